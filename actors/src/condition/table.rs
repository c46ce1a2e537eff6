//! The conditions of one node: drives their machines, and reports their changes.

use super::echo;
use super::source::{ChannelSource, ConditionWiring, SharedReadings};
use super::spec::{ChannelSpec, Connected, ConnectedChannel, LOOK_INTERVAL, TIMEOUT};
use super::{Condition, ConditionError, ConditionStatus, object_of};
use crate::component::environment::ComponentEnvironment;
use crate::platform::lock;
use crate::runtime::guardian::Guardian;
use crate::runtime::reports::FaultReports;
use crate::runtime::timekeeper::Timekeeper;
use crate::settings::{CONDITION_TIMEOUT, CONDITION_WINDOW};
use crate::topic::Topics;
use actix::prelude::{ArbiterHandle, Recipient};
use blastema_contract::reports::{AreYouAlive, DeclaredFaultCleared, FaultDeclared};
use blastema_core::connection::{Combination, ConditionState, ConnectionJudge};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, Instant, ObjectName};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
use std::time::Duration;
use tokio::sync::watch;
use tracing::info;

/// More than a robot has operators, nodes and topics to depend on.
const CONDITIONS_MAX: usize = 256;

/// The conditions of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Conditions(Arc<Shared>);

#[derive(Default)]
struct Shared {
    wiring: OnceLock<ConditionWiring>,
    timekeeper: Timekeeper,
    table: Mutex<ConditionTable>,
}

#[derive(Default)]
struct ConditionTable {
    entries: SortedMap<ObjectName, Entry>,
    shared: SharedReadings,
    ended: bool,
}

struct Entry {
    name: Arc<str>,
    needs: Connected,
    judges: Combination<ConnectionJudge>,
    sources: Vec<ChannelSource>,
    status: watch::Sender<ConditionStatus>,
    /// Until then it need not have been heard.
    expected_by: Instant,
    lost: bool,
    degraded: bool,
    followers: Vec<FollowFn>,
    /// How many leaves of trees look at it; `None` where it lasts as long as the node.
    uses: Option<usize>,
}

/// A leaf of a tree looks at a condition, which ends with the last such use, unless it was declared
/// for the node.
#[cfg(feature = "trees")]
pub(crate) struct ConditionUse(pub(crate) Conditions, pub(crate) Condition);

#[cfg(feature = "trees")]
impl Drop for ConditionUse {
    fn drop(&mut self) {
        let ConditionUse(conditions, condition) = self;
        let (Ok(object), Some(wiring)) = (object_of(condition.name()), conditions.0.wiring.get())
        else {
            return;
        };
        let mut table = conditions.lock();
        let Some(entry) = table.entries.get_mut(&object) else { return };
        entry.uses = entry.uses.map(|uses| uses - 1);
        if entry.uses == Some(0) {
            // Its faults end with it; what watched it is not woken.
            let status = entry.status.borrow().clone();
            entry.status = watch::Sender::new(status);
            let (state, cause) = (ConditionState::Connected, "no leaf looks at it any more");
            entry.report(&object, state, cause, &wiring.reports, crate::platform::now());
            table.entries.remove(&object);
        }
    }
}

/// Acts on how a condition is, and on the time. Says when it wants to do so again.
pub(crate) type FollowFn =
    Arc<dyn Fn(ConditionState, &str, Instant) -> Option<Instant> + Send + Sync>;

impl Conditions {
    /// Looks at the conditions from now on. Says where the actor that does can be asked whether it
    /// lives.
    pub(crate) fn start(
        &self,
        wiring: ConditionWiring,
        name: ObjectName,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Recipient<AreYouAlive> {
        echo::serve(&wiring.registry);
        // A table is started once, with its node.
        let _ = self.0.wiring.set(wiring);
        let conditions = self.clone();
        let look = move |now| conditions.look(now);
        self.0.timekeeper.start(look, name, guardian, arbiter)
    }

    /// The node ends, and its conditions with it.
    pub(crate) fn end(&self) {
        let mut table = self.lock();
        table.ended = true;
        table.entries.clear();
    }

    fn lock(&self) -> MutexGuard<'_, ConditionTable> {
        lock(&self.0.table)
    }

    /// The condition of this name, which needs this. It is declared if it is new, and lasts as long
    /// as the node, or as long as it is used where it is declared for one use.
    pub(crate) fn declare(
        &self,
        name: &str,
        needs: &Connected,
        now: Instant,
        uses: Option<usize>,
    ) -> Result<Condition, ConditionError> {
        let object = object_of(name)?;
        let refused = |reason: String| {
            let condition = name.to_owned();
            ConditionError::Refused { condition, place: None, reason }
        };
        let mut table = self.lock();
        let (Some(wiring), false) = (self.0.wiring.get(), table.ended) else {
            return Err(refused("the node has ended".to_owned()));
        };
        if let Some(known) = table.entries.get_mut(&object) {
            if known.needs != *needs {
                return Err(ConditionError::Taken { condition: name.to_owned() });
            }
            known.uses = known.uses.zip(uses).map(|(known, one)| known + one);
            return Ok(known.condition());
        }
        if table.entries.len() >= CONDITIONS_MAX {
            let reason = format!("the node has {CONDITIONS_MAX} already: use one of them");
            return Err(refused(reason));
        }
        let default = wiring.timeout.unwrap_or(TIMEOUT);
        let (mut sources, mut timeout) = (Vec::new(), Duration::ZERO);
        let judges = needs.try_map(name, &mut |spec, channel| {
            sources.push(ChannelSource::open(spec, channel, wiring, &object)?);
            let within = spec.rate.map_or(spec.timeout.unwrap_or(default), |(_, window)| window);
            timeout = timeout.max(within);
            Ok(ConnectionJudge::new(channel.to_string(), spec.rules(default)))
        })?;
        let cause = "nothing was measured yet".to_owned();
        let status = ConditionStatus { state: ConditionState::Lost, since: now, cause };
        let entry = Entry {
            name: name.into(),
            needs: needs.clone(),
            expected_by: now + timeout,
            judges,
            sources,
            status: watch::Sender::new(status),
            lost: false,
            degraded: false,
            followers: Vec::new(),
            uses,
        };
        let condition = entry.condition();
        table.entries.insert(object, entry);
        drop(table);
        self.0.timekeeper.look();
        Ok(condition)
    }

    /// Has a condition followed that is declared, from now on.
    pub(crate) fn follow(&self, condition: &Condition, follow: FollowFn) {
        let mut table = self.lock();
        let mut entries = table.entries.values_mut();
        if let Some(entry) = entries.find(|entry| *entry.name == *condition.name()) {
            entry.followers.push(follow);
        }
    }

    /// What follows a condition has something to do.
    pub(crate) fn look_soon(&self) {
        self.0.timekeeper.look();
    }

    /// Judges all conditions, and says when they want to be looked at again.
    fn look(&self, now: Instant) -> Option<Instant> {
        let wiring = self.0.wiring.get()?;
        let mut table = self.lock();
        let ConditionTable { entries, shared, .. } = &mut *table;
        if entries.values().flat_map(|entry| &entry.sources).any(ChannelSource::needs_rows) {
            shared.read_rows(wiring, now);
        }
        let (mut next, mut followed) = (now + LOOK_INTERVAL, Vec::new());
        for (object, entry) in entries.iter_mut() {
            let mut sources = entry.sources.iter_mut();
            entry.judges.for_each(&mut |judge| {
                let source = sources.next().expect("each channel has a source");
                judge.handle_reading(&source.read(wiring, shared, now), now);
            });
            let (state, cause) = (entry.judges.state(), entry.judges.cause());
            entry.report(object, state, &cause, &wiring.reports, now);
            next = entry.judges.poll_timeout().map_or(next, |due| next.min(due));
            let followers = entry.followers.iter().cloned();
            followed.extend(followers.map(|follow| (follow, state, cause.clone())));
        }
        let is_empty = entries.is_empty();
        drop(table);
        for (follow, state, cause) in followed {
            next = follow(state, &cause, now).map_or(next, |due| next.min(due));
        }
        (!is_empty).then_some(next)
    }
}

impl Entry {
    fn condition(&self) -> Condition {
        Condition { name: self.name.clone(), status: self.status.subscribe() }
    }

    /// Reports what the condition is now to its holders, and as faults.
    fn report(
        &mut self,
        object: &ObjectName,
        state: ConditionState,
        cause: &str,
        reports: &FaultReports,
        now: Instant,
    ) {
        let mut was_connected = false;
        self.status.send_if_modified(|status| {
            let changed = status.state != state;
            was_connected = changed && status.state != ConditionState::Lost;
            if changed {
                (status.state, status.since) = (state, now);
            }
            cause.clone_into(&mut status.cause);
            changed
        });
        let is_lost = state == ConditionState::Lost;
        let lost = is_lost && (self.lost || was_connected || now >= self.expected_by);
        let faults = [
            (&mut self.lost, lost, FaultKind::ConnectionLost),
            (&mut self.degraded, state == ConditionState::Degraded, FaultKind::CheckFailed),
        ];
        for (known, found, kind) in faults {
            if std::mem::replace(known, found) == found {
                continue;
            }
            // It belongs to the node, and has one incarnation, whatever becomes of its actor.
            let (object, incarnation) = (object.clone(), Incarnation::FIRST);
            match found {
                true => {
                    let detail = cause.to_owned();
                    reports.send(FaultDeclared { object, incarnation, kind, detail, hold: None });
                }
                false => reports.send_cleared(DeclaredFaultCleared { object, incarnation, kind }),
            }
            // Last: a log may block.
            info!(condition = &*self.name, %state, "{cause}");
        }
    }
}

impl Connected {
    /// Finds what cannot be judged on this node, for the condition of this name.
    pub(crate) fn check(
        &self,
        condition: &str,
        environment: &ComponentEnvironment,
    ) -> Result<(), ConditionError> {
        let topics = environment.feature::<Topics>();
        let object = object_of(condition)?;
        let tap = &mut |_: &_, channel: &ConnectedChannel| {
            channel.tap(topics, &environment.registry, &object, Arc::default()).map(drop)
        };
        self.try_map(condition, tap).map(drop)
    }

    /// What is made of each channel that can be judged.
    fn try_map<T>(
        &self,
        condition: &str,
        make: &mut impl FnMut(&ChannelSpec, &ConnectedChannel) -> Result<T, String>,
    ) -> Result<Combination<T>, ConditionError> {
        let refused = |place, reason| {
            let condition = condition.to_owned();
            ConditionError::Refused { condition, place, reason }
        };
        let mut places = 0..;
        let mut checked = |spec: &ChannelSpec| {
            let place = places.next().unwrap_or_default();
            let at = |setting| move |reason| refused(Some((place, setting)), reason);
            let channel = spec.channel.as_ref().map_err(|error| at("")(error.to_string()))?;
            check(spec, channel).map_err(|(setting, reason)| at(setting)(reason))?;
            make(spec, channel).map_err(at(""))
        };
        self.0.try_map(&mut checked, &|least, all| {
            let reason = format!(
                "{least} of {all} channels are no condition: write 1 to the number of channels"
            );
            refused(None, reason)
        })
    }
}

/// Finds a setting that cannot be judged.
fn check(spec: &ChannelSpec, channel: &ConnectedChannel) -> Result<(), (&'static str, String)> {
    if let Some(limit) = spec.unmeasured(channel) {
        let figure = limit.trim_start_matches("max_");
        return Err((limit, format!("the {figure} of {channel} is not measured: {CURE}")));
    }
    if spec.limits.loss_permille.is_some_and(|most| most > 1000) {
        return Err(("max_loss", "its largest loss is no share: write 0.0 to 1.0".to_owned()));
    }
    let timeout = spec.timeout.map_or(Ok(()), |timeout| CONDITION_TIMEOUT.check(timeout));
    timeout.map_err(|error| ("timeout", error.to_string()))?;
    for (hz, window) in spec.rate.into_iter().chain(spec.limits.rate) {
        CONDITION_WINDOW.check(window).map_err(|error| ("window", error.to_string()))?;
        if !(hz.is_finite() && hz > 0.0 && hz * window.as_secs_f64() >= 1.0) {
            let reason = format!(
                "{hz} messages a second in {window:?} are less than one: write a greater rate or a \
                 longer window"
            );
            return Err(("rate", reason));
        }
    }
    Ok(())
}

/// What to write where a figure is not measured.
const CURE: &str = "limit it on a heartbeat, or leave the limit out";
