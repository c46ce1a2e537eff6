//! The number by which a session knows what is meant for it.

use super::SessionConfig;
use crate::net::node_id::NodeId;

/// A tag that no other session of this node with this peer has, as far as 32 bits can tell.
pub(crate) fn tag(config: &SessionConfig, number: u32) -> u32 {
    let names = u64::from(NodeId::of(&config.node).0) << 32 | u64::from(NodeId::of(&config.peer).0);
    let mixed = [names, config.incarnation.0, number.into()]
        .into_iter()
        .fold(0, |state: u64, word| mix(state ^ word));
    // 0 stands for "not known" in the handshake.
    (mixed as u32).max(1)
}

/// The finaliser of SplitMix64: every bit of the input changes half of the output's.
fn mix(mut word: u64) -> u64 {
    word = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ (word >> 31)
}
