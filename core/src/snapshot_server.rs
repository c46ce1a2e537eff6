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

use crate::{Instant, Machine};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// A descriptor each, of which a process often has a thousand.
const SEATS: usize = 64;
/// A snapshot of ten thousand components has five megabytes, and lives as long as a client is given
/// it.
const PICTURES: usize = 8;
/// A picture costs the node some milliseconds; strangers must not have it do nothing else.
const APART: Duration = Duration::from_millis(100);
/// Those who come together are given one picture.
const TOGETHER: Duration = Duration::from_millis(10);
/// A client that reads a large snapshot has read it by then, also on a busy machine.
const ENOUGH: Duration = Duration::from_millis(200);
/// A person may have stopped the program that reads; a stranger must not stay for ever.
const PATIENCE: Duration = Duration::from_secs(5);

/// A client: the n-th that connected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ClientId(u64);

/// The n-th picture that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SnapshotId(u64);

/// The machine.
#[derive(Debug, Default)]
pub struct SnapshotServer {
    seats: BTreeMap<ClientId, Seat>,
    came: u64,
    taken: u64,
    /// When a picture was begun last.
    taken_at: Option<Instant>,
    /// Since when a client waits.
    waited_since: Option<Instant>,
    outputs: VecDeque<SnapshotServerOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Seat {
    Waiting,
    Posing { picture: SnapshotId },
    Looking { picture: SnapshotId, since: Instant },
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SnapshotServerOutput {
    /// Take a picture, and say [when it is there](SnapshotServer::handle_taken).
    Take(SnapshotId),
    /// Close his connection; he is gone.
    Close(ClientId),
}

impl SnapshotServer {
    /// Whether one more may come in.
    pub fn is_open(&self) -> bool {
        self.seats.len() < SEATS
    }

    /// One more has come in.
    pub fn handle_arrival(&mut self, now: Instant) -> ClientId {
        self.came += 1;
        let viewer = ClientId(self.came);
        self.seats.insert(viewer, Seat::Waiting);
        self.waited_since.get_or_insert(now);
        self.handle_timeout(now);
        viewer
    }

    /// A picture is there. Answers who is to be given it.
    pub fn handle_taken(&mut self, picture: SnapshotId, now: Instant) -> Vec<ClientId> {
        let posing = |(_, seat): &(&ClientId, &mut Seat)| **seat == Seat::Posing { picture };
        let looking = self.seats.iter_mut().filter(posing).map(|(viewer, seat)| {
            *seat = Seat::Looking { picture, since: now };
            *viewer
        });
        looking.collect()
    }

    /// He has seen it, or has gone away.
    pub fn handle_gone(&mut self, viewer: ClientId, now: Instant) {
        self.seats.remove(&viewer);
        self.handle_timeout(now);
    }

    fn pictures(&self) -> usize {
        let pictures = self.seats.values().filter_map(|seat| match seat {
            Seat::Waiting => None,
            Seat::Posing { picture } | Seat::Looking { picture, .. } => Some(*picture),
        });
        pictures.collect::<BTreeSet<_>>().len()
    }

    /// When the client that was given a snapshot longest ago is disconnected.
    fn oldest(&self) -> Option<(Instant, ClientId)> {
        let full = !self.is_open() || self.pictures() >= PICTURES && self.waited_since.is_some();
        let most = if full { ENOUGH } else { PATIENCE };
        let looking = self.seats.iter().filter_map(|(viewer, seat)| match seat {
            Seat::Looking { since, .. } => Some((*since + most, *viewer)),
            Seat::Waiting | Seat::Posing { .. } => None,
        });
        looking.min()
    }

    /// When the next picture is to be taken.
    fn next_picture(&self) -> Option<Instant> {
        let waited = self.waited_since.filter(|_| self.pictures() < PICTURES)? + TOGETHER;
        Some(self.taken_at.map_or(waited, |at| waited.max(at + APART)))
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
        while let Some((_, viewer)) = self.oldest().filter(|(due, _)| *due <= now) {
            self.seats.remove(&viewer);
            self.outputs.push_back(SnapshotServerOutput::Close(viewer));
        }
        if self.next_picture().is_some_and(|due| due <= now) {
            self.taken += 1;
            (self.taken_at, self.waited_since) = (Some(now), None);
            let picture = SnapshotId(self.taken);
            for seat in self.seats.values_mut().filter(|seat| **seat == Seat::Waiting) {
                *seat = Seat::Posing { picture };
            }
            self.outputs.push_back(SnapshotServerOutput::Take(picture));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How long a picture takes here.
    const TAKING: u64 = 50;

    /// A room with a door, at which any number waits.
    #[derive(Default)]
    struct Room {
        audience: SnapshotServer,
        now: u64,
        /// Who waits at the door, and whether he will read.
        door: VecDeque<bool>,
        readers: BTreeSet<ClientId>,
        taking: Vec<(u64, SnapshotId)>,
        served: u64,
        closed: u64,
        pictures: u64,
        most_seats: usize,
        most_pictures: usize,
    }

    impl Room {
        /// A millisecond.
        fn step(&mut self) {
            self.now += 1;
            let now = Instant::from_millis(self.now);
            while self.audience.is_open() {
                let Some(reads) = self.door.pop_front() else { break };
                let viewer = self.audience.handle_arrival(now);
                self.readers.extend(reads.then_some(viewer));
                self.carry_out();
            }
            let ready: Vec<_> = self.taking.extract_if(.., |(at, _)| *at <= self.now).collect();
            for (_, picture) in ready {
                for viewer in self.audience.handle_taken(picture, now) {
                    if self.readers.contains(&viewer) {
                        self.audience.handle_gone(viewer, now);
                        self.served += 1;
                    }
                }
            }
            if self.audience.poll_timeout().is_some_and(|due| due <= now) {
                self.audience.handle_timeout(now);
            }
            self.carry_out();
            self.most_seats = self.most_seats.max(self.audience.seats.len());
            self.most_pictures = self.most_pictures.max(self.audience.pictures());
        }

        fn carry_out(&mut self) {
            while let Some(output) = self.audience.poll_output() {
                match output {
                    SnapshotServerOutput::Take(picture) => {
                        self.taking.push((self.now + TAKING, picture));
                        self.pictures += 1;
                    }
                    SnapshotServerOutput::Close(_) => self.closed += 1,
                }
            }
        }

        /// One who reads comes; answers after how many milliseconds he is served.
        fn look(&mut self) -> u64 {
            let (began, before) = (self.now, self.served);
            self.door.push_back(true);
            while self.served == before {
                self.step();
                assert!(self.now - began < 60_000, "never");
            }
            self.now - began
        }
    }

    #[test]
    fn whoever_comes_alone_is_served_at_once() {
        let mut room = Room::default();
        assert_eq!(room.look(), 1 + 10 + TAKING);
        assert_eq!((room.audience.poll_timeout(), room.pictures), (None, 1));
    }

    #[test]
    fn a_crowd_that_does_not_read_delays_whoever_does_by_less_than_a_second() {
        let mut room = Room::default();
        room.door.extend([false; 200]);

        assert!(room.look() < 1_000, "{}", room.now);

        assert_eq!((room.most_seats, room.served), (SEATS, 1));
        assert!(room.pictures <= 6, "{}", room.pictures);
    }

    #[test]
    fn a_crowd_that_never_ends_delays_whoever_reads_by_no_more() {
        let mut room = Room::default();
        for wave in 0..20 {
            for _ in 0..50 {
                // As many as the system lets wait at a door.
                let missing = 128usize.saturating_sub(room.door.len());
                room.door.extend(vec![false; missing]);
                room.step();
            }
            let took = room.look();
            assert!(took <= 1_000, "wave {wave}: {took}");
        }
        assert!(room.pictures <= room.now / 100 + 1, "{} in {}", room.pictures, room.now);
        assert!(room.most_pictures <= PICTURES && room.most_seats <= SEATS);
    }

    #[test]
    fn one_after_the_other_who_do_not_read_hold_no_more_pictures_than_there_may_be() {
        let mut room = Room::default();
        for n in 0..3_000 {
            if n % 100 == 0 {
                room.door.push_back(false);
            }
            room.step();
        }
        assert_eq!(room.most_pictures, PICTURES);
        assert!(room.look() <= 10 + 100 + ENOUGH.as_millis() as u64 + TAKING);
    }

    #[test]
    fn whoever_is_in_no_hurry_has_seconds_while_there_is_room_and_not_for_ever() {
        let mut room = Room::default();
        room.door.push_back(false);
        while room.now < 10 + TAKING + 5_000 {
            room.step();
        }
        assert_eq!(room.closed, 0);
        room.step();
        assert_eq!((room.closed, room.audience.seats.len()), (1, 0));
    }
}
