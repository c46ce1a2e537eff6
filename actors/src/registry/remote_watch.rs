//! Death watch between nodes.
//!
//! ```text
//!  watcher ── AwaitEnd(object, after) ──► ServiceFn of the object's node ── Watcher ──► the object
//!     ▲                                      │ at once, or when it ends
//!     └────────── Watched(seen, ended) ◄─────┘
//! ```
//!
//! The watcher asks, and is answered when the object ends; then it asks for the next end. The task
//! that asks belongs to the watcher's incarnation and ends with it.
//!
//! Every end of an object has a number on its node, and each object keeps its last end. A question
//! names the number after which ends count, and an object that has ended since is answered at
//! once. Neither an end between two questions nor one in an outage is lost: of several, the last is
//! told. A watch that has no number yet and finds its node away has the one at which that node lost
//! the path, or opened the next session.
//!
//! That the object's node is lost is seen by the session, which resolves the request; where no
//! request was on its way, by the next answer, which another service gives.
//!
//! A node has at most as many questions waiting as it leaves free (a dynamic threshold, Choudhury
//! and Hahne 1998): one alone half of the capacity, two a third each. However many a node asks,
//! others find capacity. What goes beyond is refused, counted by node, and logged.

use crate::messaging::death_watch::{Down, DownReason, NumberedEnd, Watcher, last_end_number};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::platform::lock;
use crate::registry::access::MessageOrigin;
use crate::registry::{Registry, WeakRegistry};
use blastema_core::net::NodeId;
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, Incarnation, ObjectAddress, ObjectName};
use blastema_macros::{Request, Structure};
use std::mem::replace;
use std::sync::{Arc, Mutex, MutexGuard};
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
/// What is known of a node that has another incarnation.
const STARTED_AGAIN: &str = "its node has started again";
/// The most bytes of a panic's text that go to another node.
const TEXT_MAX: usize = 4096;

/// Asks for the last of the ends of an object that count.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/await-end", version = 3, reply = Watched)]
struct AwaitEnd {
    object: ObjectName,
    after: EndsAfter,
}

/// Which ends of an object count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
enum EndsAfter {
    /// None yet: the answer comes at once, and says how the object stands.
    Question,
    /// Those since the session was opened, or lost its path. The answer comes at once, too.
    Opening,
    /// Those after the ones that the asker knows of.
    Seen(SeenEnd),
}

/// The number of an end, as this service counts: each start of a node has another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
struct SeenEnd {
    service: u64,
    number: u64,
}

/// How an object stands: the last end that counts, or why it does not live.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
struct Watched {
    seen: SeenEnd,
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
/// A name that no object has is asked for again and again.
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
        let after = match registry.is_reachable(&node) {
            true => EndsAfter::Question,
            false => EndsAfter::Opening,
        };
        let opening = || registry.opening(&node);
        match sender {
            Ok(sender) => ask_on(&sender, &object, after, down, lost, opening).await,
            // This node has no network.
            Err(why) => lost(why.to_string()),
        }
    }
}

async fn ask_on<O: Future<Output = ()>>(
    sender: &Sender<AwaitEnd>,
    object: &ObjectName,
    mut after: EndsAfter,
    down: impl Fn(LastEnd),
    lost: impl Fn(String),
    opening: impl Fn() -> O,
) {
    let (mut is_lost, mut was_back, mut is_gone, mut is_absent) = (false, false, false, false);
    loop {
        let question = AwaitEnd { object: object.clone(), after };
        match sender.ask_within(question, WATCH_TIMEOUT).await.map_err(|error| error.kind) {
            Ok(Watched { seen, ended }) => {
                let is_other =
                    matches!(after, EndsAfter::Seen(known) if known.service != seen.service);
                if is_other && !is_lost {
                    lost(STARTED_AGAIN.to_owned());
                }
                (after, is_lost, was_back) = (EndsAfter::Seen(seen), false, false);
                let ending = ended.as_ref().map(|ended| &ended.ending);
                let is_unknown = ending == Some(&DownReason::Unknown);
                let was_gone =
                    replace(&mut is_gone, is_unknown || ending == Some(&DownReason::Stopped));
                // One that was stopped has gone.
                if let Some(ended) = ended.filter(|_| !(was_gone && is_unknown)) {
                    down(ended);
                }
                is_absent = is_unknown;
                if !is_absent {
                    continue;
                }
                // It is looked for again until an object has the name.
                after = EndsAfter::Question;
            }
            Err(DeliveryError::DeadlinePassed) => continue, // No incarnation has ended.
            // Of no concern to the object: for want of room, or because the watcher itself is
            // fenced.
            Err(DeliveryError::Full | DeliveryError::WayFull { .. } | DeliveryError::Fenced) => {}
            Err(why) => {
                let was_sent = matches!(
                    why,
                    DeliveryError::OutcomeUnknown { .. } | DeliveryError::PeerDied { .. }
                );
                // Lost once more.
                is_lost &= !(was_sent || was_back);
                was_back = false;
                if after == EndsAfter::Question {
                    after = EndsAfter::Opening;
                }
                if !is_lost && !is_absent && why != DeliveryError::Restarting {
                    lost(match why {
                        DeliveryError::OutcomeUnknown { reason } => reason,
                        // The message of which its text speaks is this question.
                        DeliveryError::PeerDied { .. } => STARTED_AGAIN.to_owned(),
                        why => why.to_string(),
                    });
                    is_lost = true;
                }
            }
        }
        tokio::select! {
            () = platform::sleep(RETRY_DELAY) => {}
            () = opening() => was_back = true,
        }
    }
}

/// Answers other nodes that watch objects of this one.
pub(crate) fn serve(registry: &Registry) -> DeathWatchService {
    let service = DeathWatchService::new(registry);
    let service_fn = service.clone();
    let serve = move |AwaitEnd { object, after }, by, responder| {
        service_fn.serve(object, after, by, responder);
    };
    registry.serve_hidden(OBJECT, serve);
    service
}

/// The objects of this node that others watch. Clones share them.
#[derive(Clone)]
pub(crate) struct DeathWatchService {
    /// Of the random source: no service of another start has it.
    number: u64,
    registry: WeakRegistry,
    questions: Arc<Mutex<Questions>>,
}

#[derive(Default)]
struct Questions {
    waiting: SortedMap<ObjectName, Vec<Waiting>>,
    /// The last end when the session with a node was opened or lost its path, for each node that
    /// this one has met.
    openings: SortedMap<MessageOrigin, u64>,
    /// How many questions of each node were refused.
    refused: SortedMap<MessageOrigin, u64>,
    /// The last end before this node began to end in order. Those that follow are told as its end.
    last: Option<u64>,
}

/// One question that waits for its answer.
struct Waiting {
    by: MessageOrigin,
    /// Ends with a higher number count.
    after: u64,
    responder: Responder<AwaitEnd>,
}

impl DeathWatchService {
    fn new(registry: &Registry) -> Self {
        let (number, questions) = (platform::random_seed(), Arc::default());
        DeathWatchService { number, registry: registry.downgrade(), questions }
    }

    /// The session with this node is opened, or loses its path: its watches that begin before the
    /// nodes are connected are told the ends from now on.
    pub(crate) fn handle_opening(&self, peer: NodeId) {
        lock(&self.questions)
            .openings
            .insert(MessageOrigin { peer: Some(peer) }, last_end_number());
    }

    /// The session with this node is over, and nothing else is known of it.
    pub(crate) fn forget(&self, peer: NodeId) {
        lock(&self.questions).openings.remove(&MessageOrigin { peer: Some(peer) });
    }

    /// This node begins to end in order.
    pub(crate) fn handle_leaving(&self) {
        lock(&self.questions).last.get_or_insert_with(last_end_number);
    }

    fn serve(
        &self,
        object: ObjectName,
        after: EndsAfter,
        by: MessageOrigin,
        responder: Responder<AwaitEnd>,
    ) {
        let questions = lock(&self.questions);
        let opening = questions.openings.get(&by).copied();
        let (after, waits) = match after {
            EndsAfter::Question => (u64::MAX, false),
            EndsAfter::Seen(seen) if seen.service == self.number => (seen.number, true),
            // What another start of this node has counted says nothing.
            EndsAfter::Seen(_) | EndsAfter::Opening => (opening.unwrap_or(u64::MAX), false),
        };
        let (last, absent) = self.watch(&object);
        let number = last.as_ref().map_or(0, |last| last.number);
        let ended = match last.filter(|last| last.number > after && questions.is_told(last)) {
            Some(last) => Some(last.down.into()),
            None if questions.last.is_some() => {
                return self.wait(questions, object, Waiting { by, after, responder });
            }
            None if absent.as_ref().is_some_and(|end| end.ending == DownReason::Unknown) => absent,
            None if !waits => absent,
            None => return self.wait(questions, object, Waiting { by, after, responder }),
        };
        drop(questions);
        responder.give(self.watched(number, ended));
    }

    fn wait(
        &self,
        mut questions: MutexGuard<'_, Questions>,
        object: ObjectName,
        question: Waiting,
    ) {
        let (mut waiting, mut of_asker) = (0, 0);
        for (_, others) in &mut questions.waiting {
            others.retain(|other| other.responder.is_wanted());
            waiting += others.len();
            of_asker += others.iter().filter(|other| other.by == question.by).count();
        }
        questions.waiting.retain(|_, others| !others.is_empty());
        if of_asker < WAITING_MAX - waiting {
            return questions.waiting.entry(object).or_default().push(question);
        }
        questions.count_refused(question.by, of_asker);
        drop(questions);
        question.responder.refuse(DeliveryError::Full, None);
    }

    fn watched(&self, number: u64, ended: Option<LastEnd>) -> Watched {
        Watched { seen: SeenEnd { service: self.number, number }, ended }
    }

    /// Watches the object, unless it is watched already. Returns its last end, and why it does not
    /// live now, if so.
    fn watch(&self, object: &ObjectName) -> (Option<NumberedEnd>, Option<LastEnd>) {
        let Some(registry) = self.registry.upgrade() else { return (None, None) };
        let absent = Arc::new(Mutex::new(None));
        let (service_fn, reported) = (self.clone(), absent.clone());
        let tell = move |down: Down| match down.ending {
            // Only ever said while the watch begins.
            DownReason::NotAlive | DownReason::Unknown => {
                *lock(&reported) = Some(LastEnd::from(down));
            }
            _ => service_fn.end(down),
        };
        let who = ObjectName::new(OBJECT).expect("a name of letters");
        let incarnation = Arc::new(IncarnationToken::default());
        let watcher = Watcher { who, incarnation, outlasts_object: false, tell: Box::new(tell) };
        let last = registry.watch(object.clone(), watcher);
        (last, lock(&absent).take())
    }

    /// Answers the questions that have not been answered with this end or a later one.
    fn end(&self, down: Down) {
        let mut questions = lock(&self.questions);
        let Some(waiting) = questions.waiting.remove(&down.object) else { return };
        let object = down.object.clone();
        // Where the object has gone with its end, no later one can be.
        let (last, _) = self.watch(&object);
        let last = last.unwrap_or_else(|| NumberedEnd { number: last_end_number(), down });
        let is_told = questions.is_told(&last);
        let (due, rest): (Vec<_>, Vec<_>) =
            waiting.into_iter().partition(|waiting| is_told && waiting.after < last.number);
        if !rest.is_empty() {
            questions.waiting.insert(object, rest);
        }
        drop(questions);
        let watched = self.watched(last.number, Some(last.down.into()));
        due.into_iter().for_each(|waiting| waiting.responder.give(watched.clone()));
    }
}

impl Questions {
    /// Whether this end is told by itself, and not as that of the node.
    fn is_told(&self, end: &NumberedEnd) -> bool {
        self.last.is_none_or(|last| end.number <= last)
    }

    /// A question was refused. It is logged whenever the number of them has doubled.
    fn count_refused(&mut self, by: MessageOrigin, waiting: usize) {
        if self.refused.len() >= REFUSED_MAX && !self.refused.contains_key(&by) {
            return;
        }
        let times = self.refused.entry(by).or_default();
        *times = times.saturating_add(1);
        if let (true, Some(node)) = (times.is_power_of_two(), by.peer) {
            warn!(%node, waiting, times, "refused: the node watches as many objects as it may");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messaging::death_watch::Deaths;
    use crate::registry::service_fn::ServiceFn;
    use blastema_core::NodeName;
    use blastema_doubles::advance;

    /// A question whose answer is kept.
    fn ask(
        service: &DeathWatchService,
        by: &str,
    ) -> Arc<Mutex<Option<Result<Watched, DeliveryError>>>> {
        ask_after(service, by, EndsAfter::Seen(SeenEnd { service: service.number, number: 0 }))
    }

    fn ask_after(
        service: &DeathWatchService,
        by: &str,
        after: EndsAfter,
    ) -> Arc<Mutex<Option<Result<Watched, DeliveryError>>>> {
        let answered = Arc::new(Mutex::new(None));
        let keep = answered.clone();
        let responder = Responder::called_back(
            Box::new(move |result| *keep.lock().unwrap() = Some(result)),
            None,
        );
        let by = MessageOrigin { peer: Some(NodeId::of(&NodeName::new(by).unwrap())) };
        let arm = ObjectName::new("arm").unwrap();
        service.serve(arm, after, by, responder);
        answered
    }

    /// How many questions of this node come to wait, of so many.
    fn waiting(service: &DeathWatchService, by: &str, asked: usize) -> usize {
        let refused = |result| matches!(result, Some(Err(DeliveryError::Full)));
        let all: Vec<_> = (0..asked).map(|_| ask(service, by)).collect();
        all.into_iter().filter(|answer| !refused(answer.lock().unwrap().clone())).count()
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn an_object_that_no_node_has_is_not_lost_with_its_node() {
        let count = Arc::new(Mutex::new(0));
        let serve = move |_: AwaitEnd, _, responder: Responder<AwaitEnd>| {
            let mut count = count.lock().unwrap();
            *count += 1;
            let reason = "the session ended".to_owned();
            let node = "module2".to_owned();
            match *count {
                2 => responder.refuse(DeliveryError::OutcomeUnknown { reason }, None),
                3 => responder.refuse(DeliveryError::Unreachable { node }, None),
                5 => {
                    responder.refuse(DeliveryError::PeerDied { incarnation: Incarnation(1) }, None)
                }
                _ => {
                    let (incarnation, ending) = (Incarnation(0), DownReason::Unknown);
                    let ended = Some(LastEnd { incarnation, ending });
                    // Its node has started again meanwhile.
                    let seen = SeenEnd { service: *count, number: 0 };
                    responder.give(Watched { seen, ended });
                }
            }
        };
        let sender = Sender(Arc::new(ServiceFn::<AwaitEnd>(Arc::new(serve))));
        let told = Arc::new(Mutex::new(Vec::new()));
        let (ends, losses) = (told.clone(), told.clone());
        let arm = ObjectName::new("arm").unwrap();
        actix_rt::spawn(async move {
            let down = |end: LastEnd| ends.lock().unwrap().push(format!("{:?}", end.ending));
            let lost = |reason| losses.lock().unwrap().push(reason);
            ask_on(&sender, &arm, EndsAfter::Question, down, lost, std::future::pending).await;
        });

        advance(8 * RETRY_DELAY).await;

        assert_eq!(*told.lock().unwrap(), ["Unknown"]);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_node_that_was_started_again_between_two_questions_or_during_one_was_lost() {
        for why in [DeliveryError::Full, DeliveryError::PeerDied { incarnation: Incarnation(1) }] {
            let asked = Arc::new(Mutex::new(Vec::new()));
            let questions = asked.clone();
            let serve = move |AwaitEnd { after, .. }, _, responder: Responder<AwaitEnd>| {
                let mut asked = questions.lock().unwrap();
                asked.push(after);
                let watched =
                    |service| Watched { seen: SeenEnd { service, number: 0 }, ended: None };
                match asked.len() {
                    1 => responder.give(watched(7)),
                    2 => responder.refuse(why.clone(), None),
                    3 => responder.give(watched(8)),
                    _ => std::mem::forget(responder),
                }
            };
            let sender = Sender(Arc::new(ServiceFn::<AwaitEnd>(Arc::new(serve))));
            let told = Arc::new(Mutex::new(Vec::new()));
            let losses = told.clone();
            let arm = ObjectName::new("arm").unwrap();
            actix_rt::spawn(async move {
                let lost = |reason| losses.lock().unwrap().push(reason);
                let down = |end| panic!("{end:?}");
                ask_on(&sender, &arm, EndsAfter::Question, down, lost, std::future::pending).await;
            });
            advance(5 * RETRY_DELAY).await;

            assert_eq!(*told.lock().unwrap(), ["its node has started again"]);
            let seen = |service| EndsAfter::Seen(SeenEnd { service, number: 0 });
            let expected = [EndsAfter::Question, seen(7), seen(7), seen(8)];
            assert_eq!(*asked.lock().unwrap(), expected);
        }
    }

    #[test]
    fn what_another_start_of_the_node_has_counted_is_answered_at_once() {
        let (registry, deaths) = (Registry::default(), Deaths::default());
        deaths.begin(&ObjectName::new("arm").unwrap(), Incarnation(1));
        registry.watch_in(deaths);
        let service = DeathWatchService::new(&registry);
        let other = SeenEnd { service: service.number.wrapping_add(1), number: 0 };
        let answer = ask_after(&service, "honest", EndsAfter::Seen(other));
        let answered = answer.lock().unwrap().clone().expect("at once").expect("it is told");
        assert_eq!(answered.seen, SeenEnd { service: service.number, number: 0 });
        assert!(answered.ended.is_none(), "it lives");
        assert!(ask(&service, "honest").lock().unwrap().is_none(), "it waits");
    }

    #[test]
    fn ends_that_no_question_waited_for_are_told_to_the_next_but_for_those_of_a_node_that_ends() {
        let (registry, deaths) = (Registry::default(), Deaths::default());
        let arm = ObjectName::new("arm").unwrap();
        let end = |incarnation| {
            deaths.begin(&arm, Incarnation(incarnation));
            deaths.end(&arm, DownReason::Stopped);
            deaths.begin(&arm, Incarnation(incarnation + 1));
        };
        deaths.begin(&arm, Incarnation(1));
        registry.watch_in(deaths.clone());
        let service = DeathWatchService::new(&registry);
        let left = NodeId::of(&NodeName::new("left").unwrap());
        let told = |after| {
            let answer = ask_after(&service, "left", after).lock().unwrap().clone();
            answer.map(|answer| answer.expect("it is told"))
        };
        let incarnation = |told: &Watched| told.ended.as_ref().map(|ended| ended.incarnation.0);

        service.handle_opening(left);
        (1..=20).for_each(end);
        let since = told(EndsAfter::Opening).expect("it is asked how the object stands");
        assert_eq!(incarnation(&since), Some(20));
        let now = told(EndsAfter::Question).expect("it is asked how the object stands");
        assert_eq!((incarnation(&now), now.seen), (None, since.seen));
        assert!(told(EndsAfter::Seen(since.seen)).is_none(), "it waits");
        end(21);
        assert_eq!(incarnation(&told(EndsAfter::Seen(since.seen)).expect("at once")), Some(21));

        service.handle_opening(left);
        assert_eq!(incarnation(&told(EndsAfter::Opening).expect("at once")), None);
        end(22);
        service.handle_leaving();
        let last = told(EndsAfter::Opening).expect("that was before");
        assert_eq!(incarnation(&last), Some(22));
        let waits = ask_after(&service, "left", EndsAfter::Seen(last.seen));
        deaths.end(&arm, DownReason::Stopped);
        assert!(waits.lock().unwrap().is_none());
        assert!(told(EndsAfter::Question).is_none());
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

        let refused: Vec<_> = lock(&service.questions).refused.values().copied().collect();
        assert_eq!(refused.iter().sum::<u64>(), (WAITING_MAX * 3 / 2 + WAITING_MAX * 7 / 4) as u64);
        let answer = ask(&service, "honest");
        deaths.end(&ObjectName::new("arm").unwrap(), DownReason::Stopped);
        let answer = answer.lock().unwrap().clone();
        assert!(answer.expect("it ends").expect("it is told").seen.number > 0);
        assert_eq!(waiting(&service, "greedy", 1), 1, "its share is free again");
    }
}
