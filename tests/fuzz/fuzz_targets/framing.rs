//! What a TCP peer sends, cut into frames: no bytes panic, and none make it hold more than the
//! limit.
#![no_main]

use blastema_transports::tcp::framing;
use bytes::BytesMut;
use libfuzzer_sys::fuzz_target;

const LIMIT: usize = 4096;

fuzz_target!(|bytes: &[u8]| {
    let mut buffer = BytesMut::from(bytes);
    while let Ok(Some(frame)) = framing::decode(&mut buffer, LIMIT) {
        assert!(frame.len() <= LIMIT);
    }
    if let Some(preamble) = bytes.first_chunk() {
        let _ = framing::decode_preamble(*preamble, framing::PreambleKind::Port);
        let _ = framing::decode_preamble(*preamble, framing::PreambleKind::Path);
    }
});
