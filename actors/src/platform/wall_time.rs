//! A time of the wall clock.

use std::fmt;
#[cfg(feature = "journal")]
use std::time::Duration;

const MICROS_PER_SECOND: i64 = 1_000_000;
const SECONDS_PER_DAY: i64 = 24 * 60 * 60;

/// A time of the wall clock, in microseconds since the beginning of 1970 UTC.
///
/// The wall clock may be set, so that a later event can have an earlier time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WallTime(i64);

impl WallTime {
    /// The time so many microseconds after the beginning of 1970 UTC.
    pub fn from_micros(micros: i64) -> Self {
        WallTime(micros)
    }

    /// Microseconds since the beginning of 1970 UTC.
    #[cfg(feature = "journal")]
    pub fn as_micros(self) -> i64 {
        self.0
    }

    /// The time of so long before.
    #[cfg(feature = "journal")]
    #[must_use]
    pub fn before(self, span: Duration) -> Self {
        WallTime(self.0.saturating_sub(i64::try_from(span.as_micros()).unwrap_or(i64::MAX)))
    }
}

impl fmt::Display for WallTime {
    /// As in RFC 3339, in UTC and to the millisecond: `2026-11-22T02:31:07.250Z`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.div_euclid(MICROS_PER_SECOND);
        let millis = self.0.rem_euclid(MICROS_PER_SECOND) / 1000;
        let (days, second) =
            (seconds.div_euclid(SECONDS_PER_DAY), seconds.rem_euclid(SECONDS_PER_DAY));
        let (year, month, day) = civil(days);
        let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
        write!(f, "{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{millis:03}Z")
    }
}

/// The date of a day since the beginning of 1970 (H. Hinnant, "chrono-compatible low-level date
/// algorithms", `civil_from_days`).
fn civil(days: i64) -> (i64, i64, i64) {
    let shifted = days + 719_468;
    let era = shifted.div_euclid(146_097);
    let day_of_era = shifted.rem_euclid(146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    let year = year_of_era + era * 400 + i64::from(month <= 2);
    (year, month, day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_written_as_in_rfc_3339() {
        let check = |seconds: i64, text: &str| {
            assert_eq!(WallTime(seconds * MICROS_PER_SECOND + 250_999).to_string(), text);
        };
        check(0, "1970-01-01T00:00:00.250Z");
        check(951_782_400, "2000-02-29T00:00:00.250Z");
        check(1_795_314_667, "2026-11-22T02:31:07.250Z");
        check(-1, "1969-12-31T23:59:59.250Z");
        check(4_107_542_399, "2100-02-28T23:59:59.250Z");
        check(4_107_542_400, "2100-03-01T00:00:00.250Z");
    }
}
