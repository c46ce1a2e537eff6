//! What is known of the components of a node, by their slots.

use super::SlotId;

/// Slots of a chunk.
const CHUNK: usize = 64;

/// Slots are dense, and all of them are looked at ten times a second. They stand in chunks, so that
/// a table that grows is not copied.
#[derive(Debug)]
pub struct SlotTable<T>(Vec<Vec<Option<T>>>);

impl<T> Default for SlotTable<T> {
    fn default() -> Self {
        SlotTable(Vec::new())
    }
}

/// The chunk of a slot, and its place therein.
fn position(slot: SlotId) -> (usize, usize) {
    (slot as usize / CHUNK, slot as usize % CHUNK)
}

impl<T> SlotTable<T> {
    /// Puts a value into a slot, in place of the one that it has.
    pub fn insert(&mut self, slot: SlotId, value: T) {
        let (chunk, at) = position(slot);
        if self.0.len() <= chunk {
            self.0.resize_with(chunk + 1, Vec::new);
        }
        let chunk = &mut self.0[chunk];
        if chunk.is_empty() {
            chunk.reserve_exact(CHUNK);
            chunk.resize_with(CHUNK, || None);
        }
        chunk[at] = Some(value);
    }

    /// Empties a slot.
    pub fn remove(&mut self, slot: SlotId) -> Option<T> {
        let (chunk, at) = position(slot);
        self.0.get_mut(chunk)?.get_mut(at)?.take()
    }

    /// The value of a slot.
    #[must_use]
    pub fn get(&self, slot: SlotId) -> Option<&T> {
        let (chunk, at) = position(slot);
        self.0.get(chunk)?.get(at)?.as_ref()
    }

    /// The value of a slot, which may be changed.
    pub fn get_mut(&mut self, slot: SlotId) -> Option<&mut T> {
        let (chunk, at) = position(slot);
        self.0.get_mut(chunk)?.get_mut(at)?.as_mut()
    }

    /// All values in the order of their slots.
    pub fn iter(&self) -> impl Iterator<Item = (SlotId, &T)> {
        let numbered = (0..).step_by(CHUNK).zip(&self.0);
        let slots = numbered.flat_map(|(first, chunk)| (first..).zip(chunk));
        slots.filter_map(|(slot, value)| Some((slot, value.as_ref()?)))
    }

    /// All values in the order of their slots, which may be changed.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (SlotId, &mut T)> {
        let numbered = (0..).step_by(CHUNK).zip(&mut self.0);
        let slots = numbered.flat_map(|(first, chunk)| (first..).zip(chunk));
        slots.filter_map(|(slot, value)| Some((slot, value.as_mut()?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slot_has_one_value_and_those_beside_it_none() {
        let mut table = SlotTable::default();
        table.insert(7, 'a');
        assert_eq!((table.get(7), table.get(6), table.get(8)), (Some(&'a'), None, None));

        table.insert(7, 'b');
        table.insert(2, 'c');
        assert_eq!(table.iter().collect::<Vec<_>>(), [(2, &'c'), (7, &'b')]);

        assert_eq!((table.remove(7), table.remove(7), table.remove(9)), (Some('b'), None, None));
    }

    #[test]
    fn a_slot_far_behind_the_others_takes_no_memory_for_those_between() {
        let mut table = SlotTable::default();
        table.insert(3, 'a');
        table.insert(6_400, 'b');
        assert_eq!(table.iter_mut().map(|(slot, _)| slot).collect::<Vec<_>>(), [3, 6_400]);
        assert_eq!(table.0.iter().filter(|chunk| chunk.capacity() > 0).count(), 2);
    }
}
