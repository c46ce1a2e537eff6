//! Passing packets on: the look-up, and what becomes of what cannot be delivered.

use super::{LinkNumber, Router, RouterOutput};
use crate::Instant;
use crate::net::frame::FRAME_HEADER;
use crate::net::node_id::NodeId;
use crate::net::packet::{Class, HOPS_MAX, Packet, Payload, Undelivered};
use crate::net::topology;
use bytes::Bytes;

impl Router {
    /// A packet came over a link.
    pub fn handle_packet(&mut self, link: LinkNumber, packet: Bytes, now: Instant) {
        self.now = now;
        let packet = match Packet::decode(packet) {
            Ok(packet) => packet,
            Err(error) => return self.refusals.count(&error),
        };
        if self.barred.contains_key(&link) || self.kept_out.contains(&packet.source) {
            self.refusals.isolated += 1;
        } else if packet.source == self.id {
            // It went in a circle, or somebody uses our name.
            self.refusals.unexpected += 1;
        } else if packet.destination != self.id {
            self.forward(packet, Some(link));
        } else {
            self.outputs.push_back(match packet.payload {
                Payload::Segment(segment) => {
                    let source = packet.source;
                    let direct = self.links.get(&link).is_some_and(|link| link.id == source);
                    RouterOutput::Segment { source, segment, direct }
                }
                Payload::Return { destination, reason } => {
                    RouterOutput::Undelivered { destination, reason }
                }
            });
        }
    }

    /// Our session with `destination` wants this sent.
    pub fn handle_segment(&mut self, destination: NodeId, class: Class, segment: Bytes) {
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let payload = Payload::Segment(segment);
        let packet = Packet { class, hops, destination, source, payload };
        match self.choose(destination, None) {
            Some(link) => self.pass(link, &packet),
            None => self.give_back(&packet, Undelivered::NoRoute),
        }
    }

    /// The same over every link whose way does not lead back here: the first copy that arrives counts.
    /// A link that is too small for it is left out.
    pub fn handle_copies(&mut self, destination: NodeId, class: Class, segment: &Bytes) {
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let payload = Payload::Segment(segment.clone());
        let packet = Packet { class, hops, destination, source, payload };
        let bytes = packet.encode();
        let ways = self.routes.get(&destination).map_or(&[][..], |route| &route.ways);
        let fits = |link: &&LinkNumber| {
            let mtu = self.links.get(link).map(|adjacent| usize::from(adjacent.mtu));
            mtu.is_some_and(|mtu| bytes.len() + FRAME_HEADER <= mtu)
        };
        let ways: Vec<_> = ways.iter().filter(fits).copied().collect();
        if ways.is_empty() {
            // One way that is there but too small, or none: its refusal says which.
            return self.handle_segment(destination, class, segment.clone());
        }
        let copy = |link| RouterOutput::Packet { link, packet: bytes.clone() };
        self.outputs.extend(ways.into_iter().map(copy));
    }

    pub(super) fn forward(&mut self, packet: Packet, from: Option<LinkNumber>) {
        let Some(hops) = packet.hops.checked_sub(1) else {
            return self.give_back(&packet, Undelivered::TooManyHops);
        };
        let packet = Packet { hops, ..packet };
        match self.choose(packet.destination, from) {
            Some(link) => self.pass(link, &packet),
            None => self.give_back(&packet, Undelivered::NoRoute),
        }
    }

    pub(super) fn pass(&mut self, link: LinkNumber, packet: &Packet) {
        let bytes = packet.encode();
        let mtu = self.links.get(&link).map_or(0, |adjacent| usize::from(adjacent.mtu));
        if bytes.len() + FRAME_HEADER > mtu {
            return self.give_back(packet, Undelivered::TooLarge);
        }
        self.outputs.push_back(RouterOutput::Packet { link, packet: bytes });
    }

    /// Tells a packet's source that it went no further. Nothing is said about a return.
    pub(super) fn give_back(&mut self, packet: &Packet, reason: Undelivered) {
        let Payload::Segment(_) = packet.payload else { return };
        let destination = packet.destination;
        if packet.source == self.id {
            self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
            return;
        }
        let payload = Payload::Return { destination, reason };
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let answer =
            Packet { class: Class::Control, hops, destination: packet.source, source, payload };
        if let Some(link) = self.choose(answer.destination, None) {
            self.pass(link, &answer);
        }
    }

    /// The look-up: the next hop if it is well, else the alternate, else whichever is better off;
    /// never back to where the packet came from.
    pub(super) fn choose(
        &self,
        destination: NodeId,
        from: Option<LinkNumber>,
    ) -> Option<LinkNumber> {
        let route = self.routes.get(&destination)?;
        let from = from.and_then(|from| self.links.get(&from)).map(|adjacent| adjacent.id);
        route.choose(&self.links, from)
    }

    /// Links have come, gone or become suspect: some nodes are now reached another way.
    pub(super) fn choose_anew(&mut self) {
        for (node, route) in &mut self.routes {
            let chosen = route.choose(&self.links, None);
            if chosen != route.chosen {
                route.chosen = chosen;
                if chosen.is_some() {
                    let mtu = topology::segment_limit(route.mtu);
                    self.outputs.push_back(RouterOutput::PathChanged { node: *node, mtu });
                }
            }
        }
    }
}
