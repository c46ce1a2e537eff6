//! Whatever bytes arrive as a message or a reply: no panic, no memory beyond the contract's limit,
//! and what is taken survives being sent on.

#![no_main]

use blastema_core::Contract;
use blastema_core::contract::codec::{decode, decode_reply, encode, encode_bounded};
use blastema_macros::{Event, Request, Structure};
use libfuzzer_sys::fuzz_target;
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

mod facade {
    pub(crate) use blastema_core::{self as core, serde};
}

#[derive(Clone, Debug, Event)]
#[contract(name = "laser/scan", max_size = 4 * 1024, crate = "crate::facade")]
struct Scan {
    ranges: Vec<f32>,
    raw: Vec<u8>,
    covariance: [f64; 36],
    at: Duration,
}

#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate::facade")]
enum Tree {
    Leaf,
    Pair(Box<Tree>, Box<Tree>),
    Many { children: Vec<Tree>, name: String },
}

/// Holds every kind of thing that memory can be asked for.
#[derive(Debug, Request)]
#[contract(reply = Result<Vec<Tree>, String>, crate = "crate::facade")]
struct Plan {
    tree: Tree,
    names: BTreeMap<String, Vec<Option<u64>>>,
    queue: VecDeque<(u8, i16, u32, i64, bool, char)>,
    shared: (Arc<str>, Arc<[u16]>, Box<[u8]>),
}

fuzz_target!(|bytes: &[u8]| {
    let mut sent = Vec::new();
    if let Ok(scan) = decode::<Scan>(bytes) {
        encode(&scan, &mut sent).expect("what was taken can be sent on");
        let again: Scan = decode(&sent).expect("what is sent is taken");
        let mut twice = Vec::new();
        encode(&again, &mut twice).expect("what was taken can be sent on");
        assert_eq!(sent, twice);
    }
    sent.clear();
    if let Ok(plan) = decode::<Plan>(bytes) {
        encode(&plan, &mut sent).expect("what was taken can be sent on");
        decode::<Plan>(&sent).expect("what is sent is taken");
    }
    sent.clear();
    if let Ok(reply) = decode_reply::<Plan>(bytes) {
        encode_bounded(&reply, Plan::MAX_SIZE, &mut sent).expect("what was taken can be sent on");
        let _ = decode_reply::<Plan>(&sent).expect("what is sent is taken");
    }
});
