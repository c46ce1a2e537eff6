//! What the robot does alone: a ladder in time for each commander that it may lose.
//!
//! ```text
//!  Condition ─ lost, connected ─► LostCommunicationActor ─ rung ─► commands actuators
//!  Node::acknowledge ────────────►        (ladder)        └──────► starts a component
//! ```
//!
//! The actor lives beside the fault chain. A rung of commands needs no other component than the
//! actuators' own; where one of the last rung does not take its command, it is cut off.

mod policy;

pub use policy::{LostCommunicationPolicy, Rung};

use super::conditions::OwnedTask;
use super::error::StartError;
use super::{Node, Shared};
use crate::component::environment::ComponentEnvironment;
use crate::condition::Condition;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use actix::prelude::*;
use blastema_contract::reports::{AreYouAlive, FaultDeclared};
use blastema_core::connection::{ConditionState, LostCommunication, LostCommunicationOutput};
use blastema_core::{FaultKind, Incarnation, NodeName, ObjectName};
use policy::{AddFn, RungCommand, RungDeed, RungSetup};
use std::cell::Cell;
use std::rc::Rc;
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::sync::{oneshot, watch};
use tracing::{info, warn};

/// An actuator of the last rung is cut off if it has not carried out its command by then.
const LAST_RUNG_WITHIN: Duration = Duration::from_secs(1);
/// How often it tries to add a component that was refused.
const ADD_INTERVAL: Duration = Duration::from_secs(1);

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
        /// The policy.
        name: String,
    },
}

/// What is carried out now. It ends when it is dropped.
enum CarriedRung {
    Commands(#[expect(dead_code, reason = "they end when they are dropped")] Vec<OwnedTask>),
    /// The task removes the component when this is gone.
    Component(#[expect(dead_code, reason = "the other end sees it drop")] oneshot::Sender<()>),
}

struct LostCommunicationActor {
    policy: LostCommunicationPolicy,
    ladder: LostCommunication,
    wake: WakeTimer,
    setup: RungSetup,
    condition: Condition,
    faults: Option<Recipient<FaultDeclared>>,
    node: Option<Weak<Shared>>,
    running: Option<CarriedRung>,
    follows: Option<OwnedTask>,
    row: watch::Sender<LostCommunicationRow>,
}

impl LostCommunicationActor {
    fn show(&self) {
        let rung = self.ladder.rung().and_then(|place| self.policy.rungs.get(place));
        let rung = rung.map(|(_, rung)| rung.name.clone());
        let (name, is_back) = (self.policy.name.clone(), self.ladder.is_back());
        self.row.send_replace(LostCommunicationRow { name, rung, is_back });
    }

    fn enter(&mut self, place: usize) {
        let Some((after, rung)) = self.policy.rungs.get(place) else { return };
        if let Some(node) = &self.policy.commander {
            self.setup.actuators.suspend(node);
        }
        let is_last = place + 1 == self.policy.rungs.len();
        // The rung before ends first: its component is stopped, its actuators are given back.
        self.running = None;
        self.running = Some(match &rung.deed {
            RungDeed::Command(commands) => {
                let begin = |command: &RungCommand| {
                    let done = Rc::<Cell<bool>>::default();
                    let work = (command.command)(&self.setup, done.clone());
                    let object = is_last.then(|| command.actuator.clone());
                    let (table, contract) = (self.setup.actuators.clone(), command.contract);
                    let cut_off = async move {
                        let Some(object) = object else { return };
                        platform::sleep(LAST_RUNG_WITHIN).await;
                        if !done.get() {
                            warn!(object, "the last rung's command is not carried out: cut off");
                            table.cut_off_now(&object, contract);
                        }
                    };
                    [OwnedTask::spawn(work), OwnedTask::spawn(cut_off)]
                };
                CarriedRung::Commands(commands.iter().flat_map(begin).collect())
            }
            RungDeed::Run(add) => {
                let (stop, stopped) = oneshot::channel();
                let node = self.node.clone().unwrap_or_default();
                actix_rt::spawn(run_component(node, add.clone(), stopped));
                CarriedRung::Component(stop)
            }
        });
        let (name, since) = (&rung.name, self.condition.status().cause);
        let detail = format!("{since}; after {after:?} the robot begins to {name}");
        info!(policy = self.policy.name, "{detail}");
        // The condition may hold again by now, and its fault be over.
        if self.condition.is_connected() {
            return;
        }
        if let (Some(faults), Ok(object)) =
            (&self.faults, ObjectName::new(&format!("conditions/{}", self.policy.name)))
        {
            let (incarnation, kind) = (Incarnation::FIRST, FaultKind::ConnectionLost);
            faults.do_send(FaultDeclared { object, incarnation, kind, detail });
        }
    }

    fn end(&mut self) {
        self.running = None;
        if let Some(node) = &self.policy.commander {
            self.setup.actuators.resume_commander(node);
        }
        info!(policy = self.policy.name, "communication is back: others command again");
    }
}

/// Runs a component until it is told to stop, or the node has ended.
async fn run_component(node: Weak<Shared>, add: AddFn, mut stopped: oneshot::Receiver<()>) {
    let name = loop {
        let Some(present) = node.upgrade().map(Node) else { return };
        match add(present).await {
            Ok(name) => break name,
            Err(why) => warn!(why, "a rung's component is not added"),
        }
        if tokio::time::timeout(ADD_INTERVAL, &mut stopped).await.is_ok() {
            return;
        }
    };
    // The sender is dropped with the rung.
    let _ = stopped.await;
    if let Some(node) = node.upgrade().map(Node)
        && let Err(why) = node.remove_child(&name).await
    {
        warn!(name, %why, "a rung's component is not removed");
    }
}

/// The node whose policy it is.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct AttachNode(pub(super) Node);

/// The condition is so now.
#[derive(Message)]
#[rtype(result = "()")]
struct ConditionTurned(ConditionState);

/// A person lets others command again. Answers whether a rung was to be ended.
#[derive(Message)]
#[rtype(result = "bool")]
struct Acknowledge;

/// A policy of a node.
pub(super) struct KeptPolicy {
    attach: Recipient<AttachNode>,
    acknowledge: Recipient<Acknowledge>,
    row: watch::Receiver<LostCommunicationRow>,
}

impl KeptPolicy {
    /// Lets rungs run components of the node.
    pub(super) fn attach(&self, node: &Node) {
        self.attach.do_send(AttachNode(node.clone()));
    }
}

impl LostCommunicationPolicy {
    /// Starts to follow the condition. Returns the policy, and its actor's name and where it
    /// answers the monitor.
    pub(super) fn start(
        self,
        (node, incarnation): (&NodeName, Incarnation),
        environment: &ComponentEnvironment,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<(KeptPolicy, ObjectName, Recipient<AreYouAlive>), StartError> {
        let refused =
            |reason: String| StartError::LostCommunication { policy: self.name.clone(), reason };
        let object = ObjectName::new(&format!("policies/{}", self.name));
        let object = object.map_err(|error| refused(error.to_string()))?;
        self.check(environment.actuators()).map_err(&refused)?;
        let conditions = environment.conditions();
        let condition = conditions.declare(&self.name, &self.needs, platform::now());
        let condition = condition.map_err(|error| refused(error.to_string()))?;
        let row = LostCommunicationRow { name: self.name.clone(), rung: None, is_back: false };
        let (row, shown) = watch::channel(row);
        let setup = RungSetup {
            registry: environment.registry.clone(),
            actuators: environment.actuators().clone(),
            own: format!("{node}:{object}"),
            incarnation,
        };
        let faults = environment.reports.faults.clone();
        let times = self.rungs.iter().map(|(after, _)| *after).collect();
        let make = move |_: &mut actix::Context<LostCommunicationActor>| LostCommunicationActor {
            ladder: LostCommunication::new(times, self.end),
            policy: self,
            wake: WakeTimer::default(),
            setup,
            condition,
            faults,
            node: None,
            running: None,
            follows: None,
            row,
        };
        let actor = guardian.start(object.clone(), arbiter, make);
        let kept = KeptPolicy {
            attach: actor.clone().recipient(),
            acknowledge: actor.clone().recipient(),
            row: shown,
        };
        Ok((kept, object, actor.recipient()))
    }
}

impl MachineActor for LostCommunicationActor {
    type Machine = LostCommunication;

    fn driven(&mut self) -> (&mut LostCommunication, &mut WakeTimer) {
        (&mut self.ladder, &mut self.wake)
    }

    fn carry_out(&mut self, output: LostCommunicationOutput, _: &mut Self::Context) {
        match output {
            LostCommunicationOutput::Enter(place) => self.enter(place),
            LostCommunicationOutput::End => self.end(),
        }
        self.show();
    }
}

answers_the_monitor!(LostCommunicationActor);

impl Actor for LostCommunicationActor {
    type Context = actix::Context<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let (turned, mut changes) =
            (context.address().downgrade().recipient(), self.condition.changes());
        self.follows = Some(OwnedTask::spawn(async move {
            while let Some(status) = changes.next().await {
                let Some(turned) = turned.upgrade() else { return };
                turned.do_send(ConditionTurned(status.state));
            }
        }));
    }
}

impl Supervised for LostCommunicationActor {
    /// The rung goes on; what has changed meanwhile is looked at.
    fn restarting(&mut self, context: &mut Self::Context) {
        self.wake = WakeTimer::default();
        self.started(context);
        if self.ladder.since().is_some() {
            context.address().do_send(ConditionTurned(self.condition.state()));
        }
    }
}

impl Handler<AttachNode> for LostCommunicationActor {
    type Result = ();

    fn handle(&mut self, AttachNode(node): AttachNode, _: &mut Self::Context) {
        self.node = Some(Arc::downgrade(&node.0));
    }
}

impl Handler<ConditionTurned> for LostCommunicationActor {
    type Result = ();

    fn handle(&mut self, ConditionTurned(state): ConditionTurned, context: &mut Self::Context) {
        let now = platform::now();
        match state {
            ConditionState::Lost => self.ladder.handle_lost(now),
            ConditionState::Connected => self.ladder.handle_connected(now),
            // It is there again, but not well enough to be trusted.
            ConditionState::Degraded if self.ladder.since().is_some() => {
                self.ladder.handle_lost(now);
            }
            ConditionState::Degraded => {}
        }
        self.drive(context);
        self.show();
    }
}

impl Handler<Acknowledge> for LostCommunicationActor {
    type Result = bool;

    fn handle(&mut self, _: Acknowledge, context: &mut Self::Context) -> bool {
        let was_due = self.ladder.handle_acknowledged();
        self.drive(context);
        was_due
    }
}

impl Node {
    /// Returns the policies for lost communication, with the rungs that are carried out.
    pub fn lost_communication(&self) -> Vec<LostCommunicationRow> {
        self.0.policies.iter().map(|policy| policy.row.borrow().clone()).collect()
    }

    /// Lets others command again after communication was lost and is back, for a person who has
    /// looked at the robot.
    ///
    /// # Errors
    /// [`AcknowledgeError`] where there is no such policy, and while communication is lost.
    pub async fn acknowledge(&self, policy: &str) -> Result<(), AcknowledgeError> {
        let name = policy.to_owned();
        let Some(policy) = self.0.policies.iter().find(|known| known.row.borrow().name == name)
        else {
            let known = self.0.policies.iter().map(|known| known.row.borrow().name.clone());
            let known = match known.collect::<Vec<_>>().join(", ") {
                none if none.is_empty() => "none".to_owned(),
                known => known,
            };
            return Err(AcknowledgeError::Unknown { name, known });
        };
        match policy.acknowledge.send(Acknowledge).await {
            Ok(true) => Ok(()),
            _ => Err(AcknowledgeError::NotBack { name }),
        }
    }
}
