//! The tag by which a session recognises its segments.

use super::SessionConfig;
use crate::net::wire::node_id::NodeId;
use crate::random::Random;

/// A tag that no other session of this node with this peer has, as far as 32 bits can tell, and
/// that follows from the configured seed.
pub(crate) fn tag(config: &SessionConfig, number: u32) -> u32 {
    let names = u64::from(NodeId::of(&config.node).0) << 32 | u64::from(NodeId::of(&config.peer).0);
    let mixed = [names, config.incarnation.0, number.into()]
        .into_iter()
        .fold(config.seed, |state: u64, word| Random::new(state ^ word).next());
    // 0 stands for "not known" in the handshake.
    (mixed as u32).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Incarnation, NodeName};
    use std::collections::BTreeSet;

    #[test]
    fn tags_follow_from_the_seed_and_differ_from_session_to_session() {
        let name = |text| NodeName::new(text).unwrap();
        let tags: BTreeSet<u32> = (0..100)
            .flat_map(|seed| {
                let own = SessionConfig::new(name("left"), Incarnation(1), name("right"));
                let config = SessionConfig { seed, ..own };
                (0..10).map(move |number| tag(&config, number))
            })
            .collect();

        assert_eq!(tags.len(), 1_000);
        assert!(!tags.contains(&0));
    }
}
