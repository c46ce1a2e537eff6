//! The supervisor's actor: it holds the children and carries out what its machine decides.

pub(crate) mod directory;
mod requests;
mod tree;

use crate::messaging::death_watch::{Deaths, DownReason};
use crate::platform;
use crate::registry::ReservedName;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian;
use crate::runtime::guardian::Guardian;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::child::{Child, ChildEvent, ChildOrder, ChildReport};
use blastema_contract::monitor::IsolationReported;
use blastema_contract::reports::{Alive, AreYouAlive, ExitReason, FaultDeclared, StateReported};
use blastema_contract::supervisor::{AddChild, GaveUp, ReadTree, Recovered, SupervisorOrder};
use blastema_core::recovery::{
    CallId, ChildRules, GiveUpReason, Supervisor, SupervisorOutput, SupervisorRules,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, Instant, Lifecycle, ObjectName};
use directory::SupervisorDirectory;
use std::sync::Arc;
use tokio::sync::oneshot;
use tracing::{error, info, warn};

type RecoveryResult = Result<Recovered, GaveUp>;

/// What a supervisor is made of.
pub(crate) struct SupervisorSetup {
    pub(crate) name: ObjectName,
    /// How it decides.
    pub(crate) rules: SupervisorRules,
    /// Its children in their start order.
    pub(crate) children: Vec<(Box<dyn Child>, ChildRules)>,
    /// Where it reports.
    pub(crate) neighbours: SupervisorNeighbours,
    /// Its name, which no other object has while it is there.
    pub(crate) reserved: Option<ReservedName>,
}

/// Where a supervisor reports.
pub(crate) struct SupervisorNeighbours {
    /// Gets a report of starts that took too long, and when it gives up.
    pub(crate) monitor: Recipient<FaultDeclared>,
    /// Gets a report when it is at work, and when it has ended.
    pub(crate) states: Recipient<StateReported>,
    /// Gets the objects that may not send and receive.
    pub(crate) isolation: Recipient<IsolationReported>,
    /// Where strategies find the supervisor of an object.
    pub(crate) directory: SupervisorDirectory,
}

/// One node of the supervision tree.
pub(crate) struct SupervisorActor {
    name: ObjectName,
    machine: Supervisor,
    wake: WakeTimer,
    children: SortedMap<ObjectName, Box<dyn Child>>,
    /// The callers that wait for the outcome of a request; bounded by the machine.
    waiting: SortedMap<CallId, oneshot::Sender<RecoveryResult>>,
    calls: u64,
    parent: Option<Arc<Recipient<ChildReport>>>,
    /// Where its children report: all to the same, since each copy of a recipient costs memory.
    reports: Option<Arc<Recipient<ChildReport>>>,
    neighbours: SupervisorNeighbours,
    /// Where its incarnations can be watched.
    watched: Deaths,
    /// It was ordered to end in order to be restarted.
    again: bool,
    /// Given back when the children are gone.
    _reserved: Option<ReservedName>,
}

impl SupervisorActor {
    /// Starts a supervisor under the guardian. It does nothing until it is ordered to begin, by its
    /// parent, or by the node if it is the root.
    pub(crate) fn start(
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
        setup: SupervisorSetup,
    ) -> SupervisorChild {
        let name = setup.name.clone();
        // The guardian counts the incarnations of this actor, the parent those of the supervisor
        // that it plays: they must not be taken for each other.
        let actor = actor_of(&name);
        let watched = guardian.watched();
        let make = move |_: &mut Context<Self>| Self::new(setup, watched);
        let address = guardian.start(actor, arbiter, make);
        SupervisorChild { name, address }
    }

    fn new(setup: SupervisorSetup, watched: Deaths) -> Self {
        let SupervisorSetup { name, rules, children: given, neighbours, reserved } = setup;
        let mut machine = Supervisor::new(rules);
        let mut children = SortedMap::new();
        for (child, rules) in given {
            match machine.add_child(child.name().clone(), rules, platform::now()) {
                Ok(_) => drop(children.insert(child.name().clone(), child)),
                Err(why) => {
                    error!(supervisor = %name, child = %child.name(), %why, "a child was refused");
                }
            }
        }
        SupervisorActor {
            name,
            machine,
            wake: WakeTimer::default(),
            children,
            waiting: SortedMap::new(),
            calls: 0,
            parent: None,
            reports: None,
            neighbours,
            watched,
            again: false,
            _reserved: reserved,
        }
    }

    /// Hands a request to the machine, and resolves when the machine has answered it.
    fn ask(
        &mut self,
        context: &mut Context<Self>,
        object: ObjectName,
        input: impl FnOnce(&mut Supervisor, &ObjectName, CallId, Instant),
    ) -> PendingAnswer<RecoveryResult> {
        self.calls += 1;
        let call = CallId(self.calls);
        let (answer, outcome) = oneshot::channel();
        self.waiting.insert(call, answer);
        input(&mut self.machine, &object, call, platform::now());
        self.drive(context);
        PendingAnswer::new(async move {
            outcome.await.unwrap_or(Err(GaveUp { object, why: GiveUpReason::Forgotten }))
        })
    }

    fn answer(&mut self, call: CallId, outcome: RecoveryResult) {
        if let Some(waiting) = self.waiting.remove(&call) {
            // The caller may have stopped waiting; the order is carried out all the same.
            let _ = waiting.send(outcome);
        }
    }

    fn tell_parent(&self, event: ChildEvent) {
        if let Some(parent) = &self.parent {
            let (object, incarnation) = (self.name.clone(), self.machine.incarnation());
            parent.do_send(ChildReport { object, incarnation, event });
        }
    }

    /// Its own state, so that its faults are over for the detector when its next incarnation is at
    /// work.
    fn report_state(&self, state: Lifecycle) {
        let (object, incarnation) = (self.name.clone(), self.machine.incarnation());
        self.watched.enter(&object, incarnation, state);
        self.neighbours.states.do_send(StateReported { object, incarnation, state, reason: None });
    }

    fn declare(
        &self,
        object: ObjectName,
        incarnation: Incarnation,
        kind: FaultKind,
        detail: String,
    ) {
        self.neighbours.monitor.do_send(FaultDeclared {
            object,
            incarnation,
            kind,
            detail,
            hold: None,
        });
    }

    fn declare_storm(&self, reason: &str) {
        error!(supervisor = %self.name, reason, "restarts are not worth it any more");
        let (name, incarnation) = (self.name.clone(), self.machine.incarnation());
        self.declare(name, incarnation, FaultKind::RestartStorm, reason.to_owned());
    }

    /// No incarnation follows for any child: what waits for one is given back, also where none was
    /// left that could have been stopped.
    fn retire_all(&mut self) {
        for child in self.children.values_mut() {
            child.order(ChildOrder::Retire);
        }
    }

    fn drop_child(&mut self, name: &ObjectName) {
        self.children.remove(name);
        self.neighbours.directory.remove(name);
    }

    /// Drops a child that the machine did not take.
    fn drop_unknown(&mut self, name: &ObjectName) {
        if self.machine.incarnation_of(name).is_none() {
            self.drop_child(name);
        }
    }

    fn with(&mut self, name: &ObjectName, then: impl FnOnce(&mut dyn Child)) {
        if let Some(child) = self.children.get_mut(name) {
            then(&mut **child);
        }
    }
}

impl MachineActor for SupervisorActor {
    type Machine = Supervisor;

    fn driven(&mut self) -> (&mut Supervisor, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, action: SupervisorOutput, context: &mut Context<Self>) {
        match action {
            SupervisorOutput::Start { child, incarnation } => {
                let report = || Arc::new(context.address().recipient());
                let report = self.reports.get_or_insert_with(report).clone();
                if let Some(started) = self.children.get_mut(&child) {
                    let begun = started.start(incarnation, report);
                    self.machine.handle_begun(&child, begun);
                }
            }
            SupervisorOutput::Order { child: name, mut order } => {
                if let ChildOrder::Stop { again } = &mut order {
                    *again |= self.again;
                }
                let Some(child) = self.children.get_mut(&name) else { return };
                child.order(order);
                if let ChildOrder::Isolate(isolated) = order {
                    self.neighbours.isolation.do_send(IsolationReported { object: name, isolated });
                }
            }
            SupervisorOutput::Recovered { call, child, incarnation } => {
                self.answer(call, Ok(Recovered { object: child, incarnation, waits: false }));
            }
            SupervisorOutput::Waits { call, child, incarnation } => {
                let incarnation = Some(incarnation);
                self.answer(call, Ok(Recovered { object: child, incarnation, waits: true }));
            }
            SupervisorOutput::GaveUp { call, child, why } => {
                self.answer(call, Err(GaveUp { object: child, why }));
            }
            SupervisorOutput::Refused { child, incarnation, reason } => {
                self.declare(child.clone(), incarnation, FaultKind::UnexpectedExit, reason);
                // What waits below for its next incarnation waits in vain.
                if let Some(child) = self.children.get_mut(&child) {
                    child.order(ChildOrder::Retire);
                }
            }
            SupervisorOutput::Unavailable(reason) => {
                warn!(supervisor = %self.name, reason, "its start waits for what is not there yet");
                self.tell_parent(ChildEvent::Unavailable { reason });
            }
            SupervisorOutput::Overdue { child, incarnation, limit } => {
                let is_reported = self
                    .children
                    .get_mut(&child)
                    .is_some_and(|child| child.order(ChildOrder::CutOff));
                if !is_reported {
                    let detail = format!("it was not at work within {limit:?}");
                    self.declare(child, incarnation, FaultKind::InitializationFailed, detail);
                }
            }
            SupervisorOutput::Left(child) => self.drop_child(&child),
            SupervisorOutput::GiveUp(reason) => {
                self.declare_storm(&reason);
                self.tell_parent(ChildEvent::GivesUp { reason });
            }
            SupervisorOutput::Escalate(reason) => {
                if self.machine.rules().root {
                    self.retire_all();
                } else {
                    self.declare_storm(&reason);
                }
                self.watched.end(&self.name, DownReason::Fatal);
                self.tell_parent(ChildEvent::Escalated { reason });
            }
            SupervisorOutput::AllStarted => {
                info!(supervisor = %self.name, "all children are at work");
                self.report_state(Lifecycle::Initialized);
                self.report_state(Lifecycle::Active);
                self.tell_parent(ChildEvent::Started);
            }
            SupervisorOutput::AllStopped => {
                if !self.again {
                    self.retire_all();
                    self.machine.handle_retired();
                }
                self.report_state(Lifecycle::Finalized);
                self.tell_parent(ChildEvent::Stopped);
            }
        }
    }
}

/// It answers for the supervisor that it plays, whose incarnations its parent counts.
impl Handler<AreYouAlive> for SupervisorActor {
    type Result = Alive;

    fn handle(&mut self, _: AreYouAlive, _: &mut Context<Self>) -> Alive {
        let incarnation = self.machine.incarnation().max(Incarnation::FIRST);
        Alive { incarnation, ..guardian::alive() }
    }
}

impl Actor for SupervisorActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.neighbours.directory.enter(&self.name, context.address(), self.children.keys());
        self.drive(context);
    }
}

impl Supervised for SupervisorActor {
    fn restarting(&mut self, _: &mut Context<Self>) {
        warn!(supervisor = %self.name, "restarted: children between two incarnations are started again");
        self.wake = WakeTimer::default();
        self.waiting.clear();
        self.machine.handle_own_restart(platform::now());
    }
}

impl Handler<SupervisorOrder> for SupervisorActor {
    type Result = ();

    fn handle(&mut self, order: SupervisorOrder, context: &mut Context<Self>) {
        let now = platform::now();
        match order {
            SupervisorOrder::Start { incarnation, report } => {
                (self.parent, self.again) = (Some(report), false);
                self.machine.handle_begin(incarnation, now);
            }
            SupervisorOrder::Carry(ChildOrder::Stop { again }) => {
                self.again = again;
                self.machine.handle_end(now);
            }
            SupervisorOrder::Carry(ChildOrder::Retire) => {
                self.again = false;
                self.machine.handle_end(now);
            }
            SupervisorOrder::Carry(ChildOrder::ExpectEnd) => self.machine.handle_end_expected(now),
            SupervisorOrder::Carry(ChildOrder::Abandon | ChildOrder::CutOff) => {
                self.watched.end(&self.name, DownReason::Abandoned);
                self.machine.handle_forsake(now);
            }
            SupervisorOrder::Carry(ChildOrder::Isolate(isolated)) => {
                self.machine.handle_isolate_all(isolated, now);
            }
            SupervisorOrder::Carry(ChildOrder::Reset) => {
                let reason = "a supervisor is restarted, not reset".into();
                self.tell_parent(ChildEvent::ResetFailed { reason });
            }
            // The guardian restarts it itself; it needs no permission.
            SupervisorOrder::Carry(ChildOrder::GrantRestart(_)) => {}
            SupervisorOrder::ExplainIsolation(reason) => {
                self.children.values_mut().for_each(|child| child.explain_isolation(&reason));
            }
            SupervisorOrder::Forget => {
                self.neighbours.directory.forget(&self.name);
                self.watched.forget(&self.name);
                self.watched.forget(&actor_of(&self.name));
                return context.stop();
            }
        }
        self.drive(context);
    }
}

impl Handler<ChildReport> for SupervisorActor {
    type Result = ();

    fn handle(&mut self, message: ChildReport, context: &mut Context<Self>) {
        let ChildReport { object, incarnation, event } = message;
        let now = platform::now();
        let machine = &mut self.machine;
        match event {
            ChildEvent::Started => machine.handle_started(&object, incarnation, now),
            ChildEvent::Unavailable { reason } => {
                machine.handle_unavailable(&object, incarnation, reason, now);
            }
            ChildEvent::FailsToStart => {
                machine.handle_fails_to_start(&object, incarnation, now);
            }
            ChildEvent::StartFailed { reason } => {
                machine.handle_start_failed(&object, incarnation, reason, now);
            }
            ChildEvent::Stopped => machine.handle_stopped(&object, incarnation, now),
            ChildEvent::Reset => machine.handle_reset_done(&object, incarnation, Ok(()), now),
            ChildEvent::ResetFailed { reason } => {
                machine.handle_reset_done(&object, incarnation, Err(reason), now);
            }
            ChildEvent::Died { exit, restarted_as } => {
                machine.handle_died(&object, incarnation, in_order(&exit), restarted_as, now);
            }
            // Said by a root, which has no supervisor.
            ChildEvent::GivesUp { .. } => {}
            ChildEvent::Escalated { reason } => {
                machine.handle_escalated(&object, incarnation, reason, now);
            }
        }
        self.drive(context);
    }
}

/// The name under which the guardian counts the incarnations of a supervisor's actor.
fn actor_of(supervisor: &ObjectName) -> ObjectName {
    let actor = ObjectName::new(&format!("chain/supervisor/{supervisor}"));
    actor.unwrap_or_else(|_| supervisor.clone())
}

fn in_order(exit: &ExitReason) -> bool {
    matches!(exit, ExitReason::Returned | ExitReason::Stopped)
}

impl Handler<AddChild> for SupervisorActor {
    type Result = PendingAnswer<RecoveryResult>;

    fn handle(&mut self, message: AddChild, context: &mut Context<Self>) -> Self::Result {
        let AddChild { child, rules, whole } = message;
        let object = child.name().clone();
        if self.children.contains_key(&object) {
            let why = GiveUpReason::NameTaken;
            return PendingAnswer::new(std::future::ready(Err(GaveUp { object, why })));
        }
        // The machine starts it at once, or says that it has left.
        self.children.insert(object.clone(), child);
        self.neighbours.directory.add(&self.name, object.clone());
        if whole {
            let answer = self.ask(context, object.clone(), |machine, object, call, now| {
                machine.handle_add(object, rules, call, now);
            });
            self.drop_unknown(&object);
            return answer;
        }
        let taken = self.machine.add_child(object.clone(), rules, platform::now());
        self.drop_unknown(&object);
        self.drive(context);
        let taken = match taken {
            Ok(()) => Ok(Recovered { object, incarnation: None, waits: false }),
            Err(why) => Err(GaveUp { object, why }),
        };
        PendingAnswer::new(std::future::ready(taken))
    }
}

/// A supervisor as its parent, or the node, sees it.
pub(crate) struct SupervisorChild {
    name: ObjectName,
    address: Addr<SupervisorActor>,
}

impl SupervisorChild {
    /// Where its tree can be read.
    pub(crate) fn tree(&self) -> Recipient<ReadTree> {
        self.address.clone().recipient()
    }

    /// Where it answers the monitor.
    pub(crate) fn pings(&self) -> Recipient<AreYouAlive> {
        self.address.clone().recipient()
    }
}

impl Drop for SupervisorChild {
    fn drop(&mut self) {
        self.address.do_send(SupervisorOrder::Forget);
    }
}

impl Child for SupervisorChild {
    fn name(&self) -> &ObjectName {
        &self.name
    }

    fn start(
        &mut self,
        incarnation: Incarnation,
        report: Arc<Recipient<ChildReport>>,
    ) -> Incarnation {
        self.address.do_send(SupervisorOrder::Start { incarnation, report });
        incarnation
    }

    fn order(&mut self, order: ChildOrder) -> bool {
        self.address.do_send(SupervisorOrder::Carry(order));
        false
    }

    fn explain_isolation(&mut self, reason: &str) {
        self.address.do_send(SupervisorOrder::ExplainIsolation(reason.to_owned()));
    }
}

#[cfg(test)]
mod tests;
