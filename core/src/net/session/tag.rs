//! The tag by which a session recognises its segments.

use super::SessionConfig;
use crate::net::wire::node_id::NodeId;
use crate::random::Random;

/// A tag that no other session of this node with this peer has, as far as 32 bits can tell.
pub(crate) fn tag(config: &SessionConfig, number: u32) -> u32 {
    let names = u64::from(NodeId::of(&config.node).0) << 32 | u64::from(NodeId::of(&config.peer).0);
    let mixed = [names, config.incarnation.0, number.into()]
        .into_iter()
        .fold(0, |state: u64, word| Random::new(state ^ word).next());
    // 0 stands for "not known" in the handshake.
    (mixed as u32).max(1)
}
