//! How much of the time a thread is kept, from looks at even intervals.

/// The share of the latest looks that found somebody there.
///
/// It costs a shift for each look, and no clock. What happens in step with the looks is misjudged, as by
/// any sample.
///
/// ```
/// use blastema_core::occupancy::Occupancy;
///
/// let mut thread = Occupancy::default();
/// assert_eq!(thread.share(), None);
/// for look in 0..200 {
///     thread.note(look % 4 == 0);
/// }
/// assert_eq!(thread.share(), Some(0.25));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Occupancy {
    /// The latest looks, the last one lowest.
    found: u128,
    looks: u32,
}

impl Occupancy {
    /// Looks that count: 1.3 s of the usual ones, every 10 ms.
    pub const LOOKS: u32 = u128::BITS;

    /// One more look.
    pub fn note(&mut self, found: bool) {
        self.found = self.found << 1 | u128::from(found);
        self.looks = (self.looks + 1).min(Self::LOOKS);
    }

    /// The share, from 0 to 1; `None` before the first look.
    pub fn share(&self) -> Option<f32> {
        // Both are at most 128, which any float holds exactly.
        let of = |count: u32| f32::from(u8::try_from(count).unwrap_or(u8::MAX));
        (self.looks > 0).then(|| of(self.found.count_ones()) / of(self.looks))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_latest_looks_count_and_fewer_at_first() {
        let mut thread = Occupancy::default();
        thread.note(true);
        thread.note(false);
        assert_eq!(thread.share(), Some(0.5));

        (0..Occupancy::LOOKS).for_each(|_| thread.note(true));
        assert_eq!(thread.share(), Some(1.0));
        (0..Occupancy::LOOKS / 2).for_each(|_| thread.note(false));
        assert_eq!(thread.share(), Some(0.5));
    }
}
