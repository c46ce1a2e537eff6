//! Which serial line, and how fast.

use blastema_core::net::routing::MTU_MIN;
use std::path::PathBuf;
use std::time::Duration;
pub use tokio_serial::{Parity, StopBits};

/// The largest frame that a line has unless told, in bytes: beyond, headers cost next to nothing.
const MTU_MAX: usize = 2_048;
/// How long the largest frame may keep a line, and what is urgent waiting, unless told.
const FRAME_TIME: Duration = Duration::from_millis(50);

/// How the port's driver turns a line of RS-485 (Linux): it raises RTS before it sends, and lowers
/// it after. The driver keeps that when the port is closed, until the next start of the system or
/// longer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Rs485 {
    /// RTS is low while it sends, and high otherwise.
    pub rts_low: bool,
    /// How long RTS is there before the first byte, in whole milliseconds; a port with parts of one
    /// is not opened. Some drivers do without.
    pub before: Duration,
    /// How long RTS stays after the last byte, likewise.
    pub after: Duration,
}

impl Rs485 {
    /// What is wrong with parts of a millisecond.
    pub(crate) const WHOLE: &str =
        "a driver counts how long RTS stays in whole milliseconds: as in 1ms";

    /// Whether a driver can be told this time.
    pub(crate) fn is_whole(span: Duration) -> bool {
        span.subsec_nanos().is_multiple_of(1_000_000)
    }
}

/// A serial line with one node at each end: RS-232, RS-422, RS-485 whose adapter or driver turns
/// it, or a USB device (CDC-ACM).
///
/// ```
/// use blastema_transports::SerialConfig;
/// let mut config = SerialConfig::new("/dev/serial/by-id/usb-FTDI_A4008NXG-if00-port0");
/// config.baud = Some(921_600);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct SerialConfig {
    /// The port. Best one of `/dev/serial/by-id/`, which stays the same when it is plugged in
    /// again.
    pub path: PathBuf,
    /// The line's speed, in bits a second; both ends must have the same. `None` is 115,200, and
    /// does not limit what is sent to a USB device (CDC-ACM): give the speed of a line behind it.
    pub baud: Option<u32>,
    /// The parity bit. The frames' checksum finds more than it does.
    pub parity: Parity,
    /// How many stop bits.
    pub stop_bits: StopBits,
    /// Whether the other end may stop us by a wire of its own (RTS/CTS).
    pub hardware_flow: bool,
    /// How the port's driver turns a line of RS-485. `None` leaves the driver as it is: an adapter
    /// that turns the line by itself needs no more.
    pub rs485: Option<Rs485>,
    /// The largest frame, in bytes. By default what takes 50 ms on the line, but from 96 to 2,048:
    /// a larger one keeps others, and hellos, waiting behind it; of a smaller one, more is headers.
    /// What is larger than the other end's is noise to it.
    pub mtu: Option<usize>,
    /// How much of one urgency may wait for the line, in time that it takes to send, and eight of
    /// the largest frames at least; beyond, frames are dropped. More rides out longer bursts, and
    /// makes everything later while they last.
    pub queue_time: Duration,
}

impl SerialConfig {
    /// 115,200 bits a second, 8 bits, no parity, one stop bit.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        SerialConfig {
            path: path.into(),
            baud: None,
            parity: Parity::None,
            stop_bits: StopBits::One,
            hardware_flow: false,
            rs485: None,
            mtu: None,
            queue_time: Duration::from_millis(100),
        }
    }

    /// The line's speed, in bits a second.
    pub(super) fn baud(&self) -> u32 {
        self.baud.unwrap_or(115_200)
    }

    /// What a byte takes on the line, in bits: a start bit, eight of its own, and what follows.
    fn bits_a_byte(&self) -> u64 {
        let parity = u64::from(self.parity != Parity::None);
        let stop = match self.stop_bits {
            StopBits::One => 1,
            StopBits::Two => 2,
        };
        1 + 8 + parity + stop
    }

    /// How many bytes the line carries in this time.
    pub fn bytes_in(&self, span: Duration) -> usize {
        let micros = u64::try_from(span.as_micros()).unwrap_or(u64::MAX);
        let bytes =
            u64::from(self.baud()).saturating_mul(micros) / (self.bits_a_byte() * 1_000_000);
        usize::try_from(bytes).unwrap_or(usize::MAX)
    }

    /// How long this many bytes take on the line.
    pub fn time_of(&self, bytes: usize) -> Duration {
        let bits = (bytes as u64).saturating_mul(self.bits_a_byte());
        Duration::from_micros(bits.saturating_mul(1_000_000) / u64::from(self.baud().max(1)))
    }

    /// The largest frame, in bytes.
    pub fn mtu(&self) -> usize {
        self.mtu.unwrap_or_else(|| self.bytes_in(FRAME_TIME).clamp(MTU_MIN, MTU_MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_frame_suits_the_speed() {
        let check = |baud, expected| {
            let mut config = SerialConfig::new("/dev/null");
            config.baud = Some(baud);
            assert_eq!(config.mtu(), expected, "at {baud} bits a second");
        };

        check(9_600, 96);
        check(38_400, 192);
        check(115_200, 576);
        check(921_600, 2_048);
    }

    #[test]
    fn a_byte_takes_as_many_bits_as_the_settings_say() {
        let mut config = SerialConfig::new("/dev/null");
        config.baud = Some(12_000);
        assert_eq!(config.time_of(1_200), Duration::from_secs(1));

        (config.parity, config.stop_bits) = (Parity::Even, StopBits::Two);
        assert_eq!(config.time_of(1_000), Duration::from_secs(1));
        assert_eq!(config.bytes_in(Duration::from_secs(1)), 1_000);
    }
}
