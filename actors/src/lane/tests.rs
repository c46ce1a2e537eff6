//! The lane by one thread; how threads interleave in it is checked in `tests/tests/interleavings`.

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

fn lane(capacity: usize, policy: WhenFull) -> Lane<u32> {
    let lane = Lane::new(capacity, policy);
    lane.give_to(Some(LIFE));
    lane
}

fn push(lane: &Lane<u32>, n: u32) -> Result<Option<u32>, (u32, Why)> {
    lane.push_with(n, |n| n)
}

fn take(lane: &Lane<u32>) -> Option<u32> {
    take_as(lane, LIFE)
}

fn take_as(lane: &Lane<u32>, life: Incarnation) -> Option<u32> {
    match lane.take(life, Waker::noop()) {
        Taken::Got(n) => Some(n),
        _ => None,
    }
}

#[test]
fn a_full_lane_does_what_its_policy_says() {
    for policy in [WhenFull::Refuse, WhenFull::DropNewest, WhenFull::Wait] {
        let lane = lane(1, policy);
        assert_eq!(push(&lane, 1), Ok(None));
        assert_eq!(push(&lane, 2), Err((2, Why::Full)));
    }
    let lane = lane(1, WhenFull::DropOldest);
    assert_eq!(push(&lane, 1), Ok(None));
    assert_eq!(push(&lane, 2), Ok(Some(1)));
}

#[test]
fn a_lane_without_a_life_keeps_what_it_has_and_says_restarting_when_full() {
    let lane = lane(1, WhenFull::Refuse);
    assert!(lane.leave(LIFE));

    assert_eq!(push(&lane, 1), Ok(None));
    assert_eq!(push(&lane, 2), Err((2, Why::Restarting)));

    lane.give_to(Some(LIFE));
    assert_eq!(take(&lane), Some(1));
}

#[test]
fn only_the_owner_takes() {
    let lane = lane(2, WhenFull::Refuse);
    push(&lane, 1).unwrap();

    lane.give_to(Some(LIFE.next()));

    assert!(matches!(lane.take(LIFE, Waker::noop()), Taken::Retired));
    assert!(!lane.leave(LIFE) && !lane.pass_on(LIFE, LIFE));
    assert!(matches!(lane.take(LIFE.next(), Waker::noop()), Taken::Got(1)));
    assert!(lane.pass_on(LIFE.next(), LIFE));
    assert_eq!(lane.owner(), Some(LIFE));
}

#[test]
fn a_stopped_lane_hands_out_what_was_left_and_opens_for_the_next_life() {
    let lane = lane(2, WhenFull::Refuse);
    push(&lane, 1).unwrap();

    assert_eq!(lane.stop_by(LIFE.next()), [0; 0]);
    assert_eq!(lane.stop_by(LIFE), [1]);
    assert_eq!(lane.stop(), [0; 0]);
    assert_eq!(push(&lane, 2), Err((2, Why::Stopped)));
    lane.give_to(None);
    assert_eq!(push(&lane, 2), Err((2, Why::Stopped)));

    lane.give_to(Some(LIFE.next()));
    assert_eq!(push(&lane, 2), Ok(None));
}

#[test]
fn a_held_lane_gives_nothing_until_it_is_let_go() {
    let lane = lane(2, WhenFull::Refuse);
    push(&lane, 1).unwrap();
    lane.hold(true);
    assert_eq!(take(&lane), None);

    lane.hold(false);

    assert_eq!(take(&lane), Some(1));
}

#[test]
fn room_wakes_one_waiter_and_a_dropped_claim_passes_it_on() {
    let lane = lane(1, WhenFull::Wait);
    push(&lane, 1).unwrap();
    let (first, second) = (Arc::new(Count::default()), Arc::new(Count::default()));
    let (one, two) = (Waker::from(first.clone()), Waker::from(second.clone()));
    let mut claim_one = Box::pin(lane.room());
    let mut claim_two = pin!(lane.room());
    assert!(claim_one.as_mut().poll(&mut Context::from_waker(&one)).is_pending());
    assert!(claim_two.as_mut().poll(&mut Context::from_waker(&two)).is_pending());

    assert_eq!(take(&lane), Some(1));
    assert_eq!((first.0.load(Relaxed), second.0.load(Relaxed)), (1, 0));

    drop(claim_one);
    assert_eq!(second.0.load(Relaxed), 1);
    assert!(claim_two.as_mut().poll(&mut Context::from_waker(&two)).is_ready());
}

#[test]
fn a_notice_comes_before_the_queue_and_though_that_is_full() {
    for policy in [WhenFull::Refuse, WhenFull::DropNewest, WhenFull::DropOldest] {
        let lane = lane(1, policy);
        push(&lane, 1).unwrap();

        assert_eq!(lane.notify(LIFE, "arm", 7), None);
        assert_eq!(lane.notify(LIFE, "leg", 8), None);
        assert_eq!(lane.depth(), 3);
        assert_eq!(lane.notify(LIFE, "arm", 9), Some(7), "one outstanding for each");

        let taken: Vec<_> = std::iter::from_fn(|| take(&lane)).collect();
        assert_eq!(taken, [9, 8, 1], "{policy:?}");
        assert!(lane.is_empty());
    }
}

#[test]
fn a_notice_is_for_one_life_only() {
    let lane = lane(1, WhenFull::Refuse);
    let next = LIFE.next();
    assert_eq!(lane.notify(next, "arm", 1), Some(1), "it does not own the lane");

    lane.notify(LIFE, "arm", 2);
    assert!(lane.pass_on(LIFE, next));
    assert_eq!((take_as(&lane, next), lane.is_empty()), (None, true));

    lane.notify(next, "arm", 3);
    assert_eq!(lane.stop(), [0; 0], "nor is it a message that was not served");
    assert!(lane.is_empty());
}

#[test]
fn a_notice_wakes_the_owner_and_makes_no_room() {
    let lane = lane(1, WhenFull::Wait);
    let (owner, sender) = (Arc::new(Count::default()), Arc::new(Count::default()));
    let of_owner = Waker::from(owner.clone());
    assert!(matches!(lane.take(LIFE, &of_owner), Taken::Empty));
    lane.notify(LIFE, "arm", 1);
    assert_eq!(owner.0.load(Relaxed), 1);
    push(&lane, 2).unwrap();
    let of_sender = Waker::from(sender.clone());
    let mut room = pin!(lane.room());
    assert!(room.as_mut().poll(&mut Context::from_waker(&of_sender)).is_pending());

    assert_eq!(take(&lane), Some(1));
    assert_eq!(sender.0.load(Relaxed), 0);
    assert_eq!(take(&lane), Some(2));
    assert_eq!(sender.0.load(Relaxed), 1);
}
