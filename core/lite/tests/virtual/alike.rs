//! Packets by chance to both sides: what one does, the other does, byte by byte.

use crate::bench::{Bench, DEVICE_TYPE, MEDIA, Medium, PORTS, RustSide};
use crate::c_side::{CSide, is_long};
use crate::channel::Random;
use crate::robot::ms;
use blastema_lite::{DevicePacket, FRAME_MAX, PACKET_MAX, cobs, message};

#[test]
fn both_sides_answer_every_packet_with_the_same_bytes() {
    let packets = if is_long() { 1_000_000 } else { 20_000 };
    for medium in MEDIA {
        let (mut rust, mut c) = (RustSide::new(medium), CSide::new(medium));
        let mut random = Random(11);
        let (mut now, mut session, mut sequence, mut answers) = (ms(0), 0x1234u16, 0u8, 0);
        for round in 0..packets {
            let mut pick = |limit: u64| random.next() % limit;
            // Now and then the host is silent for longer than the dead-man allows.
            now += ms(if pick(50) == 0 { 1_100 } else { pick(8) });
            let mut data: Vec<u8> = vec![0; [0, 1, 2, 4, 10, 13, 238][pick(7) as usize]];
            data.iter_mut().for_each(|byte| *byte = pick(4) as u8);
            let messages = [0x10, 0x11, 0x12, 0x14, 0x15, 0x16, 0x20, 0x21, 0x40, 0x41, 0x60];
            let ports = [0x80, 0x81, 0xA0, 0xC0, 0xC1, 0xE0, 0xE1, 0x00, 0x3F, 0xFF, 0x13];
            let mut packet = DevicePacket {
                address: medium.address(),
                from_device: pick(40) == 0,
                sequence: None,
                object: pick(4) as u8,
                message: [messages, ports][pick(2) as usize][pick(11) as usize],
                data: &data,
            };
            let hello = [session.to_le_bytes(), [pick(4) as u8, pick(2) as u8]].concat();
            let guard = DEVICE_TYPE.to_le_bytes();
            let number;
            match pick(30) {
                0 => session = session.wrapping_add(pick(2) as u16).max(1),
                1 | 2 => {
                    (packet.object, packet.message, packet.data) = (0, message::HELLO, &hello);
                    sequence = 0;
                }
                3 => (packet.object, packet.message) = (0, pick(6) as u8),
                6 => {
                    let probe = if pick(2) == 0 { 0 } else { message::PING_PROBE };
                    number = [pick(9) as u8 | probe];
                    (packet.object, packet.message, packet.data) = (0, message::PING, &number);
                }
                4 if pick(20) == 0 => {
                    (packet.object, packet.message, packet.data) = (0, message::RESTART, &guard);
                }
                5 => packet.address = packet.address.map(|_| pick(2) as u8 * 8),
                // A right length, for the most part.
                _ => {
                    let kinds = PORTS.iter().find(|port| {
                        port.object() == packet.object && port.id() == packet.message & 0xDF
                    });
                    let fixed = match packet.message {
                        0x10..0x16 => Some(0),
                        0x16 => Some(2),
                        0x21 => Some(1),
                        _ => kinds.map(|port| port.size().into()),
                    };
                    packet.data = fixed.and_then(|length| data.get(..length)).unwrap_or(&data);
                }
            }
            if packet.object != 0 && pick(4) > 0 {
                sequence = if pick(5) > 0 { (sequence + 1) % 8 } else { pick(8) as u8 };
                packet.sequence = Some(sequence);
            }
            let (mut bytes, mut frame) = ([0; PACKET_MAX], [0; FRAME_MAX]);
            let bytes = packet.encode(session, &mut bytes);
            let is_datagram = medium == Medium::Datagram;
            let bytes = if is_datagram { bytes } else { cobs::encode(bytes, &mut frame) };

            let sent = (rust.run(now, bytes).concat(), c.run(now, bytes).concat());

            assert_eq!(sent.0, sent.1, "{medium:?} {round} {packet:x?}");
            answers += usize::from(!sent.0.is_empty());
        }
        assert!(answers > packets / 4, "the packets reach something: {answers}");
    }
}
