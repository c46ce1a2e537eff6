//! Which clients of the inspection socket are served, and for how long.
//!
//! ```text
//! connects ─► waits ─► a snapshot is taken for all that wait ─► is given it ─► disconnects
//!                                                                  │
//!                          held for too long, or for long enough   └──────► is disconnected
//!                          while further clients wait
//! ```
//!
//! Each client is served at once, and a slow one has seconds. When all places are taken, the client
//! that was given its snapshot longest ago is disconnected, as soon as it has had the time that a
//! client needs which reads. So a client that reads is served at once, whatever the others do, and
//! none is refused: further clients wait in the listen backlog, in order.

use crate::sorted::{SortedMap, SortedSet};
use crate::{Instant, Machine};
use std::collections::VecDeque;
use std::time::Duration;

/// A descriptor each, of which a process often has a thousand.
const CLIENTS_MAX: usize = 64;
/// A snapshot of ten thousand components has five megabytes, and lives as long as a client is given
/// it.
const PICTURES: usize = 8;
/// A snapshot costs the node some milliseconds; strangers must not have it do nothing else.
const SNAPSHOT_INTERVAL: Duration = Duration::from_millis(100);
/// Those who come together are given one snapshot.
const GATHER_DELAY: Duration = Duration::from_millis(10);
/// A client that reads a large snapshot has read it by then, also on a busy machine.
const READ_TIME_MIN: Duration = Duration::from_millis(200);
/// A person may have stopped the program that reads; a stranger must not stay for ever.
const READ_TIMEOUT: Duration = Duration::from_secs(5);

/// A client: the n-th that connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(u64);

/// The n-th snapshot that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SnapshotId(u64);

/// The machine.
#[derive(Debug, Default)]
pub struct SnapshotServer {
    clients: SortedMap<ClientId, ClientState>,
    came: u64,
    taken: u64,
    /// When a snapshot was begun last.
    taken_at: Option<Instant>,
    /// Since when a client waits.
    waited_since: Option<Instant>,
    outputs: VecDeque<SnapshotServerOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ClientState {
    Waiting,
    Posing { snapshot: SnapshotId },
    Looking { snapshot: SnapshotId, since: Instant },
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SnapshotServerOutput {
    /// Take a snapshot, and say [when it is there](SnapshotServer::handle_taken).
    Take(SnapshotId),
    /// Close his connection; he is gone.
    Close(ClientId),
}

impl SnapshotServer {
    /// Whether one more may come in.
    pub fn is_open(&self) -> bool {
        self.clients.len() < CLIENTS_MAX
    }

    /// One more has come in.
    pub fn handle_arrival(&mut self, now: Instant) -> ClientId {
        self.came += 1;
        let client = ClientId(self.came);
        self.clients.insert(client, ClientState::Waiting);
        self.waited_since.get_or_insert(now);
        self.handle_timeout(now);
        client
    }

    /// A snapshot is there. Answers who is to be given it.
    pub fn handle_taken(&mut self, snapshot: SnapshotId, now: Instant) -> Vec<ClientId> {
        let posing = |(_, client_state): &(&ClientId, &mut ClientState)| {
            **client_state == ClientState::Posing { snapshot }
        };
        let looking = self.clients.iter_mut().filter(posing).map(|(client, client_state)| {
            *client_state = ClientState::Looking { snapshot, since: now };
            *client
        });
        looking.collect()
    }

    /// He has seen it, or has gone away.
    pub fn handle_gone(&mut self, client: ClientId, now: Instant) {
        self.clients.remove(&client);
        self.handle_timeout(now);
    }

    fn snapshots(&self) -> usize {
        let snapshots = self.clients.values().filter_map(|client_state| match client_state {
            ClientState::Waiting => None,
            ClientState::Posing { snapshot } | ClientState::Looking { snapshot, .. } => {
                Some(*snapshot)
            }
        });
        snapshots.collect::<SortedSet<_>>().len()
    }

    /// When the client that was given a snapshot longest ago is disconnected.
    fn oldest(&self) -> Option<(Instant, ClientId)> {
        let full = !self.is_open() || self.snapshots() >= PICTURES && self.waited_since.is_some();
        let most = if full { READ_TIME_MIN } else { READ_TIMEOUT };
        let looking = self.clients.iter().filter_map(|(client, client_state)| match client_state {
            ClientState::Looking { since, .. } => Some((*since + most, *client)),
            ClientState::Waiting | ClientState::Posing { .. } => None,
        });
        looking.min()
    }

    /// When the next snapshot is to be taken.
    fn next_picture(&self) -> Option<Instant> {
        let waited = self.waited_since.filter(|_| self.snapshots() < PICTURES)? + GATHER_DELAY;
        Some(self.taken_at.map_or(waited, |at| waited.max(at + SNAPSHOT_INTERVAL)))
    }
}

impl Machine for SnapshotServer {
    type Output = SnapshotServerOutput;

    fn poll_output(&mut self) -> Option<SnapshotServerOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let oldest = self.oldest().map(|(due, _)| due);
        oldest.into_iter().chain(self.next_picture()).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        while let Some((_, client)) = self.oldest().filter(|(due, _)| *due <= now) {
            self.clients.remove(&client);
            self.outputs.push_back(SnapshotServerOutput::Close(client));
        }
        if self.next_picture().is_some_and(|due| due <= now) {
            self.taken += 1;
            (self.taken_at, self.waited_since) = (Some(now), None);
            let snapshot = SnapshotId(self.taken);
            for client_state in self
                .clients
                .values_mut()
                .filter(|client_state| **client_state == ClientState::Waiting)
            {
                *client_state = ClientState::Posing { snapshot };
            }
            self.outputs.push_back(SnapshotServerOutput::Take(snapshot));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How long a snapshot takes here.
    const TAKING: u64 = 50;

    /// A server with a listen backlog without a limit.
    #[derive(Default)]
    struct Bench {
        server: SnapshotServer,
        now: u64,
        /// The clients in the listen backlog, and whether each will read.
        backlog: VecDeque<bool>,
        readers: SortedSet<ClientId>,
        taking: Vec<(u64, SnapshotId)>,
        served: u64,
        closed: u64,
        snapshots: u64,
        most_seats: usize,
        most_pictures: usize,
    }

    impl Bench {
        /// A millisecond.
        fn step(&mut self) {
            self.now += 1;
            let now = Instant::from_millis(self.now);
            while self.server.is_open() {
                let Some(reads) = self.backlog.pop_front() else { break };
                let client = self.server.handle_arrival(now);
                self.readers.extend(reads.then_some(client));
                self.carry_out();
            }
            let ready: Vec<_> = self.taking.extract_if(.., |(at, _)| *at <= self.now).collect();
            for (_, snapshot) in ready {
                for client in self.server.handle_taken(snapshot, now) {
                    if self.readers.contains(&client) {
                        self.server.handle_gone(client, now);
                        self.served += 1;
                    }
                }
            }
            if self.server.poll_timeout().is_some_and(|due| due <= now) {
                self.server.handle_timeout(now);
            }
            self.carry_out();
            self.most_seats = self.most_seats.max(self.server.clients.len());
            self.most_pictures = self.most_pictures.max(self.server.snapshots());
        }

        fn carry_out(&mut self) {
            while let Some(output) = self.server.poll_output() {
                match output {
                    SnapshotServerOutput::Take(snapshot) => {
                        self.taking.push((self.now + TAKING, snapshot));
                        self.snapshots += 1;
                    }
                    SnapshotServerOutput::Close(_) => self.closed += 1,
                }
            }
        }

        /// One who reads comes; answers after how many milliseconds he is served.
        fn look(&mut self) -> u64 {
            let (began, before) = (self.now, self.served);
            self.backlog.push_back(true);
            while self.served == before {
                self.step();
                assert!(self.now - began < 60_000, "never");
            }
            self.now - began
        }
    }

    #[test]
    fn whoever_comes_alone_is_served_at_once() {
        let mut bench = Bench::default();
        assert_eq!(bench.look(), 1 + 10 + TAKING);
        assert_eq!((bench.server.poll_timeout(), bench.snapshots), (None, 1));
    }

    #[test]
    fn a_crowd_that_does_not_read_delays_whoever_does_by_less_than_a_second() {
        let mut bench = Bench::default();
        bench.backlog.extend([false; 200]);

        assert!(bench.look() < 1_000, "{}", bench.now);

        assert_eq!((bench.most_seats, bench.served), (CLIENTS_MAX, 1));
        assert!(bench.snapshots <= 6, "{}", bench.snapshots);
    }

    #[test]
    fn a_crowd_that_never_ends_delays_whoever_reads_by_no_more() {
        let mut bench = Bench::default();
        for wave in 0..20 {
            for _ in 0..50 {
                // As many as the system keeps in a listen backlog.
                let missing = 128usize.saturating_sub(bench.backlog.len());
                bench.backlog.extend(vec![false; missing]);
                bench.step();
            }
            let took = bench.look();
            assert!(took <= 1_000, "wave {wave}: {took}");
        }
        assert!(bench.snapshots <= bench.now / 100 + 1, "{} in {}", bench.snapshots, bench.now);
        assert!(bench.most_pictures <= PICTURES && bench.most_seats <= CLIENTS_MAX);
    }

    #[test]
    fn one_after_the_other_who_do_not_read_hold_no_more_pictures_than_there_may_be() {
        let mut bench = Bench::default();
        for n in 0..3_000 {
            if n % 100 == 0 {
                bench.backlog.push_back(false);
            }
            bench.step();
        }
        assert_eq!(bench.most_pictures, PICTURES);
        assert!(bench.look() <= 10 + 100 + READ_TIME_MIN.as_millis() as u64 + TAKING);
    }

    #[test]
    fn whoever_is_in_no_hurry_has_seconds_while_there_is_room_and_not_for_ever() {
        let mut bench = Bench::default();
        bench.backlog.push_back(false);
        while bench.now < 10 + TAKING + 5_000 {
            bench.step();
        }
        assert_eq!(bench.closed, 0);
        bench.step();
        assert_eq!((bench.closed, bench.server.clients.len()), (1, 0));
    }
}
