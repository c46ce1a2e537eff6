//! A node's own keys, and the public ones of the robot's other nodes.

use super::own_incarnation;
use crate::platform;
use crate::platform::key_files::{folder_of, read_public, read_roster, read_secret};
use blastema_contract::transport::MediumAddress;
use blastema_core::net::routing::RouterKeys;
use blastema_core::net::seal::{NoiseCrypto, SealProfile, Sealer, SealerConfig};
use blastema_core::net::trust::access::AccessPolicy;
use blastema_core::net::trust::beacon::BeaconKeys;
use blastema_core::net::trust::key_file::KeyFile;
use blastema_core::net::trust::policy::Role;
use blastema_core::net::trust::roster::{NodeRoster, RosterOrder};
use blastema_core::net::{NeighbourKey, NodeId};
use blastema_core::{Incarnation, NodeName};
use bytes::Bytes;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use zeroize::Zeroizing;

/// The keys with which a node seals what it sends.
#[derive(Clone)]
pub(crate) struct NodeKeys {
    own: KeyFile,
    roster: NodeRoster,
    /// The roster's signed text.
    text: Bytes,
    path: PathBuf,
    permissions: KeysPermissions,
}

/// Whether keys and rosters that other users can read or change are refused.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum KeysPermissions {
    /// They are refused when the node starts, with the command that mends it.
    #[default]
    Checked,
    /// They are taken. For secrets that a container has mounted with permissions of its own. The
    /// fault `B25` says so for as long as the node runs.
    Unchecked,
}

/// The roster that a node uses, for display.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct RosterRow {
    /// The robot's name.
    pub robot: NodeName,
    /// Its serial number: of two rosters the one with the higher number counts.
    pub serial: u64,
    /// How many nodes it lists.
    pub nodes: usize,
}

/// How the frames of one network are sealed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SealTerms {
    pub(crate) profile: SealProfile,
    /// A sender on the medium can claim any address.
    pub(crate) forgeable_addresses: bool,
}

/// Why a roster does not count.
#[derive(Debug)]
pub(super) struct RosterRefusal {
    pub(super) reason: String,
    pub(super) kind: RefusalKind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RefusalKind {
    /// The file cannot be read. The node needs it when it starts again.
    Unreadable,
    /// The robot has not signed it.
    Unsigned,
    /// The robot has signed it, and this node cannot use it.
    Unusable,
}

impl NodeKeys {
    /// Reads the key of the node called `node` from this file, and the roster beside it.
    ///
    /// # Errors
    /// What is wrong, in which file, and what to do.
    pub(crate) fn read(
        file: &Path,
        node: &NodeName,
        permissions: KeysPermissions,
    ) -> Result<Self, String> {
        let is_checked = permissions == KeysPermissions::Checked;
        let own = KeyFile::parse(&if is_checked { read_secret(file) } else { read_public(file) }?);
        let own = own.map_err(|error| format!("{}: {error}", file.display()))?;
        if own.node != *node {
            return Err(format!(
                "{} is the key of {}, and this node is called {node}: copy {node}.key here",
                file.display(),
                own.node
            ));
        }
        let path = roster_path(file, &own.robot);
        let text = if is_checked { read_roster(&path) } else { read_public(&path) };
        let text = text.map_err(|error| match path.exists() {
            true => error,
            false => format!("{error}: copy {}.roster beside {}", own.robot, file.display()),
        })?;
        let roster = NodeRoster::parse_signed(&text, &own.signer)
            .map_err(|error| format!("{}: {error}", path.display()))?;
        // The number and the text are signed by the key that this file names.
        let (serial, robot) = (roster.serial, &roster.robot);
        if *robot != own.robot {
            return Err(format!(
                "{} is the roster of {robot}, and the key is of {}",
                path.display(),
                own.robot
            ));
        }
        match roster.node(node) {
            None => Err(format!(
                "{node} is not in roster {serial} of {robot} ({}): it was revoked, or added later than \
                 this file; copy the newest roster here",
                path.display()
            )),
            Some(listed) if listed.keys != own.seed.public_keys() => Err(format!(
                "{} is not the key that roster {serial} of {robot} lists for {node}: it was replaced; \
                 copy the newest {node}.key and {robot}.roster here",
                file.display()
            )),
            Some(_) => Ok(NodeKeys {
                own,
                roster,
                text: Bytes::copy_from_slice(text.as_bytes()),
                path,
                permissions,
            }),
        }
    }

    /// What is unsafe about where the keys lie.
    pub(crate) fn danger(&self) -> Option<String> {
        let secret = folder_of(&self.path).join(format!("{}.robot", self.own.robot));
        if secret.exists() {
            return Some(format!(
                "{} signs the roster, and lies on a node: who reads it commands the robot: move it \
                 to the computer of the robot's builder",
                secret.display()
            ));
        }
        (self.permissions == KeysPermissions::Unchecked).then(|| {
            format!(
                "other users may read or change the keys in {}: their permissions are unchecked",
                folder_of(&self.path).display()
            )
        })
    }

    /// The node's incarnation that starts now, above the one before it. It is kept beside the key.
    pub(crate) fn begin_incarnation(&self) -> Incarnation {
        let file = self.incarnation_path();
        own_incarnation::begin(&file, &self.own.node, platform::node_incarnation())
    }

    /// The file that keeps it.
    fn incarnation_path(&self) -> PathBuf {
        folder_of(&self.path).join(format!("{}.incarnation", self.own.node))
    }

    /// The file of the roster.
    pub(super) fn roster_path(&self) -> &Path {
        &self.path
    }

    /// The keys with the roster that the file holds now; `None` if it is the one that is known.
    ///
    /// # Errors
    /// It is refused, and why.
    pub(super) fn reread(&self) -> Result<Option<NodeKeys>, RosterRefusal> {
        let text = read_public(&self.path).map_err(|error| RosterRefusal {
            reason: format!(
                "{error}: copy the newest one there, without which this node does not start again"
            ),
            kind: RefusalKind::Unreadable,
        })?;
        self.newer(&text, &self.path.display().to_string())
    }

    /// The keys with this roster; `None` if it is the one that is known.
    ///
    /// # Errors
    /// It is refused, and why. `place` says where it was found.
    pub(super) fn newer(&self, text: &str, place: &str) -> Result<Option<NodeKeys>, RosterRefusal> {
        let roster = NodeRoster::parse_signed(text, &self.own.signer).map_err(|error| {
            RosterRefusal { reason: format!("{place}: {error}"), kind: RefusalKind::Unsigned }
        })?;
        let judged = self.judge(roster, text, place);
        judged.map_err(|reason| RosterRefusal { reason, kind: RefusalKind::Unusable })
    }

    fn judge(
        &self,
        roster: NodeRoster,
        text: &str,
        place: &str,
    ) -> Result<Option<NodeKeys>, String> {
        let (known, serial) = (self.serial(), roster.serial);
        let own = roster.node(&self.own.node).map(|listed| listed.keys);
        match self.roster.order_of(&roster) {
            RosterOrder::Same => Ok(None),
            RosterOrder::Older => Err(format!(
                "{place} has serial {serial}, and this node has seen {known}: copy the newest roster there"
            )),
            RosterOrder::Conflicting => Err(format!(
                "{place} differs from the roster that this node has, under the same serial {serial}: two \
                 copies of the robot's file were changed; use one of them"
            )),
            RosterOrder::Newer if own.is_none() => Err(format!(
                "{} is not in roster {serial} ({place}): it was revoked, and the other nodes refuse it",
                self.own.node
            )),
            RosterOrder::Newer if own != Some(self.own.seed.public_keys()) => Err(format!(
                "roster {serial} ({place}) lists another key for {0}, and the other nodes refuse the one \
                 that it has: copy the newest {0}.key here, and start the node again",
                self.own.node
            )),
            RosterOrder::Newer => {
                Ok(Some(NodeKeys { roster, text: text.to_owned().into(), ..self.clone() }))
            }
        }
    }

    /// Nodes of this roster that the other one does not list.
    pub(super) fn missing_in(&self, other: &NodeKeys) -> Vec<NodeName> {
        let listed = self.roster.nodes().iter().map(|node| &node.name);
        listed.filter(|node| other.roster.node(node).is_none()).cloned().collect()
    }

    /// The roster's signed text.
    pub(super) fn roster_text(&self) -> Bytes {
        self.text.clone()
    }

    /// The roster, for display.
    pub(super) fn row(&self) -> RosterRow {
        let NodeRoster { robot, serial, .. } = &self.roster;
        RosterRow { robot: robot.clone(), serial: *serial, nodes: self.roster.nodes().len() }
    }

    /// The robot's name.
    pub(crate) fn robot(&self) -> &NodeName {
        &self.roster.robot
    }

    /// The nodes of the roster.
    pub(crate) fn listed(&self) -> BTreeSet<NodeName> {
        self.roster.nodes().iter().map(|node| node.name.clone()).collect()
    }

    /// What the roster lets other nodes do here, and this one elsewhere.
    pub(crate) fn access_policy(&self) -> AccessPolicy {
        AccessPolicy::new(self.own.node.clone(), &self.roster)
    }

    /// The roster's serial number.
    pub(crate) fn serial(&self) -> u64 {
        self.roster.serial
    }

    /// The key of another node of the robot.
    pub(crate) fn key_of(&self, node: &NodeName) -> Option<NeighbourKey> {
        let listed = self.roster.node(node)?;
        Some(NeighbourKey { node: NodeId::of(node), public: *listed.keys.x25519.bytes() })
    }

    /// The keys for its beacons.
    pub(super) fn beacon_keys(&self) -> BeaconKeys {
        BeaconKeys::new(&self.own.seed, &self.roster, &self.own.node)
    }

    /// The fingerprint of this node's own keys.
    pub(super) fn fingerprint(&self) -> String {
        self.own.seed.public_keys().fingerprint().to_string()
    }

    /// The keys of the robot's operators, but for this node.
    pub(super) fn operators(&self) -> Vec<NeighbourKey> {
        let nodes = self.roster.nodes().iter();
        let operators = nodes.filter(|node| node.role == Role::Operator);
        let others = operators.filter(|node| node.name != self.own.node);
        others.filter_map(|node| self.key_of(&node.name)).collect()
    }

    /// The name of a node of the roster.
    pub(super) fn name_of(&self, peer: NodeId) -> Option<&NodeName> {
        let mut names = self.roster.nodes().iter().map(|node| &node.name);
        names.find(|name| NodeId::of(name) == peer)
    }

    /// A sealer for one network. Its counters begin at zero and its keys are new: one is made for
    /// each life of the links.
    ///
    /// # Panics
    /// When the system gives no random numbers, which it did when the node started.
    pub(crate) fn sealer(
        &self,
        incarnation: Incarnation,
        terms: SealTerms,
    ) -> Sealer<NoiseCrypto, MediumAddress> {
        let (config, random) = self.sealer_config(incarnation, terms);
        Sealer::new(config, self.own.seed.handshakes(), *random, platform::now())
    }

    /// Signatures and seals for a router, for each life of it.
    ///
    /// # Panics
    /// As [`sealer`](NodeKeys::sealer).
    pub(super) fn router_keys(&self, incarnation: Incarnation) -> RouterKeys {
        // A relay can put any source on a packet.
        let terms = SealTerms { profile: SealProfile::Full, forgeable_addresses: true };
        let (config, random) = self.sealer_config(incarnation, terms);
        RouterKeys::new(&self.own.seed, &self.roster, config, *random, platform::now())
    }

    /// The roster.
    pub(super) fn roster(&self) -> &NodeRoster {
        &self.roster
    }

    fn sealer_config(
        &self,
        incarnation: Incarnation,
        terms: SealTerms,
    ) -> (SealerConfig, Zeroizing<[u8; 32]>) {
        let SealTerms { profile, forgeable_addresses } = terms;
        let node = NodeId::of(&self.own.node);
        let config = SealerConfig {
            profile,
            fast_aes: platform::has_aes(),
            forgeable_addresses,
            ..SealerConfig::new(node, incarnation, self.robot().as_str())
        };
        let random = platform::random_bytes().expect("the system gave random numbers at the start");
        (config, random)
    }
}

fn roster_path(key: &Path, robot: &NodeName) -> PathBuf {
    folder_of(key).join(format!("{robot}.roster"))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use blastema_core::net::trust::crypto::Seed;
    use blastema_core::net::trust::policy::Role;
    use blastema_core::net::trust::roster::RosterNode;
    use std::fs::{self, Permissions};
    use std::os::unix::fs::PermissionsExt;

    fn name(text: &str) -> NodeName {
        NodeName::new(text).expect("a name")
    }

    /// The signed text of a roster of these nodes with these secrets.
    fn roster(nodes: &[(&str, u8)], serial: u64) -> String {
        let listed = nodes.iter().map(|(node, seed)| RosterNode {
            name: name(node),
            keys: Seed::new([*seed; 32]).public_keys(),
            role: Role::Node,
        });
        let mut roster = NodeRoster::new(name("ranger"), listed).expect("different nodes");
        roster.serial = serial;
        roster.sign(&Seed::new([9; 32]))
    }

    /// The keys of base, whose files are written into this folder.
    pub(in crate::net) fn written(folder: &Path) -> NodeKeys {
        let (key, list) = (folder.join("base.key"), folder.join("ranger.roster"));
        let signer = Seed::new([9; 32]).signer();
        let own =
            KeyFile { robot: name("ranger"), node: name("base"), seed: Seed::new([1; 32]), signer };
        fs::write(&key, own.to_text().as_bytes()).expect("a folder");
        fs::set_permissions(&key, Permissions::from_mode(0o600)).expect("it is ours");
        fs::write(&list, roster(&[("base", 1), ("arm", 2)], 5)).expect("a folder");
        fs::set_permissions(&list, Permissions::from_mode(0o644)).expect("it is ours");
        NodeKeys::read(&key, &name("base"), KeysPermissions::Checked).expect("they fit")
    }

    #[test]
    fn of_the_rosters_that_are_put_beside_a_key_only_a_newer_one_with_this_node_is_taken() {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = written(folder.path());
        let list = folder.path().join("ranger.roster");
        let reread = |text: &str| {
            fs::write(&list, text).expect("a folder");
            let reread = keys.reread().map_err(|refusal| refusal.reason);
            reread.map(|keys| keys.map(|keys| keys.serial()))
        };

        assert_eq!(reread(&roster(&[("base", 1), ("arm", 2)], 5)), Ok(None));
        assert_eq!(reread(&roster(&[("base", 1), ("arm", 3)], 6)), Ok(Some(6)));
        let refused = |text: &str, why: &str| {
            let error = reread(text).expect_err(why);
            assert!(error.contains(why), "{error}");
        };
        refused(&roster(&[("base", 1), ("arm", 2)], 4), "has seen 5");
        refused(&roster(&[("base", 1)], 5), "two copies");
        refused(&roster(&[("arm", 2)], 6), "it was revoked");
        refused(&roster(&[("base", 7)], 6), "another key for base");
        refused("blastema roster 1\n", "ranger.roster");
        let whole = roster(&[("base", 1)], 6);
        refused(&whole[..whole.len() / 2], "ranger.roster");
        fs::remove_file(&list).expect("it is there");
        let gone = keys.reread().map(|_| ()).expect_err("the file is gone").reason;
        assert!(gone.contains("ranger.roster") && gone.contains("does not start again"), "{gone}");
    }
}
