//! Judges one channel by what was measured of it.

use crate::Instant;
use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

/// How a connection is. A greater one is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum ConditionState {
    /// It is silent, or was never heard.
    Lost,
    /// It is there, and breaks a limit.
    Degraded,
    /// It is there, within all limits.
    Connected,
}

impl fmt::Display for ConditionState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ConditionState::Lost => "lost",
            ConditionState::Degraded => "degraded",
            ConditionState::Connected => "connected",
        })
    }
}

/// How long a message takes one way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Latency {
    /// The middle of what it may be.
    pub estimate: Duration,
    /// It is no further from the estimate than this.
    pub error: Duration,
}

impl Latency {
    /// Half a round trip, and as much of an error: nothing says which way took it.
    pub fn of_round_trip(round_trip: Duration) -> Self {
        Latency { estimate: round_trip / 2, error: round_trip / 2 }
    }

    /// The longest that it may be. Limits are compared with it.
    pub fn most(&self) -> Duration {
        self.estimate + self.error
    }
}

/// What was measured of a channel until now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChannelReading {
    /// How many messages, hellos or renewals have arrived.
    pub arrived: u64,
    /// When the last sign of life came; `None` for never.
    pub heard_at: Option<Instant>,
    /// How long a message takes, once known.
    pub latency: Option<Latency>,
    /// By how much that varies, once known.
    pub jitter: Option<Duration>,
    /// How many of a thousand messages are lost, once known.
    pub loss_permille: Option<u16>,
}

/// Beyond these a connection is degraded; `None` for no limit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ConnectionLimits {
    /// The longest that a message may take.
    pub latency: Option<Duration>,
    /// The most that this may vary.
    pub jitter: Option<Duration>,
    /// How many of a thousand messages may be lost.
    pub loss_permille: Option<u16>,
    /// How many messages must come in a second, and over which time they are counted.
    pub rate: Option<(f64, Duration)>,
}

/// How a channel is judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConnectionRules {
    /// It is lost when it gives no sign of life for longer, unless a rate is set.
    pub timeout: Duration,
    /// How many messages must come in a second, counted over this time. It is lost below four
    /// fifths of the rate.
    pub rate: Option<(f64, Duration)>,
    /// Whether it is good.
    pub limits: ConnectionLimits,
}

/// Counts how many messages arrive in a window that slides in tenths, and judges their rate.
#[derive(Debug)]
struct RateMeter {
    hz: f64,
    window: Duration,
    is_slow: bool,
    /// When so many had arrived. The first is a window old, once there is one.
    marks: VecDeque<(Instant, u64)>,
}

impl RateMeter {
    /// Says how slow it is, where it is too slow.
    fn judge(&mut self, arrived: u64, now: Instant) -> Option<String> {
        if self.marks.back().is_none_or(|(at, _)| now - *at >= self.window / 10) {
            self.marks.push_back((now, arrived));
        }
        while self.marks.get(1).is_some_and(|(at, _)| now - *at >= self.window) {
            self.marks.pop_front();
        }
        let (from, before) = self.marks.front().copied().unwrap_or((now, arrived));
        let span = (now - from).max(self.window);
        let (rate, hz) = (arrived.saturating_sub(before) as f64 / span.as_secs_f64(), self.hz);
        // A rate is to be high: the greater is the better.
        let is_slow = is_beyond(&mut self.is_slow, Some(-rate), -hz * RATE_KEPT, -hz);
        is_slow.then(|| format!("{rate:.1} messages a second, of {hz}"))
    }
}

/// Whether a figure is beyond its limit, or not known. A limit that was broken counts as broken
/// until the figure has fallen to where it is cleared.
fn is_beyond<T: PartialOrd>(broken: &mut bool, found: Option<T>, limit: T, cleared_at: T) -> bool {
    let limit = if *broken { cleared_at } else { limit };
    *broken = found.as_ref().is_some_and(|found| *found > limit);
    *broken || found.is_none()
}

/// Judges one channel.
#[derive(Debug)]
pub struct ConnectionJudge {
    name: String,
    rules: ConnectionRules,
    presence_rate: Option<RateMeter>,
    limit_rate: Option<RateMeter>,
    is_there: bool,
    /// A limit is broken.
    is_degraded: bool,
    /// Which were broken: those of latency, jitter and loss.
    broken: [bool; 3],
    heard_at: Option<Instant>,
    /// What was found, for display.
    cause: String,
}

/// Four fifths of a rate keep what the whole of it has won: one missing message must not end it.
const RATE_KEPT: f64 = 0.8;

impl ConnectionJudge {
    /// A channel of this name that was not heard yet.
    pub fn new(name: String, rules: ConnectionRules) -> Self {
        let meter =
            |(hz, window), is_slow| RateMeter { hz, window, is_slow, marks: <_>::default() };
        ConnectionJudge {
            name,
            rules,
            presence_rate: rules.rate.map(|rate| meter(rate, true)),
            limit_rate: rules.limits.rate.map(|rate| meter(rate, false)),
            is_there: false,
            is_degraded: false,
            broken: [false; 3],
            heard_at: None,
            cause: String::new(),
        }
    }

    /// How the channel is.
    pub fn state(&self) -> ConditionState {
        match (self.is_there, self.is_degraded) {
            (false, _) => ConditionState::Lost,
            (true, true) => ConditionState::Degraded,
            (true, false) => ConditionState::Connected,
        }
    }

    /// What was found, with the figures, for display.
    pub fn cause(&self) -> &str {
        &self.cause
    }

    /// When the channel is lost unless it is heard before.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let is_watched = self.is_there && self.rules.rate.is_none();
        // Silence of exactly the timeout is within it.
        let longest = self.rules.timeout + Duration::from_nanos(1);
        self.heard_at.filter(|_| is_watched).map(|at| at + longest)
    }

    /// Judges the channel by what is known of it now.
    pub fn handle_reading(&mut self, reading: &ChannelReading, now: Instant) {
        self.heard_at = reading.heard_at;
        let mut causes = Vec::new();
        self.judge_presence(reading, now, &mut causes);
        // The figures of a silent channel are those of its last message, and decide nothing.
        if self.is_there {
            self.judge_limits(reading, now, &mut causes);
        }
        let name = &self.name;
        self.cause = match causes.is_empty() {
            true => format!("{name}: {}", figures(reading, now)),
            false => format!("{name}: {}", causes.join(", ")),
        };
    }

    fn judge_presence(&mut self, reading: &ChannelReading, now: Instant, causes: &mut Vec<String>) {
        let silence = reading.heard_at.map(|at| now - at);
        let too_slow = self.presence_rate.as_mut().map(|rate| rate.judge(reading.arrived, now));
        let timeout = self.rules.timeout;
        let missing = match (silence, too_slow) {
            (None, _) => Some("never heard".to_owned()),
            (Some(_), Some(too_slow)) => too_slow,
            (Some(silence), None) => (silence > timeout)
                .then(|| format!("silent for {silence:.1?}, at most {timeout:?}")),
        };
        self.is_there = missing.is_none();
        causes.extend(missing);
    }

    fn judge_limits(&mut self, reading: &ChannelReading, now: Instant, causes: &mut Vec<String>) {
        let ConnectionLimits { latency, jitter, loss_permille, .. } = self.rules.limits;
        let [late, unsteady, lossy] = &mut self.broken;
        if let Some(limit) = latency {
            let most = reading.latency.map(|latency| latency.most());
            if is_beyond(late, most, limit, limit / 2) {
                let found = reading.latency.map(shown);
                causes.push(beyond("latency", found, format!("{limit:?}")));
            }
        }
        if let Some(limit) = jitter
            && is_beyond(unsteady, reading.jitter, limit, limit / 2)
        {
            let found = reading.jitter.map(|jitter| format!("{jitter:.1?}"));
            causes.push(beyond("jitter", found, format!("{limit:?}")));
        }
        if let Some(limit) = loss_permille
            && is_beyond(lossy, reading.loss_permille, limit, limit / 2)
        {
            causes.push(beyond("loss", reading.loss_permille.map(percent), percent(limit)));
        }
        causes.extend(self.limit_rate.as_mut().and_then(|rate| rate.judge(reading.arrived, now)));
        self.is_degraded = !causes.is_empty();
    }
}

fn beyond(what: &str, found: Option<String>, limit: String) -> String {
    match found {
        Some(found) => format!("{what} {found}, limit {limit}"),
        None => format!("{what} is not known yet, limit {limit}"),
    }
}

fn shown(latency: Latency) -> String {
    format!("{:.1?} ± {:.1?}", latency.estimate, latency.error)
}

fn percent(permille: u16) -> String {
    format!("{} %", f32::from(permille) / 10.0)
}

/// What is known of a channel that is well.
fn figures(reading: &ChannelReading, now: Instant) -> String {
    let heard = reading.heard_at.map(|at| format!("heard {:.1?} ago", now - at));
    let latency = reading.latency.map(|latency| format!("latency {}", shown(latency)));
    let jitter = reading.jitter.map(|jitter| format!("jitter {jitter:.1?}"));
    let loss = reading.loss_permille.map(|loss| format!("loss {}", percent(loss)));
    let known: Vec<_> = [heard, latency, jitter, loss].into_iter().flatten().collect();
    known.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use crate::testing::at;

    const SECOND: Duration = Duration::from_secs(1);

    fn judge(rate: Option<(f64, Duration)>, limits: ConnectionLimits) -> ConnectionJudge {
        let timeout = Duration::from_secs(3);
        ConnectionJudge::new("beat".into(), ConnectionRules { timeout, rate, limits })
    }

    #[test]
    fn a_channel_is_lost_until_it_is_heard_and_after_its_timeout() {
        let mut beat = judge(None, ConnectionLimits::default());
        let mut look = |heard_at: Option<u64>, now: u64| {
            let heard_at = heard_at.map(at);
            beat.handle_reading(&ChannelReading { heard_at, ..ChannelReading::default() }, at(now));
            (beat.state(), beat.cause().to_owned(), beat.poll_timeout())
        };
        assert_eq!(look(None, 9_000), (ConditionState::Lost, "beat: never heard".into(), None));
        let due = Some(Instant::from_nanos(4_000_000_001));
        let heard = "beat: heard 3.0s ago".to_owned();
        assert_eq!(look(Some(1_000), 4_000), (ConditionState::Connected, heard, due));
        let silent = "beat: silent for 3.1s, at most 3s".to_owned();
        assert_eq!(look(Some(1_000), 4_100), (ConditionState::Lost, silent, None));
    }

    #[test]
    fn a_rate_is_counted_over_its_window_and_kept_at_four_fifths() {
        let mut scan = judge(Some((10.0, SECOND)), ConnectionLimits::default());
        let (mut arrived, mut states) = (0, Vec::new());
        // Each rate holds for five seconds.
        for (rate, from) in [(20, 0), (9, 5), (7, 10), (9, 15), (12, 20)] {
            for tick in 0..500 {
                let now = at(from * 1000 + tick * 10);
                arrived += u64::from(tick * rate / 100 != (tick + 1) * rate / 100);
                let reading = ChannelReading { arrived, heard_at: Some(now), ..Default::default() };
                scan.handle_reading(&reading, now);
            }
            states.push(scan.state());
        }
        use ConditionState::{Connected, Lost};
        assert_eq!(states, [Connected, Connected, Lost, Lost, Connected]);
    }

    #[test]
    fn quality_changes_once_for_each_crossing_of_both_limits_and_not_in_silence() {
        let limits = ConnectionLimits { latency: Some(SECOND), ..ConnectionLimits::default() };
        let mut radio = judge(None, limits);
        let mut look = |round_trip_ms: u64, now: u64, heard: u64| {
            let trip = Duration::from_millis(round_trip_ms);
            let latency = Some(Latency::of_round_trip(trip));
            let reading =
                ChannelReading { latency, heard_at: Some(at(heard)), ..Default::default() };
            radio.handle_reading(&reading, at(now));
            radio.state()
        };
        let (mut changes, mut last) = (0, look(100, 0, 0));
        // Four times from 0.3 to 1.5 s and back, each step with a swing of a third around it.
        for round in 0..4 {
            for step in 0..240u64 {
                let middle = if step < 120 { 300 + step * 10 } else { 1500 - (step - 120) * 10 };
                let swing = if step % 2 == 0 { middle / 3 } else { 0 };
                let now = (round * 240 + step) * 100;
                let state = look(middle + swing, now, now);
                changes += usize::from(std::mem::replace(&mut last, state) != state);
            }
        }
        assert_eq!(changes, 8);
        assert_eq!(look(100, 98_900, 96_000), ConditionState::Connected, "silent for 2.9 s");
        assert_eq!(look(100, 99_100, 96_000), ConditionState::Lost);
    }

    #[test]
    fn a_limit_is_left_at_half_of_it_and_a_figure_that_becomes_known_needs_no_half() {
        let limits = ConnectionLimits { loss_permille: Some(100), ..ConnectionLimits::default() };
        let mut radio = judge(None, limits);
        let mut look = |loss_permille: Option<u16>| {
            let heard_at = Some(at(0));
            let reading = ChannelReading { heard_at, loss_permille, ..Default::default() };
            radio.handle_reading(&reading, at(0));
            radio.state() == ConditionState::Connected
        };
        let seen = [None, Some(90), Some(101), Some(90), Some(51), Some(50), Some(100)];
        assert_eq!(seen.map(&mut look), [false, true, false, false, false, true, true]);
    }

    #[test]
    fn an_hour_of_heartbeats_at_ten_hertz_and_thirty_percent_loss_changes_nothing() {
        let (mut beat, mut random) = (judge(None, ConnectionLimits::default()), Random::new(7));
        let mut heard_at = at(0);
        for tick in 0..36_000 {
            let now = at(tick * 100);
            if !random.chance(0.3) {
                heard_at = now;
            }
            let reading = ChannelReading { heard_at: Some(heard_at), ..Default::default() };
            beat.handle_reading(&reading, now);
            assert_eq!(beat.state(), ConditionState::Connected, "{}", beat.cause());
        }
    }

    #[test]
    fn a_limit_of_what_is_not_known_is_broken_and_every_broken_limit_is_named() {
        let limits = ConnectionLimits {
            latency: Some(SECOND),
            jitter: Some(SECOND / 10),
            loss_permille: Some(100),
            rate: Some((5.0, SECOND)),
        };
        let mut radio = judge(None, limits);
        let reading = ChannelReading { heard_at: Some(at(0)), ..ChannelReading::default() };
        radio.handle_reading(&reading, at(0));
        assert_eq!(radio.state(), ConditionState::Degraded);
        let latency = Some(Latency { estimate: SECOND, error: SECOND / 2 });
        let reading = ChannelReading {
            latency,
            jitter: Some(SECOND / 5),
            loss_permille: Some(215),
            ..reading
        };
        radio.handle_reading(&reading, at(10));
        assert_eq!(
            radio.cause(),
            "beat: latency 1.0s ± 500.0ms, limit 1s, jitter 200.0ms, limit 100ms, \
             loss 21.5 %, limit 10 %, 0.0 messages a second, of 5"
        );
    }
}
