//! The data queue: a queue that is bounded for real.
//!
//! Each port of the owner may have a capacity and a policy of its own: its messages take no places
//! of others. What waits is served in the order in which it came, whatever its port.
//!
//! It belongs to the reference, not to the incarnation that serves it, so that it outlives panics
//! and even a hung thread. Only the incarnation that owns it may take from it. What a full queue
//! does is the owner's stated policy, [`WhenFull`].

use crate::sync::atomic::Ordering::Relaxed;
use crate::sync::atomic::{AtomicBool, AtomicUsize};
use crate::sync::{Mutex, MutexGuard};
use blastema_core::{DeliveryError, Incarnation};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::PoisonError;
use std::task::{Poll, Waker};

/// So many of the oldest messages are looked at where a new one has no room: those that expire are
/// among them, since older messages expire first, and a flood is refused in bounded time.
const PURGED: usize = 64;

/// What happens to a message that exceeds a queue's capacity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum WhenFull {
    /// The sender gets it back.
    #[default]
    Refuse,
    /// The message is accepted, and the oldest one becomes a dead letter: for data of which the
    /// newest counts.
    DropOldest,
    /// The message becomes a dead letter: for data of which the first counts.
    DropNewest,
    /// As `Refuse`, for senders that use `deliver`, which waits for room.
    Wait,
}

/// The next message, if there is one.
pub(crate) enum Popped<T> {
    /// Here it is.
    Got(T),
    /// None; the waker is kept for when one comes.
    Empty,
    /// The asking incarnation owns the queue no more.
    Retired,
}

/// The result of enqueuing a message, to be acted upon after locks were released.
pub(crate) struct Pushed<T> {
    /// The older one that had to leave.
    pub(crate) displaced: Option<T>,
    /// To be woken.
    pub(crate) parked: Option<Waker>,
}

/// A bounded queue from many senders to the one incarnation that owns it.
pub(crate) struct BoundedQueue<T> {
    inner: Mutex<Inner<T>>,
    /// Written under the lock; a hint for callers that only check whether anything is there.
    length: AtomicUsize,
    /// Nothing is taken while set.
    held: AtomicBool,
    /// The capacity and policy of each port; the first one is for all ports without their own.
    bounds: Box<[(usize, WhenFull)]>,
}

struct Inner<T> {
    /// Each with its port.
    queue: VecDeque<(usize, T)>,
    /// How many wait at each port but the first one, which has the others: most queues have one
    /// port, and no memory for this.
    waiting: Box<[usize]>,
    /// Boxed, since few components watch others.
    notices: Option<Box<Notices<T>>>,
    /// The incarnation that may take; `None` between two incarnations.
    owner: Option<Incarnation>,
    /// The last incarnation that has owned it.
    newest: Incarnation,
    stopped: bool,
    parked: Option<Waker>,
    /// Boxed, since few queues are ever full.
    space: Option<Box<SpaceWaiters>>,
}

/// Notices for the owner, each under what it is about. They are taken before the queue and need no
/// room in it; they end with the owner. At most one for each thing that the owner watches.
type Notices<T> = VecDeque<(Box<str>, T)>;

/// Senders that wait for room, in the order in which they came.
#[derive(Default)]
struct SpaceWaiters {
    /// By ticket and port.
    waiting: VecDeque<(u64, usize, Waker)>,
    next_ticket: u64,
}

impl SpaceWaiters {
    /// The one that has waited longest for this port.
    fn next(&mut self, port: usize) -> Option<Waker> {
        let first = self.waiting.iter().position(|(_, of, _)| *of == port)?;
        self.waiting.remove(first).map(|(.., waker)| waker)
    }
}

impl<T> BoundedQueue<T> {
    pub(crate) fn new(capacity: usize, policy: WhenFull) -> Self {
        BoundedQueue::with_ports([(capacity, policy)].into())
    }

    /// The same with a capacity and a policy for each port.
    pub(crate) fn with_ports(bounds: Box<[(usize, WhenFull)]>) -> Self {
        let inner = Inner {
            queue: VecDeque::new(),
            waiting: vec![0; bounds.len().saturating_sub(1)].into(),
            notices: None,
            owner: None,
            newest: Incarnation::default(),
            stopped: false,
            parked: None,
            space: None,
        };
        BoundedQueue {
            inner: Mutex::new(inner),
            length: AtomicUsize::new(0),
            held: AtomicBool::new(false),
            bounds,
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How many may wait at this port, and what happens to one more.
    pub(crate) fn bound(&self, port: usize) -> (usize, WhenFull) {
        self.bounds[port]
    }

    /// Asks the bound first and packs only what goes in, so that a refused message comes back as it
    /// was. `Ok(Some)` is the older one that had to leave.
    #[inline]
    pub(crate) fn push_with<M>(
        &self,
        port: usize,
        message: M,
        pack: impl FnOnce(M) -> T,
    ) -> Result<Option<T>, (M, DeliveryError)> {
        let Pushed { displaced, parked } = self.push_quietly(port, message, pack)?;
        // To wake across threads is a system call, so it happens outside of the lock.
        if let Some(waker) = parked {
            waker.wake();
        }
        Ok(displaced)
    }

    /// The same for a caller that wakes the owner later.
    #[inline]
    pub(crate) fn push_quietly<M>(
        &self,
        port: usize,
        message: M,
        pack: impl FnOnce(M) -> T,
    ) -> Result<Pushed<T>, (M, DeliveryError)> {
        let mut queue = self.lock();
        if queue.stopped {
            return Err((message, DeliveryError::Stopped));
        }
        let mut displaced = None;
        let (capacity, policy) = self.bounds[port];
        if queue.waiting_at(port) >= capacity {
            match policy {
                WhenFull::DropOldest => {
                    let oldest = queue.queue.iter().position(|(of, _)| *of == port);
                    displaced = oldest.and_then(|oldest| queue.remove(oldest));
                }
                // No incarnation takes from it now: the reason is the death, not the load.
                _ if queue.owner.is_none() => return Err((message, DeliveryError::Restarting)),
                _ => return Err((message, DeliveryError::Full)),
            }
        }
        queue.queue.push_back((port, pack(message)));
        if let Some(own) = queue.waiting_mut(port) {
            *own += 1;
        }
        self.length.store(queue.depth(), Relaxed);
        Ok(Pushed { displaced, parked: queue.parked.take() })
    }

    /// Whether there may be no room at this port.
    #[inline]
    pub(crate) fn is_at_bound(&self, port: usize) -> bool {
        self.depth() >= self.bounds[port].0
    }

    /// Takes out those of the oldest messages that are over. Senders that wait for their places are
    /// woken.
    pub(crate) fn purge(&self, is_over: impl Fn(&T) -> bool) -> Vec<T> {
        let (mut queue, mut over, mut woken) = (self.lock(), Vec::new(), Vec::new());
        let mut at = 0;
        while let Some((port, item)) = queue.queue.get(at).filter(|_| at < PURGED) {
            if is_over(item) {
                let port = *port;
                over.extend(queue.remove(at));
                woken.extend(queue.space.as_mut().and_then(|space| space.next(port)));
            } else {
                at += 1;
            }
        }
        self.length.store(queue.depth(), Relaxed);
        drop(queue);
        woken.into_iter().for_each(Waker::wake);
        over
    }

    /// Puts a notice for the incarnation `owner` before all that waits, whether there is room or
    /// not. A notice about the same thing that still waits is replaced. Returned is what is not
    /// going to be served: the replaced notice, or this one if the queue belongs to another
    /// incarnation.
    pub(crate) fn notify(&self, owner: Incarnation, about: &str, notice: T) -> Option<T> {
        let mut queue = self.lock();
        if queue.owner != Some(owner) {
            return Some(notice);
        }
        let notices = queue.notices.get_or_insert_default();
        let waiting = notices.iter_mut().find(|(known, _)| **known == *about);
        let replaced = match waiting {
            Some((_, earlier)) => Some(std::mem::replace(earlier, notice)),
            None => {
                notices.push_back((about.into(), notice));
                None
            }
        };
        self.length.store(queue.depth(), Relaxed);
        let parked = queue.parked.take();
        drop(queue);
        if let Some(waker) = parked {
            waker.wake();
        }
        replaced
    }

    /// Completes when there may be capacity at this port. The caller then tries again; a claim that
    /// is dropped is passed on to the next.
    pub(crate) fn space(&self, port: usize) -> impl Future<Output = ()> + '_ {
        let mut claim = SpaceWaiter { queue: self, port, ticket: None };
        poll_fn(move |cx| claim.poll(cx.waker()))
    }

    /// The next message for the incarnation `owner`; where there is none, the waker is kept.
    #[inline]
    pub(crate) fn take(&self, owner: Incarnation, waker: &Waker) -> Popped<T> {
        let mut queue = self.lock();
        if queue.owner != Some(owner) {
            return Popped::Retired;
        }
        if self.held.load(Relaxed) {
            queue.parked = Some(waker.clone());
            return Popped::Empty;
        }
        if let Some((_, notice)) = queue.notices.as_mut().and_then(|notices| notices.pop_front()) {
            self.length.store(queue.depth(), Relaxed);
            return Popped::Got(notice);
        }
        let Some((port, item)) = queue.queue.pop_front() else {
            queue.parked = Some(waker.clone());
            return Popped::Empty;
        };
        queue.taken(port);
        self.length.store(queue.depth(), Relaxed);
        let next = queue.space.as_mut().and_then(|space| space.next(port));
        drop(queue);
        if let Some(waker) = next {
            waker.wake();
        }
        Popped::Got(item)
    }

    /// From now on only this incarnation may take: `incarnation`, or the one after the last that
    /// has owned the queue, so that no two have one number. Says which. An incarnation that lost
    /// the queue is cut off from its input.
    pub(crate) fn begin(&self, incarnation: Incarnation) -> Incarnation {
        let mut queue = self.lock();
        let incarnation = incarnation.max(queue.newest.next());
        let notices = self.change_owner(&mut queue, Some(incarnation));
        queue.stopped = false;
        let parked = queue.parked.take();
        drop(queue);
        drop(notices);
        if let Some(waker) = parked {
            waker.wake();
        }
        incarnation
    }

    /// Passes the queue from one incarnation to the next, unless it already belongs to another.
    pub(crate) fn pass_on(&self, from: Incarnation, to: Incarnation) -> bool {
        self.change_owner_of(from, Some(to))
    }

    /// Takes the queue from `owner`, unless it already belongs to another.
    pub(crate) fn leave(&self, owner: Incarnation) -> bool {
        self.change_owner_of(owner, None)
    }

    /// Takes the queue from the incarnation that owns it, and says which that was.
    pub(crate) fn evict(&self) -> Option<Incarnation> {
        let mut queue = self.lock();
        let owner = queue.owner;
        let notices = self.change_owner(&mut queue, None);
        drop(queue);
        drop(notices);
        owner
    }

    fn change_owner_of(&self, from: Incarnation, to: Option<Incarnation>) -> bool {
        let mut queue = self.lock();
        let mine = queue.owner == Some(from);
        let notices = mine.then(|| self.change_owner(&mut queue, to));
        drop(queue);
        drop(notices);
        mine
    }

    /// Hands out the notices of the owner before, to be dropped outside of the lock.
    fn change_owner(
        &self,
        queue: &mut Inner<T>,
        owner: Option<Incarnation>,
    ) -> Option<Box<Notices<T>>> {
        queue.owner = owner;
        queue.newest = queue.newest.max(owner.unwrap_or_default());
        let notices = std::mem::take(&mut queue.notices);
        self.length.store(queue.depth(), Relaxed);
        notices
    }

    /// The incarnation that may take.
    pub(crate) fn owner(&self) -> Option<Incarnation> {
        self.lock().owner
    }

    /// Keeps everything in the queue, or lets it flow again.
    pub(crate) fn hold(&self, held: bool) {
        self.held.store(held, Relaxed);
        self.wake();
    }

    /// Has its owner look again.
    pub(crate) fn wake(&self) {
        let parked = self.lock().parked.take();
        if let Some(waker) = parked {
            waker.wake();
        }
    }

    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.length.load(Relaxed) == 0
    }

    /// What this finds among what waits.
    pub(crate) fn select<R>(&self, mut find: impl FnMut(&T) -> Option<R>) -> Vec<R> {
        self.lock().queue.iter().filter_map(|(_, item)| find(item)).collect()
    }

    /// Whether something waits that is taken before the queue.
    pub(crate) fn has_notices(&self) -> bool {
        self.lock().notices.as_ref().is_some_and(|notices| !notices.is_empty())
    }

    /// How many messages wait.
    #[inline]
    pub(crate) fn depth(&self) -> usize {
        self.length.load(Relaxed)
    }

    /// Looks at the oldest message.
    pub(crate) fn with_oldest<R>(&self, look: impl FnOnce(&T) -> R) -> Option<R> {
        self.lock().queue.front().map(|(_, oldest)| look(oldest))
    }

    /// Whether this is true of what came last of all that waits.
    pub(crate) fn newest_is(&self, is_true: impl FnOnce(&T) -> bool) -> bool {
        self.lock().queue.back().is_some_and(|(_, newest)| is_true(newest))
    }

    /// Whether it is closed.
    pub(crate) fn is_stopped(&self) -> bool {
        self.lock().stopped
    }

    /// A copy of everything that waits.
    pub(crate) fn snapshot(&self) -> Vec<T>
    where
        T: Clone,
    {
        self.select(|item| Some(item.clone()))
    }

    /// Closes the queue until it has an owner again, and returns what was never served.
    pub(crate) fn stop(&self) -> VecDeque<T> {
        self.stop_if(|_| true)
    }

    /// The same, unless the queue does not belong to `owner` any more.
    pub(crate) fn stop_by(&self, owner: Incarnation) -> VecDeque<T> {
        self.stop_if(|of| of == Some(owner))
    }

    fn stop_if(&self, allowed: impl FnOnce(Option<Incarnation>) -> bool) -> VecDeque<T> {
        let mut queue = self.lock();
        if !allowed(queue.owner) {
            return VecDeque::new();
        }
        queue.stopped = true;
        let notices = self.change_owner(&mut queue, None);
        let parked = queue.parked.take();
        let space = queue.space.as_mut().map(|space| std::mem::take(&mut space.waiting));
        let left = std::mem::take(&mut queue.queue).into_iter().map(|(_, item)| item).collect();
        queue.waiting.fill(0);
        self.length.store(0, Relaxed);
        drop(queue);
        drop(notices);
        let space = space.into_iter().flatten().map(|(.., waker)| waker);
        parked.into_iter().chain(space).for_each(Waker::wake);
        left
    }
}

impl<T> Inner<T> {
    fn remove(&mut self, at: usize) -> Option<T> {
        let (port, item) = self.queue.remove(at)?;
        self.taken(port);
        Some(item)
    }

    /// The count of a port that has one of its own.
    #[inline]
    fn waiting_mut(&mut self, port: usize) -> Option<&mut usize> {
        self.waiting.get_mut(port.checked_sub(1)?)
    }

    /// One that waited at this port was taken.
    #[inline]
    fn taken(&mut self, port: usize) {
        if let Some(own) = self.waiting_mut(port) {
            *own -= 1;
        }
    }

    /// How many wait at a port.
    #[inline]
    fn waiting_at(&self, port: usize) -> usize {
        match port.checked_sub(1) {
            Some(own) => self.waiting[own],
            None => self.queue.len() - self.waiting.iter().sum::<usize>(),
        }
    }

    /// How many wait to be taken.
    fn depth(&self) -> usize {
        self.notices.as_ref().map_or(0, |notices| notices.len()) + self.queue.len()
    }
}

/// One sender's place among those that wait for room.
struct SpaceWaiter<'a, T> {
    queue: &'a BoundedQueue<T>,
    port: usize,
    ticket: Option<u64>,
}

impl<T> SpaceWaiter<'_, T> {
    fn poll(&mut self, waker: &Waker) -> Poll<()> {
        let mut queue = self.queue.lock();
        if let Some(ticket) = self.ticket {
            let space = queue.space.get_or_insert_default();
            let mine = space.waiting.iter_mut().find(|(of, ..)| *of == ticket);
            let Some((.., kept)) = mine else {
                self.ticket = None; // Capacity was freed, and this waiter was woken.
                return Poll::Ready(());
            };
            kept.clone_from(waker);
            return Poll::Pending;
        }
        if queue.stopped || queue.waiting_at(self.port) < self.queue.bounds[self.port].0 {
            return Poll::Ready(());
        }
        let space = queue.space.get_or_insert_default();
        let ticket = space.next_ticket;
        space.next_ticket += 1;
        space.waiting.push_back((ticket, self.port, waker.clone()));
        self.ticket = Some(ticket);
        Poll::Pending
    }
}

impl<T> Drop for SpaceWaiter<'_, T> {
    fn drop(&mut self) {
        let Some(ticket) = self.ticket else { return };
        let mut queue = self.queue.lock();
        let Some(space) = &mut queue.space else { return };
        let before = space.waiting.len();
        space.waiting.retain(|(of, ..)| *of != ticket);
        // It was called and never came: the room it was called for goes to the next.
        let next = if space.waiting.len() == before { space.next(self.port) } else { None };
        drop(queue);
        if let Some(waker) = next {
            waker.wake();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::pin::pin;
    use std::sync::Arc;
    use std::sync::atomic::AtomicU32;
    use std::task::{Context, Wake};

    #[derive(Default)]
    struct Count(AtomicU32);

    impl Wake for Count {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Relaxed);
        }
    }

    const LIFE: Incarnation = Incarnation(1);

    fn queue(capacity: usize, policy: WhenFull) -> BoundedQueue<u32> {
        let queue = BoundedQueue::new(capacity, policy);
        queue.begin(LIFE);
        queue
    }

    fn push(queue: &BoundedQueue<u32>, n: u32) -> Result<Option<u32>, (u32, DeliveryError)> {
        queue.push_with(0, n, |n| n)
    }

    fn take(queue: &BoundedQueue<u32>) -> Option<u32> {
        take_as(queue, LIFE)
    }

    fn take_as(queue: &BoundedQueue<u32>, incarnation: Incarnation) -> Option<u32> {
        match queue.take(incarnation, Waker::noop()) {
            Popped::Got(n) => Some(n),
            _ => None,
        }
    }

    #[test]
    fn a_full_lane_does_what_its_policy_says() {
        for policy in [WhenFull::Refuse, WhenFull::DropNewest, WhenFull::Wait] {
            let queue = queue(1, policy);
            assert_eq!(push(&queue, 1), Ok(None));
            assert_eq!(push(&queue, 2), Err((2, DeliveryError::Full)));
        }
        let queue = queue(1, WhenFull::DropOldest);
        assert_eq!(push(&queue, 1), Ok(None));
        assert_eq!(push(&queue, 2), Ok(Some(1)));
    }

    #[test]
    fn a_queue_without_an_incarnation_keeps_its_messages() {
        let queue = queue(1, WhenFull::Refuse);
        assert!(queue.leave(LIFE));

        assert_eq!(push(&queue, 1), Ok(None));
        assert_eq!(push(&queue, 2), Err((2, DeliveryError::Restarting)));

        let next = queue.begin(LIFE);
        assert_eq!(next, LIFE.next(), "no two incarnations have one number");
        assert!(matches!(queue.take(next, Waker::noop()), Popped::Got(1)));
    }

    #[test]
    fn only_the_owner_takes() {
        let queue = queue(2, WhenFull::Refuse);
        push(&queue, 1).unwrap();

        queue.begin(LIFE.next());

        assert!(matches!(queue.take(LIFE, Waker::noop()), Popped::Retired));
        assert!(!queue.leave(LIFE) && !queue.pass_on(LIFE, LIFE));
        assert!(matches!(queue.take(LIFE.next(), Waker::noop()), Popped::Got(1)));
        assert!(queue.pass_on(LIFE.next(), LIFE));
        assert_eq!(queue.owner(), Some(LIFE));
    }

    #[test]
    fn a_stopped_queue_returns_its_messages_and_opens_again() {
        let queue = queue(2, WhenFull::Refuse);
        push(&queue, 1).unwrap();

        assert_eq!(queue.stop_by(LIFE.next()), [0; 0]);
        assert_eq!(queue.stop_by(LIFE), [1]);
        assert_eq!(queue.stop(), [0; 0]);
        assert_eq!(push(&queue, 2), Err((2, DeliveryError::Stopped)));

        queue.begin(LIFE.next());
        assert_eq!(push(&queue, 2), Ok(None));
    }

    #[test]
    fn a_held_lane_gives_nothing_until_it_is_let_go() {
        let queue = queue(2, WhenFull::Refuse);
        push(&queue, 1).unwrap();
        queue.hold(true);
        assert_eq!(take(&queue), None);

        queue.hold(false);

        assert_eq!(take(&queue), Some(1));
    }

    #[test]
    fn room_wakes_one_waiter_and_a_dropped_claim_passes_it_on() {
        let queue = queue(1, WhenFull::Wait);
        push(&queue, 1).unwrap();
        let (first, second) = (Arc::new(Count::default()), Arc::new(Count::default()));
        let (one, two) = (Waker::from(first.clone()), Waker::from(second.clone()));
        let mut claim_one = Box::pin(queue.space(0));
        let mut claim_two = pin!(queue.space(0));
        assert!(claim_one.as_mut().poll(&mut Context::from_waker(&one)).is_pending());
        assert!(claim_two.as_mut().poll(&mut Context::from_waker(&two)).is_pending());

        assert_eq!(take(&queue), Some(1));
        assert_eq!((first.0.load(Relaxed), second.0.load(Relaxed)), (1, 0));

        drop(claim_one);
        assert_eq!(second.0.load(Relaxed), 1);
        assert!(claim_two.as_mut().poll(&mut Context::from_waker(&two)).is_ready());
    }

    #[test]
    fn a_notice_comes_before_the_queue_and_though_that_is_full() {
        for policy in [WhenFull::Refuse, WhenFull::DropNewest, WhenFull::DropOldest] {
            let queue = queue(1, policy);
            push(&queue, 1).unwrap();

            assert_eq!(queue.notify(LIFE, "arm", 7), None);
            assert_eq!(queue.notify(LIFE, "leg", 8), None);
            assert_eq!(queue.depth(), 3);
            assert_eq!(queue.notify(LIFE, "arm", 9), Some(7), "one outstanding for each");

            let taken: Vec<_> = std::iter::from_fn(|| take(&queue)).collect();
            assert_eq!(taken, [9, 8, 1], "{policy:?}");
            assert!(queue.is_empty());
        }
    }

    #[test]
    fn a_notice_is_for_one_incarnation_only() {
        let queue = queue(1, WhenFull::Refuse);
        let next = LIFE.next();
        assert_eq!(queue.notify(next, "arm", 1), Some(1), "it does not own the queue");

        queue.notify(LIFE, "arm", 2);
        assert!(queue.pass_on(LIFE, next));
        assert_eq!((take_as(&queue, next), queue.is_empty()), (None, true));

        queue.notify(next, "arm", 3);
        assert_eq!(queue.stop(), [0; 0], "nor is it a message that was not served");
        assert!(queue.is_empty());
    }

    #[test]
    fn a_notice_wakes_the_owner_and_makes_no_room() {
        let queue = queue(1, WhenFull::Wait);
        let (owner, sender) = (Arc::new(Count::default()), Arc::new(Count::default()));
        let of_owner = Waker::from(owner.clone());
        assert!(matches!(queue.take(LIFE, &of_owner), Popped::Empty));
        queue.notify(LIFE, "arm", 1);
        assert_eq!(owner.0.load(Relaxed), 1);
        push(&queue, 2).unwrap();
        let of_sender = Waker::from(sender.clone());
        let mut space = pin!(queue.space(0));
        assert!(space.as_mut().poll(&mut Context::from_waker(&of_sender)).is_pending());

        assert_eq!(take(&queue), Some(1));
        assert_eq!(sender.0.load(Relaxed), 0);
        assert_eq!(take(&queue), Some(2));
        assert_eq!(sender.0.load(Relaxed), 1);
    }

    #[test]
    fn a_queue_with_one_port_takes_no_memory_to_count_by_port() {
        assert!(queue(1, WhenFull::Refuse).lock().waiting.is_empty());
    }

    #[test]
    fn ports_fill_and_drop_apart_and_are_served_in_the_order_of_arrival() {
        let bounds = [(1, WhenFull::Refuse), (2, WhenFull::DropOldest)];
        let queue = BoundedQueue::with_ports(bounds.into());
        queue.begin(LIFE);
        let to = |port, n| queue.push_with(port, n, |n| n);

        assert_eq!(to(1, 10), Ok(None));
        assert_eq!(to(1, 11), Ok(None));
        assert_eq!(to(0, 1), Ok(None), "a flood at another port leaves room");
        assert_eq!(to(1, 12), Ok(Some(10)));
        assert_eq!(to(0, 2), Err((2, DeliveryError::Full)));
        let mut space = pin!(queue.space(0));
        let sender = Arc::new(Count::default());
        let waker = Waker::from(sender.clone());
        assert!(space.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());

        assert_eq!(take(&queue), Some(11));
        assert_eq!(sender.0.load(Relaxed), 0, "room at another port");
        assert_eq!((take(&queue), take(&queue), take(&queue)), (Some(1), Some(12), None));
        assert_eq!(sender.0.load(Relaxed), 1);
    }

    #[test]
    fn what_is_over_leaves_its_place_where_there_is_no_room() {
        let queue = queue(3, WhenFull::Refuse);
        for n in 1..=2 {
            push(&queue, n).unwrap();
        }
        assert!(!queue.is_at_bound(0));
        push(&queue, 3).unwrap();
        assert!(queue.is_at_bound(0));

        assert_eq!(queue.purge(|n| n % 2 == 1), [1, 3]);

        push(&queue, 4).unwrap();
        assert_eq!((take(&queue), take(&queue), take(&queue)), (Some(2), Some(4), None));
    }
}
