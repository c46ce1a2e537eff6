//! Death watch: reports the end of an object's incarnation to each watcher.

use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::injection::Injection;
use crate::platform;
use crate::platform::lock;
use blastema_contract::reports::ExitReason;
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Incarnation, Lifecycle, NodeName, ObjectName};
use blastema_macros::{Event, Structure};
use std::any::Any;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Between two looks at the state of a component that is steered.
const STEER_INTERVAL: Duration = Duration::from_millis(10);

/// An incarnation of a watched object has ended.
#[derive(Clone, Debug, PartialEq, Eq, Event)]
#[contract(crate = "crate", name = "blastema/down", version = 2)]
pub struct Down {
    /// The object that ended.
    pub object: ObjectName,
    /// On which other node it is; `None` for an object of the watcher's own.
    pub node: Option<NodeName>,
    /// The incarnation that ended; 0 if none ever started.
    pub incarnation: Incarnation,
    /// How it ended.
    pub ending: DownReason,
}

/// How an incarnation ended.
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
pub enum DownReason {
    /// The incarnation ended itself, in order.
    Returned,
    /// The incarnation did not become active, or declared a fatal fault.
    Fatal,
    /// The incarnation panicked.
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
    /// The incarnation was stopped.
    Stopped,
    /// The incarnation was abandoned because it hung.
    Abandoned,
    /// The object is not running: it has not started yet, or is between two incarnations.
    NotAlive,
    /// No object of this name is known.
    Unknown,
    /// The object's node has ended, has left, or cannot be reached. The state of the object is
    /// unknown; the incarnation is 0.
    NodeLost {
        /// What is known of the node.
        reason: String,
    },
}

impl From<&ExitReason> for DownReason {
    fn from(exit: &ExitReason) -> Self {
        match exit {
            ExitReason::Returned => DownReason::Returned,
            ExitReason::Fatal => DownReason::Fatal,
            ExitReason::Panicked { text, at, during } => DownReason::Panicked {
                text: text.clone(),
                at: at.clone(),
                during: (*during).to_owned(),
            },
            ExitReason::Aborted => DownReason::Aborted,
            ExitReason::Stopped => DownReason::Stopped,
        }
    }
}

/// An object that watches another one.
pub(crate) struct Watcher {
    /// The watching object; a second watch of the same object replaces the first.
    pub(crate) who: ObjectName,
    /// The incarnation that asked. Once it has ended, it gets no notice.
    pub(crate) incarnation: Arc<IncarnationToken>,
    /// It waits for the next object of the name where the present one is removed.
    pub(crate) outlasts_object: bool,
    pub(crate) tell: Box<dyn Fn(Down) + Send + Sync>,
}

/// How many incarnations of all objects of this process have ended.
static ENDS: AtomicU64 = AtomicU64::new(0);

/// The number of the last end of all. Later ends have higher numbers.
pub(crate) fn last_end_number() -> u64 {
    ENDS.load(SeqCst)
}

/// The last end of an object, with its number among the ends of all objects.
#[derive(Clone, Debug)]
pub(crate) struct NumberedEnd {
    pub(crate) number: u64,
    pub(crate) down: Down,
}

/// The ends of a node's objects, and their watchers, by name. A name is watched whether or not an
/// object has it: one that comes later, or after another one of that name, is watched as well.
/// Clones share it.
#[derive(Clone, Default)]
pub(crate) struct Deaths(Arc<Mutex<SortedMap<ObjectName, Watched>>>);

/// As many as the node has objects that ended, are watched, or are no components.
#[derive(Default)]
struct Watched {
    /// The present incarnation of a supervisor, or of one of the middleware's own, and whether it
    /// lives.
    actor: Option<(Incarnation, bool)>,
    /// At most one for each object of the node.
    watchers: Vec<Arc<Watcher>>,
    last: Option<NumberedEnd>,
}

impl Watched {
    fn prune(&mut self) {
        self.watchers.retain(|watcher| !watcher.incarnation.has_ended());
    }

    fn is_needed(&self) -> bool {
        let is_alive = |watcher: &Arc<Watcher>| !watcher.incarnation.has_ended();
        self.actor.is_some() || self.last.is_some() || self.watchers.iter().any(is_alive)
    }
}

impl Deaths {
    /// An incarnation of an object that is no component begins.
    pub(crate) fn begin(&self, object: &ObjectName, incarnation: Incarnation) {
        lock(&self.0).entry(object.clone()).or_default().actor = Some((incarnation, true));
    }

    /// An incarnation of such an object is in this state.
    pub(crate) fn enter(&self, object: &ObjectName, incarnation: Incarnation, state: Lifecycle) {
        match state {
            Lifecycle::Active => self.begin(object, incarnation),
            Lifecycle::Finalized => self.end(object, DownReason::Stopped),
            _ => {}
        }
    }

    /// The present incarnation of such an object has ended; without effect where none is.
    pub(crate) fn end(&self, object: &ObjectName, ending: DownReason) {
        let mut objects = lock(&self.0);
        let actor = objects.get_mut(object).and_then(|watched| watched.actor.as_mut());
        let Some((incarnation, is_alive)) = actor.filter(|(_, is_alive)| *is_alive) else { return };
        *is_alive = false;
        let incarnation = *incarnation;
        drop(objects);
        self.tell(&Down { object: object.clone(), node: None, incarnation, ending });
    }

    /// Keeps this end of an object, and sends it to all that watch its name.
    pub(crate) fn tell(&self, down: &Down) {
        let watchers = {
            let mut objects = lock(&self.0);
            let watched = objects.entry(down.object.clone()).or_default();
            let number = ENDS.fetch_add(1, SeqCst) + 1;
            watched.last = Some(NumberedEnd { number, down: down.clone() });
            watched.prune();
            watched.watchers.clone()
        };
        // Outside of the lock: a watcher may be watched by the object that it watches.
        watchers.iter().for_each(|watcher| (watcher.tell)(down.clone()));
    }

    /// The object is no more: its name is free.
    pub(crate) fn forget(&self, object: &ObjectName) {
        self.end(object, DownReason::Stopped);
        let mut objects = lock(&self.0);
        let Some(watched) = objects.get_mut(object) else { return };
        (watched.actor, watched.last) = (None, None);
        watched.watchers.retain(|watcher| watcher.outlasts_object);
        if !watched.is_needed() {
            objects.remove(object);
        }
    }

    /// Adds a watcher. Returns the last end of the object, which the watcher is not told.
    pub(crate) fn join(&self, object: &ObjectName, watcher: Arc<Watcher>) -> Option<NumberedEnd> {
        let mut objects = lock(&self.0);
        if !objects.contains_key(object) {
            objects.retain(|_, watched| watched.is_needed());
        }
        let watched = objects.entry(object.clone()).or_default();
        watched.watchers.retain(|known| known.who != watcher.who);
        watched.prune();
        watched.watchers.push(watcher);
        watched.last.clone()
    }

    /// The present incarnation of an object that is no component, and whether it lives.
    pub(crate) fn actor(&self, object: &ObjectName) -> Option<(Incarnation, bool)> {
        lock(&self.0).get(object)?.actor
    }

    /// How many watch this name.
    #[cfg(test)]
    pub(crate) fn watchers(&self, object: &ObjectName) -> usize {
        lock(&self.0).get(object).map_or(0, |watched| watched.watchers.len())
    }
}

/// What can be watched.
pub(crate) trait Watchable: Send + Sync {
    /// Its last incarnation, where none is there now.
    fn absent(&self) -> Option<Incarnation> {
        None
    }
    /// Its cell, where it is a component.
    fn cell(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        None
    }
    /// Its type, where it is a component.
    fn component_type(&self) -> Option<&'static str> {
        None
    }
    /// Its incarnation and state, where it is a component.
    fn life_cycle(&self) -> Option<(Incarnation, Lifecycle)> {
        None
    }
    /// Asks it to return to work, or to leave it; without effect where its state does not allow it.
    fn activate(&self, _active: bool) {}
    /// Puts a fault into it, where it is a component.
    fn inject(&self, _: Injection) {}
    /// Listens to this topic too, as by the subscription of this number that it declares.
    fn listen(self: Arc<Self>, _like: usize, _topic: &ObjectName) -> Result<(), DeliveryError> {
        Ok(())
    }
    /// Listens to this topic no longer.
    fn stop_listening(&self, _topic: &ObjectName) {}
}

impl dyn Watchable {
    /// Has a component work, or leave work, and waits until it does. Says why it cannot.
    pub(crate) async fn steer(&self, wanted: Lifecycle) -> Result<(), String> {
        loop {
            match self.life_cycle().map(|(_, state)| state) {
                Some(state) if state == wanted => return Ok(()),
                Some(Lifecycle::Active | Lifecycle::Initialized) => {
                    self.activate(wanted == Lifecycle::Active);
                }
                // It becomes active by itself.
                Some(Lifecycle::Created) => {}
                Some(Lifecycle::Error) => return Err("it is in error: reset it".to_owned()),
                Some(state) => return Err(format!("it is {state}: restart it")),
                None => return Err("it is no component".to_owned()),
            }
            platform::sleep(STEER_INTERVAL).await;
        }
    }
}
