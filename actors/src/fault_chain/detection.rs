//! The actor around monitor, detector and notifier.

use crate::fault_chain::log::log_step;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::{FaultEvent, FaultOutcome, ReadRecord, Subscribe};
use blastema_contract::monitor::{
    IsolationReported, LinkReported, NodeEnding, NodeReported, ReadTable, Register, Unregister,
};
use blastema_contract::notifier::AddPort;
use blastema_contract::recoverer::{CancelRecovery, Recover, SafeStateChanged};
use blastema_contract::reports::{
    Alive, AreYouAlive, DeclaredFaultCleared, Exited, FaultDeclared, LivenessReported,
    StateReported,
};
use blastema_core::detection::{
    ConfirmedQueueOutput, DetectionChain, DetectionOutput, FaultNotice, RecovererPort,
    RegistrationError, WorkProgress,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{NodeName, ObjectName};
use std::pin::Pin;
use std::time::Duration;
use tokio::time::timeout;
use tracing::{error, warn};

/// How often an object of the middleware is asked whether it is alive.
const PING_INTERVAL: Duration = Duration::from_secs(1);
/// One that has not answered for so many intervals is silent. Time in which the process did not run
/// counts as one interval at most.
const SILENT_AFTER: u32 = 6;
/// An interval that ends so late shows that the node starves: all its threads have a backlog.
const LATE: Duration = Duration::from_millis(50);
/// So many late intervals count as one.
const LATE_INTERVALS: u32 = 5;

/// Consoles, dashboards, journals and recordings of one node, and as many again.
const LISTENERS: usize = 64;

/// Watches everything in its node, and what its node sees of others; judges it, keeps the record,
/// and informs the recoverers, here and on other nodes.
pub(crate) struct DetectionActor {
    node: NodeName,
    machine: DetectionChain,
    wake: WakeTimer,
    /// Where objects answer; no more than the machine's table has rows.
    pings: SortedMap<ObjectName, Recipient<AreYouAlive>>,
    /// Where the machine's ports lead.
    recoverers: SortedMap<RecovererPort, (Recipient<Recover>, Option<Recipient<CancelRecovery>>)>,
    listeners: Vec<Recipient<FaultEvent>>,
}

impl DetectionActor {
    /// An actor that has nothing to watch, and no recoverer to inform.
    pub(crate) fn new(node: NodeName) -> Self {
        DetectionActor {
            machine: DetectionChain::new(node.clone()),
            node,
            wake: WakeTimer::default(),
            pings: SortedMap::new(),
            recoverers: SortedMap::new(),
            listeners: Vec::new(),
        }
    }

    /// Asks an object again and again, until its mailbox is closed. There is never more than one
    /// open question.
    fn ask(
        &mut self,
        object: ObjectName,
        pings: Recipient<AreYouAlive>,
        context: &mut Context<Self>,
    ) {
        if pings.connected() {
            let answer = Box::pin(pings.send(AreYouAlive));
            self.await_answer(object, pings, answer, 0, context);
        }
    }

    fn await_answer(
        &mut self,
        object: ObjectName,
        pings: Recipient<AreYouAlive>,
        mut answer: Pin<Box<RecipientRequest<AreYouAlive>>>,
        // In late intervals.
        waited: u32,
        context: &mut Context<Self>,
    ) {
        let asked_at = platform::now();
        let wait = async move { (timeout(PING_INTERVAL, &mut answer).await, answer) };
        let settle = move |(answered, answer), chain: &mut Self, context: &mut Context<Self>| {
            let now = platform::now();
            match answered {
                Ok(answered) => {
                    // The answer of an actor that was restarted meanwhile is lost.
                    if let Ok(Alive { incarnation, state }) = answered {
                        let progress = WorkProgress { incarnation, state };
                        chain.machine.monitor.handle_alive(&object, progress, now);
                    }
                    context.run_later(PING_INTERVAL, |chain, context| {
                        chain.ask(object, pings, context);
                    });
                }
                Err(_) => {
                    let is_late = now - asked_at > PING_INTERVAL + LATE;
                    let after = waited + if is_late { 1 } else { LATE_INTERVALS };
                    let limit = SILENT_AFTER * LATE_INTERVALS;
                    if waited < limit && after >= limit {
                        let age = SILENT_AFTER * PING_INTERVAL;
                        chain.machine.monitor.handle_unanswered(&object, age, now);
                    }
                    chain.await_answer(object, pings, answer, after, context);
                }
            }
            chain.drive(context);
        };
        context.spawn(wrap_future(wait).map(settle));
    }

    fn hand_over(
        &mut self,
        port: RecovererPort,
        number: u64,
        notice: FaultNotice,
        context: &mut Context<Self>,
    ) {
        let (recover, cancel) = &self.recoverers[&port];
        let sent: Pin<Box<dyn Future<Output = Result<Confirmed, MailboxError>>>> =
            match (notice, cancel) {
                (FaultNotice::Found(fault), _) => Box::pin(recover.send(Recover { fault })),
                (FaultNotice::Cleared { id, location }, Some(cancel)) => {
                    Box::pin(cancel.send(CancelRecovery { id, location }))
                }
                (FaultNotice::Cleared { .. }, None) => Box::pin(std::future::ready(Ok(Confirmed))),
            };
        context.spawn(wrap_future(sent).map(move |answer, chain: &mut Self, context| {
            let (notifier, now) = (&mut chain.machine.notifier, platform::now());
            match answer {
                Ok(Confirmed) => notifier.handle_confirmed(&port, number, now),
                Err(_) => notifier.handle_failed(&port, number, now),
            }
            chain.drive(context);
        }));
    }

    fn tell(&mut self, event: FaultEvent) {
        log_step(&self.node, &event);
        // A fault is reported at most once per turn, and repetitions at powers of two: the latches
        // are what bounds a slow listener's mailbox.
        self.listeners.retain(Recipient::connected);
        for listener in &self.listeners {
            listener.do_send(event.clone());
        }
    }
}

impl MachineActor for DetectionActor {
    type Machine = DetectionChain;

    fn driven(&mut self) -> (&mut DetectionChain, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: DetectionOutput, context: &mut Context<Self>) {
        match output {
            DetectionOutput::Tell { fault, at, turn } => self.tell(FaultEvent { fault, at, turn }),
            DetectionOutput::Notify(port, ConfirmedQueueOutput::Deliver { number, item }) => {
                self.hand_over(port, number, item, context);
            }
            DetectionOutput::Notify(
                port,
                ConfirmedQueueOutput::GivenUp { item: notice, tries },
            ) => {
                error!(%port, %notice, tries, "a recoverer never confirmed what the notifier told it");
                self.machine.handle_given_up(&port, &notice, platform::now());
            }
        }
    }
}

impl Actor for DetectionActor {
    type Context = Context<Self>;
}

impl Supervised for DetectionActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.machine = self.machine.clone().restarted(platform::now());
        self.wake = WakeTimer::default();
        for (object, pings) in self.pings.clone() {
            self.ask(object, pings, context);
        }
        self.drive(context);
    }
}

impl Handler<Register> for DetectionActor {
    type Result = Result<Confirmed, RegistrationError>;

    fn handle(&mut self, message: Register, context: &mut Context<Self>) -> Self::Result {
        let Register { registration, pings } = message;
        let object = registration.object.clone();
        self.machine.monitor.register(registration, platform::now())?;
        if let Some(pings) = pings
            && self.pings.insert(object.clone(), pings.clone()).is_none()
        {
            self.ask(object, pings, context);
        }
        self.drive(context);
        Ok(Confirmed)
    }
}

impl Handler<Unregister> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: Unregister, context: &mut Context<Self>) {
        let Unregister { object } = message;
        self.pings.remove(&object);
        self.machine.monitor.dismiss(&object, platform::now());
        self.drive(context);
    }
}

/// What others report: the fields of each message are an input of the monitor.
macro_rules! reports {
    ($($message:ident { $($field:ident),* } => $input:ident($($argument:expr),*);)*) => {$(
        impl Handler<$message> for DetectionActor {
            type Result = ();

            fn handle(&mut self, message: $message, context: &mut Context<Self>) {
                let $message { $($field),* } = message;
                self.machine.monitor.$input($($argument,)* platform::now());
                self.drive(context);
            }
        }
    )*};
}

reports! {
    Exited { object, incarnation, exit, restarted_as }
        => handle_exited(&object, incarnation, exit, restarted_as);
    StateReported { object, incarnation, state, reason }
        => handle_state(&object, incarnation, state, reason);
    FaultDeclared { object, incarnation, kind, detail, hold }
        => handle_declared(&object, incarnation, kind, detail, hold);
    DeclaredFaultCleared { object, incarnation, kind }
        => handle_declared_fault_cleared(&object, incarnation, kind);
    LinkReported { node, link, neighbour, condition }
        => handle_link(node, link, neighbour, condition);
    NodeReported { node, incarnation, condition } => handle_node(node, incarnation, condition);
    IsolationReported { object, isolated } => handle_isolation(&object, isolated);
}

impl Handler<LivenessReported> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: LivenessReported, context: &mut Context<Self>) {
        self.machine.monitor.handle_liveness(message.0, platform::now());
        self.drive(context);
    }
}

impl Handler<NodeEnding> for DetectionActor {
    type Result = ();

    fn handle(&mut self, _: NodeEnding, _: &mut Context<Self>) {
        self.machine.monitor.handle_ending();
    }
}

impl Handler<ReadTable> for DetectionActor {
    type Result = MessageResult<ReadTable>;

    fn handle(&mut self, _: ReadTable, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.machine.monitor.read_table(platform::now()))
    }
}

impl Handler<FaultOutcome> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: FaultOutcome, context: &mut Context<Self>) {
        let FaultOutcome { id, at, what } = message;
        self.machine.detector.handle_outcome(id, at, what);
        self.drive(context);
    }
}

impl Handler<ReadRecord> for DetectionActor {
    type Result = MessageResult<ReadRecord>;

    fn handle(&mut self, _: ReadRecord, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.machine.detector.read_record())
    }
}

impl Handler<Subscribe> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: Subscribe, _: &mut Context<Self>) {
        let Subscribe(listener) = message;
        self.listeners.retain(Recipient::connected);
        if self.listeners.len() < LISTENERS {
            self.listeners.push(listener);
        } else {
            warn!(limit = LISTENERS, "no more listeners for faults are taken");
        }
    }
}

impl Handler<SafeStateChanged> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: SafeStateChanged, _: &mut Context<Self>) {
        if let SafeStateChanged::NodeEnds = message {
            self.machine.detector.handle_node_end();
        }
    }
}

impl Handler<AddPort> for DetectionActor {
    type Result = ();

    fn handle(&mut self, message: AddPort, context: &mut Context<Self>) {
        let AddPort { port, recover, stand_down } = message;
        if self.machine.notifier.add_port(port.clone(), platform::now()) {
            self.recoverers.insert(port, (recover, stand_down));
        } else {
            error!(%port, "no more ports are taken: faults are not told there");
        }
        self.drive(context);
    }
}

answers_the_monitor!(DetectionActor);
