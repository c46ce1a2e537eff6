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
//! ends of each watched object: of several between two questions the last is told. That the
//! object's node is lost is seen by the session, which resolves the request; where no request was
//! on its way, by the next answer, which another service gives.
//!
//! A node has at most as many questions waiting as it leaves free (a dynamic threshold, Choudhury
//! and Hahne 1998): one alone half of the capacity, two a third each. However many a node asks,
//! others find capacity. What goes beyond is refused, counted by node, and logged.

use crate::messaging::death_watch::{Down, DownReason, Watcher};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::registry::access::MessageOrigin;
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, Registry, WeakRegistry};
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Incarnation, ObjectAddress, ObjectName};
use blastema_macros::{Request, Structure};
use std::future::Future;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tracing::warn;

/// Under which name nodes ask each other. It is no object that others can see.
const OBJECT: &str = "net/deaths";
/// How long one question waits for an answer. Shorter costs messages; longer keeps the questions of
/// watchers that have ended.
const WATCH_TIMEOUT: Duration = Duration::from_secs(30);
/// How often a node that was lost is asked again.
const RETRY_DELAY: Duration = Duration::from_secs(1);
/// Questions that may wait at one node: as many as a large robot has watches to it.
const WAITING_MAX: usize = 4096;
/// Nodes of which refused questions are counted: as many as there are sessions with.
const REFUSED_MAX: usize = 512;
/// The most bytes of a panic's text that go to another node.
const TEXT_MAX: usize = 4096;

/// Asks for the next end of an incarnation of the object, after those that the asker knows of;
/// without them, how the object stands now.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/await-end", version = 2, reply = Watched)]
struct AwaitEnd {
    object: ObjectName,
    seen: Option<SeenEnds>,
}

/// So many ends of an object were counted by this service: each start of a node has another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
struct SeenEnds {
    service: u64,
    ends: u64,
}

/// How an object stands: how many ends were counted, and the last of them, or why it does not live.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
struct Watched {
    seen: SeenEnds,
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
        let lost = |reason: String| {
            down(LastEnd { incarnation, ending: DownReason::NodeLost { reason } });
        };
        match sender {
            Ok(sender) => ask_on(&sender, &object, down, lost).await,
            // This node has no network.
            Err(why) => lost(why.to_string()),
        }
    }
}

async fn ask_on(
    sender: &Sender<AwaitEnd>,
    object: &ObjectName,
    down: impl Fn(LastEnd),
    lost: impl Fn(String),
) {
    let (mut seen, mut is_lost) = (None::<SeenEnds>, false);
    loop {
        let question = AwaitEnd { object: object.clone(), seen };
        let why = match sender.ask_within(question, WATCH_TIMEOUT).await {
            Ok(Watched { seen: now, ended }) => {
                if seen.is_some_and(|seen| seen.service != now.service) {
                    lost("its node has started again".to_owned());
                }
                (seen, is_lost) = (Some(now), false);
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
                lost(why.to_string());
                (seen, is_lost) = (None, true);
            }
            _ => {}
        }
        platform::sleep(RETRY_DELAY).await;
    }
}

/// Answers other nodes that watch objects of this one.
pub(crate) fn serve(registry: &Registry) {
    let service_fn = DeathWatchService::new(registry);
    let serve = move |AwaitEnd { object, seen }, by, answer| {
        service_fn.serve(object, seen, Waiting { by, answer });
    };
    let object = ObjectName::new(OBJECT).expect("a name of letters");
    registry.register_hidden(
        object,
        ContractPort::of_service_fn(ServiceFn::<AwaitEnd>(Arc::new(serve))),
    );
}

/// The objects of this node that others watch. Clones share them.
#[derive(Clone)]
struct DeathWatchService {
    /// Of the random source: no service of another start has it.
    number: u64,
    registry: WeakRegistry,
    objects: Arc<Mutex<SortedMap<ObjectName, Counted>>>,
    /// How many questions of each node were refused.
    refused: Arc<Mutex<SortedMap<MessageOrigin, u64>>>,
}

/// One object. There are as many as the node has or had objects that others watched.
#[derive(Default)]
struct Counted {
    ends: u64,
    last: Option<LastEnd>,
    waiting: Vec<Waiting>,
}

/// One question that waits for its answer.
struct Waiting {
    by: MessageOrigin,
    answer: Responder<AwaitEnd>,
}

impl DeathWatchService {
    fn new(registry: &Registry) -> Self {
        let (objects, refused) = (Arc::default(), Arc::default());
        let number = platform::random_seed();
        DeathWatchService { number, registry: registry.downgrade(), objects, refused }
    }

    fn lock(&self) -> MutexGuard<'_, SortedMap<ObjectName, Counted>> {
        self.objects.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn watched(&self, ends: u64, ended: Option<LastEnd>) -> Watched {
        Watched { seen: SeenEnds { service: self.number, ends }, ended }
    }

    fn serve(&self, object: ObjectName, seen: Option<SeenEnds>, question: Waiting) {
        // What another start of this node has counted says nothing.
        let seen = seen.filter(|seen| seen.service == self.number).map(|seen| seen.ends);
        let before = self.lock().get(&object).map_or(0, |counted| counted.ends);
        let absent = self.watch(&object);
        let mut objects = self.lock();
        let (mut waiting, mut of_asker) = (0, 0);
        for counted in objects.values_mut() {
            counted.waiting.retain(|waiting| waiting.answer.is_wanted());
            waiting += counted.waiting.len();
            of_asker += counted.waiting.iter().filter(|other| other.by == question.by).count();
        }
        if absent.as_ref().is_some_and(|absent| absent.ending == DownReason::Unknown) {
            let counted = objects.remove(&object).unwrap_or_default();
            drop(objects);
            let watched = self.watched(counted.ends, absent);
            let all = counted.waiting.into_iter().chain([question]);
            return all.for_each(|waiting| waiting.answer.give(watched.clone()));
        }
        let counted = objects.entry(object).or_default();
        let ended = match seen {
            Some(seen) if seen == counted.ends && of_asker < WAITING_MAX - waiting => {
                return counted.waiting.push(question);
            }
            Some(seen) if seen == counted.ends => {
                drop(objects);
                self.count_refused(question.by, of_asker);
                return question.answer.refuse(DeliveryError::Full, None);
            }
            Some(_) => counted.last.clone(),
            // It may have ended since the watch began.
            None if absent.is_none() && counted.ends > before => counted.last.clone(),
            None => absent,
        };
        let watched = self.watched(counted.ends, ended);
        drop(objects);
        question.answer.give(watched);
    }

    /// A question was refused. It is logged whenever the number of them has doubled.
    fn count_refused(&self, by: MessageOrigin, waiting: usize) {
        let mut refused = self.refused.lock().unwrap_or_else(PoisonError::into_inner);
        if refused.len() >= REFUSED_MAX && !refused.contains_key(&by) {
            return;
        }
        let times = refused.entry(by).or_default();
        *times = times.saturating_add(1);
        let times = *times;
        drop(refused);
        if let (true, Some(node)) = (times.is_power_of_two(), by.peer) {
            warn!(%node, waiting, times, "refused: the node watches as many objects as it may");
        }
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
        let watched = self.watched(ends, ended);
        waiting.into_iter().for_each(|waiting| waiting.answer.give(watched.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messaging::death_watch::Deaths;
    use blastema_core::NodeName;
    use blastema_core::net::NodeId;
    use blastema_doubles::{advance, paused};

    /// A question whose answer is kept.
    fn ask(
        service: &DeathWatchService,
        by: &str,
    ) -> Arc<Mutex<Option<Result<Watched, DeliveryError>>>> {
        ask_after(service, by, service.number)
    }

    /// The same after an answer of this service.
    fn ask_after(
        service: &DeathWatchService,
        by: &str,
        seen_service: u64,
    ) -> Arc<Mutex<Option<Result<Watched, DeliveryError>>>> {
        let answered = Arc::new(Mutex::new(None));
        let keep = answered.clone();
        let answer = Responder::called_back(
            Box::new(move |result| *keep.lock().unwrap() = Some(result)),
            None,
        );
        let by = MessageOrigin { peer: Some(NodeId::of(&NodeName::new(by).unwrap())) };
        let arm = ObjectName::new("arm").unwrap();
        let seen = SeenEnds { service: seen_service, ends: 0 };
        service.serve(arm, Some(seen), Waiting { by, answer });
        answered
    }

    /// How many questions of this node come to wait, of so many.
    fn waiting(service: &DeathWatchService, by: &str, asked: usize) -> usize {
        let refused = |result| matches!(result, Some(Err(DeliveryError::Full)));
        let all: Vec<_> = (0..asked).map(|_| ask(service, by)).collect();
        all.into_iter().filter(|answer| !refused(answer.lock().unwrap().clone())).count()
    }

    #[test]
    fn a_node_that_was_started_again_between_two_questions_was_lost() {
        paused(async {
            let asked = Arc::new(Mutex::new(Vec::new()));
            let questions = asked.clone();
            let serve = move |AwaitEnd { seen, .. }, _, answer: Responder<AwaitEnd>| {
                let mut asked = questions.lock().unwrap();
                asked.push(seen);
                let watched =
                    |service| Watched { seen: SeenEnds { service, ends: 0 }, ended: None };
                match asked.len() {
                    1 => answer.give(watched(7)),
                    2 => answer.refuse(DeliveryError::Full, None),
                    3 => answer.give(watched(8)),
                    _ => std::mem::forget(answer),
                }
            };
            let sender = Sender(Arc::new(ServiceFn::<AwaitEnd>(Arc::new(serve))));
            let told = Arc::new(Mutex::new(Vec::new()));
            let losses = told.clone();
            let arm = ObjectName::new("arm").unwrap();
            actix_rt::spawn(async move {
                let lost = |reason| losses.lock().unwrap().push(reason);
                ask_on(&sender, &arm, |end| panic!("{end:?}"), lost).await;
            });
            advance(5 * RETRY_DELAY).await;

            assert_eq!(*told.lock().unwrap(), ["its node has started again"]);
            let seen = |service| Some(SeenEnds { service, ends: 0 });
            assert_eq!(*asked.lock().unwrap(), [None, seen(7), seen(7), seen(8)]);
        });
    }

    #[test]
    fn what_another_start_of_the_node_has_counted_is_answered_at_once() {
        let (registry, deaths) = (Registry::default(), Deaths::default());
        deaths.begin(&ObjectName::new("arm").unwrap(), Incarnation(1));
        registry.watch_in(deaths);
        let service = DeathWatchService::new(&registry);
        let answer = ask_after(&service, "honest", service.number.wrapping_add(1));
        let answered = answer.lock().unwrap().clone().expect("at once").expect("it is told");
        assert_eq!(answered.seen, SeenEnds { service: service.number, ends: 0 });
        assert!(answered.ended.is_none(), "it lives");
        assert!(ask(&service, "honest").lock().unwrap().is_none(), "it waits");
    }

    #[test]
    fn a_node_that_watches_without_end_leaves_capacity_for_others() {
        let (registry, deaths) = (Registry::default(), Deaths::default());
        deaths.begin(&ObjectName::new("arm").unwrap(), Incarnation(1));
        registry.watch_in(deaths.clone());
        let service = DeathWatchService::new(&registry);

        assert_eq!(waiting(&service, "greedy", 2 * WAITING_MAX), WAITING_MAX / 2);
        assert_eq!(waiting(&service, "second", 2 * WAITING_MAX), WAITING_MAX / 4);
        assert_eq!(waiting(&service, "honest", 100), 100);

        let refused: Vec<_> = service.refused.lock().unwrap().values().copied().collect();
        assert_eq!(refused.iter().sum::<u64>(), (WAITING_MAX * 3 / 2 + WAITING_MAX * 7 / 4) as u64);
        let answer = ask(&service, "honest");
        deaths.end(&ObjectName::new("arm").unwrap(), DownReason::Stopped);
        let answer = answer.lock().unwrap().clone();
        assert_eq!(answer.expect("it ends").expect("it is told").seen.ends, 1);
        assert_eq!(waiting(&service, "greedy", 1), 1, "its share is free again");
    }
}
