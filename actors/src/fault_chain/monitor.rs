//! The monitor's body.

use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::Observed;
use blastema_contract::monitor::{
    IsolationReported, LinkReported, NodeEnding, NodeReported, ReadTable, Register, Unregister,
};
use blastema_contract::reports::{
    Alive, AreYouAlive, DeclaredFaultCleared, Exited, FaultDeclared, LivenessReported,
    StateReported,
};
use blastema_core::detection::{
    self, MonitorLimits, MonitorOutput, RegistrationError, WorkProgress,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{NodeName, ObjectName};
use std::pin::Pin;
use std::time::Duration;
use tokio::time::timeout;
use tracing::error;

/// How often an object of the middleware is asked whether it is alive.
const PING_INTERVAL: Duration = Duration::from_secs(1);
/// One that has not answered for so many intervals is silent. It answers in microseconds: this is
/// no matter of load. Time in which the process did not run counts as one interval at most.
const SILENT_AFTER: u32 = 6;

/// Watches everything in its node, and what its node sees of others.
pub(crate) struct MonitorActor {
    machine: detection::Monitor,
    wake: WakeTimer,
    detector: Recipient<Observed>,
    /// Where objects answer; no more than the machine's table has rows.
    pings: SortedMap<ObjectName, Recipient<AreYouAlive>>,
}

impl MonitorActor {
    /// A monitor of `node` that hands over to `detector`.
    pub(crate) fn new(
        node: NodeName,
        limits: MonitorLimits,
        detector: Recipient<Observed>,
    ) -> Self {
        let machine = detection::Monitor::new(node, limits, platform::now());
        MonitorActor { machine, wake: WakeTimer::default(), detector, pings: SortedMap::new() }
    }

    /// Asks an object again and again, until it is dismissed or has ended for good. There is never
    /// more than one open question.
    fn ask(&mut self, object: ObjectName, context: &mut Context<Self>) {
        if let Some(pings) = self.pings.get(&object).filter(|pings| pings.connected()) {
            let answer = Box::pin(pings.send(AreYouAlive));
            self.await_answer(object, answer, 0, context);
        }
    }

    fn await_answer(
        &mut self,
        object: ObjectName,
        mut answer: Pin<Box<RecipientRequest<AreYouAlive>>>,
        waited: u32,
        context: &mut Context<Self>,
    ) {
        let wait = async move { (timeout(PING_INTERVAL, &mut answer).await, answer) };
        context.spawn(wrap_future(wait).map(
            move |(answered, answer), monitor: &mut Self, context| {
                let now = platform::now();
                match answered {
                    Ok(answered) => {
                        // The answer of an actor that was restarted meanwhile is lost.
                        if let Ok(Alive { incarnation, state }) = answered {
                            let progress = WorkProgress { incarnation, state };
                            monitor.machine.handle_alive(&object, progress, now);
                        }
                        context.run_later(PING_INTERVAL, |monitor, context| {
                            monitor.ask(object, context)
                        });
                    }
                    Err(_) => {
                        if waited + 1 == SILENT_AFTER {
                            let age = SILENT_AFTER * PING_INTERVAL;
                            monitor.machine.handle_unanswered(&object, age, now);
                        }
                        monitor.await_answer(object, answer, waited + 1, context);
                    }
                }
                monitor.drive(context);
            },
        ));
    }
}

impl MachineActor for MonitorActor {
    type Machine = detection::Monitor;

    fn driven(&mut self) -> (&mut detection::Monitor, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: MonitorOutput, context: &mut Context<Self>) {
        match output {
            MonitorOutput::Observe { number, observation } => {
                let sent = self.detector.send(Observed { number, observation });
                context.spawn(wrap_future::<_, Self>(sent).map(move |answer, monitor, context| {
                    let now = platform::now();
                    match answer {
                        Ok(Confirmed) => monitor.machine.handle_confirmed(number, now),
                        Err(_) => monitor.machine.handle_failed(number, now),
                    }
                    monitor.drive(context);
                }));
            }
            MonitorOutput::GivenUp { observation, tries } => {
                let object = &observation.location;
                error!(%object, tries, "the detector never confirmed what the monitor saw of an object");
            }
        }
    }
}

impl Actor for MonitorActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.drive(context);
    }
}

impl Supervised for MonitorActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.machine = self.machine.clone().restarted(platform::now());
        self.wake = WakeTimer::default();
        let asked: Vec<ObjectName> = self.pings.keys().cloned().collect();
        asked.into_iter().for_each(|object| self.ask(object, context));
    }
}

impl Handler<Register> for MonitorActor {
    type Result = Result<Confirmed, RegistrationError>;

    fn handle(&mut self, message: Register, context: &mut Context<Self>) -> Self::Result {
        let Register { enrolment, pings } = message;
        let object = enrolment.object.clone();
        self.machine.enrol(enrolment, platform::now())?;
        if let Some(pings) = pings
            && self.pings.insert(object.clone(), pings).is_none()
        {
            self.ask(object, context);
        }
        self.drive(context);
        Ok(Confirmed)
    }
}

impl Handler<Unregister> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: Unregister, context: &mut Context<Self>) {
        let Unregister { object } = message;
        self.pings.remove(&object);
        self.machine.dismiss(&object, platform::now());
        self.drive(context);
    }
}

impl Handler<Exited> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: Exited, context: &mut Context<Self>) {
        let Exited { object, incarnation, exit, restarted_as } = message;
        self.machine.handle_exited(&object, incarnation, exit, restarted_as, platform::now());
        self.drive(context);
    }
}

impl Handler<StateReported> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: StateReported, context: &mut Context<Self>) {
        let StateReported { object, incarnation, state, reason } = message;
        self.machine.handle_state(&object, incarnation, state, reason, platform::now());
        self.drive(context);
    }
}

impl Handler<FaultDeclared> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: FaultDeclared, context: &mut Context<Self>) {
        let FaultDeclared { object, incarnation, kind, detail, hold } = message;
        self.machine.handle_declared(&object, incarnation, kind, detail, hold, platform::now());
        self.drive(context);
    }
}

impl Handler<DeclaredFaultCleared> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: DeclaredFaultCleared, context: &mut Context<Self>) {
        let DeclaredFaultCleared { object, incarnation, kind } = message;
        self.machine.handle_declared_fault_cleared(&object, incarnation, kind, platform::now());
        self.drive(context);
    }
}

impl Handler<LivenessReported> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: LivenessReported, context: &mut Context<Self>) {
        self.machine.handle_liveness(message.0, platform::now());
        self.drive(context);
    }
}

impl Handler<LinkReported> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: LinkReported, context: &mut Context<Self>) {
        let LinkReported { node, link, neighbour, condition } = message;
        self.machine.handle_link(node, link, neighbour, condition, platform::now());
        self.drive(context);
    }
}

impl Handler<NodeReported> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: NodeReported, context: &mut Context<Self>) {
        let NodeReported { node, incarnation, condition } = message;
        self.machine.handle_node(node, incarnation, condition, platform::now());
        self.drive(context);
    }
}

impl Handler<NodeEnding> for MonitorActor {
    type Result = ();

    fn handle(&mut self, _: NodeEnding, _: &mut Context<Self>) {
        self.machine.handle_ending();
    }
}

impl Handler<IsolationReported> for MonitorActor {
    type Result = ();

    fn handle(&mut self, message: IsolationReported, context: &mut Context<Self>) {
        let IsolationReported { object, isolated } = message;
        self.machine.handle_isolation(&object, isolated, platform::now());
        self.drive(context);
    }
}

impl Handler<ReadTable> for MonitorActor {
    type Result = MessageResult<ReadTable>;

    fn handle(&mut self, _: ReadTable, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.machine.read_table(platform::now()))
    }
}

answers_the_monitor!(MonitorActor);
