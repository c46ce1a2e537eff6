//! What comes from a serial line, in pieces: no bytes panic or make it hold more than a frame
//! takes, and a frame that comes whole after all of it is found.
#![no_main]

use blastema_transports::serial::framing::{Deframer, encode};
use libfuzzer_sys::fuzz_target;

const MTU: usize = 300;

fuzz_target!(|pieces: Vec<Vec<u8>>| {
    let mut deframer = Deframer::new(MTU);
    for piece in &pieces {
        let mut rest = &piece[..];
        let before = rest.len();
        let mut found = 0;
        while let Some(result) = deframer.push(&mut rest) {
            found += 1;
            assert!(result.is_ok_and(|frame| frame.len() <= MTU) || found <= before);
        }
        assert!(rest.is_empty() && found <= before);
    }
    let mut line = Vec::new();
    encode(b"found again", &mut line);
    let mut rest = &line[..];
    let found: Vec<_> = std::iter::from_fn(|| deframer.push(&mut rest)).collect();
    assert_eq!(found.last(), Some(&Ok("found again".into())));
});
