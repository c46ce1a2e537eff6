//! What is particular to CAN adapters on serial ports, on a bus of ptys.

use crate::conformance::end::End;
use actix::Actor;
use blastema_contract::transport::MediumAddress::Can;
use blastema_contract::transport::TransportReport;
use blastema_ptys::Adapters;
use blastema_transports::{FrameTransport, SlcanBus, SlcanConfig};

/// The node with this address, at the adapter with the same number.
fn at(bus: &Adapters, number: u8) -> End {
    with(bus, number, |_| {})
}

fn with(bus: &Adapters, number: u8, change: impl FnOnce(&mut SlcanConfig)) -> End {
    let mut config = SlcanConfig::new(bus.port(number));
    (config.bitrate, config.node.address) = (1_000_000, number);
    change(&mut config);
    End::new(FrameTransport::new(SlcanBus::new(config, blastema_doubles::now)).start())
}

/// A bus, and two nodes on it that are open.
async fn two([one, other]: [u8; 2], change: fn(&mut SlcanConfig)) -> (Adapters, End, End) {
    let bus = Adapters::new();
    [one, other].into_iter().for_each(|number| bus.plug(number));
    let (a, b) = (with(&bus, one, change), with(&bus, other, change));
    a.opened().await;
    b.opened().await;
    (bus, a, b)
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn several_nodes_share_a_bus_and_one_can_speak_to_all() {
    let bus = Adapters::new();
    (1..=4).for_each(|number| bus.plug(number));
    let ends: Vec<End> = (1..=4).map(|number| at(&bus, number)).collect();
    for end in &ends {
        end.opened().await;
    }

    ends[0].send(Can(2), "to the second, and in more than one CAN frame");
    ends[1].expect(Can(1), "to the second, and in more than one CAN frame").await;
    ends[3].send(Can(255), "to all, and in more than one CAN frame");

    for end in &ends[..3] {
        end.expect(Can(4), "to all, and in more than one CAN frame").await;
    }
    assert!(ends.iter().all(|end| end.frames.is_empty()));
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_adapter_that_answers_nothing_is_used_all_the_same() {
    let (_bus, a, b) = two([1, 100], |_| {}).await;

    a.send(Can(100), "hello");
    b.expect(Can(1), "hello").await;
    b.send(Can(1), "hello, and more of it than a CAN frame carries");
    a.expect(Can(100), "hello, and more of it than a CAN frame carries").await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_adapter_that_is_unplugged_is_opened_when_it_is_back() {
    let (bus, a, b) = two([1, 2], |_| {}).await;
    a.send(Can(2), "before");
    b.expect(Can(1), "before").await;

    bus.unplug(2);
    let reason = b.closed().await;
    assert!(reason.contains("plug it in"), "{reason}");
    bus.plug(2);
    b.opened().await;

    a.send(Can(2), "after");
    b.expect(Can(1), "after").await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_target_that_is_not_there_keeps_nobody_else_waiting() {
    let (_bus, a, b) = two([1, 2], |_| {}).await;

    (0..10).for_each(|_| a.send(Can(9), "no node is there to hear this"));
    a.send(Can(2), "a node is there to hear this");

    b.expect(Can(1), "a node is there to hear this").await;
    a.counted(|counters| counters.dropped == 10).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_nobody_can_do_is_refused_with_what_helps() {
    let bus = Adapters::new();
    bus.plug(1);
    let check = async |change: fn(&mut SlcanConfig), expected: &str| {
        let reason = with(&bus, 1, change).closed().await;
        assert!(reason.contains(expected), "{reason}");
    };
    check(|config| config.bitrate = 300_000, "choose 10, 20, 50").await;
    check(|config| config.node.address = 255, "choose one from 0 to 254").await;
    check(|config| config.path = "/dev/does-not-exist".into(), "plug the device in").await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn who_speaks_under_our_address_is_refused_and_the_others_are_heard() {
    let (bus, a, b) = two([1, 2], |_| {}).await;

    // From node 1 to node 2, as node 1 hears it.
    bus.inject(1, b"T18DA02015040102030405\r");
    b.send(Can(1), "hello");

    a.expect(Can(2), "hello").await;
    assert_eq!(a.counters().await.refused, 1);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn two_nodes_with_one_address_are_both_told_and_a_third_is_not() {
    let bus = Adapters::new();
    (1..=3).for_each(|number| bus.plug(number));
    let of = |number: u8, address: u8| with(&bus, number, |config| config.node.address = address);
    let (first, second, other) = (of(1, 7), of(2, 7), of(3, 9));
    for end in [&first, &second, &other] {
        end.opened().await;
    }

    let clash = |report: &TransportReport| matches!(report, TransportReport::Clash { .. });
    for (number, sender, told) in [(2, &first, &second), (1, &second, &first)] {
        sender.send(Can(255), "to all, in more than one CAN frame");
        other.expect(Can(7), "to all, in more than one CAN frame").await;
        let TransportReport::Clash { reason } = told.reports.wait(clash).await else {
            unreachable!("it was waited for")
        };
        let port = format!("slcan {}", bus.port(number).display());
        let expected = "another node sends under this node's address 7";
        assert!(reason.starts_with(&port) && reason.contains(expected), "{reason}");
    }

    // The one whose address it is receives nothing of it as if it were another node's.
    assert_eq!((first.frames.len(), second.frames.len()), (0, 0));
    assert!(!other.reports.drain().iter().any(clash));
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_adapter_with_can_fd_carries_frames_of_64_bytes_and_one_without_says_so() {
    let (bus, a, b) = two([1, 2], |config| config.fd = true).await;
    a.send(Can(2), "more than eight bytes, and less than sixty-four");
    b.expect(Can(1), "more than eight bytes, and less than sixty-four").await;

    bus.plug(3);
    let wrong = with(&bus, 3, |config| (config.fd, config.data_bitrate) = (true, 3_000_000));
    let reason = wrong.closed().await;
    assert!(reason.contains("choose 2 or 5 Mbit/s, or leave fd out"), "{reason}");
}
