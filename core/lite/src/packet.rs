//! The packet: header, command 0, command 1, data, checksum.
//!
//! ```text
//! (address) │ header │ command 0 │ command 1 │ data 0..=240 │ checksum 1 or 2
//!            bits 7-6  01: this variant of the protocol
//!            bit 5     set: from the device
//!            bit 4     set: a command, carried out once and answered; else plain
//!            bit 3     set: CRC-16; else CRC-8
//!            bits 2-0  sequence of commands; 0 in plain packets
//! ```
//!
//! The address is there on multi-drop lines only. The checksum covers it, and covers the session
//! number, which costs no byte: a packet of another session fails its checksum. After
//! RTComponent-Lite 0.4.0 (Suzuki et al., RSJ 2007, Fig. 2), with sequence, session and lengths
//! added.

/// The most data bytes of a packet: the frame stays shorter than 254 bytes.
pub const DATA_MAX: usize = 240;

/// The most objects of a device: the reply to HELLO lists the state of each behind ten bytes.
pub const OBJECTS_MAX: usize = DATA_MAX - 10;

/// The most bytes of a packet: address, header, two commands, data, CRC-16.
pub const PACKET_MAX: usize = 1 + 3 + DATA_MAX + 2;

/// The start value of the checksum of packets whose command 0 is the link.
const LINK_SESSION: u16 = 0xFFFF;

const VARIANT: u8 = 0b1100_0000;
const PLAIN_TEXT: u8 = 0b0100_0000;
const FROM_DEVICE: u8 = 0b0010_0000;
const COMMAND: u8 = 0b0001_0000;
const WIDE: u8 = 0b0000_1000;
const SEQUENCE: u8 = 0b0000_0111;

/// One packet without its checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DevicePacket<'a> {
    /// The device's address on a multi-drop line; 0 is all devices.
    pub address: Option<u8>,
    /// Whether the device sends it.
    pub from_device: bool,
    /// The sequence number of a command and of its reply, 0 to 7; `None` in plain packets.
    pub sequence: Option<u8>,
    /// Command 0: the object, or 0 for the link itself.
    pub object: u8,
    /// Command 1: what to do, one of [`message`](crate::message).
    pub message: u8,
    /// The data, at most [`DATA_MAX`] bytes.
    pub data: &'a [u8],
}

impl<'a> DevicePacket<'a> {
    /// A plain packet of the link to a device, without data, for the other fields to be set.
    pub(crate) const fn to_device(address: Option<u8>) -> DevicePacket<'static> {
        let (object, message) = (crate::message::LINK, crate::message::PING);
        DevicePacket { address, from_device: false, sequence: None, object, message, data: &[] }
    }

    /// Writes the packet with the checksum of this session and returns its bytes.
    ///
    /// # Panics
    ///
    /// If there are more than [`DATA_MAX`] bytes of data.
    ///
    /// ```
    /// use blastema_lite::{DevicePacket, PACKET_MAX, message};
    /// let ping = DevicePacket {
    ///     address: None,
    ///     from_device: false,
    ///     sequence: None,
    ///     object: message::LINK,
    ///     message: message::PING,
    ///     data: &[3],
    /// };
    /// let mut bytes = [0; PACKET_MAX];
    /// assert_eq!(ping.encode(0, &mut bytes), [0x40, 0, 0, 3, 0xfd]);
    /// ```
    pub fn encode<'b>(&self, session: u16, bytes: &'b mut [u8; PACKET_MAX]) -> &'b [u8] {
        let wide = is_wide(self.object, self.message);
        let class = self.sequence.map_or(0, |sequence| COMMAND | sequence & SEQUENCE);
        let head = usize::from(self.address.is_some());
        let end = head + 3 + self.data.len();
        bytes[0] = self.address.unwrap_or(0);
        bytes[head] = PLAIN_TEXT
            | if self.from_device { FROM_DEVICE } else { 0 }
            | class
            | if wide { WIDE } else { 0 };
        bytes[head + 1] = self.object;
        bytes[head + 2] = self.message;
        bytes[head + 3..end].copy_from_slice(self.data);
        let checksum = checksum(&bytes[..end], start(self.object, session), wide).to_be_bytes();
        bytes[end] = checksum[0];
        bytes[end + 1] = checksum[1];
        &bytes[..end + 1 + usize::from(wide)]
    }

    /// Reads a packet of this session; `addressed` on multi-drop lines. Returns none, and the
    /// receiver drops the bytes, if they are of another length, variant, width or session, or if
    /// the checksum differs: line noise and another sender's packets cause each of them.
    pub fn decode(bytes: &'a [u8], addressed: bool, session: u16) -> Option<Self> {
        let (address, rest) = match bytes {
            [address, rest @ ..] if addressed => (Some(*address), rest),
            rest => (None, rest),
        };
        let [header, object, message, ..] = *rest else { return None };
        // The width follows from the message: noise can turn bit 3, and a receiver that obeyed it
        // would be as weak as CRC-8 for every message.
        let wide = is_wide(object, message);
        let is_command = header & COMMAND != 0;
        let is_plain = header & VARIANT == PLAIN_TEXT && (is_command || header & SEQUENCE == 0);
        if !is_plain || (header & WIDE != 0) != wide {
            return None;
        }
        let tail = 1 + usize::from(wide);
        let length = rest.len().checked_sub(3 + tail).filter(|length| *length <= DATA_MAX)?;
        let (covered, found) = bytes.split_at(bytes.len() - tail);
        let expected = checksum(covered, start(object, session), wide).to_be_bytes();
        (*found == expected[..tail]).then_some(DevicePacket {
            address,
            from_device: header & FROM_DEVICE != 0,
            sequence: is_command.then_some(header & SEQUENCE),
            object,
            message,
            data: &rest[3..3 + length],
        })
    }
}

/// PING and PONG have CRC-8, everything else CRC-16.
fn is_wide(object: u8, message: u8) -> bool {
    (object, message) != (crate::message::LINK, crate::message::PING)
}

fn start(object: u8, session: u16) -> u16 {
    if object == crate::message::LINK { LINK_SESSION } else { session }
}

/// CRC-16 0x5935, or CRC-8 0x2F in the upper byte; not reflected, final XOR all ones.
///
/// Both begin with the session: for CRC-8 that is the same as a start with 0 over a packet whose
/// first two bytes are XORed with it. Without the final XOR, a packet that ends in a zero passes
/// also when one turned bit has cut that zero off.
fn checksum(bytes: &[u8], start: u16, wide: bool) -> u16 {
    let polynomial = if wide { 0x5935 } else { 0x2F00 };
    !bytes.iter().fold(start, |value, &byte| {
        (0..8).fold(value ^ u16::from(byte) << 8, |value, _| {
            value << 1 ^ if value & 0x8000 != 0 { polynomial } else { 0 }
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{cobs, message};

    const NO_DATA: DevicePacket<'static> = DevicePacket {
        address: None,
        from_device: false,
        sequence: None,
        object: 0,
        message: 0,
        data: &[],
    };

    #[track_caller]
    fn check(packet: DevicePacket<'_>, session: u16, bytes: &[u8], wire: &[u8]) {
        let (mut room, mut frame) = ([0; PACKET_MAX], [0; cobs::FRAME_MAX]);
        let encoded = packet.encode(session, &mut room);
        assert_eq!(encoded, bytes);
        assert_eq!(cobs::encode(encoded, &mut frame), wire);
        assert_eq!(DevicePacket::decode(bytes, packet.address.is_some(), session), Some(packet));
    }

    #[test]
    fn the_worked_examples_are_encoded_and_decoded() {
        check(
            DevicePacket { data: &[3], ..NO_DATA },
            0,
            &[0x40, 0, 0, 3, 0xfd],
            &[2, 0x40, 1, 3, 3, 0xfd, 0],
        );
        check(
            DevicePacket { from_device: true, data: &[3, 0, 0, 0], ..NO_DATA },
            0,
            &[0x60, 0, 0, 3, 0, 0, 0, 0x78],
            &[2, 0x60, 1, 2, 3, 1, 1, 2, 0x78, 0],
        );
        let data = &[0x34, 0x12, 0xf4, 1];
        check(
            DevicePacket { message: message::HELLO, data, ..NO_DATA },
            0,
            &[0x48, 0, 1, 0x34, 0x12, 0xf4, 1, 0x32, 0x42],
            &[2, 0x48, 8, 1, 0x34, 0x12, 0xf4, 1, 0x32, 0x42, 0],
        );
        let activate = DevicePacket { sequence: Some(1), object: 1, message: 0x10, ..NO_DATA };
        check(activate, 0x1234, &[0x59, 1, 0x10, 0x8a, 0x48], &[6, 0x59, 1, 0x10, 0x8a, 0x48, 0]);
        check(
            DevicePacket { from_device: true, data: &[0, 2], ..activate },
            0x1234,
            &[0x79, 1, 0x10, 0, 2, 0xf9, 0xd5],
            &[4, 0x79, 1, 0x10, 4, 2, 0xf9, 0xd5, 0],
        );
    }

    #[test]
    fn an_address_is_covered_by_the_checksum() {
        let packet = DevicePacket { address: Some(7), data: &[3], ..NO_DATA };
        let mut bytes = [0; PACKET_MAX];
        let length = packet.encode(0, &mut bytes).len();
        assert_eq!(DevicePacket::decode(&bytes[..length], true, 0), Some(packet));

        bytes[0] = 8;

        let refused = DevicePacket::decode(&bytes[..length], true, 0);
        assert_eq!(refused, None);
    }

    #[test]
    fn a_packet_of_another_session_fails_its_checksum_but_one_of_the_link_does_not() {
        let mut bytes = [0; PACKET_MAX];
        let command = DevicePacket { sequence: Some(1), object: 1, message: 0x10, ..NO_DATA };
        let encoded = command.encode(0x1234, &mut bytes);
        let refused = DevicePacket::decode(encoded, false, 0x1235);
        assert_eq!(refused, None);

        let ping = DevicePacket { data: &[3], ..NO_DATA };
        let encoded = ping.encode(0x1234, &mut bytes);
        assert_eq!(DevicePacket::decode(encoded, false, 0x1235), Some(ping));
    }

    #[test]
    fn foreign_variants_widths_and_sequences_are_refused_although_their_checksum_is_right() {
        let is_read = |head: [u8; 3]| {
            let wide = is_wide(head[1], head[2]);
            let sum = checksum(&head, start(head[1], 0), wide).to_be_bytes();
            let bytes = [&head[..], &sum[..1 + usize::from(wide)]].concat();
            DevicePacket::decode(&bytes, false, 0).is_some()
        };
        for right in [[0x40, 0, 0], [0x48, 0, 1], [0x59, 1, 0x10]] {
            assert!(is_read(right), "{right:x?}");
        }
        let foreign = [[0x80, 0, 0], [0xc0, 0, 0], [0x00, 0, 0]];
        // Noise has turned bit 3, or a plain packet has a sequence.
        let wrong = [[0x48, 0, 0], [0x40, 0, 1], [0x51, 1, 0x10], [0x41, 0, 0], [0x49, 0, 1]];
        for head in foreign.iter().chain(&wrong) {
            assert!(!is_read(*head), "{head:x?}");
        }
        for short in [&[0x48, 0, 1, 3][..], &[0x40, 0], &[]] {
            assert_eq!(DevicePacket::decode(short, false, 0), None);
        }
    }

    #[test]
    fn every_turned_bit_of_a_packet_is_noticed() {
        let mut bytes = [0; PACKET_MAX];
        let command = DevicePacket { object: 3, message: 0x40, data: &[1, 0, 2, 0], ..NO_DATA };
        let length = command.encode(9, &mut bytes).len();
        for bit in 0..length * 8 {
            let mut bytes = bytes;
            bytes[bit / 8] ^= 1 << (bit % 8);
            assert!(DevicePacket::decode(&bytes[..length], false, 9).is_none(), "bit {bit}");
        }
    }
}
