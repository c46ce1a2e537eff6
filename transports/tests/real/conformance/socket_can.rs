//! CAN as the system has it; only the guest of `tests/guest` has any.

use super::*;
use blastema_transports::{CanBus, CanConfig, FrameTransport};
use socketcan::{CanDataFrame, CanFdSocket, EmbeddedFrame, ExtendedId, Socket};
use std::sync::atomic::{AtomicU8, Ordering};

const INTERFACE: &str = "vcan0";
/// All tests share the interface: no address is used twice.
static NEXT: AtomicU8 = AtomicU8::new(1);

#[derive(Default)]
struct OverCan<const FD: bool>;

impl<const FD: bool> Medium for OverCan<FD> {
    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = CanConfig::new(INTERFACE);
        (config.fd, config.bit_rate_switch) = (FD, FD);
        config.node.address = match at {
            Some(MediumAddress::Can(address)) => address,
            _ => NEXT.fetch_add(1, Ordering::Relaxed),
        };
        (config.node.mtu, config.node.queue_frames) = (65_000, 256);
        Opened::of(FrameTransport::new(CanBus::new(config, blastema_doubles::now)))
    }

    fn garbage(&self, to: &MediumAddress) {
        let MediumAddress::Can(number) = to else { panic!("{to} is on no bus") };
        let bus = CanFdSocket::open(INTERFACE).unwrap();
        let id = ExtendedId::new(0x18da_00fe | u32::from(*number) << 8).unwrap();
        for data in [&b""[..], b"\xff", b"\x21abc", b"\x30", b"\x10\x20abcdef", b"\x00"] {
            bus.write_frame(&CanDataFrame::new(id, data).unwrap()).unwrap();
        }
    }
}

conformance! {
    shared:
    classic: OverCan<false>,
    fd: OverCan<true>,
}
