//! Death watch: reports the end of an object's incarnation to each watcher.

use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::injection::Injection;
use crate::platform;
use blastema_contract::reports::ExitReason;
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Incarnation, Lifecycle, NodeName, ObjectName};
use blastema_macros::{Event, Structure};
use std::any::Any;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
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
    pub(crate) tell: Box<dyn Fn(Down) + Send + Sync>,
}

/// How many incarnations of all objects of this process have ended.
static ENDS: AtomicU64 = AtomicU64::new(0);

/// The number of the last end of all. Later ends have higher numbers.
#[cfg(feature = "network")]
pub(crate) fn last_end_number() -> u64 {
    ENDS.load(SeqCst)
}

/// The last end of an object, with its number among the ends of all objects.
#[derive(Clone, Debug)]
#[cfg_attr(not(feature = "network"), expect(dead_code, reason = "only other nodes ask for it"))]
pub(crate) struct NumberedEnd {
    pub(crate) number: u64,
    pub(crate) down: Down,
}

/// The watchers of one object, and its last end.
#[derive(Default)]
pub(crate) struct Watchers(Mutex<WatcherList>);

#[derive(Default)]
struct WatcherList {
    /// At most one entry for each object of the node.
    watchers: Vec<Arc<Watcher>>,
    last: Option<NumberedEnd>,
}

impl Watchers {
    fn lock(&self) -> MutexGuard<'_, WatcherList> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a watcher, and returns the last end, which the watcher is not told.
    pub(crate) fn join(&self, watcher: Arc<Watcher>) -> Option<NumberedEnd> {
        let mut list = self.lock();
        list.watchers.retain(|known| known.who != watcher.who && !known.incarnation.has_ended());
        list.watchers.push(watcher);
        list.last.clone()
    }

    /// Keeps this end, and sends it to all of them.
    pub(crate) fn tell(&self, down: &Down) {
        let watchers = {
            let mut list = self.lock();
            let number = ENDS.fetch_add(1, SeqCst) + 1;
            list.last = Some(NumberedEnd { number, down: down.clone() });
            list.watchers.retain(|watcher| !watcher.incarnation.has_ended());
            list.watchers.clone()
        };
        // Outside of the lock: a watcher may be watched by the object that it watches.
        watchers.iter().for_each(|watcher| (watcher.tell)(down.clone()));
    }

    /// How many entries there are.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        self.lock().watchers.len()
    }
}

/// The ends of objects that are not components: supervisors, and the middleware's own. Clones share
/// it.
#[derive(Clone, Default)]
pub(crate) struct Deaths(Arc<Mutex<SortedMap<ObjectName, Watched>>>);

/// As many as the node has such objects.
#[derive(Default)]
struct Watched {
    incarnation: Incarnation,
    is_alive: bool,
    watchers: Arc<Watchers>,
}

impl Deaths {
    fn lock(&self) -> MutexGuard<'_, SortedMap<ObjectName, Watched>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An incarnation of the object begins.
    pub(crate) fn begin(&self, object: &ObjectName, incarnation: Incarnation) {
        let mut objects = self.lock();
        let watched = objects.entry(object.clone()).or_default();
        (watched.incarnation, watched.is_alive) = (incarnation, true);
    }

    /// An incarnation of the object is in this state.
    pub(crate) fn enter(&self, object: &ObjectName, incarnation: Incarnation, state: Lifecycle) {
        match state {
            Lifecycle::Active => self.begin(object, incarnation),
            Lifecycle::Finalized => self.end(object, DownReason::Stopped),
            _ => {}
        }
    }

    /// The present incarnation of the object has ended; without effect where none is.
    pub(crate) fn end(&self, object: &ObjectName, ending: DownReason) {
        let mut objects = self.lock();
        let alive = objects.get_mut(object).filter(|watched| watched.is_alive);
        let Some(Watched { incarnation, is_alive, watchers }) = alive else { return };
        *is_alive = false;
        let (incarnation, watchers) = (*incarnation, watchers.clone());
        drop(objects);
        watchers.tell(&Down { object: object.clone(), node: None, incarnation, ending });
    }

    /// The object is no more: its name is that of none.
    pub(crate) fn forget(&self, object: &ObjectName) {
        self.end(object, DownReason::Stopped);
        self.lock().remove(object);
    }

    /// As [`Watchable::watch`]. A name that never was an object's gives the watcher back.
    pub(crate) fn watch(
        &self,
        object: &ObjectName,
        watcher: Watcher,
    ) -> Result<Option<NumberedEnd>, Watcher> {
        let objects = self.lock();
        let Some(Watched { incarnation, is_alive, watchers }) = objects.get(object) else {
            return Err(watcher);
        };
        let (incarnation, is_alive, watchers) = (*incarnation, *is_alive, watchers.clone());
        drop(objects);
        let watcher = Arc::new(watcher);
        let last = watchers.join(watcher.clone());
        if !is_alive {
            let (object, ending) = (object.clone(), DownReason::NotAlive);
            (watcher.tell)(Down { object, node: None, incarnation, ending });
        }
        Ok(last)
    }
}

/// What can be watched.
pub(crate) trait Watchable: Send + Sync {
    /// Reports at once if it is not alive, and whenever an incarnation of it ends. Returns its last
    /// end.
    fn watch(&self, watcher: Watcher) -> Option<NumberedEnd>;
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
