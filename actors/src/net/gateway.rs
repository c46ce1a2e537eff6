//! Between the objects of this node and those of all others.

mod forbidden;
mod inbound;
mod local;
mod subscriptions;
mod undelivered;

pub(super) use local::LocalInput;

use super::NetEnvironment;
use super::gateway_messages::SendToPeer;
use super::keys::NodeKeys;
use super::roster_watch::{RosterOffer, RosterWatch};
use super::sessions::SessionWatch;
use super::stub::{PeerCondition, PeerSendState, PeerStubs};
use crate::messaging::dead_letters::DeadLetterLog;
use crate::platform;
use crate::platform::panics;
use crate::registry::remote_watch::DeathWatchService;
use crate::registry::{MessageMetadata, Registry, ReplyTo};
use crate::runtime::reports::FaultReporter;
use crate::topic::{TopicKey, Topics};
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::recoverer::SafeStateChanged;
use blastema_contract::session::DirectoryReport;
use blastema_core::detection::NodeCondition;
use blastema_core::net::peer_protocol::{
    Call, PeerProtocol, PeerProtocolOutput, SessionEpoch, TopicContract, TransmitState,
};
use blastema_core::net::{NodeId, Peer};
use blastema_core::sorted::SortedMap;
use blastema_core::{
    DeliveryError, FaultKind, GatherBuffer, Incarnation, Instant, NodeName, ObjectAddress,
    ObjectName, TrafficClass,
};
use bytes::Bytes;
use forbidden::ForbiddenAlarm;
use inbound::{InboundBacklog, PeerBinding};
use std::collections::BTreeSet;
use std::sync::{Arc, Weak};
use std::time::Duration;
use subscriptions::Forwarded;
use tracing::{debug, error, info, warn};

/// How long a node that ends waits for peers to agree to contracts of messages it has accepted.
const LEAVE_TIMEOUT: Duration = Duration::from_millis(500);
/// So many refusals of one node between two looks, a second apart, are an offence of it.
const FLOOD: u64 = 1_000;

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
    may_be_away: BTreeSet<NodeName>,
    /// The directory of this node, and those of others.
    directory: Option<Recipient<DirectoryReport>>,
    /// Checks the rosters of other nodes. It ends with the node's network.
    roster_watch: Weak<RosterWatch>,
}

/// Speaks for the objects of this node.
pub(super) struct ObjectGateway {
    setup: GatewaySetup,
    /// With the table of all peers.
    pub(super) protocol: PeerProtocol,
    pub(super) sessions: SessionWatch,
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
    forbidden: ForbiddenAlarm,
    /// The node ends; the sessions follow once nothing waits here, and then at the latest.
    leaving: Option<Instant>,
}

impl ObjectGateway {
    pub(super) fn new(
        environment: &NetEnvironment,
        stubs: Arc<PeerStubs>,
        deaths: DeathWatchService,
        faults: FaultReporter,
        stack: Recipient<LocalInput>,
    ) -> Self {
        let NetEnvironment { registry, topics, dead_letters, .. } = environment.clone();
        let nodes = environment.reports.nodes.clone();
        let may_be_away = environment.may_be_away.clone();
        let directory = environment.directory.as_ref().map(|line| line.reports.clone());
        let NetEnvironment { node, incarnation, session_timeout, .. } = environment;
        let mut protocol = PeerProtocol::new(node.clone(), *incarnation, *session_timeout);
        if let Some(keys) = &environment.keys {
            protocol.handle_roster(keys.serial(), keys.roster_text());
        }
        if let Some(policy) = registry.access().policy() {
            protocol.handle_access((*policy).clone());
        }
        let setup = GatewaySetup {
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
            setup,
            protocol,
            sessions: SessionWatch::default(),
            replies: SortedMap::new(),
            skeletons: SortedMap::new(),
            queues: InboundBacklog::default(),
            forwards: SortedMap::new(),
            past: SortedMap::new(),
            next: 0,
            forbidden: ForbiddenAlarm::default(),
            leaving: None,
        }
    }

    /// Listens to the topics that this node's objects listen to.
    pub(super) fn take_interest(&mut self) {
        let stack = self.setup.stack.clone();
        let interest = move |key: &TopicKey| stack.do_send(LocalInput::Interest(key.clone()));
        self.setup.topics.on_interest(Arc::new(interest));
        for (key, identities) in self.setup.topics.listened() {
            self.protocol.handle_interest(topic(&key), identities);
        }
    }

    fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    /// Carries out all that waits. A node that ends tells its peers, and ends its sessions.
    pub(super) fn drive(&mut self) {
        self.carry_out_all();
        let is_over = |until| until <= platform::now() || !self.protocol.is_waiting();
        if self.leaving.is_some_and(is_over) {
            self.protocol.handle_leave();
            self.carry_out_all();
            self.protocol.close(platform::now());
            self.leaving = None;
        }
    }

    /// A panic in here has consumed an output.
    pub(super) fn carry_out_all(&mut self) {
        while let Some(output) = self.protocol.poll_output() {
            self.carry_out(output);
        }
    }

    fn carry_out(&mut self, output: PeerProtocolOutput) {
        let now = platform::now();
        match output {
            PeerProtocolOutput::Send { peer, stream, key, message, credit } => {
                let sent = match self.protocol.peers.present(peer) {
                    Some(session) => session.handle_send_along(stream, key, message, credit, now),
                    None => Err((self.protocol.peers.unreachable(peer), message.into_bytes())),
                };
                self.give_back(peer, sent);
            }
            PeerProtocolOutput::SendNewest { peer, channel, message, credit } => {
                // Given back when the stack has yielded: senders on other threads would keep its
                // mailbox filled, and actix serves that before any timer.
                actix_rt::spawn(async move { drop(credit) });
                let sent = match self.protocol.peers.present(peer) {
                    Some(session) => session.handle_send_newest(channel, message, now),
                    None => Err((self.protocol.peers.unreachable(peer), message.into_bytes())),
                };
                self.give_back(peer, sent);
            }
            PeerProtocolOutput::Bind { peer, epoch, binding, object, identity } => {
                self.bind(peer, epoch, binding, &object, &identity);
            }
            PeerProtocolOutput::Serve { peer, epoch, binding, call, id, age, until, payload } => {
                let reply_to =
                    call.map(|call| reply_to(peer, epoch, call, self.setup.stack.clone()));
                let metadata =
                    MessageMetadata { id, age, is_first: false, until, from: Some(peer) };
                self.serve(peer, binding, &payload, metadata, reply_to);
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
                self.setup.registry.access().record(*denied);
            }
            PeerProtocolOutput::SubscriptionForbidden { why } => {
                self.forbidden.refused(&why, &self.setup.faults);
            }
            PeerProtocolOutput::Unsubscribe { peer, subscription } => {
                self.end_forward((peer, subscription));
            }
            PeerProtocolOutput::Event { peer, topic, form, age, payload } => {
                if self.protocol.peers.get(peer).is_none() {
                    return;
                }
                let key = TopicKey::new(&topic.topic, &topic.contract);
                let topics = &self.setup.topics;
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
                if let Some(Peer { node, .. }) = self.protocol.peers.get(peer) {
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
        let Some(peer) = self.protocol.peers.get_mut(peer) else { return };
        if !peer.differs(difference) {
            return;
        }
        let node = &peer.node;
        error!(%node, "a contract differs: {difference}");
        let detail = format!("with node {node}: {difference}");
        self.setup.faults.declare(FaultKind::ContractMismatch, detail);
    }

    /// What differed in an incarnation of a peer is over. What still differs, or differs again, is
    /// found and declared again.
    fn forget_differences(&self) {
        if self.protocol.peers.iter().all(|(_, peer)| peer.differences().is_empty()) {
            self.setup.faults.clear(FaultKind::ContractMismatch);
        }
    }

    /// What a peer has done does harm; several times are a fault of that node.
    fn offends(&self, peer: NodeId, what: &str) {
        self.report(peer, NodeCondition::Offends { what: what.to_owned() });
    }

    /// A node ends in order: that it will be silent is no fault.
    fn handle_bye(&mut self, peer: NodeId) {
        let Some(known) = self.protocol.peers.get_mut(peer) else { return };
        known.left = true;
        let (node, incarnation) = (known.node.clone(), known.incarnation);
        self.setup.stubs.send_state(&node).set(PeerCondition::Left);
        info!(%node, %incarnation, "node leaves in order");
        self.tell_directory(DirectoryReport::Left { node });
        self.report(peer, NodeCondition::Left);
    }

    /// Reports how a peer is, in the incarnation that a session was opened with last.
    fn report(&self, peer: NodeId, condition: NodeCondition) {
        if let (Some(nodes), Some(peer)) = (&self.setup.nodes, self.protocol.peers.get(peer)) {
            let (node, incarnation) = (peer.node.clone(), peer.incarnation);
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    fn tell_directory(&self, report: DirectoryReport) {
        if let Some(directory) = &self.setup.directory {
            directory.do_send(report);
        }
    }

    /// Why the session with a peer has ended, as its callers are told.
    fn because(&self, peer: NodeId, why: DeliveryError) -> DeliveryError {
        match self.protocol.peers.get(peer) {
            Some(Peer { node, left: true, .. }) => DeliveryError::Left { node: node.to_string() },
            _ => why,
        }
    }

    /// The session is over: what the peer had here goes with it.
    fn forget(&mut self, peer: NodeId, why: &DeliveryError) {
        self.end_lines(peer, why);
        self.with_send_state(peer, PeerSendState::forget_backlog);
        let all = (peer, 0)..=(peer, u32::MAX);
        let skeletons: Vec<_> = self.skeletons.range(all.clone()).map(|(key, _)| *key).collect();
        skeletons.iter().for_each(|key| drop(self.skeletons.remove(key)));
        let forwards: Vec<_> = self.forwards.range(all).map(|(key, _)| *key).collect();
        forwards.into_iter().for_each(|key| self.retire(key, why));
    }

    /// Makes the row of a node. Where the table is full, another one is forgotten.
    fn meet(&mut self, node: &NodeName) -> NodeId {
        if let Some(gone) = self.protocol.expendable(node)
            && let Some(known) = self.protocol.peers.get_mut(gone)
        {
            let (name, held) = (known.node.clone(), known.session.take_unacknowledged());
            self.discard(gone, held);
            self.carry_out_all();
            self.forget_past(gone);
            self.setup.deaths.forget(gone);
            self.setup.stubs.forget(&name);
            if self.protocol.forget(gone) {
                self.forget_differences();
            }
        }
        self.protocol.meet(node, platform::random_seed(), platform::now())
    }

    fn with_send_state(&self, peer: NodeId, act: impl FnOnce(&PeerSendState)) {
        if let Some(peer) = self.protocol.peers.get(peer) {
            act(&self.setup.stubs.send_state(&peer.node));
        }
    }

    /// Shows senders that no session is open, and whether one is about to begin.
    fn show_closed(&self, peer: NodeId) {
        let Some(known) = self.protocol.peers.get(peer).filter(|peer| !peer.left) else { return };
        let condition = match known.path {
            Some(_) => PeerCondition::Opening,
            None => PeerCondition::Unreachable,
        };
        self.setup.stubs.send_state(&known.node).set(condition);
    }

    /// A node can be reached; a session will begin.
    pub(super) fn handle_reachable(
        &mut self,
        node: &NodeName,
        incarnation: Incarnation,
        mtu: usize,
    ) {
        let peer = self.meet(node);
        let Some(known) = self.protocol.peers.get_mut(peer) else { return };
        let is_newer = known.incarnation != incarnation;
        known.left &= !is_newer;
        known.handle_reachable(incarnation, mtu, platform::now());
        let send_state = self.setup.stubs.send_state(node);
        send_state.path_found(is_newer);
        if !send_state.has_session() {
            self.show_closed(peer);
        } else if !is_newer {
            self.tell_directory(DirectoryReport::Reachable { node: node.clone() });
        }
    }

    /// No path leads to a node any more; its session waits for one for a while.
    pub(super) fn handle_unreachable(&mut self, node: &NodeName) {
        let peer = NodeId::of(node);
        let Some(known) = self.protocol.peers.get_mut(peer) else { return };
        known.handle_no_path(platform::now());
        self.setup.deaths.handle_opening(peer);
        let send_state = self.setup.stubs.send_state(node);
        send_state.path_lost();
        self.tell_directory(DirectoryReport::Unreachable { node: node.clone() });
        if !send_state.has_session() {
            self.show_closed(peer);
        }
    }

    /// Another node's session has sent this. It is authentic if no other node can have made it: it
    /// came over a link with that node itself, or that node has sealed it.
    pub(super) fn handle_segment(&mut self, source: NodeId, segment: Bytes, authentic: bool) {
        // A peer that the router has not told of yet repeats itself.
        let Some(peer) = self.protocol.peers.get_mut(source) else {
            self.sessions.strangers.unexpected += 1;
            return;
        };
        peer.session.handle_segment(segment, platform::now());
        peer.relayed |= !authentic;
    }

    /// A session has begun, which has this number.
    pub(super) fn session_opened(&mut self, peer: NodeId, incarnation: Incarnation, session: u32) {
        let Some(node) = self.protocol.peers.get(peer).map(|peer| peer.node.clone()) else {
            return;
        };
        info!(%node, %incarnation, "session open");
        // Before the peer learns that it is connected.
        self.setup.deaths.handle_opening(peer);
        if self.protocol.handle_opened(peer, incarnation, session, platform::now()) {
            self.forget_differences();
        }
        self.with_send_state(peer, PeerSendState::begin);
        self.tell_directory(DirectoryReport::Opened { node, incarnation });
        // What was found lost before a restart is over, too.
        self.report(peer, NodeCondition::InSession);
    }

    /// A message has arrived.
    pub(super) fn handle_message(&mut self, peer: NodeId, message: Bytes) {
        if self.protocol.peers.get(peer).is_some_and(|peer| peer.isolated) {
            debug!(%peer, "an isolated node speaks");
        } else {
            self.protocol.handle_message(peer, message, platform::now());
        }
    }

    /// A message was not delivered; or perhaps it was, if some of it was sent.
    pub(super) fn handle_returned(
        &mut self,
        peer: NodeId,
        message: Bytes,
        why: DeliveryError,
        sent: bool,
    ) {
        let why = self.because(peer, why);
        let sent = if sent { TransmitState::Perhaps } else { TransmitState::Nothing };
        self.protocol.handle_returned(peer, message, why, sent);
    }

    /// A session is over; what was unacknowledged has been returned.
    pub(super) fn session_ended(&mut self, peer: NodeId, why: DeliveryError) {
        let Some(Peer { node, .. }) = self.protocol.peers.get(peer) else { return };
        self.tell_directory(DirectoryReport::Ended { node: node.clone() });
        self.show_closed(peer);
        let why = self.because(peer, why);
        self.protocol.handle_ended(peer, &why);
    }

    /// The session with a peer is over, and held these messages.
    fn discard(&mut self, peer: NodeId, held: Vec<(TrafficClass, Bytes, bool)>) {
        let why = self.protocol.peers.unreachable(peer);
        for (_, message, sent) in held {
            self.handle_returned(peer, message, why.clone(), sent);
        }
        self.session_ended(peer, why);
    }

    /// After a panic, every session begins again. It may have lost an output: what the peers had
    /// here goes, and requests that no session will answer are resolved.
    pub(super) fn restart(&mut self) {
        let peers = self.protocol.peers.ids();
        for peer in &peers {
            let (seed, now) = (platform::random_seed(), platform::now());
            let Some(mut old) = self.protocol.replace_session(*peer, seed, now) else { continue };
            // After a panic, what it holds is given back if it can be read at all.
            let held = panics::caught(|| old.take_unacknowledged());
            self.discard(*peer, held.unwrap_or_default());
        }
        // The output that panicked may not be the only one that does. Each round consumes one.
        while let Err(again) = panics::caught(|| self.carry_out_all()) {
            error!(%again, "a restarted network panics once more");
        }
        for peer in peers {
            let why = self.because(peer, self.protocol.peers.unreachable(peer));
            self.forget(peer, &why);
        }
        let lost = |number: &u64| !self.protocol.is_to_repeat(*number);
        let lost: Vec<_> = self.replies.keys().copied().filter(lost).collect();
        for (node, reply_to) in lost.iter().filter_map(|number| self.replies.remove(number)) {
            let reason = format!("the session with {node} was reopened");
            reply_to(Err(DeliveryError::OutcomeUnknown { reason }));
        }
    }

    /// Isolates a node, or admits it again. Says whether that is a change. What is under way with
    /// an isolated node is resolved, and what it has here goes.
    pub(super) fn handle_isolation(&mut self, node: &NodeName, isolated: bool) -> bool {
        let known = self.protocol.peers.get(NodeId::of(node));
        if known.is_some_and(|known| known.isolated) == isolated {
            return false;
        }
        let peer = self.meet(node);
        let Some(known) = self.protocol.peers.get_mut(peer) else { return false };
        known.isolated = isolated;
        if !isolated {
            // What it sent meanwhile was not read: only a new session makes both agree again.
            known.session.handle_restart(platform::now());
        }
        self.with_send_state(peer, |send_state| send_state.set_isolated(isolated));
        if isolated {
            self.protocol.handle_ended(peer, &DeliveryError::isolated(node));
            self.tell_directory(DirectoryReport::Ended { node: node.clone() });
        }
        true
    }

    pub(super) fn handle_send(&mut self, message: SendToPeer) {
        let SendToPeer { to, contract, id, sent, until, payload, reply_to, credit } = message;
        let reply_as = reply_to.map(|reply_to| {
            let number = self.number();
            self.replies.insert(number, (to.node.clone(), reply_to));
            number
        });
        let ObjectAddress { node, object } = to;
        let credit = Some(credit);
        let call = Call { node, object, contract, id, sent, until, payload, reply_as, credit };
        self.protocol.handle_call(call);
    }

    pub(super) fn handle_local(&mut self, input: LocalInput) {
        let now = platform::now();
        match input {
            LocalInput::Started => self.protocol.handle_started(now),
            // Once nothing waits here, the sessions end.
            LocalInput::Ending => _ = self.leaving.get_or_insert(now + LEAVE_TIMEOUT),
            LocalInput::Reply { peer, epoch, call, result } => {
                self.protocol.handle_answer(peer, epoch, call, result, now);
            }
            LocalInput::Capacity { peer, object } => self.hand_over(peer, object),
            LocalInput::Interest(key) => {
                self.compare_forwards(&key);
                let identities = self.setup.topics.settle_interest(&key.topic);
                self.protocol.handle_interest(topic(&key), identities);
            }
            LocalInput::Event { peer, subscription, losses, event, sent, credit } => {
                let known = self.forwards.get(&(peer, subscription));
                match known.filter(|known| Arc::ptr_eq(&known.losses, &losses)) {
                    Some(known) => {
                        let (number, stream) = known.by;
                        self.protocol.handle_event(peer, number, stream, event, sent, Some(credit))
                    }
                    None => _ = losses.take_late(),
                }
            }
        }
    }

    /// Records what was lost since the last call, and ends what has waited for too long.
    pub(super) fn handle_time(&mut self) {
        self.protocol.handle_time(platform::now());
        self.collect_losses();
    }

    /// Declares what was refused, forbidden and lost since the last call, a second ago.
    pub(super) fn look(&mut self) {
        self.look_at_refusals();
        let access = self.setup.registry.access();
        for node in access.take_floods(FLOOD) {
            let what = "it asks a thousand times a second for what it may not";
            self.offends(NodeId::of(&node), what);
        }
        let is_refused = self.protocol.is_refused_a_subscription();
        self.forbidden.look(&access, is_refused, &self.setup.faults);
        self.look_at_losses();
        self.look_at_topics();
        let GatewaySetup { faults, nodes, .. } = &self.setup;
        self.sessions.look_at_refusals(&mut self.protocol.peers, faults, nodes.as_ref());
        self.sessions.look_at_rates(&self.protocol.peers);
    }

    /// Peers are told whether this node is in the safe state.
    pub(super) fn handle_safe_state(&mut self, message: SafeStateChanged) {
        self.protocol.handle_safe_state(match message {
            SafeStateChanged::Entered { reason } => Some(reason),
            SafeStateChanged::Left => None,
            // The peers see the node leave, and hear of the safe state when it is one.
            SafeStateChanged::Entering | SafeStateChanged::NodeEnds => return,
        });
    }

    pub(super) fn peer_rests(&self, peer: NodeId, reason: Option<String>) {
        let at_work = NodeCondition::AtWork;
        let condition = reason.map_or(at_work, |reason| NodeCondition::InSafeState { reason });
        self.report(peer, condition);
    }

    /// Rosters of peers are checked by this watch.
    pub(super) fn attach_roster_watch(&mut self, watch: Weak<RosterWatch>) {
        self.setup.roster_watch = watch;
    }

    /// What peers may do here is another thing now.
    pub(super) fn handle_roster(&mut self, keys: &NodeKeys) {
        let policy = keys.access_policy();
        self.setup.registry.access().replace(policy.clone());
        self.tell_directory(DirectoryReport::Policy(Box::new(policy.clone())));
        self.protocol.handle_access(policy);
    }

    /// Peers are told of a newer roster.
    pub(super) fn announce_roster(&mut self, keys: &NodeKeys) {
        self.protocol.handle_roster(keys.serial(), keys.roster_text());
    }

    pub(super) fn offer_roster(&self, peer: NodeId, text: &[u8]) {
        let from = self.protocol.peers.get(peer).map(|peer| peer.node.clone());
        let (Some(from), Some(watch)) = (from, self.setup.roster_watch.upgrade()) else { return };
        match str::from_utf8(text) {
            Ok(text) => watch.offer(RosterOffer { from, text: text.to_owned() }),
            Err(error) => warn!(%from, %error, "its roster is no text"),
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
