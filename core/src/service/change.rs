//! The change from one state to the next, for standbys that have the earlier one.

use crate::hash;
use serde::{Deserialize, Serialize};

/// The change from one state to the next: the bytes at the front and at the back stay, with others
/// between them.
///
/// If only a part in the middle differs, that part is sent: a counter in a long table, an appended
/// item, a removed one. The component only has to save equal states as equal bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Change {
    front: usize,
    back: usize,
    between: Vec<u8>,
    /// That of the later state.
    checksum: u64,
}

impl Change {
    pub(super) fn between(before: &[u8], after: &[u8]) -> Self {
        let same = |(a, b): &(&u8, &u8)| a == b;
        let front = before.iter().zip(after).take_while(same).count();
        // A byte that stays at the front is not counted at the back again.
        let shorter = before.len().min(after.len()) - front;
        let ends = before.iter().rev().zip(after.iter().rev());
        let back = ends.take(shorter).take_while(same).count();
        let between = after[front..after.len() - back].to_vec();
        Change { front, back, between, checksum: checksum(after) }
    }

    /// Returns the later state, or `None` if this is not a change of the earlier one.
    pub(super) fn apply(&self, before: &[u8]) -> Option<Vec<u8>> {
        let kept = before.len().checked_sub(self.back).filter(|end| self.front <= *end)?;
        let after = [&before[..self.front], &self.between, &before[kept..]].concat();
        (checksum(&after) == self.checksum).then_some(after)
    }
}

/// Returns a checksum, by which a replica detects a state or configuration that it did not expect.
pub(super) fn checksum(state: &[u8]) -> u64 {
    hash::of(state.iter().copied())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    #[test]
    fn a_change_leads_from_any_state_to_any_other() {
        let mut random = Random::new(5);
        let mut state = |length: usize| -> Vec<u8> {
            (0..length).map(|_| (random.unit() * 3.0) as u8).collect()
        };
        for length in 0..12 {
            for other in 0..12 {
                for _ in 0..20 {
                    let (before, after) = (state(length), state(other));
                    let change = Change::between(&before, &after);
                    assert_eq!(change.apply(&before), Some(after));
                }
            }
        }
    }

    #[test]
    fn only_what_is_new_travels() {
        let before = vec![7; 100_000];
        let mut after = before.clone();
        after[50_000] = 8;
        after.insert(50_001, 9);

        let change = Change::between(&before, &after);

        assert_eq!(change.between.len(), 2);
        assert_eq!(Change::between(&before, &before).between, [0; 0]);
    }

    #[test]
    fn a_change_of_another_state_is_refused() {
        let after = [vec![0; 5], vec![1], vec![0; 5]].concat();
        let change = Change::between(&[0; 10], &after);
        assert_eq!(change.apply(&[0; 9]), None);
        assert_eq!(change.apply(&[2; 10]), None);
        assert_eq!(change.apply(&[0; 10]), Some(after.clone()));
        assert_eq!(Change::between(&after, &after).apply(&[1; 11]), None);
    }
}
