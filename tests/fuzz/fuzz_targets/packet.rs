//! Whatever bytes arrive as a router's packet: no panic, and what is taken is the same when it is
//! sent on.

#![no_main]

use blastema_core::net::wire::packet::Packet;
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(taken) = Packet::decode(Bytes::copy_from_slice(bytes)) {
        assert_eq!(Packet::decode(taken.encode()), Ok(taken));
    }
});
