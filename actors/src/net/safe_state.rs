//! Reports this node's safe state to all other nodes, and receives theirs.
//!
//! A node in the safe state stays on the network: it forwards packets and answers who
//! it is. Without this its peers would find out only by what does not come.

use super::peer_messages::{ActorMessageReceived, PeerChannel};
use crate::registry::Registry;
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::recoverer::SafeStateChanged;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::session::PeerStatusChanged;
use blastema_core::contract::codec;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::sorted::SortedMap;
use blastema_core::{Incarnation, NodeName};
use tracing::warn;

/// The longest reason that is told, in bytes: a panic's text, shortened.
const REASON_MAX: usize = 1024;
/// The most bytes of one message.
const MESSAGE_MAX: usize = REASON_MAX + 16;

/// What the body is made of.
pub(crate) struct RestSetup {
    pub(crate) registry: Registry,
    /// Is told of other nodes.
    pub(crate) nodes: Recipient<NodeReported>,
}

/// Where the body is told and asked.
pub(crate) struct SafeStateRecipients {
    /// How this node is.
    pub(crate) own: Recipient<SafeStateChanged>,
    /// Who can be talked to.
    pub(crate) peers: Recipient<PeerStatusChanged>,
    pub(crate) pings: Recipient<AreYouAlive>,
}

/// Tells, and hears.
pub(crate) struct SafeStateActor {
    channel: PeerChannel,
    /// Why this node is in the safe state, as reported to all peers; `None` if it never was.
    reported: Option<Option<String>>,
    /// Nodes that a session is open with.
    peers: SortedMap<NodeId, (NodeName, Incarnation)>,
    nodes: Recipient<NodeReported>,
}

impl SafeStateActor {
    /// Starts it under the guardian.
    pub(crate) fn start(
        setup: RestSetup,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> SafeStateRecipients {
        let RestSetup { registry, nodes } = setup;
        let make = move |context: &mut Context<Self>| {
            let reader = context.address().recipient();
            let channel = PeerChannel::at(super::named("rest"), &registry, reader);
            SafeStateActor { channel, reported: None, peers: SortedMap::new(), nodes }
        };
        let body = guardian.start(super::named("rest"), arbiter, make);
        SafeStateRecipients {
            own: body.clone().recipient(),
            peers: body.clone().recipient(),
            pings: body.recipient(),
        }
    }

    fn tell(&mut self, node: &NodeName) {
        let Some(reported) = &self.reported else { return };
        // Four bytes a message at most.
        let shortened = reported.as_ref();
        let shortened = shortened.map(|text| text.chars().take(REASON_MAX / 4).collect::<String>());
        let mut bytes = Vec::new();
        if codec::encode_bounded(&shortened, MESSAGE_MAX, &mut bytes).is_ok() {
            self.channel.send(node, &bytes.into());
        }
    }
}

answers_the_monitor!(SafeStateActor);

impl Actor for SafeStateActor {
    type Context = Context<Self>;
}

impl Supervised for SafeStateActor {
    // What it has said, and to whom it can talk, are plain facts.
}

impl Handler<SafeStateChanged> for SafeStateActor {
    type Result = ();

    fn handle(&mut self, message: SafeStateChanged, _: &mut Context<Self>) {
        self.reported = Some(match message {
            SafeStateChanged::Entered { reason } => Some(reason),
            SafeStateChanged::Left => None,
            // The peers see the node leave, and hear of the safe state when it is one.
            SafeStateChanged::Entering | SafeStateChanged::NodeEnds => return,
        });
        let peers: Vec<_> = self.peers.values().map(|(node, _)| node.clone()).collect();
        peers.iter().for_each(|node| self.tell(node));
    }
}

impl Handler<PeerStatusChanged> for SafeStateActor {
    type Result = ();

    fn handle(&mut self, seen: PeerStatusChanged, _: &mut Context<Self>) {
        match seen {
            PeerStatusChanged::Opened { node, incarnation } => {
                self.peers.insert(NodeId::of(&node), (node.clone(), incarnation));
                self.tell(&node);
            }
            PeerStatusChanged::Ended { node } | PeerStatusChanged::Left { node } => {
                self.peers.remove(&NodeId::of(&node));
            }
        }
    }
}

impl Handler<ActorMessageReceived> for SafeStateActor {
    type Result = ();

    fn handle(&mut self, message: ActorMessageReceived, _: &mut Context<Self>) {
        self.channel.read_one();
        let Some((node, incarnation)) = self.peers.get(&message.from).cloned() else { return };
        let condition = match codec::decode_bounded::<_, MESSAGE_MAX>(&message.bytes) {
            Ok(Some(reason)) => NodeCondition::InSafeState { reason },
            Ok(None) => NodeCondition::AtWork,
            Err(error) => return warn!(%node, %error, "what it says of its rest cannot be read"),
        };
        self.nodes.do_send(NodeReported { node, incarnation, condition });
    }
}
