//! How much may be in flight from the objects of this node to those of a peer: credit, which a
//! message holds from its acceptance until the peer's session has acknowledged it.
//!
//! All senders of a class share its credit. A sender may hold up to seven times as much as is free
//! (dynamic threshold, Choudhury and Hahne 1998), so that a sender that fills its share leaves
//! capacity to the others, and gives way as soon as they send. Requests have credit of their own,
//! and events that do not wait may use half of what messages may.

use blastema_core::{Credit, CreditPool, TrafficClass};
use std::sync::Arc;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use tokio::sync::Notify;

/// Messages of one class that may be in flight to one peer, and their bytes, requests apart. Half
/// of the messages is what a hub of events has capacity for; the bytes are four of the largest
/// messages.
const MESSAGES_MAX: Amount = [2048, 4 << 20];
/// Requests of one class, and their bytes, likewise.
const REQUESTS_MAX: Amount = [1024, 2 << 20];
/// A sender may hold so many times what is free: one that is alone takes seven eighths.
const ALPHA: usize = 7;

/// Messages, and their bytes.
type Amount = [usize; 2];

/// The credits to one peer. Each class has pools of its own, so that none fills that of another.
pub(super) struct SendCredits {
    messages: [Arc<Pool>; TrafficClass::COUNT],
    requests: [Arc<Pool>; TrafficClass::COUNT],
    /// Of messages of which only the newest counts. They hold their credit until the session has
    /// them, which keeps one of each channel.
    newest: Arc<Pool>,
}

impl SendCredits {
    pub(super) fn new(changed: &Arc<Notify>) -> Self {
        let pool = |max| {
            let (taken, refused) = (Held::default(), AtomicBool::default());
            Arc::new(Pool { max, taken, refused, changed: changed.clone() })
        };
        SendCredits {
            messages: std::array::from_fn(|_| pool(MESSAGES_MAX)),
            requests: std::array::from_fn(|_| pool(REQUESTS_MAX)),
            newest: pool(MESSAGES_MAX),
        }
    }

    /// The account of one more sender of messages of this class; `None` of those of which only the
    /// newest counts.
    pub(super) fn sender(&self, class: Option<TrafficClass>) -> Arc<SenderCredit> {
        self.account(&self.messages, class)
    }

    /// The same of requests.
    pub(super) fn caller(&self, class: Option<TrafficClass>) -> Arc<SenderCredit> {
        self.account(&self.requests, class)
    }

    fn account(&self, pools: &[Arc<Pool>], class: Option<TrafficClass>) -> Arc<SenderCredit> {
        let pool = class.map_or(&self.newest, |class| &pools[class as usize]);
        Arc::new(SenderCredit { pool: pool.clone(), held: Held::default() })
    }
}

/// The credit of one class.
struct Pool {
    max: Amount,
    taken: Held,
    /// A sender was refused, and has not been told of capacity since.
    refused: AtomicBool,
    /// Told when there is credit again.
    changed: Arc<Notify>,
}

/// What holds credit.
#[derive(Default)]
struct Held {
    messages: AtomicUsize,
    bytes: AtomicUsize,
}

impl Held {
    fn load(&self) -> Amount {
        [self.messages.load(SeqCst), self.bytes.load(SeqCst)]
    }

    /// Answers what was held before.
    fn add(&self, bytes: usize) -> Amount {
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

/// Whether a sender that holds so much may take more, where all have taken so much of `max`.
fn has_share(held: Amount, taken: Amount, max: Amount) -> bool {
    let mut all = held.into_iter().zip(taken).zip(max);
    all.all(|((held, taken), max)| held < max.saturating_sub(taken) * ALPHA)
}

impl SenderCredit {
    /// Takes credit for so many bytes; it is given back when it is dropped.
    pub(super) fn take(self: &Arc<Self>, bytes: usize) -> Option<Credit> {
        self.take_of(self.pool.max, bytes)
    }

    /// Takes credit for an event that does not wait, and leaves half to those that do.
    pub(super) fn take_for_event(self: &Arc<Self>, bytes: usize) -> Option<Credit> {
        self.take_of(self.pool.max.map(|max| max / 2), bytes)
    }

    fn take_of(self: &Arc<Self>, max: Amount, bytes: usize) -> Option<Credit> {
        if !self.check(|held, taken| has_share(held, taken, max)) {
            return None;
        }
        // Many threads may have found capacity for one.
        let (taken, held) = (self.pool.taken.add(bytes), self.held.add(bytes));
        let credit = Credit::new(self.clone(), bytes);
        has_share(held, taken, max).then_some(credit)
    }

    /// Whether a sender that waited is to go on: it has half of its share, so that it goes on for a
    /// while.
    pub(super) fn is_open(&self) -> bool {
        self.check(|held, taken| has_share(held.map(|held| held * 2), taken, self.pool.max))
    }

    /// If it is refused, the next credit that is given back tells so.
    fn check(&self, is_admitted: impl Fn(Amount, Amount) -> bool) -> bool {
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
    fn fill(sender: &Arc<SenderCredit>, each: usize) -> Vec<Credit> {
        (0..9_999).map_while(|_| sender.take(each)).collect()
    }

    #[test]
    fn what_fills_one_class_leaves_the_others_theirs_and_gives_it_back() {
        let all = TrafficClass::ALL.map(Some).into_iter().chain([None]);
        for (full, each) in all.clone().flat_map(|class| [(class, 64), (class, 1 << 20)]) {
            let credits = credits();
            let sender = credits.sender(full);

            let taken = fill(&sender, each);

            assert_eq!(taken.len(), if each == 64 { MESSAGES_MAX[0] / 8 * 7 } else { 4 });
            assert!(!sender.is_open());
            for class in all.clone().filter(|class| *class != full) {
                let other = fill(&credits.sender(class), each);
                assert_eq!(other.len(), taken.len(), "{full:?}, {class:?}");
            }
            let took = taken.len();
            drop(taken);
            assert_eq!(fill(&sender, each).len(), took);
        }
    }

    #[test]
    fn a_sender_that_fills_its_share_leaves_some_to_each_other_and_gives_way_to_it() {
        let credits = credits();
        let [greedy, late] = [(); 2].map(|()| credits.sender(REQUEST));
        let mut held = fill(&greedy, 64);

        let mut other = fill(&late, 64);
        assert!(other.len() > 100, "{}", other.len());
        // Whatever is given back goes to the one that has less.
        while held.len() > other.len() + 1 + ALPHA {
            held.pop();
            assert!(greedy.take(64).is_none());
            other.extend(late.take(64));
        }
        assert!((900..1_000).contains(&other.len()), "{}", other.len());
    }

    #[test]
    fn requests_and_messages_leave_each_other_their_credit() {
        for each in [64, 1 << 20] {
            let credits = credits();
            let flood = |accounts: [Arc<SenderCredit>; 64]| -> Vec<_> {
                accounts.iter().flat_map(|account| fill(account, each)).collect()
            };
            let messages = flood([(); 64].map(|()| credits.sender(REQUEST)));
            let caller = credits.caller(REQUEST);
            let requests: Vec<_> = (0..300).map_while(|_| caller.take(64)).collect();
            assert_eq!(requests.len(), 300, "beside {} messages", messages.len());
            drop(messages);

            let requests = flood([(); 64].map(|()| credits.caller(REQUEST)));
            assert!(credits.sender(REQUEST).is_open(), "beside {} requests", requests.len());
        }
    }

    #[test]
    fn events_that_do_not_wait_leave_half_of_their_credit_to_those_that_do() {
        let credits = credits();
        let sender = credits.sender(Some(TrafficClass::Event));

        let events = (0..9_999).map_while(|_| sender.take_for_event(64));
        let events: Vec<_> = events.collect();

        assert_eq!(events.len(), MESSAGES_MAX[0] / 2 / 8 * 7);
        assert!(sender.take(64).is_some());
    }

    #[test]
    fn a_sender_that_waits_is_told_when_it_has_half_of_its_share() {
        let changed = Arc::new(Notify::new());
        let sender = SendCredits::new(&changed).sender(REQUEST);
        let mut held = fill(&sender, 64);
        while !sender.is_open() {
            let mut told = pin!(changed.notified());
            held.pop();
            assert!(told.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_ready());
        }
        assert_eq!(held.len(), MESSAGES_MAX[0] * 7 / 9);
    }

    #[test]
    fn many_threads_take_all_and_give_it_back() {
        let credits = credits();
        let class = Some(TrafficClass::Bulk);
        let threads = [(); 4].map(|()| {
            let sender = credits.sender(class);
            std::thread::spawn(move || {
                (0..20_000).for_each(|_| {
                    let all = (0..3).map_while(|_| sender.take(1 << 20));
                    drop(all.collect::<Vec<_>>());
                });
            })
        });
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        let sender = credits.sender(class);
        assert!(sender.is_open() && sender.pool.taken.load() == [0, 0]);
    }
}
