//! What shares room on the way from the objects of this node to a peer's session, and how much may
//! be there.

use blastema_contract::session::{Credit, CreditPool};
use blastema_core::net::SizeClass;
use blastema_core::net::wire::segment::Stream;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use tokio::sync::Notify;

/// Messages that may be on their way in one room: what a burst sends before the network's arbiter
/// has its turn. A session takes as many again once it has said that it is full.
const MESSAGES_MAX: usize = 2048;
/// Their bytes, likewise. One message more may be on its way, whose bytes go beyond this.
const BYTES_MAX: usize = 1 << 20;

/// What decides which messages share room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CreditClass {
    /// By which it goes; `None` if only the newest counts.
    pub(super) stream: Option<Stream>,
    pub(super) load: SizeClass,
}

impl CreditClass {
    /// That of a message of so many bytes which goes by this stream.
    pub(super) fn of(stream: Option<Stream>, bytes: usize) -> Self {
        CreditClass { stream, load: SizeClass::of(bytes) }
    }

    /// The stream that it shares room with.
    pub(super) fn shares(self) -> Stream {
        self.stream.unwrap_or(Stream::Data)
    }
}

/// The credits to one peer: what is control, and `redundant` messages, such as stops, have room that
/// nothing else takes, and so has what is small beside bulk.
pub(super) struct SendCredits {
    /// By stream, and by load.
    pools: [[Arc<Pool>; 2]; 3],
}

/// Room for what shares it.
struct Pool {
    messages: AtomicUsize,
    bytes: AtomicUsize,
    /// Told when there is room again.
    changed: Arc<Notify>,
}

impl SendCredits {
    pub(super) fn new(changed: &Arc<Notify>) -> Self {
        let none = AtomicUsize::default;
        let pool = || Pool { messages: none(), bytes: none(), changed: changed.clone() };
        SendCredits { pools: [(); 3].map(|()| [(); 2].map(|()| Arc::new(pool()))) }
    }

    fn pool(&self, class: CreditClass) -> &Arc<Pool> {
        &self.pools[class.shares() as usize][class.load as usize]
    }

    /// More may be under way.
    pub(super) fn have_capacity(&self, class: CreditClass) -> bool {
        self.pool(class).is_open(1)
    }

    /// Takes room for so many bytes; it is given back when the credit is dropped.
    pub(super) fn take_credit(&self, bytes: usize, class: CreditClass) -> Option<Credit> {
        self.pool(class).take(bytes)
    }

    /// Takes room for an event, which never waits, and leaves half to what does.
    pub(super) fn take_for_event(&self, bytes: usize, class: CreditClass) -> Option<Credit> {
        let pool = self.pool(class);
        if pool.is_open(2) { pool.take(bytes) } else { None }
    }
}

impl Pool {
    /// More may be under way, up to this share of all.
    fn is_open(&self, share: usize) -> bool {
        self.messages.load(Relaxed) < MESSAGES_MAX / share
            && self.bytes.load(Relaxed) < BYTES_MAX / share
    }

    fn take(self: &Arc<Self>, bytes: usize) -> Option<Credit> {
        let messages = self.messages.fetch_add(1, Relaxed);
        let before = self.bytes.fetch_add(bytes, Relaxed);
        // Many threads may have found room for one.
        let credit = Credit::new(self.clone(), bytes);
        (messages < MESSAGES_MAX && before < BYTES_MAX).then_some(credit)
    }
}

impl CreditPool for Pool {
    fn give_back(&self, bytes: usize) {
        let messages = self.messages.fetch_sub(1, Relaxed);
        let before = self.bytes.fetch_sub(bytes, Relaxed);
        // Decided by the values before: when several return credit at once, one of them sees the
        // limit. A sender that is woken too early checks and waits again.
        if messages >= MESSAGES_MAX || before >= BYTES_MAX {
            self.changed.notify_waiters();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fills_one_room_leaves_the_others_theirs_and_gives_it_back() {
        let credits = SendCredits::new(&Arc::new(Notify::new()));
        let all = [Stream::Control, Stream::Data, Stream::Redundant]
            .map(|stream| SizeClass::ALL.map(|load| CreditClass { stream: Some(stream), load }));
        for full in all.concat() {
            let each = if full.load == SizeClass::Bulk { 1 << 19 } else { 64 };
            let fill = || -> Vec<_> {
                (0..9_999).map_while(|_| credits.take_credit(each, full)).collect()
            };

            let taken = fill();

            assert_eq!(taken.len(), if full.load == SizeClass::Bulk { 2 } else { MESSAGES_MAX });
            for class in all.concat() {
                assert_eq!(credits.have_capacity(class), class != full, "{full:?}, {class:?}");
            }
            let took = taken.len();
            drop(taken);
            assert_eq!(fill().len(), took);
        }
    }

    #[test]
    fn events_leave_half_of_their_room_to_what_waits() {
        let credits = SendCredits::new(&Arc::new(Notify::new()));
        let class = CreditClass::of(Some(Stream::Data), 64);

        let events: Vec<_> = (0..9_999).map_while(|_| credits.take_for_event(64, class)).collect();

        assert_eq!(events.len(), MESSAGES_MAX / 2);
        assert!(credits.take_credit(64, class).is_some());
    }
}
