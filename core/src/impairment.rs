//! What a bad medium does to frames.
//!
//! ```text
//! handle_frame ──► cut? ──► lost? ──► twice? ──► held back ──► poll_output
//! ```

use crate::random::Random;
use crate::{Instant, Machine};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// How bad a medium is, in one direction.
///
/// ```
/// use blastema_core::impairment::{Fate, Impairment};
/// use blastema_core::random::Random;
///
/// let dead = Impairment { loss: 1.0, ..Impairment::NONE };
/// assert_eq!(dead.fate(&mut Random::new(1)), Fate::Lost);
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
}

/// What becomes of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
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
    /// A medium without a fault: what goes in comes out, at once and once.
    pub const NONE: Impairment =
        Impairment { loss: 0.0, duplication: 0.0, delay: Duration::ZERO, jitter: Duration::ZERO };

    /// Decides about one frame.
    pub fn fate(&self, random: &mut Random) -> Fate {
        if random.chance(self.loss) {
            return Fate::Lost;
        }
        let after = self.latency(random);
        let again = random.chance(self.duplication).then(|| self.latency(random));
        Fate::Arrives { after, again }
    }

    fn latency(&self, random: &mut Random) -> Duration {
        self.delay.saturating_add(self.jitter.mul_f64(random.unit()))
    }
}

/// One direction of a medium that can be made bad: what is put in comes out later, twice or never.
///
/// ```
/// use blastema_core::impairment::{Impairer, Impairment};
/// use blastema_core::{Instant, Machine};
/// use std::time::Duration;
///
/// let mut medium = Impairer::new(7, 100);
/// medium.impair(Impairment { delay: Duration::from_millis(5), ..Impairment::NONE });
/// medium.handle_frame("hello", Instant::ORIGIN);
/// assert_eq!(medium.poll_output(), None);
///
/// medium.handle_timeout(Instant::from_millis(5));
/// assert_eq!(medium.poll_output(), Some("hello"));
/// ```
#[derive(Debug)]
pub struct Impairer<T> {
    impairment: Impairment,
    cut: bool,
    random: Random,
    limit: usize,
    under_way: BTreeMap<(Instant, u64), T>,
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
    /// Frames thrown away by chance.
    pub lost: u64,
    /// Frames thrown away because the cable is cut, those under way included.
    pub cut: u64,
    /// Frames of which a copy was made.
    pub duplicated: u64,
    /// Frames and copies that were held back for a while.
    pub delayed: u64,
    /// Frames and copies thrown away because too many were held back already.
    pub overflowed: u64,
}

impl<T: Clone> Impairer<T> {
    /// A medium without a fault. At most `limit` frames are held back at one time.
    pub fn new(seed: u64, limit: usize) -> Self {
        Impairer {
            impairment: Impairment::NONE,
            cut: false,
            random: Random::new(seed),
            limit,
            under_way: BTreeMap::new(),
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
        self.injected.cut += (self.under_way.len() + self.arrived.len()) as u64;
        self.under_way.clear();
        self.arrived.clear();
    }

    /// Mends the cable and everything else.
    pub fn restore(&mut self) {
        self.cut = false;
        self.impairment = Impairment::NONE;
    }

    /// Whether the cable is cut.
    pub fn is_cut(&self) -> bool {
        self.cut
    }

    /// What was done so far.
    pub fn injected(&self) -> Injected {
        self.injected
    }

    /// One frame enters the medium.
    pub fn handle_frame(&mut self, frame: T, now: Instant) {
        if self.cut {
            self.injected.cut += 1;
            return;
        }
        match self.impairment.fate(&mut self.random) {
            Fate::Lost => self.injected.lost += 1,
            Fate::Arrives { after: Duration::ZERO, again: None } => {
                self.injected.passed += 1;
                self.hold(frame, Duration::ZERO, now);
            }
            Fate::Arrives { after, again } => {
                if let Some(again) = again {
                    self.injected.duplicated += 1;
                    self.hold(frame.clone(), again, now);
                }
                self.hold(frame, after, now);
            }
        }
    }

    fn hold(&mut self, frame: T, span: Duration, now: Instant) {
        if self.under_way.len() + self.arrived.len() >= self.limit {
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

impl<T> Machine for Impairer<T> {
    type Output = T;

    fn poll_output(&mut self) -> Option<T> {
        self.arrived.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.under_way.first_key_value().map(|(&(due, _), _)| due)
    }

    fn handle_timeout(&mut self, now: Instant) {
        while let Some(first) = self.under_way.first_entry()
            && first.key().0 <= now
        {
            self.arrived.push_back(first.remove());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_medium_without_a_fault_delivers_at_once_and_once() {
        let mut random = Random::new(1);

        let once = Fate::Arrives { after: Duration::ZERO, again: None };
        assert!((0..1000).all(|_| Impairment::NONE.fate(&mut random) == once));
    }

    #[test]
    fn the_same_seed_gives_the_same_fates() {
        let bad = Impairment {
            loss: 0.3,
            duplication: 0.2,
            delay: Duration::from_millis(5),
            jitter: Duration::from_millis(10),
        };
        let fates = |seed| {
            let mut random = Random::new(seed);
            (0..1000).map(|_| bad.fate(&mut random)).collect::<Vec<_>>()
        };

        assert_eq!(fates(7), fates(7));
        assert_ne!(fates(7), fates(8));
        let lost = fates(7).iter().filter(|fate| **fate == Fate::Lost).count();
        assert!((250..350).contains(&lost), "{lost}");
        let timely = |fate: &Fate| match fate {
            Fate::Lost => true,
            Fate::Arrives { after, .. } => {
                (5..15).contains(&u64::try_from(after.as_millis()).unwrap())
            }
        };
        assert!(fates(7).iter().all(timely));
    }

    fn arrivals(medium: &mut Impairer<u32>) -> Vec<u32> {
        std::iter::from_fn(|| medium.poll_output()).collect()
    }

    const MS: fn(u64) -> Duration = Duration::from_millis;

    #[test]
    fn frames_held_back_equally_long_keep_their_order() {
        let mut medium = Impairer::new(1, 100);
        medium.impair(Impairment { delay: MS(5), ..Impairment::NONE });

        (0..10).for_each(|n| medium.handle_frame(n, Instant::ORIGIN));
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
        let mut medium = Impairer::new(1, 100);
        medium.impair(Impairment { delay: MS(5), ..Impairment::NONE });
        medium.handle_frame(1, Instant::ORIGIN);

        medium.cut();
        medium.handle_frame(2, Instant::ORIGIN);
        medium.handle_timeout(Instant::from_millis(9));
        assert_eq!(arrivals(&mut medium), []);

        medium.restore();
        medium.handle_frame(3, Instant::from_millis(9));
        assert_eq!(arrivals(&mut medium), [3]);
        let Injected { cut, passed, .. } = medium.injected();
        assert_eq!((cut, passed), (2, 1));
    }

    #[test]
    fn what_is_held_back_is_bounded() {
        let mut medium = Impairer::new(1, 10);
        medium.impair(Impairment { delay: MS(5), duplication: 1.0, ..Impairment::NONE });

        (0..100).for_each(|n| medium.handle_frame(n, Instant::ORIGIN));
        medium.handle_timeout(Instant::from_millis(5));

        assert_eq!(arrivals(&mut medium), [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]);
        assert_eq!(medium.injected().overflowed, 190);
    }
}
