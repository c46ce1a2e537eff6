//! Many machines of one kind, driven as one.

use crate::sorted::SortedMap;
use crate::{Instant, Machine};
use std::collections::BTreeSet;

/// Machines by key: the links over one transport, the sessions of one node.
///
/// The machine that got an input is asked for its outputs, and no other; the earliest deadline is
/// known without looking at all.
#[derive(Debug)]
pub struct MachineSet<K, M> {
    members: SortedMap<K, M>,
    /// Those that may have outputs.
    talking: BTreeSet<K>,
    due: BTreeSet<(Instant, K)>,
    due_of: SortedMap<K, Instant>,
}

impl<K, M> Default for MachineSet<K, M> {
    fn default() -> Self {
        MachineSet {
            members: SortedMap::new(),
            talking: BTreeSet::new(),
            due: BTreeSet::new(),
            due_of: SortedMap::new(),
        }
    }
}

impl<K: Ord + Copy, M: Machine> MachineSet<K, M> {
    /// Adds a member, or replaces it. Both may have something to say at once.
    pub fn insert(&mut self, key: K, machine: M) {
        self.members.insert(key, machine);
        self.talking.insert(key);
    }

    /// Takes a member out.
    pub fn remove(&mut self, key: K) -> Option<M> {
        self.talking.remove(&key);
        self.settle(key, None);
        self.members.remove(&key)
    }

    /// Looks at a member.
    pub fn get(&self, key: K) -> Option<&M> {
        self.members.get(&key)
    }

    /// Speaks to a member; its outputs are polled next.
    pub fn get_mut(&mut self, key: K) -> Option<&mut M> {
        let member = self.members.get_mut(&key)?;
        self.talking.insert(key);
        Some(member)
    }

    /// All members, in the order of their keys.
    pub fn iter(&self) -> impl Iterator<Item = (K, &M)> {
        self.members.iter().map(|(key, member)| (*key, member))
    }

    /// The same, for what changes no member's outputs and no deadline.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (K, &mut M)> {
        self.members.iter_mut().map(|(key, member)| (*key, member))
    }

    fn settle(&mut self, key: K, due: Option<Instant>) {
        let before = match due {
            Some(due) => self.due_of.insert(key, due),
            None => self.due_of.remove(&key),
        };
        if before != due {
            if let Some(before) = before {
                self.due.remove(&(before, key));
            }
            self.due.extend(due.map(|due| (due, key)));
        }
    }
}

impl<K: Ord + Copy, M: Machine> Machine for MachineSet<K, M> {
    type Output = (K, M::Output);

    fn poll_output(&mut self) -> Option<(K, M::Output)> {
        while let Some(&key) = self.talking.first() {
            let member = self.members.get_mut(&key);
            if let Some(output) = member.and_then(Machine::poll_output) {
                return Some((key, output));
            }
            self.talking.remove(&key);
            let due = self.members.get(&key).and_then(Machine::poll_timeout);
            self.settle(key, due);
        }
        None
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.due.first().map(|(due, _)| *due)
    }

    fn handle_timeout(&mut self, now: Instant) {
        let due: Vec<_> = self.due.range(..).take_while(|(at, _)| *at <= now).copied().collect();
        for (_, key) in due {
            if let Some(member) = self.get_mut(key) {
                member.handle_timeout(now);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Says its number whenever it is woken, every so many milliseconds.
    struct Clock {
        every: u64,
        next: Instant,
        says: Option<u64>,
    }

    impl Machine for Clock {
        type Output = u64;

        fn poll_output(&mut self) -> Option<u64> {
            self.says.take()
        }

        fn poll_timeout(&self) -> Option<Instant> {
            Some(self.next)
        }

        fn handle_timeout(&mut self, now: Instant) {
            self.says = Some(self.every);
            self.next = now + std::time::Duration::from_millis(self.every);
        }
    }

    #[test]
    fn each_member_is_woken_at_its_own_time_and_heard() {
        let mut machines = MachineSet::default();
        for every in [2, 3] {
            machines.insert(every, Clock { every, next: Instant::ORIGIN, says: None });
        }
        let mut outputs = vec![];
        while machines.poll_output().is_some() {}
        for now in 0..=6 {
            machines.handle_timeout(Instant::from_millis(now));
            while let Some((key, says)) = machines.poll_output() {
                assert_eq!(key, says);
                outputs.push((now, says));
            }
        }
        assert_eq!(outputs, [(0, 2), (0, 3), (2, 2), (3, 3), (4, 2), (6, 2), (6, 3)]);
        assert!(machines.remove(2).is_some() && machines.get(2).is_none());
        assert_eq!(machines.poll_timeout(), Some(Instant::from_millis(9)));
    }
}
