//! A CAN frame as Linux lays it out for a raw socket (`struct can_frame`, `struct canfd_frame`).
//!
//! ```text
//!      0      4      5       6   8
//! ┌─────────┬──────┬───────┬───┬────────────────┐
//! │   id    │length│ flags │ 0 │ data, 8 or 64  │   the identifier in the machine's own order
//! └─────────┴──────┴───────┴───┴────────────────┘
//!   id: 31 extended, 30 request, 29 error      flags, FD only: 0 data at the faster rate
//! ```

use blastema_core::medium::can::{CLASSIC_MAX, CanFrame, CanId, FD_MAX, Format};

/// In front of the data.
const HEADER: usize = 8;
/// How long a classic frame is.
const CLASSIC: usize = HEADER + CLASSIC_MAX;
/// How long a CAN FD frame is, and a buffer for any.
pub(super) const FD: usize = HEADER + FD_MAX;

/// Marks identifiers of 29 bits.
pub(super) const EXTENDED: u32 = 1 << 31;
/// Marks remote frames, which ask for data. The filters let none pass.
pub(super) const REMOTE: u32 = 1 << 30;
/// Marks what the kernel says of the bus.
const ERROR: u32 = 1 << 29;
/// Of what the kernel says: the controller is off the bus, after too many errors.
pub(super) const BUS_OFF: u32 = 1 << 6;
const FAST: u8 = 1;

/// Writes a frame; the answer is how many bytes that were.
pub(super) fn write(frame: &CanFrame, bytes: &mut [u8; FD]) -> usize {
    let extended = if frame.id().is_extended() { EXTENDED } else { 0 };
    let id = frame.id().number() | extended;
    let (flags, length) = match frame.format() {
        Format::Classic => (0, CLASSIC),
        Format::Fd { fast } => (if fast { FAST } else { 0 }, FD),
    };
    bytes.fill(0);
    bytes[..4].copy_from_slice(&id.to_ne_bytes());
    (bytes[4], bytes[5]) = (frame.length() as u8, flags);
    bytes[HEADER..HEADER + frame.data().len()].copy_from_slice(frame.data());
    length
}

/// Reads a frame; `None` for what is none, such as the kernel's word on the bus.
pub(super) fn read(bytes: &[u8]) -> Option<CanFrame> {
    let (id, rest) = bytes.split_first_chunk()?;
    let id = u32::from_ne_bytes(*id);
    let format = match bytes.len() {
        CLASSIC => Format::Classic,
        FD => Format::Fd { fast: rest[1] & FAST != 0 },
        _ => return None,
    };
    let number = id & !(EXTENDED | REMOTE | ERROR);
    let is_extended = id & EXTENDED != 0;
    let named = if is_extended { CanId::extended(number) } else { CanId::standard(number) }?;
    let length = usize::from(rest[0]);
    if id & (ERROR | REMOTE) != 0 {
        return None;
    }
    CanFrame::new(named, format, bytes.get(HEADER..HEADER + length)?)
}

/// Whether this is the kernel's word that the controller is off the bus.
pub(super) fn is_bus_off(bytes: &[u8]) -> bool {
    let id = bytes.first_chunk().map(|id| u32::from_ne_bytes(*id));
    id.is_some_and(|id| id & ERROR != 0 && id & BUS_OFF != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_come_back_as_they_went() {
        let (short, long) = (CanId::standard(0x7ff).unwrap(), CanId::extended(1).unwrap());
        let fast = Format::Fd { fast: true };
        let slow = Format::Fd { fast: false };
        for frame in [
            CanFrame::new(short, Format::Classic, b"").unwrap(),
            CanFrame::new(long, Format::Classic, b"12345678").unwrap(),
            CanFrame::new(long, fast, &[7; 64]).unwrap(),
            CanFrame::new(short, slow, b"123").unwrap(),
        ] {
            let mut bytes = [0xff; FD];
            let length = write(&frame, &mut bytes);
            assert_eq!(length, if frame.format() == Format::Classic { 16 } else { 72 });
            assert_eq!(read(&bytes[..length]), Some(frame));
        }
    }

    #[test]
    fn what_is_no_frame_is_none() {
        let frame = CanFrame::new(CanId::standard(1).unwrap(), Format::Classic, b"ab").unwrap();
        let mut bytes = [0; FD];
        assert_eq!(write(&frame, &mut bytes), 16);
        for length in (0..=FD).filter(|length| ![16, 72].contains(length)) {
            assert_eq!(read(&bytes[..length]), None);
        }
        let mut check = |id: u32, length: u8| {
            bytes[..4].copy_from_slice(&id.to_ne_bytes());
            bytes[4] = length;
            assert_eq!(read(&bytes[..16]), None, "{id:x} {length}");
        };
        check(1, 9);
        check(1, 255);
        check(0x800, 0);
        check(ERROR | 4, 8);
        check(REMOTE | 4, 0);
    }

    #[test]
    fn the_kernels_word_on_the_bus_is_told_from_frames() {
        let word = |id: u32| [&id.to_ne_bytes()[..], &[8, 0, 0, 0], &[0; 8]].concat();

        assert!(is_bus_off(&word(ERROR | BUS_OFF)));
        assert_eq!(read(&word(ERROR | BUS_OFF)), None);
        assert!(!is_bus_off(&word(ERROR | 4)), "the controller has a problem, and is on the bus");
        assert!(!is_bus_off(&word(BUS_OFF)), "a frame with this identifier");
        assert!(!is_bus_off(b"abc"));
    }
}
