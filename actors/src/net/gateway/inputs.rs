//! The messages that the gateway handles.

use super::peer::GatewayPeer;
use super::subscriptions::LocalEvent;
use super::{GatewayActor, LEAVE_TIMEOUT, topic};
use crate::net::gateway_messages::{LocalReply, SendToPeer, StartCompleted, TopicInterestChanged};
use crate::net::isolation::IsolationChanged;
use crate::net::stub::PeerCondition;
use crate::platform;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::router::InjectPanic;
use blastema_contract::session::{
    CloseSessions, PeerStatusChanged, ReadDifferences, ResetSession, SessionReported,
};
use blastema_contract::strategy::IsolateNode;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::{Call, TransmitState};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use blastema_core::{DeliveryError, Incarnation, NodeName, ObjectAddress};
use std::sync::Arc;
use tracing::debug;

impl Handler<SessionReported> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: SessionReported, context: &mut Context<Self>) {
        match message {
            SessionReported::Reachable { node, incarnation } => {
                let (peer, send_state) = self.meet(&node);
                self.exchange.handle_reachable(peer);
                if let Some(peer) = self.peers.get_mut(&peer) {
                    peer.left &= peer.incarnation == incarnation;
                    send_state.path_found(incarnation != peer.incarnation);
                }
                if !send_state.has_session() {
                    self.set(peer, PeerCondition::Opening);
                }
            }
            SessionReported::Unreachable { node } => {
                let (peer, send_state) = self.meet(&node);
                self.exchange.handle_unreachable(peer);
                self.wiring.deaths.handle_opening(peer);
                send_state.path_lost();
                if !send_state.has_session() {
                    self.set(peer, PeerCondition::Unreachable);
                }
            }
            SessionReported::Opened { node, incarnation, session } => {
                self.session_opened(node, incarnation, session);
            }
            SessionReported::Message { peer, message } => {
                let send_state = self.peers.get(&peer).map(|peer| &peer.send_state);
                if send_state.is_some_and(|send_state| send_state.is_isolated()) {
                    self.of_isolated += 1;
                    debug!(%peer, of_isolated = self.of_isolated, "an isolated node speaks");
                } else {
                    self.exchange.handle_message(peer, message, platform::now());
                }
            }
            SessionReported::Returned { peer, message, why, sent } => {
                let why = self.because(peer, why);
                let sent = if sent { TransmitState::Perhaps } else { TransmitState::Nothing };
                self.exchange.handle_returned(peer, message, why, sent);
            }
            SessionReported::Ended { peer, why } => self.session_ended(peer, why),
        }
        self.drive(context);
    }
}

impl GatewayActor {
    fn session_opened(&mut self, node: NodeName, incarnation: Incarnation, session: u32) {
        let (id, send_state) = self.meet(&node);
        self.begin_peer(id, session, incarnation);
        // Before the peer learns that it is connected.
        self.wiring.deaths.handle_opening(id);
        self.exchange.handle_opened(id, incarnation, platform::now());
        send_state.begin();
        self.report_peer(&PeerStatusChanged::Opened { node: node.clone(), incarnation });
        if let Some(nodes) = &self.wiring.nodes {
            // What a gateway before this one has found lost is over, too.
            nodes.do_send(NodeReported { node, incarnation, condition: NodeCondition::InSession });
        }
    }

    fn session_ended(&mut self, peer: NodeId, why: DeliveryError) {
        let condition = match self.exchange.is_reachable(peer) {
            true => PeerCondition::Opening,
            false => PeerCondition::Unreachable,
        };
        self.set(peer, condition);
        let why = self.because(peer, why);
        self.exchange.handle_ended(peer, &why);
        self.forget_forbidden(peer);
        if let Some(peer) = self.peers.get(&peer) {
            self.report_peer(&PeerStatusChanged::Ended { node: peer.node.clone() });
        }
    }
}

impl Handler<IsolationChanged> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: IsolationChanged, context: &mut Context<Self>) {
        let IsolationChanged { node, isolated } = message;
        let (peer, _) = self.meet(&node);
        if isolated {
            // What is under way with it is resolved, and what it has here goes.
            let why = DeliveryError::isolated(&node);
            self.exchange.handle_ended(peer, &why);
            self.forget_forbidden(peer);
            self.report_peer(&PeerStatusChanged::Ended { node });
        } else {
            // What it said meanwhile was not heard: only a new session makes both agree again.
            self.wiring.sessions.begin_anew.do_send(ResetSession { peer: Some(peer) });
        }
        self.drive(context);
    }
}

/// A recovery strategy has decided so.
impl Handler<IsolateNode> for GatewayActor {
    type Result = Result<RecoveryDone, RecoveryFailed>;

    fn handle(&mut self, message: IsolateNode, _: &mut Context<Self>) -> Self::Result {
        self.wiring.isolation.decide(message);
        Ok(RecoveryDone::default())
    }
}

impl Handler<SendToPeer> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: SendToPeer, context: &mut Context<Self>) {
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
        self.drive(context);
    }
}

impl Handler<StartCompleted> for GatewayActor {
    type Result = ();

    fn handle(&mut self, _: StartCompleted, context: &mut Context<Self>) {
        self.exchange.handle_started(platform::now());
        self.drive(context);
    }
}

impl Handler<LocalReply> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: LocalReply, context: &mut Context<Self>) {
        let LocalReply { peer, epoch, call, result } = message;
        self.exchange.handle_answer(peer, epoch, call, result, platform::now());
        self.drive(context);
    }
}

impl Handler<LocalEvent> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: LocalEvent, context: &mut Context<Self>) {
        let LocalEvent { peer, subscription, losses, event, sent, credit } = message;
        let known = self.forwards.get(&(peer, subscription));
        match known.filter(|known| Arc::ptr_eq(&known.losses, &losses)) {
            Some(known) => self.exchange.handle_event(peer, known.by, event, sent, Some(credit)),
            None => _ = losses.take_late(),
        }
        self.drive(context);
    }
}

impl Handler<TopicInterestChanged> for GatewayActor {
    type Result = ();

    fn handle(&mut self, message: TopicInterestChanged, context: &mut Context<Self>) {
        let TopicInterestChanged { key } = message;
        self.compare_forwards(&key);
        let identities = self.wiring.topics.settle_interest(&key.topic);
        self.exchange.handle_interest(topic(&key), identities);
        self.drive(context);
    }
}

impl Handler<CloseSessions> for GatewayActor {
    type Result = ();

    fn handle(&mut self, _: CloseSessions, context: &mut Context<Self>) {
        self.leaving = true;
        context.run_later(LEAVE_TIMEOUT, |gateway, context| gateway.leave(context));
        self.drive(context);
    }
}

impl Handler<ReadDifferences> for GatewayActor {
    type Result = MessageResult<ReadDifferences>;

    fn handle(&mut self, _: ReadDifferences, _: &mut Context<Self>) -> Self::Result {
        let of = |peer: &GatewayPeer| (peer.node.clone(), peer.differences().to_vec());
        MessageResult(self.peers.values().map(of).collect())
    }
}

impl Handler<InjectPanic> for GatewayActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the gateway panics on purpose");
    }
}
