//! Injected faults of the demonstration's objects, and their records.

use super::messages::{FloodMessage, InjectFault, ObjectHarm, Probe};
use crate::machine_instant::MachineInstant;
use blastema::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::Notify;

/// How long an object needs for one message of a flood, so that its queue fills.
const NOISE: Duration = Duration::from_millis(2);

/// The record of a harm that outlives the harmed incarnation. One for each object.
#[derive(Debug, Default)]
pub(super) struct HarmRecord {
    struck_ns: AtomicU64,
    fails_to_initialize: AtomicBool,
    struck: Notify,
}

/// The harm of one incarnation.
#[derive(Debug)]
pub(super) struct HarmState {
    record: Arc<HarmRecord>,
    is_in_error: bool,
}

impl HarmRecord {
    /// Deletes the last harm.
    pub(super) fn heal(&self) {
        self.struck_ns.store(0, Ordering::SeqCst);
    }

    /// Records that the fault is present from now on.
    pub(super) fn strike(&self) {
        self.struck_ns.store(MachineInstant::now().as_nanos(), Ordering::SeqCst);
        self.struck.notify_one();
    }

    /// Waits until the fault is present, and returns since when.
    pub(super) async fn struck(&self) -> MachineInstant {
        loop {
            match self.struck_ns.load(Ordering::SeqCst) {
                0 => self.struck.notified().await,
                nanos => return MachineInstant::from_nanos(nanos),
            }
        }
    }
}

impl HarmState {
    /// None yet.
    pub(super) fn new(record: &Arc<HarmRecord>) -> HarmState {
        HarmState { record: record.clone(), is_in_error: false }
    }

    /// To be called in `on_initialize`.
    pub(super) fn initialize(&self) -> Result<(), Failure> {
        if self.record.fails_to_initialize.swap(false, Ordering::SeqCst) {
            self.record.strike();
            return Err("the device does not answer, as ordered".into());
        }
        Ok(())
    }

    /// To be called in `on_execute`.
    pub(super) fn execute(&mut self) -> Result<(), Failure> {
        if std::mem::take(&mut self.is_in_error) {
            self.record.strike();
            return Err("the device reports an error, as ordered".into());
        }
        Ok(())
    }

    /// Executes the harm.
    ///
    /// # Panics
    /// If that is the wound.
    pub(super) fn suffer<C: Component>(&mut self, wound: ObjectHarm, cx: &mut Context<C>) {
        match wound {
            ObjectHarm::Panic => {
                self.record.strike();
                panic!("as ordered");
            }
            ObjectHarm::Hang { millis } => {
                self.record.strike();
                std::thread::sleep(Duration::from_millis(millis));
            }
            ObjectHarm::Error => self.is_in_error = true,
            ObjectHarm::FailInitialization => {
                self.record.fails_to_initialize.store(true, Ordering::SeqCst);
                panic!("as ordered, to be initialised again");
            }
            ObjectHarm::Silence => {
                self.record.strike();
                cx.set_interval(None);
            }
        }
    }
}

/// The ports that every object of the demonstration has beside its own.
pub(super) fn declare<C: Handle<InjectFault> + Handle<Probe> + Handle<FloodMessage>>(
    ports: &mut Ports<C>,
) {
    ports.serve::<InjectFault>().serve::<Probe>().accept::<FloodMessage>();
}

/// Serves one message of a flood.
pub(super) async fn endure() {
    tokio::time::sleep(NOISE).await;
}

/// Lets a component with a field `harm` take what [`declare`] declares.
macro_rules! vulnerable {
    ($component:ty) => {
        impl Handle<$crate::module::messages::InjectFault> for $component {
            async fn handle(
                &mut self,
                harm: $crate::module::messages::InjectFault,
                cx: &mut Context<Self>,
            ) {
                self.harm.suffer(harm.wound, cx);
            }
        }

        impl Handle<$crate::module::messages::Probe> for $component {
            async fn handle(
                &mut self,
                _: $crate::module::messages::Probe,
                cx: &mut Context<Self>,
            ) -> u64 {
                cx.incarnation().0
            }
        }

        impl Handle<$crate::module::messages::FloodMessage> for $component {
            async fn handle(
                &mut self,
                _: $crate::module::messages::FloodMessage,
                _: &mut Context<Self>,
            ) {
                $crate::module::harm::endure().await;
            }
        }
    };
}
pub(super) use vulnerable;
