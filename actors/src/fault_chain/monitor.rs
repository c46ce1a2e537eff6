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
    self, Liveness, MonitorLimits, MonitorOutput, RegistrationError, WorkProgress,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{NodeName, ObjectName};
use tracing::error;

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

    fn ask(&mut self, object: ObjectName, context: &mut Context<Self>) {
        let Some(pings) = self.pings.get(&object) else {
            return self.machine.handle_unanswered(&object, platform::now());
        };
        let answer = wrap_future::<_, Self>(pings.send(AreYouAlive));
        context.spawn(answer.map(move |answer, monitor, context| {
            let now = platform::now();
            match answer {
                Ok(alive) => monitor.machine.handle_alive(&object, progress(alive), now),
                Err(_) => monitor.machine.handle_unanswered(&object, now),
            }
            monitor.drive(context);
        }));
    }
}

fn progress(alive: Alive) -> WorkProgress {
    let Alive { incarnation, state } = alive;
    WorkProgress { incarnation, state }
}

impl MachineActor for MonitorActor {
    type Machine = detection::Monitor;

    fn driven(&mut self) -> (&mut detection::Monitor, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: MonitorOutput, context: &mut Context<Self>) {
        match output {
            MonitorOutput::Ask { object } => self.ask(object, context),
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
    fn restarting(&mut self, _: &mut Context<Self>) {
        self.machine = self.machine.clone().restarted(platform::now());
        self.wake = WakeTimer::default();
    }
}

impl Handler<Register> for MonitorActor {
    type Result = Result<Confirmed, RegistrationError>;

    fn handle(&mut self, message: Register, context: &mut Context<Self>) -> Self::Result {
        let Register { enrolment, pings } = message;
        let object = enrolment.object.clone();
        if matches!(enrolment.watch, Liveness::Pull(_)) && pings.is_none() {
            return Err(RegistrationError::NowhereToAsk { object });
        }
        self.machine.enrol(enrolment, platform::now())?;
        if let Some(pings) = pings {
            self.pings.insert(object, pings);
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
