//! What comes from a device's line: no bytes panic, what is read as a packet is written as the same
//! bytes, and a packet that comes whole after all of it is found.

#![no_main]

use blastema_lite::{CobsDecoder, DevicePacket, FRAME_MAX, PACKET_MAX, cobs};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|script: (bool, u16, Vec<u8>)| {
    let (addressed, session, bytes) = script;
    let mut room = [0; PACKET_MAX];
    let check = |packet: &[u8], room: &mut [u8; PACKET_MAX]| {
        if let Some(fields) = DevicePacket::decode(packet, addressed, session) {
            assert_eq!(fields.encode(session, room), packet);
        }
    };
    check(&bytes, &mut room);
    let mut decoder = CobsDecoder::default();
    for &byte in bytes.iter().chain(&[0]) {
        if let Some(packet) = decoder.push(byte) {
            assert!(packet.len() <= PACKET_MAX);
            check(packet, &mut room);
        }
    }
    let mut frame = [0; FRAME_MAX];
    let (last, whole) = cobs::encode(b"found again", &mut frame).split_last().expect("a frame");
    assert!(whole.iter().all(|byte| decoder.push(*byte).is_none()));
    assert_eq!(decoder.push(*last), Some(&b"found again"[..]));
});
