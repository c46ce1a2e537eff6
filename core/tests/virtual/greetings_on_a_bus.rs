//! Hellos of whole nodes on a simulated CAN bus: every frame that they cost is counted.

use blastema_core::medium::can::isotp::IsoTpOutput;
use blastema_core::medium::can::{
    Addressing, BusAddress, CanFrame, Format, IsoTp, IsoTpConfig, bits_on_bus,
};
use blastema_core::net::link::{LinkConfig, LinkOutput, LinkState};
use blastema_core::net::{Link, LinkId, LinkSet, LinkSetOutput};
use blastema_core::{Incarnation, Instant, Machine, NodeName};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::time::Duration;

const RATE_HZ: u64 = 500_000;
/// What `blastema-transports` puts behind each frame.
const CHECKSUM: &[u8] = &[0; 4];
/// A wall clock of today: it makes incarnations as long as they are.
const TODAY: u64 = 1_790_000_000_000;

struct Node {
    bundle: LinkSet,
    isotp: IsoTp,
    /// What its controller has taken and the bus not yet.
    ready: Option<CanFrame>,
    changes: Vec<(LinkId, LinkState)>,
}

struct Bus {
    now: Instant,
    nodes: Vec<Node>,
    frames: u64,
    bits: u64,
    /// Who hears nothing of whom: (speaker, listener).
    deaf: BTreeSet<(usize, usize)>,
}

fn name(index: usize) -> NodeName {
    NodeName::new(&format!("module{index}")).unwrap()
}

impl Bus {
    fn new(nodes: usize, format: Format) -> Self {
        let now = Instant::from_millis(5_000);
        let node = |own: usize| {
            let mut bundle = LinkSet::default();
            for other in (0..nodes).filter(|other| *other != own) {
                let config = LinkConfig {
                    expected: Some(name(other)),
                    ..LinkConfig::new(name(own), Incarnation(TODAY + own as u64))
                };
                // No two begin at the same time.
                let start = now + Duration::from_micros(own as u64 * 1_700);
                bundle.insert(LinkId(other as u16), Link::new(config, start));
            }
            bundle.handle_bus();
            let part = format.capacity();
            bundle.handle_rate((part as u64 - 1) * RATE_HZ / bits_on_bus(true, part));
            let mut config = IsoTpConfig::default();
            config.format = format;
            let isotp = IsoTp::new(BusAddress(own as u8), Addressing::default(), config).unwrap();
            Node { bundle, isotp, ready: None, changes: Vec::new() }
        };
        let nodes = (0..nodes).map(node).collect();
        Bus { now, nodes, frames: 0, bits: 0, deaf: BTreeSet::new() }
    }

    fn settle(&mut self) {
        let now = self.now;
        for node in &mut self.nodes {
            let due = node.bundle.poll_timeout().into_iter().chain(node.isotp.poll_timeout());
            if due.min().is_some_and(|due| due <= now) {
                node.bundle.handle_timeout(now);
                node.isotp.handle_timeout(now);
            }
            while let Some(output) = node.isotp.poll_output() {
                let IsoTpOutput::Received { from, message } = output else { continue };
                let frame = message.slice(..message.len() - CHECKSUM.len());
                let link = node.bundle.get_mut(LinkId(from.0.into())).unwrap();
                link.handle_frame(frame, now);
            }
            while let Some(output) = node.bundle.poll_output() {
                match output {
                    LinkSetOutput::Greet(frame) => {
                        let message = Bytes::from([&frame.into_bytes()[..], CHECKSUM].concat());
                        node.isotp.handle_message(BusAddress::ALL, message, now).unwrap();
                    }
                    LinkSetOutput::Of(link, LinkOutput::Changed { state, .. }) => {
                        node.changes.push((link, state));
                    }
                    LinkSetOutput::Of(_, LinkOutput::Quality(_)) => {}
                    other => panic!("{other:?}"),
                }
            }
            if node.ready.is_none() {
                node.ready = node.isotp.poll_frame(now);
            }
        }
    }

    fn run_for(&mut self, span: Duration) {
        let end = self.now + span;
        while self.now < end {
            self.settle();
            // Of those that are ready, the lowest identifier wins.
            let ready = |(at, node): (usize, &Node)| Some((node.ready?.id(), at));
            let winner = self.nodes.iter().enumerate().filter_map(ready).min();
            let Some((_, speaker)) = winner else {
                let due = self.nodes.iter().flat_map(|node| {
                    node.bundle.poll_timeout().into_iter().chain(node.isotp.poll_timeout())
                });
                let due = due.min().expect("a node always sends hellos");
                self.now = due.max(self.now + Duration::from_micros(1)).min(end);
                continue;
            };
            let frame = self.nodes[speaker].ready.take().expect("it won");
            let bits = bits_on_bus(frame.id().is_extended(), frame.length());
            (self.frames, self.bits) = (self.frames + 1, self.bits + bits);
            self.now = self.now + Duration::from_nanos(bits * 1_000_000_000 / RATE_HZ);
            for listener in (0..self.nodes.len()).filter(|listener| *listener != speaker) {
                if !self.deaf.contains(&(speaker, listener)) {
                    self.nodes[listener].isotp.handle_frame(&frame, self.now);
                }
            }
        }
    }

    fn all_up(&self) -> bool {
        let mut links = self.nodes.iter().flat_map(|node| node.bundle.iter());
        links.all(|(_, link)| link.state() == LinkState::Up)
    }
}

/// The load of so many nodes in frames a second, and in percent of the bus, with the interval.
fn load(nodes: usize, format: Format) -> (u64, f64, Duration) {
    const SECONDS: u64 = 20;
    let mut bus = Bus::new(nodes, format);
    bus.run_for(Duration::from_secs(5));
    assert!(bus.all_up(), "{nodes} nodes are up within five seconds");
    (bus.frames, bus.bits) = (0, 0);
    bus.nodes.iter_mut().for_each(|node| node.changes.clear());

    bus.run_for(Duration::from_secs(SECONDS));

    assert!(bus.all_up());
    for node in &bus.nodes {
        assert_eq!(node.changes, [], "nothing was suspected for nothing");
        for (_, link) in node.bundle.iter() {
            let round_trip = link.quality().round_trip.expect("echoes come back");
            assert!(round_trip < Duration::from_millis(40), "{round_trip:?}");
            assert_eq!(link.quality().loss_permille, 0);
        }
    }
    let (_, link) = bus.nodes[0].bundle.iter().next().unwrap();
    let percent = bus.bits as f64 * 100.0 / (RATE_HZ * SECONDS) as f64;
    (bus.frames / SECONDS, percent, link.hello_interval())
}

#[test]
fn one_hello_of_each_node_for_all_takes_a_tenth_of_a_classic_bus_at_most() {
    // As the manual has them.
    for (nodes, frames, permille, millis) in [(2, 240, 69, 50), (4, 336, 96, 95), (8, 336, 96, 190)]
    {
        let (counted, percent, interval) = load(nodes, Format::Classic);

        assert_eq!((counted, (percent * 10.0) as u32), (frames, permille), "{nodes} nodes");
        assert_eq!(interval.as_millis(), millis, "{nodes} nodes");
    }
}

#[test]
fn a_hello_is_a_single_frame_of_can_fd() {
    for (nodes, frames, permille, millis) in [(2, 40, 39, 50), (4, 80, 101, 50), (8, 85, 108, 93)] {
        let (counted, percent, interval) = load(nodes, Format::Fd { fast: false });

        assert_eq!((counted, (percent * 10.0) as u32), (frames, permille), "{nodes} nodes");
        assert_eq!(interval.as_millis(), millis, "{nodes} nodes");
    }
}

#[test]
fn two_that_do_not_hear_each_other_give_their_link_up_and_no_other() {
    let mut bus = Bus::new(4, Format::Classic);
    bus.run_for(Duration::from_secs(5));
    bus.nodes.iter_mut().for_each(|node| node.changes.clear());

    bus.deaf.insert((1, 2));
    bus.run_for(Duration::from_secs(5));

    let down = |node: &Node| {
        let down = node.bundle.iter().filter(|(_, link)| link.state() == LinkState::Down);
        down.map(|(number, _)| number.0).collect::<Vec<_>>()
    };
    let found: Vec<_> = bus.nodes.iter().map(down).collect();
    assert_eq!(found, [vec![], vec![2], vec![1], vec![]], "both ends, for one hears nothing");
    assert!(bus.nodes[0].changes.is_empty() && bus.nodes[3].changes.is_empty());

    bus.deaf.clear();
    bus.run_for(Duration::from_secs(5));
    assert!(bus.all_up());
}

#[test]
fn a_node_that_leaves_the_bus_is_noticed_after_three_and_a_half_of_its_hellos() {
    let mut bus = Bus::new(4, Format::Classic);
    bus.run_for(Duration::from_secs(5));
    bus.deaf.extend((0..3).map(|listener| (3, listener)));
    let cut = bus.now;
    bus.run_for(Duration::from_millis(250));
    assert!(
        bus.nodes[..3]
            .iter()
            .all(|node| { node.bundle.get(LinkId(3)).unwrap().state() != LinkState::Down })
    );

    bus.run_for(Duration::from_millis(200));

    // Three and a half intervals of 95 ms, one more since its last hello, and what the hello took.
    assert!(bus.now - cut <= Duration::from_millis(451));
    for node in &bus.nodes[..3] {
        assert_eq!(node.bundle.get(LinkId(3)).unwrap().state(), LinkState::Down);
    }
}
