//! A line that loses, repeats and corrupts.

/// Random numbers of one seed (SplitMix64: Steele, Lea, Flood, OOPSLA 2014).
#[derive(Clone, Debug)]
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let word = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        word ^ (word >> 31)
    }

    /// At least 0 and below 1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub(crate) fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }
}

/// Both directions of a line.
#[derive(Clone, Debug)]
pub(crate) struct Channel {
    pub(crate) random: Random,
    /// The share of frames that are lost.
    pub(crate) loss: f64,
    /// The share of frames that arrive twice.
    pub(crate) repeated: f64,
    /// The share of bits that are turned.
    pub(crate) bit_errors: f64,
    /// The share of packets that are held back and arrive after up to four later ones.
    pub(crate) late: f64,
    held: Vec<(u64, Vec<u8>)>,
    /// Bits up to the next error.
    until_error: f64,
}

impl Channel {
    pub(crate) fn perfect() -> Channel {
        Channel::new(0, 0.0, 0.0, 0.0)
    }

    pub(crate) fn new(seed: u64, loss: f64, repeated: f64, bit_errors: f64) -> Channel {
        let random = Random(seed);
        let (late, held, until_error) = (0.0, Vec::new(), 0.0);
        let mut channel = Channel { random, loss, repeated, bit_errors, late, held, until_error };
        channel.until_error = channel.gap();
        channel
    }

    /// The distance of errors is distributed geometrically.
    fn gap(&mut self) -> f64 {
        let unit = self.random.unit();
        if self.bit_errors > 0.0 {
            (1.0 - unit).ln() / (1.0 - self.bit_errors).ln()
        } else {
            f64::MAX
        }
    }

    /// What arrives when this frame is sent: none, one or two copies of it, and late ones before
    /// it.
    pub(crate) fn carry(&mut self, frame: &[u8]) -> Vec<Vec<u8>> {
        for (packets, _) in &mut self.held {
            *packets -= 1;
        }
        let mut arrived: Vec<Vec<u8>> = self
            .held
            .extract_if(.., |(packets, _)| *packets == 0)
            .map(|(_, frame)| frame)
            .collect();

        let copies = match () {
            () if self.random.chance(self.loss) => 0,
            () if self.random.chance(self.repeated) => 2,
            () => 1,
        };
        for _ in 0..copies {
            let copy = self.corrupted(frame);
            if self.late > 0.0 && self.random.chance(self.late) {
                self.held.push((1 + self.random.next() % 4, copy));
            } else {
                arrived.push(copy);
            }
        }
        arrived
    }

    fn corrupted(&mut self, frame: &[u8]) -> Vec<u8> {
        let mut frame = frame.to_vec();
        let bits = frame.len() as f64 * 8.0;
        while self.until_error < bits {
            let bit = self.until_error as usize;
            frame[bit / 8] ^= 1 << (bit % 8);
            self.until_error += self.gap().max(1.0);
        }
        self.until_error -= bits;
        frame
    }
}
