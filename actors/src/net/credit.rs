//! How much may be in flight from the objects of this node to those of a peer: credit, which a
//! message holds from its acceptance until the peer's session has acknowledged it.

use blastema_core::{Credit, CreditPool, TrafficClass};
use std::sync::Arc;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use tokio::sync::Notify;

/// Messages of one class that may be in flight to one peer. Half of it is what a hub of events has
/// capacity for.
const MESSAGES_MAX: usize = 2048;
/// Their bytes, likewise: four of the largest messages.
const BYTES_MAX: usize = 4 << 20;

/// The credits to one peer. Each class has a pool of its own, so that none fills that of another.
pub(super) struct SendCredits {
    classes: [Arc<Pool>; TrafficClass::COUNT],
    /// Of messages of which only the newest counts. They hold their credit until the session has
    /// them, which keeps one of each channel.
    newest: Arc<Pool>,
}

/// The credit of one class.
struct Pool {
    messages: AtomicUsize,
    bytes: AtomicUsize,
    /// All was taken, and less than half of it is free since. Senders that do not wait would take
    /// what others wait for otherwise.
    exhausted: AtomicBool,
    /// Told when there is credit again.
    changed: Arc<Notify>,
}

impl SendCredits {
    pub(super) fn new(changed: &Arc<Notify>) -> Self {
        let pool = || {
            Arc::new(Pool {
                messages: AtomicUsize::default(),
                bytes: AtomicUsize::default(),
                exhausted: AtomicBool::default(),
                changed: changed.clone(),
            })
        };
        SendCredits { classes: std::array::from_fn(|_| pool()), newest: pool() }
    }

    /// Of messages of this class; `None` of those of which only the newest counts.
    fn pool(&self, class: Option<TrafficClass>) -> &Arc<Pool> {
        class.map_or(&self.newest, |class| &self.classes[class as usize])
    }

    /// There is credit.
    pub(super) fn is_open(&self, class: Option<TrafficClass>) -> bool {
        self.pool(class).is_open()
    }

    /// Takes credit for so many bytes; it is given back when it is dropped.
    pub(super) fn take(&self, bytes: usize, class: Option<TrafficClass>) -> Option<Credit> {
        self.pool(class).take(bytes)
    }

    /// Takes credit for an event, which never waits, and leaves half to what does.
    pub(super) fn take_for_event(
        &self,
        bytes: usize,
        class: Option<TrafficClass>,
    ) -> Option<Credit> {
        let pool = self.pool(class);
        if pool.is_half_free() { pool.take(bytes) } else { None }
    }
}

impl Pool {
    fn is_open(&self) -> bool {
        if self.messages.load(SeqCst) >= MESSAGES_MAX || self.bytes.load(SeqCst) >= BYTES_MAX {
            self.exhausted.store(true, SeqCst);
            // Some may have been given back since.
            self.reopen();
        }
        !self.exhausted.load(SeqCst)
    }

    fn is_half_free(&self) -> bool {
        self.messages.load(SeqCst) < MESSAGES_MAX / 2 && self.bytes.load(SeqCst) < BYTES_MAX / 2
    }

    fn take(self: &Arc<Self>, bytes: usize) -> Option<Credit> {
        if !self.is_open() {
            return None;
        }
        let messages = self.messages.fetch_add(1, SeqCst);
        let before = self.bytes.fetch_add(bytes, SeqCst);
        // Many threads may have found capacity for one.
        let credit = Credit::new(self.clone(), bytes);
        let has_space = messages < MESSAGES_MAX && before < BYTES_MAX;
        if !has_space {
            // Who is refused here waits until it is told that there is space.
            self.exhausted.store(true, SeqCst);
        }
        has_space.then_some(credit)
    }

    fn reopen(&self) {
        if self.exhausted.load(SeqCst) && self.is_half_free() && self.exhausted.swap(false, SeqCst)
        {
            self.changed.notify_waiters();
        }
    }
}

impl CreditPool for Pool {
    fn give_back(&self, bytes: usize) {
        self.messages.fetch_sub(1, SeqCst);
        self.bytes.fetch_sub(bytes, SeqCst);
        self.reopen();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn credits() -> SendCredits {
        SendCredits::new(&Arc::new(Notify::new()))
    }

    #[test]
    fn what_exhausts_one_class_leaves_the_others_theirs_and_gives_it_back() {
        let all = TrafficClass::ALL.map(Some).into_iter().chain([None]);
        for (full, each) in all.clone().flat_map(|class| [(class, 64), (class, 1 << 20)]) {
            let credits = credits();
            let fill =
                || -> Vec<_> { (0..9_999).map_while(|_| credits.take(each, full)).collect() };

            let taken = fill();

            assert_eq!(taken.len(), if each == 64 { MESSAGES_MAX } else { 4 });
            for class in all.clone() {
                assert_eq!(credits.is_open(class), class != full, "{full:?}, {class:?}");
            }
            let took = taken.len();
            drop(taken);
            assert_eq!(fill().len(), took);
        }
    }

    #[test]
    fn an_exhausted_class_takes_nothing_until_half_of_it_is_free() {
        let (credits, class) = (credits(), Some(TrafficClass::Request));
        let mut taken: Vec<_> = (0..9_999).map_while(|_| credits.take(64, class)).collect();
        taken.truncate(MESSAGES_MAX / 2);
        assert!(credits.take(64, class).is_none(), "senders that wait are to find some");
        taken.pop();
        assert!(credits.take(64, class).is_some());
    }

    #[test]
    fn events_leave_half_of_their_credit_to_what_waits() {
        let (credits, class) = (credits(), Some(TrafficClass::Event));

        let events: Vec<_> = (0..9_999).map_while(|_| credits.take_for_event(64, class)).collect();

        assert_eq!(events.len(), MESSAGES_MAX / 2);
        assert!(credits.take(64, class).is_some());
    }

    #[test]
    fn many_threads_exhaust_a_class_and_leave_it_open() {
        let credits = Arc::new(credits());
        let class = Some(TrafficClass::Bulk);
        let threads = (0..4).map(|_| {
            let credits = credits.clone();
            std::thread::spawn(move || {
                for _ in 0..20_000 {
                    let all: Vec<_> = (0..3).map_while(|_| credits.take(1 << 20, class)).collect();
                    drop(all);
                }
            })
        });
        threads.collect::<Vec<_>>().into_iter().for_each(|thread| thread.join().unwrap());
        assert!(credits.is_open(class) && credits.pool(class).messages.load(SeqCst) == 0);
    }
}
