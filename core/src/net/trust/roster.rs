//! The signed list of a robot's nodes: its canonical text, its signature, its serial number.
//!
//! ```text
//! blastema roster 1
//! robot   ranger
//! serial  7
//! node    base x25519 M3rk… ed25519 kQ0p…
//! node    laptop x25519 … ed25519 … role operator
//! policy
//!   only base may ask tell on arm/**
//! end
//! signed  sYx1…    Ed25519 over all bytes before this line
//! ```

use super::crypto::{PublicKey, PublicKeys, SIGNATURE_BYTES, Seed};
use super::policy::{PolicyLine, Role};
use super::text::{Lines, PEERS_END, TrustError, TrustProblem, decode, encode, public_key};
use crate::NodeName;
use crate::net::NodeId;
use std::cmp::Ordering;
use std::fmt::Write;

/// The longest roster, in bytes.
pub const ROSTER_BYTES: usize = 64 * 1024;
/// So many nodes a roster lists at most.
pub const ROSTER_NODES: usize = 256;
const TITLE: &str = "blastema roster 1";

/// The nodes of a robot, with their public keys and roles, and its policy.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct NodeRoster {
    /// The name of the robot.
    pub robot: NodeName,
    /// Rises with each change.
    pub serial: u64,
    pub(super) nodes: Vec<RosterNode>,
    pub(super) policy: Vec<PolicyLine>,
}

/// One node of a roster.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosterNode {
    /// The node's name.
    pub name: NodeName,
    /// Its public keys.
    pub keys: PublicKeys,
    /// The node's role.
    pub role: Role,
}

/// How a roster that is offered stands to the one that is held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RosterOrder {
    /// It has a higher serial number, and replaces the other.
    Newer,
    /// They are the same.
    Same,
    /// It has a lower serial number, and is refused.
    Older,
    /// It is of another robot, or differs under the same serial number, as when two copies of the
    /// signer's file were used. It is refused.
    Conflicting,
}

impl NodeRoster {
    /// A roster of these nodes without a policy, with the serial number 1.
    ///
    /// # Errors
    /// A node cannot be listed with those before it.
    pub fn new(
        robot: NodeName,
        nodes: impl IntoIterator<Item = RosterNode>,
    ) -> Result<Self, TrustProblem> {
        let mut roster = NodeRoster { robot, serial: 1, nodes: Vec::new(), policy: Vec::new() };
        nodes.into_iter().try_for_each(|node| roster.add(node))?;
        Ok(roster)
    }

    /// Returns the robot's nodes.
    pub fn nodes(&self) -> &[RosterNode] {
        &self.nodes
    }

    /// Returns the lines of the policy, in order.
    pub fn policy(&self) -> &[PolicyLine] {
        &self.policy
    }

    /// The node of this name.
    pub fn node(&self, name: &NodeName) -> Option<&RosterNode> {
        self.nodes.iter().find(|node| node.name == *name)
    }

    /// Lists one more node.
    ///
    /// # Errors
    /// Its name, its number or a key of it is another node's, its name is a word of policy lines,
    /// or the list is full.
    pub fn add(&mut self, node: RosterNode) -> Result<(), TrustProblem> {
        if node.name.as_str() == PEERS_END {
            return Err(TrustProblem::ReservedName);
        }
        if self.nodes.len() >= ROSTER_NODES {
            return Err(TrustProblem::TooManyNodes { most: ROSTER_NODES });
        }
        for other in &self.nodes {
            if other.name == node.name {
                return Err(TrustProblem::NodeTwice(node.name));
            }
            let number = NodeId::of(&node.name);
            if NodeId::of(&other.name) == number {
                return Err(TrustProblem::NumberTaken { number, other: other.name.clone() });
            }
            let (own, others) = (&node.keys, &other.keys);
            if own.x25519 == others.x25519 || own.ed25519 == others.ed25519 {
                return Err(TrustProblem::KeyTwice(other.name.clone()));
            }
        }
        self.nodes.push(node);
        Ok(())
    }

    /// Removes a node, also from the lines of the policy, and returns it. A line that names no
    /// other is kept back: the number of the first such line, from 1 on, is returned instead.
    ///
    /// # Errors
    /// This line of the policy names the node alone; without it, what it closes would be open.
    pub fn remove(&mut self, name: &NodeName) -> Result<Option<RosterNode>, usize> {
        let alone = |line: &PolicyLine| line.peers.iter().all(|peer| peer == name);
        if let Some(place) = self.policy.iter().position(alone) {
            return Err(place + 1);
        }
        self.policy.iter_mut().for_each(|line| line.peers.retain(|peer| peer != name));
        let place = self.nodes.iter().position(|node| node.name == *name);
        Ok(place.map(|place| self.nodes.remove(place)))
    }

    /// Gives a listed node other keys, and returns whether it is listed.
    pub fn replace_keys(&mut self, name: &NodeName, keys: PublicKeys) -> bool {
        let node = self.nodes.iter_mut().find(|node| node.name == *name);
        node.map(|node| node.keys = keys).is_some()
    }

    /// How `offered` stands to this roster.
    pub fn order_of(&self, offered: &NodeRoster) -> RosterOrder {
        match offered.serial.cmp(&self.serial) {
            _ if offered.robot != self.robot => RosterOrder::Conflicting,
            Ordering::Greater => RosterOrder::Newer,
            Ordering::Less => RosterOrder::Older,
            Ordering::Equal if offered == self => RosterOrder::Same,
            Ordering::Equal => RosterOrder::Conflicting,
        }
    }

    /// Parses the text without its signature.
    ///
    /// # Errors
    /// The line that is wrong, and what to write.
    pub fn parse(text: &str) -> Result<Self, TrustError> {
        let mut lines = Lines::new(text, ROSTER_BYTES)?;
        lines.title(TITLE)?;
        let (line, robot) = lines.value("robot")?;
        let robot = NodeName::new(robot).map_err(|error| TrustProblem::Name(error).at(line))?;
        let (line, serial) = lines.value("serial")?;
        let number = serial.parse().ok().filter(|serial| *serial > 0);
        let serial = number.ok_or_else(|| TrustProblem::NotSerial.at(line))?;
        let mut roster = NodeRoster { robot, serial, nodes: Vec::new(), policy: Vec::new() };
        let mut in_policy = false;
        loop {
            let (line, words) = lines.next();
            let taken = match words.as_slice() {
                ["end"] => break,
                ["policy"] if !in_policy => {
                    in_policy = true;
                    Ok(())
                }
                ["node", rest @ ..] if !in_policy => node(rest).and_then(|node| roster.add(node)),
                words if in_policy => roster.add_line(words),
                _ => Err(TrustProblem::expected("`node`, `policy` or `end`")),
            };
            taken.map_err(|problem| problem.at(line))?;
        }
        lines.finish()?;
        Ok(roster)
    }

    fn add_line(&mut self, words: &[&str]) -> Result<(), TrustProblem> {
        let line = PolicyLine::parse(words)?;
        let known = self.nodes.iter().map(|node| node.name.as_str());
        match line.peers.iter().find(|peer| self.node(peer).is_none()) {
            Some(peer) => Err(TrustProblem::unknown(peer.as_str(), known)),
            None => {
                self.policy.push(line);
                Ok(())
            }
        }
    }

    /// The text without its signature: the bytes that are signed.
    pub fn to_text(&self) -> String {
        let NodeRoster { robot, serial, nodes, policy } = self;
        let mut text = format!("{TITLE}\nrobot   {robot}\nserial  {serial}\n");
        for RosterNode { name, keys: PublicKeys { x25519, ed25519 }, role } in nodes {
            let _ = write!(text, "node    {name} x25519 {x25519} ed25519 {ed25519}");
            if *role != Role::Node {
                let _ = write!(text, " role {role}");
            }
            text.push('\n');
        }
        if !policy.is_empty() {
            text.push_str("policy\n");
        }
        policy.iter().for_each(|line| {
            let _ = writeln!(text, "  {line}");
        });
        text + "end\n"
    }

    /// The text with its signature by the robot's key.
    pub fn sign(&self, robot: &Seed) -> String {
        let text = self.to_text();
        let signature = encode(&robot.sign_roster(text.as_bytes()));
        format!("{text}signed  {signature}\n")
    }

    /// Parses the text with its signature, which must be by the robot of this key.
    ///
    /// # Errors
    /// The line that is wrong, and what to do.
    pub fn parse_signed(text: &str, signer: &PublicKey) -> Result<Self, TrustError> {
        let last = text.trim_end().rfind('\n').map_or(0, |end| end + 1);
        let (body, signed) = text.split_at(last);
        let letters = signed.strip_prefix("signed  ").and_then(|rest| rest.strip_suffix('\n'));
        let signature = letters.and_then(decode::<SIGNATURE_BYTES>);
        if !signature.is_some_and(|bytes| signer.has_signed(body.as_bytes(), &bytes)) {
            return Err(TrustProblem::NotSigned.at(body.lines().count() + 1));
        }
        let roster = NodeRoster::parse(body)?;
        if roster.to_text() == body { Ok(roster) } else { Err(TrustProblem::NotCanonical.at(1)) }
    }
}

fn node(words: &[&str]) -> Result<RosterNode, TrustProblem> {
    let (words, role) = match words {
        [words @ .., "role", role] => (words, Role::parse(role)?),
        words => (words, Role::Node),
    };
    let [name, "x25519", x25519, "ed25519", ed25519] = words else {
        let form = "`node NAME x25519 KEY ed25519 KEY`, and perhaps `role ROLE`";
        return Err(TrustProblem::expected(form));
    };
    let keys = PublicKeys { x25519: public_key(x25519)?, ed25519: public_key(ed25519)? };
    Ok(RosterNode { name: NodeName::new(name)?, keys, role })
}
