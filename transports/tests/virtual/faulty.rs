//! What the fault wrapper does when it is told to, in virtual time.

use actix::prelude::*;
use blastema_contract::transport::{
    Adopt, Attach, ConnectionTrust, Cut, Direction, Impair, InjectedFaults, MediumAddress,
    Partition, ReadInjectedFaults, Received, Restore, Transmit, Transport, TransportReport,
};
use blastema_core::medium::impairment::Impairment;
use blastema_doubles::{MockTransport, Probe, advance, now, paused};
use blastema_transports::{FaultInjector, FaultInjectorConfig};
use std::time::Duration;

const MS: fn(u64) -> Duration = Duration::from_millis;

/// A cable with a mock behind it and probes before it.
struct Bench {
    medium: MockTransport,
    cable: Addr<FaultInjector>,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
}

impl Bench {
    async fn new(seed: u64) -> Self {
        let medium = MockTransport::start("here");
        let cable =
            FaultInjector::new(medium.transport(), FaultInjectorConfig::new(seed, now)).start();
        let (frames, reports) = (Probe::start(), Probe::start());
        let (to_frames, to_reports) = (frames.recipient(), reports.recipient());
        cable.do_send(Attach::new(to_frames, to_reports));
        let opened: TransportReport = reports.expect().await;
        assert!(matches!(opened, TransportReport::Opened { .. }));
        Bench { medium, cable, frames, reports }
    }

    fn transmit(&self, numbers: std::ops::Range<u8>) {
        for number in numbers {
            let frame = vec![number].into();
            Transport::from(self.cable.clone())
                .transmit
                .do_send(Transmit::new(self.medium.local(), frame));
        }
    }

    fn sent(&self) -> Vec<u8> {
        self.medium.sent().iter().map(|sent| sent.frame.pieces()[0][0]).collect()
    }

    fn receive(&self, numbers: std::ops::Range<u8>) {
        numbers.for_each(|number| self.medium.receive(self.medium.local(), vec![number]));
    }

    fn received(&self) -> Vec<u8> {
        self.frames.drain().iter().map(|received| received.frame[0]).collect()
    }

    async fn injected(&self) -> InjectedFaults {
        self.cable.send(ReadInjectedFaults).await.unwrap()
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_good_cable_passes_everything_both_ways() {
    let bench = Bench::new(1).await;

    bench.transmit(0..100);
    bench.receive(100..200);
    advance(Duration::ZERO).await;

    assert_eq!(bench.sent(), (0..100).collect::<Vec<_>>());
    assert_eq!(bench.received(), (100..200).collect::<Vec<_>>());
    let InjectedFaults { outgoing, incoming } = bench.injected().await;
    assert_eq!((outgoing.passed, incoming.passed), (100, 100));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn each_direction_is_as_bad_as_told() {
    let bench = Bench::new(1).await;
    let lossy = Impairment { loss: 1.0, ..Impairment::default() };
    bench.cable.do_send(Impair { direction: Direction::Outgoing, impairment: lossy });
    let slow = Impairment { delay: MS(20), ..Impairment::default() };
    bench.cable.do_send(Impair { direction: Direction::Incoming, impairment: slow });

    bench.transmit(0..10);
    bench.receive(0..10);
    advance(MS(19)).await;
    assert_eq!((bench.sent(), bench.received()), (vec![], vec![]));

    advance(MS(1)).await;
    assert_eq!((bench.sent(), bench.received()), (vec![], (0..10).collect()));
    let InjectedFaults { outgoing, incoming } = bench.injected().await;
    assert_eq!((outgoing.lost, incoming.delayed), (10, 10));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_silent_cut_says_nothing_and_a_mended_cable_passes_again() {
    let bench = Bench::new(1).await;

    bench.cable.do_send(Cut { direction: Direction::Both, reported: false });
    bench.transmit(0..10);
    bench.receive(0..10);
    advance(Duration::from_secs(3600)).await;
    assert_eq!((bench.sent(), bench.received()), (vec![], vec![]));
    assert!(bench.reports.drain().is_empty());

    bench.cable.do_send(Restore);
    bench.transmit(10..20);
    bench.receive(10..20);
    advance(Duration::ZERO).await;
    assert_eq!((bench.sent(), bench.received()), ((10..20).collect(), (10..20).collect()));
    let InjectedFaults { outgoing, incoming } = bench.injected().await;
    assert_eq!((outgoing.cut, incoming.cut), (10, 10));
    assert!(bench.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_cut_in_one_direction_leaves_the_other() {
    let bench = Bench::new(1).await;

    bench.cable.do_send(Cut { direction: Direction::Incoming, reported: false });
    bench.transmit(0..10);
    bench.receive(0..10);
    advance(MS(1)).await;

    assert_eq!((bench.sent(), bench.received()), ((0..10).collect(), vec![]));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_cut_that_is_noticed_is_reported_and_so_is_its_end() {
    let bench = Bench::new(1).await;

    bench.cable.do_send(Cut { direction: Direction::Both, reported: true });
    assert!(matches!(bench.reports.expect().await, TransportReport::Closed { .. }));
    // What the transport itself says meanwhile is what holds afterwards.
    let closed = TransportReport::Closed { reason: "unplugged".into() };
    bench.medium.report(closed.clone());
    bench.reports.expect_none_for(MS(1)).await;

    bench.cable.do_send(Restore);
    assert_eq!(bench.reports.expect().await, closed);

    // How much it carries is no state of its own.
    let rate = TransportReport::Rate { bytes_per_second: 100 };
    bench.medium.report(rate.clone());
    assert_eq!(bench.reports.expect().await, rate);
    bench.cable.do_send(Cut { direction: Direction::Both, reported: true });
    bench.reports.expect().await;
    bench.cable.do_send(Restore);
    assert_eq!(bench.reports.expect().await, closed);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn frames_are_overtaken_and_spoilt_in_the_direction_that_is_told() {
    let bench = Bench::new(1).await;
    let restless = Impairment { reordering: 1.0, ..Impairment::default() };
    bench.cable.do_send(Impair { direction: Direction::Outgoing, impairment: restless });
    let noisy = Impairment { corruption: 1.0, ..Impairment::default() };
    bench.cable.do_send(Impair { direction: Direction::Incoming, impairment: noisy });

    bench.transmit(0..5);
    bench.receive(0..1);
    advance(MS(9)).await;
    assert_eq!(bench.sent(), [1, 0, 3, 2]);
    assert_eq!(bench.received()[0].count_ones(), 1);

    advance(MS(1)).await;
    assert_eq!(bench.sent(), [4], "no frame has overtaken it");
    let InjectedFaults { outgoing, incoming } = bench.injected().await;
    assert_eq!((outgoing.reordered, incoming.corrupted), (3, 1));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_slow_cable_passes_so_many_bytes_a_second() {
    let bench = Bench::new(1).await;
    let slow = Impairment { rate: 100, ..Impairment::default() };
    bench.cable.do_send(Impair { direction: Direction::Outgoing, impairment: slow });

    bench.transmit(0..10);
    bench.receive(0..10);
    for number in 0..10 {
        advance(MS(9)).await;
        assert_eq!(bench.sent().len(), 0);
        advance(MS(1)).await;
        assert_eq!(bench.sent(), [number]);
    }
    assert_eq!(bench.received(), (0..10).collect::<Vec<_>>());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_partition_parts_from_some_peers_and_says_nothing() {
    let bench = Bench::new(1).await;
    let peer = |name: &str| MediumAddress::Memory(name.into());
    let send = |to: &str, number: u8| {
        let message = Transmit::new(peer(to), vec![number].into());
        bench.cable.do_send(message);
    };
    let partition = |peers: &[&str]| Partition {
        direction: Direction::Both,
        peers: peers.iter().map(|name| peer(name)).collect(),
    };

    bench.cable.do_send(partition(&["left", "right"]));
    ["left", "middle", "right"].into_iter().zip(0..).for_each(|(to, n)| send(to, n));
    for (from, number) in [("left", 0), ("middle", 1), ("right", 2)] {
        bench.medium.receive(peer(from), vec![number]);
    }
    advance(MS(1)).await;
    assert_eq!((bench.sent(), bench.received()), (vec![1], vec![1]));

    bench.cable.do_send(partition(&["left"]));
    send("left", 3);
    send("right", 4);
    advance(MS(1)).await;
    assert_eq!(bench.sent(), [4]);

    bench.cable.do_send(Restore);
    send("left", 5);
    advance(MS(1)).await;
    assert_eq!(bench.sent(), [5]);
    let InjectedFaults { outgoing, incoming } = bench.injected().await;
    assert_eq!((outgoing.parted, incoming.parted), (3, 2));
    assert!(bench.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_partition_from_a_peer_holds_for_connections_that_claim_to_be_its() {
    let bench = Bench::new(1).await;
    let connection = |number, name: &str| MediumAddress::Connection {
        number,
        claimed: MediumAddress::Memory(name.into()).into(),
    };
    bench.cable.do_send(Partition {
        direction: Direction::Both,
        peers: [MediumAddress::Memory("left".into())].into(),
    });

    for (number, name) in [(1, "left"), (2, "right")] {
        let address = connection(number.into(), name);
        bench.cable.do_send(Transmit::new(address.clone(), vec![number].into()));
        bench.medium.receive(address, vec![number]);
    }
    advance(MS(1)).await;

    assert_eq!((bench.sent(), bench.received()), (vec![2], vec![2]));
    assert_eq!(connection(2, "right").to_string(), "connection 2 of right");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_medium_is_told_which_connections_are_believed_and_which_are_adopted() {
    let bench = Bench::new(1).await;
    let (frames, reports) = (bench.frames.recipient(), bench.reports.recipient());

    let connections = ConnectionTrust::Proven;
    bench.cable.do_send(Attach { frames, reports, connections, clock: None });
    let peer = MediumAddress::Memory("peer".into());
    let connection = MediumAddress::Connection { number: 7, claimed: peer.clone().into() };
    let adopt = Adopt { connection, peer };
    bench.cable.do_send(adopt.clone());

    assert_eq!(bench.medium.expect_adopted().await, adopt);
    assert_eq!(bench.medium.connections().await, ConnectionTrust::Proven);
}

#[test]
fn one_seed_gives_one_run() {
    let run = |seed| {
        paused(async move {
            let bench = Bench::new(seed).await;
            let bad = Impairment {
                loss: 0.3,
                duplication: 0.2,
                delay: MS(5),
                jitter: MS(20),
                ..Impairment::default()
            };
            bench.cable.do_send(Impair { direction: Direction::Both, impairment: bad });
            bench.transmit(0..200);
            bench.receive(0..200);
            advance(MS(100)).await;
            (bench.sent(), bench.received())
        })
    };

    assert_eq!(run(7), run(7));
    assert_ne!(run(7), run(8));
    let (sent, received) = run(7);
    assert_ne!(sent, received, "the directions have fates of their own");
}
