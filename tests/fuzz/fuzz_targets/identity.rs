//! Whatever contract a peer claims to hold: no panic, and a verdict of bounded length.

#![no_main]

use blastema_core::{ContractIdentity, PeerIdentity};
use blastema_macros::{Request, Structure};
use libfuzzer_sys::fuzz_target;

mod facade {
    pub(crate) use blastema_core::{self as core, serde};
}

#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate::facade")]
enum Tree {
    Leaf,
    Many { children: Vec<Tree>, name: String },
}

#[derive(Debug, Request)]
#[contract(name = "plan", reply = Option<Tree>, crate = "crate::facade")]
struct Plan {
    tree: Tree,
    #[contract(unit = "m", frame = "map")]
    goal: [f64; 2],
}

fuzz_target!(|bytes: &[u8]| {
    let Ok(peer) = PeerIdentity::decode(bytes) else { return };
    assert_eq!(PeerIdentity::decode(&peer.encode()).as_ref(), Ok(&peer));
    if let Err(difference) = ContractIdentity::of::<Plan>().check(&peer) {
        let shown = difference.to_string();
        assert!(!shown.is_empty() && shown.len() < 32 * 1024, "{} bytes", shown.len());
    }
});
