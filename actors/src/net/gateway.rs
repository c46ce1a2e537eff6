//! Between the objects of this node and those of all others.

mod errand;

pub(super) use errand::{Notify, Ship};

use super::NetEnvironment;
use super::door::{Condition, Doors, Gate};
use super::notice;
use crate::guardian::answers_the_monitor;
use crate::host::office::DeadLetterOffice;
use crate::platform;
use crate::registry::{Doorway, Registry, ReplyTo};
use crate::topic::{Forward, ForwardId, TopicKey, Topics};
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::naming::{FindObject, NodeRow, ReadNames};
use blastema_contract::recoverer::Recover;
use blastema_contract::router::PanicOnPurpose;
use blastema_contract::session::{BeginAnew, Leave, Say, SessionReported};
use blastema_core::net::NodeId;
use blastema_core::net::exchange::{Call, Epoch, Exchange, ExchangeOutput, TopicContract};
use blastema_core::net::naming::Naming;
use blastema_core::net::segment::Stream;
use blastema_core::{FaultKind, MessageId, NodeName, ObjectAddress, ObjectName, PeerIdentity, Why};
use bytes::Bytes;
use errand::{Answered, Interested, Noticed, Published};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::Duration;
use tokio::sync::oneshot;
use tracing::{debug, error, warn};

/// How often the registry is looked at for objects that came or went.
const NAMES_INTERVAL: Duration = Duration::from_millis(200);
/// How long a node that ends waits for peers to agree to contracts of messages it has accepted.
const LEAVE_PATIENCE: Duration = Duration::from_millis(500);
/// Events of one subscription that may wait in the gateway's mailbox; beyond, they are dropped.
const EVENTS_MAX: usize = 1024;

/// What the gateway must know after a panic.
struct Wiring {
    registry: Registry,
    topics: Topics,
    recoverer: Option<Recipient<Recover>>,
    sessions: SessionPorts,
    doors: Arc<Doors>,
    dead_letters: DeadLetterOffice,
}

/// What the gateway asks of the sessions.
pub(super) struct SessionPorts {
    pub(super) say: Recipient<Say>,
    pub(super) leave: Recipient<Leave>,
    pub(super) begin_anew: Recipient<BeginAnew>,
}

/// Speaks for the objects of this node.
pub(super) struct Gateway {
    wiring: Wiring,
    exchange: Exchange,
    naming: Naming,
    peers: BTreeMap<NodeId, Peer>,
    /// Where replies go, by our number of the request.
    replies: BTreeMap<u64, (NodeName, ReplyTo)>,
    /// What peers have bound here.
    doorways: BTreeMap<(NodeId, u32), Arc<dyn Doorway>>,
    /// What peers listen to here.
    forwards: BTreeMap<(NodeId, u32), Forwarded>,
    notices: BTreeMap<u64, oneshot::Sender<Confirmed>>,
    next: u64,
    /// Messages without a reply, and events, that did not arrive.
    lost: u64,
    /// The node ends; the sessions follow once nothing waits here.
    leaving: bool,
    /// As of which revision of the registry the peers know our names.
    revision: Option<u64>,
}

struct Peer {
    node: NodeName,
    gate: Arc<Gate>,
    /// The number of the session that was opened last.
    session: u32,
}

struct Forwarded {
    id: ForwardId,
    key: TopicKey,
    /// What the peer takes the events for, until that could be compared.
    unverified: Option<Box<PeerIdentity>>,
    waiting: Arc<AtomicUsize>,
}

impl Gateway {
    pub(super) fn maker(
        environment: &NetEnvironment,
        sessions: SessionPorts,
        doors: Arc<Doors>,
    ) -> impl FnOnce(&mut Context<Self>) -> Self + Send + 'static {
        let NetEnvironment { registry, topics, recoverer, dead_letters, .. } = environment.clone();
        move |_| Gateway {
            wiring: Wiring { registry, topics, recoverer, sessions, doors, dead_letters },
            exchange: Exchange::default(),
            naming: Naming::default(),
            peers: BTreeMap::new(),
            replies: BTreeMap::new(),
            doorways: BTreeMap::new(),
            forwards: BTreeMap::new(),
            notices: BTreeMap::new(),
            next: 0,
            lost: 0,
            leaving: false,
            revision: None,
        }
    }

    /// Listens to the topics that this node's objects listen to.
    fn take_interest(&mut self, context: &mut Context<Self>) {
        let gateway = context.address();
        let interest = move |key: &TopicKey, more| {
            gateway.do_send(Interested { key: key.clone(), more });
        };
        self.wiring.topics.on_interest(Arc::new(interest));
        for (key, identity) in self.wiring.topics.listened() {
            self.exchange.handle_interest(topic(&key), Some(identity));
        }
    }

    fn number(&mut self) -> u64 {
        self.next += 1;
        self.next
    }

    fn drive(&mut self, context: &mut Context<Self>) {
        while let Some(output) = self.exchange.poll_output() {
            self.carry_out(output, context);
        }
        if self.leaving && !self.exchange.is_waiting() {
            self.leave();
        }
    }

    fn say(&self, peer: NodeId, stream: Stream, message: Bytes) {
        let session = self.peers.get(&peer).map_or(0, |peer| peer.session);
        self.wiring.sessions.say.do_send(Say { peer, session, stream, message });
    }

    fn leave(&mut self) {
        if std::mem::take(&mut self.leaving) {
            self.exchange.handle_leave();
            while let Some(ExchangeOutput::Send { peer, stream, message }) =
                self.exchange.poll_output()
            {
                self.say(peer, stream, message);
            }
            self.wiring.sessions.leave.do_send(Leave);
        }
    }

    fn carry_out(&mut self, output: ExchangeOutput, context: &mut Context<Self>) {
        match output {
            ExchangeOutput::Send { peer, stream, message } => {
                self.say(peer, stream, message);
            }
            ExchangeOutput::Bind { peer, epoch, binding, object, identity } => {
                self.bind(peer, epoch, binding, &object, &identity);
            }
            ExchangeOutput::Serve { peer, epoch, binding, call, id, age, payload } => {
                let reply_to =
                    call.map(|call| reply_to(peer, epoch, call, context.address().recipient()));
                self.serve((peer, binding), id, (&payload, age), reply_to);
            }
            ExchangeOutput::Resolve { reply_as, result } => {
                if let Some((_, reply_to)) = self.replies.remove(&reply_as) {
                    reply_to(result);
                }
            }
            ExchangeOutput::Lost { to: Some((object, contract)), why, .. } => {
                self.wiring.dead_letters.take(&object, contract, &why);
            }
            ExchangeOutput::Lost { peer, to: None, why } => {
                self.lost += 1;
                debug!(%peer, %why, "an event did not arrive");
            }
            ExchangeOutput::Full { peer } => self.set(peer, Condition::Full),
            ExchangeOutput::Room { peer } => self.set(peer, Condition::Open),
            ExchangeOutput::Differs { peer, difference } => {
                let node =
                    self.peers.get(&peer).map_or(String::new(), |peer| peer.node.to_string());
                error!(node, "a contract differs: {difference}");
            }
            ExchangeOutput::Subscribe { peer, subscription, topic, identity } => {
                self.subscribe(peer, subscription, &topic, identity, context);
            }
            ExchangeOutput::Unsubscribe { peer, subscription } => {
                self.end_forward((peer, subscription));
            }
            ExchangeOutput::Event { topic, age, payload } => {
                let key = TopicKey::new(&topic.topic, &topic.contract);
                if let Err(why) = self.wiring.topics.inject(&key, &payload, age) {
                    self.lost += 1;
                    debug!(topic = %topic.topic, %why, "an event did not arrive");
                }
            }
            ExchangeOutput::Notice { peer, epoch, number, payload } => {
                self.pass_notice(peer, epoch, number, &payload, context);
            }
            ExchangeOutput::Noticed { number, arrived } => {
                // Dropped unanswered, the notifier knows that it has to try again.
                if let (Some(confirm), true) = (self.notices.remove(&number), arrived) {
                    let _ = confirm.send(Confirmed);
                }
            }
            ExchangeOutput::Names { peer, announcement } => {
                self.naming.handle_announcement(peer, announcement);
            }
            ExchangeOutput::Bye { peer } => debug!(%peer, "a node leaves in order"),
            ExchangeOutput::Forget { peer } => self.forget(peer),
        }
    }

    fn bind(
        &mut self,
        peer: NodeId,
        epoch: Epoch,
        binding: u32,
        object: &ObjectName,
        identity: &PeerIdentity,
    ) {
        let result = match self.wiring.registry.doorway(object, &identity.name) {
            Err(why) => Err((why, None)),
            Ok((known, doorway)) => match known.check(identity) {
                Ok(()) => {
                    self.doorways.insert((peer, binding), doorway);
                    Ok(())
                }
                Err(difference) => {
                    let difference = difference.to_string();
                    error!(%object, "a peer's contract differs: {difference}");
                    doorway.declare(FaultKind::ContractMismatch, difference.clone());
                    Err((Why::ContractDiffers { difference }, Some(known)))
                }
            },
        };
        self.exchange.handle_bound(peer, epoch, binding, result);
    }

    fn serve(
        &mut self,
        binding: (NodeId, u32),
        id: Option<MessageId>,
        (payload, age): (&[u8], Duration),
        reply_to: Option<ReplyTo>,
    ) {
        match (self.doorways.get(&binding), reply_to) {
            (Some(doorway), reply_to) => {
                // The object's own dead letters tell of what it did not take.
                let _ = doorway.deliver(payload, id, reply_to, age);
            }
            (None, Some(reply_to)) => reply_to(Err(Why::Unknown { name: "binding".into() })),
            (None, None) => self.lost += 1,
        }
    }

    fn subscribe(
        &mut self,
        peer: NodeId,
        subscription: u32,
        topic: &TopicContract,
        theirs: Box<PeerIdentity>,
        context: &mut Context<Self>,
    ) {
        let key = TopicKey::new(&topic.topic, &topic.contract);
        let ours = self.wiring.topics.identity(&key);
        if let Some(Err(difference)) = ours.as_ref().map(|ours| ours.check(&theirs)) {
            let difference = difference.to_string();
            error!(topic = %topic.topic, "a listener's contract differs: {difference}");
            let why = Why::ContractDiffers { difference };
            self.exchange.handle_subscribe_refused(peer, subscription, why);
            return;
        }
        let Some(known) = self.peers.get(&peer) else { return };
        let (gate, gateway) = (known.gate.clone(), context.address());
        let waiting = Arc::new(AtomicUsize::new(0));
        let under_way = waiting.clone();
        let forward: Forward = Arc::new(move |event: &Bytes| {
            // Publishing never waits: what a peer cannot take now is not sent.
            if gate.is_open() && under_way.load(Relaxed) < EVENTS_MAX {
                under_way.fetch_add(1, Relaxed);
                let (event, sent) = (event.clone(), platform::now());
                gateway.do_send(Published { peer, subscription, event, sent });
            }
        });
        self.end_forward((peer, subscription));
        let id = self.wiring.topics.forward(&key, forward);
        let unverified = ours.is_none().then_some(theirs);
        self.forwards.insert((peer, subscription), Forwarded { id, key, unverified, waiting });
    }

    fn end_forward(&mut self, forward: (NodeId, u32)) {
        if let Some(Forwarded { id, .. }) = self.forwards.remove(&forward) {
            self.wiring.topics.end_forward(&id);
        }
    }

    /// Before the first event: the topic had no contract here when the peer subscribed.
    fn verify(&mut self, forward: (NodeId, u32)) -> Result<(), Why> {
        let Some(known) = self.forwards.get_mut(&forward) else {
            return Err(Why::Unknown { name: "subscription".into() });
        };
        let Some(theirs) = known.unverified.take() else { return Ok(()) };
        match self.wiring.topics.identity(&known.key).map(|ours| ours.check(&theirs)) {
            Some(Err(difference)) => {
                Err(Why::ContractDiffers { difference: difference.to_string() })
            }
            _ => Ok(()),
        }
    }

    fn pass_notice(
        &mut self,
        peer: NodeId,
        epoch: Epoch,
        number: u64,
        payload: &[u8],
        context: &mut Context<Self>,
    ) {
        let fault = match notice::decode(payload, platform::now()) {
            Ok(fault) => fault,
            Err(error) => return warn!(%peer, %error, "a fault that cannot be read"),
        };
        let Some(recoverer) = &self.wiring.recoverer else { return };
        let (taken, gateway) = (recoverer.send(Recover { fault }), context.address());
        actix_rt::spawn(async move {
            if taken.await.is_ok() {
                gateway.do_send(Noticed { peer, epoch, number });
            }
        });
    }

    /// The session is over: what the peer had here goes with it.
    fn forget(&mut self, peer: NodeId) {
        let all = (peer, 0)..=(peer, u32::MAX);
        let doorways: Vec<_> = self.doorways.range(all.clone()).map(|(key, _)| *key).collect();
        doorways.iter().for_each(|key| drop(self.doorways.remove(key)));
        let forwards: Vec<_> = self.forwards.range(all).map(|(key, _)| *key).collect();
        forwards.into_iter().for_each(|key| self.end_forward(key));
    }

    fn meet(&mut self, node: &NodeName) -> (NodeId, Arc<Gate>) {
        let peer = NodeId::of(node);
        let gate = self.wiring.doors.gate(node);
        let known = Peer { node: node.clone(), gate: gate.clone(), session: 0 };
        self.peers.entry(peer).or_insert(known);
        (peer, gate)
    }

    fn set(&self, peer: NodeId, condition: Condition) {
        if let Some(peer) = self.peers.get(&peer) {
            peer.gate.set(condition);
        }
    }

    fn look_for_names(&mut self, context: &mut Context<Self>) {
        let revision = Some(self.wiring.registry.revision());
        if std::mem::replace(&mut self.revision, revision) == revision {
            return;
        }
        let objects = self.wiring.registry.objects().into_iter().map(|(name, _)| name).collect();
        for announcement in self.naming.handle_own(objects) {
            self.exchange.handle_own_names(None, &announcement, platform::now());
        }
        self.drive(context);
    }
}

fn topic(key: &TopicKey) -> TopicContract {
    TopicContract { topic: key.topic.to_string(), contract: key.contract.to_string() }
}

/// Brings an answer back to the gateway, whichever thread gives it.
fn reply_to(peer: NodeId, epoch: Epoch, call: u64, gateway: Recipient<Answered>) -> ReplyTo {
    Box::new(move |result| gateway.do_send(Answered { peer, epoch, call, result }))
}

answers_the_monitor!(Gateway);

impl Actor for Gateway {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.take_interest(context);
        self.look_for_names(context);
        context.run_interval(NAMES_INTERVAL, |gateway, context| gateway.look_for_names(context));
    }
}

impl Supervised for Gateway {
    /// Every promise is resolved, and every session begins anew, so that both ends agree again.
    fn restarting(&mut self, context: &mut Context<Self>) {
        for (node, reply_to) in std::mem::take(&mut self.replies).into_values() {
            reply_to(Err(Why::Unreachable { node: node.to_string() }));
        }
        let forwards: Vec<_> = self.forwards.keys().copied().collect();
        forwards.into_iter().for_each(|key| self.end_forward(key));
        self.doorways.clear();
        self.notices.clear();
        self.exchange = self.exchange.reborn();
        self.naming = Naming::default();
        self.revision = None;
        self.peers.values().for_each(|peer| peer.gate.set(Condition::Opening));
        let peers: Vec<_> = self.peers.keys().copied().collect();
        peers.into_iter().for_each(|peer| self.exchange.handle_reachable(peer, true));
        self.wiring.sessions.begin_anew.do_send(BeginAnew);
        self.started(context);
    }
}

impl Handler<SessionReported> for Gateway {
    type Result = ();

    fn handle(&mut self, message: SessionReported, context: &mut Context<Self>) {
        match message {
            SessionReported::Reachable { node } => {
                let (peer, gate) = self.meet(&node);
                self.exchange.handle_reachable(peer, true);
                if !gate.has_session() {
                    gate.set(Condition::Opening);
                }
            }
            SessionReported::Unreachable { node } => {
                let (peer, gate) = self.meet(&node);
                self.exchange.handle_reachable(peer, false);
                if !gate.has_session() {
                    gate.set(Condition::Unreachable);
                }
            }
            SessionReported::Opened { node, incarnation, session } => {
                let (peer, gate) = self.meet(&node);
                self.peers.entry(peer).and_modify(|peer| peer.session = session);
                self.exchange.handle_opened(peer, platform::now());
                for announcement in self.naming.handle_opened(node, incarnation) {
                    let now = platform::now();
                    self.exchange.handle_own_names(Some(peer), &announcement, now);
                }
                gate.set(Condition::Open);
            }
            SessionReported::Message { peer, message } => {
                self.exchange.handle_message(peer, message, platform::now());
            }
            SessionReported::Returned { peer, message, why } => {
                self.exchange.handle_returned(peer, message, why);
            }
            SessionReported::Ended { peer, why } => {
                let condition = match self.exchange.is_reachable(peer) {
                    true => Condition::Opening,
                    false => Condition::Unreachable,
                };
                self.set(peer, condition);
                self.exchange.handle_ended(peer, &why);
                self.naming.handle_ended(peer);
            }
            SessionReported::Full { peer } => self.set(peer, Condition::Full),
            SessionReported::Room { peer } => self.set(peer, Condition::Open),
        }
        self.drive(context);
    }
}

impl Handler<Ship> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Ship, context: &mut Context<Self>) {
        let Ship { to, contract, id, sent, payload, reply_to, gate } = message;
        gate.taken();
        let reply_as = reply_to.map(|reply_to| {
            let number = self.number();
            self.replies.insert(number, (to.node.clone(), reply_to));
            number
        });
        let ObjectAddress { node, object } = to;
        self.exchange.handle_call(Call { node, object, contract, id, sent, payload, reply_as });
        self.drive(context);
    }
}

impl Handler<Answered> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Answered, context: &mut Context<Self>) {
        let Answered { peer, epoch, call, result } = message;
        self.exchange.handle_answer(peer, epoch, call, result);
        self.drive(context);
    }
}

impl Handler<Published> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Published, context: &mut Context<Self>) {
        let Published { peer, subscription, event, sent } = message;
        if let Some(forwarded) = self.forwards.get(&(peer, subscription)) {
            forwarded.waiting.fetch_sub(1, Relaxed);
        }
        match self.verify((peer, subscription)) {
            Ok(()) => self.exchange.handle_event(peer, subscription, event, sent),
            Err(why @ Why::ContractDiffers { .. }) => {
                error!("a listener's contract differs: {why}");
                self.end_forward((peer, subscription));
                self.exchange.handle_subscribe_refused(peer, subscription, why);
            }
            Err(_) => self.lost += 1,
        }
        self.drive(context);
    }
}

impl Handler<Interested> for Gateway {
    type Result = ();

    fn handle(&mut self, message: Interested, context: &mut Context<Self>) {
        let Interested { key, more } = message;
        let identity = self.wiring.topics.identity(&key).filter(|_| more);
        self.exchange.handle_interest(topic(&key), identity);
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
        MessageResult(self.naming.find(&message.object))
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

impl Handler<PanicOnPurpose> for Gateway {
    type Result = ();

    fn handle(&mut self, _: PanicOnPurpose, _: &mut Context<Self>) {
        panic!("the gateway panics on purpose");
    }
}
