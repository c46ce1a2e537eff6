use super::*;
use crate::medium::can::{CanId, Format};
use crate::random::Random;
use crate::testing::at;
use proptest::prelude::*;
use std::time::Duration;

const FD: Format = Format::Fd { fast: true };

fn node(address: u8, config: IsoTpConfig) -> IsoTp {
    IsoTp::new(BusAddress(address), config).unwrap()
}

fn message(length: usize, seed: u8) -> Bytes {
    (0..length).map(|at| (at as u8).wrapping_mul(31).wrapping_add(seed)).collect()
}

/// A bus: of the frames that nodes have ready the lowest identifier goes first; what one says all
/// others hear, in order, unless it is lost.
struct Bus {
    nodes: Vec<IsoTp>,
    ready: Vec<Option<CanFrame>>,
    now: Instant,
    random: Random,
    loss: f64,
    outputs: Vec<(usize, IsoTpOutput)>,
}

impl Bus {
    fn new(nodes: Vec<IsoTp>) -> Self {
        let ready = vec![None; nodes.len()];
        Bus { nodes, ready, now: at(1), random: Random::new(1), loss: 0.0, outputs: Vec::new() }
    }

    fn drain(&mut self) {
        for (number, node) in self.nodes.iter_mut().enumerate() {
            self.outputs
                .extend(std::iter::from_fn(|| node.poll_output()).map(|output| (number, output)));
        }
    }

    fn send(&mut self, from: usize, to: BusAddress, message: Bytes) {
        let taken = self.nodes[from].handle_message(to, message, FrameLane::Usual, self.now);
        assert_eq!(taken, Ok(()));
    }

    /// Runs until nothing is under way any more; each frame takes a quarter of a millisecond.
    fn run(&mut self) {
        for _ in 0..200_000 {
            self.drain();
            for (node, ready) in self.nodes.iter_mut().zip(&mut self.ready) {
                *ready = ready.take().or_else(|| node.poll_frame(self.now));
            }
            let ready = self.ready.iter().enumerate();
            let ready = ready.filter_map(|(number, frame)| Some((frame.as_ref()?.id(), number)));
            if let Some((_, speaker)) = ready.min() {
                let frame = self.ready[speaker].take().unwrap();
                self.now = self.now + Duration::from_micros(250);
                for listener in (0..self.nodes.len()).filter(|number| *number != speaker) {
                    if !self.random.chance(self.loss) {
                        self.nodes[listener].handle_frame(&frame, self.now);
                    }
                }
            } else {
                let Some(due) = self.nodes.iter().filter_map(IsoTp::poll_timeout).min() else {
                    return;
                };
                self.now = self.now.max(due);
            }
            for node in &mut self.nodes {
                node.handle_timeout(self.now);
            }
        }
        panic!("the bus never comes to rest: {:?}", self.nodes);
    }

    fn received(&self, by: usize) -> Vec<(BusAddress, Bytes)> {
        let received = |(number, output): &(usize, IsoTpOutput)| match output {
            IsoTpOutput::Received { from, message } if *number == by => {
                Some((*from, message.clone()))
            }
            _ => None,
        };
        self.outputs.iter().filter_map(received).collect()
    }
}

fn large(format: Format) -> IsoTpConfig {
    IsoTpConfig { format, message_max: 70_000, queue_messages: 100, ..IsoTpConfig::default() }
}

/// From whom, and how much.
fn shape(received: &[(BusAddress, Bytes)]) -> Vec<(u8, usize)> {
    received.iter().map(|(from, message)| (from.0, message.len())).collect()
}

#[test]
fn messages_of_every_length_arrive_over_both_formats_and_all_block_sizes() {
    for format in [Format::Classic, FD] {
        for (block_size, separation_ms) in [(0, 0), (1, 0), (8, 1), (255, 0)] {
            let separation = SeparationTime::at_least(Duration::from_millis(separation_ms));
            let config = IsoTpConfig { block_size, separation, ..large(format) };
            let mut bus = Bus::new(vec![node(1, config), node(2, config)]);
            let lengths = [1, 6, 7, 8, 9, 13, 14, 61, 62, 63, 64, 125, 126, 1000, 4095, 4096, 5000];
            lengths.iter().for_each(|length| bus.send(0, BusAddress(2), message(*length, 3)));

            bus.run();

            let expected = lengths.map(|length| (BusAddress(1), message(length, 3)));
            let received = bus.received(1);
            assert!(received == expected, "{format:?} {block_size} {:?}", shape(&received));
            let sent =
                |(_, output): &&(usize, IsoTpOutput)| matches!(output, IsoTpOutput::Sent { .. });
            assert_eq!(bus.outputs.iter().filter(sent).count(), lengths.len());
        }
    }
}

#[test]
fn nodes_of_both_formats_understand_each_other() {
    let mut bus = Bus::new(vec![node(1, large(FD)), node(2, large(Format::Classic))]);
    for (own, other) in [(0, 2), (1, 1)] {
        bus.send(own, BusAddress(other), message(500, other));
    }

    bus.run();

    assert_eq!(bus.received(1), [(BusAddress(1), message(500, 2))]);
    assert_eq!(bus.received(0), [(BusAddress(2), message(500, 1))]);
}

#[test]
fn every_node_can_speak_to_every_other_at_one_time_and_to_all() {
    let new = |own| node(own, large(Format::Classic));
    let mut bus = Bus::new((0..8).map(new).collect());
    let targets = || (0..8).map(BusAddress).chain([BusAddress::ALL]);
    for own in 0..8_u8 {
        for to in targets().filter(|to| *to != BusAddress(own)) {
            bus.send(own.into(), to, message(100 + usize::from(to.0), own));
        }
    }

    bus.run();

    for own in 0..8_u8 {
        let mut received = bus.received(own.into());
        received.sort();
        let mut expected: Vec<_> = (0..8)
            .filter(|from| *from != own)
            .flat_map(|from| {
                [own, 255].map(|to| (BusAddress(from), message(100 + usize::from(to), from)))
            })
            .collect();
        expected.sort();
        assert!(received == expected, "{own} got {:?}", shape(&received));
    }
}

#[test]
fn a_target_that_is_not_there_loses_what_waits_and_nobody_else_does() {
    let mut bus = Bus::new(vec![node(1, large(Format::Classic)), node(2, large(Format::Classic))]);
    for to in [9, 2] {
        (0..5).for_each(|seed| bus.send(0, BusAddress(to), message(50, seed)));
    }

    bus.run();

    assert_eq!(bus.received(1).len(), 5);
    let (to, error) = (BusAddress(9), TransmissionError::Unanswered);
    assert!(bus.outputs.contains(&(0, IsoTpOutput::NotSent { to, error, with_it: 4 })));
    assert!(bus.now - at(1) < Duration::from_millis(1100), "the timeout is waited for once");
}

#[test]
fn a_bus_that_takes_no_frames_is_noticed() {
    let mut node = node(1, IsoTpConfig::default());
    assert_eq!(node.handle_message(BusAddress(2), message(3, 0), FrameLane::Usual, at(1)), Ok(()));
    assert_eq!(node.handle_message(BusAddress(2), message(3, 0), FrameLane::Usual, at(1)), Ok(()));

    assert_eq!(node.poll_timeout(), Some(at(1001)));
    node.handle_timeout(at(1001));

    let (to, error) = (BusAddress(2), TransmissionError::BusStuck);
    assert_eq!(node.poll_output(), Some(IsoTpOutput::NotSent { to, error, with_it: 1 }));
    assert_eq!((node.poll_frame(at(1001)), node.poll_timeout()), (None, None));
}

#[test]
fn what_cannot_be_sent_is_refused_with_the_reason() {
    let mut node = node(1, IsoTpConfig { queue_messages: 2, ..IsoTpConfig::default() });
    let mut check = |to, length, expected| {
        assert_eq!(
            node.handle_message(BusAddress(to), message(length, 0), FrameLane::Usual, at(1)),
            expected
        );
    };
    check(1, 5, Err(EnqueueError::Ourselves { to: BusAddress(1) }));
    check(2, 0, Err(EnqueueError::Length { length: 0, limit: 1024 }));
    check(2, 1025, Err(EnqueueError::Length { length: 1025, limit: 1024 }));
    check(2, 1024, Ok(())); // Under way.
    check(2, 1024, Ok(()));
    check(2, 1024, Ok(()));
    check(2, 1024, Err(EnqueueError::Full { to: BusAddress(2) }));
    check(3, 1024, Ok(()));
    assert!(IsoTp::new(BusAddress::ALL, IsoTpConfig::default()).is_none());
}

#[test]
fn what_comes_in_wrong_is_told_by_its_kind_and_harms_nothing() {
    let mut node = node(1, IsoTpConfig { receptions_max: 1, ..IsoTpConfig::default() });
    let mut hear = |from: u8, to: u8, data: &[u8]| {
        let parties = AddressInfo { source: BusAddress(from), target: BusAddress(to) };
        let id = parties.id().unwrap();
        node.handle_frame(&CanFrame::new(id, Format::Classic, data).unwrap(), at(1));
        std::iter::from_fn(|| node.poll_output()).collect::<Vec<_>>()
    };
    for refused in [&b"\xf0"[..], b"", b"\x30\x00\x00"] {
        assert_eq!(hear(2, 1, refused), [IsoTpOutput::Refused]);
    }
    assert_eq!(hear(2, 255, b"\x30\x00\x00"), [IsoTpOutput::Refused]);
    assert_eq!(hear(1, 2, b"\x01a"), [IsoTpOutput::AddressTaken]);
    assert_eq!(hear(1, 255, b"\x01a"), [IsoTpOutput::AddressTaken]);
    assert_eq!(hear(2, 3, b"\x01a"), [], "others may talk");
    let from = BusAddress(2);
    let unexpected = IsoTpOutput::NotReceived { from, error: ReceptionError::Unexpected };
    assert_eq!(hear(2, 1, b"\x21abc"), [unexpected]);
    assert_eq!(hear(3, 1, b"\x10\x10abcdef"), []);
    let many = IsoTpOutput::NotReceived { from, error: ReceptionError::TooMany };
    assert_eq!(hear(2, 1, b"\x10\x10abcdef"), [many]);
    let foreign = CanFrame::new(CanId::standard(1).unwrap(), Format::Classic, b"\x01a").unwrap();
    node.handle_frame(&foreign, at(1));
    assert_eq!(node.poll_output(), None, "other things on the bus are no fault");
}

#[test]
fn an_urgent_message_goes_before_those_that_wait_for_the_same_target() {
    let config = large(Format::Classic);
    let mut bus = Bus::new(vec![node(1, config), node(2, config)]);
    let to = BusAddress(2);
    [100, 200, 300].into_iter().for_each(|length| bus.send(0, to, message(length, 0)));

    assert_eq!(bus.nodes[0].handle_message(to, message(50, 0), FrameLane::Urgent, bus.now), Ok(()));
    bus.run();

    let lengths: Vec<_> = bus.received(1).iter().map(|(_, message)| message.len()).collect();
    assert_eq!(lengths, [100, 50, 200, 300], "one is under way at a time");
}

#[test]
fn frames_of_long_messages_take_turns() {
    let config = large(Format::Classic);
    let mut bus = Bus::new(vec![node(1, config), node(2, config), node(3, config)]);
    // The short message is not kept waiting by the long one.
    bus.send(0, BusAddress(2), message(5000, 0));
    bus.send(0, BusAddress(3), message(50, 0));

    bus.run();

    let order: Vec<usize> = bus
        .outputs
        .iter()
        .filter(|(_, output)| matches!(output, IsoTpOutput::Received { .. }))
        .map(|(by, _)| *by)
        .collect();
    assert_eq!(order, [2, 1]);
}

fn any_config() -> impl Strategy<Value = IsoTpConfig> {
    (any::<bool>(), any::<u8>(), 0_u8..=3).prop_map(|(fd, block_size, separation)| IsoTpConfig {
        block_size,
        separation: SeparationTime(separation),
        ..large(if fd { FD } else { Format::Classic })
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn whatever_is_lost_what_arrives_is_what_was_sent_and_everything_comes_to_rest(
        configs in (any_config(), any_config()),
        lengths in prop::collection::vec(1_usize..6000, 1..8),
        loss in 0.0..0.3_f64,
        seed in any::<u64>(),
    ) {
        let mut bus = Bus::new(vec![node(1, configs.0), node(2, configs.1)]);
        (bus.loss, bus.random) = (loss, Random::new(seed));
        for (number, length) in lengths.iter().enumerate() {
            let (here, there) = (number % 2, BusAddress(2 - number as u8 % 2));
            let message = message(*length, number as u8);
            bus.send(here, there, message);
        }

        bus.run();

        for by in [0, 1] {
            let sent: Vec<_> = lengths
                .iter()
                .enumerate()
                .filter(|(number, _)| number % 2 != by)
                .map(|(number, length)| message(*length, number as u8))
                .collect();
            let mut rest = sent.iter();
            for (_, received) in bus.received(by) {
                prop_assert!(rest.any(|sent| *sent == received), "in order, and none invented");
            }
            if loss == 0.0 {
                prop_assert_eq!(bus.received(by).len(), sent.len());
            }
        }
    }

    #[test]
    fn no_bytes_in_any_order_make_it_panic_or_grow(
        script in prop::collection::vec(
            (0_u8..6, prop::collection::vec(any::<u8>(), 0..9), 0_u64..400),
            0..200,
        ),
    ) {
        let mut node = node(1, IsoTpConfig { receptions_max: 2, ..IsoTpConfig::default() });
        let mut now = at(1);
        for (from, data, wait) in script {
            now = now + Duration::from_millis(wait);
            node.handle_timeout(now);
            let _ = node.handle_message(BusAddress(2), message(100, 0), FrameLane::Usual, now);
            let to = if from == 5 { BusAddress::ALL } else { BusAddress(1) };
            let parties = AddressInfo { source: BusAddress(from), target: to };
            let id = parties.id().unwrap();
            if let Some(frame) = CanFrame::new(id, Format::Classic, &data) {
                node.handle_frame(&frame, now);
            }
            while node.poll_output().is_some() {}
            while node.poll_frame(now).is_some() {}
            prop_assert!(node.poll_timeout().is_none_or(|due| due > now));
            prop_assert!(node.incoming.len() <= 2 * 6);
        }
    }
}
