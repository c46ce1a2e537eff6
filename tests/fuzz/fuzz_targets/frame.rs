//! Whatever bytes arrive as a link's frame: no panic, and what is taken is the same when it is sent
//! on.

#![no_main]

use blastema_core::net::wire::frame::Frame;
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(taken) = Frame::decode(Bytes::copy_from_slice(bytes)) {
        assert_eq!(Frame::decode(taken.encode()), Ok(taken));
    }
});
