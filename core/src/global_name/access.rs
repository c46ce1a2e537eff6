//! Which nodes may claim which names, by the policy of the robot.
//!
//! What a node may not claim is remembered of it, so that both agree on what it has told, and does
//! not count.

use super::types::{ClaimRefused, GlobalNamesOutput};
use super::{EPOCH_OF_CLOCKS, EPOCH_STEP, GlobalNames, NameClaim};
use crate::net::NodeId;
use crate::net::trust::access::{AccessDenied, AccessPolicy};
use crate::net::trust::policy::Verb;
use crate::{Instant, NodeName, ObjectName};

impl GlobalNames {
    /// From now on this policy counts, for what is claimed already as well.
    pub fn handle_access(&mut self, policy: AccessPolicy, now: Instant) {
        self.access = Some(policy);
        let mut names: Vec<_> = self.own.keys().cloned().collect();
        for name in &names {
            let node = self.config.node.clone();
            if let Err(denied) = self.may_claim(&node, name) {
                self.handle_withdrawn(name);
                let (name, refused) = (name.clone(), ClaimRefused::from(&*denied));
                self.outputs.push_back(GlobalNamesOutput::Refused { name, refused });
            }
        }
        let told = self.peers.iter().flat_map(|(node, peer)| {
            peer.claims.iter().map(|(name, claim)| (node.clone(), name.clone(), claim.clone()))
        });
        let told: Vec<_> = told.collect();
        for (node, name, claim) in told {
            self.believe(&node, &name, claim);
            names.push(name);
        }
        names.iter().for_each(|name| self.look_at(name, now));
    }

    /// A claim that a node has told of counts, if the node may claim the name.
    pub(super) fn believe(&mut self, node: &NodeName, name: &ObjectName, claim: NameClaim) {
        match self.may_claim(node, name) {
            Ok(()) => {
                let bound = self.last_epoch.max(EPOCH_OF_CLOCKS).saturating_add(EPOCH_STEP);
                let epoch = claim.epoch.unwrap_or_default().min(bound);
                self.last_epoch = self.last_epoch.max(epoch);
                self.known.entry(name.clone()).or_default().insert(node.clone(), claim);
            }
            Err(denied) => {
                self.disbelieve(node, name);
                self.outputs.push_back(GlobalNamesOutput::AccessDenied { denied });
            }
        }
    }

    /// The node claims the name no more.
    pub(super) fn disbelieve(&mut self, node: &NodeName, name: &ObjectName) {
        if let Some(claimants) = self.known.get_mut(name) {
            claimants.remove(node);
            if claimants.is_empty() {
                self.known.remove(name);
            }
        }
    }

    /// Whether a node, this one or another, may claim a name.
    pub(super) fn may_claim(
        &self,
        node: &NodeName,
        name: &ObjectName,
    ) -> Result<(), Box<AccessDenied>> {
        let Some(policy) = &self.access else { return Ok(()) };
        policy.check(NodeId::of(node), Verb::Claim, name.as_str(), "")
    }
}

impl From<&AccessDenied> for ClaimRefused {
    fn from(denied: &AccessDenied) -> Self {
        ClaimRefused::Forbidden {
            name: denied.object.clone(),
            node: denied.peer.clone(),
            serial: denied.serial,
        }
    }
}
