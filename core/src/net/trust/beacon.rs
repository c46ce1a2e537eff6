//! Beacons of nodes with keys: who is at which port, with a code for each other node of the robot.
//!
//! ```text
//! BLB 3 │ version 2 │ port 2 │ serial 8 │ first 1 │ n 1 │ name n │ code 8 for each other node …
//! ```
//!
//! Each code is the first 8 bytes of HMAC-SHA-256 over all that stands before the codes, under a
//! key of the pair. They are in the order of the sender's roster, without the sender, from the
//! place `first` on: a robot of more nodes than fit has several beacons. There is no secret of all
//! nodes.
//!
//! A beacon that was recorded passes when it is repeated: it tells an address that was true once,
//! and the node there must still complete a handshake.

use super::crypto::Seed;
use super::roster::NodeRoster;
use crate::net::seal::cipher::SealCrypto;
use crate::net::seal::noise::{MacKey, derived_key};
use crate::{Instant, NodeName, SlidingWindow};
use std::time::Duration;
use zeroize::Zeroizing;

const MARK: &[u8] = b"BLB\x02";
const CODE: usize = 8;
/// With more codes, a beacon would not fit into one frame of Ethernet.
const CODES_MAX: usize = 128;
/// So many beacons with another serial number are tried in a second, at each of their codes.
const TRIES_MAX: u32 = 10;
const TRIES_PERIOD: Duration = Duration::from_secs(1);

/// The keys for beacons of one node.
#[derive(Debug)]
pub struct BeaconKeys {
    own: NodeName,
    serial: u64,
    /// All nodes in the order of the roster; the node itself has no key with itself.
    nodes: Vec<(NodeName, Option<MacKey>)>,
    tried: SlidingWindow,
}

/// What a beacon says that was checked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CheckedBeacon {
    /// This node is at this port of the address that the beacon came from.
    Node(NodeName, u16),
    /// It is for other nodes, or this node's own.
    NotForUs,
    /// No node of the robot has made it for this one.
    Forged,
}

impl BeaconKeys {
    /// The keys of the node that has this seed, with the nodes of this roster: some 60 µs for each.
    pub fn new(seed: &Seed, roster: &NodeRoster, own: &NodeName) -> Self {
        let crypto = seed.handshakes();
        let key = |public: &[u8; 32]| {
            let secret = Zeroizing::new(crypto.pair_secret(public)?);
            Some(MacKey::new(&*derived_key(&secret, "beacon")))
        };
        let nodes = roster.nodes().iter().map(|node| {
            let is_other = node.name != *own;
            (node.name.clone(), key(node.keys.x25519.bytes()).filter(|_| is_other))
        });
        let (own, serial, nodes) = (own.clone(), roster.serial, nodes.collect());
        let tried = SlidingWindow::new(TRIES_MAX, TRIES_PERIOD);
        BeaconKeys { own, serial, nodes, tried }
    }

    /// What says that this node is at this port.
    pub fn beacons(&self, port: u16) -> Vec<Vec<u8>> {
        let others: Vec<_> = self.nodes.iter().filter(|(name, _)| *name != self.own).collect();
        let beacon = |(part, nodes): (usize, &[&(NodeName, Option<MacKey>)])| {
            let name = self.own.as_str().as_bytes();
            let (first, length) = ((part * CODES_MAX) as u8, name.len() as u8);
            let (port, serial) = (port.to_be_bytes(), self.serial.to_be_bytes());
            let head = [MARK, &port, &serial, &[first, length], name].concat();
            let codes = nodes
                .iter()
                .flat_map(|(_, key)| key.as_ref().map_or([0; CODE], |key| key.short_mac(&[&head])));
            let codes: Vec<u8> = codes.collect();
            [head, codes].concat()
        };
        others.chunks(CODES_MAX).enumerate().map(beacon).collect()
    }

    /// Checks a frame that came to the group of the beacons.
    pub fn check(&mut self, frame: &[u8], now: Instant) -> CheckedBeacon {
        self.checked(frame, now).unwrap_or(CheckedBeacon::Forged)
    }

    fn checked(&mut self, frame: &[u8], now: Instant) -> Option<CheckedBeacon> {
        let rest = frame.strip_prefix(MARK)?;
        let (port, rest) = rest.split_first_chunk()?;
        let (serial, rest) = rest.split_first_chunk()?;
        let ([first, length], rest) = rest.split_first_chunk()?;
        let (name, codes) = rest.split_at_checked(usize::from(*length))?;
        if codes.len() % CODE != 0 || codes.len() > CODE * CODES_MAX {
            return None;
        }
        let name = NodeName::new(str::from_utf8(name).ok()?).ok()?;
        if name == self.own {
            return Some(CheckedBeacon::NotForUs);
        }
        let place_of = |node: &NodeName| self.nodes.iter().position(|(known, _)| known == node);
        let theirs = place_of(&name)?;
        let key = self.nodes[theirs].1.as_ref()?;
        let head = &frame[..frame.len() - codes.len()];
        let codes: Vec<&[u8]> = codes.chunks(CODE).collect();
        let is_right = |code: &&[u8]| key.verify_short(&[head], code);
        let is_for_us = if u64::from_be_bytes(*serial) == self.serial {
            let own = place_of(&self.own)?;
            let place = own - usize::from(theirs < own);
            let code = place.checked_sub((*first).into()).and_then(|place| codes.get(place));
            let Some(code) = code else { return Some(CheckedBeacon::NotForUs) };
            is_right(code)
        } else {
            // Where this node stands in that roster is not known.
            if !self.tried.add((), now) {
                return Some(CheckedBeacon::NotForUs);
            }
            codes.iter().any(is_right)
        };
        is_for_us.then(|| CheckedBeacon::Node(name, u16::from_be_bytes(*port)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::trust::policy::Role;
    use crate::net::trust::roster::RosterNode;
    use crate::testing::at;

    fn name(node: usize) -> NodeName {
        NodeName::new(&format!("node{node}")).expect("a name")
    }

    fn seed(node: usize) -> Seed {
        let mut bytes = [7; 32];
        bytes[..8].copy_from_slice(&(node as u64).to_be_bytes());
        Seed::new(bytes)
    }

    fn roster(nodes: impl IntoIterator<Item = usize>, serial: u64) -> NodeRoster {
        let listed = nodes.into_iter().map(|node| RosterNode {
            name: name(node),
            keys: seed(node).public_keys(),
            role: Role::Node,
        });
        let robot = NodeName::new("ranger").expect("a name");
        let mut roster = NodeRoster::new(robot, listed).expect("different nodes");
        roster.serial = serial;
        roster
    }

    fn keys(node: usize, roster: &NodeRoster) -> BeaconKeys {
        BeaconKeys::new(&seed(node), roster, &name(node))
    }

    #[test]
    fn each_node_of_the_roster_believes_its_own_code_and_no_changed_byte() {
        let roster = roster(0..4, 3);
        for sender in 0..4 {
            let beacons = keys(sender, &roster).beacons(7400);
            let [beacon] = &beacons[..] else { panic!("{beacons:?}") };
            assert_eq!(beacon.len(), 16 + "node0".len() + 3 * CODE);
            for receiver in 0..4 {
                let mut keys = keys(receiver, &roster);
                let expected = match receiver == sender {
                    true => CheckedBeacon::NotForUs,
                    false => CheckedBeacon::Node(name(sender), 7400),
                };
                assert_eq!(keys.check(beacon, at(0)), expected);
            }
        }

        let beacon = &keys(0, &roster).beacons(7400)[0];
        let mut keys = keys(1, &roster);
        let head = beacon.len() - 3 * CODE;
        for byte in 0..head + CODE {
            let mut changed = beacon.clone();
            changed[byte] ^= 1;
            let checked = keys.check(&changed, at(0));
            assert!(!matches!(checked, CheckedBeacon::Node(..)), "byte {byte}: {checked:?}");
        }
        for length in 0..beacon.len() {
            let checked = keys.check(&beacon[..length], at(0));
            let is_whole = length >= head + CODE && (length - head).is_multiple_of(CODE);
            assert_eq!(matches!(checked, CheckedBeacon::Node(..)), is_whole, "{length} bytes");
        }
    }

    #[test]
    fn beacons_of_other_robots_and_revoked_nodes_and_without_codes_are_forged() {
        let ours = roster(0..3, 3);
        let mut keys = keys(0, &ours);
        let stranger = BeaconKeys::new(&seed(9), &ours, &name(1)).beacons(1);
        assert_eq!(keys.check(&stranger[0], at(0)), CheckedBeacon::Forged);
        let revoked = BeaconKeys::new(&seed(5), &roster(0..6, 2), &name(5)).beacons(1);
        assert_eq!(keys.check(&revoked[0], at(0)), CheckedBeacon::Forged);
        for noise in
            [&b""[..], b"BLB\x01\x1c\xe8node1", b"BLB\x02", b"BLB\x02\0\x01\0\0\0\0\0\0\0\x03\0"]
        {
            assert_eq!(keys.check(noise, at(0)), CheckedBeacon::Forged, "{noise:?}");
        }
    }

    #[test]
    fn another_serial_number_is_no_hindrance_and_costs_ten_tries_a_second() {
        let older = keys(2, &roster([0, 2], 2)).beacons(7400);
        let mut keys = keys(0, &roster(0..5, 3));
        let found = CheckedBeacon::Node(name(2), 7400);
        for _ in 0..TRIES_MAX {
            assert_eq!(keys.check(&older[0], at(10)), found);
        }
        assert_eq!(keys.check(&older[0], at(900)), CheckedBeacon::NotForUs);
        assert_eq!(keys.check(&older[0], at(1_011)), found);
    }

    #[test]
    fn a_robot_of_many_nodes_has_several_beacons_of_one_frame_each() {
        let roster = roster(0..200, 1);
        let beacons = keys(60, &roster).beacons(7400);
        assert_eq!(beacons.len(), 2);
        assert!(beacons.iter().all(|beacon| beacon.len() <= 1_472));
        for (receiver, part) in [(0, 0), (59, 0), (61, 0), (128, 0), (129, 1), (199, 1)] {
            let mut keys = keys(receiver, &roster);
            let found = CheckedBeacon::Node(name(60), 7400);
            assert_eq!(keys.check(&beacons[part], at(0)), found, "node {receiver}");
            assert_eq!(keys.check(&beacons[1 - part], at(0)), CheckedBeacon::NotForUs);
        }
    }
}
