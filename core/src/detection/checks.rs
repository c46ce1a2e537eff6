//! Checks of important data at fixed points (FT23): small, pure, called by the component itself.
//!
//! A component that finds a failed check declares a fault of the kind
//! [`FaultKind::CheckFailed`](crate::FaultKind::CheckFailed), with the error's text.

use crate::Instant;
use std::fmt;
use std::ops::RangeInclusive;
use std::time::Duration;

/// A check failed: what, its value, and the limit that it broke.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} is {found}, and should be {expected}")]
pub struct CheckFailed {
    /// The checked quantity, as named by the component.
    pub what: &'static str,
    /// The value found.
    pub found: String,
    /// The value expected.
    pub expected: String,
}

/// A value must lie within limits. A value that does not compare, such as NaN, fails.
///
/// ```
/// use blastema_core::detection::Range;
///
/// let speed = Range::new("speed", 0.0..=1.5);
/// assert!(speed.check(1.2).is_ok());
/// let wrong = speed.check(1.7).unwrap_err();
/// assert_eq!(wrong.to_string(), "speed is 1.7, and should be in 0.0..=1.5");
/// assert!(speed.check(f64::NAN).is_err());
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Range<T> {
    what: &'static str,
    limits: RangeInclusive<T>,
}

impl<T: PartialOrd + fmt::Debug> Range<T> {
    /// A check that `what` lies within `limits`.
    pub const fn new(what: &'static str, limits: RangeInclusive<T>) -> Self {
        Range { what, limits }
    }

    /// Checks one value, and hands it on if it is right.
    ///
    /// # Errors
    /// The value lies outside.
    pub fn check(&self, value: T) -> Result<T, CheckFailed> {
        if self.limits.contains(&value) {
            return Ok(value);
        }
        let expected = format!("in {:?}", self.limits);
        Err(CheckFailed { what: self.what, found: format!("{value:?}"), expected })
    }
}

/// A value must not change faster than so much per second.
///
/// ```
/// use blastema_core::Instant;
/// use blastema_core::detection::Rate;
///
/// let mut heading = Rate::new("heading", 2.0);
/// assert!(heading.check(0.0, Instant::from_millis(0)).is_ok());
/// assert!(heading.check(0.1, Instant::from_millis(100)).is_ok());
/// let wrong = heading.check(1.1, Instant::from_millis(200)).unwrap_err();
/// assert_eq!(wrong.found, "changing by 10 per second");
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Rate {
    what: &'static str,
    per_second: f64,
    last: Option<(f64, Instant)>,
}

impl Rate {
    /// A check that `what` changes by at most `per_second`, in its own unit.
    pub const fn new(what: &'static str, per_second: f64) -> Self {
        Rate { what, per_second, last: None }
    }

    /// Checks the next value against the one before, also if that failed: a sensor that has jumped
    /// to another value and stays there fails once.
    ///
    /// # Errors
    /// It changed too fast, or is no number.
    pub fn check(&mut self, value: f64, now: Instant) -> Result<f64, CheckFailed> {
        let failed = |found| {
            let expected = format!("changing by at most {} per second", self.per_second);
            Err(CheckFailed { what: self.what, found, expected })
        };
        if !value.is_finite() {
            return failed(format!("{value}"));
        }
        let Some((last, then)) = self.last.replace((value, now)) else { return Ok(value) };
        let change = (value - last).abs();
        let seconds = (now - then).as_secs_f64();
        if change > self.per_second * seconds {
            return failed(match change / seconds {
                rate if rate.is_finite() => {
                    format!("changing by {rate:.6}")
                        .trim_end_matches('0')
                        .trim_end_matches('.')
                        .to_owned()
                        + " per second"
                }
                _ => format!("changing by {change} at once"),
            });
        }
        Ok(value)
    }
}

/// Data must not be older than so much when it is used.
///
/// ```
/// use blastema_core::Instant;
/// use blastema_core::detection::Freshness;
/// use std::time::Duration;
///
/// let scan = Freshness::new("the last scan", Duration::from_millis(100));
/// let taken = Instant::from_millis(1000);
/// assert!(scan.check(taken, Instant::from_millis(1080)).is_ok());
/// let wrong = scan.check(taken, Instant::from_millis(1250)).unwrap_err();
/// assert_eq!(wrong.to_string(), "the last scan is 250ms old, and should be at most 100ms old");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Freshness {
    what: &'static str,
    max_age: Duration,
}

impl Freshness {
    /// A check that `what` is not older than `max_age`.
    pub const fn new(what: &'static str, max_age: Duration) -> Self {
        Freshness { what, max_age }
    }

    /// Checks data that was taken at `taken`, and answers its age.
    ///
    /// # Errors
    /// It is too old.
    pub fn check(&self, taken: Instant, now: Instant) -> Result<Duration, CheckFailed> {
        let age = now - taken;
        if age <= self.max_age {
            return Ok(age);
        }
        let expected = format!("at most {:?} old", self.max_age);
        Err(CheckFailed { what: self.what, found: format!("{age:?} old"), expected })
    }
}

/// A condition that must always hold between values.
///
/// ```
/// use blastema_core::detection::Invariant;
///
/// let balance = Invariant::new("wheel speeds", "of one sign while driving", |(left, right): &(f64, f64)| {
///     left * right >= 0.0
/// });
/// assert!(balance.check(&(0.4, 0.5)).is_ok());
/// let wrong = balance.check(&(0.4, -0.5)).unwrap_err();
/// assert_eq!(
///     wrong.to_string(),
///     "wheel speeds is (0.4, -0.5), and should be of one sign while driving"
/// );
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Invariant<T> {
    what: &'static str,
    expected: &'static str,
    holds: fn(&T) -> bool,
}

impl<T: fmt::Debug> Invariant<T> {
    /// A check that `holds` is true of `what`; `expected` says in words what that means.
    pub const fn new(what: &'static str, expected: &'static str, holds: fn(&T) -> bool) -> Self {
        Invariant { what, expected, holds }
    }

    /// Checks one value.
    ///
    /// # Errors
    /// It does not hold.
    pub fn check(&self, value: &T) -> Result<(), CheckFailed> {
        if (self.holds)(value) {
            return Ok(());
        }
        let (found, expected) = (format!("{value:?}"), self.expected.into());
        Err(CheckFailed { what: self.what, found, expected })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_themselves_are_within_the_range() {
        let level = Range::new("level", 1..=3);

        assert_eq!(
            [0, 1, 3, 4].map(|value| level.check(value).is_ok()),
            [false, true, true, false]
        );
    }

    #[test]
    fn a_jump_fails_once_and_a_value_that_is_no_number_is_not_compared_with() {
        let mut height = Rate::new("height", 1.0);
        let at = |seconds: u64| Instant::from_millis(seconds * 1000);

        let inputs = [(0.0, 0), (1.0, 1), (9.0, 2), (9.5, 3), (f64::NAN, 4), (9.9, 5)];
        let right = inputs.map(|(value, second)| height.check(value, at(second)).is_ok());

        assert_eq!(right, [true, true, false, true, false, true]);
    }

    #[test]
    fn two_values_at_one_instant_must_be_equal() {
        let mut height = Rate::new("height", 1.0);
        let now = Instant::from_millis(5);

        height.check(1.0, now).expect("there is nothing to compare with");
        assert!(height.check(1.0, now).is_ok());

        let wrong = height.check(2.0, now).unwrap_err();
        assert_eq!(wrong.found, "changing by 1 at once");
    }

    #[test]
    fn data_of_exactly_the_greatest_age_is_still_fresh() {
        let scan = Freshness::new("scan", Duration::from_millis(10));

        assert!(scan.check(Instant::from_millis(0), Instant::from_millis(10)).is_ok());
        assert!(scan.check(Instant::from_millis(0), Instant::from_nanos(10_000_001)).is_err());
    }
}
