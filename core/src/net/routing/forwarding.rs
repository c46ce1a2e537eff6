//! Passing packets on: the look-up, and what becomes of what cannot be delivered.

use super::{LinkHealth, Router, RouterOutput};
use crate::net::routing::topology::DisjointPath;
use crate::net::wire::frame::FRAME_HEADER;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::{HOPS_MAX, Packet, PacketPriority, Payload, UndeliveredReason};
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
            match packet.payload {
                Payload::Copy { .. } => self.follow(packet),
                Payload::Segment(_) | Payload::Return { .. } => self.forward(packet, link),
            }
        } else {
            match packet.payload {
                Payload::Copy { relays, .. } if !relays.is_empty() => self.refusals.malformed += 1,
                Payload::Segment(segment) | Payload::Copy { segment, .. } => {
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
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let (payload, passed) = (Payload::Segment(segment), Vec::new());
        self.pass(link, &Packet { class, hops, destination, source, passed, payload });
    }

    /// The same over ways that have as little in common as can be, each written into its copy: the
    /// first one that arrives counts. A way that is too small for it is left out.
    pub fn handle_copies(
        &mut self,
        destination: NodeId,
        class: PacketPriority,
        segment: &GatherBuffer,
    ) {
        if self.routes.contains_key(&destination) && !self.ways.contains_key(&destination) {
            let ways = self.topology().ways(destination);
            self.ways.insert(destination, ways);
        }
        let ways = self.ways.get(&destination).cloned().unwrap_or_default();
        let copies: Vec<_> = (0..)
            .zip(ways)
            .filter_map(|(copy, way)| self.copy_over(way, (destination, copy), class, segment))
            .collect();
        if copies.len() < 2 {
            // One way alone is followed by routes, each node knowing an alternate; or it is said
            // why none is.
            return self.handle_segment(destination, class, segment.clone());
        }
        self.outputs.extend(copies);
    }

    fn copy_over(
        &mut self,
        way: DisjointPath,
        (destination, copy): (NodeId, u8),
        class: PacketPriority,
        segment: &GatherBuffer,
    ) -> Option<RouterOutput> {
        let mtu = self.links.get(&way.link)?.mtu.min(way.mtu);
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let is_near = way.relays.len() <= hops.into();
        let segment = self.protect((destination, way.link), class, segment.clone())?;
        let payload = match way.relays.split_first() {
            None => Payload::Segment(segment),
            Some((_, relays)) => Payload::Copy { copy, relays: relays.to_vec(), segment },
        };
        let packet =
            Packet { class, hops, destination, source, passed: Vec::new(), payload }.parcel();
        let fits = packet.len() + FRAME_HEADER <= mtu.into();
        (fits && is_near).then_some(RouterOutput::Packet { link: way.link, packet })
    }

    /// Passes a copy on by the way that is written in it, and by no other: on one of its own it
    /// would go where another copy goes already, or in a circle. What no copy brings, the session
    /// repeats.
    fn follow(&mut self, packet: Packet) {
        let Packet { class, hops, destination, source, passed, payload } = packet;
        let Payload::Copy { copy, mut relays, segment } = payload else { return };
        if relays.contains(&self.id) {
            self.refusals.malformed += 1;
            return;
        }
        let next = if relays.is_empty() { destination } else { relays.remove(0) };
        let payload = Payload::Copy { copy, relays, segment };
        let link = hops.checked_sub(1).and_then(|hops| {
            let packet = Packet { class, hops, destination, source, passed, payload }.parcel();
            Some((self.parallel(next, copy, packet.len() + FRAME_HEADER)?, packet))
        });
        match link {
            Some((link, packet)) => self.outputs.push_back(RouterOutput::Packet { link, packet }),
            None => self.refusals.astray += 1,
        }
    }

    /// Of several links to a neighbour, copies that both must pass it take different ones.
    fn parallel(&self, next: NodeId, copy: u8, length: usize) -> Option<LinkId> {
        let fitting = self
            .links
            .iter()
            .filter(|(_, adjacent)| adjacent.id == next && length <= usize::from(adjacent.mtu));
        let best = |usable: fn(LinkHealth) -> bool| -> Vec<LinkId> {
            let usable = fitting.clone().filter(|(_, adjacent)| usable(adjacent.health));
            usable.map(|(number, _)| *number).collect()
        };
        let links =
            Some(best(|health| health < LinkHealth::Suspect)).filter(|links| !links.is_empty());
        let links = links.unwrap_or_else(|| best(|_| true));
        links.get(usize::from(copy) % links.len().max(1)).copied()
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
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let (class, passed) = (PacketPriority::Control, Vec::new());
        let answer = Packet { class, hops, destination: packet.source, source, passed, payload };
        if let Some(link) = self.choose(answer.destination, &[]) {
            self.pass(link, &answer);
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
