//! Endpoint strings: no text panics, and every error points into the text.
#![no_main]

use blastema_transports::Endpoint;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    match text.parse::<Endpoint>() {
        Err(error) => {
            assert!(text.get(error.at()) == Some(error.part()));
            assert_eq!(error.to_string().lines().count(), 3);
        }
        Ok(endpoint) => {
            let _ = endpoint.peer(text);
        }
    }
});
