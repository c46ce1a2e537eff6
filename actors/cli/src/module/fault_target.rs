//! Carries out what the director wants done to an object, and tells when the object answers again.

use super::harm::Scar;
use super::measurements::Gauges;
use super::messages::{Harm, Noise, Poke, Wound};
use crate::demo::machine_instant::Moment;
use crate::demo::protocol::{Event, OrderId, Sabotage};
use blastema::prelude::*;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::yield_now;
use tokio::time::{sleep, timeout};

/// How long a harmed object may take until the fault is there.
const ONSET: Duration = Duration::from_secs(2);
/// For one poke: about what a person would call at once.
const ANSWER: Duration = Duration::from_millis(100);
/// Between two pokes of an object that does not answer, or whose old life does.
const BETWEEN_POKES: Duration = Duration::from_millis(1);
/// So many pokes follow each other at once, so that a return within microseconds is seen as such.
const EAGER_POKES: u32 = 100;
/// After this nobody waits for the object any more.
const PATIENCE: Duration = Duration::from_secs(20);
/// Messages of a flood in one go: more than the object serves until the next.
const BURST: u32 = 3;
/// Between two goes.
const BETWEEN_BURSTS: Duration = Duration::from_millis(1);

/// One object that is to be harmed.
#[derive(Debug)]
pub(super) struct Duty {
    gauges: Gauges,
    order: OrderId,
    scar: Arc<Scar>,
    harm: Sender<Harm>,
    poke: Sender<Poke>,
    noise: Sender<Noise>,
}

impl Duty {
    /// Finds the object.
    ///
    /// # Errors
    /// There is none of this name.
    pub(super) fn new(
        node: &Node,
        gauges: &Gauges,
        order: OrderId,
        object: &str,
    ) -> Result<Duty, Why> {
        Ok(Duty {
            gauges: gauges.clone(),
            order,
            scar: gauges.scar(object),
            harm: node.sender(object)?,
            poke: node.sender(object)?,
            noise: node.sender(object)?,
        })
    }

    /// Does it, and tells the director.
    pub(super) async fn carry_out(self, sabotage: Sabotage) {
        let Ok(life) = self.poke.ask_within(Poke {}, ONSET).await else {
            self.refuse("the object does not answer before anything is done to it".into());
            return;
        };
        self.scar.heal();
        let wound = match sabotage {
            Sabotage::Panic => Wound::Panic,
            Sabotage::Hang { millis } => Wound::Hang { millis },
            Sabotage::ErrorState => Wound::Error,
            Sabotage::FailInitialization => Wound::FailInitialization,
            Sabotage::Silence => Wound::Silence,
            Sabotage::Flood { messages } => {
                self.scar.strike();
                self.announce().await;
                self.flood(messages).await;
                self.await_service(0).await;
                return;
            }
        };
        if let Err(error) = self.harm.tell(Harm { wound }) {
            self.refuse(error.to_string());
            return;
        }
        match sabotage {
            // A reset brings back the same life: what answers before the error has struck does not
            // count.
            Sabotage::ErrorState => {
                self.announce().await;
                self.await_service(life).await;
            }
            _ => {
                tokio::join!(self.announce(), self.await_service(life + 1));
            }
        }
    }

    /// Tells when the fault was there.
    async fn announce(&self) {
        match timeout(ONSET, self.scar.struck()).await {
            Ok(at) => self.gauges.tell(Event::CarriedOut { order: self.order, at }),
            Err(_) => self.refuse("the fault did not set in".into()),
        }
    }

    /// Tells when this life, or a later one, answers.
    async fn await_service(&self, life: u64) {
        let answered = timeout(PATIENCE, async {
            let mut pokes = 0;
            loop {
                match self.poke.ask_within(Poke {}, ANSWER).await {
                    Ok(answering) if answering >= life => return answering,
                    _ if pokes < EAGER_POKES => yield_now().await,
                    _ => sleep(BETWEEN_POKES).await,
                }
                pokes += 1;
            }
        });
        if let Ok(life) = answered.await {
            self.gauges.tell(Event::Served { order: self.order, at: Moment::now(), life });
        }
    }

    async fn flood(&self, messages: u32) {
        for _ in 0..messages / BURST {
            for _ in 0..BURST {
                // What does not fit is refused: that is what a flood is about.
                let _ = self.noise.tell(Noise {});
            }
            sleep(BETWEEN_BURSTS).await;
        }
    }

    fn refuse(&self, reason: String) {
        self.gauges.tell(Event::Refused { order: self.order, reason });
    }
}
