//! Who is told about a fault: the ports to recoverers, here and on other nodes.

use super::{Handed, Handover, HandoverLimits, Notice};
use crate::{FaultId, Instant, Machine, NodeName};
use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::time::Duration;

/// Hands every fault to every port, and limits storms.
///
/// Each port has a queue of its own, so that a recoverer that cannot be reached holds up nobody else.
/// In a queue, what is over goes first, then critical faults, errors, warnings. A fault is never twice
/// in a queue; one that is over before its turn is taken out again.
#[derive(Clone, Debug)]
pub struct Notifier {
    limits: NotifierLimits,
    ports: BTreeMap<Port, Lane>,
    outputs: VecDeque<NotifierOutput>,
    refused: u64,
}

/// The bounds of a [`Notifier`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotifierLimits {
    /// How many ports there may be.
    pub ports: usize,
    /// The hand-over to the local recoverer.
    pub local: HandoverLimits,
    /// The hand-over to another node's recoverer.
    pub remote: HandoverLimits,
}

impl Default for NotifierLimits {
    fn default() -> Self {
        let remote = HandoverLimits {
            // A round trip over two hops and a change of path takes less.
            patience: Duration::from_millis(250),
            longest: Duration::from_secs(2),
            // What another node's recoverer cannot keep up with helps nobody, and the network has
            // other things to carry.
            per_second: 50,
            capacity: 256,
            ..HandoverLimits::default()
        };
        // A recoverer takes in a fault in microseconds; a robot on which two hundred things break each
        // second is better served by the most important ones.
        let local = HandoverLimits { per_second: 200, ..HandoverLimits::default() };
        // A robot of more than thirty nodes tells the rest over its fleet.
        NotifierLimits { ports: 32, local, remote }
    }
}

/// Whose recoverer is told.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Port {
    /// This node's.
    Local,
    /// Another node's.
    Remote(NodeName),
}

impl fmt::Display for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Port::Local => f.write_str("here"),
            Port::Remote(node) => write!(f, "{node}"),
        }
    }
}

/// What a [`Notifier`] wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum NotifierOutput {
    /// Hand this to the recoverer behind this port, and bring its confirmation to
    /// [`Notifier::handle_confirmed`].
    HandOver {
        /// Which port.
        port: Port,
        /// The number under which it is confirmed.
        number: u64,
        /// What the recoverer must know.
        notice: Notice,
    },
    /// The recoverer never confirmed this, or there was no room: tell a person.
    GivenUp {
        /// Which port.
        port: Port,
        /// What the recoverer should have known.
        notice: Notice,
        /// How often it was sent.
        tries: u32,
    },
}

/// How the hand-overs of one port stand.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct PortRow {
    /// Which port.
    pub port: Port,
    /// How many notices wait or are under way.
    pub pending: usize,
    /// How many were confirmed.
    pub confirmed: u64,
    /// How many were not handed over because the same fault waited already, or was over in time.
    pub suppressed: u64,
    /// How many had to wait because more came than may be handed over in a second.
    pub held_back: u64,
    /// How many were given up.
    pub given_up: u64,
}

#[derive(Clone, Debug)]
struct Lane {
    handover: Handover<Notice>,
    confirmed: u64,
    suppressed: u64,
}

impl Notifier {
    /// A notifier without ports.
    pub fn new(limits: NotifierLimits) -> Self {
        Notifier { limits, ports: BTreeMap::new(), outputs: VecDeque::new(), refused: 0 }
    }

    /// Opens a port; no, if there are too many. A port that is open stays as it is.
    pub fn add_port(&mut self, port: Port, now: Instant) -> bool {
        if self.ports.len() >= self.limits.ports && !self.ports.contains_key(&port) {
            self.refused += 1;
            return false;
        }
        let limits = match port {
            Port::Local => self.limits.local,
            Port::Remote(_) => self.limits.remote,
        };
        let fresh = || Lane {
            handover: Handover::new(limits, now.as_nanos()),
            confirmed: 0,
            suppressed: 0,
        };
        self.ports.entry(port).or_insert_with(fresh);
        true
    }

    /// Closes a port and forgets what waits there.
    pub fn remove_port(&mut self, port: &Port) {
        self.ports.remove(port);
    }

    /// The detector hands over what all recoverers must know.
    pub fn handle_notice(&mut self, notice: Notice, now: Instant) {
        for lane in self.ports.values_mut() {
            lane.take(&notice, now);
        }
        self.collect();
    }

    /// A recoverer has confirmed.
    pub fn handle_confirmed(&mut self, port: &Port, number: u64, now: Instant) {
        if let Some(lane) = self.ports.get_mut(port) {
            let before = lane.handover.pending();
            lane.handover.handle_confirmed(number, now);
            lane.confirmed += u64::from(lane.handover.pending() < before);
        }
        self.collect();
    }

    /// A notice is known not to have reached the recoverer.
    pub fn handle_failed(&mut self, port: &Port, number: u64, now: Instant) {
        if let Some(lane) = self.ports.get_mut(port) {
            lane.handover.handle_failed(number, now);
        }
        self.collect();
    }

    /// How the hand-overs stand, port by port.
    pub fn read_ports(&self) -> Vec<PortRow> {
        let row = |(port, lane): (&Port, &Lane)| PortRow {
            port: port.clone(),
            pending: lane.handover.pending(),
            confirmed: lane.confirmed,
            suppressed: lane.suppressed,
            held_back: lane.handover.held_back(),
            given_up: lane.handover.given_up(),
        };
        self.ports.iter().map(row).collect()
    }

    /// How many ports were refused because there were too many.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// A notifier that knows the same plain facts, for a body that was struck in the middle of an input.
    #[must_use]
    pub fn reborn(self, now: Instant) -> Self {
        let renew = |(port, lane): (Port, Lane)| {
            (port, Lane { handover: lane.handover.reborn(now), ..lane })
        };
        let ports = self.ports.into_iter().map(renew).collect();
        let mut notifier = Notifier { ports, outputs: VecDeque::new(), ..self };
        notifier.collect();
        notifier
    }

    fn collect(&mut self) {
        for (port, lane) in &mut self.ports {
            while let Some(handed) = lane.handover.poll_output() {
                let port = port.clone();
                self.outputs.push_back(match handed {
                    Handed::Deliver { number, item } => {
                        NotifierOutput::HandOver { port, number, notice: item }
                    }
                    Handed::GivenUp { item, tries } => {
                        NotifierOutput::GivenUp { port, notice: item, tries }
                    }
                });
            }
        }
    }
}

impl Lane {
    fn take(&mut self, notice: &Notice, now: Instant) {
        let id: FaultId = notice.id();
        let waited = self.handover.withdraw(|waiting| waiting.id() == id).is_some();
        self.suppressed += u64::from(waited);
        match notice {
            // Nobody behind this port has heard of it: there is nothing to take back.
            Notice::Cleared { .. } if waited => {}
            Notice::Found(_) if self.handover.under_way().map(Notice::id) == Some(id) => {
                self.suppressed += 1;
            }
            notice => self.handover.hand(notice.rank(), notice.clone(), now),
        }
    }
}

impl Machine for Notifier {
    type Output = NotifierOutput;

    fn poll_output(&mut self) -> Option<NotifierOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.ports.values().filter_map(|lane| lane.handover.poll_timeout()).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        for lane in self.ports.values_mut() {
            lane.handover.handle_timeout(now);
        }
        self.collect();
    }
}
