//! What waits for a medium, the urgent before the usual.

use crate::frame_medium::QueueLimits;
use blastema_contract::transport::Lane;
use std::collections::VecDeque;

/// So many urgent frames go first in a row while a usual one waits: a flood of them does not keep it for
/// ever.
const IN_A_ROW: usize = 8;

/// Two queues before one medium, each bounded by itself, so that the usual fills no place of the urgent.
#[derive(Debug)]
pub(crate) struct Lanes<T> {
    urgent: Queue<T>,
    usual: Queue<T>,
    in_a_row: usize,
}

#[derive(Debug)]
struct Queue<T> {
    waiting: VecDeque<(T, usize)>,
    bytes: usize,
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        Queue { waiting: VecDeque::new(), bytes: 0 }
    }
}

impl<T> Default for Lanes<T> {
    fn default() -> Self {
        Lanes { urgent: Queue::default(), usual: Queue::default(), in_a_row: 0 }
    }
}

impl<T> Lanes<T> {
    /// Takes one of so many bytes; says whether there was room in its lane.
    #[must_use = "what is not taken is to be counted"]
    pub(crate) fn push(&mut self, lane: Lane, one: T, bytes: usize, limits: QueueLimits) -> bool {
        let queue = match lane {
            Lane::Urgent => &mut self.urgent,
            Lane::Usual => &mut self.usual,
        };
        if queue.waiting.len() >= limits.frames || queue.bytes + bytes > limits.bytes {
            return false;
        }
        queue.bytes += bytes;
        queue.waiting.push_back((one, bytes));
        true
    }

    /// Takes out the one that is to go next.
    pub(crate) fn pop(&mut self) -> Option<(Lane, T)> {
        let has_turn = self.in_a_row >= IN_A_ROW && !self.usual.waiting.is_empty();
        if !has_turn && let Some(one) = self.urgent.pop() {
            self.in_a_row += 1;
            return Some((Lane::Urgent, one));
        }
        self.in_a_row = 0;
        Some((Lane::Usual, self.usual.pop()?))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.urgent.waiting.is_empty() && self.usual.waiting.is_empty()
    }

    /// Throws all away; the answer is how many that were.
    pub(crate) fn clear(&mut self) -> u64 {
        let waiting = self.urgent.waiting.len() + self.usual.waiting.len();
        *self = Lanes::default();
        waiting as u64
    }
}

impl<T> Queue<T> {
    fn pop(&mut self) -> Option<T> {
        let (one, bytes) = self.waiting.pop_front()?;
        self.bytes -= bytes;
        Some(one)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: QueueLimits = QueueLimits { frames: 20, bytes: 1_000 };

    fn drain(lanes: &mut Lanes<u32>) -> Vec<u32> {
        std::iter::from_fn(|| lanes.pop().map(|(_, one)| one)).collect()
    }

    #[test]
    fn the_urgent_goes_before_the_usual_and_each_in_its_order() {
        let mut lanes = Lanes::default();
        for (lane, one) in
            [(Lane::Usual, 1), (Lane::Urgent, 2), (Lane::Usual, 3), (Lane::Urgent, 4)]
        {
            assert!(lanes.push(lane, one, 10, LIMITS));
        }

        assert_eq!(drain(&mut lanes), [2, 4, 1, 3]);
        assert!(lanes.is_empty());
    }

    #[test]
    fn each_lane_is_bounded_by_itself_in_frames_and_in_bytes() {
        let mut lanes = Lanes::default();

        let usual = (0..30).filter(|one| lanes.push(Lane::Usual, *one, 0, LIMITS)).count();
        let urgent = (0..30).filter(|one| lanes.push(Lane::Urgent, *one, 400, LIMITS)).count();

        assert_eq!((usual, urgent), (20, 2));
        assert_eq!(lanes.clear(), 22);
        assert!(lanes.is_empty() && lanes.push(Lane::Urgent, 1, 1_000, LIMITS));
    }

    #[test]
    fn a_flood_of_the_urgent_leaves_the_usual_one_place_in_nine() {
        let mut lanes = Lanes::default();
        (0..18).for_each(|one| assert!(lanes.push(Lane::Urgent, one, 1, LIMITS)));
        (100..103).for_each(|one| assert!(lanes.push(Lane::Usual, one, 1, LIMITS)));

        let order = drain(&mut lanes);

        assert_eq!((order[8], order[17]), (100, 101));
        assert_eq!(order.len(), 21);
    }
}
