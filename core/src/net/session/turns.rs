//! Which of the classes that share a path goes next: weighted round robin, in its smooth form, in
//! which the turns of one class are spread among those of the others.

use crate::TrafficClass;

/// The turns of the classes that share a path by their [weights](TrafficClass::WEIGHTED).
#[derive(Debug, Default)]
pub(super) struct WeightedTurns {
    /// What each is owed, in the order of the weights; together they are zero.
    owed: [i32; TrafficClass::WEIGHTED.len()],
    /// Parts of control since the last one that shares what it leaves.
    pub(super) control_run: usize,
}

impl WeightedTurns {
    /// The one whose turn it is, of those that wait.
    pub(super) fn next(&self, waits: impl Fn(TrafficClass) -> bool) -> Option<TrafficClass> {
        let all = TrafficClass::WEIGHTED.into_iter().zip(self.owed);
        let waiting = all.filter(|((class, _), _)| waits(*class));
        // Of those that are owed as much, the first.
        let next = waiting.rev().max_by_key(|((_, weight), owed)| owed + weight);
        next.map(|((class, _), _)| class)
    }

    /// It had its turn, while these waited, itself among them.
    pub(super) fn took(&mut self, turn: TrafficClass, waited: impl Fn(TrafficClass) -> bool) {
        let mut all = 0;
        for ((class, weight), owed) in TrafficClass::WEIGHTED.into_iter().zip(&mut self.owed) {
            if class == turn || waited(class) {
                *owed += weight;
                all += weight;
            }
        }
        for ((class, _), owed) in TrafficClass::WEIGHTED.into_iter().zip(&mut self.owed) {
            *owed -= if class == turn { all } else { 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use TrafficClass::{Bulk, Event, Replication, Request};

    fn turns(
        turns: &mut WeightedTurns,
        waiting: &[TrafficClass],
        count: usize,
    ) -> Vec<TrafficClass> {
        let one = |_| {
            let next = turns.next(|class| waiting.contains(&class)).unwrap();
            turns.took(next, |class| waiting.contains(&class));
            next
        };
        (0..count).map(one).collect()
    }

    #[test]
    fn each_gets_its_share_spread_among_the_others_and_none_waits_for_ever() {
        let mut all = WeightedTurns::default();
        let round = [Request, Event, Request, Bulk, Request, Event, Request];
        assert_eq!(turns(&mut all, &[Request, Event, Bulk], 14), [round, round].concat());
        assert_eq!(turns(&mut all, &[Bulk], 3), [Bulk; 3], "who is alone has all");
        let two = turns(&mut all, &[Event, Bulk], 300);
        assert_eq!(two.iter().filter(|class| **class == Bulk).count(), 100);
        let two = turns(&mut all, &[Replication, Request], 300);
        assert_eq!(two.iter().filter(|class| **class == Request).count(), 100);
        assert_eq!(WeightedTurns::default().next(|_| false), None);
    }

    #[test]
    fn who_comes_and_goes_saves_up_no_turns() {
        let mut all = WeightedTurns::default();
        for _ in 0..1000 {
            turns(&mut all, &[Bulk], 3);
            turns(&mut all, &[Request, Bulk], 1);
        }
        let next = turns(&mut all, &[Request, Event, Bulk], 14);
        let count = |class| next.iter().filter(|other| **other == class).count();
        assert!(count(Bulk) >= 1 && count(Event) >= 3 && count(Request) >= 7, "{next:?}");
    }
}
