//! Gives the newest roster to every node that this one has a session with.
//!
//! ```text
//!  have:    0 │ serial 8
//!  roster:  1 │ signed text
//! ```
//!
//! A node says which serial number it has when a session begins, when it has a newer roster, and from
//! time to time, since a message may find no capacity. The one with the lower number is given the
//! text. It believes the signature of the robot, not the node that sends it.

use super::fault_reporter::FaultReporter;
use super::keys::NodeKeys;
use super::peer_messages::{ActorMessageReceived, PeerChannel};
use super::roster_watch::{RosterChanged, RosterOffer, RosterRefused, RosterWatch};
use crate::registry::Registry;
use crate::runtime::guardian::answers_the_monitor;
use actix::prelude::*;
use blastema_contract::router::InjectPanic;
use blastema_contract::session::PeerStatusChanged;
use blastema_core::net::NodeId;
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{FaultKind, NodeName};
use bytes::Bytes;
use serde::Serialize;
use std::sync::{Arc, Weak};
use std::time::Duration;

/// How often a node says which roster it has. Shorter costs messages; longer leaves a node with an
/// old roster for longer after one was lost.
const HAVE_INTERVAL: Duration = Duration::from_secs(30);

const HAVE: u8 = 0;
const ROSTER: u8 = 1;

/// Speaks with the other nodes of rosters.
pub(super) struct RosterActor {
    keys: Arc<NodeKeys>,
    channel: PeerChannel,
    /// Nodes that a session is open with.
    peers: SortedMap<NodeId, NodeName>,
    /// Those that were asked for their roster, which is newer.
    asked: SortedSet<NodeId>,
    /// It ends with the node's network.
    watch: Weak<RosterWatch>,
    faults: FaultReporter,
}

/// What a node says of its roster.
#[derive(Debug, PartialEq, Eq)]
enum RosterMessage {
    Have(u64),
    Roster(String),
}

impl RosterMessage {
    fn encode(&self) -> Bytes {
        match self {
            RosterMessage::Have(serial) => [&[HAVE][..], &serial.to_be_bytes()].concat().into(),
            RosterMessage::Roster(text) => [&[ROSTER][..], text.as_bytes()].concat().into(),
        }
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        match bytes.split_first()? {
            (&HAVE, serial) => {
                Some(RosterMessage::Have(u64::from_be_bytes(serial.try_into().ok()?)))
            }
            (&ROSTER, text) => Some(RosterMessage::Roster(str::from_utf8(text).ok()?.to_owned())),
            _ => None,
        }
    }
}

/// The roster that a node uses, for display.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct RosterRow {
    /// The robot's name.
    pub robot: NodeName,
    /// Its serial number: of two rosters the one with the higher number counts.
    pub serial: u64,
    /// How many nodes it lists.
    pub nodes: usize,
}

/// Asks for the roster that is used.
#[derive(Message)]
#[rtype(result = "RosterRow")]
pub(super) struct ReadRoster;

/// Takes the rosters of other nodes from now on.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct AttachRosterWatch(pub(super) Weak<RosterWatch>);

impl RosterActor {
    pub(super) fn new(
        keys: Arc<NodeKeys>,
        registry: &Registry,
        faults: FaultReporter,
        reader: Recipient<ActorMessageReceived>,
    ) -> Self {
        let channel = PeerChannel::at(super::named("roster"), registry, reader);
        RosterActor {
            keys,
            channel,
            peers: SortedMap::new(),
            asked: SortedSet::new(),
            watch: Weak::new(),
            faults,
        }
    }

    fn tell_serial(&mut self, node: &NodeName) {
        let have = RosterMessage::Have(self.keys.serial());
        self.channel.send(node, &have.encode());
    }

    fn tell_all(&mut self) {
        let peers: Vec<_> = self.peers.values().cloned().collect();
        peers.iter().for_each(|node| self.tell_serial(node));
    }
}

answers_the_monitor!(RosterActor);

impl Actor for RosterActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(HAVE_INTERVAL, |exchange, _| exchange.tell_all());
    }
}

impl Supervised for RosterActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.started(context);
    }
}

impl Handler<AttachRosterWatch> for RosterActor {
    type Result = ();

    fn handle(&mut self, AttachRosterWatch(watch): AttachRosterWatch, _: &mut Context<Self>) {
        self.watch = watch;
    }
}

impl Handler<PeerStatusChanged> for RosterActor {
    type Result = ();

    fn handle(&mut self, seen: PeerStatusChanged, _: &mut Context<Self>) {
        match seen {
            PeerStatusChanged::Opened { node, .. } => {
                self.tell_serial(&node);
                self.peers.insert(NodeId::of(&node), node);
            }
            PeerStatusChanged::Ended { node } | PeerStatusChanged::Left { node } => {
                self.peers.remove(&NodeId::of(&node));
                self.asked.remove(&NodeId::of(&node));
            }
        }
    }
}

impl Handler<ActorMessageReceived> for RosterActor {
    type Result = ();

    fn handle(&mut self, message: ActorMessageReceived, _: &mut Context<Self>) {
        self.channel.read_one();
        let Some(from) = self.peers.get(&message.from).cloned() else { return };
        let own = self.keys.serial();
        match RosterMessage::decode(&message.bytes) {
            Some(RosterMessage::Have(serial)) if serial < own => {
                let roster = RosterMessage::Roster(self.keys.roster_text().to_owned());
                self.channel.send(&from, &roster.encode());
            }
            Some(RosterMessage::Have(serial)) if serial > own => {
                self.asked.insert(message.from);
                self.tell_serial(&from);
            }
            Some(RosterMessage::Roster(text)) => {
                let was_asked = self.asked.remove(&message.from);
                if let Some(watch) = self.watch.upgrade().filter(|_| was_asked) {
                    watch.offer(RosterOffer { from, text });
                }
            }
            Some(RosterMessage::Have(_)) | None => {}
        }
    }
}

impl Handler<RosterChanged> for RosterActor {
    type Result = ();

    fn handle(&mut self, RosterChanged(keys): RosterChanged, _: &mut Context<Self>) {
        self.keys = keys;
        self.tell_all();
    }
}

impl Handler<RosterRefused> for RosterActor {
    type Result = ();

    fn handle(&mut self, RosterRefused(reason): RosterRefused, _: &mut Context<Self>) {
        match reason {
            Some(reason) => self.faults.declare(FaultKind::CheckFailed, reason),
            None => self.faults.clear(FaultKind::CheckFailed),
        }
    }
}

impl Handler<ReadRoster> for RosterActor {
    type Result = MessageResult<ReadRoster>;

    fn handle(&mut self, _: ReadRoster, _: &mut Context<Self>) -> Self::Result {
        let roster = self.keys.roster();
        let (robot, serial, nodes) = (roster.robot.clone(), roster.serial, roster.nodes().len());
        MessageResult(RosterRow { robot, serial, nodes })
    }
}

impl Handler<InjectPanic> for RosterActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the exchange of rosters panics on purpose");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_as_they_were_and_nothing_else_is_understood() {
        for message in [RosterMessage::Have(7), RosterMessage::Roster("text".to_owned())] {
            let bytes = message.encode();
            assert_eq!(RosterMessage::decode(&bytes), Some(message));
        }
        for bytes in [&[][..], &[0], &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9], &[1, 0xff], &[2]] {
            assert_eq!(RosterMessage::decode(bytes), None);
        }
    }
}
