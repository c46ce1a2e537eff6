//! The conditions of one node: drives their machines, and reports their changes.

#[cfg(feature = "network")]
use super::echo;
use super::source::{ChannelSource, ConditionWiring, SharedReadings};
use super::spec::{ChannelSpec, Connected, ConnectedPart, TIMEOUT};
use super::{Condition, ConditionError, ConditionStatus, object_of};
use crate::component::environment::ComponentEnvironment;
use crate::component::extension::Extension;
use crate::platform;
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use crate::runtime::reports::FaultReports;
use crate::settings::{CONDITION_TIMEOUT, CONDITION_WINDOW, SettingError};
use actix::prelude::*;
use blastema_contract::reports::{AreYouAlive, DeclaredFaultCleared, FaultDeclared};
use blastema_core::connection::{
    Combination, ConditionState, ConnectionCondition, ConnectionJudge, Presence, TopicEstimator,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, Instant, ObjectName};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;
use tokio::sync::watch;
use tracing::info;

/// How often conditions are looked at; the end of a timeout is looked at exactly. More often finds
/// what is restored sooner.
const LOOK_INTERVAL: Duration = Duration::from_millis(50);
/// More than a robot has operators, nodes and topics to depend on.
const CONDITIONS_MAX: usize = 256;

/// The conditions of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Conditions(Arc<Shared>);

#[derive(Default)]
struct Shared {
    wiring: OnceLock<ConditionWiring>,
    actor: OnceLock<Recipient<Look>>,
    table: Mutex<ConditionTable>,
}

#[derive(Default)]
struct ConditionTable {
    entries: SortedMap<ObjectName, Entry>,
    shared: SharedReadings,
    ended: bool,
}

/// One condition.
struct Entry {
    name: Arc<str>,
    /// What it needs, as text.
    needs: String,
    machine: ConnectionCondition,
    sources: Vec<ChannelSource>,
    status: watch::Sender<ConditionStatus>,
    /// Until then it need not have been heard.
    expected_by: Instant,
    lost: bool,
    degraded: bool,
}

impl Extension for Conditions {}

impl ComponentEnvironment {
    /// The conditions of the node.
    pub(crate) fn conditions(&self) -> &Conditions {
        self.extensions.get()
    }
}

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
        #[cfg(feature = "network")]
        echo::serve(&wiring.registry);
        let conditions = self.clone();
        // A table is started once, with its node.
        let _ = self.0.wiring.set(wiring);
        let make =
            move |_: &mut Context<ConditionsActor>| ConditionsActor { conditions, armed: None };
        let actor = guardian.start(name, arbiter, make);
        let _ = self.0.actor.set(actor.clone().recipient());
        actor.recipient()
    }

    /// The node ends, and its conditions with it.
    pub(crate) fn end(&self) {
        let mut table = self.lock();
        table.ended = true;
        table.entries.clear();
    }

    fn lock(&self) -> MutexGuard<'_, ConditionTable> {
        self.0.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The condition of this name, which needs this. It is declared if it is new, and lasts as long
    /// as the node.
    pub(crate) fn declare(
        &self,
        name: &str,
        needs: &Connected,
        now: Instant,
    ) -> Result<Condition, ConditionError> {
        let (object, described) = (object_of(name)?, format!("{needs:?}"));
        let refused = |reason: String| {
            let condition = name.to_owned();
            Err(ConditionError::Refused { condition, reason })
        };
        let (Some(wiring), false) = (self.0.wiring.get(), self.lock().ended) else {
            return refused("the node has ended".to_owned());
        };
        if let Some(known) = self.lock().entries.get(&object) {
            return match known.needs == described {
                true => Ok(known.condition()),
                false => Err(ConditionError::Taken { condition: name.to_owned() }),
            };
        }
        if self.lock().entries.len() >= CONDITIONS_MAX {
            return refused(format!("the node has {CONDITIONS_MAX} already: use one of them"));
        }
        let mut parts = Parts {
            wiring,
            condition: name,
            object: &object,
            judges: Vec::new(),
            sources: Vec::new(),
            patience: Duration::ZERO,
        };
        let combination = parts.add(needs)?;
        let expected_by = now + parts.patience;
        let machine = ConnectionCondition::new(parts.judges, combination);
        let cause = "nothing was measured yet".to_owned();
        let status = ConditionStatus { state: ConditionState::Lost, since: now, cause };
        let entry = Entry {
            name: name.into(),
            needs: described,
            machine,
            sources: parts.sources,
            status: watch::Sender::new(status),
            expected_by,
            lost: false,
            degraded: false,
        };
        let mut table = self.lock();
        // Another thread may have declared the same meanwhile.
        let condition = match table.entries.get(&object) {
            Some(known) => known.condition(),
            None => {
                let condition = entry.condition();
                table.entries.insert(object, entry);
                condition
            }
        };
        drop(table);
        if let Some(actor) = self.0.actor.get() {
            actor.do_send(Look);
        }
        Ok(condition)
    }

    /// Judges all conditions, and says when they want to be looked at again.
    fn look(&self, now: Instant) -> Option<Instant> {
        let wiring = self.0.wiring.get()?;
        let mut table = self.lock();
        let ConditionTable { entries, shared, .. } = &mut *table;
        #[cfg(feature = "network")]
        if entries.values().flat_map(|entry| &entry.sources).any(ChannelSource::needs_rows) {
            shared.read_rows(wiring, now);
        }
        let mut next: Option<Instant> = None;
        for (object, entry) in entries.iter_mut() {
            let read = |source: &mut ChannelSource| source.read(wiring, shared, now);
            let readings: Vec<_> = entry.sources.iter_mut().map(read).collect();
            entry.machine.handle_readings(&readings, now);
            entry.report(object, &wiring.reports, now);
            let due = entry.machine.poll_timeout().into_iter().chain([now + LOOK_INTERVAL]);
            next = next.into_iter().chain(due).min();
        }
        next
    }
}

impl Entry {
    fn condition(&self) -> Condition {
        Condition { name: self.name.clone(), status: self.status.subscribe() }
    }

    /// Reports what the condition is now to its holders, and as faults.
    fn report(&mut self, object: &ObjectName, reports: &FaultReports, now: Instant) {
        let (state, cause) = (self.machine.state(), self.machine.cause());
        let mut was_connected = false;
        self.status.send_if_modified(|status| {
            let changed = status.state != state;
            was_connected = changed && status.state != ConditionState::Lost;
            if changed {
                (status.state, status.since) = (state, now);
            }
            status.cause.clone_from(&cause);
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
            match (found, &reports.faults, &reports.cleared) {
                (true, Some(faults), _) => {
                    let detail = cause.clone();
                    faults.do_send(FaultDeclared { object, incarnation, kind, detail });
                }
                (false, _, Some(cleared)) => {
                    cleared.do_send(DeclaredFaultCleared { object, incarnation, kind });
                }
                _ => {}
            }
            // Last: a log may block.
            info!(condition = &*self.name, %state, "{cause}");
        }
    }
}

/// Collects the channels of a condition.
struct Parts<'a> {
    wiring: &'a ConditionWiring,
    condition: &'a str,
    object: &'a ObjectName,
    judges: Vec<ConnectionJudge>,
    sources: Vec<ChannelSource>,
    /// How long the slowest of its channels may be silent.
    patience: Duration,
}

impl Parts<'_> {
    fn add(&mut self, needs: &Connected) -> Result<Combination, ConditionError> {
        match &needs.0 {
            ConnectedPart::Channel(spec) => {
                self.check(spec)?;
                self.add_channel(spec)
            }
            ConnectedPart::AtLeast(least, of) => {
                if !(1..=of.len()).contains(least) {
                    let what = format!(
                        "{least} of {} channels are no condition: write 1 to the number of \
                         channels that follow",
                        of.len()
                    );
                    return Err(self.wrong(what));
                }
                let of = of.iter().map(|part| self.add(part)).collect::<Result<_, _>>()?;
                Ok(Combination::AtLeast { least: *least, of })
            }
        }
    }

    fn add_channel(&mut self, spec: &ChannelSpec) -> Result<Combination, ConditionError> {
        let measured = Arc::<Mutex<TopicEstimator>>::default();
        let condition = || self.condition.to_owned();
        let source = ChannelSource::new(spec, measured.clone())
            .map_err(|error| ConditionError::Name { condition: condition(), error })?;
        let listens = spec.channel.listen(&self.wiring.topics, self.object, measured);
        listens.map_err(|why| self.wrong(why.to_string()))?;
        let rules = spec.rules(self.wiring.timeout.unwrap_or(TIMEOUT));
        self.patience = self.patience.max(match rules.presence {
            Presence::Heard { timeout } => timeout,
            Presence::Rate { window, .. } => window,
        });
        self.judges.push(ConnectionJudge::new(spec.channel.to_string(), rules));
        self.sources.push(source);
        Ok(Combination::Channel(self.sources.len() - 1))
    }

    fn check(&self, spec: &ChannelSpec) -> Result<(), ConditionError> {
        if let Some(figure) = spec.figures().find(|figure| !spec.channel.has(*figure)) {
            let what = format!("the {figure} of {} is not measured: {}", spec.channel, CURE);
            return Err(self.wrong(what));
        }
        if let Some(timeout) = spec.timeout {
            let checked = CONDITION_TIMEOUT.check(timeout);
            checked.map_err(|error| self.wrong(text_of(&error)))?;
        }
        for (hz, window) in spec.rate.into_iter().chain(spec.limits.rate) {
            CONDITION_WINDOW.check(window).map_err(|error| self.wrong(text_of(&error)))?;
            if !(hz.is_finite() && hz > 0.0 && hz * window.as_secs_f64() >= 1.0) {
                let what = format!(
                    "{hz} messages a second in {window:?} are less than one: write a greater rate \
                     or a longer window"
                );
                return Err(self.wrong(what));
            }
        }
        Ok(())
    }

    fn wrong(&self, reason: String) -> ConditionError {
        ConditionError::Refused { condition: self.condition.to_owned(), reason }
    }
}

fn text_of(SettingError { setting, value, cure }: &SettingError) -> String {
    format!("{setting} {value} makes no sense: {cure}")
}

/// What to write where a figure is not measured.
const CURE: &str = "limit it on a heartbeat, or leave the limit out";

/// Conditions have changed: look when to be up next.
#[derive(Message)]
#[rtype(result = "()")]
struct Look;

/// Looks at the conditions in time.
struct ConditionsActor {
    conditions: Conditions,
    armed: Option<SpawnHandle>,
}

impl ConditionsActor {
    fn look(&mut self, context: &mut Context<Self>) {
        let Some(due) = self.conditions.look(platform::now()) else { return };
        if let Some(armed) = self.armed.take() {
            context.cancel_future(armed);
        }
        let timer = tokio::time::sleep_until(platform::timer_at(due));
        let timer = actix::fut::wrap_future::<_, Self>(timer);
        let timer = timer.map(|(), actor: &mut Self, context| {
            actor.armed = None;
            actor.look(context);
        });
        self.armed = Some(context.spawn(timer));
    }
}

answers_the_monitor!(ConditionsActor);

impl Actor for ConditionsActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.armed = None;
        self.look(context);
    }
}

impl Supervised for ConditionsActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.started(context);
    }
}

impl Handler<Look> for ConditionsActor {
    type Result = ();

    fn handle(&mut self, _: Look, context: &mut Context<Self>) {
        self.look(context);
    }
}
