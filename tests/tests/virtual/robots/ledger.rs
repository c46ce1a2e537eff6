//! What really happened: written by the components of a robot themselves, in the order in which it
//! happened, without asking the middleware.

use crate::robots::plan::{Blow, Pull, Robot};
use blastema::Instant;
use blastema::platform::now;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// One line of the ledger.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Entry {
    pub(crate) at: Instant,
    pub(crate) part: usize,
    /// 0 where no incarnation had begun.
    pub(crate) incarnation: u64,
    pub(crate) what: What,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum What {
    /// `on_initialize` of a new incarnation was called.
    Began,
    /// A hook other than `on_execute` was called.
    Hook(&'static str),
    /// A round of `on_execute` began.
    Round,
    /// A request with this number is being served.
    Serving(u64),
    /// An event from the listed publisher, its incarnation and its number.
    Read { topic: usize, from: usize, of: u64, n: u64 },
    /// An event was published without an error.
    Published { topic: usize, n: u64 },
    /// A message of a flood.
    Load(u64),
    /// A death notice.
    Down { object: String, incarnation: u64, ending: String },
    /// It is about to do this; panics have a number, which is in their text.
    Struck(Cause),
    /// The handler or hook that had struck ended by itself.
    Returned,
    /// The component was dropped.
    Dropped,
}

/// Why something goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Cause {
    /// In a handler, hook, task or timer.
    Panic(u64),
    /// In a condition, which knows no incarnation: it is noted with the one that began last.
    Condition(u64),
    /// In `Drop` of the component.
    DropPanic,
    /// A hook fails, or the handler says so.
    Fail(&'static str),
    Fatal(&'static str),
    Unavailable,
    Stop,
    /// It takes so many milliseconds.
    Wait(u64),
    /// It keeps its thread for so many milliseconds.
    Block(u64),
    Declare,
    /// The runner put one in.
    Kill,
    Hang,
    Silence,
    FailInit,
    Slow,
    Flood,
    /// A person restarted it.
    RestartChild,
    /// It asks another component, and waits for the answer.
    Consult,
    /// A person added it, or removed it.
    Added,
    Removed,
}

/// The outcome of one request.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Asked {
    pub(crate) number: u64,
    pub(crate) part: usize,
    /// Of a request that a component made: which, and in which incarnation.
    pub(crate) by: Option<(usize, u64)>,
    pub(crate) asked_at: Instant,
    pub(crate) deadline_ms: u64,
    /// None where the incarnation that asked has ended before.
    pub(crate) answer: Option<(Instant, Answer)>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Answer {
    /// The incarnation that served it.
    Reply(u64),
    NotTaken(String),
    PeerDied(u64),
    DeadlinePassed,
    Other(String),
}

#[derive(Default)]
struct Inner {
    entries: Vec<Entry>,
    asked: Vec<Asked>,
    /// Of each component: its latest incarnation.
    current: BTreeMap<usize, u64>,
    pulls: BTreeMap<(usize, &'static str), VecDeque<Pull>>,
    /// What the next conditions of components do.
    conditions: BTreeMap<usize, VecDeque<Blow>>,
    /// Components whose device is away.
    unplugged: BTreeSet<usize>,
    /// Late components that a person wanted.
    wanted: BTreeSet<usize>,
    /// Of these, what was not added, and why.
    refused: Vec<(usize, String)>,
    /// The watcher watches.
    watched: bool,
    published: BTreeMap<usize, u64>,
    numbers: u64,
    /// Tasks and timers that have not struck yet.
    scheduled: usize,
    /// Of each listener and topic: the latest mark that its condition has seen.
    marks: BTreeMap<(usize, usize), u64>,
}

/// A task or timer that is going to strike, unless its incarnation ends before.
pub(crate) struct Scheduled(Ledger);

impl Drop for Scheduled {
    fn drop(&mut self) {
        self.0.inner().scheduled -= 1;
    }
}

/// What the runner, the components and the model share.
#[derive(Clone)]
pub(crate) struct Ledger {
    pub(crate) robot: Arc<Robot>,
    inner: Arc<Mutex<Inner>>,
}

impl Ledger {
    pub(crate) fn new(robot: Arc<Robot>) -> Self {
        Ledger { robot, inner: Arc::default() }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn write(&self, part: usize, incarnation: u64, what: What) {
        self.write_at(now(), part, incarnation, what);
    }

    /// Notes what began at `at`.
    pub(crate) fn write_at(&self, at: Instant, part: usize, incarnation: u64, what: What) {
        let mut inner = self.inner();
        if what == What::Began {
            inner.current.insert(part, incarnation);
        }
        inner.entries.push(Entry { at, part, incarnation, what });
    }

    /// The same, for the incarnation that began last.
    pub(crate) fn write_current(&self, part: usize, what: What) {
        let incarnation = self.inner().current.get(&part).copied().unwrap_or_default();
        self.write(part, incarnation, what);
    }

    /// Notes that this incarnation panics, and panics.
    pub(crate) fn panic(&self, part: usize, incarnation: u64) -> ! {
        let number = self.number();
        self.write(part, incarnation, What::Struck(Cause::Panic(number)));
        panic!("panic number {number} of the plan");
    }

    /// A number that was not given before.
    pub(crate) fn number(&self) -> u64 {
        let mut inner = self.inner();
        inner.numbers += 1;
        inner.numbers
    }

    /// The number of the next event of this component.
    pub(crate) fn next_event(&self, part: usize) -> u64 {
        let mut inner = self.inner();
        let n = inner.published.entry(part).or_default();
        *n += 1;
        *n
    }

    pub(crate) fn pull(&self, part: usize, hook: &'static str, pull: Pull) {
        self.inner().pulls.entry((part, hook)).or_default().push_back(pull);
    }

    pub(crate) fn next_pull(&self, part: usize, hook: &'static str) -> Option<Pull> {
        let mut inner = self.inner();
        let pulls = inner.pulls.get_mut(&(part, hook))?;
        match pulls.front_mut()? {
            Pull::Unavailable(times) if *times > 1 => {
                *times -= 1;
                Some(Pull::Unavailable(*times))
            }
            _ => pulls.pop_front(),
        }
    }

    pub(crate) fn strike_condition(&self, part: usize, blow: Blow) {
        self.inner().conditions.entry(part).or_default().push_back(blow);
    }

    pub(crate) fn next_blow(&self, part: usize) -> Option<Blow> {
        self.inner().conditions.get_mut(&part)?.pop_front()
    }

    pub(crate) fn plug_in(&self, part: usize, is_there: bool) {
        let mut inner = self.inner();
        match is_there {
            true => inner.unplugged.remove(&part),
            false => inner.unplugged.insert(part),
        };
    }

    pub(crate) fn is_unplugged(&self, part: usize) -> bool {
        self.inner().unplugged.contains(&part)
    }

    /// Whether this component comes late, and has not been asked for yet.
    pub(crate) fn is_to_be_added(&self, part: usize) -> bool {
        self.robot.parts[part].late && self.inner().wanted.insert(part)
    }

    pub(crate) fn watches(&self) {
        self.inner().watched = true;
    }

    pub(crate) fn is_watched(&self) -> bool {
        self.inner().watched
    }

    pub(crate) fn refuse(&self, part: usize, why: String) {
        self.inner().refused.push((part, why));
    }

    pub(crate) fn refused(&self) -> Vec<(usize, String)> {
        self.inner().refused.clone()
    }

    pub(crate) fn mark(&self, part: usize, topic: usize, n: u64) {
        self.inner().marks.insert((part, topic), n);
    }

    pub(crate) fn has_mark(&self, part: usize, topic: usize, n: u64) -> bool {
        self.inner().marks.get(&(part, topic)).is_some_and(|latest| *latest >= n)
    }

    pub(crate) fn schedule(&self) -> Scheduled {
        self.inner().scheduled += 1;
        Scheduled(self.clone())
    }

    /// How much has happened, and how much is going to.
    pub(crate) fn progress(&self) -> (usize, usize) {
        let inner = self.inner();
        let happened = inner.entries.iter().filter(|entry| {
            matches!(entry.what, What::Began | What::Struck(_) | What::Returned | What::Dropped)
        });
        (happened.count(), inner.scheduled)
    }

    /// What was to go wrong and has not yet is not going to.
    pub(crate) fn cut(&self) {
        let mut inner = self.inner();
        inner.pulls.clear();
        inner.conditions.clear();
        inner.unplugged.clear();
    }

    /// Notes a request; answers its number.
    pub(crate) fn ask(&self, part: usize, by: Option<(usize, u64)>, deadline_ms: u64) -> u64 {
        let number = self.number();
        let (asked_at, answer) = (now(), None);
        self.inner().asked.push(Asked { number, part, by, asked_at, deadline_ms, answer });
        number
    }

    pub(crate) fn answer(&self, number: u64, answer: Answer) {
        let at = now();
        let mut inner = self.inner();
        if let Some(asked) = inner.asked.iter_mut().find(|asked| asked.number == number) {
            asked.answer = Some((at, answer));
        }
    }

    pub(crate) fn entries(&self) -> Vec<Entry> {
        self.inner().entries.clone()
    }

    pub(crate) fn asked(&self) -> Vec<Asked> {
        self.inner().asked.clone()
    }
}
