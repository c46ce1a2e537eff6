//! Links to discovered neighbours: created and removed while the node runs.

use super::LinksActor;
use crate::net::LinkSpec;
use crate::platform;
use crate::runtime::driver::MachineActor;
use actix::prelude::*;
use blastema_contract::link::LinkChanged;
use blastema_contract::transport::MediumAddress;
use blastema_core::NodeName;
use blastema_core::detection::LinkCondition;
use blastema_core::net::routing::{LinkHealth, LinkStatus};
use blastema_core::net::{LinkId, LinkState};
use tracing::debug;

/// What discovery must know of the links. A domain is a network, by its place
/// among those that discover.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) enum NeighbourChange {
    /// A link came up, or went down.
    Neighbour { domain: usize, node: NodeName, remote: MediumAddress, up: bool },
    /// The network is open at this port.
    Open { domain: usize, port: u16 },
}

/// Make a link.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct AddDiscoveredLink {
    pub(crate) number: LinkId,
    pub(crate) spec: LinkSpec,
}

/// Give up a link that was made.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct RemoveDiscoveredLink {
    pub(crate) number: LinkId,
}

/// Report every link again.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct ReportNeighbours;

impl LinksActor {
    /// Takes a link out that was not described.
    pub(super) fn remove(&mut self, number: LinkId) {
        if let Some(status) = self.reported.remove(&number) {
            let status = LinkStatus { health: LinkHealth::Down, ..status };
            let remote = self.remote(number);
            self.wiring.router_changes.do_send(LinkChanged { link: number, status, remote });
        }
        self.tell_monitor(number, LinkCondition::Forgotten);
        self.bundle.remove(number);
        self.forget_namesake(number);
        self.forget_key_in_use(number);
        self.specs.remove(&number);
        self.dialed_in.remove(&number);
    }

    /// Tells discovery whether a link is up, and with whom.
    pub(super) fn tell_discovery(&self, number: LinkId, state: LinkState) {
        let (Some((domain, discovery)), Some(spec)) =
            (&self.wiring.discovery, self.specs.get(&number))
        else {
            return;
        };
        let up = match state {
            LinkState::Up => true,
            LinkState::Down => false,
            LinkState::Connecting | LinkState::Suspect => return,
        };
        let peer = self.bundle.get(number).and_then(|link| link.neighbour());
        let node = peer.map(|peer| peer.node.clone()).or(spec.neighbour.clone());
        if let Some(node) = node {
            let (domain, remote) = (*domain, spec.remote.clone());
            discovery.do_send(NeighbourChange::Neighbour { domain, node, remote, up });
        }
    }

    /// Tells at which port we can be found.
    pub(super) fn tell_port(&self, local: &MediumAddress) {
        if let (Some((domain, discovery)), MediumAddress::Ip(local)) =
            (&self.wiring.discovery, local)
        {
            discovery.do_send(NeighbourChange::Open { domain: *domain, port: local.port() });
        }
    }
}

impl Handler<AddDiscoveredLink> for LinksActor {
    type Result = ();

    fn handle(
        &mut self,
        AddDiscoveredLink { number, spec }: AddDiscoveredLink,
        context: &mut Context<Self>,
    ) {
        // Where a link leads already, none is needed.
        if self.bundle.link_at(&spec.remote).is_some() {
            return;
        }
        match self.insert(number, &spec, platform::now()) {
            Ok(()) => {
                self.specs.insert(number, spec);
            }
            // Another address of a node that has a link here, or a node without a key.
            Err(error) => debug!(network = %self.wiring.network, link = %spec.name, "{error}"),
        }
        self.drive(context);
    }
}

impl Handler<RemoveDiscoveredLink> for LinksActor {
    type Result = ();

    fn handle(
        &mut self,
        RemoveDiscoveredLink { number }: RemoveDiscoveredLink,
        context: &mut Context<Self>,
    ) {
        self.remove(number);
        self.drive(context);
    }
}

impl Handler<ReportNeighbours> for LinksActor {
    type Result = ();

    fn handle(&mut self, _: ReportNeighbours, _: &mut Context<Self>) {
        for (number, link) in self.bundle.iter() {
            self.tell_discovery(number, link.state());
        }
    }
}
