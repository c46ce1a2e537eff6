//! Whatever frames arrive at whatever times, an ISO-TP node neither panics nor holds more than it
//! may, never answers more than it is asked, and comes to rest when the bus falls silent.

#![no_main]

use blastema_core::medium::can::isotp::SeparationTime;
use blastema_core::medium::lane::FrameLane;
use blastema_core::medium::can::{
    AddressInfo, BusAddress, CanFrame, Format, IsoTp, IsoTpConfig, IsoTpOutput,
};
use blastema_core::{Instant, Machine};
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

const LIMIT: usize = 300;

fuzz_target!(|script: (u8, u8, bool, Vec<(u8, u16, Vec<u8>)>)| {
    let (block_size, separation, fd, script) = script;
    let mut config = IsoTpConfig::default();
    config.format = if fd { Format::Fd { fast: true } } else { Format::Classic };
    (config.block_size, config.separation) = (block_size, SeparationTime(separation));
    (config.message_max, config.receptions_max) = (LIMIT, 2);
    let own = BusAddress(1);
    let mut now = Instant::from_millis(1);
    let mut node = IsoTp::new(own, config).expect("an address");
    // What is said to all under our own address is received: it may be another's claim to it.
    let mut own_to_all = false;
    let drain = |node: &mut IsoTp, now, own_to_all: bool| {
        let mut frames = 0;
        while node.poll_frame(now).is_some() {
            frames += 1;
            assert!(frames <= 2 + LIMIT, "more than a message is long");
        }
        while let Some(output) = node.poll_output() {
            if let IsoTpOutput::Received { from, message } = output {
                assert!(
                    (from != own || own_to_all) && !message.is_empty() && message.len() <= LIMIT
                );
            }
        }
        assert!(node.poll_timeout().is_none_or(|due| due > now));
    };
    for (who, wait_ms, data) in script {
        now = now + Duration::from_millis((wait_ms % 2000).into());
        node.handle_timeout(now);
        drain(&mut node, now, own_to_all);
        if who & 0x80 != 0 {
            let (to, lane) = (BusAddress(who & 7), FrameLane::Usual);
            let _ = node.handle_message(to, Bytes::from(data), lane, now);
        } else {
            let target = if who & 0x40 != 0 { BusAddress::ALL } else { own };
            let parties = AddressInfo { source: BusAddress(who & 7), target };
            own_to_all |= parties.source == own && target == BusAddress::ALL;
            let id = parties.id().expect("addresses of this bus");
            let format = if who & 0x20 != 0 { Format::Fd { fast: false } } else { Format::Classic };
            if let Some(frame) = CanFrame::new(id, format, &data) {
                node.handle_frame(&frame, now);
            }
        }
        drain(&mut node, now, own_to_all);
    }
    for _ in 0..100_000 {
        drain(&mut node, now, own_to_all);
        let Some(due) = node.poll_timeout() else { return };
        now = now.max(due);
        node.handle_timeout(now);
    }
    panic!("it never comes to rest: {node:?}");
});
