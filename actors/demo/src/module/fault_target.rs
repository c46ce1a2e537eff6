//! Injects a fault into an object, and reports when the object answers again.

use super::harm::HarmRecord;
use super::measurements::Measurements;
use super::messages::{FloodMessage, InjectFault, ObjectHarm, Probe};
use crate::machine_instant::MachineInstant;
use crate::protocol::{ModuleEvent, ObjectFault, OrderId};
use blastema::prelude::*;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::yield_now;
use tokio::time::{sleep, timeout};

/// How long an object may take until the fault is present.
const ONSET: Duration = Duration::from_secs(10);
/// For one probe: about what a person would call at once.
const ANSWER: Duration = Duration::from_millis(100);
/// The pause between two probes of an object that does not answer, or answers as its old
/// incarnation.
const BETWEEN_POKES: Duration = Duration::from_millis(1);
/// The number of probes without a pause, so that a return within microseconds is measured as such.
const EAGER_POKES: u32 = 100;
/// The limit of the wait for the object.
const PATIENCE: Duration = Duration::from_secs(20);
/// Messages in one burst of a flood: more than the object serves until the next burst.
const BURST: u32 = 3;
/// The pause between two bursts.
const BETWEEN_BURSTS: Duration = Duration::from_millis(1);

/// One object into which a fault is injected.
#[derive(Debug)]
pub(super) struct FaultTarget {
    measurements: Measurements,
    order: OrderId,
    record: Arc<HarmRecord>,
    inject: Sender<InjectFault>,
    probe: Sender<Probe>,
    flood_queue: Sender<FloodMessage>,
}

impl FaultTarget {
    /// Looks the object up.
    ///
    /// # Errors
    /// No object has this name.
    pub(super) fn new(
        node: &Node,
        measurements: &Measurements,
        order: OrderId,
        object: &str,
    ) -> Result<FaultTarget, DeliveryError> {
        Ok(FaultTarget {
            measurements: measurements.clone(),
            order,
            record: measurements.record(object),
            inject: node.sender(object)?,
            probe: node.sender(object)?,
            flood_queue: node.sender(object)?,
        })
    }

    /// Injects the fault and reports to the director.
    pub(super) async fn carry_out(self, fault: ObjectFault) {
        let Ok(incarnation) = self.probe.ask_within(Probe {}, ONSET).await else {
            self.refuse("the object does not answer before anything is done to it".into());
            return;
        };
        self.record.heal();
        let wound = match fault {
            ObjectFault::Panic => ObjectHarm::Panic,
            ObjectFault::Hang { millis } => ObjectHarm::Hang { millis },
            ObjectFault::ErrorState => ObjectHarm::Error,
            ObjectFault::FailInitialization => ObjectHarm::FailInitialization,
            ObjectFault::Silence => ObjectHarm::Silence,
            ObjectFault::Flood { messages } => {
                self.record.strike();
                self.announce().await;
                self.flood(messages).await;
                self.await_service(0).await;
                return;
            }
        };
        if let Err(error) = self.inject.tell(InjectFault { wound }) {
            self.refuse(error.to_string());
            return;
        }
        match fault {
            // A reset keeps the incarnation: an answer before the error does not count.
            ObjectFault::ErrorState => {
                self.announce().await;
                self.await_service(incarnation).await;
            }
            _ => {
                tokio::join!(self.announce(), self.await_service(incarnation + 1));
            }
        }
    }

    /// Reports when the fault is present.
    async fn announce(&self) {
        match timeout(ONSET, self.record.struck()).await {
            Ok(at) => self.measurements.tell(ModuleEvent::CarriedOut { order: self.order, at }),
            Err(_) => self.refuse("the fault did not set in".into()),
        }
    }

    /// Reports when this incarnation, or a later one, answers.
    async fn await_service(&self, incarnation: u64) {
        let answered = timeout(PATIENCE, async {
            let mut pokes = 0;
            loop {
                match self.probe.ask_within(Probe {}, ANSWER).await {
                    Ok(answering) if answering >= incarnation => return answering,
                    _ if pokes < EAGER_POKES => yield_now().await,
                    _ => sleep(BETWEEN_POKES).await,
                }
                pokes += 1;
            }
        });
        if let Ok(incarnation) = answered.await {
            self.measurements.tell(ModuleEvent::Served {
                order: self.order,
                at: MachineInstant::now(),
                incarnation,
            });
        }
    }

    async fn flood(&self, messages: u32) {
        for _ in 0..messages / BURST {
            for _ in 0..BURST {
                // A full queue refuses the message, as the flood intends.
                let _ = self.flood_queue.tell(FloodMessage {});
            }
            sleep(BETWEEN_BURSTS).await;
        }
    }

    fn refuse(&self, reason: String) {
        self.measurements.tell(ModuleEvent::Refused { order: self.order, reason });
    }
}
