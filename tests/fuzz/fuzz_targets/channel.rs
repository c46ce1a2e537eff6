//! Whatever frames arrive at whatever times, a node's seals neither panic nor pile anything up,
//! open nothing, and send to no address more than came from there.

#![no_main]

use blastema_core::net::NodeId;
use blastema_core::net::seal::{NoiseCrypto, SealProfile, Sealer, SealerConfig, SealerOutput};
use blastema_core::{Incarnation, Instant, Machine};
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

fuzz_target!(|script: (bool, Vec<(u16, bool, Vec<u8>)>)| {
    let (compact, frames) = script;
    let mut now = Instant::from_millis(1);
    let node = NodeId(5);
    let profile = if compact { SealProfile::Compact } else { SealProfile::Full };
    let config = SealerConfig { profile, ..SealerConfig::new(node, Incarnation(7), "ranger") };
    let mut sealer = Sealer::new(config, NoiseCrypto::new([1; 32]), [2; 32], now);
    for peer in [1, 9] {
        let public = NoiseCrypto::new([peer; 32]).public_key();
        sealer.add_peer(NodeId(peer.into()), &public).expect("a good key");
    }
    // One of them is asked, so that its answer is expected.
    sealer.connect(NodeId(9), 9, now);
    let (mut received, mut sent) = (0, 0);
    for (wait_ms, turn, frame) in frames {
        now = now + Duration::from_millis(wait_ms.into());
        sealer.handle_timeout(now);
        received += frame.len();
        let opened = sealer.handle_frame(Bytes::from(frame), &3, now);
        assert!(!matches!(opened, Ok(Some(_))), "no keys were agreed on");
        if turn {
            sealer.handle_turn(now);
        }
        let mut outputs = 0;
        while let Some(output) = sealer.poll_output() {
            outputs += 1;
            assert!(outputs < 8, "too much to do: {output:?}");
            if let SealerOutput::Transmit { to: 3, frame } = output {
                sent += frame.len();
            }
        }
        assert!(sent <= received);
        assert!(sealer.poll_timeout().is_some_and(|due| due > now), "it asks again");
    }
});
