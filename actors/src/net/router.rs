//! The router's body.

use super::fault_reporter::FaultReporter;
use super::keys::NodeKeys;
use super::own_name::OwnName;
use super::roster_watch::RosterChanged;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::link::{
    AddLinks, LinkChanged, LinkPayload, ReceivedOnLink, ReportLinks, TransmitOnLink,
};
use blastema_contract::monitor::NodeReported;
use blastema_contract::router::{
    AddSessions, InjectPanic, PathReported, ReadRoutes, Routes, SegmentArrived, SendSegment,
    SetIsolation,
};
use blastema_contract::strategy::Reroute;
use blastema_core::detection::NodeCondition;
use blastema_core::net::wire::frame::NameHolder;
use blastema_core::net::{self, LinkId, NodeId, RouterConfig, RouterOutput};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{FaultKind, FaultLocation, Incarnation, NodeName};
use std::sync::Arc;
use tokio::sync::oneshot;
use tracing::{debug, error, info, warn};

/// Forwards for this node.
pub(super) struct RouterActor {
    config: RouterConfig,
    machine: net::Router,
    wake: WakeTimer,
    links: SortedMap<LinkId, Recipient<TransmitOnLink>>,
    networks: Vec<Recipient<ReportLinks>>,
    sessions: Option<AddSessions>,
    monitor: Option<Recipient<NodeReported>>,
    faults: FaultReporter,
    /// The nodes that can be reached, and their incarnations: what a restarted router finds again.
    reached: SortedMap<NodeName, Incarnation>,
    /// Who wants to know whether there is another way to a node, until that is certain: as many as
    /// the recoverer has under way, which gives each two seconds.
    inquirers: Vec<(NodeName, oneshot::Sender<Result<RecoveryDone, RecoveryFailed>>)>,
    /// The isolated nodes, which a restarted router is given.
    isolated: SortedSet<NodeName>,
    /// Where the links lead, for display.
    remotes: SortedMap<LinkId, Arc<str>>,
    own_name: OwnName,
    /// Each life of the machine agrees on keys of its own.
    keys: Option<Arc<NodeKeys>>,
}

impl RouterActor {
    pub(super) fn maker(
        (node, incarnation): (NodeName, Incarnation),
        (monitor, own_name): (Option<Recipient<NodeReported>>, OwnName),
        faults: FaultReporter,
        keys: Option<Arc<NodeKeys>>,
    ) -> impl FnOnce(&mut Context<Self>) -> Self + Send + 'static {
        move |_| {
            let config = RouterConfig::new(node, incarnation);
            let machine = net::Router::new(config.clone(), platform::now());
            RouterActor {
                machine: with_keys(machine, keys.as_deref(), incarnation),
                keys,
                config,
                wake: WakeTimer::default(),
                links: SortedMap::new(),
                networks: Vec::new(),
                sessions: None,
                monitor,
                faults,
                reached: SortedMap::new(),
                inquirers: Vec::new(),
                isolated: SortedSet::new(),
                remotes: SortedMap::new(),
                own_name,
            }
        }
    }

    /// A name is used twice: a user must act.
    fn name_taken(&self, detail: String) {
        error!("{detail}");
        self.faults.declare_passing(FaultKind::NameTaken, detail);
    }

    /// Where a link leads.
    fn remote(&self, link: Option<LinkId>) -> Arc<str> {
        let remote = link.and_then(|link| self.remotes.get(&link));
        remote.cloned().unwrap_or(NameHolder::NOWHERE.into())
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

    fn report_path(&self, report: PathReported) {
        if let Some(sessions) = &self.sessions {
            sessions.paths.do_send(report);
        }
    }

    fn report_node(&self, node: NodeName, incarnation: Incarnation, condition: NodeCondition) {
        if let Some(monitor) = &self.monitor {
            monitor.do_send(NodeReported { node, incarnation, condition });
        }
    }

    fn reachable(&mut self, node: NodeName, incarnation: Incarnation, mtu: usize) {
        info!(%node, %incarnation, "node reachable");
        let before = self.reached.insert(node.clone(), incarnation);
        if before != Some(incarnation) {
            let restarted = before.is_some();
            let condition =
                if restarted { NodeCondition::Restarted } else { NodeCondition::Reachable };
            self.report_node(node.clone(), incarnation, condition);
            // Of a neighbour its own hellos say so; what is told of others may be made up.
            if restarted && self.machine.is_neighbour(&node, incarnation) {
                let what = "its process died and began again".to_owned();
                self.report_node(node.clone(), incarnation, NodeCondition::Offends { what });
            }
        }
        self.report_path(PathReported::Reachable { node, incarnation, mtu });
    }

    fn answer_inquirers(&mut self, context: &mut Context<Self>) {
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
        self.drive(context);
    }

    /// Builds the machine again.
    fn build(&mut self) {
        let reached = self.reached.clone();
        let machine = net::Router::restarted(self.config.clone(), reached, platform::now());
        self.machine = with_keys(machine, self.keys.as_deref(), self.config.incarnation);
        for node in &self.isolated {
            self.machine.handle_isolation(node, true, platform::now());
        }
    }

    fn lost(&mut self, node: NodeName, incarnation: Incarnation) {
        info!(%node, %incarnation, "node lost");
        self.reached.remove(&node);
        let reason = "no path leads there any more".to_owned();
        self.report_node(node.clone(), incarnation, NodeCondition::Lost { reason });
        self.report_path(PathReported::Lost { node });
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

answers_the_monitor!(RouterActor);

impl Actor for RouterActor {
    type Context = Context<Self>;
}

impl Supervised for RouterActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.build();
        self.wake = WakeTimer::default();
        self.networks.iter().for_each(|network| network.do_send(ReportLinks));
        self.drive(context);
    }
}

impl MachineActor for RouterActor {
    type Machine = net::Router;

    fn driven(&mut self) -> (&mut net::Router, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: RouterOutput, _: &mut Context<Self>) {
        let carry = |link, load| {
            if let Some(links) = self.links.get(&link) {
                links.do_send(TransmitOnLink { link, load });
            }
        };
        match output {
            RouterOutput::Routing { link, bytes } => carry(link, LinkPayload::Routing(bytes)),
            RouterOutput::Packet { link, packet } => carry(link, LinkPayload::Packet(packet)),
            RouterOutput::Segment { source, segment, authentic } => {
                if let Some(sessions) = &self.sessions {
                    sessions.segments.do_send(SegmentArrived { source, segment, authentic });
                }
            }
            RouterOutput::Undelivered { destination, reason } => {
                debug!(node = %destination, %reason, "a packet came back");
                self.report_path(PathReported::Undelivered { node: destination, reason });
            }
            RouterOutput::Reachable { node, incarnation, mtu } => {
                self.reachable(node, incarnation, mtu);
            }
            RouterOutput::PathChanged { node, mtu } => {
                self.report_path(PathReported::Changed { node, mtu });
            }
            RouterOutput::Lost { node, incarnation } => self.lost(node, incarnation),
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
                carry(link, LinkPayload::Taken(NameHolder::new(by, self.remote(over))));
            }
            RouterOutput::NameTaken { by } => {
                let (name, cure) = (&self.config.node, self.cure_of_namesakes());
                self.own_name.set_taken(format!(
                    "this process, {name} as {}, stops: another process called {name} was there before, \
                     as {by}, and answers; {cure}",
                    self.config.incarnation
                ));
            }
        }
    }
}

impl Handler<AddLinks> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: AddLinks, _: &mut Context<Self>) {
        let AddLinks { links, carry, report } = message;
        self.links.extend(links.into_iter().map(|link| (link, carry.clone())));
        report.do_send(ReportLinks);
        self.networks.push(report);
    }
}

impl Handler<AddSessions> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: AddSessions, _: &mut Context<Self>) {
        self.sessions = Some(message);
    }
}

impl Handler<LinkChanged> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: LinkChanged, context: &mut Context<Self>) {
        let LinkChanged { link, status, remote } = message;
        self.remotes.insert(link, remote);
        self.machine.handle_link(link, status, platform::now());
        self.drive(context);
        self.answer_inquirers(context);
    }
}

impl Handler<ReceivedOnLink> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: ReceivedOnLink, context: &mut Context<Self>) {
        let ReceivedOnLink { link, load } = message;
        let now = platform::now();
        match load {
            LinkPayload::Routing(bytes) => self.machine.handle_routing(link, bytes, now),
            LinkPayload::Packet(packet) => {
                self.machine.handle_packet(link, packet.into_bytes(), now)
            }
            LinkPayload::Taken(_) => unreachable!("the links act on it"),
        }
        self.drive_soon(context);
    }
}

impl Handler<SendSegment> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: SendSegment, context: &mut Context<Self>) {
        let SendSegment { peer, class, segment, everywhere } = message;
        match everywhere {
            true => self.machine.handle_copies(peer, class, &segment),
            false => self.machine.handle_segment(peer, class, segment),
        }
        self.drive_soon(context);
    }
}

impl Handler<RosterChanged> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: RosterChanged, context: &mut Context<Self>) {
        let RosterChanged(keys) = message;
        self.machine.handle_roster(keys.roster(), platform::now());
        let before = self.keys.replace(keys.clone());
        let Some(before) = before else { return self.drive(context) };
        for node in before.missing_in(&keys) {
            self.report_node(node, Incarnation::default(), NodeCondition::Removed);
        }
        for node in keys.missing_in(&before) {
            self.report_node(node, Incarnation::default(), NodeCondition::Listed);
        }
        self.drive(context);
    }
}

impl Handler<SetIsolation> for RouterActor {
    type Result = ();

    fn handle(&mut self, message: SetIsolation, context: &mut Context<Self>) {
        let SetIsolation { node, isolated } = message;
        self.machine.handle_isolation(&node, isolated, platform::now());
        if isolated {
            self.isolated.insert(node);
        } else {
            self.isolated.remove(&node);
        }
        self.drive(context);
    }
}

impl Handler<ReadRoutes> for RouterActor {
    type Result = Routes;

    fn handle(&mut self, _: ReadRoutes, _: &mut Context<Self>) -> Routes {
        let mut routes: Vec<_> = self.machine.routes().map(|(_, route)| route.clone()).collect();
        routes.sort_by(|a, b| a.node.cmp(&b.node));
        Routes { routes }
    }
}

impl Handler<InjectPanic> for RouterActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the router panics on purpose");
    }
}

/// The alternative was chosen before it was needed: what is left to do is to say whether there is
/// one. Where the only one may have failed as well, the answer waits until its link says so or
/// recovers.
impl Handler<Reroute> for RouterActor {
    type Result = PendingAnswer<Result<RecoveryDone, RecoveryFailed>>;

    fn handle(&mut self, message: Reroute, context: &mut Context<Self>) -> Self::Result {
        let Reroute { location } = message;
        let node = match location {
            FaultLocation::Link { neighbour: Some(node), .. } | FaultLocation::Node(node) => node,
            other => {
                let error = format!("the node behind {other} is not known");
                return PendingAnswer::new(async { Err(error.into()) });
            }
        };
        let (answer, verdict) = oneshot::channel();
        self.inquirers.retain(|(_, inquirer)| !inquirer.is_closed());
        self.inquirers.push((node, answer));
        self.answer_inquirers(context);
        PendingAnswer::new(async {
            verdict.await.unwrap_or_else(|_| Err("the router was restarted".into()))
        })
    }
}
