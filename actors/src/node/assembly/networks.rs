//! The networks of a node: what stands on its media, and how that is led to the fault chain.

use super::chain::FaultChain;
use super::{KeptObject, NodeAssembly, named};
use crate::component::spec_error::SpecError;
use crate::directory::DirectoryTable;
use crate::directory::actor::{DirectoryActor, DirectorySetup};
use crate::fault_chain::strategy::NetworkOrders;
use crate::net::{self, DirectoryLine, NetEnvironment, NetHandle, NetReports};
use crate::node::Shared;
use crate::node::controller::SubscribeSafeState;
use crate::node::error::StartError;
use crate::node::network::description::NetworkDescription;
use crate::node::network::start::StartedNetwork;
use crate::node::network::{Cable, NetworkRow};
use crate::service::Roster;
use crate::service::{Carried, ReplicaActor, ServiceRefused};
use crate::topic::Topics;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::notifier::AddPort;
use blastema_contract::reports::FaultDeclared;
use blastema_contract::transport::Close;
use blastema_core::detection::{NodeCondition, RecovererPort};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, NodeName};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

/// The networks of a node that runs.
pub(in crate::node) struct Networks {
    pub(in crate::node) handle: NetHandle,
    pub(in crate::node) cables: SortedMap<String, Cable>,
    pub(in crate::node) rows: Vec<NetworkRow>,
    /// What is unsafe about where the keys lie.
    danger: Option<String>,
    transports: Vec<Recipient<Close>>,
    pub(super) arbiter: Option<ArbiterHandle>,
    /// The nodes that the description names.
    pub(super) described: BTreeSet<NodeName>,
    /// The links that the description names; those that begin as one that ends at `/` may come by
    /// themselves.
    pub(super) links: Vec<String>,
    /// How long a channel may be silent over the slowest of the media.
    pub(super) silence: Duration,
}

/// How long a node that ends waits until its peers have what was sent to them. One that is gone
/// must not keep it.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(1);
/// How often it looks whether they have.
const LEAVE_POLL_INTERVAL: Duration = Duration::from_millis(5);

impl Networks {
    /// Whether this node has met another, was told of it, or has heard what others say of it.
    pub(in crate::node) fn know(&self, node: &NodeName) -> bool {
        self.described.contains(node) || self.handle.knows(node)
    }

    /// All whom it has met, or was told of.
    pub(in crate::node) fn known(&self) -> BTreeSet<NodeName> {
        self.described.iter().cloned().chain(self.handle.met()).collect()
    }

    /// Delivers what was sent, and ends every session.
    pub(in crate::node) async fn leave(&self) {
        self.handle.leave();
        let gone = async {
            while self
                .handle
                .read_sessions()
                .await
                .iter()
                .any(|row| row.status.incarnation.is_some())
            {
                tokio::time::sleep(LEAVE_POLL_INTERVAL).await;
            }
        };
        // Whatever is left after that is lost with the peers.
        let _ = tokio::time::timeout(LEAVE_TIMEOUT, gone).await;
    }

    pub(in crate::node) fn stop(&self) {
        // On an arbiter that others use too, links would go on saying that the node lives.
        self.transports.iter().for_each(|transport| transport.do_send(Close));
        self.handle.stop();
        if let Some(arbiter) = &self.arbiter {
            arbiter.stop();
        }
    }
}

impl NodeAssembly {
    /// What a node without networks claims, it claims of itself.
    pub(super) fn start_networks(
        &mut self,
        description: &mut NetworkDescription,
    ) -> Result<(), StartError> {
        let chain = &self.node.chain;
        if description.networks.is_empty() {
            let setup = directory_setup(&self.node);
            let directory = DirectoryActor::start(setup, &chain.guardian, chain.arbiter.as_ref());
            return self.keep(named("net/directory"), Some(directory.pings));
        }
        let arbiter = self.placement.own_arbiter()?;
        let mut transports = Vec::new();
        let made = make_networks(description, arbiter.clone(), &mut transports, &self.node);
        let (networks, kept) = made.inspect_err(|_| {
            transports.iter().for_each(|transport| transport.do_send(Close));
            if let Some(arbiter) = &arbiter {
                arbiter.stop();
            }
        })?;
        self.node.networks = Some(networks);
        kept.into_iter().try_for_each(|(name, pings)| self.keep(name, pings))
    }

    /// The faults of insecure networks and of keys that others may read stand from the start of the
    /// node to its end.
    pub(super) fn declare_insecure_networks(&self) {
        let rows = self.node.networks.iter().flat_map(|networks| &networks.rows);
        let danger = self.node.networks.iter().filter_map(|networks| networks.danger.clone());
        let of_keys = danger.map(|detail| FaultDeclared {
            object: named("net/roster"),
            incarnation: Incarnation::FIRST,
            kind: FaultKind::Insecure,
            detail,
            hold: None,
        });
        let faults = rows.filter_map(NetworkRow::fault).chain(of_keys);
        faults.for_each(|fault| self.node.chain.monitor.do_send(fault));
    }

    pub(super) fn carry_services(
        &mut self,
        services: Vec<Result<Carried, ServiceRefused>>,
    ) -> Result<(), StartError> {
        let services: Vec<_> = services.into_iter().collect::<Result<_, _>>()?;
        for carried in services {
            let name = carried.actor.clone();
            let roster = self.node.environment.feature::<Roster>();
            roster.enter(carried.name.clone(), &carried.config);
            let place = self.node.networks.as_ref().and_then(|networks| networks.arbiter.as_ref());
            let Shared { chain, environment, .. } = &self.node;
            let place = place.or(chain.arbiter.as_ref());
            let monitored = ReplicaActor::start(carried, environment, &chain.guardian, place);
            let monitored = monitored.map_err(SpecError::from)?;
            self.keep(name, Some(monitored))?;
        }
        Ok(())
    }
}

/// Starts transports, links and the stack above them, and connects them to the fault chain.
fn make_networks(
    description: &mut NetworkDescription,
    arbiter: Option<ArbiterHandle>,
    transports: &mut Vec<Recipient<Close>>,
    node: &Shared,
) -> Result<(Networks, Vec<KeptObject>), StartError> {
    let Shared { chain, environment, .. } = node;
    let FaultChain { guardian, monitor, .. } = chain;
    let may_be_away = description.may_be_away.iter().filter_map(|node| NodeName::new(node).ok());
    let may_be_away: BTreeSet<_> = may_be_away.collect();
    for node in may_be_away.iter().cloned() {
        let (incarnation, condition) = (Incarnation::default(), NodeCondition::MayBeAway);
        monitor.do_send(NodeReported { node, incarnation, condition });
    }
    let described = description.named_nodes();
    let networks = std::mem::take(&mut description.networks);
    let (keys, session_timeout) = (description.keys.take(), description.session_timeout);
    let (mut specs, mut cables) = (Vec::new(), SortedMap::new());
    let (mut neighbours, mut kept) = (BTreeSet::new(), Vec::new());
    let has_keys = keys.is_some();
    let danger = keys.as_ref().and_then(|keys| keys.danger());
    let mut links = Vec::new();
    let rows: Vec<_> = networks.iter().map(|network| network.row(has_keys)).collect();
    rows.iter().for_each(NetworkRow::log);
    let silence = networks.iter().map(|network| network.medium_kind().timeout()).max();
    let silence = silence.unwrap_or_default();
    for network in networks {
        let started = StartedNetwork::start(network, has_keys, guardian, arbiter.as_ref())?;
        let beacons = started.spec.discovery.iter().map(|spec| &spec.beacons.0);
        let of_network = beacons.chain([&started.spec.transport]);
        transports.extend(of_network.map(|transport| transport.close.clone()));
        if let Some(cable) = started.cable {
            cables.insert(started.spec.name.to_string(), cable);
        }
        kept.extend(started.transports.into_iter().map(|name| (name, None)));
        neighbours.extend(started.spec.links.iter().filter_map(|link| link.neighbour.clone()));
        links.extend(started.spec.links.iter().map(|link| link.name.to_string()));
        if has_keys || started.spec.discovery.is_some() {
            links.push(format!("{}/", started.spec.name));
        }
        specs.push(started.spec);
    }
    if let Some(keys) = &keys {
        kept.push((named("net/roster"), None));
        environment.registry.access().replace(keys.access_policy());
    }
    let net_environment = NetEnvironment {
        node: node.name.clone(),
        incarnation: node.incarnation,
        guardian: guardian.clone(),
        arbiter: arbiter.clone(),
        registry: environment.registry.clone(),
        topics: environment.feature::<Topics>().clone(),
        dead_letters: environment.dead_letters.clone(),
        may_be_away,
        reports: NetReports {
            recoverer: Some(chain.recoverer.clone().recipient()),
            links: Some(monitor.clone().recipient()),
            stalls: Some(monitor.clone().recipient()),
            nodes: Some(monitor.clone().recipient()),
            declared: environment.reports.clone(),
        },
        session_timeout,
        directory: None,
        keys,
    };
    let slowest = specs.iter().flat_map(|spec| &spec.links).map(|link| link.hello_interval).max();
    let setup = directory_setup(node);
    let setup = DirectorySetup {
        settle: settling(slowest.unwrap_or_default()),
        expected: neighbours.iter().cloned().collect(),
        ..setup
    };
    let network = setup.network.clone();
    let directory = DirectoryActor::start(setup, guardian, arbiter.as_ref());
    kept.push((named("net/directory"), Some(directory.pings)));
    let directory = Some(DirectoryLine { reports: directory.reports, network });
    let net_environment = NetEnvironment { directory, ..net_environment };
    let handle = net::start(net_environment, specs);
    chain.controller.do_send(SubscribeSafeState(handle.safe_states()));
    kept.extend(handle.pings().into_iter().map(|(name, pings)| (name, Some(pings))));
    // The recipient is set once, here.
    let _ =
        chain.network.set(NetworkOrders { reroute: handle.reroute(), isolate: handle.isolation() });
    for neighbour in neighbours {
        let recover = handle.recoverer_of(&neighbour);
        let port = RecovererPort::Remote(neighbour);
        monitor.do_send(AddPort { port, recover, stand_down: None });
    }
    let transports = transports.clone();
    let networks =
        Networks { handle, cables, rows, danger, transports, arbiter, described, links, silence };
    Ok((networks, kept))
}

/// The setup of the directory for a node without a network.
fn directory_setup(node: &Shared) -> DirectorySetup {
    let Shared { name, incarnation, environment, .. } = node;
    DirectorySetup {
        node: name.clone(),
        incarnation: *incarnation,
        settle: Duration::ZERO,
        expected: Vec::new(),
        network: Arc::default(),
        registry: environment.registry.clone(),
        topics: environment.feature::<Topics>().clone(),
        names: environment.feature::<DirectoryTable>().clone(),
        reports: environment.reports.clone(),
    }
}

/// How long a node listens after its start before it grants itself a name, where hellos come so
/// often: a link that failed once lately is up after nine of them, and the rest is for sessions on
/// slow media.
fn settling(hello_interval: Duration) -> Duration {
    (hello_interval * 12 + Duration::from_millis(400)).min(Duration::from_secs(30))
}
