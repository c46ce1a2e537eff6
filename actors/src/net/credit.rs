//! How much may be in flight from the objects of this node to those of a peer: credit, which a
//! message holds from its acceptance until the peer's session has acknowledged it.
//!
//! All senders of a class share its credit. A sender may hold up to seven times as much as is free
//! (dynamic threshold, Choudhury and Hahne 1998), so that a sender that fills its share leaves
//! capacity to the others, and gives way as soon as they send. Events that do not wait may use half
//! of what messages may, and requests half more.

use blastema_core::{Credit, CreditPool, TrafficClass};
use std::sync::Arc;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use tokio::sync::Notify;

/// Messages of one class that may be in flight to one peer, requests apart. Half of it is what a hub
/// of events has capacity for.
const MESSAGES_MAX: usize = 2048;
/// Their bytes, likewise: four of the largest messages.
const BYTES_MAX: usize = 4 << 20;
/// A sender may hold so many times what is free: one that is alone takes seven eighths.
const ALPHA: usize = 7;

/// What a message is sent by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CreditUse {
    /// An event that does not wait.
    Publish,
    /// A message without a reply, or an event that waits.
    Deliver,
    /// A request.
    Ask,
}

impl CreditUse {
    /// How many halves of a class's credit are open to it.
    fn halves(self) -> usize {
        match self {
            CreditUse::Publish => 1,
            CreditUse::Deliver => 2,
            CreditUse::Ask => 3,
        }
    }
}

/// The credits to one peer. Each class has a pool of its own, so that none fills that of another.
pub(super) struct SendCredits {
    classes: [Arc<Pool>; TrafficClass::COUNT],
    /// Of messages of which only the newest counts. They hold their credit until the session has
    /// them, which keeps one of each channel.
    newest: Arc<Pool>,
}

impl SendCredits {
    pub(super) fn new(changed: &Arc<Notify>) -> Self {
        let pool = || {
            let (taken, refused) = (Held::default(), AtomicBool::default());
            Arc::new(Pool { taken, refused, changed: changed.clone() })
        };
        SendCredits { classes: std::array::from_fn(|_| pool()), newest: pool() }
    }

    /// The account of one more sender of this class; `None` of messages of which only the newest
    /// counts.
    pub(super) fn sender(&self, class: Option<TrafficClass>) -> Arc<SenderCredit> {
        let pool = class.map_or(&self.newest, |class| &self.classes[class as usize]);
        Arc::new(SenderCredit { pool: pool.clone(), held: Held::default() })
    }
}

/// The credit of one class.
struct Pool {
    taken: Held,
    /// A sender was refused, and has not been told of capacity since.
    refused: AtomicBool,
    /// Told when there is credit again.
    changed: Arc<Notify>,
}

/// The messages that hold credit, and their bytes.
#[derive(Default)]
struct Held {
    messages: AtomicUsize,
    bytes: AtomicUsize,
}

impl Held {
    fn load(&self) -> [usize; 2] {
        [self.messages.load(SeqCst), self.bytes.load(SeqCst)]
    }

    /// Answers what was held before.
    fn add(&self, bytes: usize) -> [usize; 2] {
        [self.messages.fetch_add(1, SeqCst), self.bytes.fetch_add(bytes, SeqCst)]
    }

    fn remove(&self, bytes: usize) {
        self.messages.fetch_sub(1, SeqCst);
        self.bytes.fetch_sub(bytes, SeqCst);
    }
}

/// The credit that one sender holds.
pub(super) struct SenderCredit {
    pool: Arc<Pool>,
    held: Held,
}

/// Whether a sender that holds so much may take more while all have taken so much, each messages
/// and bytes.
fn has_share(held: [usize; 2], taken: [usize; 2], usage: CreditUse) -> bool {
    let limits = [MESSAGES_MAX, BYTES_MAX].map(|max| max / 2 * usage.halves());
    let mut all = held.into_iter().zip(taken).zip(limits);
    all.all(|((held, taken), max)| held < max.saturating_sub(taken) * ALPHA)
}

impl SenderCredit {
    /// Takes credit for so many bytes; it is given back when it is dropped.
    pub(super) fn take(self: &Arc<Self>, bytes: usize, usage: CreditUse) -> Option<Credit> {
        if !self.check(|held, taken| has_share(held, taken, usage)) {
            return None;
        }
        // Many threads may have found capacity for one.
        let (taken, held) = (self.pool.taken.add(bytes), self.held.add(bytes));
        let credit = Credit::new(self.clone(), bytes);
        has_share(held, taken, usage).then_some(credit)
    }

    /// Whether a sender that waited is to go on: it has half of its share, so that it goes on for a
    /// while.
    pub(super) fn is_open(&self) -> bool {
        self.check(|held, taken| has_share(held.map(|held| held * 2), taken, CreditUse::Deliver))
    }

    /// If it is refused, the next credit that is given back tells so.
    fn check(&self, is_admitted: impl Fn([usize; 2], [usize; 2]) -> bool) -> bool {
        let is_admitted = || is_admitted(self.held.load(), self.pool.taken.load());
        is_admitted() || {
            self.pool.refused.store(true, SeqCst);
            // Some may have been given back since.
            is_admitted()
        }
    }
}

impl CreditPool for SenderCredit {
    fn give_back(&self, bytes: usize) {
        self.held.remove(bytes);
        self.pool.taken.remove(bytes);
        if self.pool.refused.load(SeqCst) && self.pool.refused.swap(false, SeqCst) {
            self.pool.changed.notify_waiters();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::pin::pin;
    use std::task::{Context, Waker};

    const REQUEST: Option<TrafficClass> = Some(TrafficClass::Request);

    fn credits() -> SendCredits {
        SendCredits::new(&Arc::new(Notify::new()))
    }

    /// All that this sender gets.
    fn fill(sender: &Arc<SenderCredit>, each: usize, usage: CreditUse) -> Vec<Credit> {
        (0..9_999).map_while(|_| sender.take(each, usage)).collect()
    }

    #[test]
    fn what_fills_one_class_leaves_the_others_theirs_and_gives_it_back() {
        let all = TrafficClass::ALL.map(Some).into_iter().chain([None]);
        for (full, each) in all.clone().flat_map(|class| [(class, 64), (class, 1 << 20)]) {
            let credits = credits();
            let sender = credits.sender(full);

            let taken = fill(&sender, each, CreditUse::Deliver);

            assert_eq!(taken.len(), if each == 64 { MESSAGES_MAX / 8 * 7 } else { 4 });
            assert!(!sender.is_open());
            for class in all.clone().filter(|class| *class != full) {
                let other = fill(&credits.sender(class), each, CreditUse::Deliver);
                assert_eq!(other.len(), taken.len(), "{full:?}, {class:?}");
            }
            let took = taken.len();
            drop(taken);
            assert_eq!(fill(&sender, each, CreditUse::Deliver).len(), took);
        }
    }

    #[test]
    fn a_sender_that_fills_its_share_leaves_some_to_each_other_and_gives_way_to_it() {
        let credits = credits();
        let [greedy, late] = [(); 2].map(|()| credits.sender(REQUEST));
        let mut held = fill(&greedy, 64, CreditUse::Deliver);

        let mut other = fill(&late, 64, CreditUse::Deliver);
        assert!(other.len() > 100, "{}", other.len());
        // Whatever is given back goes to the one that has less.
        while held.len() > other.len() + 1 {
            held.pop();
            assert!(greedy.take(64, CreditUse::Deliver).is_none());
            other.extend(late.take(64, CreditUse::Deliver));
        }
        assert!((900..1_000).contains(&other.len()), "{}", other.len());
    }

    #[test]
    fn requests_have_credit_that_no_stream_of_messages_can_take() {
        for each in [64, 1 << 20] {
            let credits = credits();
            let streams = [(); 64].map(|()| credits.sender(REQUEST));
            let held: Vec<_> =
                streams.iter().flat_map(|one| fill(one, each, CreditUse::Deliver)).collect();
            let late = credits.sender(REQUEST);
            let asked: Vec<_> = (0..300).map(|_| late.take(64, CreditUse::Ask)).collect();
            assert!(asked.iter().all(Option::is_some), "beside {} messages", held.len());
        }
    }

    #[test]
    fn events_that_do_not_wait_leave_half_of_their_credit_to_those_that_do() {
        let credits = credits();
        let sender = credits.sender(Some(TrafficClass::Event));

        let events = fill(&sender, 64, CreditUse::Publish);

        assert_eq!(events.len(), MESSAGES_MAX / 2 / 8 * 7);
        assert!(sender.take(64, CreditUse::Deliver).is_some());
    }

    #[test]
    fn a_sender_that_waits_is_told_when_it_has_half_of_its_share() {
        let changed = Arc::new(Notify::new());
        let sender = SendCredits::new(&changed).sender(REQUEST);
        let mut held = fill(&sender, 64, CreditUse::Deliver);
        while !sender.is_open() {
            let mut told = pin!(changed.notified());
            held.pop();
            assert!(told.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_ready());
        }
        assert_eq!(held.len(), MESSAGES_MAX * 7 / 9);
    }

    #[test]
    fn many_threads_take_all_and_give_it_back() {
        let credits = credits();
        let class = Some(TrafficClass::Bulk);
        let threads = [(); 4].map(|()| {
            let sender = credits.sender(class);
            std::thread::spawn(move || {
                (0..20_000).for_each(|_| {
                    let all = (0..3).map_while(|_| sender.take(1 << 20, CreditUse::Deliver));
                    drop(all.collect::<Vec<_>>());
                });
            })
        });
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        let sender = credits.sender(class);
        assert!(sender.is_open() && sender.pool.taken.load() == [0, 0]);
    }
}
