//! Whole networks of routers that hear each other after a millisecond.

use super::*;
use crate::net::seal::SealerConfig;
use crate::net::trust::crypto::Seed;
use crate::net::trust::policy::Role;
use crate::net::trust::roster::{NodeRoster, RosterNode};
use crate::sorted::SortedMap;
use std::collections::BTreeSet;

pub(super) const MS: Duration = Duration::from_millis(1);

/// A node's name, and its incarnation.
pub(super) type Who = (&'static str, u64);

/// What is on its way over a cable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Load {
    Routing(Bytes),
    Packet(Bytes),
}

#[derive(Default)]
pub(super) struct Net {
    pub(super) now: Instant,
    pub(super) routers: SortedMap<Who, Router>,
    /// The nodes of the roster, where nodes have keys.
    pub(super) roster: Option<NodeRoster>,
    /// Who has a cable to whom; its number on one's side says who is at the other.
    pub(super) cables: BTreeSet<(Who, Who)>,
    numbers: SortedMap<(Who, &'static str), LinkId>,
    /// From whom, to whom, over which of its links.
    pub(super) wire: Vec<(Who, Who, LinkId, Load)>,
    outputs: Vec<String>,
    /// Who has received which segment from whom.
    pub(super) segments: Vec<(Who, NodeId, Bytes)>,
}

/// The seed of a node of this name.
pub(super) fn seed(name: &str) -> Seed {
    let mut seed = [7; 32];
    seed[..name.len()].copy_from_slice(name.as_bytes());
    Seed::new(seed)
}

/// A roster of these nodes.
pub(super) fn roster(names: &[&str]) -> NodeRoster {
    let listed = names.iter().map(|name| RosterNode {
        name: named(name),
        keys: seed(name).public_keys(),
        role: Role::Node,
    });
    NodeRoster::new(named("ranger"), listed).unwrap()
}

impl Net {
    pub(super) fn new(cables: &[(Who, Who)]) -> Self {
        Net::with_roster(cables, None)
    }

    pub(super) fn with_roster(cables: &[(Who, Who)], roster: Option<NodeRoster>) -> Self {
        let mut net = Net { now: Instant::from_millis(1_000), roster, ..Net::default() };
        cables.iter().for_each(|(a, b)| net.plug(*a, *b));
        net.run(1_000);
        net.outputs.clear();
        net
    }

    /// A link is one cable's, whichever incarnation is at its other end.
    pub(super) fn number(&mut self, own: Who, far: &'static str) -> LinkId {
        let next = LinkId(self.numbers.len() as u16);
        *self.numbers.entry((own, far)).or_insert(next)
    }

    pub(super) fn link(&mut self, own: Who, far: Who, health: LinkHealth) {
        let number = self.number(own, far.0);
        let neighbour =
            Neighbour { node: NodeName::new(far.0).unwrap(), incarnation: Incarnation(far.1) };
        let status = LinkStatus { neighbour, health, cost: 10, mtu: 1400 };
        if let Some(router) = self.routers.get_mut(&own) {
            router.handle_link(number, status, self.now);
        }
        self.settle(own);
    }

    fn router(&self, (name, incarnation): Who) -> Router {
        let (name, incarnation) = (named(name), Incarnation(incarnation));
        let router = Router::new(RouterConfig::new(name.clone(), incarnation), self.now);
        let Some(roster) = &self.roster else { return router };
        let config = SealerConfig::new(NodeId::of(&name), incarnation, "ranger");
        let random = [incarnation.0 as u8; 32];
        let keys = RouterKeys::new(&seed(name.as_str()), roster, config, random, self.now);
        router.with_keys(keys)
    }

    pub(super) fn plug(&mut self, a: Who, b: Who) {
        for who in [a, b] {
            if !self.routers.contains_key(&who) {
                let router = self.router(who);
                self.routers.insert(who, router);
            }
        }
        self.cables.extend([(a, b), (b, a)]);
        self.link(a, b, LinkHealth::Up);
        self.link(b, a, LinkHealth::Up);
    }

    pub(super) fn unplug(&mut self, a: Who, b: Who) {
        self.cables.retain(|cable| *cable != (a, b) && *cable != (b, a));
        self.link(a, b, LinkHealth::Down);
        self.link(b, a, LinkHealth::Down);
    }

    pub(super) fn kill(&mut self, who: Who) {
        self.routers.remove(&who);
        let far: Vec<_> = self.cables.iter().filter(|(a, _)| *a == who).map(|(_, b)| *b).collect();
        far.into_iter().for_each(|far| self.unplug(who, far));
    }

    /// The node at the other end of the cable from one node to another of this name.
    fn far(&self, who: Who, link: LinkId) -> Option<Who> {
        let far = self.numbers.iter().find(|((own, _), number)| *own == who && **number == link);
        let far = far.map(|((_, far), _)| *far).unwrap();
        let cable = self.cables.iter().find(|(a, b)| *a == who && b.0 == far);
        cable.map(|(_, far)| *far)
    }

    pub(super) fn carry(&mut self, who: Who, link: LinkId, load: Load) {
        if let Some(far) = self.far(who, link) {
            let number = self.number(far, who.0);
            self.wire.push((who, far, number, load));
        }
    }

    pub(super) fn settle(&mut self, who: Who) {
        while let Some(output) = self.routers.get_mut(&who).and_then(Machine::poll_output) {
            match output {
                RouterOutput::Routing { link, bytes } => {
                    self.carry(who, link, Load::Routing(bytes))
                }
                RouterOutput::Packet { link, packet } => {
                    self.carry(who, link, Load::Packet(packet.into_bytes()));
                }
                RouterOutput::Segment { source, segment, .. } => {
                    self.segments.push((who, source, segment));
                }
                RouterOutput::KeptOut { node, incarnation, by, .. } => {
                    self.outputs.push(format!("{who:?} keeps {node}{incarnation} out for {by}"));
                }
                RouterOutput::Reachable { node, incarnation, .. } => {
                    self.outputs.push(format!("{who:?} reaches {node}{incarnation}"));
                }
                RouterOutput::Lost { node, incarnation } => {
                    self.outputs.push(format!("{who:?} lost {node}{incarnation}"));
                }
                RouterOutput::NameTaken { by } => {
                    self.outputs.push(format!("{who:?} stops for {by}"));
                    return self.kill(who);
                }
                RouterOutput::Refuse { link, by, .. } => {
                    let far = self.far(who, link).expect("its neighbour has said something");
                    self.outputs.push(format!("{far:?} stops for {by}"));
                    self.kill(far);
                }
                _ => {}
            }
        }
    }

    pub(super) fn run(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now = self.now + MS;
            for (_, to, link, load) in std::mem::take(&mut self.wire) {
                self.arrive(to, link, load);
            }
            let all: Vec<_> = self.routers.keys().copied().collect();
            for who in all {
                let router = self.routers.get_mut(&who).unwrap();
                if router.poll_timeout().is_some_and(|due| due <= self.now) {
                    router.handle_timeout(self.now);
                }
                self.settle(who);
            }
        }
    }

    pub(super) fn arrive(&mut self, to: Who, link: LinkId, load: Load) {
        if let Some(router) = self.routers.get_mut(&to) {
            match load {
                Load::Routing(bytes) => router.handle_routing(link, bytes, self.now),
                Load::Packet(packet) => router.handle_packet(link, packet, self.now),
            }
        }
        self.settle(to);
    }

    /// One node sends another a segment.
    pub(super) fn send(&mut self, from: Who, to: &str, segment: &'static [u8]) {
        let (class, segment) = (PacketPriority::Data, Bytes::from_static(segment));
        self.routers.get_mut(&from).unwrap().handle_segment(id(to), class, segment.into());
        self.settle(from);
    }

    pub(super) fn outputs(&mut self) -> Vec<String> {
        std::mem::take(&mut self.outputs)
    }

    pub(super) fn reached(&self, by: Who, name: &str) -> Option<u64> {
        let route = self.routers[&by].route(NodeId::of(&NodeName::new(name).unwrap()))?;
        Some(route.incarnation.0)
    }
}
