//! Passing packets on: the look-up, and what becomes of what cannot be delivered.

use super::keys::RouterKeys;
use super::topology::Adjacency;
use super::{Router, RouterOutput};
use crate::net::wire::frame::FRAME_HEADER;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::{
    HOPS_MAX, PACKET_HEADER, Packet, PacketPriority, Payload, UndeliveredReason,
};
use crate::{GatherBuffer, Instant};
use bytes::Bytes;

impl Router {
    /// A packet came over a link.
    pub fn handle_packet(&mut self, link: LinkId, packet: Bytes, now: Instant) {
        self.now = now;
        let packet = match Packet::decode(packet) {
            Ok(packet) => packet,
            Err(error) => return self.refusals.count(&error),
        };
        if self.isolated_links.contains_key(&link) || self.isolated.contains(&packet.source) {
            self.refusals.isolated += 1;
        } else if self.unused.contains_key(&link) {
            self.refusals.unexpected += 1;
        } else if packet.source == self.id {
            // It went in a circle, as packets may while nodes hear of a change one after the other,
            // and is repeated. Or another node uses our name; then the session asks no more often
            // than it would.
            self.refusals.unexpected += 1;
            self.give_back(&packet, UndeliveredReason::TooManyHops);
        } else if packet.destination != self.id {
            self.forward(packet, link);
        } else {
            match packet.payload {
                Payload::Segment(segment) => {
                    self.take_segment(link, packet.source, segment.into_bytes());
                }
                Payload::Return { destination, reason } => {
                    self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
                }
            }
        }
    }

    /// Our session with `destination` wants this sent.
    pub fn handle_segment(
        &mut self,
        destination: NodeId,
        class: PacketPriority,
        segment: GatherBuffer,
    ) {
        let Some(link) = self.choose(destination, &[]) else {
            let reason = UndeliveredReason::NoRoute;
            return self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
        };
        // Before there are keys it waits with the session, which repeats it.
        let Some(segment) = self.protect((destination, link), class, segment) else { return };
        self.originate(link, destination, class, Payload::Segment(segment));
    }

    /// Sends a copy over every link to the destination and over both next hops of its route: the
    /// first one that arrives counts. A link that is too small for it is left out.
    pub fn handle_copies(
        &mut self,
        destination: NodeId,
        class: PacketPriority,
        segment: &GatherBuffer,
    ) {
        let seal = self.keys.as_ref().map_or(0, RouterKeys::overhead);
        let fits = |adjacent: &Adjacency| {
            let seal = if adjacent.id == destination { 0 } else { seal };
            segment.len() + seal + FRAME_HEADER + PACKET_HEADER <= adjacent.mtu.into()
        };
        let route = self.routes.get(&destination);
        let hops = route.map(|route| [Some(route.next), route.alternate]).unwrap_or_default();
        let leads = |link: &LinkId, adjacent: &Adjacency| {
            (adjacent.id == destination || hops.contains(&Some(*link))) && fits(adjacent)
        };
        let links = self.links.iter().filter(|(link, adjacent)| leads(link, adjacent));
        let links: Vec<_> = links.map(|(link, _)| *link).collect();
        if links.is_empty() {
            // It comes back, with the reason.
            return self.handle_segment(destination, class, segment.clone());
        }
        for link in links {
            if let Some(copy) = self.protect((destination, link), class, segment.clone()) {
                self.originate(link, destination, class, Payload::Segment(copy));
            }
        }
    }

    /// Sends a packet of this node's own over a link.
    pub(super) fn originate(
        &mut self,
        link: LinkId,
        destination: NodeId,
        class: PacketPriority,
        payload: Payload,
    ) {
        let (hops, source, passed) = (self.config.hops.min(HOPS_MAX), self.id, Vec::new());
        self.pass(link, &Packet { class, hops, destination, source, passed, payload });
    }

    /// Forwards a packet that came over a link, to no node that has had it: nodes that hear of a
    /// change one after the other may each believe that another is nearer.
    pub(super) fn forward(&mut self, mut packet: Packet, from: LinkId) {
        let here_before = packet.passed.contains(&self.id);
        let (false, Some(hops)) = (here_before, packet.hops.checked_sub(1)) else {
            return self.give_back(&packet, UndeliveredReason::TooManyHops);
        };
        let from = self.links.get(&from).map(|adjacent| adjacent.id);
        let had: Vec<_> =
            packet.passed.iter().copied().chain([packet.source]).chain(from).collect();
        packet.hops = hops;
        match self.choose(packet.destination, &had) {
            Some(_) if packet.passed.len() >= HOPS_MAX.into() => {
                self.give_back(&packet, UndeliveredReason::TooManyHops);
            }
            Some(link) => {
                packet.passed.push(self.id);
                self.pass(link, &packet);
            }
            None => self.give_back(&packet, UndeliveredReason::NoRoute),
        }
    }

    pub(super) fn pass(&mut self, link: LinkId, packet: &Packet) {
        let encoded = packet.parcel();
        let mtu = self.links.get(&link).map_or(0, |adjacent| usize::from(adjacent.mtu));
        if encoded.len() + FRAME_HEADER > mtu {
            return self.give_back(packet, UndeliveredReason::TooLarge);
        }
        self.outputs.push_back(RouterOutput::Packet { link, packet: encoded });
    }

    /// Tells a packet's source that it went no further. Nothing is said about a return.
    pub(super) fn give_back(&mut self, packet: &Packet, reason: UndeliveredReason) {
        let Payload::Segment(_) = packet.payload else { return };
        let destination = packet.destination;
        if packet.source == self.id {
            self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
            return;
        }
        let payload = Payload::Return { destination, reason };
        if let Some(link) = self.choose(packet.source, &[]) {
            self.originate(link, packet.source, PacketPriority::Control, payload);
        }
    }

    /// The look-up: the next hop if it is well, else the alternate, else whichever is better off;
    /// none that has had the packet.
    pub(super) fn choose(&self, destination: NodeId, had: &[NodeId]) -> Option<LinkId> {
        self.routes.get(&destination)?.choose(&self.links, had)
    }

    /// Links have come, gone or become suspect: some nodes are now reached another way.
    pub(super) fn choose_anew(&mut self) {
        for (node, route) in &mut self.routes {
            let chosen = route.choose(&self.links, &[]);
            if chosen != route.chosen {
                route.chosen = chosen;
                if chosen.is_some() {
                    let mtu = route.segment_limit();
                    self.outputs.push_back(RouterOutput::PathChanged { node: *node, mtu });
                }
            }
        }
    }
}
