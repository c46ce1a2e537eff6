//! Whatever bytes arrive as a link's frame: no panic, and what is taken is what would have been sent.

#![no_main]

use blastema_core::net::frame::Frame;
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let bytes = Bytes::copy_from_slice(bytes);
    if let Ok(taken) = Frame::decode(bytes.clone()) {
        assert_eq!(taken.encode(), bytes);
    }
});
