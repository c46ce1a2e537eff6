//! Handing things over one by one until each is confirmed.

use crate::sorted::SortedMap;
use crate::{Instant, Machine, SlidingWindow};
use std::collections::VecDeque;
use std::time::Duration;

/// A delivery that is exactly one second old does not count any more.
const SECOND: Duration = Duration::from_nanos(999_999_999);

/// Hands items over to one receiver: in order of rank, one at a time, repeated with back-off until
/// it is confirmed, given up loudly.
///
/// Only one item is under way at any time. So items of one rank arrive in the order in which they
/// were given, and a receiver detects a repetition by comparing with the one number that it saw
/// last.
///
/// ```text
/// hand(item) ─► waiting ─► under way ──handle_confirmed──► done
///                 │          │    ▲
///        full: GivenUp       │    └ timeout over, or known to have failed: again
///                            └ tries used up: GivenUp
/// ```
#[derive(Clone, Debug)]
pub struct ConfirmedQueue<T> {
    limits: ConfirmedQueueLimits,
    number: u64,
    waiting: SortedMap<(u8, u64), T>,
    flight: Option<Flight<T>>,
    /// The latest deliveries.
    recent: SlidingWindow,
    outputs: VecDeque<ConfirmedQueueOutput<T>>,
}

/// The bounds of a [`ConfirmedQueue`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConfirmedQueueLimits {
    /// How many items may wait. More survives a longer outage of the receiver and takes more
    /// memory.
    pub capacity: usize,
    /// How long a confirmation may take before the item is sent again; doubled from try to try.
    /// Less repairs a loss sooner and repeats more to a slow receiver.
    pub timeout: Duration,
    /// The longest pause between two tries.
    pub longest: Duration,
    /// After how many tries an item is given up.
    pub tries: u32,
    /// How many deliveries a second: what comes faster is held back, not lost.
    pub per_second: u32,
}

impl ConfirmedQueueLimits {
    /// Those of two ends on one arbiter.
    pub const DEFAULT: Self = ConfirmedQueueLimits {
        // Every one of a thousand objects may have something to tell at the same moment.
        capacity: 1024,
        // Both ends share an arbiter that turns in well under a millisecond.
        timeout: Duration::from_millis(100),
        longest: Duration::from_secs(1),
        // Five seconds in all: a receiver that a guardian has not brought back by then is gone.
        tries: 8,
        // Far above what a robot in order has to tell, far below what an arbiter can take.
        per_second: 10_000,
    };
}

/// An output of a [`ConfirmedQueue`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ConfirmedQueueOutput<T> {
    /// Send it to the receiver.
    Deliver {
        /// Goes with the item and comes back with the confirmation.
        number: u64,
        /// What the receiver is to confirm.
        item: T,
    },
    /// The item is not sent again: report it to a person.
    GivenUp {
        /// What the receiver has not confirmed.
        item: T,
        /// How often it was sent; zero if there was no room for it.
        tries: u32,
    },
}

#[derive(Clone, Debug)]
struct Flight<T> {
    number: u64,
    item: T,
    tries: u32,
    /// When it is sent again.
    due: Instant,
}

impl<T: Clone> ConfirmedQueue<T> {
    /// A hand-over whose numbers begin after `first`. A sender that restarts with nothing
    /// remembered gives the present time, in nanoseconds: larger than any number it used before.
    pub fn new(limits: ConfirmedQueueLimits, first: u64) -> Self {
        ConfirmedQueue {
            limits,
            number: first,
            waiting: SortedMap::new(),
            flight: None,
            recent: SlidingWindow::new(limits.per_second, SECOND),
            outputs: VecDeque::new(),
        }
    }

    /// Takes an item. Lower ranks go first. When there is no room, the last item that waits is
    /// given up.
    pub fn hand(&mut self, rank: u8, item: T, now: Instant) {
        self.number += 1;
        self.waiting.insert((rank, self.number), item);
        if self.waiting.len() > self.limits.capacity {
            let (_, item) = self.waiting.pop_last().expect("one was just put in");
            self.give_up(item, 0);
        }
        self.advance(now);
    }

    /// The receiver has confirmed. Confirmations of anything but what is under way are ignored.
    pub fn handle_confirmed(&mut self, number: u64, now: Instant) {
        if self.flight.as_ref().is_some_and(|flight| flight.number == number) {
            self.flight = None;
            self.advance(now);
        }
    }

    /// It is known that a delivery did not arrive. The first time it is sent again at once, since a
    /// receiver that a guardian restarts is back by now; after that the back-off holds.
    pub fn handle_failed(&mut self, number: u64, now: Instant) {
        if let Some(flight) = &mut self.flight
            && flight.number == number
            && flight.tries == 1
        {
            flight.due = now;
            self.handle_timeout(now);
        }
    }

    /// Takes the first item back that `wanted` says it is, if it is still waiting.
    pub fn withdraw(&mut self, wanted: impl Fn(&T) -> bool) -> Option<T> {
        let key = *self.waiting.iter().find(|(_, item)| wanted(item))?.0;
        self.waiting.remove(&key)
    }

    /// The item under way.
    pub fn under_way(&self) -> Option<&T> {
        self.flight.as_ref().map(|flight| &flight.item)
    }

    /// Sends what is under way again: for a body that has lost its open deliveries. The lost try
    /// counts, so that an item that kills its own sender is given up as well.
    #[must_use]
    pub fn restarted(mut self, now: Instant) -> Self {
        self.outputs.clear();
        if let Some(flight) = &mut self.flight {
            flight.due = now;
        }
        self.handle_timeout(now);
        self
    }

    fn advance(&mut self, now: Instant) {
        if self.flight.is_some() || self.waiting.is_empty() || self.freed_at(now) > now {
            return;
        }
        let ((_, number), item) = self.waiting.pop_first().expect("one is waiting");
        self.flight = Some(Flight { number, item, tries: 0, due: now });
        self.deliver(now);
    }

    fn deliver(&mut self, now: Instant) {
        let flight = self.flight.as_mut().expect("the caller has seen one");
        flight.tries += 1;
        flight.due = now + pause(&self.limits, flight.tries);
        self.outputs.push_back(ConfirmedQueueOutput::Deliver {
            number: flight.number,
            item: flight.item.clone(),
        });
        self.recent.push((), now);
    }

    fn give_up(&mut self, item: T, tries: u32) {
        self.outputs.push_back(ConfirmedQueueOutput::GivenUp { item, tries });
    }

    /// When the next delivery is allowed by the limit per second.
    fn freed_at(&self, now: Instant) -> Instant {
        match self.recent.left(now) {
            0 => self.recent.next_release().map_or(now, |at| at.max(now)),
            _ => now,
        }
    }
}

fn pause(limits: &ConfirmedQueueLimits, tries: u32) -> Duration {
    // Sixteen doublings exceed any sensible longest pause and cannot overflow.
    let doublings = tries.saturating_sub(1).min(16);
    limits.timeout.saturating_mul(1 << doublings).min(limits.longest)
}

impl<T: Clone> Machine for ConfirmedQueue<T> {
    type Output = ConfirmedQueueOutput<T>;

    fn poll_output(&mut self) -> Option<ConfirmedQueueOutput<T>> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.flight {
            Some(flight) => Some(flight.due),
            None if self.waiting.is_empty() => None,
            None => Some(self.freed_at(Instant::ORIGIN)),
        }
    }

    fn handle_timeout(&mut self, now: Instant) {
        if let Some(flight) = &self.flight
            && flight.due <= now
        {
            if flight.tries < self.limits.tries {
                self.deliver(now);
            } else {
                let flight = self.flight.take().expect("it was just looked at");
                self.give_up(flight.item, flight.tries);
            }
        }
        self.advance(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    const LIMITS: ConfirmedQueueLimits = ConfirmedQueueLimits {
        capacity: 3,
        timeout: Duration::from_millis(100),
        longest: Duration::from_millis(300),
        tries: 4,
        per_second: 1000,
    };

    fn drain<T: Clone>(queue: &mut ConfirmedQueue<T>) -> Vec<ConfirmedQueueOutput<T>> {
        std::iter::from_fn(|| queue.poll_output()).collect()
    }

    /// What is delivered; panics on anything else.
    fn delivered(queue: &mut ConfirmedQueue<&'static str>) -> Vec<(u64, &'static str)> {
        drain(queue)
            .into_iter()
            .map(|handed| match handed {
                ConfirmedQueueOutput::Deliver { number, item } => (number, item),
                ConfirmedQueueOutput::GivenUp { item, .. } => panic!("{item} was given up"),
            })
            .collect()
    }

    #[test]
    fn items_go_one_at_a_time_and_in_order() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);

        queue.hand(1, "a", at(0));
        queue.hand(1, "b", at(0));
        assert_eq!(delivered(&mut queue), [(1, "a")]);

        queue.handle_confirmed(1, at(1));
        assert_eq!(delivered(&mut queue), [(2, "b")]);
        queue.handle_confirmed(2, at(2));
        assert_eq!(queue.poll_timeout(), None);
    }

    #[test]
    fn lower_ranks_overtake_what_waits_but_not_what_is_under_way() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);

        queue.hand(2, "warning", at(0));
        queue.hand(2, "error", at(0));
        queue.hand(0, "critical", at(0));

        assert_eq!(delivered(&mut queue), [(1, "warning")]);
        queue.handle_confirmed(1, at(1));
        assert_eq!(delivered(&mut queue), [(3, "critical")]);
    }

    #[test]
    fn what_is_not_confirmed_is_repeated_with_back_off_and_given_up_loudly() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);
        queue.hand(0, "a", at(0));
        queue.hand(0, "b", at(0));

        let mut reported = Vec::new();
        for millis in [0, 100, 300, 600, 900] {
            queue.handle_timeout(at(millis));
            reported.extend(drain(&mut queue).into_iter().map(|handed| (millis, handed)));
        }

        let a = |millis| (millis, ConfirmedQueueOutput::Deliver { number: 1, item: "a" });
        let lost = (900, ConfirmedQueueOutput::GivenUp { item: "a", tries: 4 });
        let b = (900, ConfirmedQueueOutput::Deliver { number: 2, item: "b" });
        assert_eq!(reported, [a(0), a(100), a(300), a(600), lost, b]);
    }

    #[test]
    fn a_delivery_known_to_have_failed_is_repeated_at_once_and_only_once() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);
        queue.hand(0, "a", at(0));
        delivered(&mut queue);

        queue.handle_failed(1, at(1));
        assert_eq!(delivered(&mut queue), [(1, "a")]);
        queue.handle_failed(1, at(2));
        assert_eq!(delivered(&mut queue), []);

        assert_eq!(queue.poll_timeout(), Some(at(201)));
    }

    #[test]
    fn a_confirmation_of_something_else_changes_nothing() {
        let mut queue = ConfirmedQueue::new(LIMITS, 7);
        queue.hand(0, "a", at(0));
        delivered(&mut queue);

        queue.handle_confirmed(7, at(1));
        queue.handle_failed(9, at(1));

        assert_eq!(queue.under_way(), Some(&"a"));
        assert_eq!(delivered(&mut queue), []);
    }

    #[test]
    fn when_there_is_no_room_the_least_important_is_given_up() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);
        for item in ["under way", "b", "c", "d"] {
            queue.hand(2, item, at(0));
        }
        drain(&mut queue);

        queue.hand(0, "critical", at(0));

        assert_eq!(drain(&mut queue), [ConfirmedQueueOutput::GivenUp { item: "d", tries: 0 }]);
    }

    #[test]
    fn more_than_so_many_a_second_are_held_back() {
        let mut queue = ConfirmedQueue::new(ConfirmedQueueLimits { per_second: 2, ..LIMITS }, 0);
        queue.hand(0, "a", at(0));
        queue.handle_confirmed(1, at(10));
        queue.hand(0, "b", at(20));
        queue.handle_confirmed(2, at(30));
        delivered(&mut queue);

        queue.hand(0, "c", at(40));
        assert_eq!(delivered(&mut queue), []);
        assert_eq!(queue.poll_timeout(), Some(at(1000)));

        queue.handle_timeout(at(1000));
        assert_eq!(delivered(&mut queue), [(3, "c")]);
    }

    #[test]
    fn an_item_is_withdrawn_only_while_it_waits() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);
        queue.hand(0, "a", at(0));
        queue.hand(0, "b", at(0));

        assert_eq!(queue.withdraw(|&item| item == "a"), None);
        assert_eq!(queue.withdraw(|&item| item == "b"), Some("b"));
    }

    #[test]
    fn a_restarted_actor_retransmits_under_the_same_number() {
        let mut queue = ConfirmedQueue::new(LIMITS, 0);
        queue.hand(0, "a", at(0));
        queue.hand(0, "b", at(0));
        delivered(&mut queue);

        let mut queue = queue.restarted(at(5));

        assert_eq!(delivered(&mut queue), [(1, "a")]);
    }
}
