//! Global names: who claims and who holds them.
//!
//! The policy of the robot says which nodes may claim which names and publish on which topics. What
//! a node may not claim is remembered of it, so that both agree on what it has told, and does not
//! count.

use super::types::{ClaimRefused, ClaimRequest, NameClaim, NameHeld};
use super::{
    CLAIMS_MAX, ClaimPolicy, Directory, DirectoryKey, DirectoryOutput, Holder, Reachability,
};
use crate::net::NodeId;
use crate::net::trust::access::{AccessDenied, AccessPolicy};
use crate::net::trust::policy::Verb;
use crate::sorted::SortedMap;
use crate::{Incarnation, Instant, NodeName, ObjectName};

/// Epochs are below it.
pub(super) const EPOCH_MAX: u64 = 1 << 62;
/// The greatest epoch that an incarnation begins with: the milliseconds of its clock times 2^16,
/// until the year 2527.
const EPOCH_OF_CLOCKS: u64 = 1 << 60;

/// A claim of this node.
#[derive(Debug)]
pub(super) struct OwnClaim {
    pub(super) object: ObjectName,
    pub(super) policy: ClaimPolicy,
    pub(super) epoch: Option<u64>,
    /// When this node takes the name, which has no holder.
    pub(super) take_at: Option<Instant>,
}

impl OwnClaim {
    fn waiting(object: ObjectName, policy: ClaimPolicy) -> Self {
        OwnClaim { object, policy, epoch: None, take_at: None }
    }

    fn told_of(&self, name: &ObjectName) -> NameClaim {
        let object = (self.object != *name).then(|| self.object.clone());
        NameClaim { epoch: self.epoch, object }
    }
}

/// The epoch before the first of this incarnation.
pub(super) fn first_epoch(incarnation: Incarnation) -> u64 {
    incarnation.0.saturating_mul(1 << 16).min(EPOCH_OF_CLOCKS)
}

impl Directory {
    /// Who holds a name, here or elsewhere.
    pub fn holder(&self, name: &ObjectName) -> Option<Holder> {
        let own = self.own.get(name).and_then(|own| Some((own.epoch?, &own.object)));
        let own = own.map(|(epoch, object)| (&self.config.node, epoch, Some(object)));
        let others = self.known.get(name).into_iter().flatten();
        let others =
            others.filter_map(|(node, claim)| Some((node, claim.epoch?, claim.object.as_ref())));
        let first = others.chain(own).reduce(|a, b| {
            // Of equal ones the first by name.
            if (b.1, a.0) > (a.1, b.0) { b } else { a }
        });
        first.map(|(node, epoch, object)| Holder {
            node: node.clone(),
            object: object.unwrap_or(name).clone(),
            epoch,
        })
    }

    /// How many names are known to be held, here and elsewhere.
    pub fn held(&self) -> usize {
        self.shown.len()
    }

    /// Whether an object here claims a name: it holds it, stands by or waits.
    pub fn is_claimed_here(&self, name: &ObjectName) -> bool {
        self.own.contains_key(name)
    }

    /// An object here claims a name. Answers the epoch, or nothing where it stands by, or has to
    /// wait: it is told later then.
    ///
    /// # Errors
    /// [`ClaimRefused`] where another claimant holds it and the policy is to be refused, and where
    /// this node may not claim it.
    pub fn handle_claim(
        &mut self,
        wanted: ClaimRequest,
        now: Instant,
    ) -> Result<Option<u64>, ClaimRefused> {
        let ClaimRequest { name, object, policy } = wanted;
        self.may_claim(&self.config.node, &name).map_err(|denied| ClaimRefused::from(&*denied))?;
        if self.own.len() >= CLAIMS_MAX && !self.own.contains_key(&name) {
            return Err(ClaimRefused::TooMany { limit: CLAIMS_MAX });
        }
        if let Some(OwnClaim { epoch: Some(epoch), .. }) = self.own.get(&name) {
            return Ok(Some(*epoch));
        }
        match (self.holder(&name), policy) {
            (Some(Holder { node: holder, epoch, .. }), ClaimPolicy::Refuse) => {
                Err(NameHeld { name, holder, epoch }.into())
            }
            (holder, _) => {
                self.set_own(&name, Some(OwnClaim::waiting(object, policy)), now);
                if holder.is_none() && self.settles.is_none() {
                    return Ok(self.take(&name, now));
                }
                self.look_at(&name, now);
                Ok(None)
            }
        }
    }

    /// An object here gives a name back, or stands by no more.
    pub fn handle_withdrawn(&mut self, name: &ObjectName, now: Instant) {
        self.set_own(name, None, now);
    }

    /// Something new is known of a name: it is shown, and may concern us.
    pub(super) fn look_at(&mut self, name: &ObjectName, now: Instant) {
        let holder = self.holder(name);
        self.show(name, holder.clone(), now);
        let Some(own) = self.own.get_mut(name) else { return };
        let (policy, ours) = (own.policy, own.epoch);
        match (holder, ours) {
            (Some(Holder { node, epoch, .. }), Some(_)) if node != self.config.node => {
                let object = own.object.clone();
                let stands_by = policy == ClaimPolicy::Standby;
                self.set_own(name, stands_by.then_some(OwnClaim::waiting(object, policy)), now);
                let (name, to) = (name.clone(), node);
                self.outputs.push_back(DirectoryOutput::Lost { name, to, epoch, stands_by });
            }
            (Some(Holder { node: holder, epoch, .. }), None) if policy == ClaimPolicy::Refuse => {
                self.handle_withdrawn(name, now);
                let refused = NameHeld { name: name.clone(), holder, epoch }.into();
                let name = name.clone();
                self.outputs.push_back(DirectoryOutput::Refused { name, refused });
            }
            (Some(_), Some(_)) => {}
            (Some(_), None) => {
                own.take_at = None;
                self.outputs.push_back(DirectoryOutput::StandsBy { name: name.clone() });
            }
            (None, _) if self.settles.is_some() || own.take_at.is_some() => {}
            (None, _) => {
                // Those before us by name have their turn first.
                let others = self.known.get(name).into_iter().flat_map(SortedMap::keys);
                let before = others.filter(|node| **node < self.config.node).count();
                let turns = u32::try_from(before).unwrap_or(u32::MAX);
                own.take_at = Some(now + (self.config.lease / 4).saturating_mul(turns));
            }
        }
    }

    fn show(&mut self, name: &ObjectName, holder: Option<Holder>, now: Instant) {
        if self.shown.get(name).map(|(shown, _)| shown) == holder.as_ref() {
            return;
        }
        match &holder {
            Some(holder) => drop(self.shown.insert(name.clone(), (holder.clone(), now))),
            None => drop(self.shown.remove(name)),
        }
        self.outputs.push_back(DirectoryOutput::Held { name: name.clone(), holder });
    }

    /// The others have been heard: waiting claims are granted, if the name has no holder.
    pub(super) fn settle(&mut self, now: Instant) {
        if self.settles.take().is_some() {
            let waiting = self.own.iter().filter(|(_, own)| own.epoch.is_none());
            let waiting: Vec<_> = waiting.map(|(name, _)| name.clone()).collect();
            waiting.iter().for_each(|name| self.look_at(name, now));
        }
    }

    /// Takes a name that is wanted here and that has no holder.
    pub(super) fn take(&mut self, name: &ObjectName, now: Instant) -> Option<u64> {
        let OwnClaim { object, policy, .. } = self.own.get(name)?;
        let (object, policy) = (object.clone(), *policy);
        self.last_epoch = (self.last_epoch + 1).min(EPOCH_MAX - 1);
        let epoch = self.last_epoch;
        let granted = OwnClaim { object, policy, epoch: Some(epoch), take_at: None };
        self.set_own(name, Some(granted), now);
        self.outputs.push_back(DirectoryOutput::Granted { name: name.clone(), epoch });
        Some(epoch)
    }

    /// Changes a claim of ours, and tells all nodes.
    pub(super) fn set_own(&mut self, name: &ObjectName, own: Option<OwnClaim>, now: Instant) {
        let told = own.as_ref().map(|own| own.told_of(name));
        match own {
            Some(own) => drop(self.own.insert(name.clone(), own)),
            None => drop(self.own.remove(name)),
        }
        self.record(vec![(DirectoryKey::Name(name.clone()), told)]);
        self.show(name, self.holder(name), now);
    }

    /// From now on this policy counts, for what is claimed already as well.
    pub fn handle_access(&mut self, policy: AccessPolicy, now: Instant) {
        self.access = Some(policy);
        let mut names: Vec<_> = self.own.keys().cloned().collect();
        for name in &names {
            let node = self.config.node.clone();
            if let Err(denied) = self.may_claim(&node, name) {
                self.handle_withdrawn(name, now);
                let (name, refused) = (name.clone(), ClaimRefused::from(&*denied));
                self.outputs.push_back(DirectoryOutput::Refused { name, refused });
            }
        }
        let peers = self.peers.iter().filter(|(_, peer)| peer.reachability != Reachability::Gone);
        let told = peers.flat_map(|(node, peer)| {
            peer.records.iter().map(|(key, claim)| (node.clone(), key.clone(), claim.clone()))
        });
        let told: Vec<_> = told.collect();
        for (node, key, claim) in told {
            if let DirectoryKey::Name(name) = key {
                self.believe(&node, &name, claim);
                names.push(name);
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

    /// Whether a node has what it has told: not a publisher where it may not publish.
    pub(super) fn has(&self, node: &NodeName, key: &DirectoryKey) -> bool {
        let DirectoryKey::Publisher { topic, contract } = key else { return true };
        let node = NodeId::of(node);
        self.access.as_ref().is_none_or(|policy| {
            policy.check(node, Verb::Publish, topic.as_str(), contract).is_ok()
        })
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
