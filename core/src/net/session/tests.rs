//! Two sessions and the wire between them, every state with every input.

mod best_effort;
mod delivery;
mod incarnations;
mod overtaking;
mod paths;
mod settling;

use super::*;
use crate::net::wire::segment::{Ack, DelayTicks, OpenSegment};
use crate::testing::{at, node as named};

const MS: Duration = Duration::from_millis(1);

fn config(node: &str, incarnation: u64, peer: &str) -> SessionConfig {
    SessionConfig::new(named(node), Incarnation(incarnation), named(peer))
}

fn text(text: &'static str) -> Bytes {
    Bytes::from_static(text.as_bytes())
}

/// Says whether the wire loses what this end sends.
type Lose = Box<dyn FnMut(usize, &Segment) -> bool>;

/// A wire that takes a millisecond and loses what it is told to.
struct Pair {
    ends: [Session; 2],
    now: u64,
    wire: VecDeque<(u64, usize, Bytes)>,
    /// Bytes per second each way, where the wire is slow, and until when each way is taken.
    rate: Option<u64>,
    taken: [u64; 2],
    /// Control passes what waits for a slow wire, as in the queues of a transport.
    overtakes: bool,
    /// Every segment that went out, by its sender.
    sent: Vec<(usize, Segment)>,
    outputs: [Vec<SessionOutput>; 2],
    lose: Lose,
}

impl Pair {
    fn new() -> Self {
        Pair::of(config("left", 1, "right"), config("right", 1, "left"))
    }

    fn of(left: SessionConfig, right: SessionConfig) -> Self {
        Pair {
            ends: [Session::new(left, at(0)), Session::new(right, at(0))],
            now: 0,
            wire: VecDeque::new(),
            rate: None,
            taken: [0; 2],
            overtakes: false,
            sent: vec![],
            outputs: [vec![], vec![]],
            lose: Box::new(|_, _| false),
        }
    }

    /// Both ends know a path, and a session is open.
    fn open() -> Self {
        let mut pair = Pair::new();
        pair.connect();
        assert_eq!(pair.take(0), [opened(1)]);
        assert_eq!(pair.take(1), [opened(1)]);
        pair
    }

    fn connect(&mut self) {
        self.connect_over(1389);
    }

    fn connect_over(&mut self, mtu: usize) {
        for end in 0..2 {
            self.ends[end].handle_path(mtu, at(self.now));
        }
        self.run(20);
    }

    fn run(&mut self, millis: u64) {
        let end = self.now + millis;
        while self.now <= end {
            while let Some(first) = self.wire.iter().position(|(due, ..)| *due <= self.now) {
                let (_, to, segment) = self.wire.remove(first).unwrap();
                self.ends[to].handle_segment(segment, at(self.now));
                self.drain();
            }
            for end in 0..2 {
                let session = &mut self.ends[end];
                if session.poll_timeout().is_some_and(|due| due <= at(self.now)) {
                    session.handle_timeout(at(self.now));
                }
            }
            self.drain();
            self.now += 1;
        }
    }

    fn drain(&mut self) {
        for end in 0..2 {
            while let Some(mut output) = self.ends[end].poll_output() {
                if let SessionOutput::Opened { number, .. } = &mut output {
                    assert_eq!(std::mem::take(number), self.ends[end].number());
                }
                let SessionOutput::Transmit { class, segment, .. } = output else {
                    self.outputs[end].push(output);
                    continue;
                };
                let segment = segment.into_bytes();
                let decoded = Segment::decode(segment.clone()).unwrap();
                if !(self.lose)(end, &decoded) {
                    let due = match self.rate {
                        Some(rate) if class != PacketPriority::Control || !self.overtakes => {
                            let takes = segment.len() as u64 * 1000 / rate;
                            self.taken[end] = self.taken[end].max(self.now) + takes;
                            self.taken[end]
                        }
                        _ => self.now + 1,
                    };
                    self.wire.push_back((due, 1 - end, segment));
                }
                self.sent.push((end, decoded));
            }
        }
    }

    fn send(&mut self, from: usize, message: Bytes) {
        self.ends[from].handle_send(TrafficClass::Request, message, at(self.now)).unwrap();
    }

    fn take(&mut self, end: usize) -> Vec<SessionOutput> {
        std::mem::take(&mut self.outputs[end])
    }

    fn parts(&self, from: usize) -> usize {
        self.sent.iter().filter(|(end, s)| *end == from && matches!(s, Segment::Data(_))).count()
    }
}

impl Session {
    /// With the default ordering key.
    fn handle_send(
        &mut self,
        stream: TrafficClass,
        message: impl Into<GatherBuffer>,
        now: Instant,
    ) -> Result<(), Refused> {
        self.handle_send_along(stream, OrderingKey::default(), message, None, now)
    }
}

fn opened(incarnation: u64) -> SessionOutput {
    SessionOutput::Opened { incarnation: Incarnation(incarnation), number: 0 }
}

fn message(message: Bytes) -> SessionOutput {
    SessionOutput::Message { stream: TrafficClass::Request, message }
}

fn returned(message: Bytes, why: &DeliveryError) -> SessionOutput {
    SessionOutput::Returned { stream: TrafficClass::Request, message, why: why.clone(), sent: true }
}

fn unreachable(node: &str) -> DeliveryError {
    DeliveryError::Unreachable { node: node.into() }
}
