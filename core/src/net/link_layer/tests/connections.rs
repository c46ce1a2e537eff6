//! Two nodes that connect to each other at the same time, over streams.

use super::*;
use crate::random::Random;

/// The connection that node `by` has made, as the other end names it.
fn named(by: usize) -> Address {
    10 + by as Address
}

/// Two nodes, each of which has connected to the other. Each sends to the other's address over the
/// connection that is its peer's: its own, until it adopts the other one and closes its own.
struct Streams {
    ends: [End; 2],
    /// By who has made it; a closed one carries nothing more.
    open: [bool; 2],
    /// Which connection is the peer's, by who has made it.
    place: [usize; 2],
    adopted: [Vec<usize>; 2],
    now: u64,
    /// When the last frame arrives that each end has sent on each connection: they stay in order.
    last: [[u64; 2]; 2],
    in_flight: Vec<(u64, usize, usize, Bytes)>,
    random: Random,
}

impl Streams {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        // One of them is started a little later.
        let late = random.below(30);
        Streams {
            ends: [end(0, 1, 0), end(1, 1, late)],
            open: [true; 2],
            place: [0, 1],
            adopted: [vec![], vec![]],
            now: late,
            last: [[0; 2]; 2],
            in_flight: vec![],
            random,
        }
    }

    fn send(&mut self, node: usize, to: Address, frame: Bytes) {
        let connection = if to < 10 { self.place[node] } else { to as usize - 10 };
        let arrives = (self.now + 1 + self.random.below(8)).max(self.last[node][connection]);
        self.last[node][connection] = arrives;
        self.in_flight.push((arrives, node, connection, frame));
    }

    fn poll(&mut self, node: usize) {
        while let Some(output) = self.ends[node].poll_output() {
            match output {
                LinkLayerOutput::Transmit { to, frame, .. } => {
                    self.send(node, to, frame.into_bytes());
                }
                LinkLayerOutput::Adopt { connection, .. } => {
                    let connection = connection as usize - 10;
                    self.adopted[node].push(connection);
                    self.open[self.place[node]] &= self.place[node] == connection;
                    self.place[node] = connection;
                }
                _ => {}
            }
        }
    }

    fn run(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now += 1;
            let now = at(self.now);
            let mut arrived: Vec<_> = self.in_flight.extract_if(.., |f| f.0 <= self.now).collect();
            arrived.retain(|(_, _, connection, _)| self.open[*connection]);
            for (_, from, connection, frame) in arrived {
                let own = self.place[1 - from] == connection;
                let from_address = if own { from as Address } else { named(connection) };
                self.ends[1 - from].handle_frame(from_address, frame, now);
                self.poll(1 - from);
            }
            for node in 0..2 {
                while self.ends[node].poll_timeout().is_some_and(|due| due <= now) {
                    self.ends[node].handle_timeout(now);
                }
                self.poll(node);
            }
        }
    }
}

#[test]
fn of_two_connections_that_nodes_make_at_the_same_time_both_adopt_the_same() {
    for seed in 0..500 {
        let mut streams = Streams::new(seed);

        streams.run(600);

        let states = [0, 1].map(|node| streams.ends[node].get(LINK).unwrap().state());
        let adopted = &streams.adopted;
        assert_eq!(states, [LinkState::Up; 2], "seed {seed}: {adopted:?}");
        assert_eq!(streams.place[0], streams.place[1], "seed {seed}: {adopted:?}");
        assert!(adopted.iter().all(|of| of.len() <= 1), "seed {seed}: {adopted:?}");
    }
}
