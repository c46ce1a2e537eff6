//! The router of this node, for the network's stack.

use super::keys::{NodeKeys, RosterRow};
use super::own_name::OwnName;
use crate::platform;
use crate::runtime::reports::FaultReporter;
use actix::prelude::*;
use blastema_contract::link::{AddLinks, LinkChanged, LinkPayload, TransmitOnLink};
use blastema_contract::monitor::NodeReported;
use blastema_contract::strategy::IsolateNode;
use blastema_core::detection::NodeCondition;
use blastema_core::net::wire::frame::NameHolder;
use blastema_core::net::{self, LinkId, NodeId, Peers, RouterConfig, RouterOutput};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, NodeName};
use std::sync::Arc;
use tokio::sync::oneshot;
use tracing::{error, info, warn};

/// The verdict on another way to a node.
pub(super) type Verdict = Result<RecoveryDone, RecoveryFailed>;

/// Forwards for this node.
pub(super) struct NodeRouter {
    pub(super) machine: net::Router,
    config: RouterConfig,
    carriers: SortedMap<LinkId, Recipient<TransmitOnLink>>,
    /// What the links have reported last: what a rebuilt machine is given.
    links: SortedMap<LinkId, LinkChanged>,
    monitor: Option<Recipient<NodeReported>>,
    faults: FaultReporter,
    /// Who wants to know whether there is another way to a node, until that is certain: as many as
    /// the recoverer has under way, which gives each two seconds.
    inquirers: Vec<(NodeName, oneshot::Sender<Verdict>)>,
    own_name: OwnName,
    /// Each life of the machine agrees on keys of its own.
    keys: Option<Arc<NodeKeys>>,
}

impl NodeRouter {
    pub(super) fn new(
        node: NodeName,
        incarnation: Incarnation,
        monitor: Option<Recipient<NodeReported>>,
        own_name: OwnName,
        faults: FaultReporter,
        keys: Option<Arc<NodeKeys>>,
    ) -> Self {
        let config = RouterConfig::new(node, incarnation);
        let machine = net::Router::new(config.clone(), platform::now());
        NodeRouter {
            machine: with_keys(machine, keys.as_deref(), incarnation),
            config,
            carriers: SortedMap::new(),
            links: SortedMap::new(),
            monitor,
            faults,
            inquirers: Vec::new(),
            own_name,
            keys,
        }
    }

    /// The roster that is used, for display.
    pub(super) fn roster(&self) -> Option<RosterRow> {
        Some(self.keys.as_ref()?.row())
    }

    /// A name is used twice: a user must act.
    fn name_taken(&self, detail: String) {
        error!("{detail}");
        self.faults.declare_passing(FaultKind::NameTaken, detail);
    }

    /// Where a link leads.
    fn remote(&self, link: Option<LinkId>) -> Arc<str> {
        let link = link.and_then(|link| self.links.get(&link));
        link.map_or(NameHolder::NOWHERE.into(), |link| link.remote.clone())
    }

    /// What a user does about two nodes of one name.
    fn cure_of_namesakes(&self) -> &'static str {
        match &self.keys {
            Some(_) => {
                "two processes, perhaps of two computers, have one key file: end one of them, or give \
                 it a key of its own"
            }
            None => "end one of them, or give it another name",
        }
    }

    fn report_node(&self, node: NodeName, incarnation: Incarnation, condition: NodeCondition) {
        if let Some(monitor) = &self.monitor {
            monitor.do_send(NodeReported { node, incarnation, condition });
        }
    }

    /// A path leads to a node; and before, if so, to this incarnation.
    pub(super) fn reachable(
        &mut self,
        node: &NodeName,
        incarnation: Incarnation,
        before: Option<Incarnation>,
    ) {
        info!(%node, %incarnation, "node reachable");
        if before != Some(incarnation) {
            let restarted = before.is_some();
            let condition =
                if restarted { NodeCondition::Restarted } else { NodeCondition::Reachable };
            self.report_node(node.clone(), incarnation, condition);
            // Of a neighbour its own hellos say so; what is told of others may be made up.
            if restarted && self.machine.is_neighbour(node, incarnation) {
                let what = "its process died and began again".to_owned();
                self.report_node(node.clone(), incarnation, NodeCondition::Offends { what });
            }
        }
    }

    /// Answers when it is certain whether another way leads to the node.
    pub(super) fn inquire(&mut self, node: NodeName, answer: oneshot::Sender<Verdict>) {
        self.inquirers.retain(|(_, inquirer)| !inquirer.is_closed());
        self.inquirers.push((node, answer));
        self.answer_inquirers();
    }

    fn answer_inquirers(&mut self) {
        for (node, inquirer) in std::mem::take(&mut self.inquirers) {
            // The caller may have stopped waiting.
            let _ = match self.machine.verdict(NodeId::of(&node), platform::now()) {
                Some(true) => inquirer.send(Ok(RecoveryDone::default())),
                Some(false) => inquirer.send(Err(format!("no other way leads to {node}").into())),
                None => {
                    self.inquirers.push((node, inquirer));
                    Ok(())
                }
            };
        }
    }

    /// Builds the machine again: it finds the peers again that can be reached.
    pub(super) fn rebuild(&mut self, peers: &Peers) {
        let reached = peers.iter().filter_map(|(_, peer)| Some((peer.node.clone(), peer.path?.0)));
        let machine = net::Router::restarted(self.config.clone(), reached, platform::now());
        self.machine = with_keys(machine, self.keys.as_deref(), self.config.incarnation);
        for (_, peer) in peers.iter().filter(|(_, peer)| peer.isolated) {
            self.machine.handle_isolation(&peer.node, true, platform::now());
        }
        for LinkChanged { link, status, .. } in self.links.values().cloned() {
            self.machine.handle_link(link, status, platform::now());
        }
    }

    pub(super) fn lost(&mut self, node: &NodeName, incarnation: Incarnation) {
        info!(%node, %incarnation, "node lost");
        let reason = "no path leads there any more".to_owned();
        self.report_node(node.clone(), incarnation, NodeCondition::Lost { reason });
    }

    pub(super) fn add_links(&mut self, AddLinks { links, carry }: AddLinks) {
        self.carriers.extend(links.into_iter().map(|link| (link, carry.clone())));
    }

    pub(super) fn handle_link(&mut self, changed: LinkChanged) {
        // Before the machine has it: a machine that is built again is given the last of each link.
        self.links.insert(changed.link, changed.clone());
        self.machine.handle_link(changed.link, changed.status, platform::now());
        self.answer_inquirers();
    }

    pub(super) fn handle_load(&mut self, link: LinkId, load: LinkPayload) {
        let now = platform::now();
        match load {
            LinkPayload::Routing(bytes) => self.machine.handle_routing(link, bytes, now),
            LinkPayload::Packet(packet) => {
                self.machine.handle_packet(link, packet.into_bytes(), now)
            }
            LinkPayload::Taken(_) => unreachable!("the links act on it"),
        }
    }

    pub(super) fn handle_roster(&mut self, keys: Arc<NodeKeys>) {
        self.machine.handle_roster(keys.roster(), platform::now());
        let Some(before) = self.keys.replace(keys.clone()) else { return };
        for node in before.missing_in(&keys) {
            self.report_node(node, Incarnation::default(), NodeCondition::Removed);
        }
        for node in keys.missing_in(&before) {
            self.report_node(node, Incarnation::default(), NodeCondition::Listed);
        }
    }

    /// Isolates a node, or admits it again.
    pub(super) fn handle_isolation(&mut self, IsolateNode { node, isolated, cause }: IsolateNode) {
        warn!(%node, isolated, "isolated, or admitted again: {cause}");
        self.machine.handle_isolation(&node, isolated, platform::now());
        let condition = match isolated {
            true => NodeCondition::Isolated { reason: cause },
            false => NodeCondition::Admitted,
        };
        self.report_node(node, Incarnation::default(), condition);
    }

    fn carry(&self, link: LinkId, load: LinkPayload) {
        if let Some(links) = self.carriers.get(&link) {
            links.do_send(TransmitOnLink { link, load });
        }
    }

    /// Carries out what concerns only links and users.
    pub(super) fn carry_out(&self, output: RouterOutput) {
        match output {
            RouterOutput::Routing { link, bytes } => self.carry(link, LinkPayload::Routing(bytes)),
            RouterOutput::Packet { link, packet } => self.carry(link, LinkPayload::Packet(packet)),
            RouterOutput::NumberTaken { node, refused } => {
                self.name_taken(format!(
                    "the names {node} and {refused} give one node number: {refused} is kept out; \
                     rename it"
                ));
            }
            RouterOutput::KeysDiffer { neighbour } => match &self.keys {
                Some(_) => warn!(
                    %neighbour,
                    "the neighbour has no keys, and this node has: nodes behind it are not reached; \
                     give it a key file of this robot"
                ),
                None => warn!(
                    %neighbour,
                    "the neighbour has keys, and this node has none: nodes behind it are not reached; \
                     give this node a key file of that robot"
                ),
            },
            RouterOutput::KeptOut { node, incarnation, by, link, over } => {
                let (cure, [at, first]) =
                    (self.cure_of_namesakes(), [Some(link), over].map(|l| self.remote(l)));
                self.name_taken(format!(
                    "another process called {node} has come up at {at} as {incarnation}, and {node} is \
                     reached at {first} as {by}, and answers: the new one is told to stop; {cure}"
                ));
            }
            RouterOutput::Refuse { link, by, over } => {
                self.carry(link, LinkPayload::Taken(NameHolder::new(by, self.remote(over))));
            }
            RouterOutput::NameTaken { by } => {
                let (name, cure) = (&self.config.node, self.cure_of_namesakes());
                self.own_name.set_taken(format!(
                    "this process, {name} as {}, stops: another process called {name} was there before, \
                     as {by}, and answers; {cure}",
                    self.config.incarnation
                ));
            }
            RouterOutput::Segment { .. }
            | RouterOutput::Undelivered { .. }
            | RouterOutput::Reachable { .. }
            | RouterOutput::PathChanged { .. }
            | RouterOutput::Lost { .. } => unreachable!("the stack tells the sessions"),
        }
    }
}

fn with_keys(
    machine: net::Router,
    keys: Option<&NodeKeys>,
    incarnation: Incarnation,
) -> net::Router {
    match keys {
        Some(keys) => machine.with_keys(keys.router_keys(incarnation)),
        None => machine,
    }
}
