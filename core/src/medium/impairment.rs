//! What a bad medium does to frames.
//!
//! ```text
//! handle_frame ─► cut? parted? ─► lost? ─► spoilt? ─► overtaken? ─► in its turn ─► twice? ─► held back
//!                                                                   (rate)          (delay, jitter) │
//!                                                                                    poll_output ◄──┘
//! ```

use crate::random::Random;
use crate::sorted::SortedMap;
use crate::{Instant, Machine};
use bytes::{Bytes, BytesMut};
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

/// How bad a medium is, in one direction.
///
/// ```
/// use blastema_core::medium::impairment::{FrameFate, Impairment};
/// use blastema_core::random::Random;
///
/// let dead = Impairment { loss: 1.0, ..Impairment::default() };
/// assert_eq!(dead.fate(&mut Random::new(1)), FrameFate::Lost);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Impairment {
    /// The share of frames that is lost, 0 to 1.
    pub loss: f64,
    /// The share of frames that arrives twice, 0 to 1.
    pub duplication: f64,
    /// How long every frame takes at least.
    pub delay: Duration,
    /// By how much more a frame may take, evenly spread. Any jitter reorders frames.
    pub jitter: Duration,
    /// The share of frames that the next one overtakes, 0 to 1; or that are late by 10 ms, if none
    /// comes in that time.
    pub reordering: f64,
    /// The share of frames in which one bit is changed, 0 to 1.
    pub corruption: f64,
    /// How many bytes the medium carries in a second; 0 is any number. Frames wait for each other,
    /// up to the limit of what is held back.
    pub rate: u64,
    /// The largest frame that arrives, in bytes; 0 is any size. A larger one is lost, as on a path
    /// through a VPN.
    pub largest: usize,
}

/// What becomes of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameFate {
    /// It never arrives.
    Lost,
    /// It arrives after this time, and perhaps a second time.
    Arrives {
        /// After how long.
        after: Duration,
        /// After how long its copy arrives, if there is one.
        again: Option<Duration>,
    },
}

impl Impairment {
    /// Decides whether one frame is lost, and how often and when it arrives.
    pub fn fate(&self, random: &mut Random) -> FrameFate {
        if random.chance(self.loss) {
            return FrameFate::Lost;
        }
        let after = self.latency(random);
        let again = random.chance(self.duplication).then(|| self.latency(random));
        FrameFate::Arrives { after, again }
    }

    /// How long a frame of this length keeps the medium from the next.
    fn occupation(&self, length: usize) -> Duration {
        match self.rate {
            0 => Duration::ZERO,
            rate => Duration::from_nanos(
                (length as u64).saturating_mul(1_000_000_000).checked_div(rate).unwrap_or(0),
            ),
        }
    }

    fn latency(&self, random: &mut Random) -> Duration {
        self.delay.saturating_add(self.jitter.mul_f64(random.unit()))
    }
}

/// What a medium moves, and can spoil.
pub trait Impairable: Clone {
    /// Who is at the other end.
    type Peer: Ord;

    /// To whom it goes, or from whom it comes.
    fn peer(&self) -> &Self::Peer;

    /// How many bytes it has.
    fn length(&self) -> usize;

    /// Its bytes, in one piece.
    fn bytes(&mut self) -> &mut Bytes;
}

/// Between two ends there is one peer only.
impl Impairable for Bytes {
    type Peer = ();

    fn peer(&self) -> &() {
        &()
    }

    fn length(&self) -> usize {
        self.len()
    }

    fn bytes(&mut self) -> &mut Bytes {
        self
    }
}

/// A frame that no other overtakes is late by so much.
const OVERTAKEN_AFTER: Duration = Duration::from_millis(10);

/// One direction of a medium that can be made bad: what is put in comes out later, twice or never.
///
/// ```
/// use blastema_core::medium::impairment::{ImpairedDirection, Impairment};
/// use blastema_core::{Instant, Machine};
/// use bytes::Bytes;
/// use std::time::Duration;
///
/// let mut medium = ImpairedDirection::<Bytes>::new(7, 100);
/// medium.impair(Impairment { delay: Duration::from_millis(5), ..Impairment::default() });
/// medium.handle_frame("hello".into(), Instant::ORIGIN);
/// assert_eq!(medium.poll_output(), None);
///
/// medium.handle_timeout(Instant::from_millis(5));
/// assert_eq!(medium.poll_output(), Some("hello".into()));
/// ```
#[derive(Debug)]
pub struct ImpairedDirection<T: Impairable> {
    impairment: Impairment,
    cut: bool,
    parted_from: BTreeSet<T::Peer>,
    random: Random,
    limit: usize,
    /// Waits for another to overtake it, until then.
    overtaken: Option<(Instant, T)>,
    /// When the medium has carried what it was given.
    free_at: Instant,
    under_way: SortedMap<(Instant, u64), T>,
    sequence: u64,
    arrived: VecDeque<T>,
    injected: Injected,
}

/// What was done to frames on purpose, in one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Injected {
    /// Frames that passed at once and once.
    pub passed: u64,
    /// Frames thrown away by chance, or because they are too large.
    pub lost: u64,
    /// Frames thrown away because the cable is cut, those under way included.
    pub cut: u64,
    /// Frames thrown away because their peer is on the other side of a partition, those under way
    /// included.
    pub parted: u64,
    /// Frames in which a bit was changed.
    pub corrupted: u64,
    /// Frames that another has overtaken, or that were late because none did.
    pub reordered: u64,
    /// Frames of which a copy was made.
    pub duplicated: u64,
    /// Frames and copies that were held back for a while.
    pub delayed: u64,
    /// Frames and copies thrown away because too many were held back already.
    pub overflowed: u64,
}

impl<T: Impairable> ImpairedDirection<T> {
    /// A medium without a fault. At most `limit` frames are held back at one time.
    pub fn new(seed: u64, limit: usize) -> Self {
        ImpairedDirection {
            impairment: Impairment::default(),
            cut: false,
            parted_from: BTreeSet::new(),
            random: Random::new(seed),
            limit,
            overtaken: None,
            free_at: Instant::ORIGIN,
            under_way: SortedMap::new(),
            sequence: 0,
            arrived: VecDeque::new(),
            injected: Injected::default(),
        }
    }

    /// From now on the medium is this bad. Frames under way are not touched.
    pub fn impair(&mut self, impairment: Impairment) {
        self.impairment = impairment;
    }

    /// Cuts the cable: what is under way is lost too.
    pub fn cut(&mut self) {
        self.cut = true;
        self.injected.cut += self.held() as u64;
        self.overtaken = None;
        self.under_way.clear();
        self.arrived.clear();
    }

    /// From now on these peers, and no others, are on the other side of a partition: what is under
    /// way to them is lost too.
    pub fn part_from(&mut self, peers: impl IntoIterator<Item = T::Peer>) {
        self.parted_from = peers.into_iter().collect();
        let (parted, before) = (&self.parted_from, self.held());
        self.overtaken.take_if(|(_, frame)| parted.contains(frame.peer()));
        self.under_way.retain(|_, frame| !parted.contains(frame.peer()));
        self.arrived.retain(|frame| !parted.contains(frame.peer()));
        self.injected.parted += (before - self.held()) as u64;
    }

    /// Restores the cable and everything else.
    pub fn restore(&mut self) {
        self.cut = false;
        self.parted_from.clear();
        self.impairment = Impairment::default();
        self.free_at = Instant::ORIGIN;
    }

    /// What was done so far.
    pub fn injected(&self) -> Injected {
        self.injected
    }

    fn held(&self) -> usize {
        self.under_way.len() + self.arrived.len() + usize::from(self.overtaken.is_some())
    }

    /// One frame enters the medium.
    pub fn handle_frame(&mut self, mut frame: T, now: Instant) {
        if self.cut {
            self.injected.cut += 1;
            return;
        }
        if self.parted_from.contains(frame.peer()) {
            self.injected.parted += 1;
            return;
        }
        let fate = self.impairment.fate(&mut self.random);
        let Impairment { largest, .. } = self.impairment;
        if fate == FrameFate::Lost || largest > 0 && frame.length() > largest {
            self.injected.lost += 1;
            return;
        }
        // Chance is drawn for what is asked for only, so that a seed keeps its meaning.
        let Impairment { corruption, reordering, .. } = self.impairment;
        if corruption > 0.0 && self.random.chance(corruption) {
            self.corrupt(frame.bytes());
        }
        if reordering > 0.0 && self.overtaken.is_none() && self.random.chance(reordering) {
            self.injected.reordered += 1;
            self.overtaken = Some((now + OVERTAKEN_AFTER, frame));
            return;
        }
        self.enter(frame, fate, now);
        if let Some((_, overtaken)) = self.overtaken.take() {
            self.enter(overtaken, fate, now);
        }
    }

    fn corrupt(&mut self, bytes: &mut Bytes) {
        let mut spoilt = BytesMut::from(&bytes[..]);
        let chance = self.random.next();
        let place = chance as usize % spoilt.len().max(1);
        if let Some(byte) = spoilt.get_mut(place) {
            *byte ^= 1 << ((chance >> 61) as u8);
            self.injected.corrupted += 1;
            *bytes = spoilt.freeze();
        }
    }

    /// It goes onto the medium in its turn.
    fn enter(&mut self, frame: T, fate: FrameFate, now: Instant) {
        let FrameFate::Arrives { after, again } = fate else { return };
        let turn = self.free_at.max(now);
        let occupation = self.impairment.occupation(frame.length());
        let carried = turn + occupation;
        if occupation > Duration::ZERO && self.held() < self.limit {
            self.free_at = carried;
        }
        let waiting = carried - now;
        if after == Duration::ZERO && again.is_none() && waiting == Duration::ZERO {
            self.injected.passed += 1;
        }
        if let Some(again) = again {
            self.injected.duplicated += 1;
            self.hold(frame.clone(), waiting + again, now);
        }
        self.hold(frame, waiting + after, now);
    }

    fn hold(&mut self, frame: T, span: Duration, now: Instant) {
        if self.held() >= self.limit {
            self.injected.overflowed += 1;
        } else if span == Duration::ZERO {
            self.arrived.push_back(frame);
        } else {
            self.injected.delayed += 1;
            self.sequence += 1;
            self.under_way.insert((now + span, self.sequence), frame);
        }
    }
}

impl<T: Impairable> Machine for ImpairedDirection<T> {
    type Output = T;

    fn poll_output(&mut self) -> Option<T> {
        self.arrived.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let under_way = self.under_way.first_key_value().map(|(&(due, _), _)| due);
        let overtaken = self.overtaken.as_ref().map(|(due, _)| *due);
        under_way.into_iter().chain(overtaken).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        if let Some((due, frame)) = self.overtaken.take_if(|(due, _)| *due <= now) {
            let fate = FrameFate::Arrives { after: self.impairment.delay, again: None };
            self.enter(frame, fate, due);
        }
        while let Some((_, frame)) = self.under_way.pop_first_if(|(due, _)| *due <= now) {
            self.arrived.push_back(frame);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_medium_without_a_fault_delivers_at_once_and_once() {
        let mut random = Random::new(1);

        let once = FrameFate::Arrives { after: Duration::ZERO, again: None };
        assert!((0..1000).all(|_| Impairment::default().fate(&mut random) == once));
    }

    #[test]
    fn the_same_seed_gives_the_same_fates() {
        let bad = Impairment {
            loss: 0.3,
            duplication: 0.2,
            delay: Duration::from_millis(5),
            jitter: Duration::from_millis(10),
            ..Impairment::default()
        };
        let fates = |seed| {
            let mut random = Random::new(seed);
            (0..1000).map(|_| bad.fate(&mut random)).collect::<Vec<_>>()
        };

        assert_eq!(fates(7), fates(7));
        assert_ne!(fates(7), fates(8));
        let lost = fates(7).iter().filter(|fate| **fate == FrameFate::Lost).count();
        assert!((250..350).contains(&lost), "{lost}");
        let timely = |fate: &FrameFate| match fate {
            FrameFate::Lost => true,
            FrameFate::Arrives { after, .. } => {
                (5..15).contains(&u64::try_from(after.as_millis()).unwrap())
            }
        };
        assert!(fates(7).iter().all(timely));
    }

    /// A number on its way to a peer, as bytes.
    #[derive(Clone, Debug)]
    struct Frame(Bytes, u8);

    impl Impairable for Frame {
        type Peer = u8;

        fn peer(&self) -> &u8 {
            &self.1
        }

        fn length(&self) -> usize {
            self.0.len()
        }

        fn bytes(&mut self) -> &mut Bytes {
            &mut self.0
        }
    }

    impl From<u32> for Frame {
        fn from(number: u32) -> Self {
            Frame(Bytes::copy_from_slice(&number.to_be_bytes()), 0)
        }
    }

    fn arrivals(medium: &mut ImpairedDirection<Frame>) -> Vec<u32> {
        let number = |frame: Frame| u32::from_be_bytes(*frame.0.first_chunk().expect("four bytes"));
        std::iter::from_fn(|| medium.poll_output().map(number)).collect()
    }

    const MS: fn(u64) -> Duration = Duration::from_millis;

    #[test]
    fn frames_held_back_equally_long_keep_their_order() {
        let mut medium = ImpairedDirection::new(1, 100);
        medium.impair(Impairment { delay: MS(5), ..Impairment::default() });

        (0..10).for_each(|n| medium.handle_frame(n.into(), Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(4));
        assert_eq!(arrivals(&mut medium), []);
        assert_eq!(medium.poll_timeout(), Some(Instant::from_millis(5)));

        medium.handle_timeout(Instant::from_millis(5));
        assert_eq!(arrivals(&mut medium), (0..10).collect::<Vec<_>>());
        assert_eq!(medium.poll_timeout(), None);
        assert_eq!(medium.injected(), Injected { delayed: 10, ..Injected::default() });
    }

    #[test]
    fn a_cut_loses_what_is_under_way_and_what_comes_until_it_is_mended() {
        let mut medium = ImpairedDirection::new(1, 100);
        medium.impair(Impairment { delay: MS(5), ..Impairment::default() });
        medium.handle_frame(1.into(), Instant::ORIGIN);

        medium.cut();
        medium.handle_frame(2.into(), Instant::ORIGIN);
        medium.handle_timeout(Instant::from_millis(9));
        assert_eq!(arrivals(&mut medium), []);

        medium.restore();
        medium.handle_frame(3.into(), Instant::from_millis(9));
        assert_eq!(arrivals(&mut medium), [3]);
        let Injected { cut, passed, .. } = medium.injected();
        assert_eq!((cut, passed), (2, 1));
    }

    #[test]
    fn what_is_held_back_is_bounded() {
        let mut medium = ImpairedDirection::new(1, 10);
        medium.impair(Impairment { delay: MS(5), duplication: 1.0, ..Impairment::default() });

        (0..100).for_each(|n| medium.handle_frame(n.into(), Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(5));

        assert_eq!(arrivals(&mut medium), [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]);
        assert_eq!(medium.injected().overflowed, 190);
    }

    #[test]
    fn a_frame_that_is_larger_than_the_largest_is_lost() {
        let mut medium = ImpairedDirection::<Bytes>::new(1, 10);
        medium.impair(Impairment { largest: 1_300, ..Impairment::default() });

        for length in [1_301, 1_300, 0] {
            medium.handle_frame(vec![0; length].into(), Instant::ORIGIN);
        }

        let arrived = std::iter::from_fn(|| medium.poll_output()).map(|frame| frame.len());
        assert_eq!(arrived.collect::<Vec<_>>(), [1_300, 0]);
        assert_eq!(medium.injected().lost, 1);
    }

    #[test]
    fn a_frame_that_is_overtaken_comes_after_the_next_and_if_none_comes_late() {
        let mut medium = ImpairedDirection::<Frame>::new(1, 100);
        medium.impair(Impairment { reordering: 1.0, ..Impairment::default() });

        (0..5).for_each(|n| medium.handle_frame(n.into(), Instant::ORIGIN));
        assert_eq!(arrivals(&mut medium), [1, 0, 3, 2]);
        assert_eq!(medium.poll_timeout(), Some(Instant::from_millis(10)));

        medium.handle_timeout(Instant::from_millis(10));
        assert_eq!(arrivals(&mut medium), [4]);
        assert_eq!((medium.poll_timeout(), medium.injected().reordered), (None, 3));
    }

    #[test]
    fn a_share_of_frames_is_overtaken_and_none_is_lost_or_doubled() {
        let mut medium = ImpairedDirection::<Frame>::new(1, 2000);
        medium.impair(Impairment { reordering: 0.2, delay: MS(5), ..Impairment::default() });

        (0..1000).for_each(|n| medium.handle_frame(n.into(), Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(20));
        medium.handle_timeout(Instant::from_millis(20));

        let mut arrived = arrivals(&mut medium);
        let reordered = arrived.windows(2).filter(|pair| pair[0] > pair[1]).count();
        assert!((120..250).contains(&reordered), "{reordered}");
        arrived.sort_unstable();
        assert_eq!(arrived, (0..1000).collect::<Vec<_>>());
    }

    #[test]
    fn a_spoilt_frame_differs_in_one_bit() {
        let mut medium = ImpairedDirection::<Frame>::new(1, 1000);
        medium.impair(Impairment { corruption: 0.5, ..Impairment::default() });

        (0..1000).for_each(|_| medium.handle_frame(0.into(), Instant::ORIGIN));
        medium.handle_frame(Frame(Bytes::new(), 0), Instant::ORIGIN);

        let ones: Vec<u32> = std::iter::from_fn(|| medium.poll_output())
            .map(|frame| frame.0.iter().map(|byte| byte.count_ones()).sum())
            .collect();
        assert!(ones.iter().all(|&ones| ones <= 1));
        let spoilt = ones.iter().filter(|&&ones| ones == 1).count();
        assert!((400..600).contains(&spoilt), "{spoilt}");
        assert_eq!(medium.injected().corrupted, spoilt as u64);
    }

    #[test]
    fn a_rate_lets_frames_wait_for_each_other_and_no_more_of_them_than_the_limit() {
        let mut medium = ImpairedDirection::<Frame>::new(1, 10);
        // A frame of four bytes each millisecond.
        medium.impair(Impairment { rate: 4_000, delay: MS(100), ..Impairment::default() });

        (0..20).for_each(|n| medium.handle_frame(n.into(), Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(100));
        assert_eq!(arrivals(&mut medium), []);
        for n in 0..10 {
            medium.handle_timeout(Instant::from_millis(101 + u64::from(n)));
            assert_eq!(arrivals(&mut medium), [n]);
        }
        assert_eq!((medium.poll_timeout(), medium.injected().overflowed), (None, 10));

        // An idle medium saves nothing up, and what was lost has taken no time.
        medium.handle_frame(77.into(), Instant::from_millis(1000));
        assert_eq!(medium.poll_timeout(), Some(Instant::from_millis(1101)));
    }

    #[test]
    fn a_partition_loses_what_goes_to_some_and_leaves_the_others() {
        let mut medium = ImpairedDirection::<Frame>::new(1, 100);
        medium.impair(Impairment { delay: MS(5), ..Impairment::default() });
        let frame = |n: u8| Frame(Bytes::copy_from_slice(&u32::from(n).to_be_bytes()), n);

        (0..4).for_each(|n| medium.handle_frame(frame(n), Instant::ORIGIN));
        medium.part_from([1, 2]);
        (0..4).for_each(|n| medium.handle_frame(frame(n), Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(5));
        assert_eq!(arrivals(&mut medium), [0, 3, 0, 3]);
        assert_eq!(medium.injected().parted, 4);

        medium.part_from([3]);
        (0..4).for_each(|n| medium.handle_frame(frame(n), Instant::ORIGIN));
        medium.restore();
        medium.handle_frame(frame(3), Instant::from_millis(5));
        medium.handle_timeout(Instant::from_millis(10));
        assert_eq!(arrivals(&mut medium), [3, 0, 1, 2]);
    }
}
