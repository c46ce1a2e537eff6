//! The change from one state to the next, for standbys that have the earlier one.

use crate::hash;
use serde::{Deserialize, Serialize};

/// The change from one state to the next.
///
/// If only a part in the middle differs, that part is sent: a counter in a long table, an appended
/// item, a removed one. The component only has to save equal states as equal bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Change {
    /// The states are equal; the checksum is that of the state.
    Same { checksum: u64 },
    /// The bytes at the front and at the back stay, with other bytes between them. The checksum is
    /// that of the later state.
    Middle { front: u32, back: u32, between: Vec<u8>, checksum: u64 },
    /// The whole state.
    Whole(Vec<u8>),
}

impl Change {
    pub(super) fn between(before: Option<&[u8]>, after: &[u8]) -> Self {
        let Some(before) = before else { return Change::Whole(after.to_vec()) };
        if before == after {
            return Change::Same { checksum: checksum(after) };
        }
        let same = |(a, b): &(&u8, &u8)| a == b;
        let front = before.iter().zip(after).take_while(same).count();
        // A byte that stays at the front is not counted at the back again.
        let shorter = before.len().min(after.len()) - front;
        let ends = before.iter().rev().zip(after.iter().rev());
        let back = ends.take(shorter).take_while(same).count();
        match (u32::try_from(front), u32::try_from(back)) {
            (Ok(front32), Ok(back32)) if front + back > 0 => {
                let between = after[front..after.len() - back].to_vec();
                Change::Middle { front: front32, back: back32, between, checksum: checksum(after) }
            }
            _ => Change::Whole(after.to_vec()),
        }
    }

    /// Returns the later state, or `None` if this is not a change of the earlier one.
    pub(super) fn apply(self, before: Option<&[u8]>) -> Option<Vec<u8>> {
        match self {
            Change::Whole(after) => Some(after),
            Change::Same { checksum: expected } => {
                before.filter(|before| checksum(before) == expected).map(<[u8]>::to_vec)
            }
            Change::Middle { front, back, between, checksum: expected } => {
                let (front, back) = (usize::try_from(front).ok()?, usize::try_from(back).ok()?);
                let before = before?;
                let kept = before.len().checked_sub(back).filter(|end| front <= *end)?;
                let after = [&before[..front], &between, &before[kept..]].concat();
                (checksum(&after) == expected).then_some(after)
            }
        }
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
                    let change = Change::between(Some(&before), &after);
                    assert_eq!(change.apply(Some(&before)), Some(after));
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

        let change = Change::between(Some(&before), &after);

        assert!(matches!(&change, Change::Middle { between, .. } if between.len() == 2));
        let same = Change::between(Some(&before), &before);
        assert!(matches!(same, Change::Same { .. }));
        assert_eq!(Change::between(None, &before), Change::Whole(before));
    }

    #[test]
    fn a_change_of_another_state_is_refused() {
        let after = [vec![0; 5], vec![1], vec![0; 5]].concat();
        let change = Change::between(Some(&[0; 10]), &after);
        assert_eq!(change.clone().apply(Some(&[0; 9])), None);
        assert_eq!(change.clone().apply(Some(&[2; 10])), None);
        assert_eq!(change.clone().apply(None), None);
        assert_eq!(change.apply(Some(&[0; 10])), Some(after.clone()));
        let same = Change::between(Some(&after), &after);
        assert_eq!(same.clone().apply(None), None);
        assert_eq!(same.apply(Some(&[1; 11])), None);
    }
}
