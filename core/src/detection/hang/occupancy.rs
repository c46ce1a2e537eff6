//! The share of time that each component occupies a thread, from samples at even intervals.

use crate::sorted::SortedMap;
use std::collections::VecDeque;

/// The components that were found on a thread in the latest samples.
///
/// It costs a store for each look, and no clock. What happens in step with the looks is misjudged,
/// as by any sample.
///
/// ```
/// use blastema_core::detection::hang::occupancy::Occupancy;
///
/// let mut thread = Occupancy::default();
/// assert_eq!(thread.share(), None);
/// for look in 0..200 {
///     thread.note((look % 4 == 0).then_some("planner"));
/// }
/// assert_eq!(thread.share(), Some(0.25));
/// assert_eq!(thread.largest(100), Some(("planner", 0.25)));
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Occupancy<K> {
    /// The latest looks, the last one at the back.
    found: VecDeque<Option<K>>,
}

impl<K> Default for Occupancy<K> {
    fn default() -> Self {
        Occupancy { found: VecDeque::new() }
    }
}

impl<K: Copy + Ord> Occupancy<K> {
    /// Looks that count: 1.3 s of the usual ones, every 10 ms.
    pub const LOOKS: usize = 128;

    /// One more look.
    pub fn note(&mut self, found: Option<K>) {
        if self.found.len() == Self::LOOKS {
            self.found.pop_front();
        }
        self.found.push_back(found);
    }

    /// The share of the looks that found a component, from 0 to 1; `None` before the first look.
    pub fn share(&self) -> Option<f32> {
        (!self.found.is_empty()).then(|| self.busy(Self::LOOKS))
    }

    /// The same for the latest looks; 0 before the first.
    pub fn busy(&self, looks: usize) -> f32 {
        self.share_where(looks, |found| found.is_some())
    }

    /// The share of the latest looks that found this one; 0 before the first.
    pub fn share_of(&self, who: K, looks: usize) -> f32 {
        self.share_where(looks, |found| found == Some(who))
    }

    /// The component that was found most often in the latest samples, and in which share of them.
    pub fn largest(&self, looks: usize) -> Option<(K, f32)> {
        let mut counts: SortedMap<K, usize> = SortedMap::new();
        self.latest(looks).flatten().for_each(|who| *counts.entry(who).or_default() += 1);
        let (who, _) = counts.into_iter().max_by_key(|(_, count)| *count)?;
        Some((who, self.share_of(who, looks)))
    }

    fn latest(&self, looks: usize) -> impl Iterator<Item = Option<K>> + '_ {
        self.found.iter().rev().take(looks.max(1)).copied()
    }

    fn share_where(&self, looks: usize, holds: impl Fn(Option<K>) -> bool) -> f32 {
        let of = self.latest(looks).count();
        let found = self.latest(looks).filter(|found| holds(*found)).count();
        // Both are at most 128, which any float holds exactly.
        let float = |count: usize| f32::from(u8::try_from(count).unwrap_or(u8::MAX));
        if of == 0 { 0.0 } else { float(found) / float(of) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_latest_looks_count_and_fewer_at_first() {
        let mut thread = Occupancy::default();
        thread.note(Some(1));
        thread.note(None);
        assert_eq!(thread.share(), Some(0.5));

        (0..Occupancy::<u32>::LOOKS).for_each(|_| thread.note(Some(1)));
        assert_eq!(thread.share(), Some(1.0));
        (0..Occupancy::<u32>::LOOKS / 2).for_each(|_| thread.note(None));
        assert_eq!(thread.share(), Some(0.5));
        assert_eq!(thread.busy(10), 0.0);
    }

    #[test]
    fn who_was_found_most_often_is_told_with_its_share() {
        let mut thread = Occupancy::default();
        [Some(2), Some(7), None, Some(7)].into_iter().for_each(|found| thread.note(found));

        assert_eq!(thread.largest(4), Some((7, 0.5)));
        assert_eq!(thread.largest(100), Some((7, 0.5)), "there were no more looks");
        assert_eq!((thread.share_of(2, 4), thread.share_of(2, 3)), (0.25, 0.0));
    }
}
