//! What each node of a roster may do at this one, and what it was refused.

use super::policy::{PolicyLine, Role, Verb, permission};
use super::roster::NodeRoster;
use crate::net::NodeId;
use crate::sorted::SortedMap;
use crate::{DeliveryError, Instant, NodeName, ObjectName};
use std::time::Duration;

/// What every node may use that is not a guest, whatever the lines say: the middleware's own
/// contracts. Those of them that a right is needed for are told apart by [`rights_for`].
const INTERNAL: &str = "blastema/";

/// The rights of a roster's nodes at one of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessPolicy {
    own: NodeName,
    serial: u64,
    nodes: SortedMap<NodeId, (NodeName, Role)>,
    lines: Vec<PolicyLine>,
}

/// A right that a peer does not have.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct AccessDenied {
    /// The node that lacks the right.
    pub peer: NodeName,
    /// What it wanted to do.
    pub verb: Verb,
    /// At which object, topic or name: as patterns of policy lines name it.
    pub object: String,
    /// By which contract; empty where there is none.
    pub contract: String,
    /// The policy line that gives the right to others, from 1 on; `None` if the node's role does
    /// not have it.
    pub line: Option<usize>,
    /// The serial number of the roster.
    pub serial: u64,
}

/// What a binding needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::net) enum BindingNeeds {
    /// A peer of any role.
    Nothing,
    /// A peer that is not a guest.
    Membership,
    /// An object of the same node: no peer.
    OwnNode,
    Right(Verb),
    /// This right at this node.
    RightAtNode(Verb),
    /// The right to ask for requests, to tell for messages without a reply.
    AskOrTell,
}

/// What a binding of this contract at this object needs. Commands and variables are checked where
/// they are served, since only the message says of which actuator or variable it is.
pub(in crate::net) fn needs(contract: &str) -> BindingNeeds {
    match contract.strip_prefix(INTERNAL) {
        None => BindingNeeds::AskOrTell,
        Some("command" | "variables") => BindingNeeds::Nothing,
        Some("serve" | "who-serves") => BindingNeeds::Right(Verb::Ask),
        Some("replica" | "service-configuration") => BindingNeeds::Right(Verb::Claim),
        Some("key-status" | "order-isolation" | "order-component") => {
            BindingNeeds::RightAtNode(Verb::Operate)
        }
        Some("recover") => BindingNeeds::RightAtNode(Verb::Recover),
        // What a replica says to the component of its own node.
        Some("drive-component") => BindingNeeds::OwnNode,
        Some(_) => BindingNeeds::Membership,
    }
}

impl AccessPolicy {
    /// The rights that this roster gives at the node `own`.
    pub fn new(own: NodeName, roster: &NodeRoster) -> Self {
        let nodes = roster.nodes().iter();
        let nodes = nodes.map(|node| (NodeId::of(&node.name), (node.name.clone(), node.role)));
        let (serial, lines) = (roster.serial, roster.policy().to_vec());
        AccessPolicy { own, serial, nodes: nodes.collect(), lines }
    }

    /// An object of this node, as patterns of policy lines name it: `arm/gripper`.
    pub fn object(&self, object: &ObjectName) -> String {
        format!("{}/{object}", self.own)
    }

    /// This node, as patterns of policy lines name it.
    pub fn own(&self) -> &NodeName {
        &self.own
    }

    /// The serial number of the roster.
    pub fn serial(&self) -> u64 {
        self.serial
    }

    /// The name of a node of the roster.
    pub fn name_of(&self, peer: NodeId) -> Option<&NodeName> {
        self.nodes.get(&peer).map(|(name, _)| name)
    }

    /// Whether the peer may do this everywhere, so that nothing else need be looked at.
    pub fn is_open(&self, peer: NodeId, verb: Verb) -> bool {
        let role = self.nodes.get(&peer).map_or(Role::Guest, |(_, role)| *role);
        role.may(verb) && !self.lines.iter().any(|line| line.verbs.contains(&verb))
    }

    /// Whether a peer may do this at an object by a contract. The object is a name with its node's
    /// in front, a topic, or a name of the whole robot.
    ///
    /// # Errors
    /// It may not.
    pub fn check(
        &self,
        peer: NodeId,
        verb: Verb,
        object: &str,
        contract: &str,
    ) -> Result<(), Box<AccessDenied>> {
        let permitted = match self.nodes.get(&peer) {
            Some((name, role)) => permission(&self.lines, name, *role, verb, object, contract),
            None => Err(None),
        };
        permitted.map_err(|line| self.denied(peer, verb, object, contract, line))
    }

    /// Whether a node may claim a name of the robot, and serve under it.
    pub fn may_claim(&self, node: &NodeName, name: &ObjectName) -> bool {
        self.check(NodeId::of(node), Verb::Claim, name.as_str(), "").is_ok()
    }

    /// Whether a peer is a node of the robot and no guest.
    ///
    /// # Errors
    /// It is not.
    pub(in crate::net) fn check_membership(
        &self,
        peer: NodeId,
        object: &str,
        contract: &str,
    ) -> Result<(), Box<AccessDenied>> {
        match self.nodes.get(&peer) {
            Some((_, role)) if *role != Role::Guest => Ok(()),
            _ => Err(self.deny(peer, object, contract)),
        }
    }

    /// What a peer is refused whatever the lines say.
    pub(in crate::net) fn deny(
        &self,
        peer: NodeId,
        object: &str,
        contract: &str,
    ) -> Box<AccessDenied> {
        self.denied(peer, Verb::Tell, object, contract, None)
    }

    fn denied(
        &self,
        peer: NodeId,
        verb: Verb,
        object: &str,
        contract: &str,
        line: Option<usize>,
    ) -> Box<AccessDenied> {
        let unlisted = || NodeName::new(&peer.to_string()).expect("a number is a name");
        let peer = self.nodes.get(&peer).map_or_else(unlisted, |(name, _)| name.clone());
        let (object, contract) = (object.to_owned(), contract.to_owned());
        Box::new(AccessDenied { peer, verb, object, contract, line, serial: self.serial })
    }
}

impl AccessDenied {
    /// Whether a program has asked for it. What the middleware of another node says of itself, and
    /// its faults, is refused as well, and is no reason to look at the programs.
    pub fn is_of_a_program(&self) -> bool {
        let is_internal = self.verb == Verb::Tell && self.contract.starts_with(INTERNAL);
        self.verb != Verb::Recover && !is_internal
    }
}

impl From<&AccessDenied> for DeliveryError {
    fn from(denied: &AccessDenied) -> Self {
        DeliveryError::Forbidden {
            node: denied.peer.to_string(),
            verb: denied.verb.word().to_owned(),
            object: denied.object.clone(),
            serial: denied.serial,
        }
    }
}

/// So many different refusals of one peer are remembered at most; the oldest is forgotten first.
const ROWS_MAX: usize = 128;
/// So many refusals of one peer are reported within [`REFUSAL_REMINDER`]; further ones are only
/// counted.
const REPORTED_MAX: u32 = 32;
/// A refusal that goes on is reported again after this time.
pub const REFUSAL_REMINDER: Duration = Duration::from_secs(60);

/// What peers were refused: which, how often, and when last. Times are monotonic.
#[derive(Clone, Debug, Default)]
pub struct RefusalLog {
    /// Peers are nodes of the roster, or were.
    peers: SortedMap<NodeName, PeerRefusals>,
}

#[derive(Clone, Debug)]
struct PeerRefusals {
    entries: SortedMap<RefusalKey, RefusalEntry>,
    /// Since when so many were reported.
    reported: (Instant, u32),
    /// How many there were since [`RefusalLog::take_floods`].
    recent: u64,
}

/// What is counted together: the verb, the object and the contract.
type RefusalKey = (Verb, String, String);

#[derive(Clone, Debug)]
struct RefusalEntry {
    row: RefusalRow,
    reported: Instant,
}

/// One row of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RefusalRow {
    /// What was refused to whom, the last time.
    pub denied: AccessDenied,
    /// The number of refusals.
    pub times: u64,
    /// When the first one happened.
    pub first: Instant,
    /// When the last one happened.
    pub last: Instant,
}

impl RefusalLog {
    /// A peer was refused something. Returns how often, if that is to be reported: the first time,
    /// and once a minute while it goes on; but no more than 32 times a minute of one peer.
    pub fn handle_refused(&mut self, denied: AccessDenied, now: Instant) -> Option<u64> {
        let none = || PeerRefusals { entries: SortedMap::new(), reported: (now, 0), recent: 0 };
        let peer = self.peers.entry(denied.peer.clone()).or_insert_with(none);
        peer.recent = peer.recent.saturating_add(1);
        let times = peer.count(denied, now)?;
        let (since, reported) = &mut peer.reported;
        if now >= *since + REFUSAL_REMINDER {
            (*since, *reported) = (now, 0);
        }
        *reported += 1;
        (*reported <= REPORTED_MAX).then_some(times)
    }

    /// Peers that were refused so much, or more, since this was asked last.
    pub fn take_floods(&mut self, least: u64) -> Vec<NodeName> {
        let floods = self.peers.iter_mut().filter_map(|(node, peer)| {
            let recent = std::mem::take(&mut peer.recent);
            (recent >= least).then(|| node.clone())
        });
        floods.collect()
    }

    /// What was refused, in the order of peers.
    pub fn rows(&self) -> impl Iterator<Item = RefusalRow> {
        let entries = self.peers.values().flat_map(|peer| peer.entries.values());
        entries.map(|entry| entry.row.clone())
    }
}

impl PeerRefusals {
    fn count(&mut self, denied: AccessDenied, now: Instant) -> Option<u64> {
        let AccessDenied { verb, object, contract, .. } = denied.clone();
        let key = (verb, object, contract);
        if let Some(RefusalEntry { row, reported }) = self.entries.get_mut(&key) {
            row.times = row.times.saturating_add(1);
            (row.denied, row.last) = (denied, now);
            let is_due = now >= *reported + REFUSAL_REMINDER;
            *reported = if is_due { now } else { *reported };
            return is_due.then_some(row.times);
        }
        if self.entries.len() >= ROWS_MAX {
            let oldest = self.entries.iter().min_by_key(|(_, entry)| entry.row.last);
            let oldest = oldest.map(|(key, _)| key.clone());
            oldest.map(|key| self.entries.remove(&key));
        }
        let row = RefusalRow { denied, times: 1, first: now, last: now };
        self.entries.insert(key, RefusalEntry { row, reported: now });
        Some(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::trust::crypto::Seed;
    use crate::net::trust::roster::RosterNode;
    use crate::testing::node as name;

    fn id(text: &str) -> NodeId {
        NodeId::of(&name(text))
    }

    fn denied(peer: &str, object: &str) -> AccessDenied {
        let (object, contract) = (object.to_owned(), String::new());
        AccessDenied { peer: name(peer), verb: Verb::Ask, object, contract, line: None, serial: 1 }
    }

    /// The rights at `base`, of a roster with these roles and lines.
    pub(crate) fn policy(nodes: &[(&str, Role)], lines: &[&str]) -> AccessPolicy {
        let listed = nodes.iter().zip(1..).map(|((node, role), seed)| RosterNode {
            name: name(node),
            keys: Seed::new([seed; 32]).public_keys(),
            role: *role,
        });
        let mut roster = NodeRoster::new(name("ranger"), listed).expect("different nodes");
        for line in lines {
            let words: Vec<_> = line.split(' ').collect();
            roster.policy.push(PolicyLine::parse(&words).expect("a line"));
        }
        AccessPolicy::new(name("base"), &roster)
    }

    #[test]
    fn a_verb_without_a_line_is_open_to_all_but_guests_and_what_a_line_closes_is_named() {
        let nodes = [("base", Role::Node), ("arm", Role::Node), ("visitor", Role::Guest)];
        let policy = policy(&nodes, &["only base may lease on base/wheels"]);
        assert!(policy.is_open(id("arm"), Verb::Ask) && !policy.is_open(id("arm"), Verb::Lease));
        assert!(!policy.is_open(id("arm"), Verb::Operate));
        assert!(!policy.is_open(id("visitor"), Verb::Ask) && !policy.is_open(id("x"), Verb::Ask));
        assert_eq!(policy.check(id("arm"), Verb::Lease, "base/arm", "arm/move"), Ok(()));
        let refused = policy.check(id("arm"), Verb::Lease, "base/wheels", "wheels/drive");
        let refused = *refused.expect_err("a line gives it to base");
        assert_eq!((refused.peer.as_str(), refused.line), ("arm", Some(1)));
        assert_eq!((refused.object.as_str(), refused.serial), ("base/wheels", 1));
        let refused = policy.check(id("visitor"), Verb::Ask, "base/wheels", "wheels/drive");
        assert_eq!(refused.expect_err("a guest").line, None);
        let refused = policy.check(id("unknown"), Verb::Ask, "base/wheels", "wheels/drive");
        assert_eq!(refused.expect_err("it is not listed").peer.as_str(), id("unknown").to_string());
    }

    #[test]
    fn contracts_of_the_middleware_need_what_they_do() {
        assert_eq!(needs("arm/move"), BindingNeeds::AskOrTell);
        assert_eq!(needs("blastema/command"), BindingNeeds::Nothing);
        assert_eq!(needs("blastema/replica"), BindingNeeds::Right(Verb::Claim));
        assert_eq!(needs("blastema/drive-component"), BindingNeeds::OwnNode);
        assert_eq!(needs("blastema/recover"), BindingNeeds::RightAtNode(Verb::Recover));
        assert_eq!(needs("blastema/await-end"), BindingNeeds::Membership);
    }

    #[test]
    fn who_asks_a_thousand_times_for_what_it_may_not_is_told_once_for_each_look() {
        let (mut log, start) = (RefusalLog::default(), Instant::default());
        for number in 0..1_500 {
            log.handle_refused(denied("arm", &format!("o{number}")), start);
        }
        for _ in 0..999 {
            log.handle_refused(denied("leg", "base/wheels"), start);
        }
        assert_eq!(log.take_floods(1_000), [name("arm")]);
        log.handle_refused(denied("leg", "base/wheels"), start);
        assert_eq!(log.take_floods(1_000), []);
    }

    #[test]
    fn a_refusal_is_told_at_first_and_once_a_minute_and_the_log_is_bounded() {
        let (mut log, start) = (RefusalLog::default(), Instant::default());
        assert_eq!(log.handle_refused(denied("arm", "base/wheels"), start), Some(1));
        let reported: Vec<_> = (1..=130)
            .filter_map(|second| {
                let now = start + Duration::from_secs(second);
                log.handle_refused(denied("arm", "base/wheels"), now)
            })
            .collect();
        assert_eq!(reported, [61, 121]);
        let row = log.rows().next().expect("one");
        assert_eq!((row.times, row.last - row.first), (131, Duration::from_secs(130)));

        log.handle_refused(denied("leg", "base/wheels"), start);
        for number in 0..2 * ROWS_MAX {
            let now = start + Duration::from_secs(200 + number as u64);
            log.handle_refused(denied("arm", &format!("o{number}")), now);
        }
        let flood = start + Duration::from_secs(10_000);
        let reported = (0..ROWS_MAX)
            .filter_map(|n| log.handle_refused(denied("arm", &format!("new{n}")), flood));
        assert_eq!(reported.count(), REPORTED_MAX as usize);
        let (of_arm, others): (Vec<_>, Vec<_>) =
            log.rows().partition(|row| row.denied.peer.as_str() == "arm");
        assert_eq!((of_arm.len(), others.len()), (ROWS_MAX, 1));
        assert!(of_arm.iter().all(|row| row.first >= start + Duration::from_secs(200)));
    }
}
