//! Between the objects of this node and those of all others.

mod forbidden;
mod inbound;
mod inputs;
mod local;
mod node_state;
mod peer;
mod subscriptions;
mod undelivered;

pub(super) use local::LocalInput;

use super::NetEnvironment;
use super::fault_reporter::FaultReporter;
use super::roster_watch::RosterWatch;
use super::sessions::{DiscardedSession, PeerSessions};
use super::stub::{PeerCondition, PeerSendState, PeerStubs};
use crate::messaging::dead_letters::DeadLetterLog;
use crate::platform;
use crate::registry::remote_watch::DeathWatchService;
use crate::registry::{MessageMetadata, Registry, ReplyTo};
use crate::topic::{TopicKey, Topics};
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::session::DirectoryReport;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::{
    PeerProtocol, PeerProtocolOutput, SessionEpoch, TopicContract,
};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{
    DeliveryError, FaultKind, GatherBuffer, Incarnation, Instant, NodeName, ObjectName,
};
use bytes::Bytes;
use forbidden::ForbiddenAlarm;
use inbound::{InboundBacklog, PeerBinding};
use peer::GatewayPeer;
use std::sync::{Arc, Weak};
use subscriptions::Forwarded;
use tracing::{debug, error, info};

/// What the gateway uses of its node.
struct GatewaySetup {
    registry: Registry,
    topics: Topics,
    nodes: Option<Recipient<NodeReported>>,
    faults: FaultReporter,
    stack: Recipient<LocalInput>,
    stubs: Arc<PeerStubs>,
    deaths: DeathWatchService,
    dead_letters: DeadLetterLog,
    may_be_away: SortedSet<NodeName>,
    /// The directory of this node, and those of others.
    directory: Option<Recipient<DirectoryReport>>,
    /// Checks the rosters of other nodes. It ends with the node's network.
    roster_watch: Weak<RosterWatch>,
}

/// Speaks for the objects of this node.
pub(super) struct ObjectGateway {
    wiring: GatewaySetup,
    pub(super) exchange: PeerProtocol,
    peers: SortedMap<NodeId, GatewayPeer>,
    /// Where replies go, by our number of the request.
    replies: SortedMap<u64, (NodeName, ReplyTo)>,
    /// What peers have bound here.
    skeletons: SortedMap<(NodeId, u32), PeerBinding>,
    /// What waits for room with objects here.
    queues: InboundBacklog,
    /// What peers listen to here.
    forwards: SortedMap<(NodeId, u32), Forwarded>,
    /// What they listened to when their last sessions ended, until they have told it again.
    past: SortedMap<(NodeId, ObjectName), Forwarded>,
    next: u64,
    /// Messages of isolated nodes.
    of_isolated: u64,
    forbidden: ForbiddenAlarm,
    /// The node ends; the sessions follow once nothing waits here, and then at the latest.
    leaving: Option<Instant>,
}

impl ObjectGateway {
    pub(super) fn new(
        environment: &NetEnvironment,
        stubs: Arc<PeerStubs>,
        deaths: DeathWatchService,
        (faults, stack): (FaultReporter, Recipient<LocalInput>),
    ) -> Self {
        let NetEnvironment { registry, topics, nodes, dead_letters, .. } = environment.clone();
        let may_be_away = environment.may_be_away.clone();
        let directory = environment.directory.as_ref().map(|line| line.reports.clone());
        let mut exchange = PeerProtocol::default();
        if let Some(keys) = &environment.keys {
            exchange.handle_roster(keys.serial(), keys.roster_text());
        }
        if let Some(policy) = registry.access().policy() {
            exchange.handle_access((*policy).clone());
        }
        let wiring = GatewaySetup {
            registry,
            topics,
            nodes,
            faults,
            stack,
            stubs,
            deaths,
            dead_letters,
            may_be_away,
            directory,
            roster_watch: Weak::new(),
        };
        ObjectGateway {
            wiring,
            exchange,
            peers: SortedMap::new(),
            replies: SortedMap::new(),
            skeletons: SortedMap::new(),
            queues: InboundBacklog::default(),
            forwards: SortedMap::new(),
            past: SortedMap::new(),
            next: 0,
            of_isolated: 0,
            forbidden: ForbiddenAlarm::default(),
            leaving: None,
        }
    }

    /// Listens to the topics that this node's objects listen to.
    pub(super) fn take_interest(&mut self) {
        let stack = self.wiring.stack.clone();
        let interest = move |key: &TopicKey| stack.do_send(LocalInput::Interest(key.clone()));
        self.wiring.topics.on_interest(Arc::new(interest));
        for (key, identities) in self.wiring.topics.listened() {
            self.exchange.handle_interest(topic(&key), identities);
        }
    }

    fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    /// Carries out all that waits. A node that ends tells its peers, and ends its sessions.
    pub(super) fn drive(&mut self, sessions: &mut PeerSessions) {
        self.carry_out_all(sessions);
        let is_over = |until| until <= platform::now() || !self.exchange.is_waiting();
        if self.leaving.is_some_and(is_over) {
            self.exchange.handle_leave();
            self.carry_out_all(sessions);
            sessions.close();
            self.leaving = None;
        }
    }

    /// A panic in here has consumed an output.
    pub(super) fn carry_out_all(&mut self, sessions: &mut PeerSessions) {
        while let Some(output) = self.exchange.poll_output() {
            self.carry_out(output, sessions);
        }
    }

    fn carry_out(&mut self, output: PeerProtocolOutput, sessions: &mut PeerSessions) {
        match output {
            PeerProtocolOutput::Send { peer, stream, strand, message, credit } => {
                let session = (peer, self.peers.get(&peer).map_or(0, |peer| peer.session));
                let sent = sessions.send_reliable(session, (stream, strand), message, credit);
                self.give_back(peer, sent);
            }
            PeerProtocolOutput::SendNewest { peer, channel, message, credit } => {
                // Given back when the stack has yielded: senders on other threads would keep its
                // mailbox filled, and actix serves that before any timer.
                actix_rt::spawn(async move { drop(credit) });
                let session = (peer, self.peers.get(&peer).map_or(0, |peer| peer.session));
                let sent = sessions.send_latest(session, channel, message);
                self.give_back(peer, sent);
            }
            PeerProtocolOutput::Bind { peer, epoch, binding, object, identity } => {
                self.bind(peer, epoch, binding, &object, &identity);
            }
            PeerProtocolOutput::Serve { peer, epoch, binding, call, id, age, until, payload } => {
                let reply_to =
                    call.map(|call| reply_to(peer, epoch, call, self.wiring.stack.clone()));
                let metadata =
                    MessageMetadata { id, age, is_first: false, until, from: Some(peer) };
                self.serve((peer, binding), &payload, metadata, reply_to);
            }
            PeerProtocolOutput::Resolve { reply_as, result } => {
                if let Some((_, reply_to)) = self.replies.remove(&reply_as) {
                    reply_to(result.map(GatherBuffer::from));
                }
            }
            PeerProtocolOutput::Lost { peer, to, why } => self.record_undelivered(peer, to, &why),
            PeerProtocolOutput::ObjectFull { peer, object } => {
                self.with_send_state(peer, |send_state| send_state.object_is_full(object))
            }
            PeerProtocolOutput::ObjectReady { peer, object } => {
                self.with_send_state(peer, |send_state| send_state.handle_object_ready(&object))
            }
            PeerProtocolOutput::Differs { peer, difference } => {
                self.differs(peer, &difference);
            }
            PeerProtocolOutput::Subscribe { peer, subscription, topic, identities } => {
                self.subscribe(peer, subscription, &topic, identities);
            }
            PeerProtocolOutput::AccessDenied { denied } => {
                self.wiring.registry.access().record(*denied);
            }
            PeerProtocolOutput::SubscriptionForbidden { peer, why } => {
                self.subscription_forbidden(peer, &why);
            }
            PeerProtocolOutput::SubscriptionsAllowed { peer } => self.forget_forbidden(peer),
            PeerProtocolOutput::Unsubscribe { peer, subscription } => {
                self.end_forward((peer, subscription));
            }
            PeerProtocolOutput::Event { peer, topic, form, age, payload } => {
                if !self.peers.contains_key(&peer) {
                    return;
                }
                let key = TopicKey::new(&topic.topic, &topic.contract);
                let topics = &self.wiring.topics;
                // An event that cannot be read is among the topic's dead letters; a topic that is
                // not known has no listeners.
                let given = key.and_then(|key| topics.inject(&key.topic, form, &payload, age));
                if let Err(why) = given {
                    debug!(topic = %topic.topic, %why, "an event did not arrive");
                }
            }
            PeerProtocolOutput::Announced { peer } => {
                self.forget_past(peer);
                self.with_send_state(peer, PeerSendState::handle_announced)
            }
            PeerProtocolOutput::SafeState { peer, reason } => self.peer_rests(peer, reason),
            PeerProtocolOutput::Roster { peer, text } => self.offer_roster(peer, &text),
            PeerProtocolOutput::Directory { peer, message } => {
                if let Some(GatewayPeer { node, .. }) = self.peers.get(&peer) {
                    self.tell_directory(DirectoryReport::Said { node: node.clone(), message });
                }
            }
            PeerProtocolOutput::Bye { peer } => self.handle_bye(peer),
            PeerProtocolOutput::Forget { peer, why } => self.forget(peer, &why),
        }
    }

    /// The session does not take a message.
    fn give_back(&mut self, peer: NodeId, refused: Result<(), (DeliveryError, Bytes)>) {
        if let Err((why, message)) = refused {
            self.handle_returned(peer, message, why, false);
        }
    }

    /// Two nodes hold different contracts: shown in the session's row, and a fault. Each is told
    /// once in an incarnation of the peer.
    fn differs(&mut self, peer: NodeId, difference: &str) {
        let Some(peer) = self.peers.get_mut(&peer) else { return };
        if !peer.differs(difference) {
            return;
        }
        let node = &peer.node;
        error!(%node, "a contract differs: {difference}");
        let detail = format!("with node {node}: {difference}");
        self.wiring.faults.declare(FaultKind::ContractMismatch, detail);
    }

    /// A session begins. What differed in an earlier incarnation of the peer may be right now; if
    /// not, it is found and declared again.
    fn begin_peer(&mut self, peer: NodeId, session: u32, incarnation: Incarnation) {
        let Some(known) = self.peers.get_mut(&peer) else { return };
        let differed = known.begin(session, incarnation);
        if differed && self.peers.values().all(|peer| peer.differences().is_empty()) {
            self.wiring.faults.clear(FaultKind::ContractMismatch);
        }
    }

    /// What a peer has done does harm; several times are a fault of that node.
    fn offends(&self, peer: NodeId, what: &str) {
        if let (Some(nodes), Some(peer)) = (&self.wiring.nodes, self.peers.get(&peer)) {
            let (node, incarnation) = (peer.node.clone(), peer.incarnation);
            let condition = NodeCondition::Offends { what: what.to_owned() };
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    /// A node ends in order: that it will be silent is no fault.
    fn handle_bye(&mut self, peer: NodeId) {
        let Some(known) = self.peers.get_mut(&peer) else { return };
        known.left = true;
        known.send_state.set(PeerCondition::Left);
        let (node, incarnation) = (known.node.clone(), known.incarnation);
        info!(%node, %incarnation, "node leaves in order");
        self.tell_directory(DirectoryReport::Left { node: node.clone() });
        if let Some(nodes) = &self.wiring.nodes {
            let condition = NodeCondition::Left;
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    fn tell_directory(&self, report: DirectoryReport) {
        if let Some(directory) = &self.wiring.directory {
            directory.do_send(report);
        }
    }

    /// Why the session with a peer has ended, as its callers are told.
    fn because(&self, peer: NodeId, why: DeliveryError) -> DeliveryError {
        match self.peers.get(&peer) {
            Some(GatewayPeer { node, left: true, .. }) => {
                DeliveryError::Left { node: node.to_string() }
            }
            _ => why,
        }
    }

    /// The session is over: what the peer had here goes with it.
    fn forget(&mut self, peer: NodeId, why: &DeliveryError) {
        self.end_lines(peer, why);
        if let Some(peer) = self.peers.get(&peer) {
            peer.send_state.forget_backlog();
        }
        let all = (peer, 0)..=(peer, u32::MAX);
        let skeletons: Vec<_> = self.skeletons.range(all.clone()).map(|(key, _)| *key).collect();
        skeletons.iter().for_each(|key| drop(self.skeletons.remove(key)));
        let forwards: Vec<_> = self.forwards.range(all).map(|(key, _)| *key).collect();
        forwards.into_iter().for_each(|key| self.retire(key, why));
    }

    fn meet(&mut self, node: &NodeName) -> (NodeId, Arc<PeerSendState>) {
        let peer = NodeId::of(node);
        let send_state = self.wiring.stubs.send_state(node);
        let known = GatewayPeer::new(node.clone(), send_state.clone());
        self.peers.entry(peer).or_insert(known);
        (peer, send_state)
    }

    fn with_send_state(&self, peer: NodeId, act: impl FnOnce(&PeerSendState)) {
        if let Some(peer) = self.peers.get(&peer) {
            act(&peer.send_state);
        }
    }

    fn set(&self, peer: NodeId, condition: PeerCondition) {
        if let Some(peer) = self.peers.get(&peer)
            && !peer.left
        {
            peer.send_state.set(condition);
        }
    }
}

fn topic(key: &TopicKey) -> TopicContract {
    TopicContract { topic: key.topic.to_string(), contract: key.contract.to_string() }
}

/// Brings an answer back to the gateway, whichever thread gives it.
fn reply_to(
    peer: NodeId,
    epoch: SessionEpoch,
    call: u64,
    gateway: Recipient<LocalInput>,
) -> ReplyTo {
    Box::new(move |result| gateway.do_send(LocalInput::Reply { peer, epoch, call, result }))
}
