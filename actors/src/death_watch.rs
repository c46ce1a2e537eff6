//! Death watch: anyone may ask to be told when a life of an object ends.

use crate::host::injection::Injection;
use crate::host::life::LifeToken;
use blastema_contract::reports::Exit;
use blastema_core::{Incarnation, ObjectName};
use blastema_macros::{Event, Structure};
use std::sync::{Arc, Mutex, PoisonError};

/// A life of a watched object has ended.
#[derive(Clone, Debug, PartialEq, Eq, Event)]
#[contract(crate = "crate", name = "blastema/down", version = 1)]
pub struct Down {
    /// Who.
    pub object: ObjectName,
    /// Which of its lives; 0 for one that never lived.
    pub incarnation: Incarnation,
    /// How it ended.
    pub ending: Ending,
}

/// How a life ended.
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
pub enum Ending {
    /// It ended itself, in order.
    Returned,
    /// It could not go on: it did not come to work, or declared a fatal fault.
    Fatal,
    /// It panicked.
    Panicked {
        /// The panic's text.
        text: String,
        /// File and line.
        at: String,
        /// The contract or hook that it was serving.
        during: String,
    },
    /// Its arbiter went away.
    Aborted,
    /// It was told to.
    Stopped,
    /// It was given up, because it hung.
    Abandoned,
    /// It does not live now: it was not started yet, or is between two lives.
    NotAlive,
    /// No object of this name is known.
    Unknown,
}

impl From<&Exit> for Ending {
    fn from(exit: &Exit) -> Self {
        match exit {
            Exit::Returned => Ending::Returned,
            Exit::Fatal => Ending::Fatal,
            Exit::Panicked { text, at, during } => Ending::Panicked {
                text: text.clone(),
                at: at.clone(),
                during: (*during).to_owned(),
            },
            Exit::Aborted => Ending::Aborted,
            Exit::Stopped => Ending::Stopped,
        }
    }
}

/// Somebody who wants to be told.
pub(crate) struct Mourner {
    /// Asking twice is asking once.
    pub(crate) who: ObjectName,
    /// The life that asked; when it has ended, nobody is told any more.
    pub(crate) life: Arc<LifeToken>,
    pub(crate) tell: Box<dyn Fn(Down) + Send + Sync>,
}

/// Those who watch one object: at most one entry for each object of the node.
#[derive(Default)]
pub(crate) struct Mourners(Mutex<Vec<Arc<Mourner>>>);

impl Mourners {
    pub(crate) fn join(&self, mourner: Arc<Mourner>) {
        let mut mourners = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        mourners.retain(|known| known.who != mourner.who && !known.life.has_ended());
        mourners.push(mourner);
    }

    pub(crate) fn tell(&self, down: &Down) {
        let mourners = {
            let mut mourners = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            mourners.retain(|mourner| !mourner.life.has_ended());
            mourners.clone()
        };
        // Outside of the lock: a mourner may be watched by whom it mourns.
        mourners.iter().for_each(|mourner| (mourner.tell)(down.clone()));
    }
}

/// What can be watched.
pub(crate) trait Mortal: Send + Sync {
    /// Tells at once if it is not alive, and whenever a life of it ends.
    fn watch(&self, mourner: Mourner);
    /// Puts a fault into it, where it is a component.
    fn inject(&self, _: Injection) {}
}
