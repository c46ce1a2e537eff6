//! The detector's body.

use crate::fault_chain::log::FaultPrinter;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::{FaultEvent, FaultOutcome, Observed, ReadRecord, Subscribe};
use blastema_contract::notifier::{FaultCleared, FaultFound};
use blastema_contract::recoverer::SafeStateChanged;
use blastema_core::NodeName;
use blastema_core::detection::{self, DetectorLimits, DetectorOutput, FaultNotice};
use tracing::{error, warn};

/// Consoles, dashboards, journals and recordings of one node, and as many again.
const LISTENERS: usize = 64;

/// Judges what the monitor saw, and keeps the record.
pub(crate) struct DetectorActor {
    node: NodeName,
    machine: detection::Detector,
    wake: WakeTimer,
    found: Recipient<FaultFound>,
    cleared: Recipient<FaultCleared>,
    listeners: Vec<Recipient<FaultEvent>>,
    log: FaultPrinter,
}

impl DetectorActor {
    /// A detector of `node` that hands over to the notifier behind these recipients.
    pub(crate) fn new(
        node: NodeName,
        limits: DetectorLimits,
        found: Recipient<FaultFound>,
        cleared: Recipient<FaultCleared>,
    ) -> Self {
        let machine = detection::Detector::new(node.clone(), limits, platform::now());
        DetectorActor {
            node,
            machine,
            wake: WakeTimer::default(),
            found,
            cleared,
            listeners: Vec::new(),
            log: FaultPrinter::default(),
        }
    }

    fn hand_over(&mut self, number: u64, notice: FaultNotice, context: &mut Context<Self>) {
        match notice {
            FaultNotice::Found(fault) => {
                self.await_confirmation(number, self.found.send(FaultFound { fault }), context)
            }
            FaultNotice::Cleared { id, location } => {
                self.await_confirmation(
                    number,
                    self.cleared.send(FaultCleared { id, location }),
                    context,
                );
            }
        }
    }

    fn await_confirmation(
        &self,
        number: u64,
        sent: impl Future<Output = Result<Confirmed, MailboxError>> + 'static,
        context: &mut Context<Self>,
    ) {
        context.spawn(wrap_future::<_, Self>(sent).map(move |answer, detector, context| {
            let now = platform::now();
            match answer {
                Ok(Confirmed) => detector.machine.handle_confirmed(number, now),
                Err(_) => detector.machine.handle_failed(number, now),
            }
            detector.drive(context);
        }));
    }

    fn tell(&mut self, event: FaultEvent) {
        self.log.step(&self.node, &event);
        // A fault is reported at most once per turn, and repetitions at powers of two: the latches
        // are what bounds a slow listener's mailbox.
        self.listeners.retain(Recipient::connected);
        for listener in &self.listeners {
            listener.do_send(event.clone());
        }
    }
}

impl MachineActor for DetectorActor {
    type Machine = detection::Detector;

    fn driven(&mut self) -> (&mut detection::Detector, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: DetectorOutput, context: &mut Context<Self>) {
        match output {
            DetectorOutput::HandOver { number, notice } => self.hand_over(number, notice, context),
            DetectorOutput::Tell { fault, at, turn } => self.tell(FaultEvent { fault, at, turn }),
            DetectorOutput::GivenUp { notice, tries } => {
                error!(%notice, tries, "the notifier never confirmed what the detector found");
            }
        }
    }
}

impl Actor for DetectorActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.drive(context);
    }
}

impl Supervised for DetectorActor {
    fn restarting(&mut self, _: &mut Context<Self>) {
        self.machine = self.machine.clone().restarted(platform::now());
        self.wake = WakeTimer::default();
    }
}

impl Handler<Observed> for DetectorActor {
    type Result = Confirmed;

    fn handle(&mut self, message: Observed, context: &mut Context<Self>) -> Confirmed {
        let Observed { number, observation } = message;
        self.machine.handle_observed(number, observation, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<FaultOutcome> for DetectorActor {
    type Result = ();

    fn handle(&mut self, message: FaultOutcome, context: &mut Context<Self>) {
        let FaultOutcome { id, at, what } = message;
        self.machine.handle_outcome(id, at, what);
        self.drive(context);
    }
}

impl Handler<ReadRecord> for DetectorActor {
    type Result = MessageResult<ReadRecord>;

    fn handle(&mut self, _: ReadRecord, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.machine.read_record())
    }
}

impl Handler<Subscribe> for DetectorActor {
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

impl Handler<SafeStateChanged> for DetectorActor {
    type Result = ();

    fn handle(&mut self, message: SafeStateChanged, _: &mut Context<Self>) {
        if let SafeStateChanged::NodeEnds = message {
            self.machine.handle_node_end();
        }
    }
}

answers_the_monitor!(DetectorActor);
