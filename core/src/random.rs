//! Randomness as an argument: one seed gives one sequence, on every platform.

/// A small generator of random numbers (SplitMix64: Steele, Lea, Flood, OOPSLA 2014).
///
/// Good enough for back-off, jitter and injected faults; never for keys.
///
/// ```
/// use blastema_core::random::Random;
/// let (mut a, mut b) = (Random::new(7), Random::new(7));
/// assert_eq!(a.next(), b.next());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Random(u64);

impl Random {
    /// The sequence that belongs to `seed`.
    pub const fn new(seed: u64) -> Self {
        Random(seed)
    }

    /// The next number, from the whole range.
    pub const fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(STEP);
        mixed(self.0)
    }

    /// The number that comes `n`-th from here, counted from 1, without those before it.
    pub const fn nth(&self, n: u32) -> u64 {
        mixed(self.0.wrapping_add(STEP.wrapping_mul(n as u64)))
    }

    /// The next number, at least 0 and below `limit`, which is not 0. Small limits are what it is
    /// for: a bias of `limit` in 2^64 is accepted.
    pub const fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }

    /// The next number, at least 0 and below 1.
    pub fn unit(&mut self) -> f64 {
        // 53 bits are what a double holds exactly.
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// True with this probability: 0 and below is never, 1 and above always.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }
}

/// The odd number nearest to the golden ratio's part of 2^64.
const STEP: u64 = 0x9E37_79B9_7F4A_7C15;

/// Every bit of the input changes half of the output's.
const fn mixed(mut word: u64) -> u64 {
    word = (word ^ (word >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    word ^ (word >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nth_number_is_the_one_that_comes_after_those_before_it() {
        let mut random = Random::new(7);

        for n in 1..100 {
            assert_eq!(Random::new(7).nth(n), random.next());
        }
    }

    #[test]
    fn the_sequence_is_the_published_one() {
        let mut random = Random::new(1_234_567);

        assert_eq!(random.next(), 6_457_827_717_110_365_317);
        assert_eq!(random.next(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn a_chance_of_none_never_comes_and_of_one_always() {
        let mut random = Random::new(1);

        assert!((0..1000).all(|_| !random.chance(0.0) && random.chance(1.0)));
        let hits = (0..10_000).filter(|_| random.chance(0.3)).count();
        assert!((2_800..3_200).contains(&hits), "{hits}");
    }
}
