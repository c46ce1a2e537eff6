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
    const CONNECTS: bool = false;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = CanConfig::new(INTERFACE);
        (config.fd, config.bit_rate_switch) = (FD, FD);
        config.node.address = match at {
            Some(MediumAddress::Can(address)) => address,
            _ => NEXT.fetch_add(1, Ordering::Relaxed),
        };
        (config.node.mtu, config.node.queue_frames) = (65_000, 256);
        let (address, panic) =
            start(FrameTransport::new(CanBus::new(config, blastema_doubles::now)));
        Opened { transport: address.into(), wrapper: None, panic }
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

// No port is taken: any number of programs can use one interface.
conformance! {
    classic, OverCan<false>:
    frames_arrive_whole,
    the_empty_and_the_largest_frame_arrive,
    a_frame_that_is_too_large_is_refused_and_counted,
    an_address_of_another_medium_is_refused_and_counted,
    many_frames_keep_their_order_and_none_is_doubled,
    attaching_replaces_who_was_attached_and_tells_the_present_state,
    a_peer_that_is_gone_and_back_is_reached_again,
    closing_releases_the_port,
    garbage_on_the_wire_harms_nobody,
    a_flood_before_a_receiver_that_hangs_stays_bounded,
    the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
}
conformance! {
    fd, OverCan<true>:
    frames_arrive_whole,
    the_empty_and_the_largest_frame_arrive,
    a_frame_that_is_too_large_is_refused_and_counted,
    an_address_of_another_medium_is_refused_and_counted,
    many_frames_keep_their_order_and_none_is_doubled,
    attaching_replaces_who_was_attached_and_tells_the_present_state,
    a_peer_that_is_gone_and_back_is_reached_again,
    closing_releases_the_port,
    garbage_on_the_wire_harms_nobody,
    a_flood_before_a_receiver_that_hangs_stays_bounded,
    the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
}
