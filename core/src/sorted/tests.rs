use super::{CHUNK_MAX, SortedMap};
use crate::random::Random;
use std::collections::BTreeMap;
use std::ops::Bound;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Changes by chance of a map of up to `keys` entries, each compared with what a `BTreeMap` does.
fn compare(seed: u64, keys: u64) {
    let mut random = Random::new(seed);
    let mut below = |limit: u64| (random.unit() * limit as f64) as u64;
    let (mut map, mut model) = (SortedMap::new(), BTreeMap::new());
    for step in 0..2000u64 {
        let key = below(keys);
        match below(8) {
            0..4 => assert_eq!(map.insert(key, step), model.insert(key, step)),
            4 => assert_eq!(map.entry(key).or_insert(step), model.entry(key).or_insert(step)),
            5 => assert_eq!(map.remove(&key), model.remove(&key)),
            6 if step % 2 == 0 => assert_eq!(map.pop_first(), model.pop_first()),
            6 => assert_eq!(map.pop_last(), model.pop_last()),
            _ if step % 500 == 7 => {
                map.retain(|key, value| (key + *value) % 3 > 0);
                model.retain(|key, value| (key + *value) % 3 > 0);
            }
            _ => assert_eq!(map.get_key_value(&key), model.get_key_value(&key)),
        }
        if step % 10 == 0 {
            agree(&mut map, &mut model, below(keys), below(keys));
        }
    }
}

/// Both hold the same, forwards and backwards, whole and between two keys.
fn agree(map: &mut SortedMap<u64, u64>, model: &mut BTreeMap<u64, u64>, one: u64, other: u64) {
    assert!(map.chunks.iter().all(|chunk| (1..=CHUNK_MAX).contains(&chunk.len())));
    assert_eq!((map.len(), map.is_empty()), (model.len(), model.is_empty()));
    assert!(map.iter().eq(model.iter()) && map.iter().rev().eq(model.iter().rev()));
    assert!(map.iter_mut().rev().eq(model.iter_mut().rev()));
    assert!(map.values().eq(model.values()) && map.keys().rev().eq(model.keys().rev()));
    assert!(map.clone().into_iter().eq(model.clone()));
    assert!(map.first_key_value() == model.first_key_value());
    let (low, high) = (one.min(other), one.max(other));
    assert!(map.range(low..high).eq(model.range(low..high)));
    assert!(map.range(low..=high).rev().eq(model.range(low..=high).rev()));
    assert!(map.range(..high).eq(model.range(..high)));
    let after = (Bound::Excluded(low), Bound::Unbounded);
    assert!(map.range(after).eq(model.range(after)));
    assert!(map.range_mut(low..=high).eq(model.range_mut(low..=high)));
    assert_eq!(map.range(high + 1..low).next(), None, "nothing is between");
    let mut again: SortedMap<u64, u64> = model.iter().rev().map(|(k, v)| (*k, *v)).collect();
    assert_eq!(*map, again, "whatever way it was made");
    again.insert(u64::MAX, 0);
    assert_ne!(*map, again);
}

#[test]
fn a_map_does_what_a_tree_does() {
    for (seed, keys) in [(1, 4), (2, 100), (3, 1000), (4, 5000)] {
        compare(seed, keys);
    }
}

#[test]
fn ascending_keys_fill_whole_chunks() {
    let map: SortedMap<usize, ()> = (0..10 * CHUNK_MAX).map(|n| (n, ())).collect();
    assert!(map.chunks.iter().all(|chunk| chunk.len() == CHUNK_MAX));
}

#[test]
fn descending_keys_behind_a_full_chunk_share_chunks() {
    let mut map: SortedMap<usize, ()> = (0..CHUNK_MAX).map(|n| (n, ())).collect();

    (CHUNK_MAX..50 * CHUNK_MAX).rev().for_each(|n| assert!(map.insert(n, ()).is_none()));

    assert!(map.keys().copied().eq(0..50 * CHUNK_MAX));
    assert!(map.chunks.len() <= 100, "{} chunks", map.chunks.len());
}

/// Leaves the first entry of each of a hundred chunks, and expects them in few chunks.
fn thin_out(thin: impl FnOnce(&mut SortedMap<usize, ()>)) {
    let mut map: SortedMap<usize, ()> = (0..100 * CHUNK_MAX).map(|n| (n, ())).collect();
    thin(&mut map);
    assert!(map.keys().copied().eq((0..100).map(|n| n * CHUNK_MAX)));
    assert!(map.chunks.len() < 10, "{} chunks", map.chunks.len());
}

#[test]
fn the_rest_of_a_large_map_is_merged_into_few_chunks() {
    let is_left = |n: &usize| n.is_multiple_of(CHUNK_MAX);
    let removed = move || (0..100 * CHUNK_MAX).filter(move |n| !is_left(n));
    thin_out(|map| removed().for_each(|n| assert!(map.remove(&n).is_some())));
    thin_out(|map| removed().rev().for_each(|n| assert!(map.remove(&n).is_some())));
    thin_out(|map| map.retain(|n, ()| is_left(n)));
}

#[test]
fn a_map_is_whole_after_a_predicate_or_a_drop_of_retain_has_panicked() {
    struct PanicsIf(bool);
    impl Drop for PanicsIf {
        fn drop(&mut self) {
            assert!(!self.0, "a drop that panics");
        }
    }
    let check = |panics: fn(&usize), drop_panics_at: usize| {
        let value = |n| (n, PanicsIf(n == drop_panics_at));
        let mut map: SortedMap<usize, PanicsIf> = (0..3 * CHUNK_MAX).map(value).collect();
        let retained = catch_unwind(AssertUnwindSafe(|| {
            map.retain(|n, _| {
                panics(n);
                *n >= CHUNK_MAX && n % 2 == 0
            });
        }));
        assert!(retained.is_err());
        assert!(map.chunks.iter().all(|chunk| !chunk.is_empty()));
        assert_eq!(map.len(), map.iter().count());
        (0..3 * CHUNK_MAX).for_each(|n| drop(map.remove(&n)));
        assert!(map.is_empty());
    };
    check(|n| assert_ne!(*n, CHUNK_MAX + 3), usize::MAX);
    check(|_| {}, CHUNK_MAX - 1);
}
