//! The variables of one node's objects: values that any node may read, write and watch.
//!
//! A variable belongs to an object and outlives its incarnations; what becomes of the value when an
//! incarnation ends is the owner's choice. Several are written together or not at all. Values are
//! bytes here: what they mean is for those who read and write.
//!
//! Every change has a revision, which rises over all variables and over the incarnations of the
//! node, so that "has it changed since?" has an answer whatever happened in between.

use crate::contract::layout::{Described, Field, Fields, Layout, Shape, Variant, describe};
use crate::sorted::SortedMap;
use crate::{Blob, DeliveryError, Instant, ObjectName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::any::TypeId;
use std::borrow::Cow;
use std::collections::VecDeque;
use std::time::Duration;

/// Watchers that may wait for one node's variables: more than a robot has consoles and planners.
const WATCHERS_MAX: usize = 4096;
/// Variables that may be written together: all that one movement sets, several times over.
const WRITES_MAX: usize = 256;
/// A watcher that has not asked again for so long has gone.
const WATCHER_TIMEOUT: Duration = Duration::from_secs(10);

/// What becomes of a variable's value when an incarnation of its owner ends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RestorePolicy {
    /// It stays: the next incarnation goes on with it.
    #[default]
    Restore,
    /// It becomes the default, as at the start.
    Default,
    /// It stays, and is marked as held until it is written again.
    Hold,
    /// No reader or writer is answered until a user has decided what it is to be.
    AskFirst,
}

/// How far a value can be relied on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ValueState {
    /// It was written, or is the default.
    Current,
    /// It was written before an incarnation of its owner ended, and not since.
    Held,
    /// It is the last one that was written before an incarnation of its owner ended; whether it is
    /// to be used awaits a decision.
    Undecided,
}

/// A variable as it stands; of a write, its revision only.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ValueReport {
    /// The encoded value. All reports of one change share its bytes.
    pub value: Blob,
    /// The number of the change that gave the value; rises.
    pub revision: u64,
    /// How far it can be relied on.
    pub state: ValueState,
    /// For how long it has stood so.
    pub age: Duration,
}

describe! { enum ValueState { Current, Held, Undecided } }
describe! {
    struct ValueReport { value: Blob, revision: u64, state: ValueState, age: Duration }
}

/// Which variable: its owner, and the name of its contract.
pub type VariableKey = (ObjectName, String);

/// One value to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ValueWrite {
    /// The variable to write.
    pub variable: VariableKey,
    /// What; `None` leaves the value that was there before a decision on it was awaited.
    pub value: Option<Bytes>,
    /// Only if this is still the variable's revision.
    pub if_revision: Option<u64>,
}

/// A variable as its owner declares it.
#[derive(Clone, Debug)]
pub struct VariableDeclaration<F> {
    /// Its value until it is written.
    pub default: Bytes,
    /// What becomes of it when an incarnation of its owner ends.
    pub policy: RestorePolicy,
    /// What else is known of it.
    pub facts: F,
}

/// A value as it is kept for the node's next process.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PersistedValue {
    /// The variable that had the value.
    pub variable: VariableKey,
    /// Of the contract under which it was written: under another, its bytes mean something else.
    pub fingerprint: u64,
    /// The encoded value.
    pub value: Vec<u8>,
}

/// A watcher that asked, and what has become of the variable.
pub type WatchReport<W> = (W, Result<ValueReport, DeliveryError>);

/// The variables of one node: facts `F` are known of each, and watchers `W` are answered.
#[derive(Debug)]
pub struct Variables<F, W> {
    entries: SortedMap<VariableKey, Entry<F>>,
    last_revision: u64,
    watchers: Vec<VariableWatcher<W>>,
    outputs: VecDeque<WatchReport<W>>,
}

#[derive(Debug)]
struct Entry<F> {
    declaration: VariableDeclaration<F>,
    value: Bytes,
    revision: u64,
    state: ValueState,
    since: Instant,
}

#[derive(Debug)]
struct VariableWatcher<W> {
    watcher: W,
    variable: VariableKey,
    asked: Instant,
}

impl<F, W> Variables<F, W> {
    /// No variables yet. Revisions are above this one; let it rise with every incarnation of the
    /// node.
    pub fn new(last_revision: u64) -> Self {
        Variables {
            entries: SortedMap::new(),
            last_revision,
            watchers: Vec::new(),
            outputs: VecDeque::new(),
        }
    }

    /// The next watcher to be answered.
    pub fn poll_output(&mut self) -> Option<WatchReport<W>> {
        self.outputs.pop_front()
    }

    /// An object has this variable from now on. `kept` is its value from before the node's process
    /// began: what is left of it is what an incarnation's end would have left.
    pub fn handle_declared(
        &mut self,
        variable: VariableKey,
        declared: VariableDeclaration<F>,
        kept: Option<Bytes>,
        now: Instant,
    ) {
        self.last_revision += 1;
        let entry = Entry {
            value: declared.default.clone(),
            declaration: declared,
            revision: self.last_revision,
            state: ValueState::Current,
            since: now,
        };
        self.entries.insert(variable.clone(), entry);
        if kept.is_some() {
            self.set(&variable, kept, ValueState::Current, now);
            self.end_incarnation_of(&variable, now);
        }
    }

    /// What is worth keeping for the next process.
    pub fn kept(&self) -> impl Iterator<Item = (&VariableKey, &F, &Bytes)> {
        let restored = |entry: &Entry<F>| entry.declaration.policy != RestorePolicy::Default;
        let entries = self.entries.iter().filter(move |(_, entry)| restored(entry));
        entries.map(|(variable, entry)| (variable, &entry.declaration.facts, &entry.value))
    }

    /// The variables, in order.
    pub fn keys(&self) -> impl Iterator<Item = &VariableKey> {
        self.entries.keys()
    }

    /// A variable as its owner has declared it.
    pub fn declaration(&self, variable: &VariableKey) -> Option<&VariableDeclaration<F>> {
        self.entries.get(variable).map(|entry| &entry.declaration)
    }

    /// An object has gone for good.
    pub fn handle_withdrawn(&mut self, object: &ObjectName) {
        self.entries.retain(|(owner, _), _| owner != object);
        self.answer(
            |watcher| &watcher.variable.0 == object,
            |watcher| Err(unknown(&watcher.variable)),
        );
    }

    /// Reads a variable.
    ///
    /// # Errors
    /// [`DeliveryError::Unknown`], and [`DeliveryError::Undecided`] while a decision is awaited.
    pub fn read(&self, variable: &VariableKey, now: Instant) -> Result<ValueReport, DeliveryError> {
        let entry = self.entries.get(variable).ok_or_else(|| unknown(variable))?;
        entry.check(variable)?;
        Ok(entry.report(now))
    }

    /// A watcher wants to know as soon as the variable's revision is another than `after`.
    pub fn handle_watch(&mut self, watcher: W, variable: VariableKey, after: u64, now: Instant) {
        let result = match self.entries.get(&variable) {
            None => Err(unknown(&variable)),
            Some(entry) if entry.revision != after => Ok(entry.report(now)),
            Some(_) => {
                // Those who went without a word make room.
                let stale = |known: &VariableWatcher<W>| now - known.asked > WATCHER_TIMEOUT;
                self.answer(stale, |_| Err(DeliveryError::DeadlinePassed));
                if self.watchers.len() < WATCHERS_MAX {
                    self.watchers.push(VariableWatcher { watcher, variable, asked: now });
                    return;
                }
                Err(DeliveryError::Full)
            }
        };
        self.outputs.push_back((watcher, result));
    }

    /// Only these watchers wait still.
    pub fn retain_watchers(&mut self, waits: impl Fn(&W) -> bool) {
        self.watchers.retain(|known| waits(&known.watcher));
    }

    /// How many watchers wait.
    pub fn watchers(&self) -> usize {
        self.watchers.len()
    }

    /// Writes all of these, or none. Where the values decide, a decision must be awaited of each;
    /// elsewhere of none.
    ///
    /// # Errors
    /// The first thing that stands in the way; nothing is written then. Among others
    /// [`DeliveryError::Changed`] where no decision is awaited, or not any more.
    pub fn handle_write(
        &mut self,
        writes: Vec<ValueWrite>,
        decides: bool,
        now: Instant,
    ) -> Result<u64, DeliveryError> {
        if writes.len() > WRITES_MAX {
            return Err(DeliveryError::TooLarge { limit: WRITES_MAX });
        }
        for ValueWrite { variable, if_revision, .. } in &writes {
            let entry = self.entries.get(variable).ok_or_else(|| unknown(variable))?;
            if !decides {
                entry.check(variable)?;
            }
            let is_decided = decides && entry.state != ValueState::Undecided;
            if is_decided || if_revision.is_some_and(|wanted| wanted != entry.revision) {
                let variable = shown(variable);
                return Err(DeliveryError::Changed { variable, revision: entry.revision });
            }
        }
        self.last_revision += 1;
        for ValueWrite { variable, value, .. } in writes {
            self.set(&variable, value, ValueState::Current, now);
        }
        Ok(self.last_revision)
    }

    /// An incarnation of the owner has ended: each variable becomes what its policy says.
    pub fn handle_owner_ended(&mut self, object: &ObjectName, now: Instant) {
        let keys: Vec<_> = self.keys().filter(|key| &key.0 == object).cloned().collect();
        keys.iter().for_each(|key| self.end_incarnation_of(key, now));
    }

    fn end_incarnation_of(&mut self, key: &VariableKey, now: Instant) {
        let Some(entry) = self.entries.get(key) else { return };
        let (value, state) = match entry.declaration.policy {
            RestorePolicy::Restore => return,
            RestorePolicy::Default => {
                (Some(entry.declaration.default.clone()), ValueState::Current)
            }
            RestorePolicy::Hold => (None, ValueState::Held),
            RestorePolicy::AskFirst => (None, ValueState::Undecided),
        };
        self.last_revision += 1;
        self.set(key, value, state, now);
    }

    fn set(&mut self, key: &VariableKey, value: Option<Bytes>, state: ValueState, now: Instant) {
        let Some(entry) = self.entries.get_mut(key) else { return };
        if let Some(value) = value {
            entry.value = value;
        }
        entry.state = state;
        entry.revision = self.last_revision;
        entry.since = now;
        let report = entry.report(now);
        let waited = |watcher: &VariableWatcher<W>| watcher.variable == *key;
        self.answer(waited, |_| Ok(report.clone()));
    }

    /// Tells those watchers of whom this holds, once.
    fn answer(
        &mut self,
        whom: impl Fn(&VariableWatcher<W>) -> bool,
        what: impl Fn(&VariableWatcher<W>) -> Result<ValueReport, DeliveryError>,
    ) {
        for known in self.watchers.extract_if(.., |known| whom(known)) {
            let result = what(&known);
            self.outputs.push_back((known.watcher, result));
        }
    }
}

impl<F> Entry<F> {
    fn check(&self, variable: &VariableKey) -> Result<(), DeliveryError> {
        match self.state {
            ValueState::Undecided => Err(DeliveryError::Undecided { variable: shown(variable) }),
            ValueState::Current | ValueState::Held => Ok(()),
        }
    }

    fn report(&self, now: Instant) -> ValueReport {
        ValueReport {
            value: self.value.clone().into(),
            revision: self.revision,
            state: self.state,
            age: now - self.since,
        }
    }
}

fn shown((object, variable): &VariableKey) -> String {
    format!("{variable} of {object}")
}

fn unknown(variable: &VariableKey) -> DeliveryError {
    DeliveryError::Unknown { name: shown(variable) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Instant = Instant::from_millis(5);

    fn key(variable: &str) -> VariableKey {
        (ObjectName::new("arm").unwrap(), variable.into())
    }

    fn value(byte: u8) -> Bytes {
        Bytes::copy_from_slice(&[byte])
    }

    fn write(variable: &str, byte: u8) -> ValueWrite {
        ValueWrite { variable: key(variable), value: Some(value(byte)), if_revision: None }
    }

    type Numbered = Variables<(), u64>;

    fn declared(all: &[(&str, RestorePolicy)]) -> Numbered {
        let mut variables = Variables::new(100);
        for &(name, policy) in all {
            let declaration = VariableDeclaration { default: value(0), policy, facts: () };
            variables.handle_declared(key(name), declaration, None, NOW);
        }
        variables
    }

    fn now_is(variables: &Numbered, name: &str) -> Result<(u8, ValueState), DeliveryError> {
        variables.read(&key(name), NOW).map(|report| (report.value[0], report.state))
    }

    #[test]
    fn each_policy_says_what_is_left_when_the_owner_dies() {
        let policies = [
            ("speed", RestorePolicy::Restore),
            ("torque", RestorePolicy::Default),
            ("height", RestorePolicy::Hold),
            ("target", RestorePolicy::AskFirst),
        ];
        let mut variables = declared(&policies);
        let all = policies.iter().map(|(name, _)| write(name, 7)).collect();
        variables.handle_write(all, false, NOW).unwrap();

        variables.handle_owner_ended(&ObjectName::new("arm").unwrap(), NOW);

        assert_eq!(now_is(&variables, "speed"), Ok((7, ValueState::Current)));
        assert_eq!(now_is(&variables, "torque"), Ok((0, ValueState::Current)));
        assert_eq!(now_is(&variables, "height"), Ok((7, ValueState::Held)));
        let undecided = Err(DeliveryError::Undecided { variable: "target of arm".into() });
        assert_eq!(now_is(&variables, "target"), undecided);
        variables.handle_write(vec![write("height", 8)], false, NOW).unwrap();
        assert_eq!(now_is(&variables, "height"), Ok((8, ValueState::Current)));
    }

    #[test]
    fn what_was_kept_over_the_process_is_left_as_each_policy_says() {
        let expected = [
            (RestorePolicy::Restore, Ok((7, ValueState::Current))),
            (RestorePolicy::Default, Ok((0, ValueState::Current))),
            (RestorePolicy::Hold, Ok((7, ValueState::Held))),
            (
                RestorePolicy::AskFirst,
                Err(DeliveryError::Undecided { variable: "it of arm".into() }),
            ),
        ];
        for (policy, left) in expected {
            let mut variables = Numbered::new(100);
            let declaration = VariableDeclaration { default: value(0), policy, facts: () };
            variables.handle_declared(key("it"), declaration, Some(value(7)), NOW);

            assert_eq!(now_is(&variables, "it"), left, "{policy:?}");
            let kept: Vec<_> = variables.kept().map(|(_, (), value)| value[0]).collect();
            let worth = policy != RestorePolicy::Default;
            assert_eq!(kept, if worth { vec![7] } else { vec![] }, "{policy:?}");
        }
    }

    #[test]
    fn what_awaits_a_decision_is_not_written_until_somebody_has_decided() {
        for (choice, left) in [(None, 7), (Some(value(3)), 3)] {
            let mut variables = declared(&[("target", RestorePolicy::AskFirst)]);
            variables.handle_write(vec![write("target", 7)], false, NOW).unwrap();
            variables.handle_owner_ended(&ObjectName::new("arm").unwrap(), NOW);

            let early = variables.handle_write(vec![write("target", 9)], false, NOW);
            assert!(matches!(early, Err(DeliveryError::Undecided { .. })), "{early:?}");
            let choice = || vec![ValueWrite { value: choice.clone(), ..write("target", 0) }];
            variables.handle_write(choice(), true, NOW).unwrap();

            assert_eq!(now_is(&variables, "target"), Ok((left, ValueState::Current)));
            let again = variables.handle_write(choice(), true, NOW);
            assert!(matches!(again, Err(DeliveryError::Changed { .. })), "{again:?}");
        }
    }

    #[test]
    fn several_are_written_together_or_not_at_all() {
        let mut variables =
            declared(&[("speed", RestorePolicy::Restore), ("torque", RestorePolicy::Restore)]);
        let before = variables.read(&key("torque"), NOW).unwrap().revision;

        let unknown = variables.handle_write(vec![write("speed", 1), write("heat", 1)], false, NOW);
        assert!(matches!(unknown, Err(DeliveryError::Unknown { .. })));
        let late = ValueWrite { if_revision: Some(before - 1), ..write("torque", 1) };
        let changed = variables.handle_write(vec![write("speed", 1), late], false, NOW);
        assert!(matches!(changed, Err(DeliveryError::Changed { .. })));
        assert_eq!(now_is(&variables, "speed"), Ok((0, ValueState::Current)));

        let right = ValueWrite { if_revision: Some(before), ..write("torque", 1) };
        variables.handle_write(vec![write("speed", 1), right], false, NOW).unwrap();
        assert_eq!(now_is(&variables, "speed"), Ok((1, ValueState::Current)));
        assert_eq!(now_is(&variables, "torque"), Ok((1, ValueState::Current)));
    }

    #[test]
    fn a_watcher_is_told_once_of_the_next_change_and_at_once_of_one_it_has_missed() {
        let mut variables = declared(&[("speed", RestorePolicy::Restore)]);
        let first = variables.read(&key("speed"), NOW).unwrap().revision;

        variables.handle_watch(1, key("speed"), first, NOW);
        assert_eq!(variables.poll_output(), None);
        let second = variables.handle_write(vec![write("speed", 1)], false, NOW).unwrap();
        let (watcher, result) = variables.poll_output().unwrap();
        assert_eq!((watcher, result.unwrap().revision), (1, second));
        variables.handle_write(vec![write("speed", 2)], false, NOW).unwrap();
        assert_eq!(variables.poll_output(), None);

        variables.handle_watch(2, key("speed"), second, NOW);
        assert_eq!(variables.poll_output().unwrap().1.unwrap().value[..], [2]);
    }

    #[test]
    fn a_watcher_that_has_gone_is_told_nothing() {
        let mut variables = declared(&[("speed", RestorePolicy::Restore)]);
        let after = variables.read(&key("speed"), NOW).unwrap().revision;
        variables.handle_watch(1, key("speed"), after, NOW);
        variables.handle_watch(2, key("speed"), after, NOW);

        variables.retain_watchers(|&watcher| watcher != 1);
        variables.handle_write(vec![write("speed", 1)], false, NOW).unwrap();

        assert_eq!(variables.poll_output().unwrap().0, 2);
        assert_eq!(variables.poll_output(), None);
    }

    #[test]
    fn watchers_that_went_make_room_and_too_many_are_refused() {
        let mut variables = declared(&[("speed", RestorePolicy::Restore)]);
        let after = variables.read(&key("speed"), NOW).unwrap().revision;
        for watcher in 0..=WATCHERS_MAX as u64 {
            variables.handle_watch(watcher, key("speed"), after, NOW);
        }
        assert_eq!(variables.poll_output().unwrap().1, Err(DeliveryError::Full));

        variables.handle_watch(9999, key("speed"), after, NOW + 2 * WATCHER_TIMEOUT);
        assert_eq!(variables.outputs.len(), WATCHERS_MAX);
        variables.outputs.clear();
        variables.handle_withdrawn(&ObjectName::new("arm").unwrap());
        assert!(matches!(variables.poll_output().unwrap().1, Err(DeliveryError::Unknown { .. })));
    }
}
