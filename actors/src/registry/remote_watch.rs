//! Death watch between nodes.
//!
//! ```text
//!  watcher ── AwaitEnd(object, seen) ──► ServiceFn of the object's node ── Watcher ──► the object
//!     ▲                                     │ at once, or when it ends
//!     └────────── Watched(ends, ended) ◄────┘
//! ```
//!
//! The watcher asks, and is answered when the object ends; then it asks for the next end. The task
//! that asks belongs to the watcher's incarnation and ends with it. The object's node counts the
//! ends of each watched object, so that none between two questions is missed. That the object's
//! node is lost is seen by the session, which resolves the request.

use crate::messaging::death_watch::{Down, DownReason, Watcher};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, Registry, WeakRegistry};
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Incarnation, ObjectAddress, ObjectName};
use blastema_macros::{Request, Structure};
use std::future::Future;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Under which name nodes ask each other. It is no object that others can see.
const OBJECT: &str = "net/deaths";
/// How long one question waits for an answer. Shorter costs messages; longer keeps the questions of
/// watchers that have ended.
const WATCH_TIMEOUT: Duration = Duration::from_secs(30);
/// How often a node that was lost is asked again.
const RETRY_DELAY: Duration = Duration::from_secs(1);
/// Questions that may wait at one node: as many as a large robot has watches to it.
const WAITING_MAX: usize = 4096;
/// The most bytes of a panic's text that go to another node.
const TEXT_MAX: usize = 4096;

/// Asks for the next end of an incarnation of the object, after so many that the asker knows of;
/// without a number, how the object stands now.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/await-end", version = 1, reply = Watched)]
struct AwaitEnd {
    object: ObjectName,
    seen: Option<u64>,
}

/// How an object stands: how many ends the service_fn has counted, and the last of them, or why it
/// does not live.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
struct Watched {
    ends: u64,
    ended: Option<LastEnd>,
}

#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
struct LastEnd {
    incarnation: Incarnation,
    ending: DownReason,
}

impl From<Down> for LastEnd {
    fn from(down: Down) -> Self {
        let Down { incarnation, mut ending, .. } = down;
        if let DownReason::Panicked { text, .. } = &mut ending {
            let end = (0..=TEXT_MAX.min(text.len())).rev().find(|at| text.is_char_boundary(*at));
            text.truncate(end.unwrap_or(0));
        }
        LastEnd { incarnation, ending }
    }
}

/// Tells of every end of that object, and of the loss of its node, for as long as it is polled.
/// Completes when the node knows no such object.
pub(crate) fn follow(
    registry: Registry,
    ObjectAddress { node, object }: ObjectAddress,
    tell: Box<dyn Fn(Down)>,
) -> impl Future<Output = ()> {
    let sender = registry.sender::<AwaitEnd>(&format!("{node}:{OBJECT}"));
    async move {
        let down = |LastEnd { incarnation, ending }| {
            tell(Down { object: object.clone(), node: Some(node.clone()), incarnation, ending });
        };
        let incarnation = Incarnation(0);
        let lost = |why: &DeliveryError| {
            down(LastEnd { incarnation, ending: DownReason::NodeLost { reason: why.to_string() } });
        };
        match sender {
            Ok(sender) => ask_on(&sender, &object, down, lost).await,
            // This node has no network.
            Err(why) => lost(&why),
        }
    }
}

async fn ask_on(
    sender: &Sender<AwaitEnd>,
    object: &ObjectName,
    down: impl Fn(LastEnd),
    lost: impl Fn(&DeliveryError),
) {
    let (mut seen, mut is_lost) = (None, false);
    loop {
        let question = AwaitEnd { object: object.clone(), seen };
        let why = match sender.ask_within(question, WATCH_TIMEOUT).await {
            Ok(Watched { ends, ended }) => {
                (seen, is_lost) = (Some(ends), false);
                if let Some(ended) = ended {
                    let is_unknown = ended.ending == DownReason::Unknown;
                    down(ended);
                    if is_unknown {
                        return;
                    }
                }
                continue;
            }
            Err(error) => error.kind,
        };
        match why {
            DeliveryError::DeadlinePassed => continue, // No incarnation has ended.
            // Of no concern to the object: for want of room, or because the watcher itself is
            // fenced.
            DeliveryError::Full
            | DeliveryError::WayFull { .. }
            | DeliveryError::Restarting
            | DeliveryError::Fenced => {}
            why if !is_lost => {
                lost(&why);
                (seen, is_lost) = (None, true);
            }
            _ => {}
        }
        platform::sleep(RETRY_DELAY).await;
    }
}

/// Answers other nodes that watch objects of this one.
pub(crate) fn serve(registry: &Registry) {
    let service_fn = DeathWatchService { registry: registry.downgrade(), objects: Arc::default() };
    let serve = move |AwaitEnd { object, seen }, _, answer| service_fn.serve(object, seen, answer);
    let object = ObjectName::new(OBJECT).expect("a name of letters");
    registry.register_hidden(
        object,
        ContractPort::of_service_fn(ServiceFn::<AwaitEnd>(Arc::new(serve))),
    );
}

/// The objects of this node that others watch. Clones share them.
#[derive(Clone)]
struct DeathWatchService {
    registry: WeakRegistry,
    objects: Arc<Mutex<SortedMap<ObjectName, Counted>>>,
}

/// One object. There are as many as the node has or had objects that others watched.
#[derive(Default)]
struct Counted {
    ends: u64,
    last: Option<LastEnd>,
    waiting: Vec<Responder<AwaitEnd>>,
}

impl DeathWatchService {
    fn lock(&self) -> MutexGuard<'_, SortedMap<ObjectName, Counted>> {
        self.objects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn serve(&self, object: ObjectName, seen: Option<u64>, answer: Responder<AwaitEnd>) {
        let absent = self.watch(&object);
        let mut objects = self.lock();
        let waiting: usize = objects
            .values_mut()
            .map(|counted| {
                counted.waiting.retain(Responder::is_wanted);
                counted.waiting.len()
            })
            .sum();
        if absent.as_ref().is_some_and(|absent| absent.ending == DownReason::Unknown) {
            let counted = objects.remove(&object).unwrap_or_default();
            drop(objects);
            let watched = Watched { ends: counted.ends, ended: absent };
            let all = counted.waiting.into_iter().chain([answer]);
            return all.for_each(|answer| answer.give(watched.clone()));
        }
        let counted = objects.entry(object).or_default();
        let ended = match seen {
            Some(seen) if seen == counted.ends && waiting < WAITING_MAX => {
                return counted.waiting.push(answer);
            }
            Some(seen) if seen == counted.ends => {
                drop(objects);
                return answer.refuse(DeliveryError::Full, None);
            }
            Some(_) => counted.last.clone(),
            None => absent,
        };
        let watched = Watched { ends: counted.ends, ended };
        drop(objects);
        answer.give(watched);
    }

    /// Watches the object, unless it is watched already; says why it does not live now, if so.
    fn watch(&self, object: &ObjectName) -> Option<LastEnd> {
        let registry = self.registry.upgrade()?;
        let absent = Arc::new(Mutex::new(None));
        let (service_fn, reported) = (self.clone(), absent.clone());
        let tell = move |down: Down| match down.ending {
            // Only ever said while the watch begins.
            DownReason::NotAlive | DownReason::Unknown => {
                *reported.lock().unwrap_or_else(PoisonError::into_inner) =
                    Some(LastEnd::from(down));
            }
            _ => service_fn.end(down),
        };
        let who = ObjectName::new(OBJECT).expect("a name of letters");
        let incarnation = Arc::new(IncarnationToken::default());
        registry.watch(object.clone(), Watcher { who, incarnation, tell: Box::new(tell) });
        absent.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn end(&self, down: Down) {
        let mut objects = self.lock();
        let counted = objects.entry(down.object.clone()).or_default();
        let ended = Some(LastEnd::from(down));
        counted.ends += 1;
        counted.last.clone_from(&ended);
        let (ends, waiting) = (counted.ends, std::mem::take(&mut counted.waiting));
        drop(objects);
        waiting.into_iter().for_each(|answer| answer.give(Watched { ends, ended: ended.clone() }));
    }
}
