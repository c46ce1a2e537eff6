//! How much may be on its way along one path: slow start (RFC 5681), then by the delay in queues
//! (LEDBAT, RFC 6817), less after a loss (RFC 9002), and in no larger bursts than the queues bear.
//!
//! A robot's commands wait in the same queues as its images. A sender that goes on until a queue
//! overflows keeps it full: a second of delay where the queue holds a second. This one keeps it at
//! [`TARGET`], whatever it holds.

use crate::Instant;
use crate::net::wire::segment::DelayTicks;
use std::collections::VecDeque;
use std::time::Duration;

/// The queueing delay that is aimed at. RFC 6817 allows 100 ms at most; a command waits in the
/// queues of both directions, each up to twice as long, and has a lease of 200 ms.
pub(super) const TARGET: Duration = Duration::from_millis(25);
/// The same on a narrow path, where one part takes as long as that.
const TARGET_NARROW: Duration = Duration::from_millis(100);
/// The payload of an Ethernet frame, by which windows are counted on paths with larger ones.
const PART: usize = 1400;
/// What a part costs beside its bytes, so that many small ones do not pass for nothing.
const OVERHEAD: usize = 40;
/// Parts that may be on their way at first (RFC 6928).
const INITIAL: usize = 10;
/// The same on a narrow path.
const INITIAL_NARROW: usize = 4;
/// The most there: as many as may wait for a serial line.
const MOST_NARROW: usize = 8;
/// Parts that may always be on their way: fewer would wait for a timer at every loss. Of a narrow
/// path they would be seconds.
const LEAST: usize = 8;
/// Parts on their way however long the queues are.
const LEAST_CROWDED: usize = 2;
/// A part is so much of the window at most: what is urgent waits behind one of them.
const PARTS_OF_A_WINDOW: usize = 8;
/// The queueing delay is the least of so many samples (RFC 6817, CURRENT_FILTER): a thread that was
/// late once is no queue.
const SAMPLES: usize = 4;
/// The delays of a lane that was not used for so long say nothing of the present.
const LANE_MAX_AGE: Duration = Duration::from_millis(500);
/// A base delay that was not met for so long may be another one now: it is measured again with
/// empty queues (BBR, ProbeRTT).
const BASE_MAX_AGE: Duration = Duration::from_secs(10);
/// A delay so much above the base delay confirms it: the clocks drift by less in [`BASE_MAX_AGE`].
const BASE_TOLERANCE: Duration = Duration::from_millis(2);
/// What may be sent at once is worth so much time on the path: more would be a queue, less would
/// wait for the timers of a busy computer.
const BURST: Duration = Duration::from_millis(8);

/// The most bytes that may be on their way: they should fit into the buffers of the sockets there.
pub(super) const MOST: usize = 1024 * 1024;

/// The control of what travels along one path.
#[derive(Debug)]
pub(super) struct CongestionControl {
    is_narrow: bool,
    /// The bytes of a part by which the window is counted.
    part: usize,
    window: usize,
    is_slow_start: bool,
    /// The shortest delay on this path, and when one was about as short. Delays are one way, from a
    /// clock to another: what stands in queues on the way back does not count.
    base: Option<(DelayTicks, Instant)>,
    /// The latest delays of each lane, and when the last of them was told.
    recent: [(VecDeque<DelayTicks>, Instant); 2],
    /// The base delay is measured again until then.
    probing_until: Option<Instant>,
    /// When the window was reduced last: what was sent before that is no further sign.
    reduced_at: Instant,
    /// When the path will have carried what was sent, and how much of that may stand in queues.
    carried_at: Instant,
    burst: Duration,
}

/// A delay on the path, as an acknowledgement told it.
#[derive(Clone, Copy, Debug)]
pub(super) struct DelaySample {
    /// From the sender's clock to the receiver's, whose offset is not known.
    pub(super) delay: DelayTicks,
    pub(super) round_trip: Duration,
    pub(super) lane: DelayLane,
}

/// Which frames a part stands in queues with: those of one lane overtake those of the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DelayLane {
    Urgent,
    Usual,
}

/// What an acknowledgement told.
#[derive(Clone, Copy, Debug)]
pub(super) struct CongestionSignal {
    /// So many parts and bytes have arrived.
    pub(super) arrived: (usize, usize),
    /// The window was full before.
    pub(super) was_full: bool,
    /// Some were lost.
    pub(super) has_lost: bool,
    /// It is certain which transmission has arrived, and its round trip was told.
    pub(super) is_measured: bool,
    /// When the latest that has arrived was sent.
    pub(super) sent: Instant,
}

impl CongestionControl {
    /// For a path of which nothing is known.
    pub(super) fn new() -> Self {
        CongestionControl {
            is_narrow: false,
            part: PART,
            window: INITIAL * PART,
            is_slow_start: true,
            base: None,
            recent: [(); 2].map(|()| (VecDeque::with_capacity(SAMPLES), Instant::ORIGIN)),
            probing_until: None,
            reduced_at: Instant::ORIGIN,
            carried_at: Instant::ORIGIN,
            burst: BURST,
        }
    }

    /// What is sent takes this path from now on.
    pub(super) fn enter_path(&mut self, mtu: usize, is_narrow: bool) {
        (self.is_narrow, self.part) = (is_narrow, mtu.min(PART));
        self.forget_delays();
        (self.carried_at, self.burst) = (Instant::ORIGIN, BURST);
        // What the path before carried says nothing of this one, which may be a radio in the place
        // of a cable (RFC 9000, 9.4).
        (self.window, self.is_slow_start) = (self.initial(), true);
    }

    /// Delays are differences of two clocks, and one of them may be another now.
    fn forget_delays(&mut self) {
        (self.base, self.probing_until) = (None, None);
        self.recent.iter_mut().for_each(|(recent, _)| recent.clear());
    }

    /// A session begins from nothing, perhaps with another incarnation of the peer.
    pub(super) fn restart(&mut self, now: Instant) {
        self.forget_delays();
        (self.window, self.is_slow_start, self.reduced_at) = (self.initial(), true, now);
    }

    fn initial(&self) -> usize {
        self.part * if self.is_narrow { INITIAL_NARROW } else { INITIAL }
    }

    /// Parts that may always be on their way.
    pub(super) fn least_parts(&self) -> usize {
        if self.is_narrow { INITIAL_NARROW } else { LEAST }
    }

    /// The bytes that may be on their way.
    pub(super) fn window(&self) -> usize {
        match self.probing_until {
            Some(_) => self.window.min(LEAST_CROWDED * self.part),
            None => self.window,
        }
    }

    /// The largest part that should be cut.
    pub(super) fn part_max(&self) -> usize {
        (self.window / PARTS_OF_A_WINDOW).max(self.part)
    }

    /// What so many parts of so many bytes take of the window.
    pub(super) fn load(parts: usize, bytes: usize) -> usize {
        bytes + parts * OVERHEAD
    }

    /// Whether so much leaves no room for another part.
    pub(super) fn is_full(&self, load: usize) -> bool {
        load >= self.window()
    }

    /// How long what is sent waits in queues, as far as is known: in those of the slower lane.
    pub(super) fn queueing(&self) -> Option<Duration> {
        let (base, _) = self.base?;
        let least = |(recent, _): &(VecDeque<DelayTicks>, Instant)| {
            recent.iter().map(|delay| delay.since(base)).min()
        };
        self.recent.iter().filter_map(least).max()
    }

    /// It was told when a part arrived that was sent once.
    pub(super) fn handle_delay(&mut self, sample: DelaySample, now: Instant) {
        let DelaySample { delay, round_trip, lane } = sample;
        for (recent, told) in &mut self.recent {
            if now - *told > LANE_MAX_AGE {
                recent.clear();
            }
        }
        let (recent, told) = &mut self.recent[lane as usize];
        if recent.len() == SAMPLES {
            recent.pop_front();
        }
        recent.push_back(delay);
        *told = now;
        if let Some(until) = self.probing_until {
            // This one was sent after the queue had emptied.
            if now >= until {
                (self.base, self.probing_until) = (Some((delay, now)), None);
            }
            return;
        }
        let Some((base, met)) = self.base else {
            self.base = Some((delay, now));
            return;
        };
        if delay.since(base) <= BASE_TOLERANCE {
            let is_shorter = delay.since(base).is_zero();
            self.base = Some((if is_shorter { delay } else { base }, now));
        } else if now >= met + BASE_MAX_AGE {
            // One round trip to empty the queue, and one to measure.
            self.probing_until = Some(now + 2 * round_trip);
        }
    }

    /// Some of what was sent has arrived.
    pub(super) fn handle_arrived(&mut self, signal: CongestionSignal, now: Instant) {
        let CongestionSignal { arrived: (parts, bytes), was_full, has_lost, is_measured, sent } =
            signal;
        let queueing = self.queueing();
        let target = if self.is_narrow { TARGET_NARROW } else { TARGET };
        // By a base delay that is measured again, queues may seem to be where none are.
        let is_known = is_measured && self.probing_until.is_none();
        let is_crowded = is_known && queueing.is_some_and(|queueing| queueing > 2 * target);
        // Once per round trip, as in RFC 9002: one burst of losses is one sign.
        if (has_lost || is_crowded) && sent > self.reduced_at {
            self.reduced_at = now;
            self.is_slow_start = false;
            let least = if is_crowded { LEAST_CROWDED } else { self.least_parts() } * self.part;
            self.window = (self.window / 2).max(least.min(self.window));
            return;
        }
        // A window that is not used tells nothing of a larger one (RFC 7661). Nor, on a narrow
        // path, does an acknowledgement that may be of either of two transmissions.
        if self.probing_until.is_some() || (self.is_narrow && !is_measured) {
            return;
        }
        let queueing = queueing.unwrap_or_default();
        let load = Self::load(parts, bytes);
        if self.is_slow_start && queueing > target / 2 {
            // The window has doubled since what has just arrived was sent.
            self.is_slow_start = false;
            self.reduced_at = now;
            self.window /= 2;
        } else if self.is_slow_start {
            self.window += if was_full { load } else { 0 };
        } else {
            // Up to a part more each round trip while queues are empty, and as much less where they
            // are twice as long as they should be.
            let step = (load * self.part / self.window.max(1)).min(self.part) as i64;
            let off = target.as_micros() as i64 - queueing.as_micros() as i64;
            let change = step * off / target.as_micros() as i64;
            if change < 0 || was_full {
                self.window = self.window.saturating_add_signed(change as isize);
            }
        }
        let least = LEAST_CROWDED * self.part;
        let most = if self.is_narrow { MOST_NARROW * self.part } else { MOST };
        self.window = self.window.clamp(least.min(most), most);
    }

    /// Nothing has come back for so long that all is taken for lost.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        let least = if self.is_narrow { LEAST_CROWDED } else { LEAST };
        self.window = self.window.min(least * self.part);
        (self.reduced_at, self.probing_until) = (now, None);
    }

    /// When the next part may be sent, if no more than a burst is to stand in queues.
    pub(super) fn send_at(&self) -> Instant {
        let burst = self.burst.as_nanos() as u64;
        Instant::from_nanos(self.carried_at.as_nanos().saturating_sub(burst))
    }

    /// So much is sent, where an answer takes so long.
    pub(super) fn handle_sent(&mut self, load: usize, round_trip: Option<Duration>, now: Instant) {
        let Some(round_trip) = round_trip else { return };
        let window = self.window.max(1) as u64;
        // A quarter faster than the window empties (RFC 9002, 7.7), and twice as fast while it
        // doubles.
        let gain = if self.is_slow_start { 200 } else { 125 };
        let nanos = round_trip.as_nanos() as u64 * 100 / gain;
        let takes = |bytes: usize| {
            Duration::from_nanos((nanos as u128 * bytes as u128 / window as u128) as u64)
        };
        self.burst = takes(self.initial()).max(BURST);
        self.carried_at = self.carried_at.max(now) + takes(load);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    /// A path that carries so many bytes in a millisecond, with an unbounded queue before it, and a
    /// sender that always has more to send.
    struct Path {
        control: CongestionControl,
        rate: usize,
        base: Duration,
        now: Instant,
        /// When each part was sent, when it left the queue, and when its answer is there.
        flying: VecDeque<(Instant, Instant, Instant)>,
        free_at: Instant,
        round_trip: Option<Duration>,
        lane: DelayLane,
    }

    impl Path {
        fn new(rate: usize, base: Duration) -> Self {
            let mut control = CongestionControl::new();
            control.enter_path(PART, false);
            let now = Instant::ORIGIN + Duration::from_secs(1);
            Path {
                control,
                rate,
                base,
                now,
                flying: VecDeque::new(),
                free_at: now,
                round_trip: None,
                lane: DelayLane::Usual,
            }
        }

        /// Runs for a while. Answers with the longest and the mean delay in the queue, and how much
        /// arrived.
        fn run(&mut self, span: Duration) -> (Duration, Duration, usize) {
            let end = self.now + span;
            let (mut longest, mut sum, mut arrived) = (Duration::ZERO, Duration::ZERO, 0);
            while self.now < end {
                while let Some((sent, left, due)) = self.flying.front().copied()
                    && due <= self.now
                {
                    let load = CongestionControl::load(self.flying.len(), self.flying.len() * PART);
                    let was_full = self.control.is_full(load + PART);
                    self.flying.pop_front();
                    let trip = due - sent;
                    longest = longest.max(left - sent);
                    sum += left - sent;
                    arrived += 1;
                    // The receiver's clock is ahead by minutes.
                    let arrived = DelayTicks::of(left + self.base / 2 + Duration::from_secs(1000));
                    let delay = arrived - DelayTicks::of(sent);
                    let sample = DelaySample { delay, round_trip: trip, lane: self.lane };
                    self.control.handle_delay(sample, self.now);
                    self.round_trip = Some(trip);
                    let signal = CongestionSignal {
                        arrived: (1, PART),
                        was_full,
                        has_lost: false,
                        is_measured: true,
                        sent,
                    };
                    self.control.handle_arrived(signal, self.now);
                }
                while !self
                    .control
                    .is_full(CongestionControl::load(self.flying.len(), self.flying.len() * PART))
                    && self.control.send_at() <= self.now
                {
                    let takes = Duration::from_nanos((PART * 1_000_000 / self.rate) as u64);
                    self.free_at = self.free_at.max(self.now) + takes;
                    self.flying.push_back((self.now, self.free_at, self.free_at + self.base));
                    self.control.handle_sent(PART + OVERHEAD, self.round_trip, self.now);
                }
                self.now = self.now + Duration::from_micros(500);
            }
            (longest, sum / arrived.max(1), arrived as usize * PART)
        }
    }

    #[test]
    fn a_queue_is_kept_at_the_target_and_the_path_is_used() {
        for (rate, base) in [(125, 2 * MS), (1_000, 2 * MS), (1_000, 30 * MS), (12_500, 5 * MS)] {
            let mut path = Path::new(rate, base);
            let (longest, ..) = path.run(Duration::from_secs(2));
            assert!(longest < 8 * TARGET, "at first {longest:?} at {rate} bytes/ms");
            let (longest, mean, arrived) = path.run(Duration::from_secs(30));
            assert!(longest < 3 * TARGET, "{longest:?} at {rate} bytes/ms");
            assert!(mean < 2 * TARGET, "{mean:?} at {rate} bytes/ms");
            let most = rate * 30_000;
            assert!(arrived * 10 > most * 8, "{arrived} of {most} at {base:?}");
        }
    }

    #[test]
    fn what_is_control_alone_fills_no_queue_either() {
        let mut path = Path { lane: DelayLane::Urgent, ..Path::new(1_000, 2 * MS) };
        path.run(Duration::from_secs(5));
        let (longest, _, arrived) = path.run(Duration::from_secs(5));
        assert!(longest < 3 * TARGET && arrived > 4_000_000, "{longest:?}, {arrived}");
    }

    #[test]
    fn control_that_has_passed_a_queue_hides_it_not_and_an_old_delay_counts_no_more() {
        let mut control = CongestionControl::new();
        let now = Instant::ORIGIN + Duration::from_secs(1);
        let mut told = |lane, delay: Duration, after: Duration| {
            let delay = DelayTicks::of(Instant::ORIGIN + delay);
            control.handle_delay(DelaySample { delay, round_trip: MS, lane }, now + after);
            control.queueing()
        };
        told(DelayLane::Urgent, 5 * MS, Duration::ZERO);
        told(DelayLane::Usual, 45 * MS, MS);
        assert_eq!(told(DelayLane::Urgent, 5 * MS, 2 * MS), Some(40 * MS));
        assert_eq!(told(DelayLane::Urgent, 6 * MS, 600 * MS), Some(MS));
    }

    #[test]
    fn a_slow_path_in_the_place_of_a_fast_one_gets_no_burst() {
        let mut path = Path::new(125_000, MS);
        path.run(Duration::from_secs(5));
        assert!(path.control.window() > 400_000, "{:?}", path.control);
        path.run(Duration::from_secs(1));
        path.rate = 1_000;
        path.flying.clear();
        path.free_at = path.now;
        path.control.enter_path(PART, false);
        let (longest, ..) = path.run(Duration::from_secs(5));
        assert!(longest < 6 * TARGET, "{longest:?}");
    }

    #[test]
    fn a_path_that_has_become_longer_is_used_all_the_same() {
        let mut path = Path::new(1_000, 2 * MS);
        path.run(Duration::from_secs(5));
        path.base = 150 * MS;
        path.run(Duration::from_secs(40));
        let (_, _, arrived) = path.run(Duration::from_secs(30));
        assert!(arrived > 15_000_000, "{arrived}");
    }
}
