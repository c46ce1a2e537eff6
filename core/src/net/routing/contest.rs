//! Two nodes of one name: the one that was there first keeps it.
//!
//! ```text
//!  A ─── B ─── C ─── A'      C knows A by its routes when A' comes up beside it
//!        ◄─dispute── C       is A still there?
//!  A ──defend──► B ──► C     it is: A' is kept out, and told so
//! ```
//!
//! A restarted node has its name from its old incarnation at once: the links that led to the old
//! one have told of its end. Only while routes still lead to the old incarnation is a new one
//! disputed, and if its end was not noticed, it does not defend itself. Where two halves of a
//! network meet that have each a node of this name, the older incarnation stays, everywhere.

use super::{LinkHealth, LinkStatus, Router, RouterAlarm, RouterOutput};
use crate::net::link::Neighbour;
use crate::net::routing::topology::Adjacency;
use crate::net::wire::advertisement::{Advertisement, AdvertisementId, RoutingMessage};
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::{Incarnation, Instant, NodeName};
use std::time::Duration;

/// Which later incarnation of a name is kept out.
#[derive(Clone, Copy, Debug)]
pub(super) struct Dispute {
    contender: Incarnation,
    /// Until when the holder may take to defend itself; `None` once it has.
    until: Option<Instant>,
    /// When others were last asked, or told.
    reported_at: Instant,
    /// When the holder was last asked.
    asked_at: Instant,
}

impl Router {
    /// For a holder's answer to come back over every hop there is.
    const DEFEND_WITHIN: Duration = Duration::from_secs(1);
    /// A dispute is asked about, and its end told again, no more often.
    const TELL_AGAIN: Duration = Duration::from_millis(100);
    /// The holder hears so often that the contender is still there.
    const ASK_AGAIN: Duration = Duration::from_secs(10);

    /// Whether this incarnation of a node is kept out, because an older one is still there.
    pub(super) fn is_contested(&mut self, node: &NodeName, incarnation: Incarnation) -> bool {
        let (id, now) = (NodeId::of(node), self.now);
        let Some(holder) = self.routes.get(&id).map(|route| route.incarnation) else {
            return false;
        };
        let ended =
            self.known.get(&id).is_none_or(|known| known.ended) && !self.is_neighbour(node, holder);
        if holder >= incarnation || ended {
            return false;
        }
        if self.disputes.get(&id).is_none_or(|dispute| dispute.contender < incarnation) {
            let until = Some(now + Self::DEFEND_WITHIN);
            let dispute =
                Dispute { contender: incarnation, until, reported_at: now, asked_at: now };
            self.disputes.insert(id, dispute);
            self.wake_at = self.wake_at.min(now + Self::DEFEND_WITHIN);
            let contender = AdvertisementId { origin: id, incarnation, sequence: 0 };
            self.tell_all(&RoutingMessage::Dispute { contender, node: node.clone() }, None);
        }
        self.refusals.unexpected += 1;
        true
    }

    /// A link to an incarnation that is kept out.
    pub(super) fn contest(&mut self, link: LinkId, status: LinkStatus) {
        if self.links.remove(&link).is_some() {
            self.announce_links();
        }
        self.contested.insert(link, status);
    }

    /// Another node asks whether the holder of a name is still there.
    pub(super) fn handle_dispute(
        &mut self,
        from: LinkId,
        contender: AdvertisementId,
        node: NodeName,
    ) {
        let AdvertisementId { origin, incarnation, .. } = contender;
        if origin == self.id {
            if incarnation > self.own.id.incarnation {
                self.defend(incarnation);
            }
            return;
        }
        let now = self.now;
        let known = self.disputes.get(&origin).filter(|dispute| dispute.contender >= incarnation);
        if known.is_some_and(|dispute| now < dispute.reported_at + Self::TELL_AGAIN)
            || self.disputes.len() >= self.config.nodes_max && known.is_none()
        {
            return;
        }
        let until = known.map_or(Some(now + Self::DEFEND_WITHIN), |dispute| dispute.until);
        let dispute = Dispute { contender: incarnation, until, reported_at: now, asked_at: now };
        self.disputes.insert(origin, dispute);
        self.wake_at = self.wake_at.min(now + Self::DEFEND_WITHIN);
        self.tell_all(&RoutingMessage::Dispute { contender, node }, Some(from));
    }

    /// Whether a node that has our name, and a greater incarnation, sends something new. What an
    /// earlier incarnation of ours has said, before the clock that numbers incarnations was set
    /// back, others can only repeat.
    pub(super) fn is_more_than_a_rumour(&mut self, theirs: AdvertisementId) -> bool {
        match self.unconfirmed_incarnation {
            Some((known, since)) if known.incarnation == theirs.incarnation => {
                // Until then, others may have known different words of it.
                let settled = self.now >= since + Self::DEFEND_WITHIN;
                let newer = known.sequence < theirs.sequence;
                if newer {
                    self.unconfirmed_incarnation = Some((theirs, since));
                }
                newer && settled
            }
            _ => {
                self.unconfirmed_incarnation = Some((theirs, self.now));
                false
            }
        }
    }

    /// Another node of our name, of a later incarnation, is there: it is for us to say that we are.
    pub(super) fn defend(&mut self, against: Incarnation) {
        if self.usurper == Some(against) {
            self.go_on(RouterAlarm::NameTaken);
            return self.defend_against_rumour(against);
        }
        self.usurper = Some(against);
        let (incarnation, first) = (against, true);
        self.outputs.push_back(RouterOutput::NameTaken { incarnation, first });
        self.begin_trouble(RouterAlarm::NameTaken);
        self.say_that_we_are(against);
    }

    /// It is there, or was once.
    pub(super) fn defend_against_rumour(&mut self, against: Incarnation) {
        if self.now >= self.defended_at + Self::TELL_AGAIN {
            self.say_that_we_are(against);
        }
    }

    fn say_that_we_are(&mut self, against: Incarnation) {
        self.defended_at = self.now;
        self.renew();
        let advertisement = self.own.clone();
        self.tell_all(&RoutingMessage::Defend { against, advertisement }, None);
    }

    /// The holder of a name is there.
    pub(super) fn handle_defence(
        &mut self,
        from: LinkId,
        against: Incarnation,
        advertisement: Advertisement,
    ) {
        let AdvertisementId { origin, incarnation, .. } = advertisement.id;
        if incarnation >= against {
            self.refusals.malformed += 1;
            return;
        }
        if origin == self.id {
            let own = self.own.id.incarnation;
            self.go_on(RouterAlarm::NameTaken);
            if incarnation < own && own <= against && self.usurper != Some(incarnation) {
                self.begin_trouble(RouterAlarm::NameTaken);
                self.usurper = Some(incarnation);
                self.outputs.push_back(RouterOutput::NameTaken { incarnation, first: false });
            }
            return;
        }
        let held = self.known.get(&origin).map(|known| &known.advertisement);
        if held.is_some_and(|held| held.node != advertisement.node) {
            let held = held.map(|held| held.node.clone());
            return self.tell_collision(held, advertisement.node);
        }
        let settled = |dispute: &Dispute| dispute.until.is_none() && dispute.contender >= against;
        // Also where a later incarnation is held, which has ended, and an earlier one defends
        // itself against it.
        let news =
            held.is_none_or(|held| held.id < advertisement.id || held.id.incarnation > incarnation);
        let known = self.disputes.get(&origin);
        if known.is_some_and(settled) && !news {
            return;
        }
        let contender = known.map_or(against, |known| known.contender.max(against));
        if let Some(held) = held.map(|held| held.id).filter(|held| held.incarnation > incarnation) {
            if held.incarnation > against {
                // A later incarnation than the one that it knows of, and has not heard of it yet.
                return;
            }
            self.known.remove(&origin);
        } else if held.is_none() && self.known.len() >= self.config.nodes_max {
            self.refusals.too_large += 1;
            return;
        }
        let asked_at = known.map_or(self.now, |known| known.asked_at);
        let dispute = Dispute { contender, until: None, reported_at: self.now, asked_at };
        self.disputes.insert(origin, dispute);
        self.learn(advertisement.clone(), from);
        self.outdate();
        let out = |neighbour: &Neighbour| {
            NodeId::of(&neighbour.node) == origin && neighbour.incarnation > incarnation
        };
        let links = self.links.iter().filter(|(_, adjacent)| out(&adjacent.neighbour));
        let links: Vec<_> = links.map(|(link, adjacent)| (*link, status_of(adjacent))).collect();
        links.into_iter().for_each(|(link, status)| self.contest(link, status));
        self.tell_all(&RoutingMessage::Defend { against, advertisement }, Some(from));
    }

    /// Tells all neighbours, and those that are kept out.
    fn tell_all(&mut self, routing: &RoutingMessage, except: Option<LinkId>) {
        let bytes = routing.encode();
        let links = self.links.keys().chain(self.contested.keys());
        for link in links.copied().filter(|link| Some(*link) != except) {
            self.outputs.push_back(RouterOutput::Routing { link, bytes: bytes.clone() });
        }
    }

    /// The contender, which is kept out, announces itself over and over: it is told why.
    pub(super) fn tell_contender(&mut self, link: LinkId) {
        let Some(LinkStatus { neighbour, .. }) = self.contested.get(&link) else { return };
        let (node, now) = (neighbour.node.clone(), self.now);
        let (origin, incarnation) = (NodeId::of(&node), neighbour.incarnation);
        self.tell_why(link, origin);
        let due = |dispute: &&mut Dispute| {
            dispute.until.is_none() && dispute.asked_at + Self::ASK_AGAIN <= now
        };
        if let Some(dispute) = self.disputes.get_mut(&origin).filter(due) {
            dispute.asked_at = now;
            let contender = AdvertisementId { origin, incarnation, sequence: 0 };
            self.tell_all(&RoutingMessage::Dispute { contender, node }, Some(link));
        }
    }

    /// Repeats to one neighbour how the dispute about a name has ended.
    pub(super) fn tell_why(&mut self, link: LinkId, id: NodeId) {
        let now = self.now;
        let Some(dispute) = self.disputes.get_mut(&id).filter(|dispute| dispute.until.is_none())
        else {
            return;
        };
        let known = self.known.get(&id).map(|known| known.advertisement.clone());
        if let (true, Some(advertisement)) = (dispute.reported_at + Self::TELL_AGAIN <= now, known)
        {
            dispute.reported_at = now;
            let defence = RoutingMessage::Defend { against: dispute.contender, advertisement };
            let bytes = defence.encode();
            self.outputs.push_back(RouterOutput::Routing { link, bytes });
        }
    }

    /// Routes have changed, or time has passed: whose name is free again?
    pub(super) fn settle_disputes(&mut self) {
        let (routes, now) = (&self.routes, self.now);
        for (id, known) in &mut self.known {
            let incarnation = known.advertisement.id.incarnation;
            known.ended |=
                known.reached && routes.get(id).is_none_or(|r| r.incarnation != incarnation);
            known.reached |= routes.get(id).is_some_and(|route| route.incarnation == incarnation);
        }
        let (before, known) = (self.disputes.len(), &mut self.known);
        self.disputes.retain(|id, dispute| {
            let held = routes.get(id).is_some_and(|route| route.incarnation < dispute.contender);
            let late = dispute.until.is_some_and(|until| until <= now);
            if let (true, Some(known)) = (late, known.get_mut(id)) {
                known.ended = true;
            }
            held && !late
        });
        if self.disputes.len() == before {
            return;
        }
        for (link, status) in std::mem::take(&mut self.contested) {
            if status.health != LinkHealth::Down {
                self.handle_link(link, status, now);
            }
        }
    }

    /// When the first of them is over.
    pub(super) fn dispute_ends(&self) -> Option<Instant> {
        self.disputes.values().filter_map(|dispute| dispute.until).min()
    }
}

fn status_of(adjacent: &Adjacency) -> LinkStatus {
    let Adjacency { neighbour, cost, mtu, health, .. } = adjacent;
    let (neighbour, mtu) = (neighbour.clone(), usize::from(*mtu));
    LinkStatus { neighbour, health: *health, cost: *cost, mtu }
}

#[cfg(test)]
mod tests;
