//! The notifier's body.

use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::notifier::{AddPort, FaultCleared, FaultFound, ReadPorts, RemovePort};
use blastema_contract::recoverer::{CancelRecovery, Recover};
use blastema_core::detection::{self, FaultNotice, NotifierLimits, NotifierOutput, RecovererPort};
use blastema_core::sorted::SortedMap;
use tracing::error;

/// Notifies the recoverers, here and on other nodes.
pub(crate) struct NotifierActor {
    machine: detection::Notifier,
    wake: WakeTimer,
    /// Where the machine's ports lead.
    recoverers: SortedMap<RecovererPort, RecovererRecipients>,
}

struct RecovererRecipients {
    recover: Recipient<Recover>,
    stand_down: Option<Recipient<CancelRecovery>>,
}

impl NotifierActor {
    /// A notifier without ports.
    pub(crate) fn new(limits: NotifierLimits) -> Self {
        let machine = detection::Notifier::new(limits);
        NotifierActor { machine, wake: WakeTimer::default(), recoverers: SortedMap::new() }
    }

    fn hand_over(
        &mut self,
        port: RecovererPort,
        number: u64,
        notice: FaultNotice,
        context: &mut Context<Self>,
    ) {
        // A port that was removed in the meantime has nothing under way any more.
        let Some(recoverer) = self.recoverers.get(&port) else { return };
        match (notice, &recoverer.stand_down) {
            (FaultNotice::Found(fault), _) => {
                await_confirmation(
                    port,
                    number,
                    recoverer.recover.send(Recover { fault }),
                    context,
                );
            }
            (FaultNotice::Cleared { id, location }, Some(stand_down)) => {
                let sent = stand_down.send(CancelRecovery { id, location });
                await_confirmation(port, number, sent, context);
            }
            (FaultNotice::Cleared { .. }, None) => {
                self.machine.handle_confirmed(&port, number, platform::now());
            }
        }
    }
}

fn await_confirmation(
    port: RecovererPort,
    number: u64,
    sent: impl Future<Output = Result<Confirmed, MailboxError>> + 'static,
    context: &mut Context<NotifierActor>,
) {
    context.spawn(wrap_future::<_, NotifierActor>(sent).map(move |answer, notifier, context| {
        let now = platform::now();
        match answer {
            Ok(Confirmed) => notifier.machine.handle_confirmed(&port, number, now),
            Err(_) => notifier.machine.handle_failed(&port, number, now),
        }
        notifier.drive(context);
    }));
}

impl MachineActor for NotifierActor {
    type Machine = detection::Notifier;

    fn driven(&mut self) -> (&mut detection::Notifier, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: NotifierOutput, context: &mut Context<Self>) {
        match output {
            NotifierOutput::HandOver { port, number, notice } => {
                self.hand_over(port, number, notice, context);
            }
            NotifierOutput::GivenUp { port, notice, tries } => {
                error!(%port, %notice, tries, "a recoverer never confirmed what the notifier told it");
            }
        }
    }
}

impl Actor for NotifierActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.drive(context);
    }
}

impl Supervised for NotifierActor {
    fn restarting(&mut self, _: &mut Context<Self>) {
        self.machine = self.machine.clone().restarted(platform::now());
        self.wake = WakeTimer::default();
    }
}

impl Handler<FaultFound> for NotifierActor {
    type Result = Confirmed;

    fn handle(&mut self, message: FaultFound, context: &mut Context<Self>) -> Confirmed {
        let FaultFound { fault } = message;
        self.machine.handle_notice(FaultNotice::Found(fault), platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<FaultCleared> for NotifierActor {
    type Result = Confirmed;

    fn handle(&mut self, message: FaultCleared, context: &mut Context<Self>) -> Confirmed {
        let FaultCleared { id, location } = message;
        self.machine.handle_notice(FaultNotice::Cleared { id, location }, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<AddPort> for NotifierActor {
    type Result = ();

    fn handle(&mut self, message: AddPort, context: &mut Context<Self>) {
        let AddPort { port, recover, stand_down } = message;
        if self.machine.add_port(port.clone(), platform::now()) {
            self.recoverers.insert(port, RecovererRecipients { recover, stand_down });
        } else {
            error!(%port, "no more ports are taken: faults are not told there");
        }
        self.drive(context);
    }
}

impl Handler<RemovePort> for NotifierActor {
    type Result = ();

    fn handle(&mut self, message: RemovePort, context: &mut Context<Self>) {
        let RemovePort { port } = message;
        self.machine.remove_port(&port);
        self.recoverers.remove(&port);
        self.drive(context);
    }
}

impl Handler<ReadPorts> for NotifierActor {
    type Result = MessageResult<ReadPorts>;

    fn handle(&mut self, _: ReadPorts, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.machine.read_ports())
    }
}

answers_the_monitor!(NotifierActor);
