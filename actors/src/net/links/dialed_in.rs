//! Links to operators that come by themselves: no node describes where an operator is.

use super::LinksActor;
use crate::net::LinkSpec;
use blastema_contract::transport::MediumAddress;
use blastema_core::net::{HELLO_INTERVAL, LinkId, NodeId, PEER_TIMEOUT};
use tracing::{debug, info, warn};

/// So many operators have a link on one network that no node describes: one at work, and one whose
/// program has just ended.
pub(in crate::net) const DIALED_IN_MAX: usize = 2;

impl LinksActor {
    /// The operators of the roster are let in from wherever they come. Links that were made for
    /// some before the links were built again are gone with them.
    pub(super) fn let_operators_dial_in(&mut self) {
        let Some((keys, _)) = &self.wiring.seal else { return };
        if let Err(error) = self.bundle.set_dial_in(keys.operators()) {
            warn!(network = %self.wiring.network, "an operator cannot connect: {error}");
        }
    }

    /// An operator has proved itself and has no link here yet.
    pub(super) fn dialed_in(&mut self, peer: NodeId, address: MediumAddress) {
        let node = self.wiring.seal.as_ref().and_then(|(keys, _)| keys.name_of(peer).cloned());
        let Some(node) = node else { return };
        let number = self.wiring.dial_in.iter().find(|number| !self.specs.contains_key(*number));
        let Some(&number) = number else {
            debug!(network = %self.wiring.network, %node, "{DIALED_IN_MAX} operators are connected");
            return;
        };
        let spec = LinkSpec {
            name: format!("{}/{node}", self.wiring.network).into(),
            remote: address.clone(),
            neighbour: Some(node.clone()),
            cost: None,
            hello_interval: HELLO_INTERVAL,
            expected_within: PEER_TIMEOUT,
        };
        let now = crate::platform::now();
        let link = super::link(&self.wiring, &spec, now);
        if self.bundle.insert_dialed_in(number, link, (peer, address.clone()), now) {
            info!(network = %self.wiring.network, %node, %address, "an operator connects");
            self.specs.insert(number, spec);
            self.dialed_in.insert(number);
        } else {
            // It is told with each frame; a medium with connections needs the operator's address.
            debug!(network = %self.wiring.network, %node, %address, "no link to the operator");
        }
    }

    /// Forgets such links before the links are built again: operators connect again.
    pub(super) fn forget_dialed_in(&mut self) {
        let numbers: Vec<LinkId> = std::mem::take(&mut self.dialed_in).into_iter().collect();
        numbers.into_iter().for_each(|number| self.remove(number));
    }
}
