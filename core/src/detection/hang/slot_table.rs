//! What is known of the components of a node, by their slots.

use super::SlotId;

/// Slots are dense, and all of them are looked at ten times a second.
#[derive(Debug)]
pub struct SlotTable<T>(Vec<Option<T>>);

impl<T> Default for SlotTable<T> {
    fn default() -> Self {
        SlotTable(Vec::new())
    }
}

impl<T> SlotTable<T> {
    /// Puts a value into a slot, in place of the one that it has.
    pub fn insert(&mut self, slot: SlotId, value: T) {
        let at = slot as usize;
        if self.0.len() <= at {
            self.0.resize_with(at + 1, || None);
        }
        self.0[at] = Some(value);
    }

    /// Empties a slot.
    pub fn remove(&mut self, slot: SlotId) -> Option<T> {
        self.0.get_mut(slot as usize)?.take()
    }

    /// The value of a slot.
    #[must_use]
    pub fn get(&self, slot: SlotId) -> Option<&T> {
        self.0.get(slot as usize)?.as_ref()
    }

    /// The value of a slot, which may be changed.
    pub fn get_mut(&mut self, slot: SlotId) -> Option<&mut T> {
        self.0.get_mut(slot as usize)?.as_mut()
    }

    /// All values in the order of their slots.
    pub fn iter(&self) -> impl Iterator<Item = (SlotId, &T)> {
        (0..).zip(&self.0).filter_map(|(slot, value)| Some((slot, value.as_ref()?)))
    }

    /// All values in the order of their slots, which may be changed.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (SlotId, &mut T)> {
        (0..).zip(&mut self.0).filter_map(|(slot, value)| Some((slot, value.as_mut()?)))
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
}
