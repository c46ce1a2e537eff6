//! What the gateway is told and asked.

use super::peer::Peer;
use super::{Gateway, LEAVE_PATIENCE, topic};
use crate::net::gateway_messages::{Answered, Interested, Noticed, Notify, Published, Ship};
use crate::net::isolation::KeptOut;
use crate::net::stub::Condition;
use crate::platform;
use actix::prelude::*;
use blastema_contract::naming::{FindObject, FoundObject, NodeRow, ReadDifferences, ReadNames};
use blastema_contract::router::PanicOnPurpose;
use blastema_contract::session::{BeginAnew, Leave, PeerSeen, SessionReported};
use blastema_contract::strategy::IsolateNode;
use blastema_core::net::NodeId;
use blastema_core::net::isolation::{Decision, NoSay};
use blastema_core::net::peer_protocol::{Call, Sent};
use blastema_core::recovery::{Done, Failed};
use blastema_core::{Incarnation, NodeName, ObjectAddress, ObjectName, Why};
use tracing::debug;

impl Handler<SessionReported> for Gateway {
    type Result = ();

    fn handle(&mut self, message: SessionReported, context: &mut Context<Self>) {
        match message {
            SessionReported::Reachable { node, incarnation } => {
                let (peer, gate) = self.meet(&node);
                self.exchange.handle_reachable(peer);
                gate.path_found();
                self.peers
                    .entry(peer)
                    .and_modify(|peer| peer.left &= peer.incarnation == incarnation);
                if !gate.has_session() {
                    self.set(peer, Condition::Opening);
                }
            }
            SessionReported::Unreachable { node } => {
                let (peer, gate) = self.meet(&node);
                self.exchange.handle_unreachable(peer);
                gate.path_lost();
                if !gate.has_session() {
                    self.set(peer, Condition::Unreachable);
                }
            }
            SessionReported::Opened { node, incarnation, session } => {
                self.session_opened(node, incarnation, session);
            }
            SessionReported::Message { peer, message } => {
                let gate = self.peers.get(&peer).map(|peer| &peer.gate);
                if gate.is_some_and(|gate| gate.is_isolated()) {
                    self.kept_out += 1;
                    debug!(%peer, kept_out = self.kept_out, "an isolated node speaks");
                } else {
                    self.exchange.handle_message(peer, message, platform::now());
                }
            }
            SessionReported::Returned { peer, message, why, sent } => {
                let why = self.because(peer, why);
                let sent = if sent { Sent::Perhaps } else { Sent::Nothing };
                self.exchange.handle_returned(peer, message, why, sent);
            }
            SessionReported::Ended { peer, why } => self.session_ended(peer, why),
            SessionReported::Full { peer, stream, load } => {
                self.at_gate(peer, |gate| gate.stream_is_full(stream, load))
            }
            SessionReported::Room { peer, stream, load } => {
                self.at_gate(peer, |gate| gate.stream_has_room(stream, load))
            }
        }
        self.drive(context);
    }
}

impl Gateway {
    fn session_opened(&mut self, node: NodeName, incarnation: Incarnation, session: u32) {
        let (id, gate) = self.meet(&node);
        self.peers.entry(id).and_modify(|peer| peer.begin(session, incarnation));
        self.forget_past(id);
        let now = platform::now();
        self.exchange.handle_opened(id, incarnation, now);
        for announcement in self.naming.handle_opened(node.clone(), incarnation) {
            self.exchange.handle_own_names(Some(id), &announcement, now);
        }
        gate.begin();
        self.wiring.wardens.opened(node.clone());
        self.tell_envoys(&PeerSeen::Opened { node, incarnation });
    }

    fn session_ended(&mut self, peer: NodeId, why: Why) {
        let condition = match self.exchange.is_reachable(peer) {
            true => Condition::Opening,
            false => Condition::Unreachable,
        };
        self.set(peer, condition);
        let why = self.because(peer, why);
        self.exchange.handle_ended(peer, &why);
        self.naming.handle_ended(peer);
        if let Some(peer) = self.peers.get(&peer) {
            self.wiring.wardens.ended(&peer.node);
            self.tell_envoys(&PeerSeen::Ended { node: peer.node.clone() });
        }
    }
}

impl Handler<KeptOut> for Gateway {
    type Result = ();

    fn handle(&mut self, message: KeptOut, context: &mut Context<Self>) {
        let KeptOut { node, isolated } = message;
        let (peer, _) = self.meet(&node);
        if isolated {
            // What is under way with it is resolved, and what it has here goes.
            self.exchange.handle_ended(peer, &Why::Isolated);
            self.naming.handle_ended(peer);
            self.tell_envoys(&PeerSeen::Ended { node });
        } else {
            // What it said meanwhile was not heard: only a new session makes both agree again.
            self.wiring.sessions.begin_anew.do_send(BeginAnew { peer: Some(peer) });
        }
        self.drive(context);
    }
}

/// A recovery strategy has decided so.
impl Handler<IsolateNode> for Gateway {
    type Result = Result<Done, Failed>;

    fn handle(&mut self, message: IsolateNode, _: &mut Context<Self>) -> Self::Result {
        let IsolateNode { node, isolated, cause } = &message;
        let decision = Decision { node, isolated: *isolated, cause };
        match self.wiring.wardens.carry_decision_out(decision) {
            Ok(()) => Ok(Done::default()),
            Err(NoSay::Oneself) => Err(format!("{node} has no say on itself").into()),
            Err(NoSay::TooMany { limit }) => {
                Err(format!("this node has voted on {limit} others already: admit one of them")
                    .into())
            }
        }
    }
}

impl Handler<Ship> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Ship, context: &mut Context<Self>) {
        let Ship { to, contract, id, sent, until, payload, reply_to, credit } = message;
        self.credit = Some(credit);
        let reply_as = reply_to.map(|reply_to| {
            let number = self.number();
            self.replies.insert(number, (to.node.clone(), reply_to));
            number
        });
        let ObjectAddress { node, object } = to;
        let call = Call { node, object, contract, id, sent, until, payload, reply_as };
        self.exchange.handle_call(call);
        self.drive(context);
        self.credit = None;
    }
}

impl Handler<Answered> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Answered, context: &mut Context<Self>) {
        let Answered { peer, epoch, call, result } = message;
        self.exchange.handle_answer(peer, epoch, call, result, platform::now());
        self.drive(context);
    }
}

impl Handler<Published> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Published, context: &mut Context<Self>) {
        let Published { peer, subscription, event, sent, credit } = message;
        self.credit = Some(credit);
        match self.verify((peer, subscription)) {
            Ok(by) => self.exchange.handle_event(peer, by, event, sent),
            Err(why @ Why::ContractDiffers { .. }) => {
                self.differs(peer, &why.to_string());
                self.retire((peer, subscription), &why);
                self.bury_late((peer, subscription));
                self.exchange.handle_subscribe_refused(peer, subscription, why);
            }
            Err(_) => self.bury_late((peer, subscription)),
        }
        self.drive(context);
        self.credit = None;
    }
}

impl Handler<Interested> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Interested, context: &mut Context<Self>) {
        let Interested { key, more } = message;
        let identities = if more { self.wiring.topics.identities(&key) } else { Vec::new() };
        self.exchange.handle_interest(topic(&key), identities);
        self.drive(context);
    }
}

impl Handler<Notify> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Notify, context: &mut Context<Self>) {
        let Notify { peer, payload, confirm } = message;
        let number = self.number();
        self.notices.insert(number, confirm);
        self.exchange.handle_notice(peer, number, payload);
        self.drive(context);
    }
}

impl Handler<Noticed> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Noticed, context: &mut Context<Self>) {
        let Noticed { peer, epoch, number } = message;
        self.exchange.handle_noticed(peer, epoch, number);
        self.drive(context);
    }
}

impl Handler<Leave> for Gateway {
    type Result = ();

    fn handle(&mut self, _: Leave, context: &mut Context<Self>) {
        self.leaving = true;
        context.run_later(LEAVE_PATIENCE, |gateway, _| gateway.leave());
        self.drive(context);
    }
}

impl Handler<FindObject> for Gateway {
    type Result = MessageResult<FindObject>;

    fn handle(&mut self, message: FindObject, _: &mut Context<Self>) -> Self::Result {
        let found = self.naming.find(&message.object).into_iter().map(|address| {
            let reachable = self.exchange.is_reachable(NodeId::of(&address.node));
            FoundObject { address, reachable }
        });
        MessageResult(found.collect())
    }
}

impl Handler<ReadNames> for Gateway {
    type Result = MessageResult<ReadNames>;

    fn handle(&mut self, _: ReadNames, _: &mut Context<Self>) -> Self::Result {
        let rows = self.naming.nodes().map(|(node, incarnation, objects)| {
            let address = |object: &ObjectName| ObjectAddress::new(node.clone(), object.clone());
            let objects = objects.iter().map(address).collect();
            NodeRow { node: node.clone(), incarnation, objects }
        });
        MessageResult(rows.collect())
    }
}

impl Handler<ReadDifferences> for Gateway {
    type Result = MessageResult<ReadDifferences>;

    fn handle(&mut self, _: ReadDifferences, _: &mut Context<Self>) -> Self::Result {
        let of = |peer: &Peer| (peer.node.clone(), peer.differences().to_vec());
        MessageResult(self.peers.values().map(of).collect())
    }
}

impl Handler<PanicOnPurpose> for Gateway {
    type Result = ();

    fn handle(&mut self, _: PanicOnPurpose, _: &mut Context<Self>) {
        panic!("the gateway panics on purpose");
    }
}
