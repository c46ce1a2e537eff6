//! What the network's stack tells the gateway.

use super::local::LocalInput;
use super::{DiscardedSession, ObjectGateway, topic};
use crate::net::gateway_messages::SendToPeer;
use crate::net::stub::PeerCondition;
use crate::platform;
use blastema_contract::monitor::NodeReported;
use blastema_contract::session::DirectoryReport;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::{Call, TransmitState};
use blastema_core::{DeliveryError, Incarnation, NodeName, ObjectAddress};
use bytes::Bytes;
use std::sync::Arc;
use std::time::Duration;
use tracing::debug;

/// How long a node that ends waits for peers to agree to contracts of messages it has accepted.
const LEAVE_TIMEOUT: Duration = Duration::from_millis(500);

impl ObjectGateway {
    /// A node can be reached; a session will begin.
    pub(in crate::net) fn handle_reachable(&mut self, node: &NodeName, incarnation: Incarnation) {
        let (peer, send_state) = self.meet(node);
        self.exchange.handle_reachable(peer);
        let Some(known) = self.peers.get_mut(&peer) else { return };
        let is_newer = known.incarnation != incarnation;
        known.left &= !is_newer;
        send_state.path_found(is_newer);
        if !send_state.has_session() {
            self.set(peer, PeerCondition::Opening);
        } else if !is_newer {
            self.tell_directory(DirectoryReport::Reachable { node: node.clone() });
        }
    }

    /// No path leads to a node any more; its session waits for one for a while.
    pub(in crate::net) fn handle_unreachable(&mut self, node: &NodeName) {
        let (peer, send_state) = self.meet(node);
        self.exchange.handle_unreachable(peer);
        self.wiring.deaths.handle_opening(peer);
        send_state.path_lost();
        self.tell_directory(DirectoryReport::Unreachable { node: node.clone() });
        if !send_state.has_session() {
            self.set(peer, PeerCondition::Unreachable);
        }
    }

    /// A session has begun, which has this number.
    pub(in crate::net) fn session_opened(
        &mut self,
        node: &NodeName,
        incarnation: Incarnation,
        session: u32,
    ) {
        let (id, send_state) = self.meet(node);
        self.begin_peer(id, session, incarnation);
        // Before the peer learns that it is connected.
        self.wiring.deaths.handle_opening(id);
        self.exchange.handle_opened(id, incarnation, platform::now());
        send_state.begin();
        self.tell_directory(DirectoryReport::Opened { node: node.clone(), incarnation });
        if let Some(nodes) = &self.wiring.nodes {
            // What was found lost before a restart is over, too.
            let (node, condition) = (node.clone(), NodeCondition::InSession);
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    /// A message has arrived.
    pub(in crate::net) fn handle_message(&mut self, peer: NodeId, message: Bytes) {
        let send_state = self.peers.get(&peer).map(|peer| &peer.send_state);
        if send_state.is_some_and(|send_state| send_state.is_isolated()) {
            self.of_isolated += 1;
            debug!(%peer, of_isolated = self.of_isolated, "an isolated node speaks");
        } else {
            self.exchange.handle_message(peer, message, platform::now());
        }
    }

    /// A message was not delivered; or perhaps it was, if some of it was sent.
    pub(in crate::net) fn handle_returned(
        &mut self,
        peer: NodeId,
        message: Bytes,
        why: DeliveryError,
        sent: bool,
    ) {
        let why = self.because(peer, why);
        let sent = if sent { TransmitState::Perhaps } else { TransmitState::Nothing };
        self.exchange.handle_returned(peer, message, why, sent);
    }

    /// A session is over; what was unacknowledged has been returned.
    pub(in crate::net) fn session_ended(&mut self, peer: NodeId, why: DeliveryError) {
        let condition = match self.exchange.is_reachable(peer) {
            true => PeerCondition::Opening,
            false => PeerCondition::Unreachable,
        };
        self.set(peer, condition);
        let why = self.because(peer, why);
        self.exchange.handle_ended(peer, &why);
        self.forget_forbidden(peer);
        if let Some(peer) = self.peers.get(&peer) {
            self.tell_directory(DirectoryReport::Ended { node: peer.node.clone() });
        }
    }

    /// A session is over, with all that it held.
    pub(in crate::net) fn session_discarded(&mut self, discarded: DiscardedSession) {
        let DiscardedSession { peer, held, why } = discarded;
        for (_, message, sent) in held {
            self.handle_returned(peer, message, why.clone(), sent);
        }
        self.session_ended(peer, why);
    }

    /// Every session was discarded after a panic, which may have lost an output: what the peers had
    /// here goes, and requests that no session will answer are resolved.
    pub(in crate::net) fn resolve_lost(&mut self) {
        let known = self.peers.iter().map(|(id, peer)| (*id, peer.node.to_string()));
        for (peer, node) in known.collect::<Vec<_>>() {
            let why = self.because(peer, DeliveryError::Unreachable { node });
            self.forget(peer, &why);
        }
        let lost = |number: &u64| !self.exchange.is_to_repeat(*number);
        let lost: Vec<_> = self.replies.keys().copied().filter(lost).collect();
        for (node, reply_to) in lost.iter().filter_map(|number| self.replies.remove(number)) {
            let reason = format!("the session with {node} was reopened");
            reply_to(Err(DeliveryError::OutcomeUnknown { reason }));
        }
    }

    /// A node is isolated: what is under way with it is resolved, and what it has here goes.
    pub(in crate::net) fn handle_isolated(&mut self, node: &NodeName) {
        let (peer, send_state) = self.meet(node);
        send_state.set_isolated(true);
        self.exchange.handle_ended(peer, &DeliveryError::isolated(node));
        self.forget_forbidden(peer);
        self.tell_directory(DirectoryReport::Ended { node: node.clone() });
    }

    /// An isolated node is admitted again.
    pub(in crate::net) fn handle_admitted(&mut self, node: &NodeName) {
        self.meet(node).1.set_isolated(false);
    }

    pub(in crate::net) fn handle_send(&mut self, message: SendToPeer) {
        let SendToPeer { to, contract, id, sent, until, payload, reply_to, credit } = message;
        let reply_as = reply_to.map(|reply_to| {
            let number = self.number();
            self.replies.insert(number, (to.node.clone(), reply_to));
            number
        });
        let ObjectAddress { node, object } = to;
        let credit = Some(credit);
        let call = Call { node, object, contract, id, sent, until, payload, reply_as, credit };
        self.exchange.handle_call(call);
    }

    pub(in crate::net) fn handle_local(&mut self, input: LocalInput) {
        let now = platform::now();
        match input {
            LocalInput::Started => self.exchange.handle_started(now),
            // Once nothing waits here, the sessions end.
            LocalInput::Ending => _ = self.leaving.get_or_insert(now + LEAVE_TIMEOUT),
            LocalInput::Reply { peer, epoch, call, result } => {
                self.exchange.handle_answer(peer, epoch, call, result, now);
            }
            LocalInput::Capacity { peer, object } => self.hand_over(peer, object),
            LocalInput::Interest(key) => {
                self.compare_forwards(&key);
                let identities = self.wiring.topics.settle_interest(&key.topic);
                self.exchange.handle_interest(topic(&key), identities);
            }
            LocalInput::Event { peer, subscription, losses, event, sent, credit } => {
                let known = self.forwards.get(&(peer, subscription));
                match known.filter(|known| Arc::ptr_eq(&known.losses, &losses)) {
                    Some(known) => {
                        self.exchange.handle_event(peer, known.by, event, sent, Some(credit))
                    }
                    None => _ = losses.take_late(),
                }
            }
        }
    }

    /// Records what was lost since the last call, and ends what has waited for too long.
    pub(in crate::net) fn handle_time(&mut self) {
        self.exchange.handle_time(platform::now());
        self.collect_losses();
    }

    /// Declares what was refused, forbidden and lost since the last call, a second ago.
    pub(in crate::net) fn look(&mut self) {
        self.look_at_refusals();
        self.look_at_access();
        self.look_at_losses();
        self.look_at_topics();
    }

    /// Contracts that this node and the peer do not mean alike.
    pub(in crate::net) fn differences(&self, peer: NodeId) -> Vec<String> {
        self.peers.get(&peer).map_or_else(Vec::new, |peer| peer.differences().to_vec())
    }
}
