//! A map in the order of its keys, as vectors with binary search.
//!
//! It behaves as `BTreeMap` does, with a quarter of the code that is compiled for each type of key
//! and value, and without the unused slots of a tree's nodes: with trees, the executable of the
//! README's program is 13 % larger. The entries are kept in chunks, as in Python's
//! `sortedcontainers`, so that an insertion into a large map moves the entries of one chunk and not
//! all of them.

use std::borrow::Borrow;
use std::fmt::{self, Debug};
use std::iter::{Chain, Flatten, Map};
use std::ops::{Bound, Index, RangeBounds};
use std::{mem, slice, vec};

/// Entries of a chunk at most.
const CHUNK_MAX: usize = 64;
/// Entries of two neighbouring chunks that are merged: half a chunk, so that the next insertions do
/// not split it again.
const MERGED_MAX: usize = CHUNK_MAX / 2;

/// A map in the order of its keys.
#[derive(Clone)]
pub struct SortedMap<K, V> {
    /// Sorted; none of them is empty.
    chunks: Vec<Vec<(K, V)>>,
    len: usize,
}

/// The entries of a [`SortedMap`], in order.
pub type Iter<'a, K, V> = Map<Entries<'a, K, V>, fn(&'a (K, V)) -> (&'a K, &'a V)>;
/// The keys of a [`SortedMap`], in order.
pub type Keys<'a, K, V> = Map<Entries<'a, K, V>, fn(&'a (K, V)) -> &'a K>;
/// The entries of a [`SortedMap`], in order, with values that may be changed.
pub type IterMut<'a, K, V> =
    Map<Flatten<slice::IterMut<'a, Vec<(K, V)>>>, fn(&'a mut (K, V)) -> (&'a K, &'a mut V)>;

/// The end of a chunk, whole chunks, and the beginning of one.
type Entries<'a, K, V> = Chain<
    Chain<slice::Iter<'a, (K, V)>, Flatten<slice::Iter<'a, Vec<(K, V)>>>>,
    slice::Iter<'a, (K, V)>,
>;

fn entry<K, V>((key, value): &(K, V)) -> (&K, &V) {
    (key, value)
}

fn key<K, V>((key, _): &(K, V)) -> &K {
    key
}

fn entry_mut<K, V>((key, value): &mut (K, V)) -> (&K, &mut V) {
    (key, value)
}

/// The index of an entry's chunk, and its index in this chunk.
type EntryPosition = (usize, usize);

impl<K: PartialEq, V: PartialEq> PartialEq for SortedMap<K, V> {
    fn eq(&self, other: &Self) -> bool {
        self.len == other.len && self.iter().eq(other)
    }
}

impl<K: Eq, V: Eq> Eq for SortedMap<K, V> {}

impl<K, V> Default for SortedMap<K, V> {
    fn default() -> Self {
        SortedMap::new()
    }
}

impl<K, V> SortedMap<K, V> {
    /// An empty map, which holds no memory.
    #[must_use]
    pub const fn new() -> Self {
        SortedMap { chunks: Vec::new(), len: 0 }
    }

    /// The number of entries.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no entry.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Removes all entries.
    pub fn clear(&mut self) {
        *self = SortedMap::new();
    }

    /// All entries in order.
    pub fn iter(&self) -> Iter<'_, K, V> {
        self.between((0, 0), (self.chunks.len(), 0)).map(entry as fn(_) -> _)
    }

    /// All entries in order, with values that may be changed.
    pub fn iter_mut(&mut self) -> IterMut<'_, K, V> {
        self.chunks.iter_mut().flatten().map(entry_mut as fn(_) -> _)
    }

    /// All keys in order.
    pub fn keys(&self) -> Keys<'_, K, V> {
        self.between((0, 0), (self.chunks.len(), 0)).map(key as fn(_) -> _)
    }

    /// All values in the order of their keys.
    pub fn values(&self) -> impl DoubleEndedIterator<Item = &V> + Clone {
        self.chunks.iter().flatten().map(|(_, value)| value)
    }

    /// All values in the order of their keys.
    pub fn values_mut(&mut self) -> impl DoubleEndedIterator<Item = &mut V> {
        self.chunks.iter_mut().flatten().map(|(_, value)| value)
    }

    /// All values in the order of their keys.
    pub fn into_values(self) -> impl DoubleEndedIterator<Item = V> {
        self.into_iter().map(|(_, value)| value)
    }

    /// Keeps the entries of which this is true.
    pub fn retain(&mut self, mut is_kept: impl FnMut(&K, &mut V) -> bool) {
        let SortedMap { chunks, len } = self;
        // Dropped when the map is complete again: the `Drop` of an entry may panic.
        let mut removed = Vec::new();
        chunks.retain_mut(|chunk| {
            for entry in chunk.extract_if(.., |(key, value)| !is_kept(key, value)) {
                *len -= 1;
                removed.push(entry);
            }
            !chunk.is_empty()
        });
        chunks.dedup_by(|upper, lower| {
            let fits = lower.len() + upper.len() <= MERGED_MAX;
            if fits {
                lower.append(upper);
            }
            fits
        });
    }

    /// The entry with the lowest key.
    #[must_use]
    pub fn first_key_value(&self) -> Option<(&K, &V)> {
        self.chunks.first()?.first().map(|(key, value)| (key, value))
    }

    /// Removes the entry with the lowest key.
    pub fn pop_first(&mut self) -> Option<(K, V)> {
        (self.len > 0).then(|| self.remove_at((0, 0)))
    }

    /// Removes the entry with the lowest key, if this is true of the key.
    pub fn pop_first_if(&mut self, is_popped: impl FnOnce(&K) -> bool) -> Option<(K, V)> {
        self.first_key_value()
            .is_some_and(|(key, _)| is_popped(key))
            .then(|| self.remove_at((0, 0)))
    }

    /// Removes the entry with the highest key.
    pub fn pop_last(&mut self) -> Option<(K, V)> {
        let last = self.chunks.len().checked_sub(1)?;
        Some(self.remove_at((last, self.chunks[last].len() - 1)))
    }

    /// The entries from one position up to another, which is behind them.
    fn between(&self, from: EntryPosition, to: EntryPosition) -> Entries<'_, K, V> {
        let chunk = |at: usize| self.chunks.get(at).map_or(&[][..], Vec::as_slice);
        let (front, chunks, back) = match from.0 < to.0 {
            true => (&chunk(from.0)[from.1..], from.0 + 1..to.0, &chunk(to.0)[..to.1]),
            false => {
                let end = if from.0 == to.0 { to.1.max(from.1) } else { from.1 };
                (&chunk(from.0)[from.1..end], 0..0, &[][..])
            }
        };
        front.iter().chain(self.chunks[chunks].iter().flatten()).chain(back)
    }

    fn at(&self, (chunk, at): EntryPosition) -> &(K, V) {
        &self.chunks[chunk][at]
    }

    fn insert_at(&mut self, (mut chunk, mut at): EntryPosition, key: K, value: V) -> &mut V {
        if self.chunks.is_empty() {
            self.chunks.reserve_exact(1);
            self.chunks.push(Vec::new());
        }
        let has_capacity = |chunk: &Vec<_>| chunk.len() < CHUNK_MAX;
        if at == CHUNK_MAX && self.chunks.get(chunk + 1).is_some_and(has_capacity) {
            // Descending keys behind a full chunk would each begin a chunk of their own.
            (chunk, at) = (chunk + 1, 0);
        } else if self.chunks[chunk].len() == CHUNK_MAX {
            // Ascending keys fill whole chunks.
            let split = if at == CHUNK_MAX { CHUNK_MAX } else { CHUNK_MAX / 2 };
            let upper = self.chunks[chunk].split_off(split);
            self.chunks.insert(chunk + 1, upper);
            if at >= split {
                (chunk, at) = (chunk + 1, at - split);
            }
        }
        self.len += 1;
        let chunk = &mut self.chunks[chunk];
        chunk.insert(at, (key, value));
        &mut chunk[at].1
    }

    fn remove_at(&mut self, (chunk, at): EntryPosition) -> (K, V) {
        self.len -= 1;
        let entry = self.chunks[chunk].remove(at);
        if self.chunks[chunk].is_empty() {
            self.chunks.remove(chunk);
        } else if self.is_mergeable(chunk) {
            self.merge(chunk);
        } else if chunk > 0 && self.is_mergeable(chunk - 1) {
            self.merge(chunk - 1);
        }
        entry
    }

    /// Whether this chunk and the next one are small enough for one.
    fn is_mergeable(&self, chunk: usize) -> bool {
        let next = self.chunks.get(chunk + 1);
        next.is_some_and(|next| self.chunks[chunk].len() + next.len() <= MERGED_MAX)
    }

    fn merge(&mut self, chunk: usize) {
        let mut next = self.chunks.remove(chunk + 1);
        self.chunks[chunk].append(&mut next);
    }
}

impl<K: Ord, V> SortedMap<K, V> {
    /// Where the entry is, or where it would be put.
    fn position<Q: Ord + ?Sized>(&self, key: &Q) -> Result<EntryPosition, EntryPosition>
    where
        K: Borrow<Q>,
    {
        let above = self.chunks.partition_point(|chunk| chunk[0].0.borrow() <= key);
        let chunk = above.saturating_sub(1);
        let Some(entries) = self.chunks.get(chunk) else { return Err((0, 0)) };
        match entries.binary_search_by(|(known, _)| known.borrow().cmp(key)) {
            Ok(at) => Ok((chunk, at)),
            Err(at) => Err((chunk, at)),
        }
    }

    /// Where the entries within these bounds begin, and where they end.
    fn bounds<Q: Ord + ?Sized>(&self, range: &impl RangeBounds<Q>) -> (EntryPosition, EntryPosition)
    where
        K: Borrow<Q>,
    {
        let seek = |key: &Q, is_after: bool| match self.position(key) {
            Ok((chunk, at)) => (chunk, at + usize::from(is_after)),
            Err(position) => position,
        };
        let from = match range.start_bound() {
            Bound::Included(key) => seek(key, false),
            Bound::Excluded(key) => seek(key, true),
            Bound::Unbounded => (0, 0),
        };
        let to = match range.end_bound() {
            Bound::Included(key) => seek(key, true),
            Bound::Excluded(key) => seek(key, false),
            Bound::Unbounded => (self.chunks.len(), 0),
        };
        (from, to)
    }

    /// The value of this key.
    pub fn get<Q: Ord + ?Sized>(&self, key: &Q) -> Option<&V>
    where
        K: Borrow<Q>,
    {
        self.position(key).ok().map(|position| &self.at(position).1)
    }

    /// The key as it stands in the map, and its value.
    pub fn get_key_value<Q: Ord + ?Sized>(&self, key: &Q) -> Option<(&K, &V)>
    where
        K: Borrow<Q>,
    {
        self.position(key).ok().map(|position| self.at(position)).map(|(key, value)| (key, value))
    }

    /// The value of this key.
    pub fn get_mut<Q: Ord + ?Sized>(&mut self, key: &Q) -> Option<&mut V>
    where
        K: Borrow<Q>,
    {
        let (chunk, at) = self.position(key).ok()?;
        Some(&mut self.chunks[chunk][at].1)
    }

    /// Whether there is an entry with this key.
    pub fn contains_key<Q: Ord + ?Sized>(&self, key: &Q) -> bool
    where
        K: Borrow<Q>,
    {
        self.position(key).is_ok()
    }

    /// Sets the value of this key; returns the value that it had.
    pub fn insert(&mut self, key: K, value: V) -> Option<V> {
        match self.position(&key) {
            Ok((chunk, at)) => Some(mem::replace(&mut self.chunks[chunk][at].1, value)),
            Err(position) => {
                self.insert_at(position, key, value);
                None
            }
        }
    }

    /// Removes this key; returns its value.
    pub fn remove<Q: Ord + ?Sized>(&mut self, key: &Q) -> Option<V>
    where
        K: Borrow<Q>,
    {
        self.position(key).ok().map(|position| self.remove_at(position).1)
    }

    /// The entry of this key, which may be vacant.
    pub fn entry(&mut self, key: K) -> SortedEntry<'_, K, V> {
        let position = self.position(&key);
        SortedEntry { map: self, key, position }
    }

    /// The entries within these bounds, in order.
    pub fn range<Q: Ord + ?Sized>(&self, range: impl RangeBounds<Q>) -> Iter<'_, K, V>
    where
        K: Borrow<Q>,
    {
        let (from, to) = self.bounds(&range);
        self.between(from, to).map(entry as fn(_) -> _)
    }

    /// The entries within these bounds, in order, with values that may be changed.
    pub fn range_mut<Q: Ord + ?Sized>(
        &mut self,
        range: impl RangeBounds<Q>,
    ) -> impl Iterator<Item = (&K, &mut V)>
    where
        K: Borrow<Q>,
    {
        let (from, to) = self.bounds(&range);
        let chunks = self.chunks.iter_mut().enumerate().take(to.0 + 1).skip(from.0);
        chunks.flat_map(move |(chunk, entries)| {
            let start = if chunk == from.0 { from.1 } else { 0 };
            let end = if chunk == to.0 { to.1 } else { entries.len() };
            entries.iter_mut().take(end).skip(start).map(entry_mut)
        })
    }
}

/// The entry of one key in a [`SortedMap`].
pub struct SortedEntry<'a, K, V> {
    map: &'a mut SortedMap<K, V>,
    key: K,
    position: Result<EntryPosition, EntryPosition>,
}

impl<'a, K: Ord, V> SortedEntry<'a, K, V> {
    /// The value; where there is none, this one is inserted.
    pub fn or_insert(self, value: V) -> &'a mut V {
        self.or_insert_with(|| value)
    }

    /// The value; where there is none, one is made and inserted.
    pub fn or_insert_with(self, value: impl FnOnce() -> V) -> &'a mut V {
        match self.position {
            Ok((chunk, at)) => &mut self.map.chunks[chunk][at].1,
            Err(position) => self.map.insert_at(position, self.key, value()),
        }
    }

    /// The value; where there is none, the default is inserted.
    pub fn or_default(self) -> &'a mut V
    where
        V: Default,
    {
        self.or_insert_with(V::default)
    }
}

impl<K, V> IntoIterator for SortedMap<K, V> {
    type Item = (K, V);
    type IntoIter = Flatten<vec::IntoIter<Vec<(K, V)>>>;

    fn into_iter(self) -> Self::IntoIter {
        self.chunks.into_iter().flatten()
    }
}

impl<'a, K, V> IntoIterator for &'a SortedMap<K, V> {
    type Item = (&'a K, &'a V);
    type IntoIter = Iter<'a, K, V>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, K, V> IntoIterator for &'a mut SortedMap<K, V> {
    type Item = (&'a K, &'a mut V);
    type IntoIter = IterMut<'a, K, V>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

impl<K: Ord, V> Extend<(K, V)> for SortedMap<K, V> {
    fn extend<I: IntoIterator<Item = (K, V)>>(&mut self, entries: I) {
        for (key, value) in entries {
            self.insert(key, value);
        }
    }
}

impl<K: Ord, V> FromIterator<(K, V)> for SortedMap<K, V> {
    fn from_iter<I: IntoIterator<Item = (K, V)>>(entries: I) -> Self {
        let mut map = SortedMap::new();
        map.extend(entries);
        map
    }
}

impl<K: Ord, V, const N: usize> From<[(K, V); N]> for SortedMap<K, V> {
    fn from(entries: [(K, V); N]) -> Self {
        entries.into_iter().collect()
    }
}

impl<K: Ord + Borrow<Q>, Q: Ord + ?Sized, V> Index<&Q> for SortedMap<K, V> {
    type Output = V;

    fn index(&self, key: &Q) -> &V {
        self.get(key).expect("no entry of this key")
    }
}

impl<K: Debug, V: Debug> Debug for SortedMap<K, V> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_map().entries(self).finish()
    }
}

#[cfg(test)]
mod tests;
