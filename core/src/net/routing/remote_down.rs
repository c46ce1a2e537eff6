//! A link that carries no more at one end, while the other end does not know of it.
//!
//! ```text
//!  A ═╳═ switch ══════ B      A's interface has lost its carrier; B's has not
//!  A ──── C ────────── B      A announces its links without B: B need not wait for hellos
//!  A ───gave up 1───── B      of several links with B, A names the one: B has said what it calls it
//! ```
//!
//! What is missing in the neighbour's newest announcement, and was in the one before, has been
//! withdrawn; what was in neither is not announced yet, and says nothing. Where others can lie in
//! its name, without keys, the link becomes suspect, and dear, which diverts traffic where there is
//! another way; it goes on as soon as the neighbour's hellos say the contrary, and then such words
//! do not count for a while.

use super::{Router, RouterOutput};
use crate::net::routing::topology::Adjacency;
use crate::net::wire::advertisement::{Advertisement, Edge, NEIGHBOURS_MAX, RoutingMessage};
use crate::net::wire::link_id::LinkId;

impl Router {
    /// A link is down: its neighbour learns which by every other one.
    pub(super) fn say_given_up(&mut self, lost: &Adjacency) {
        let Some(number) = lost.number_there else { return };
        let bytes = RoutingMessage::GaveUp(number).encode();
        for (&link, _) in self.links.iter().filter(|(_, adjacent)| adjacent.id == lost.id) {
            self.outputs.push_back(RouterOutput::Routing { link, bytes: bytes.clone() });
        }
    }

    pub(super) fn handle_numbered(&mut self, link: LinkId, number: LinkId) {
        if let Some(adjacent) = self.links.get_mut(&link) {
            adjacent.number_there = Some(number);
        }
    }

    /// The neighbour at the other end of `from` has declared a link down; reports of other nodes do
    /// not count.
    pub(super) fn handle_given_up(&mut self, from: LinkId, link: LinkId) {
        let neighbour = |link| self.links.get(link).map(|adjacent| &adjacent.neighbour);
        // Often both ends know of it.
        let Some(lost) = neighbour(&link) else { return };
        if link != from && neighbour(&from) == Some(lost) {
            self.outputs.push_back(RouterOutput::GivenUp { link });
        } else {
            self.refusals.unexpected += 1;
        }
    }

    /// A node's newest announcement follows another: has it withdrawn its links with us?
    pub(super) fn hear_given_up(&mut self, before: Option<&Advertisement>, newest: &Advertisement) {
        let id = self.id;
        let incarnation = Edge::incarnation_tag(self.incarnation());
        let with_us = |advertisement: &Advertisement| {
            advertisement.edges.iter().any(|edge| edge.to == id && edge.incarnation == incarnation)
        };
        let before = before.filter(|before| before.incarnation == newest.incarnation);
        // One that is full may lack what there was no room for.
        let complete = newest.edges.len() < NEIGHBOURS_MAX;
        if !complete || with_us(newest) || !before.is_some_and(with_us) {
            return;
        }
        let lost = self.links.iter().filter(|(_, adjacent)| {
            adjacent.id == newest.id.origin && adjacent.neighbour.incarnation == newest.incarnation
        });
        self.outputs.extend(lost.map(|(&link, _)| RouterOutput::GivenUp { link }));
    }
}
