//! Whatever an adapter says, it is understood or refused, never holds more than a line, and what is
//! understood is written and read back as it was.

#![no_main]

use blastema_core::medium::can::slcan::{AdapterCommand, AdapterReply, LINE_MAX, ReplyParser};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let mut listener = ReplyParser::default();
    for byte in bytes {
        let Some(reply) = listener.handle_byte(*byte) else { continue };
        let mut line = Vec::new();
        reply.encode(&mut line);
        assert!(line.len() <= LINE_MAX + 1);
        let again: Vec<AdapterReply> =
            line.iter().filter_map(|byte| ReplyParser::handle_byte(&mut listener, *byte)).collect();
        assert_eq!(again, [reply]);
    }
    assert!(listener.refused() <= bytes.len() as u64);
    if let Some(command) = AdapterCommand::decode(bytes) {
        let mut line = Vec::new();
        command.encode(&mut line);
        assert_eq!(AdapterCommand::decode(&line[..line.len() - 1]), Some(command));
    }
});
