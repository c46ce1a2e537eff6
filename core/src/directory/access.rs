//! Which nodes may claim which names and publish on which topics, by the policy of the robot.
//!
//! What a node may not claim is remembered of it, so that both agree on what it has told, and does
//! not count.

use super::types::{ClaimRefused, DirectoryOutput};
use super::{Directory, DirectoryKey, NameClaim};
use crate::net::NodeId;
use crate::net::trust::access::{AccessDenied, AccessPolicy};
use crate::net::trust::policy::Verb;
use crate::{Instant, NodeName, ObjectName};

impl Directory {
    /// From now on this policy counts, for what is claimed already as well.
    pub fn handle_access(&mut self, policy: AccessPolicy, now: Instant) {
        self.access = Some(policy);
        let mut names: Vec<_> = self.own.keys().cloned().collect();
        for name in &names {
            let node = self.config.node.clone();
            if let Err(denied) = self.may_claim(&node, name) {
                self.handle_withdrawn(name);
                let (name, refused) = (name.clone(), ClaimRefused::from(&*denied));
                self.outputs.push_back(DirectoryOutput::Refused { name, refused });
            }
        }
        let told = self.peers.iter().flat_map(|(node, peer)| {
            peer.records.iter().map(|(key, claim)| (node.clone(), key.clone(), claim.clone()))
        });
        let told: Vec<_> = told.collect();
        for (node, key, claim) in told {
            match key {
                DirectoryKey::Name(name) => {
                    self.believe(&node, &name, claim);
                    names.push(name);
                }
                DirectoryKey::Object(_) => {}
                DirectoryKey::Publisher { .. } => self.show_record(&node, key),
            }
        }
        names.iter().for_each(|name| self.look_at(name, now));
    }

    /// A claim that a node has told of counts, if the node may claim the name.
    pub(super) fn believe(&mut self, node: &NodeName, name: &ObjectName, claim: NameClaim) {
        match self.may_claim(node, name) {
            Ok(()) => {
                self.last_epoch = self.last_epoch.max(claim.epoch.unwrap_or_default());
                self.known.entry(name.clone()).or_default().insert(node.clone(), claim);
            }
            Err(denied) => {
                self.disbelieve(node, name);
                self.outputs.push_back(DirectoryOutput::AccessDenied { denied });
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

    /// A node has told of an object, or of a publisher, which counts if it may publish there.
    pub(super) fn show_record(&mut self, node: &NodeName, key: DirectoryKey) {
        let may_publish = |policy: &AccessPolicy| match &key {
            DirectoryKey::Publisher { topic, contract } => {
                let node = NodeId::of(node);
                policy.check(node, Verb::Publish, topic.as_str(), contract).is_ok()
            }
            DirectoryKey::Object(_) | DirectoryKey::Name(_) => true,
        };
        let counts = self.access.as_ref().is_none_or(may_publish);
        let node = node.clone();
        self.outputs.push_back(match counts {
            true => DirectoryOutput::RecordAdded { node, key },
            false => DirectoryOutput::RecordRemoved { node, key },
        });
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
