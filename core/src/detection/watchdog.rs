//! The push model: objects say "I am alive", and silence is noticed.

use super::{Opinion, Push};
use crate::{Incarnation, Instant, Machine, ObjectName};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Notices which objects have stopped to give signs of life.
///
/// ```text
///             ┌───────── beat ──────────┐
/// Unheard ─ beat ─► Trusted ─ overdue ─► Suspect ─ still overdue ─► Failed ─ beat ─► Trusted
///    └──────── start-up time over ───────────────────────────────────►┘
/// life ended ─► AtRest ─ a newer life ─► Unheard
/// ```
/// A beat of an older life, or of one that has ended, never refreshes trust. A suspicion is told, so
/// that it can be counted and shown; only [`Opinion::Failed`] is a verdict.
///
/// What the monitor itself missed is not held against anybody: see
/// [`handle_stall`](Watchdog::handle_stall).
#[derive(Clone, Debug, Default)]
pub struct Watchdog {
    watched: BTreeMap<ObjectName, Watched>,
    /// When to look at whom: at most one look per object, never after its deadline, often before.
    looks: BTreeSet<(Instant, ObjectName)>,
    outputs: VecDeque<Verdict>,
    stalls: u64,
}

/// A change of opinion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verdict {
    /// About whom.
    pub object: ObjectName,
    /// In which life.
    pub incarnation: Incarnation,
    /// The new opinion.
    pub opinion: Opinion,
    /// For how long it was silent.
    pub silence: Duration,
}

/// A machine that was woken this many times too late for one silence judges all the same: otherwise a
/// monitor that is always late would never find anything.
const REPRIEVES: u32 = 2;

#[derive(Clone, Debug)]
struct Watched {
    push: Push,
    incarnation: Incarnation,
    opinion: Opinion,
    last: Option<Instant>,
    /// From when the silence is counted.
    since: Instant,
    /// The look that stands in `looks`.
    look: Option<Instant>,
    reprieves: u32,
}

impl Watched {
    fn deadline(&self) -> Option<Instant> {
        let interval = self.push.interval;
        // Half an interval of lateness is allowed on top (ITU-T G.8013).
        let after =
            |intervals: u32| interval.saturating_mul(intervals).saturating_add(interval / 2);
        match self.opinion {
            Opinion::Unheard => Some(self.since + self.push.start_up),
            Opinion::Trusted => Some(self.since + after(1)),
            Opinion::Suspect => Some(self.since + after(self.push.tolerance.max(1))),
            Opinion::Failed | Opinion::AtRest => None,
        }
    }

    fn begin(&mut self, incarnation: Incarnation, now: Instant) {
        self.incarnation = incarnation;
        self.opinion = Opinion::Unheard;
        self.last = None;
        self.since = now;
        self.reprieves = 0;
    }
}

impl Watchdog {
    /// A watchdog that watches nobody yet.
    pub fn new() -> Self {
        Watchdog::default()
    }

    /// Watches an object, whose life `incarnation` begins now. For an object that is watched already
    /// in this life, only the times are changed.
    pub fn enrol(
        &mut self,
        object: &ObjectName,
        push: Push,
        incarnation: Incarnation,
        now: Instant,
    ) {
        // A period of zero would condemn everybody at once.
        let push = Push { interval: push.interval.max(Duration::from_millis(1)), ..push };
        let fresh = Watched {
            push,
            incarnation,
            opinion: Opinion::Unheard,
            last: None,
            since: now,
            look: None,
            reprieves: 0,
        };
        let watched = self.watched.entry(object.clone()).or_insert(fresh);
        watched.push = push;
        if watched.incarnation < incarnation {
            watched.begin(incarnation, now);
        }
        schedule(&mut self.looks, object, watched);
    }

    /// Forgets an object.
    pub fn dismiss(&mut self, object: &ObjectName) {
        if let Some(Watched { look: Some(look), .. }) = self.watched.remove(object) {
            self.looks.remove(&(look, object.clone()));
        }
    }

    /// A sign of life. Costs one search and arms no timer: the standing look finds out when it is due.
    pub fn handle_heartbeat(
        &mut self,
        source: &ObjectName,
        incarnation: Incarnation,
        now: Instant,
    ) {
        let Some(watched) = self.watched.get_mut(source) else { return };
        if incarnation < watched.incarnation {
            return;
        }
        if incarnation > watched.incarnation {
            watched.begin(incarnation, now);
        } else if watched.opinion == Opinion::AtRest {
            return;
        }
        let silence = now - watched.since;
        let before = std::mem::replace(&mut watched.opinion, Opinion::Trusted);
        watched.last = Some(now);
        watched.since = now;
        watched.reprieves = 0;
        if before != Opinion::Trusted {
            schedule(&mut self.looks, source, watched);
            self.outputs.push_back(Verdict {
                object: source.clone(),
                incarnation,
                opinion: Opinion::Trusted,
                silence,
            });
        }
    }

    /// A new life has begun: its history is empty, and its start-up time runs.
    pub fn handle_start(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        if let Some(watched) = self.watched.get_mut(object)
            && incarnation > watched.incarnation
        {
            watched.begin(incarnation, now);
            schedule(&mut self.looks, object, watched);
        }
    }

    /// A life has ended, for whatever reason: nothing is expected until a newer one begins.
    pub fn handle_end(&mut self, object: &ObjectName, incarnation: Incarnation) {
        if let Some(watched) = self.watched.get_mut(object)
            && incarnation >= watched.incarnation
        {
            watched.incarnation = incarnation;
            watched.opinion = Opinion::AtRest;
            schedule(&mut self.looks, object, watched);
        }
    }

    /// The monitor was not scheduled for `gap`, until now: signs of life may have been lost or late
    /// because of that, so all deadlines move by as much.
    pub fn handle_stall(&mut self, gap: Duration, now: Instant) {
        self.stalls += 1;
        for (object, watched) in &mut self.watched {
            watched.since = (watched.since + gap).min(now).max(watched.since);
            schedule(&mut self.looks, object, watched);
        }
    }

    /// Whether this is the present life of an object that is watched.
    pub fn knows(&self, object: &ObjectName, incarnation: Incarnation) -> bool {
        self.watched.get(object).is_some_and(|watched| watched.incarnation == incarnation)
    }

    /// When an object last gave a sign of life in its present life.
    pub fn last_sign(&self, object: &ObjectName) -> Option<Instant> {
        self.watched.get(object)?.last
    }

    /// How often the monitor itself was found to have stood still.
    pub fn stalls(&self) -> u64 {
        self.stalls
    }

    /// Says whether the object was spared because the monitor came late.
    fn look_at(&mut self, object: ObjectName, lateness: Duration, now: Instant) -> bool {
        let watched = self.watched.get_mut(&object).expect("a look stands for a watched object");
        watched.look = None;
        let interval = watched.push.interval;
        let overdue = watched.deadline().is_some_and(|deadline| deadline <= now);
        // Woken so late, the monitor cannot tell whether nobody spoke or nobody listened.
        let spared = overdue && lateness > interval / 2 && watched.reprieves < REPRIEVES;
        if spared {
            watched.reprieves += 1;
            watched.since = watched.since + lateness + interval;
        }
        while let Some(deadline) = watched.deadline()
            && deadline <= now
        {
            watched.opinion = match watched.opinion {
                Opinion::Trusted => Opinion::Suspect,
                _ => Opinion::Failed,
            };
            self.outputs.push_back(Verdict {
                object: object.clone(),
                incarnation: watched.incarnation,
                opinion: watched.opinion,
                silence: now - watched.last.unwrap_or(watched.since),
            });
        }
        schedule(&mut self.looks, &object, watched);
        spared
    }
}

/// Puts an object's look where its deadline needs it. A look that is early is left standing.
fn schedule(
    looks: &mut BTreeSet<(Instant, ObjectName)>,
    object: &ObjectName,
    watched: &mut Watched,
) {
    let deadline = watched.deadline();
    if let (Some(look), Some(deadline)) = (watched.look, deadline)
        && look <= deadline
    {
        return;
    }
    if let Some(look) = watched.look.take() {
        looks.remove(&(look, object.clone()));
    }
    if let Some(deadline) = deadline {
        looks.insert((deadline, object.clone()));
        watched.look = Some(deadline);
    }
}

impl Machine for Watchdog {
    type Output = Verdict;

    fn poll_output(&mut self) -> Option<Verdict> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.looks.first().map(|&(look, _)| look)
    }

    fn handle_timeout(&mut self, now: Instant) {
        let mut stalled = false;
        while let Some(&(look, _)) = self.looks.first()
            && look <= now
        {
            let (look, object) = self.looks.pop_first().expect("it was just looked at");
            stalled |= self.look_at(object, now - look, now);
        }
        self.stalls += u64::from(stalled);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ONE: Incarnation = Incarnation(1);
    const TWO: Incarnation = Incarnation(2);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn laser() -> ObjectName {
        ObjectName::new("laser").expect("a name")
    }

    fn push() -> Push {
        let (interval, start_up) = (Duration::from_millis(100), Duration::from_secs(1));
        Push { interval, tolerance: 3, start_up }
    }

    fn watchdog() -> Watchdog {
        let mut watchdog = Watchdog::new();
        watchdog.enrol(&laser(), push(), ONE, at(0));
        watchdog
    }

    /// Wakes the machine exactly when it wants, up to `until`, and collects (millisecond, opinion).
    fn run(watchdog: &mut Watchdog, until: u64) -> Vec<(u64, Opinion)> {
        let mut told = Vec::new();
        loop {
            let now = watchdog.poll_timeout().unwrap_or(at(until)).min(at(until));
            watchdog.handle_timeout(now);
            while let Some(verdict) = watchdog.poll_output() {
                told.push((now.as_nanos() / 1_000_000, verdict.opinion));
            }
            if now == at(until) {
                return told;
            }
        }
    }

    #[test]
    fn silence_is_first_a_suspicion_and_then_a_failure_and_a_beat_restores_trust() {
        let mut watchdog = watchdog();

        watchdog.handle_heartbeat(&laser(), ONE, at(10));
        assert_eq!(run(&mut watchdog, 10), [(10, Opinion::Trusted)]);
        let told = run(&mut watchdog, 2000);
        assert_eq!(told, [(160, Opinion::Suspect), (360, Opinion::Failed)]);
        assert_eq!(watchdog.poll_timeout(), None);

        watchdog.handle_heartbeat(&laser(), ONE, at(2000));
        let verdict = watchdog.poll_output().expect("trust is told");
        assert_eq!((verdict.opinion, verdict.silence), (Opinion::Trusted, at(2000) - at(10)));
    }

    #[test]
    fn a_life_that_was_never_heard_fails_when_its_start_up_time_is_over() {
        let mut watchdog = watchdog();

        assert_eq!(run(&mut watchdog, 5000), [(1000, Opinion::Failed)]);
    }

    #[test]
    fn a_beat_of_an_older_life_never_refreshes_trust() {
        let mut watchdog = watchdog();
        watchdog.handle_start(&laser(), TWO, at(0));

        watchdog.handle_heartbeat(&laser(), ONE, at(900));

        assert_eq!(run(&mut watchdog, 5000), [(1000, Opinion::Failed)]);
    }

    #[test]
    fn a_beat_of_a_newer_life_begins_a_new_history() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        run(&mut watchdog, 200);

        watchdog.handle_heartbeat(&laser(), TWO, at(200));

        let verdict = watchdog.poll_output().expect("trust is told");
        assert_eq!((verdict.incarnation, verdict.opinion), (TWO, Opinion::Trusted));
        watchdog.handle_heartbeat(&laser(), ONE, at(300));
        assert_eq!(watchdog.last_sign(&laser()), Some(at(200)));
    }

    #[test]
    fn nothing_is_expected_of_a_life_that_has_ended_until_the_next_one_begins() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        watchdog.handle_end(&laser(), ONE);
        run(&mut watchdog, 0);

        watchdog.handle_heartbeat(&laser(), ONE, at(50));
        assert_eq!(run(&mut watchdog, 5000), []);

        watchdog.handle_start(&laser(), TWO, at(5000));
        assert_eq!(run(&mut watchdog, 9000), [(6000, Opinion::Failed)]);
    }

    #[test]
    fn heartbeats_leave_the_standing_look_alone() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        let standing = watchdog.poll_timeout();

        for beat in 1..100 {
            watchdog.handle_heartbeat(&laser(), ONE, at(beat));
            assert_eq!(watchdog.poll_timeout(), standing);
        }
    }

    #[test]
    fn a_stall_moves_every_deadline_and_condemns_nobody() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        run(&mut watchdog, 100);

        watchdog.handle_stall(Duration::from_secs(60), at(60_100));

        assert_eq!(run(&mut watchdog, 60_100), []);
        let told = run(&mut watchdog, 70_000);
        assert_eq!(told, [(60_150, Opinion::Suspect), (60_350, Opinion::Failed)]);
        assert_eq!(watchdog.stalls(), 1);
    }

    #[test]
    fn a_monitor_that_is_woken_late_gives_everybody_another_interval_but_not_for_ever() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        while watchdog.poll_output().is_some() {}

        let mut opinions = Vec::new();
        for _ in 0..10 {
            let Some(look) = watchdog.poll_timeout() else { break };
            watchdog.handle_timeout(look + Duration::from_secs(5));
            opinions.push(watchdog.poll_output().map(|verdict| verdict.opinion));
        }

        assert_eq!(opinions, [None, None, Some(Opinion::Suspect)]);
        assert_eq!(watchdog.poll_output().map(|verdict| verdict.opinion), Some(Opinion::Failed));
    }

    #[test]
    fn strangers_and_the_dismissed_are_ignored() {
        let mut watchdog = watchdog();
        watchdog.dismiss(&laser());

        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        watchdog.handle_start(&laser(), TWO, at(0));
        watchdog.handle_end(&laser(), TWO);
        watchdog.handle_stall(Duration::from_secs(1), at(0));
        watchdog.handle_timeout(at(9000));

        assert_eq!((watchdog.poll_output(), watchdog.poll_timeout()), (None, None));
    }

    #[test]
    fn enrolling_again_changes_the_times_and_keeps_the_history() {
        let mut watchdog = watchdog();
        watchdog.handle_heartbeat(&laser(), ONE, at(0));
        run(&mut watchdog, 0);

        let slower = Push { interval: Duration::from_secs(1), ..push() };
        watchdog.enrol(&laser(), slower, ONE, at(10));

        assert_eq!(watchdog.last_sign(&laser()), Some(at(0)));
        assert_eq!(run(&mut watchdog, 2000), [(1500, Opinion::Suspect)]);
    }

    /// One thing that may happen to a watchdog.
    #[derive(Clone, Debug)]
    enum Input {
        Beat { incarnation: u64 },
        Start { incarnation: u64 },
        Wait { millis: u64 },
        Stall { millis: u64 },
        Wake,
    }

    fn input() -> impl Strategy<Value = Input> {
        prop_oneof![
            (1..4u64).prop_map(|incarnation| Input::Beat { incarnation }),
            (1..4u64).prop_map(|incarnation| Input::Start { incarnation }),
            (0..300u64).prop_map(|millis| Input::Wait { millis }),
            (0..2000u64).prop_map(|millis| Input::Stall { millis }),
            Just(Input::Wake),
        ]
    }

    proptest! {
        /// Whatever else happens, in whatever order and however late the machine is woken: an object
        /// whose beats come in time is never taken for failed.
        #[test]
        fn nobody_is_condemned_while_its_beats_come_in_time(inputs in prop::collection::vec(input(), 0..200)) {
            let mut watchdog = Watchdog::new();
            let (mut now, mut life) = (at(0), ONE);
            let mut heard = now;
            watchdog.enrol(&laser(), push(), life, now);
            watchdog.handle_heartbeat(&laser(), life, now);
            for input in inputs {
                match input {
                    Input::Beat { incarnation } => {
                        watchdog.handle_heartbeat(&laser(), Incarnation(incarnation), now);
                        life = life.max(Incarnation(incarnation));
                    }
                    Input::Start { incarnation } => {
                        watchdog.handle_start(&laser(), Incarnation(incarnation), now);
                        life = life.max(Incarnation(incarnation));
                    }
                    Input::Stall { millis } => {
                        let gap = Duration::from_millis(millis);
                        now = now + gap;
                        heard = heard + gap;
                        watchdog.handle_stall(gap, now);
                    }
                    Input::Wake => watchdog.handle_timeout(now),
                    Input::Wait { millis } => now = now + Duration::from_millis(millis),
                }
                // In time: before three and a half intervals are over.
                if now - heard >= Duration::from_millis(300) || matches!(input, Input::Wait { .. }) {
                    watchdog.handle_heartbeat(&laser(), life, now);
                    heard = now;
                }
                while let Some(verdict) = watchdog.poll_output() {
                    prop_assert_ne!(verdict.opinion, Opinion::Failed);
                }
            }
        }

        /// The other half of the promise: whoever falls silent is found, and found once, however late
        /// the machine is woken.
        #[test]
        fn whoever_falls_silent_is_found_once(lateness in 0..2000u64, beats in 1..20u64) {
            let mut watchdog = watchdog();
            for beat in 0..beats {
                watchdog.handle_heartbeat(&laser(), ONE, at(beat * 100));
            }
            let mut failures = 0;
            while let Some(due) = watchdog.poll_timeout() {
                watchdog.handle_timeout(due + Duration::from_millis(lateness));
                while let Some(verdict) = watchdog.poll_output() {
                    failures += u32::from(verdict.opinion == Opinion::Failed);
                }
            }
            prop_assert_eq!(failures, 1);
        }
    }
}
