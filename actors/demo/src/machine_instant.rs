//! A point in time that may travel between the processes of one machine.

use blastema::core::Instant;
use serde::{Deserialize, Serialize};
use std::ops::{Add, Sub};
use std::time::Duration;

/// Nanoseconds of the machine's monotonic clock: it compares between the robot's processes, which
/// all run on one machine, and the clock of a fault starts at the instant that its injector
/// stamped.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub(crate) struct MachineInstant(u64);

impl MachineInstant {
    /// This instant.
    pub(crate) fn now() -> MachineInstant {
        blastema::platform::now().into()
    }

    /// So many nanoseconds after the clock's origin.
    pub(crate) const fn from_nanos(nanos: u64) -> MachineInstant {
        MachineInstant(nanos)
    }

    /// So many milliseconds after the clock's origin.
    #[cfg(test)]
    pub(crate) const fn from_millis(millis: u64) -> MachineInstant {
        MachineInstant(millis * 1_000_000)
    }

    /// Nanoseconds since the clock's origin.
    pub(crate) const fn as_nanos(self) -> u64 {
        self.0
    }
}

impl From<Instant> for MachineInstant {
    fn from(instant: Instant) -> MachineInstant {
        MachineInstant(instant.as_nanos())
    }
}

impl Add<Duration> for MachineInstant {
    type Output = MachineInstant;

    fn add(self, span: Duration) -> MachineInstant {
        MachineInstant(self.0.saturating_add(u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)))
    }
}

impl Sub for MachineInstant {
    type Output = Duration;

    /// The span since `earlier`; zero where `earlier` is in fact later.
    fn sub(self, earlier: MachineInstant) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}
