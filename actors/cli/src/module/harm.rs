//! How an object of the demonstration is harmed on command, and what remembers it.

use super::messages::{Harm, Noise, Poke, Wound};
use crate::demo::machine_instant::Moment;
use blastema::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::Notify;

/// How long an object needs for one message of a flood, so that its queue fills.
const NOISE: Duration = Duration::from_micros(200);

/// What stays of a wound when the life that suffered it is over. One for each object.
#[derive(Debug, Default)]
pub(super) struct Scar {
    struck_ns: AtomicU64,
    fails_to_initialize: AtomicBool,
    struck: Notify,
}

/// The wounds of one life.
#[derive(Debug)]
pub(super) struct Wounds {
    scar: Arc<Scar>,
    is_in_error: bool,
}

impl Scar {
    /// Forgets the last wound.
    pub(super) fn heal(&self) {
        self.struck_ns.store(0, Ordering::SeqCst);
    }

    /// The fault is there, now.
    pub(super) fn strike(&self) {
        self.struck_ns.store(Moment::now().as_nanos(), Ordering::SeqCst);
        self.struck.notify_one();
    }

    /// Waits until the fault is there; when that was.
    pub(super) async fn struck(&self) -> Moment {
        loop {
            match self.struck_ns.load(Ordering::SeqCst) {
                0 => self.struck.notified().await,
                nanos => return Moment::from_nanos(nanos),
            }
        }
    }
}

impl Wounds {
    /// None yet.
    pub(super) fn new(scar: &Arc<Scar>) -> Wounds {
        Wounds { scar: scar.clone(), is_in_error: false }
    }

    /// Belongs into `on_initialize`.
    pub(super) fn initialize(&self) -> Result<(), Failure> {
        if self.scar.fails_to_initialize.swap(false, Ordering::SeqCst) {
            self.scar.strike();
            return Err("the device does not answer, as ordered".into());
        }
        Ok(())
    }

    /// Belongs into `on_execute`.
    pub(super) fn execute(&mut self) -> Result<(), Failure> {
        if std::mem::take(&mut self.is_in_error) {
            self.scar.strike();
            return Err("the device reports an error, as ordered".into());
        }
        Ok(())
    }

    /// Suffers a wound.
    ///
    /// # Panics
    /// If that is the wound.
    pub(super) fn suffer<C: Component>(&mut self, wound: Wound, cx: &mut Context<C>) {
        match wound {
            Wound::Panic => {
                self.scar.strike();
                panic!("as ordered");
            }
            Wound::Hang { millis } => {
                self.scar.strike();
                std::thread::sleep(Duration::from_millis(millis));
            }
            Wound::Error => self.is_in_error = true,
            Wound::FailInitialization => {
                self.scar.fails_to_initialize.store(true, Ordering::SeqCst);
                panic!("as ordered, to be initialised anew");
            }
            Wound::Silence => {
                self.scar.strike();
                cx.set_interval(None);
            }
        }
    }
}

/// The ports that every object of the demonstration has beside its own.
pub(super) fn declare<C: Handle<Harm> + Handle<Poke> + Handle<Noise>>(ports: &mut Ports<C>) {
    ports.serve::<Harm>().serve::<Poke>().accept::<Noise>();
}

/// Serves one message of a flood.
pub(super) async fn endure() {
    tokio::time::sleep(NOISE).await;
}

/// Lets a component with a field `wounds` take what [`declare`] declares.
macro_rules! vulnerable {
    ($component:ty) => {
        impl Handle<$crate::module::messages::Harm> for $component {
            async fn handle(
                &mut self,
                harm: $crate::module::messages::Harm,
                cx: &mut Context<Self>,
            ) {
                self.wounds.suffer(harm.wound, cx);
            }
        }

        impl Handle<$crate::module::messages::Poke> for $component {
            async fn handle(
                &mut self,
                _: $crate::module::messages::Poke,
                cx: &mut Context<Self>,
            ) -> u64 {
                cx.incarnation().0
            }
        }

        impl Handle<$crate::module::messages::Noise> for $component {
            async fn handle(&mut self, _: $crate::module::messages::Noise, _: &mut Context<Self>) {
                $crate::module::harm::endure().await;
            }
        }
    };
}
pub(super) use vulnerable;
