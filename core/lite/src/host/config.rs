//! What a host knows of a device beforehand, and how long it waits for it.

use core::time::Duration;

/// How the host of one device behaves.
///
/// `P` holds the table of ports: an array, a slice or a vector.
#[derive(Clone, Debug)]
pub struct HostConfig<P> {
    /// The device's address on a multi-drop line; `None` if it has the line, or the socket, to
    /// itself.
    pub address: Option<u8>,
    /// The type that the device must have.
    pub device_type: u32,
    /// The ports and variables that the device must have, at most 255. A device may have more.
    pub ports: P,
    /// A random number. The sessions are numbered from here, so that a new host's session differs
    /// from those of its predecessors.
    pub session: u16,
    /// How often the device is asked for a sign of life. Shorter finds a silent device sooner and
    /// takes more of the line.
    pub interval: Duration,
    /// How many unanswered tries in a row declare the device lost.
    pub tries: Tries,
    /// After so long a silence of the host the device makes itself safe, at the latest after its
    /// own limit. Must be longer than a few intervals; rounded down to milliseconds.
    pub deadman: Duration,
    /// How long one byte is on the line: 10 bits divided by the baud rate. 0 for datagrams.
    pub byte_time: Duration,
    /// How long the device and both ends' drivers take for an answer at most, without its bytes:
    /// the longest hook included. Shorter repeats sooner after a loss. At least 1 ms is taken.
    pub turnaround: Duration,
}

impl<P> HostConfig<P> {
    /// How long a PING and its answer take at most: the slot of an idle device. The intervals of
    /// all devices of a multi-drop line must be longer than the sum of their slots.
    ///
    /// ```
    /// use blastema_lite::HostConfig;
    /// use core::time::Duration;
    /// let config = HostConfig {
    ///     address: Some(7),
    ///     device_type: 0,
    ///     ports: [blastema_lite::Port::output(1, 0, 4, 0)],
    ///     session: 1,
    ///     interval: Duration::from_millis(200),
    ///     tries: Default::default(),
    ///     deadman: Duration::from_secs(1),
    ///     byte_time: Duration::from_secs(10) / 115_200,
    ///     turnaround: Duration::from_millis(2),
    /// };
    /// assert_eq!(config.slot().as_micros(), 3649);
    /// assert_eq!((config.slot() * 32).as_millis(), 116);
    /// ```
    pub fn slot(&self) -> Duration {
        // Both have CRC-8, one byte less than others.
        self.exchange_time(1, 4) - 2 * self.byte_time
    }

    /// How long a request with so many bytes of data, and its reply, take at most.
    pub(crate) fn exchange_time(&self, out: usize, back: usize) -> Duration {
        // Header, two commands, CRC-16, code byte and delimiter.
        let around = 7 + usize::from(self.address.is_some());
        let bytes = (out + back + 2 * around) as u32;
        self.byte_time * bytes + self.turnaround.max(Duration::from_millis(1))
    }
}

/// When a device that does not answer is lost.
///
/// A try fails with `q = 1 - (1 - p)^2` on a line that loses each frame with `p`. At `p` = 20 %
/// three tries in a row fail in 4.7 % of cases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tries {
    /// As many as keep false alarms below one a day at the measured loss, at least 3.
    #[default]
    Auto,
    /// This many. The host reports when the measured loss demands more.
    Fixed(u8),
}

impl Tries {
    /// The fewest tries, also of a line without loss.
    pub const LEAST: u8 = 3;

    /// The tries that keep false alarms below one a day, if of `asked` tries `missed` failed.
    ///
    /// ```
    /// use blastema_lite::Tries;
    /// use core::time::Duration;
    /// // 36 % fail: 14 tries at 10 pings per second, 16 at 100.
    /// assert_eq!(Tries::needed(360, 1000, Duration::from_millis(100)), 14);
    /// assert_eq!(Tries::needed(360, 1000, Duration::from_millis(10)), 16);
    /// assert_eq!(Tries::needed(0, 1000, Duration::from_millis(10)), 3);
    /// ```
    pub fn needed(missed: u32, asked: u32, interval: Duration) -> u8 {
        const DAY_S: f32 = 86_400.0;
        let target = interval.as_secs_f32() / DAY_S;
        let fails = missed as f32 / asked.max(1) as f32;
        let mut all_fail = fails;
        let mut tries = 1;
        while all_fail > target && tries < u8::MAX {
            all_fail *= fails;
            tries += 1;
        }
        tries.max(Tries::LEAST)
    }
}
