//! A link on a bus, where one frame carries the hellos to all neighbours.

use super::{Link, LinkConfig, percent};
use crate::Instant;
use crate::net::wire::bus_hello::{BusHello, CompactEcho, NeighbourEntry};
use crate::net::wire::frame::{Echo, Hello};
use crate::net::wire::hello_state::HelloState;
use crate::net::wire::node_id::NodeId;

impl Link {
    /// From now on hellos are said to all links of a bus at once: this one only says when one is
    /// due.
    pub(in crate::net) fn join_bus(&mut self) {
        self.on_bus = true;
    }

    /// The number of the greeting that is due, once.
    pub(in crate::net) fn take_greeting(&mut self) -> Option<u32> {
        self.greeting.take()
    }

    /// What the next greeting says to the neighbour; `None` while there is nothing to say.
    pub(in crate::net) fn word(&self, now: Instant) -> Option<NeighbourEntry> {
        let Hello { stance, loss_permille, echo, .. } = self.hello(now, 0);
        let echo = echo.map(|Echo { incarnation, sequence, held_us }| CompactEcho {
            incarnation: incarnation.0 as u16,
            sequence: sequence as u16,
            held_us,
        });
        let to = NodeId::of(&self.neighbour()?.node);
        Some(NeighbourEntry { to, stance, loss_permille, echo })
    }

    /// A greeting in our name.
    pub(in crate::net) fn greeting(
        &self,
        sequence: u32,
        turn: u8,
        words: Vec<NeighbourEntry>,
    ) -> BusHello {
        let LinkConfig { node, incarnation, .. } = &self.config;
        BusHello {
            node: node.clone(),
            incarnation: *incarnation,
            sequence,
            interval_us: u32::try_from(self.hello_interval.as_micros()).unwrap_or(u32::MAX),
            turn,
            words,
        }
    }

    /// Whether a hello of the neighbour is not long overdue: those who are not there need no word.
    pub(in crate::net) fn is_received(&self, now: Instant) -> bool {
        self.neighbour.as_ref().is_some_and(|record| {
            let patience = percent(record.arrivals.interval(), self.down_after_percent());
            now <= record.arrivals.expected() + patience
        })
    }

    pub(super) fn handle_greeting(&mut self, greeting: BusHello, now: Instant) {
        let BusHello { node, incarnation, sequence, interval_us, turn, words } = greeting;
        let own = NodeId::of(&self.config.node);
        let word = words.into_iter().find(|word| word.to == own);
        let known = self.neighbour.as_ref().filter(|record| {
            record.neighbour.node == node && record.neighbour.incarnation == incarnation
        });
        // Where none is for us, it stands as it was said last.
        let reported =
            known.map_or((HelloState::Unproved, 0), |record| (record.stance, record.loss_there));
        let (stance, loss_permille) =
            word.map_or(reported, |word| (word.stance, word.loss_permille));
        let echo = word.and_then(|word| self.echo(word.echo?));
        let skipped = 0;
        let hello = Hello {
            node,
            incarnation,
            sequence,
            interval_us,
            skipped,
            stance,
            loss_permille,
            echo,
        };
        self.handle_hello(hello, now);
        if let Some(record) = &mut self.neighbour {
            record.turn = u32::from(turn.max(1));
        }
    }

    /// An echo in full, if it is of this incarnation of ours.
    fn echo(&self, short: CompactEcho) -> Option<Echo> {
        let CompactEcho { incarnation: tag, sequence, held_us } = short;
        let incarnation = self.config.incarnation;
        let last = self.sent.back().map(|(number, _)| *number)?;
        let back = (last as u16).wrapping_sub(sequence);
        let sequence = last.wrapping_sub(back.into());
        (tag == incarnation.0 as u16).then_some(Echo { incarnation, sequence, held_us })
    }
}
