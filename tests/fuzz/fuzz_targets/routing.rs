//! Whatever bytes arrive as what routers tell each other: no panic, and what is taken is the same
//! when it is sent on.

#![no_main]

use blastema_core::net::wire::advertisement::RoutingMessage;
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(taken) = RoutingMessage::decode(Bytes::copy_from_slice(bytes)) {
        assert_eq!(RoutingMessage::decode(taken.encode()), Ok(taken));
    }
});
