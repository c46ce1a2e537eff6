//! What waits for a medium, hellos first and the usual last.

use crate::frame_medium::QueueLimits;
use blastema_contract::transport::TransmitBacklog;
use blastema_core::Instant;
use blastema_core::medium::lane::FrameLane;
use std::collections::VecDeque;

/// So many urgent frames go first in a row while a usual one waits: a flood of them does not keep
/// it for ever.
const IN_A_ROW: usize = 8;

/// A queue for each lane before one medium, each bounded by itself, so that the usual fills no
/// place of the urgent, nor the urgent one of the hellos.
#[derive(Debug)]
pub(crate) struct TransmitQueues<T> {
    /// By lane.
    queues: [Queue<T>; 3],
    in_a_row: usize,
    /// Since when the one that was taken out last had waited.
    taken: Option<Instant>,
}

#[derive(Debug)]
struct Queue<T> {
    /// Each with its bytes, and since when it waits.
    waiting: VecDeque<(T, usize, Option<Instant>)>,
    bytes: usize,
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        Queue { waiting: VecDeque::new(), bytes: 0 }
    }
}

impl<T> Default for TransmitQueues<T> {
    fn default() -> Self {
        let queues = std::array::from_fn(|_| Queue::default());
        TransmitQueues { queues, in_a_row: 0, taken: None }
    }
}

impl<T> TransmitQueues<T> {
    /// Takes one of so many bytes, at this time; says whether there was room in its lane.
    #[must_use = "what is not taken is to be counted"]
    pub(crate) fn push(
        &mut self,
        lane: FrameLane,
        one: T,
        since: Option<Instant>,
        bytes: usize,
        limits: QueueLimits,
    ) -> bool {
        let queue = &mut self.queues[lane as usize];
        if queue.waiting.len() >= limits.frames || queue.bytes + bytes > limits.bytes {
            return false;
        }
        queue.bytes += bytes;
        queue.waiting.push_back((one, bytes, since));
        true
    }

    /// Takes out the one that is to go next.
    pub(crate) fn pop(&mut self) -> Option<(FrameLane, T)> {
        let (lane, (one, since)) = self.pop_next()?;
        self.taken = since;
        Some((lane, one))
    }

    fn pop_next(&mut self) -> Option<(FrameLane, (T, Option<Instant>))> {
        let [hellos, urgent, usual] = &mut self.queues;
        if let Some(one) = hellos.pop() {
            return Some((FrameLane::Hello, one));
        }
        let has_turn = self.in_a_row >= IN_A_ROW && !usual.waiting.is_empty();
        if !has_turn && let Some(one) = urgent.pop() {
            self.in_a_row += 1;
            return Some((FrameLane::Urgent, one));
        }
        self.in_a_row = 0;
        Some((FrameLane::Usual, usual.pop()?))
    }

    /// What waits, with the one that was taken out last if the medium has not taken it yet.
    pub(crate) fn backlog(&self, is_going: bool, now: Option<Instant>) -> TransmitBacklog {
        let frames = self.len();
        let fronts = self.queues.iter().filter_map(|queue| queue.waiting.front());
        let going = self.taken.filter(|_| is_going);
        let oldest = fronts.filter_map(|(_, _, since)| *since).chain(going).min();
        TransmitBacklog::since(frames + usize::from(is_going), oldest, now)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Throws all away; the answer is how many that were.
    pub(crate) fn clear(&mut self) -> u64 {
        let waiting = self.len();
        *self = TransmitQueues::default();
        waiting as u64
    }

    fn len(&self) -> usize {
        self.queues.iter().map(|queue| queue.waiting.len()).sum()
    }
}

impl<T> Queue<T> {
    fn pop(&mut self) -> Option<(T, Option<Instant>)> {
        let (one, bytes, since) = self.waiting.pop_front()?;
        self.bytes -= bytes;
        Some((one, since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    const LIMITS: QueueLimits = QueueLimits { frames: 20, bytes: 1_000 };

    fn drain(lanes: &mut TransmitQueues<u32>) -> Vec<u32> {
        std::iter::from_fn(|| lanes.pop().map(|(_, one)| one)).collect()
    }

    #[test]
    fn hellos_go_before_the_urgent_and_the_urgent_before_the_usual_each_in_its_order() {
        let mut lanes = TransmitQueues::default();
        for one in 1..=6 {
            let lane = [FrameLane::Usual, FrameLane::Urgent, FrameLane::Hello][one as usize % 3];
            assert!(lanes.push(lane, one, None, 10, LIMITS));
        }

        assert_eq!(drain(&mut lanes), [2, 5, 1, 4, 3, 6]);
        assert!(lanes.is_empty());
    }

    #[test]
    fn each_lane_is_bounded_by_itself_in_frames_and_in_bytes() {
        let mut lanes = TransmitQueues::default();

        let usual =
            (0..30).filter(|one| lanes.push(FrameLane::Usual, *one, None, 0, LIMITS)).count();
        let urgent =
            (0..30).filter(|one| lanes.push(FrameLane::Urgent, *one, None, 400, LIMITS)).count();

        assert_eq!((usual, urgent), (20, 2));
        assert!(lanes.push(FrameLane::Hello, 0, None, 1_000, LIMITS));
        assert_eq!(lanes.clear(), 23);
        assert!(lanes.is_empty() && lanes.push(FrameLane::Urgent, 1, None, 1_000, LIMITS));
    }

    #[test]
    fn what_waits_is_as_old_as_the_frame_that_the_medium_has_not_taken_yet() {
        let mut lanes = TransmitQueues::default();
        let at = |millis| Some(Instant::from_millis(millis));
        let backlog = |frames, millis| {
            let oldest = Duration::from_millis(millis);
            TransmitBacklog { frames, oldest }
        };
        assert_eq!(lanes.backlog(false, at(0)), backlog(0, 0));
        assert!(lanes.push(FrameLane::Usual, 1, at(0), 10, LIMITS));
        assert!(lanes.push(FrameLane::Hello, 2, at(30), 10, LIMITS));

        assert_eq!(lanes.backlog(false, at(40)), backlog(2, 40));
        assert_eq!(lanes.pop().map(|(_, one)| one), Some(2));
        assert_eq!(lanes.pop().map(|(_, one)| one), Some(1));
        assert_eq!(lanes.backlog(true, at(40)), backlog(1, 40));
        assert_eq!(lanes.backlog(false, at(40)), backlog(0, 0));
    }

    #[test]
    fn a_flood_of_the_urgent_leaves_the_usual_one_place_in_nine() {
        let mut lanes = TransmitQueues::default();
        (0..18).for_each(|one| assert!(lanes.push(FrameLane::Urgent, one, None, 1, LIMITS)));
        (100..103).for_each(|one| assert!(lanes.push(FrameLane::Usual, one, None, 1, LIMITS)));

        let order = drain(&mut lanes);

        assert_eq!((order[8], order[17]), (100, 101));
        assert_eq!(order.len(), 21);
    }
}
