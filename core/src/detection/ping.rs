//! The pull model: objects are asked "are you alive?", and must answer in time.

use super::{Opinion, Pull, WorkProgress};
use crate::sorted::{SortedMap, SortedSet};
use crate::{Incarnation, Instant, Machine, ObjectName};
use std::collections::VecDeque;
use std::time::Duration;

/// Asks objects whether they are alive.
///
/// It is for the middleware's own objects, which have no [activity
/// records](crate::detection::hang): whether a component is alive, and how far its work has come,
/// is seen without asking it.
///
/// ```text
/// ask ──── answer within T ────► Trusted       alive?
///  ├── T over ─► Suspect ── tolerance × T over ─► Failed
/// ```
/// There is one open question per object, so that a stuck one is not buried under questions.
#[derive(Clone, Debug, Default)]
pub struct PingMonitor {
    asked: SortedMap<ObjectName, Asked>,
    /// When to check which object: exactly one check for each object from which something is due.
    looks: SortedSet<(Instant, ObjectName)>,
    outputs: VecDeque<PingOutput>,
}

/// An output of a [`PingMonitor`]: a ping to send, or a finding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PingOutput {
    /// Ask this object.
    Ask {
        /// The object.
        object: ObjectName,
    },
    /// The opinion about its being alive has changed.
    Verdict(Verdict),
}

/// A change of opinion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Verdict {
    /// The object concerned.
    pub object: ObjectName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// The new opinion.
    pub opinion: Opinion,
    /// For how long it was silent.
    pub silence: Duration,
}

#[derive(Clone, Debug)]
struct Asked {
    pull: Pull,
    incarnation: Incarnation,
    opinion: Opinion,
    /// When the last question was asked that is not answered yet.
    unanswered: Option<Instant>,
    /// A question stands; no other is asked meanwhile.
    open: bool,
    next: Instant,
    look: Option<Instant>,
    reprieves: u32,
}

/// A machine that was woken this many times too late for one silence judges all the same: otherwise
/// a monitor that is always late would never find anything.
const REPRIEVES: u32 = 2;

impl Asked {
    fn new(pull: Pull, incarnation: Incarnation, now: Instant) -> Self {
        Asked {
            pull,
            incarnation,
            opinion: Opinion::Unheard,
            unanswered: None,
            open: false,
            next: now,
            look: None,
            reprieves: 0,
        }
    }

    /// When the opinion changes unless an answer comes.
    fn verdict_due(&self) -> Option<Instant> {
        let asked = self.unanswered?;
        match self.opinion {
            Opinion::Unheard | Opinion::Trusted => Some(asked + self.pull.within),
            Opinion::Suspect => {
                Some(asked + self.pull.within.saturating_mul(self.pull.tolerance.max(1)))
            }
            Opinion::Failed | Opinion::Stopped => None,
        }
    }

    fn due(&self) -> Option<Instant> {
        let question = (!self.open && self.opinion != Opinion::Stopped).then_some(self.next);
        [question, self.verdict_due()].into_iter().flatten().min()
    }
}

impl PingMonitor {
    /// An pings that asks no object yet.
    pub fn new() -> Self {
        PingMonitor::default()
    }

    /// Pings an object from now on, whose incarnation `incarnation` begins or goes on.
    pub fn enrol(
        &mut self,
        object: &ObjectName,
        pull: Pull,
        incarnation: Incarnation,
        now: Instant,
    ) {
        let least = Duration::from_millis(1);
        let pull =
            Pull { interval: pull.interval.max(least), within: pull.within.max(least), ..pull };
        let asked =
            self.asked.entry(object.clone()).or_insert_with(|| Asked::new(pull, incarnation, now));
        asked.pull = pull;
        if asked.incarnation < incarnation {
            *asked = Asked { look: asked.look, ..Asked::new(pull, incarnation, now) };
        }
        schedule(&mut self.looks, object, asked);
    }

    /// Forgets an object.
    pub fn dismiss(&mut self, object: &ObjectName) {
        if let Some(Asked { look: Some(look), .. }) = self.asked.remove(object) {
            self.looks.remove(&(look, object.clone()));
        }
    }

    /// An object has answered. Answers of older incarnations do not count.
    pub fn handle_answer(&mut self, object: &ObjectName, progress: WorkProgress, now: Instant) {
        let Some(asked) = self.asked.get_mut(object) else { return };
        if progress.incarnation < asked.incarnation || asked.opinion == Opinion::Stopped {
            return self.handle_unanswered(object, now);
        }
        if progress.incarnation > asked.incarnation {
            let next = asked.next;
            let fresh = Asked::new(asked.pull, progress.incarnation, now);
            *asked = Asked { look: asked.look, next, ..fresh };
        }
        let silence = asked.unanswered.map_or(Duration::ZERO, |since| now - since);
        asked.unanswered = None;
        asked.open = false;
        asked.reprieves = 0;
        // The rhythm is kept; what a late answer made us miss is skipped.
        asked.next = asked.next.max(now);
        let (incarnation, opinion) = (asked.incarnation, Opinion::Trusted);
        if std::mem::replace(&mut asked.opinion, opinion) != opinion {
            let verdict = Verdict { object: object.clone(), incarnation, opinion, silence };
            self.outputs.push_back(PingOutput::Verdict(verdict));
        }
        schedule(&mut self.looks, object, asked);
    }

    /// The open ping will never be answered: the mailbox is closed, or the actor that sent it was
    /// restarted. The next ping is sent at the next turn; the silence goes on.
    pub fn handle_unanswered(&mut self, object: &ObjectName, now: Instant) {
        if let Some(asked) = self.asked.get_mut(object)
            && asked.open
        {
            asked.open = false;
            asked.next = asked.next.max(now);
            schedule(&mut self.looks, object, asked);
        }
    }

    /// A new incarnation has begun: its history is empty, and the old incarnation's question is
    /// void.
    pub fn handle_start(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        if let Some(asked) = self.asked.get_mut(object)
            && incarnation > asked.incarnation
        {
            *asked = Asked { look: asked.look, ..Asked::new(asked.pull, incarnation, now) };
            schedule(&mut self.looks, object, asked);
        }
    }

    /// An incarnation has ended: it is not asked until a newer one begins.
    pub fn handle_end(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        if let Some(asked) = self.asked.get_mut(object)
            && incarnation >= asked.incarnation
        {
            let fresh = Asked::new(asked.pull, incarnation, now);
            *asked = Asked { look: asked.look, opinion: Opinion::Stopped, ..fresh };
            schedule(&mut self.looks, object, asked);
        }
    }

    /// The monitor was not scheduled for `gap`: all deadlines move by as much.
    pub fn handle_stall(&mut self, gap: Duration, now: Instant) {
        for (object, asked) in &mut self.asked {
            asked.unanswered = asked.unanswered.map(|since| (since + gap).min(now).max(since));
            schedule(&mut self.looks, object, asked);
        }
    }

    fn look_at(&mut self, object: ObjectName, lateness: Duration, now: Instant) {
        let asked = self.asked.get_mut(&object).expect("a look stands for an object that is asked");
        asked.look = None;
        let overdue = asked.verdict_due().is_some_and(|due| due <= now);
        if overdue && lateness > asked.pull.within / 2 && asked.reprieves < REPRIEVES {
            asked.reprieves += 1;
            let spared = lateness + asked.pull.within;
            asked.unanswered = asked.unanswered.map(|since| since + spared);
        }
        while let Some(due) = asked.verdict_due()
            && due <= now
        {
            asked.opinion = match asked.opinion {
                Opinion::Suspect => Opinion::Failed,
                _ => Opinion::Suspect,
            };
            self.outputs.push_back(PingOutput::Verdict(Verdict {
                object: object.clone(),
                incarnation: asked.incarnation,
                opinion: asked.opinion,
                silence: asked.unanswered.map_or(Duration::ZERO, |since| now - since),
            }));
        }
        if !asked.open && asked.opinion != Opinion::Stopped && asked.next <= now {
            asked.open = true;
            asked.unanswered = asked.unanswered.or(Some(now));
            asked.next = now + asked.pull.interval;
            self.outputs.push_back(PingOutput::Ask { object: object.clone() });
        }
        schedule(&mut self.looks, &object, asked);
    }
}

/// Puts an object's look where it is due.
fn schedule(looks: &mut SortedSet<(Instant, ObjectName)>, object: &ObjectName, asked: &mut Asked) {
    let due = asked.due();
    if asked.look == due {
        return;
    }
    if let Some(look) = asked.look.take() {
        looks.remove(&(look, object.clone()));
    }
    if let Some(due) = due {
        looks.insert((due, object.clone()));
        asked.look = Some(due);
    }
}

impl Machine for PingMonitor {
    type Output = PingOutput;

    fn poll_output(&mut self) -> Option<PingOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.looks.first().map(|&(look, _)| look)
    }

    fn handle_timeout(&mut self, now: Instant) {
        while let Some(&(look, _)) = self.looks.first()
            && look <= now
        {
            let (look, object) = self.looks.pop_first().expect("it was just looked at");
            self.look_at(object, now - look, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Lifecycle;

    const ONE: Incarnation = Incarnation(1);
    const TWO: Incarnation = Incarnation(2);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn map() -> ObjectName {
        ObjectName::new("map").expect("a name")
    }

    fn pull() -> Pull {
        Pull {
            interval: Duration::from_millis(100),
            within: Duration::from_millis(40),
            tolerance: 3,
        }
    }

    fn pings() -> PingMonitor {
        let mut pings = PingMonitor::new();
        pings.enrol(&map(), pull(), ONE, at(0));
        pings
    }

    fn progress(incarnation: Incarnation) -> WorkProgress {
        WorkProgress { incarnation, state: Lifecycle::Active }
    }

    /// Wakes the machine exactly when it wants, up to `until`; an ask reads "ask".
    fn run(pings: &mut PingMonitor, until: u64) -> Vec<(u64, String)> {
        let mut reported = Vec::new();
        loop {
            let now = pings.poll_timeout().unwrap_or(at(until)).min(at(until));
            pings.handle_timeout(now);
            let millis = now.as_nanos() / 1_000_000;
            while let Some(output) = pings.poll_output() {
                let text = match output {
                    PingOutput::Ask { .. } => "ask".into(),
                    PingOutput::Verdict(verdict) => verdict.opinion.to_string(),
                };
                reported.push((millis, text));
            }
            if now == at(until) {
                return reported;
            }
        }
    }

    fn texts<const N: usize>(reported: [(u64, &str); N]) -> Vec<(u64, String)> {
        reported.map(|(at, text)| (at, text.to_string())).into()
    }

    #[test]
    fn whoever_answers_is_trusted_and_asked_again_at_the_next_turn() {
        let mut pings = pings();
        assert_eq!(run(&mut pings, 0), texts([(0, "ask")]));

        pings.handle_answer(&map(), progress(ONE), at(5));

        assert_eq!(run(&mut pings, 99), texts([(99, "trusted")]));
        assert_eq!(run(&mut pings, 100), texts([(100, "ask")]));
    }

    #[test]
    fn an_object_that_does_not_answer_is_suspect_then_failed() {
        let mut pings = pings();

        let reported = run(&mut pings, 10_000);

        assert_eq!(reported, texts([(0, "ask"), (40, "suspect"), (120, "failed")]));
        pings.handle_answer(&map(), progress(ONE), at(10_000));
        assert_eq!(run(&mut pings, 10_000), texts([(10_000, "trusted"), (10_000, "ask")]));
    }

    #[test]
    fn a_ping_without_a_reply_is_repeated_while_the_silence_lasts() {
        let mut pings = pings();
        run(&mut pings, 0);

        pings.handle_unanswered(&map(), at(1));

        let reported = run(&mut pings, 150);
        assert_eq!(reported, texts([(40, "suspect"), (100, "ask"), (120, "failed")]));
    }

    #[test]
    fn an_answer_of_an_older_incarnation_does_not_count() {
        let mut pings = pings();
        run(&mut pings, 0);
        pings.handle_start(&map(), TWO, at(10));
        run(&mut pings, 10);

        pings.handle_answer(&map(), progress(ONE), at(20));

        assert_eq!(run(&mut pings, 60), texts([(50, "suspect")]));
    }

    #[test]
    fn an_answer_of_a_newer_incarnation_begins_a_new_history() {
        let mut pings = pings();
        run(&mut pings, 50);

        pings.handle_answer(&map(), progress(TWO), at(60));

        assert_eq!(run(&mut pings, 60), texts([(60, "trusted")]));
    }

    #[test]
    fn nobody_is_asked_after_its_end_until_a_newer_incarnation_begins() {
        let mut pings = pings();
        run(&mut pings, 0);
        pings.handle_end(&map(), ONE, at(10));
        pings.handle_answer(&map(), progress(ONE), at(11));
        assert_eq!(run(&mut pings, 5000), []);

        pings.handle_start(&map(), TWO, at(5000));

        assert_eq!(run(&mut pings, 5000), texts([(5000, "ask")]));
    }

    #[test]
    fn a_stall_moves_the_deadlines_and_condemns_nobody() {
        let mut pings = pings();
        run(&mut pings, 30);

        pings.handle_stall(Duration::from_secs(60), at(60_030));

        assert_eq!(run(&mut pings, 60_039), []);
        assert_eq!(run(&mut pings, 60_040), texts([(60_040, "suspect")]));
    }

    #[test]
    fn a_monitor_that_is_woken_late_gives_another_time_to_answer_but_not_for_ever() {
        let mut pings = pings();
        run(&mut pings, 0);

        let mut opinions = Vec::new();
        while let Some(due) = pings.poll_timeout() {
            pings.handle_timeout(due + Duration::from_secs(1));
            while let Some(output) = pings.poll_output() {
                let PingOutput::Verdict(verdict) = output else { panic!("{output:?}") };
                opinions.push((verdict.opinion, verdict.silence > Duration::from_secs(1)));
            }
        }

        assert_eq!(opinions, [(Opinion::Suspect, true), (Opinion::Failed, true)]);
    }

    #[test]
    fn strangers_and_the_dismissed_are_ignored() {
        let mut pings = pings();
        pings.dismiss(&map());

        pings.handle_answer(&map(), progress(ONE), at(0));
        pings.handle_unanswered(&map(), at(0));
        pings.handle_start(&map(), TWO, at(0));
        pings.handle_end(&map(), TWO, at(0));
        pings.handle_stall(Duration::from_secs(1), at(0));
        pings.handle_timeout(at(1000));

        assert_eq!((pings.poll_output(), pings.poll_timeout()), (None, None));
    }
}
