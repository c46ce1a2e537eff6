//! What can be known to be wrong with a network before anything is started.

use super::{Link, Medium, Network};
use crate::net::LinkSpec;
use crate::net::keys::NodeKeys;
use crate::node::error::StartError;
use crate::platform;
use crate::settings::SettingError;
use crate::settings::network::{EXPECTED_WITHIN, HELLO_INTERVAL};
use blastema_core::net::routing::MTU_MIN;
use blastema_core::net::wire::advertisement::NEIGHBOURS_MAX;
use blastema_core::sorted::SortedMap;
use blastema_core::{NodeName, ObjectName};
use blastema_transports::EndpointError;
use std::collections::BTreeSet;

/// Every network and every neighbour there can be what it is said to be.
pub(in crate::node) fn check_networks(
    networks: &[Network],
    node: &NodeName,
    keys: Option<&NodeKeys>,
) -> Result<(), Vec<StartError>> {
    let (mut names, mut refused) = (BTreeSet::new(), Vec::new());
    for network in networks {
        if !names.insert(network.name()) {
            let text = format!(
                "two networks are called {}: give one of them another name",
                network.name()
            );
            refused.push(StartError::Network(text));
        }
        refused.extend(network.check(node, keys).err());
    }
    if !refused.is_empty() {
        return Err(refused);
    }
    let neighbours: BTreeSet<_> = networks.iter().flat_map(Network::neighbours).collect();
    if neighbours.len() > NEIGHBOURS_MAX {
        let text = format!(
            "{} neighbours are described, and a node has {NEIGHBOURS_MAX} at most: leave out those \
             that are reached over another one, or connect the nodes by Zenoh (the crate \
             blastema-zenoh, transports/zenoh)",
            neighbours.len()
        );
        return Err(StartError::Network(text).into());
    }
    let mut links = SortedMap::new();
    for network in networks {
        for link in network.link_names() {
            // Faults and tables know a link by its name alone.
            if let Some(other) = links.insert(link.clone(), network.name()) {
                let text = format!(
                    "two links are called {link}, on {other} and on {}: give one of them another \
                     name, by Link::named",
                    network.name()
                );
                return Err(StartError::Network(text).into());
            }
        }
    }
    Ok(())
}

/// So many files a node has open beside its connections: event loops, sockets, its logs.
const FILES_OF_NODE: usize = 32;

/// Strangers must not use up the files that connections of peers need.
pub(in crate::node) fn check_files(networks: &[Network]) -> Result<(), StartError> {
    let strangers = |network: &Network| match &network.medium {
        Medium::At(endpoint) => endpoint.strangers(),
        _ => 0,
    };
    let listening = networks.iter().filter(|network| strangers(network) > 0);
    let needed: usize = listening.map(|network| strangers(network) + network.links.len()).sum();
    let Some(left) = platform::files_left() else { return Ok(()) };
    if needed == 0 || needed + FILES_OF_NODE <= left {
        return Ok(());
    }
    Err(StartError::Network(format!(
        "this process may open {left} more files, and its networks and the node need {}: raise the \
         limit (`ulimit -n`, or `LimitNOFILE=` of a systemd service), or set `strangers` of the \
         endpoints lower",
        needed + FILES_OF_NODE
    )))
}

impl Network {
    pub(in crate::node) fn name(&self) -> &str {
        &self.name
    }

    /// Whom its links lead to.
    pub(in crate::node) fn neighbours(&self) -> impl Iterator<Item = &str> {
        self.links.iter().map(|link| link.neighbour.as_str())
    }

    /// The nodes that it names: its neighbours, and those that are discovered.
    pub(in crate::node) fn named_nodes(&self) -> impl Iterator<Item = &str> {
        let admitted = self.discovery.iter().filter_map(|discovery| discovery.nodes.as_ref());
        self.neighbours().chain(admitted.flatten().map(String::as_str))
    }

    /// What people call its links.
    pub fn link_names(&self) -> impl Iterator<Item = String> {
        self.links.iter().map(|link| self.link_name(link))
    }

    /// What people call one of its links.
    pub(super) fn link_name(&self, link: &Link) -> String {
        let usual = || match self.links.len() {
            1 => self.name.clone(),
            _ => format!("{}/{}", self.name, link.neighbour),
        };
        link.name.clone().unwrap_or_else(usual)
    }

    /// The name of an object of this network.
    pub(super) fn object(&self, kind: &str) -> Result<ObjectName, StartError> {
        let object = ObjectName::new(&format!("{kind}/{}", self.name));
        object.map_err(StartError::name_of(format!("the name of network {:?}", self.name)))
    }

    pub(super) fn link_specs(&self) -> Result<Vec<LinkSpec>, StartError> {
        let mut remotes = BTreeSet::new();
        let spec = |link: &Link| {
            let of = format!("the name of a neighbour on network {}", self.name);
            let neighbour = NodeName::new(&link.neighbour).map_err(StartError::name_of(of))?;
            let remote = self.medium.remote(&link.address);
            let remote = remote.map_err(|error| self.endpoint_error(Some(&neighbour), error))?;
            if !remotes.insert(remote.clone()) {
                return Err(StartError::Network(format!(
                    "two links of network {} lead to {remote}: leave one of them out",
                    self.name
                )));
            }
            Ok(LinkSpec {
                name: self.link_name(link).into(),
                remote,
                neighbour: Some(neighbour),
                cost: link.cost,
                hello_interval: link.hello_every,
                expected_within: link.expected_within,
            })
        };
        self.links.iter().map(spec).collect()
    }

    /// An address is wrong: our own, or that of a neighbour.
    pub(super) fn endpoint_error(
        &self,
        neighbour: Option<&NodeName>,
        error: EndpointError,
    ) -> StartError {
        let neighbour = neighbour.cloned();
        StartError::Endpoint { network: self.name.clone(), neighbour, error }
    }

    /// Finds what can be known to be wrong before anything is started.
    pub(in crate::node) fn check(
        &self,
        node: &NodeName,
        keys: Option<&NodeKeys>,
    ) -> Result<(), StartError> {
        let wrong = |what| Err(StartError::Network(format!("network {}: {what}", self.name)));
        if let Medium::Unreadable(error) = &self.medium {
            return Err(self.endpoint_error(None, error.clone()));
        }
        for link in &self.links {
            self.check_settings(link)?;
            if let Some(what) = self.link_fault(link, node) {
                return wrong(what);
            }
        }
        self.object("transport")?;
        self.link_specs()?;
        if let Some(discovery) = &self.discovery {
            discovery.beacons(self)?;
            discovery.admission(&self.name)?;
        }
        if let Some(keys) = keys.filter(|_| self.leaves_process()) {
            self.check_sealed(keys)?;
        }
        self.check_exposure(keys.is_some())
    }

    /// On a sealed network frames have room for the seal; each neighbour has a key, and one link.
    fn check_sealed(&self, keys: &NodeKeys) -> Result<(), StartError> {
        let seal = self.medium.seal_terms().profile.overhead();
        if let Some(mtu) = self.medium.set_mtu().filter(|mtu| *mtu < MTU_MIN + seal) {
            return Err(StartError::Network(format!(
                "network {}: of frames of {mtu} bytes a seal takes {seal}, which leaves too few: \
                 set mtu={} at least",
                self.name,
                MTU_MIN + seal
            )));
        }
        let mut neighbours = BTreeSet::new();
        for Link { neighbour, .. } in &self.links {
            let known = NodeName::new(neighbour).is_ok_and(|node| keys.key_of(&node).is_some());
            if !known {
                let (robot, serial) = (keys.robot(), keys.serial());
                return Err(StartError::Keys(format!(
                    "{neighbour}, a neighbour on network {}, is not in roster {serial} of {robot}: \
                     list it by `blastema keys add {neighbour}`, and copy the new roster here",
                    self.name
                )));
            }
            if !neighbours.insert(neighbour) {
                return Err(StartError::Network(format!(
                    "two links of network {} lead to {neighbour}: on a sealed network each \
                     neighbour has one; leave one out, or make it a network of its own",
                    self.name
                )));
            }
        }
        Ok(())
    }

    fn link_fault(&self, link: &Link, node: &NodeName) -> Option<String> {
        let Link { neighbour, name, .. } = link;
        if neighbour == node.as_str() {
            return Some(format!(
                "{neighbour} is this node itself, and no neighbour: write the neighbour's name, or \
                 leave the link out"
            ));
        }
        let is_empty = name.as_ref().is_some_and(String::is_empty);
        is_empty.then(|| format!("the link to {neighbour} has an empty name: leave named() out"))
    }

    fn check_settings(&self, link: &Link) -> Result<(), StartError> {
        let Link { neighbour, hello_every, expected_within, .. } = link;
        let refused = |SettingError { setting, value, cure }| {
            let (network, neighbour) = (self.name.clone(), neighbour.clone());
            Err(StartError::Link { network, neighbour, setting, value, cure })
        };
        // Over a link that costs nothing, two nodes may each take the other for the shorter way.
        if link.cost == Some(0) {
            let (value, cure) = ("0".to_owned(), "a link costs 1 at least");
            return refused(SettingError { setting: "cost", value, cure });
        }
        HELLO_INTERVAL.check(*hello_every).or_else(refused)?;
        if expected_within < hello_every {
            let value = format!("{expected_within:?}, less than its {hello_every:?}");
            return refused(EXPECTED_WITHIN.refuse(value, EXPECTED_WITHIN.cure));
        }
        Ok(())
    }
}
