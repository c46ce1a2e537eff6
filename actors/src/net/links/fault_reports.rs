//! What the links of a network report as faults: neighbours that never came or are refused, frames
//! that are refused all the time, names and keys that two nodes have.

use super::LinksActor;
use crate::net::LinkSpec;
use crate::platform;
use blastema_contract::transport::MediumAddress;
use blastema_core::detection::LinkCondition;
use blastema_core::net::link::PeerRefusal;
use blastema_core::net::seal::SealRefusals;
use blastema_core::net::wire::frame::NameHolder;
use blastema_core::net::{Link, LinkId, Quality, Refusals};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, Instant};
use std::collections::BTreeSet;
use std::time::Duration;
use tracing::{error, warn};

/// A process that is told to stop may be started again by a service manager.
const KEY_FREE_AFTER: Duration = Duration::from_secs(10);

/// Names and keys that two nodes have.
#[derive(Default)]
pub(super) struct NamesTaken {
    /// Links at whose other end is a node of our name, until another one is.
    namesakes: BTreeSet<LinkId>,
    /// Links whose neighbour's key is in use twice, and when the other node was there last. That
    /// outlives the actor's incarnation, and ends when the other has been silent.
    keys_in_use: SortedMap<LinkId, Instant>,
}

impl NamesTaken {
    fn are_taken(&self) -> bool {
        !self.namesakes.is_empty() || !self.keys_in_use.is_empty()
    }

    /// The link is no more.
    pub(super) fn forget(&mut self, number: LinkId) {
        self.namesakes.remove(&number);
        self.keys_in_use.remove(&number);
    }
}

impl LinksActor {
    /// Frames that are refused for seconds are a fault until none was refused for a while: another
    /// node sends with the neighbour's address, or the neighbour is broken.
    pub(super) fn look_at_refusals(&mut self) {
        let links = self.link_layer.iter().map(|(number, _)| number);
        let links = links.map(|number| (Some(number), self.link_layer.refused_of(number)));
        let others = match self.link_layer.seal_refusals() {
            Some(refusals) => Refusals { unexpected: refusals.total(), ..Refusals::default() },
            None => self.link_layer.strangers(),
        };
        for (number, since) in self.alarms.handle_look(links.chain([(None, others)])) {
            let network = &self.recipients.network;
            let detail = match number.and_then(|number| self.specs.get(&number)) {
                Some(LinkSpec { name, remote, .. }) => format!(
                    "what comes from {remote}, by link {name}, is refused all the time: {since}"
                ),
                None if self.link_layer.is_sealed() => format!(
                    "{} frames in a second on network {network} that no node of this robot has \
                     sealed: another station sends there, or a node has other keys; their addresses \
                     may be forged",
                    since.total()
                ),
                None => format!(
                    "what comes from addresses that no link of {network} leads to is refused all the \
                     time: {since}"
                ),
            };
            warn!(%network, "{detail}");
            self.recipients.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }

    /// Two nodes have one address on the medium, which is ours: its owner is reported, too.
    pub(super) fn clash(&self, detail: String) {
        error!(network = %self.recipients.network, "{detail}");
        self.recipients.faults.declare(FaultKind::NameTaken, detail);
    }

    /// The neighbour never came. Reports the link as down; that it is up is reported when it comes.
    pub(super) fn missing(&mut self, number: LinkId, hello_received: bool) {
        if self.recipients.dial_in.contains(&number) {
            return self.remove(number);
        }
        if self.medium.mtu.is_none() {
            // Why no hello was received was reported, and is found here.
            self.unheard.insert(number);
            return;
        }
        let Some(spec) = self.specs.get(&number) else { return };
        let who = spec.neighbour.as_ref().map_or("the neighbour", |node| node.as_str());
        let remote = &spec.remote;
        let unsealed = self.link_layer.seal_refusals().map(SealRefusals::total);
        let refusals = self.link_layer.refused_of(number);
        let reason = match unsealed {
            _ if hello_received => format!(
                "{who} is heard since the start, and does not hear us: check its address for us"
            ),
            None if refusals.total() == 0 => format!(
                "never heard since the start: check the address {remote}, the cable, and that {who} runs"
            ),
            None => format!(
                "never heard since the start: what comes from {remote} is refused ({refusals}): perhaps \
                 {who} has a key, and this node has none: give it a key of that robot; or {who} is of \
                 another release"
            ),
            Some(0) => format!(
                "never heard since the start: check the address {remote}, the cable, that {who} runs, \
                 and by `blastema keys show` that both have keys of one roster"
            ),
            Some(frames) => format!(
                "never heard since the start, and {frames} frames came that no node of this robot has \
                 sealed: perhaps {who} has no key, or an old one; compare the files of both by \
                 `blastema keys show`"
            ),
        };
        warn!(network = %self.recipients.network, link = %spec.name, "{reason}");
        self.tell_monitor(number, LinkCondition::Down { reason });
    }

    /// Reports how a link that carries is.
    pub(super) fn tell_condition(&self, number: LinkId) {
        let (Some(link), Some(spec)) = (self.link_layer.get(number), self.specs.get(&number))
        else {
            return;
        };
        let Quality { round_trip, loss_permille, degraded, .. } = link.quality();
        let lossy = degraded.then(|| {
            let round_trip = round_trip.unwrap_or_default();
            let lost = f32::from(loss_permille) / 10.0;
            format!("{lost:.1} % of the hellos lost, round trip {round_trip:.1?}")
        });
        let narrow = link.shortfall().map(|sizes| {
            let overhead = self.link_layer.overhead();
            let (passes, configured) = (sizes.0 + overhead, sizes.1 + overhead);
            format!(
                "the path to {} drops frames of {configured} bytes, the network's mtu, and carries \
                 {passes}, as large as they are sent now: check the VPN or tunnel on the path, or set \
                 mtu={passes} in the endpoint on both nodes",
                spec.remote
            )
        });
        let reasons: Vec<_> = [lossy, narrow].into_iter().flatten().collect();
        let condition = match reasons[..] {
            [] => LinkCondition::Up,
            _ => LinkCondition::Degraded { reason: reasons.join("; ") },
        };
        self.tell_monitor(number, condition);
    }

    /// Another process with the neighbour's key is there, at the second address, and the neighbour
    /// has answered, at the first.
    pub(super) fn key_in_use(
        &mut self,
        number: LinkId,
        open: Incarnation,
        refused: Incarnation,
        at: &MediumAddress,
        address: &MediumAddress,
    ) {
        if self.names.keys_in_use.insert(number, platform::now()).is_some() {
            return;
        }
        let Some(spec) = self.specs.get(&number) else { return };
        let neighbour = spec.neighbour.as_ref().map_or("the neighbour", |node| node.as_str());
        // Over a connection that was adopted it may have come from any place.
        let at = if at == address { NameHolder::NOWHERE.to_owned() } else { at.to_string() };
        let detail = format!(
            "the key of {neighbour} is in use twice, as incarnation {open} at {at}, which answers, and as \
             {refused} at {address}, which is told to stop: two processes, perhaps of two computers, have \
             one key file; give one of them a key of its own"
        );
        error!(network = %self.recipients.network, link = %spec.name, "{detail}");
        self.recipients.faults.declare(FaultKind::NameTaken, detail);
    }

    /// The neighbour reaches another process with this node's name, which answers.
    pub(super) fn taken(&self, number: LinkId, holder: &NameHolder) {
        let NameHolder { incarnation, address } = holder;
        let (node, own) = (&self.recipients.node, self.recipients.incarnation);
        let local = &self.medium.local;
        // The neighbour may know no other address of that name.
        let address: &str = if address == local { NameHolder::NOWHERE } else { address };
        let neighbour = self.link_layer.get(number).and_then(Link::neighbour);
        let neighbour = neighbour.map(|neighbour| neighbour.node.clone());
        let neighbour =
            neighbour.or(self.specs.get(&number).and_then(|spec| spec.neighbour.clone()));
        let neighbour = neighbour.as_ref().map_or("the neighbour", |node| node.as_str());
        let cure = match self.recipients.seal {
            Some(_) => "end one of them, or give it a key file of its own",
            None => "end one of them, or give it another name",
        };
        self.recipients.own_name.set_taken(format!(
            "this process, {node} as {own} at {local}, stops: {neighbour} reaches another process called \
             {node} at {address}, as {incarnation}, which answers; {cure}"
        ));
    }

    /// Forgets keys that no other node has used for a while.
    pub(super) fn forget_unused_keys(&mut self) {
        let is_used = |last: Instant| platform::now() - last < KEY_FREE_AFTER;
        self.free_names(|names| names.keys_in_use.retain(|_, last| is_used(*last)));
    }

    /// The link has another neighbour.
    pub(super) fn forget_namesake(&mut self, number: LinkId) {
        self.free_names(|names| _ = names.namesakes.remove(&number));
    }

    /// Frees names and keys. The fault is over when none is taken twice.
    pub(super) fn free_names(&mut self, free: impl FnOnce(&mut NamesTaken)) {
        let were_taken = self.names.are_taken();
        free(&mut self.names);
        if were_taken && !self.names.are_taken() {
            self.recipients.faults.clear(FaultKind::NameTaken);
        }
    }

    pub(super) fn refused(&mut self, number: LinkId, refusal: &PeerRefusal) {
        let link = self.specs.get(&number).map(|spec| spec.name.clone()).unwrap_or_default();
        error!(network = %self.recipients.network, %link, "{refusal}");
        self.tell_monitor(number, LinkCondition::Down { reason: refusal.to_string() });
        if let PeerRefusal::NameTaken { .. } | PeerRefusal::NumberTaken { .. } = refusal {
            self.names.namesakes.insert(number);
            let detail = format!("{refusal}, at the other end of {link}: give one another name");
            self.recipients.faults.declare(FaultKind::NameTaken, detail);
        }
    }
}
