//! Whatever frames arrive at whatever times, a link neither panics nor piles anything up.

#![no_main]

use blastema_core::net::{Link, LinkConfig, LinkOutput};
use blastema_core::{Incarnation, Instant, Machine, NodeName};
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

fuzz_target!(|script: Vec<(u16, Vec<u8>)>| {
    let node = NodeName::new("m1").expect("a good name");
    let mut now = Instant::from_millis(1);
    let mut link = Link::new(LinkConfig::new(node, Incarnation(7)), now);
    for (wait_ms, frame) in script {
        now = now + Duration::from_millis(wait_ms.into());
        link.handle_timeout(now);
        link.handle_frame(Bytes::from(frame), now);
        let mut outputs = 0;
        while let Some(output) = link.poll_output() {
            outputs += 1;
            // A link answers a frame with a few words of its own at most.
            assert!(outputs < 16, "too much to do: {output:?}");
            if let LinkOutput::Transmit(frame) = output {
                assert!(frame.len() < 128, "a hello is small");
            }
        }
        assert!(link.poll_timeout().is_some_and(|due| due > now), "it will say hello again");
    }
});
