//! What has changed of a state, for standbys that have what it was before.

use crate::hash;
use serde::{Deserialize, Serialize};

/// From one state to the next.
///
/// Where only a part in the middle is another, that part travels: a counter in a long table,
/// something appended, something cut out. It needs nothing of the component but that it saves the
/// same as the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Change {
    /// It is as it was; the sum is that of the state.
    Same { sum: u64 },
    /// So many bytes at the front and at the back stay, with this in between.
    Middle { front: u32, back: u32, between: Vec<u8>, sum: u64 },
    /// All of it is new.
    Whole(Vec<u8>),
}

impl Change {
    pub(super) fn between(before: Option<&[u8]>, after: &[u8]) -> Self {
        let Some(before) = before else { return Change::Whole(after.to_vec()) };
        if before == after {
            return Change::Same { sum: sum(after) };
        }
        let same = |(a, b): &(&u8, &u8)| a == b;
        let front = before.iter().zip(after).take_while(same).count();
        // What stays at the front does not stay at the back as well.
        let shorter = before.len().min(after.len()) - front;
        let ends = before.iter().rev().zip(after.iter().rev());
        let back = ends.take(shorter).take_while(same).count();
        match (u32::try_from(front), u32::try_from(back)) {
            (Ok(front32), Ok(back32)) if front + back > 0 => {
                let between = after[front..after.len() - back].to_vec();
                Change::Middle { front: front32, back: back32, between, sum: sum(after) }
            }
            _ => Change::Whole(after.to_vec()),
        }
    }

    /// The state afterwards; `None` where this is no change of that state.
    pub(super) fn apply(self, before: Option<&[u8]>) -> Option<Vec<u8>> {
        match self {
            Change::Whole(after) => Some(after),
            Change::Same { sum: expected } => {
                before.filter(|before| sum(before) == expected).map(<[u8]>::to_vec)
            }
            Change::Middle { front, back, between, sum: expected } => {
                let (front, back) = (usize::try_from(front).ok()?, usize::try_from(back).ok()?);
                let before = before?;
                let kept = before.len().checked_sub(back).filter(|end| front <= *end)?;
                let after = [&before[..front], &between, &before[kept..]].concat();
                (sum(&after) == expected).then_some(after)
            }
        }
    }
}

/// Against a standby whose state, or terms, are not what they are taken for.
pub(super) fn sum(state: &[u8]) -> u64 {
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
