//! Key files, rosters and policy lines: no text panics, and what is taken is written back as it was
//! meant.
#![no_main]

use blastema_core::net::trust::key_file::{KeyFile, RobotFile};
use blastema_core::net::trust::policy::PolicyLine;
use blastema_core::net::trust::roster::NodeRoster;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(key) = KeyFile::parse(text) {
        assert!(KeyFile::parse(&key.to_text()) == Ok(key));
    }
    let _ = RobotFile::parse(text);
    if let Ok(roster) = NodeRoster::parse(text) {
        assert!(NodeRoster::parse(&roster.to_text()) == Ok(roster));
    }
    let words: Vec<&str> = text.split_whitespace().collect();
    if let Ok(line) = PolicyLine::parse(&words) {
        let written = line.to_string();
        let words: Vec<&str> = written.split_whitespace().collect();
        assert!(PolicyLine::parse(&words) == Ok(line));
    }
});
