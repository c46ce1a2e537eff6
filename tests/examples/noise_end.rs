//! One end of a handshake of the seals, for `tests/interop/run`: `noise_end SUITE ROLE` speaks
//! lines of hexadecimal digits on standard input and output. All its keys are fixed.
#![allow(clippy::print_stdout, reason = "standard output is the wire")]

use blastema_core::net::seal::cipher::HandshakeTerms;
use blastema_core::net::seal::{CipherSuite, NoiseCrypto, SealCrypto};
use bytes::BytesMut;
use std::fmt::Write;
use std::io::{BufRead, stdin};

fn key(number: u8) -> [u8; 32] {
    let mut key = [number; 32];
    key[0] = 1;
    key
}

fn say(bytes: &[u8]) {
    let mut line = String::new();
    bytes.iter().for_each(|byte| write!(line, "{byte:02x}").expect("a text takes it"));
    // Written at once: each line ends a buffer of standard output.
    println!("{line}");
}

fn hear() -> Vec<u8> {
    let line = stdin().lock().lines().next().expect("the other end speaks").expect("it is text");
    let digits = |at| u8::from_str_radix(&line[at..at + 2], 16).expect("a hexadecimal number");
    (0..line.len()).step_by(2).map(digits).collect()
}

fn main() {
    let [suite, role] = ["a suite", "a role"].map({
        let mut arguments = std::env::args().skip(1);
        move |what| arguments.next().expect(what)
    });
    let suite = match suite.as_str() {
        "AESGCM" => CipherSuite::AesGcm,
        _ => CipherSuite::ChaChaPoly,
    };
    let initiates = role == "initiator";
    let (own, other) = if initiates { (key(0x11), key(0x22)) } else { (key(0x22), key(0x11)) };
    let (crypto, peer) = (NoiseCrypto::new(own), NoiseCrypto::new(other).public_key());
    let terms = HandshakeTerms { suite, prologue: b"blastema link 2", peer: &peer };
    let message = || hear().try_into().expect("a message of a handshake");

    let keys = if initiates {
        let (mut handshake, init) =
            crypto.write_init(terms, [7; 32], b"hello from i").expect("the keys are good");
        say(&init);
        let (payload, keys) = crypto.read_answer(&mut handshake, &message()).expect("it agrees");
        assert_eq!(&payload, b"hello from r");
        keys
    } else {
        let (handshake, payload) =
            crypto.read_init(terms, [7; 32], &message()).expect("it has its key");
        assert_eq!(&payload, b"hello from i");
        let (answer, keys) =
            crypto.write_answer(handshake, b"hello from r").expect("the keys are good");
        say(&answer);
        keys
    };

    let mut cipher = crypto.cipher(suite, &keys);
    for nonce in [0, 1, 7, 4_000_000_000] {
        let mut frame = BytesMut::from(format!("rust {nonce}").as_bytes());
        cipher.seal(nonce, &mut frame, 0);
        say(&frame);
        let mut sealed = hear();
        let length = cipher.open(nonce, &mut sealed).expect("it is sealed with the same keys");
        assert_eq!(&sealed[..length], format!("python {nonce}").as_bytes());
    }
    say(b"ok");
}
