//! What each node advertises of its links.

use super::RouterConfig;
use crate::Instant;
use crate::net::wire::advertisement::{Advertisement, AdvertisementId};
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;

/// The newest advertisement of every node.
#[derive(Debug)]
pub(super) struct AdvertisementDatabase {
    pub(super) own: Advertisement,
    /// When our own links were announced last, and whether they have changed since.
    pub(super) announced_at: Instant,
    pub(super) has_news: bool,
    /// Those of other nodes.
    pub(super) known: SortedMap<NodeId, DatabaseEntry>,
}

#[derive(Debug)]
pub(super) struct DatabaseEntry {
    pub(super) advertisement: Advertisement,
    pub(super) expires: Instant,
}

impl AdvertisementDatabase {
    pub(super) fn new(config: &RouterConfig, now: Instant) -> Self {
        let origin = NodeId::of(&config.node);
        let sequence = AdvertisementId::first_sequence(config.incarnation) + 1;
        let own = Advertisement {
            id: AdvertisementId { origin, sequence },
            incarnation: config.incarnation,
            node: config.node.clone(),
            edges: Vec::new(),
            signature: None,
        };
        let known = SortedMap::new();
        AdvertisementDatabase { own, announced_at: now, has_news: false, known }
    }

    pub(super) fn id(&self) -> NodeId {
        self.own.id.origin
    }

    pub(super) fn advertisement(&self, origin: NodeId) -> Option<&Advertisement> {
        if origin == self.id() { Some(&self.own) } else { self.newest(origin) }
    }

    /// The same of another node.
    pub(super) fn newest(&self, origin: NodeId) -> Option<&Advertisement> {
        self.known.get(&origin).map(|known| &known.advertisement)
    }

    /// All of them, in order.
    pub(super) fn ids(&self) -> Vec<AdvertisementId> {
        let known = self.known.values().map(|known| known.advertisement.id);
        let mut ids: Vec<_> = known.chain([self.own.id]).collect();
        ids.sort();
        ids
    }

    pub(super) fn expires_at(&self) -> Option<Instant> {
        self.known.values().map(|known| known.expires).min()
    }

    /// Forgets what was not refreshed. Returns whether there was any.
    pub(super) fn expire(&mut self, now: Instant) -> bool {
        let before = self.known.len();
        self.known.retain(|_, known| known.expires > now);
        self.known.len() != before
    }
}
