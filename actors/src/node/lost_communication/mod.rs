//! What the robot does alone: a ladder in time for each commander that it may lose.
//!
//! ```text
//!  Conditions ─ lost, connected, the time ─► KeptPolicy ─ rung ─► commands actuators
//!  Node::acknowledge ───────────────────────►  (ladder)  └──────► starts a component
//! ```
//!
//! The actor that looks at conditions drives the ladders, beside the fault chain. The table of
//! actuators holds their leases for the policy and gives the commands, as it gives safe commands:
//! neither needs a component but the actuators' own.

mod policy;

pub use policy::{LostCommunicationPolicy, Rung};

use super::Node;
use super::conditions::NodeSlot;
use super::error::{PolicyPart, StartError};
use crate::actuator::{ActuatorKey, ActuatorTable};
use crate::component::environment::ComponentEnvironment;
use crate::condition::Conditions;
use crate::condition::{ConditionError, object_of};
use crate::platform::{self, lock};
use crate::runtime::reports::FaultReports;
use actix::prelude::ArbiterHandle;
use blastema_contract::reports::FaultDeclared;
use blastema_core::connection::{ConditionState, LostCommunication, LostCommunicationOutput};
use blastema_core::lease::CommanderId;
use blastema_core::{FaultKind, Incarnation, Instant, Machine, NodeName, ObjectName};
use bytes::Bytes;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;
use tokio::sync::watch;
use tracing::info;

/// How a policy for lost communication is, from [`Node::lost_communication`].
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct LostCommunicationRow {
    /// The policy, and its condition.
    pub name: String,
    /// The rung that is carried out; `None` while others command.
    pub rung: Option<String>,
    /// Communication is back, and the rung lasts until it is stable or a person acknowledges it.
    pub is_back: bool,
}

/// Why there is nothing to acknowledge.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AcknowledgeError {
    /// The node has no such policy.
    #[error("the node has no policy {name:?} for lost communication: it has {known}")]
    Unknown {
        /// The name that was given.
        name: String,
        /// The policies that it has.
        known: String,
    },
    /// Communication is not back, or was not lost for as long as the first rung takes.
    #[error("the policy {name:?} holds no rung that can end: wait until communication is back")]
    NotBack {
        /// The name of the policy.
        name: String,
    },
}

/// A policy of a node that runs.
pub(super) struct KeptPolicy {
    pub(super) name: String,
    /// The object in which the faults of its condition are found.
    object: ObjectName,
    rungs: Vec<KeptRung>,
    /// By what name the policy holds leases.
    holder: CommanderId,
    commander: Option<NodeName>,
    actuators: ActuatorTable,
    reports: FaultReports,
    ladder: Mutex<LostCommunication>,
    /// The place of the rung that is carried out.
    rung: watch::Sender<Option<usize>>,
    node: NodeSlot,
}

struct KeptRung {
    after: Duration,
    name: String,
    commands: Vec<(ActuatorKey, Bytes)>,
    /// The commander that the component is which it runs.
    runs: Option<String>,
}

impl KeptPolicy {
    /// Lets rungs run components of the node.
    pub(super) fn attach(&self, node: &Node) {
        // Once, when the node is put together.
        let _ = self.node.set(Arc::downgrade(&node.0));
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, LostCommunication> {
        lock(&self.ladder)
    }

    /// Acts on how the condition is, and on the time.
    fn follow(&self, state: ConditionState, cause: &str, now: Instant) -> Option<Instant> {
        let mut ladder = self.lock();
        ladder.handle(state, now);
        let outputs: Vec<_> = std::iter::from_fn(|| ladder.poll_output()).collect();
        let (rung, due) = (ladder.rung(), ladder.poll_timeout());
        drop(ladder);
        for output in outputs {
            match output {
                LostCommunicationOutput::Enter(place) => self.enter(place, state, cause),
                LostCommunicationOutput::End => self.end(),
            }
        }
        // Last: the removal of the component of the rung before begins with this.
        self.rung.send_if_modified(|known| std::mem::replace(known, rung) != rung);
        due
    }

    /// The actuators that the ladder commands.
    fn keys(&self) -> impl Iterator<Item = &ActuatorKey> {
        self.rungs.iter().flat_map(|rung| rung.commands.iter().map(|(key, _)| key))
    }

    fn enter(&self, place: usize, state: ConditionState, cause: &str) {
        let Some(KeptRung { after, name, commands, runs }) = self.rungs.get(place) else { return };
        for (key, command) in commands {
            self.actuators.enter_rung(key, &self.holder, Some(command.clone()), None);
        }
        self.suspend();
        runs.iter().for_each(|component| self.actuators.resume_commander(component));
        let is_commanded = |key: &ActuatorKey| commands.iter().any(|(known, _)| known == key);
        for key in self.keys().filter(|key| !is_commanded(key)) {
            self.actuators.enter_rung(key, &self.holder, None, runs.as_ref());
        }
        let detail = format!("{cause}; after {after:?} the robot begins to {name}");
        info!(policy = self.name, "{detail}");
        // The condition may hold again by now, and its fault be over.
        if state == ConditionState::Lost {
            let (object, incarnation) = (self.object.clone(), Incarnation::FIRST);
            let kind = FaultKind::ConnectionLost;
            self.reports.send(FaultDeclared { object, incarnation, kind, detail, hold: None });
        }
    }

    /// The commander is lost, and components command only while their rungs are carried out.
    fn suspend(&self) {
        let components = self.rungs.iter().filter_map(|rung| rung.runs.as_deref());
        let commanders = components.chain(self.commander.as_ref().map(NodeName::as_str));
        commanders.for_each(|name| self.actuators.suspend(name));
    }

    fn end(&self) {
        self.suspend();
        self.keys().for_each(|key| self.actuators.end_rungs(key));
        if let Some(node) = &self.commander {
            self.actuators.resume_commander(node.as_str());
        }
        info!(policy = self.name, "communication is back: others command again");
    }

    pub(super) fn row(&self) -> LostCommunicationRow {
        let is_back = self.lock().is_back();
        let rung = self.rung.borrow().and_then(|place| Some(self.rungs.get(place)?.name.clone()));
        LostCommunicationRow { name: self.name.clone(), rung, is_back }
    }
}

impl LostCommunicationPolicy {
    /// What cannot work on this node, or beside the policies before it.
    pub(super) fn wrong(
        &self,
        before: &[LostCommunicationPolicy],
        node: &NodeName,
        environment: &ComponentEnvironment,
    ) -> Vec<StartError> {
        let beside = before.iter().filter_map(|other| self.check_beside(other).err());
        let whole = beside.chain(self.check(node, environment).err());
        let rungs = (0..self.rungs.len()).flat_map(|place| self.check_rung(place, environment));
        whole.chain(rungs).map(|(part, reason)| self.refused(part, reason)).collect()
    }

    pub(super) fn refused(&self, part: PolicyPart, reason: String) -> StartError {
        StartError::LostCommunication { policy: self.name.clone(), part, reason }
    }

    /// The node whose commanders are lost.
    pub(super) fn commander_node(&self) -> Result<Option<NodeName>, StartError> {
        let node = self.commander.as_deref().map(NodeName::new).transpose();
        let reason = |error| format!("its commander: {error}");
        node.map_err(|error| self.refused(PolicyPart::Commander, reason(error)))
    }

    /// Follows the condition from now on. Components of rungs are added and removed on `arbiter`,
    /// or here.
    pub(super) fn start(
        self,
        node: &NodeName,
        incarnation: Incarnation,
        environment: &ComponentEnvironment,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<Arc<KeptPolicy>, StartError> {
        let conditions = environment.feature::<Conditions>();
        let condition = conditions.declare(&self.name, &self.needs, platform::now(), None);
        let refused = |error: ConditionError| self.refused(PolicyPart::Whole, error.to_string());
        let condition = condition.map_err(refused)?;
        let object = object_of(&self.name).map_err(refused)?;
        let commander = self.commander_node()?;
        let times = self.rungs.iter().map(|(after, _)| *after).collect();
        let (slot, ladder) = (NodeSlot::default(), watch::Sender::new(None));
        let mut rungs = Vec::new();
        for (place, (after, rung)) in self.rungs.into_iter().enumerate() {
            let commands = rung.commands.into_iter();
            // Those that are wrong were refused by the check.
            let commands = commands.filter_map(|known| {
                let (key, command) = known.resolved(environment.feature::<ActuatorTable>())?;
                Some((key, command.ok()?))
            });
            let runs = rung.component.map(|component| format!("{node}:{component}"));
            let commands = commands.collect();
            rungs.push(KeptRung { after, name: rung.name, commands, runs });
            let Some(run) = rung.run else { continue };
            let (slot, rung) = (slot.clone(), ladder.subscribe());
            let begin = move || drop(actix_rt::spawn(run(slot, rung, place)));
            match arbiter {
                Some(arbiter) => drop(arbiter.spawn_fn(begin)),
                None => begin(),
            }
        }
        let kept = Arc::new(KeptPolicy {
            holder: CommanderId { name: format!("{node}:{object}"), incarnation },
            name: self.name,
            object,
            rungs,
            commander,
            actuators: environment.feature::<ActuatorTable>().clone(),
            reports: environment.reports.clone(),
            ladder: Mutex::new(LostCommunication::new(times, self.end)),
            rung: ladder,
            node: slot,
        });
        kept.keys().for_each(|key| kept.actuators.keep_by_policy(key));
        let follower = kept.clone();
        let follow = move |state, cause: &str, now| follower.follow(state, cause, now);
        conditions.follow(&condition, Arc::new(follow));
        Ok(kept)
    }
}
