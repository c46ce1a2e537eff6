//! The body of all sessions of this node.

use super::fault_reporter::FaultReporter;
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::router::{InjectPanic, PathReported, SegmentArrived, SendSegment};
use blastema_contract::session::{
    AddGateway, CloseSessions, ReadSessions, ResetSession, SendLatest, SendReliable,
    SessionReported, SessionRow,
};
use blastema_core::detection::NodeCondition;
use blastema_core::net::refusal_alarms::{MANY, RefusalAlarms};
use blastema_core::net::{
    ByteRates, MachineSet, NodeId, Refusals, Session, SessionConfig, SessionOutput,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, FaultKind, Incarnation, NodeName, TrafficClass};
use bytes::Bytes;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;
use tracing::{error, info, warn};

/// The most peers that are remembered. Twice what a router knows at a time: robots change.
const PEERS_MAX: usize = 512;
/// How often it is looked at what was refused.
const REFUSAL_CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// A session that is built again counts on from there: more than any session needs.
const NUMBERS_PER_LIFE: u32 = 1 << 16;

/// One session per peer node.
pub(super) struct SessionsActor {
    node: NodeName,
    incarnation: Incarnation,
    idle_timeout: Duration,
    machines: MachineSet<NodeId, Session>,
    wake: WakeTimer,
    peers: SortedMap<NodeId, Peer>,
    router: Recipient<SendSegment>,
    gateway: Option<Recipient<SessionReported>>,
    faults: FaultReporter,
    nodes: Option<Recipient<NodeReported>>,
    complaints: RefusalAlarms<Option<NodeId>>,
    /// What came from nodes that no route leads to.
    strangers: Refusals,
    /// The highest number of a session with a peer that was forgotten: those with a new one are
    /// above it, for it may be the same peer.
    forgotten: u32,
    rates: ByteRates<NodeId>,
}

struct Peer {
    node: NodeName,
    /// Its incarnation, and the largest segment on the way, while there is one.
    path: Option<(Incarnation, usize)>,
    /// Sessions are numbered above this.
    number: u32,
    /// Since the last look something in its name came by way of others.
    relayed: bool,
}

impl SessionsActor {
    pub(super) fn new(
        (node, incarnation): (NodeName, Incarnation),
        idle_timeout: Duration,
        router: Recipient<SendSegment>,
        (faults, nodes): (FaultReporter, Option<Recipient<NodeReported>>),
    ) -> Self {
        SessionsActor {
            node,
            incarnation,
            idle_timeout,
            machines: MachineSet::default(),
            wake: WakeTimer::default(),
            peers: SortedMap::new(),
            router,
            gateway: None,
            faults,
            nodes,
            complaints: RefusalAlarms::default(),
            strangers: Refusals::default(),
            forgotten: 0,
            rates: ByteRates::default(),
        }
    }

    fn build(&mut self, id: NodeId) {
        let Some(peer) = self.peers.get(&id) else { return };
        let (node, incarnation) = (self.node.clone(), self.incarnation);
        let config = SessionConfig::new(node, incarnation, peer.node.clone());
        let (number, idle_timeout) = (peer.number, self.idle_timeout);
        let seed = platform::random_seed();
        let config = SessionConfig { number, seed, idle_timeout, ..config };
        self.machines.insert(id, Session::new(config, platform::now()));
    }

    fn meet(&mut self, node: NodeName) -> NodeId {
        let id = NodeId::of(&node);
        if !self.peers.contains_key(&id) {
            if self.peers.len() >= PEERS_MAX {
                self.forget_one();
            }
            let number = self.forgotten;
            self.peers.insert(id, Peer { node, path: None, number, relayed: false });
            self.build(id);
        }
        id
    }

    /// Makes room for a new peer: removes one without a path.
    fn forget_one(&mut self) {
        let gone = self.peers.iter().find(|(_, peer)| peer.path.is_none()).map(|(id, _)| *id);
        if let Some(id) = gone {
            let why = self.unreachable(id);
            if let Some(mut session) = self.machines.remove(id) {
                self.forgotten = self.forgotten.max(session.number());
                self.give_all_back(id, session.take_unacknowledged(), &why);
            }
            self.peers.remove(&id);
            self.complaints.forget(&Some(id));
            self.report(SessionReported::Ended { peer: id, why });
        }
    }

    /// The machine of this peer, if that session is the present one.
    fn present(&mut self, peer: NodeId, number: u32) -> Option<&mut Session> {
        self.machines.get_mut(peer).filter(|session| session.number() == number)
    }

    fn report(&self, report: SessionReported) {
        if let Some(gateway) = &self.gateway {
            gateway.do_send(report);
        }
    }

    fn give_back(&self, peer: NodeId, refused: Result<(), (DeliveryError, Bytes)>) {
        if let Err((why, message)) = refused {
            self.report(SessionReported::Returned { peer, message, why, sent: false });
        }
    }

    /// A session's machine goes with all that it held.
    fn give_all_back(
        &self,
        peer: NodeId,
        held: Vec<(TrafficClass, Bytes, bool)>,
        why: &DeliveryError,
    ) {
        for (_, message, sent) in held {
            let why = why.clone();
            self.report(SessionReported::Returned { peer, message, why, sent });
        }
    }

    /// Raises an alarm for a peer whose packets are refused for seconds.
    fn look_at_refusals(&mut self) {
        let peers = self.machines.iter().map(|(id, session)| (Some(id), session.refusals()));
        let looks: Vec<_> = peers.chain([(None, self.strangers)]).collect();
        for (peer, refusals) in looks {
            let known = peer.and_then(|id| self.peers.get_mut(&id));
            let relayed = known.is_none_or(|known| std::mem::take(&mut known.relayed));
            let alarm = self.complaints.handle_look(peer, refusals);
            let Some(since) = alarm else { continue };
            let name = peer.and_then(|id| self.peers.get(&id)).map(|peer| peer.node.to_string());
            let name = name.unwrap_or_else(|| "nodes that no route leads to".to_owned());
            let detail = format!("what comes from {name} is refused all the time: {since}");
            warn!("{detail}");
            // Nodes on the path may send in another's name. Over its own links it is itself, unless
            // an attacker replays its packets there.
            let its_own = !relayed && since.of_the_present() >= MANY;
            if let (Some(nodes), Some(peer), true) =
                (&self.nodes, peer.and_then(|id| self.peers.get(&id)), its_own)
            {
                let (node, incarnation) = (peer.node.clone(), Incarnation::default());
                let what = "it sent for seconds what had to be refused".to_owned();
                let condition = NodeCondition::Offends { what };
                nodes.do_send(NodeReported { node, incarnation, condition });
            }
            self.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }

    fn look_at_rates(&mut self) {
        let carried = self.machines.iter().map(|(id, session)| {
            let counters = session.counters();
            (id, counters.bytes_sent, counters.bytes_received)
        });
        self.rates.handle_look(carried, platform::now());
    }

    fn unreachable(&self, peer: NodeId) -> DeliveryError {
        let node = self.peers.get(&peer).map_or(peer.to_string(), |peer| peer.node.to_string());
        DeliveryError::Unreachable { node }
    }
}

answers_the_monitor!(SessionsActor);

impl Actor for SessionsActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(REFUSAL_CHECK_INTERVAL, |sessions, _| {
            sessions.look_at_refusals();
            sessions.look_at_rates();
        });
    }
}

impl Supervised for SessionsActor {
    /// The session in service is built again; the others go on.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.wake = WakeTimer::default();
        self.started(context);
        if let Some(id) = self.machines.last() {
            self.build_again(id);
        }
        self.drive(context);
    }
}

impl SessionsActor {
    /// Ends a session, and builds its machine again.
    fn build_again(&mut self, id: NodeId) {
        if let Some(mut broken) = self.machines.remove(id) {
            let why = self.unreachable(id);
            // What it still holds is given back, if it can be read at all.
            let held =
                catch_unwind(AssertUnwindSafe(|| broken.take_unacknowledged())).unwrap_or_default();
            self.give_all_back(id, held, &why);
            self.report(SessionReported::Ended { peer: id, why });
            if let Some(peer) = self.peers.get_mut(&id) {
                peer.number = peer.number.max(broken.number()).saturating_add(NUMBERS_PER_LIFE);
            }
            self.build(id);
            let path = self.peers.get(&id).and_then(|peer| peer.path);
            if let (Some((incarnation, mtu)), Some(session)) = (path, self.machines.get_mut(id)) {
                session.handle_incarnation(incarnation, platform::now());
                session.handle_path(mtu, platform::now());
            }
        }
    }
}

impl MachineActor for SessionsActor {
    type Machine = MachineSet<NodeId, Session>;

    fn driven(&mut self) -> (&mut Self::Machine, &mut WakeTimer) {
        (&mut self.machines, &mut self.wake)
    }

    fn carry_out(&mut self, output: (NodeId, SessionOutput), _: &mut Context<Self>) {
        let (peer, output) = output;
        match output {
            SessionOutput::Transmit { class, segment, everywhere } => {
                self.router.do_send(SendSegment { peer, class, segment, everywhere });
            }
            SessionOutput::Opened { incarnation } => {
                let Some(known) = self.peers.get(&peer) else { return };
                let node = known.node.clone();
                info!(%node, %incarnation, "session open");
                let session = self.machines.get(peer).map_or(0, Session::number);
                self.report(SessionReported::Opened { node, incarnation, session });
            }
            SessionOutput::Message { message, .. } | SessionOutput::Newest { message, .. } => {
                self.report(SessionReported::Message { peer, message });
            }
            SessionOutput::Returned { message, why, sent, .. } => {
                self.report(SessionReported::Returned { peer, message, why, sent });
            }
            SessionOutput::Ended { incarnation, why } => {
                info!(%peer, %incarnation, %why, "session ended");
                self.report(SessionReported::Ended { peer, why });
            }
            SessionOutput::Incompatible { theirs } => {
                error!(%peer, theirs, "the peer's sessions speak another version: update one node");
            }
        }
    }
}

impl Handler<AddGateway> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: AddGateway, _: &mut Context<Self>) {
        self.gateway = Some(message.0);
    }
}

impl Handler<PathReported> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: PathReported, context: &mut Context<Self>) {
        // What was said and heard before goes first.
        self.drive(context);
        let now = platform::now();
        match message {
            PathReported::Reachable { node, incarnation, mtu } => {
                let id = self.meet(node.clone());
                if let Some(peer) = self.peers.get_mut(&id) {
                    peer.path = Some((incarnation, mtu));
                }
                self.report(SessionReported::Reachable { node, incarnation });
                if let Some(session) = self.machines.get_mut(id) {
                    session.handle_incarnation(incarnation, now);
                    session.handle_path(mtu, now);
                }
            }
            PathReported::Changed { node, mtu } => {
                if let Some((_, old)) =
                    self.peers.get_mut(&node).and_then(|peer| peer.path.as_mut())
                {
                    *old = mtu;
                }
                if let Some(session) = self.machines.get_mut(node) {
                    session.handle_path(mtu, now);
                }
            }
            PathReported::Undelivered { node, reason } => {
                if let Some(session) = self.machines.get_mut(node) {
                    session.handle_undelivered(reason, now);
                }
            }
            PathReported::Lost { node } => {
                let id = NodeId::of(&node);
                if let Some(peer) = self.peers.get_mut(&id) {
                    peer.path = None;
                }
                self.report(SessionReported::Unreachable { node });
                if let Some(session) = self.machines.get_mut(id) {
                    session.handle_no_path(now);
                }
            }
        }
        self.drive(context);
    }
}

impl Handler<SegmentArrived> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: SegmentArrived, context: &mut Context<Self>) {
        let SegmentArrived { source, segment, authentic } = message;
        // A peer that the router has not told of yet repeats itself.
        let Some(session) = self.machines.get_mut(source) else {
            self.strangers.unexpected += 1;
            return;
        };
        session.handle_segment(segment, platform::now());
        self.drive_soon(context);
        if !authentic && let Some(peer) = self.peers.get_mut(&source) {
            peer.relayed = true;
        }
    }
}

impl Handler<SendReliable> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: SendReliable, context: &mut Context<Self>) {
        let SendReliable { peer, session, stream, strand, message, credit } = message;
        let now = platform::now();
        let sent = match self.present(peer, session) {
            Some(session) => session.handle_send_along((stream, strand), message, credit, now),
            None => Err((self.unreachable(peer), message.into_bytes())),
        };
        self.give_back(peer, sent);
        self.drive_soon(context);
    }
}

impl Handler<SendLatest> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: SendLatest, context: &mut Context<Self>) {
        let SendLatest { peer, session, channel, message, credit } = message;
        // The session has it from here on, and keeps one of each channel.
        drop(credit);
        let sent = match self.present(peer, session) {
            Some(session) => session.handle_send_newest(channel, message, platform::now()),
            None => Err((self.unreachable(peer), message.into_bytes())),
        };
        self.give_back(peer, sent);
        self.drive_soon(context);
    }
}

impl Handler<ResetSession> for SessionsActor {
    type Result = ();

    fn handle(&mut self, message: ResetSession, context: &mut Context<Self>) {
        let all = || self.peers.keys().copied().collect();
        let ids: Vec<_> = message.peer.map_or_else(all, |peer| vec![peer]);
        for session in ids {
            if let Some(session) = self.machines.get_mut(session) {
                session.handle_restart(platform::now());
            }
        }
        self.drive(context);
    }
}

impl Handler<CloseSessions> for SessionsActor {
    type Result = ();

    fn handle(&mut self, _: CloseSessions, context: &mut Context<Self>) {
        let ids: Vec<_> = self.peers.keys().copied().collect();
        for session in ids {
            if let Some(session) = self.machines.get_mut(session) {
                session.handle_close(platform::now());
            }
        }
        self.drive(context);
    }
}

impl Handler<ReadSessions> for SessionsActor {
    type Result = MessageResult<ReadSessions>;

    fn handle(&mut self, _: ReadSessions, _: &mut Context<Self>) -> Self::Result {
        let row = |(id, session): (NodeId, &Session)| {
            Some(SessionRow {
                node: self.peers.get(&id)?.node.clone(),
                status: session.status(),
                rate: self.rates.rate(id),
                // The gateway knows.
                differences: Vec::new(),
            })
        };
        MessageResult(self.machines.iter().filter_map(row).collect())
    }
}

impl Handler<InjectPanic> for SessionsActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the sessions panic on purpose");
    }
}
