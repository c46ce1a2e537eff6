//! Random faults, the same for the same seed.

use super::injection::FaultInjection;
use super::protocol::ObjectFault;
use super::robot::{CABLES, Module, skin};
use blastema::core::random::Random;
use std::collections::VecDeque;
use std::time::Duration;

/// How long a hung object blocks its thread: longer than any grace, short enough that the thread
/// returns before abandoned threads add up.
pub(crate) const HANG_MILLIS: u64 = 2_500;

/// Four times what the queues of the robot hold.
pub(crate) const FLOOD_MESSAGES: u32 = 2_000;

/// The last places that are not struck again, so that random faults do not add up to a restart
/// storm.
const SPARED: usize = 6;

/// A random generator that repeats for the same seed.
#[derive(Clone, Debug)]
pub(crate) struct SeededRandom(Random);

impl SeededRandom {
    /// The same for the same seed.
    pub(crate) const fn new(seed: u64) -> SeededRandom {
        SeededRandom(Random::new(seed))
    }

    /// One of `0..bound`; 0 if the bound is.
    fn below(&mut self, bound: u64) -> u64 {
        self.0.next().checked_rem(bound).unwrap_or_default()
    }

    /// A pause of up to `longest`.
    pub(crate) fn pause(&mut self, longest: Duration) -> Duration {
        longest.mul_f64(self.0.unit())
    }

    fn one_of<T: Clone>(&mut self, choice: &[T]) -> T {
        let at = usize::try_from(self.below(choice.len() as u64)).unwrap_or_default();
        choice[at].clone()
    }
}

/// Endless random faults.
#[derive(Clone, Debug)]
pub(crate) struct RandomFaults {
    random: SeededRandom,
    spared: VecDeque<String>,
}

impl RandomFaults {
    /// The same faults for the same seed.
    pub(crate) fn new(seed: u64) -> RandomFaults {
        RandomFaults { random: SeededRandom::new(seed), spared: VecDeque::new() }
    }

    /// The next fault.
    pub(crate) fn next(&mut self) -> FaultInjection {
        let injection = loop {
            let candidate = self.any();
            if !self.spared.contains(&candidate.location()) {
                break candidate;
            }
        };
        if self.spared.len() == SPARED {
            self.spared.pop_front();
        }
        self.spared.push_back(injection.location());
        injection
    }

    fn any(&mut self) -> FaultInjection {
        match self.random.below(12) {
            0 => FaultInjection::Cut { cable: self.random.one_of(&CABLES), returns: true },
            1 => FaultInjection::Blackout { far: self.far() },
            2 => FaultInjection::Router { module: self.random.one_of(&Module::ALL) },
            3 => FaultInjection::Kill { module: self.far() },
            _ => self.object(),
        }
    }

    /// Not module1: all paths lead through it.
    fn far(&mut self) -> Module {
        self.random.one_of(&[Module::Module2, Module::Module3])
    }

    fn object(&mut self) -> FaultInjection {
        let fault = self.random.one_of(&[
            ObjectFault::Panic,
            ObjectFault::Hang { millis: HANG_MILLIS },
            ObjectFault::ErrorState,
            ObjectFault::FailInitialization,
            ObjectFault::Silence,
            ObjectFault::Flood { messages: FLOOD_MESSAGES },
        ]);
        let module = match fault {
            ObjectFault::Flood { .. } => self.random.one_of(&[Module::Module1, Module::Module2]),
            _ => self.random.one_of(&Module::ALL),
        };
        let cells = module.skin();
        let cell = cells.start + u32::try_from(self.random.below(cells.len() as u64)).unwrap_or(0);
        let object = match fault {
            // Only of passive objects is the waiting time of messages known.
            ObjectFault::Flood { .. } => self.random.one_of(module.passive()).to_owned(),
            // A passive object is pinged, and so never silent.
            ObjectFault::Silence => skin(cell),
            _ if self.random.below(2) == 0 => skin(cell),
            _ => self.random.one_of(module.components()).to_owned(),
        };
        FaultInjection::Object { module, object, fault }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn locations(seed: u64) -> Vec<String> {
        let mut chaos = RandomFaults::new(seed);
        (0..300).map(|_| chaos.next().to_string()).collect()
    }

    #[test]
    fn one_seed_gives_one_run_and_another_seed_another() {
        assert_eq!(locations(1), locations(1));
        assert_ne!(locations(1), locations(2));
    }

    #[test]
    fn every_kind_of_fault_comes() {
        let all = locations(1).join("\n");

        for kind in [
            "panic in module",
            "hang",
            "error state",
            "failed init",
            "silent",
            "flood",
            "cable cut",
            "both cables",
            "router",
            "kill -9",
        ] {
            assert!(all.contains(kind), "{kind} never came");
        }
    }

    #[test]
    fn no_place_is_struck_again_at_once() {
        let mut chaos = RandomFaults::new(7);
        let locations: Vec<_> = (0..300).map(|_| chaos.next().location()).collect();

        for window in locations.windows(SPARED + 1) {
            assert!(!window[..SPARED].contains(&window[SPARED]), "{window:?}");
        }
    }

    #[test]
    fn module1_is_never_killed() {
        assert!(!locations(3).iter().any(|text| text == "kill -9, rejoin in module1"));
    }
}
