//! Two nodes on one medium, whose links are sealed, and what others do on that medium.

use super::*;
use crate::testing::at;

mod connections;
mod dialing_in;

use crate::net::link::{LinkConfig, LinkState};
use crate::net::seal::{NoiseCrypto, SealerConfig};
use crate::net::wire::frame::{Frame, Hello};
use crate::net::wire::hello_state::HelloState;
use crate::{Incarnation, NodeName};
use std::collections::BTreeSet;

/// An address of the medium: below 10 a node's, from 10 on a connection of no known node.
type Address = u32;
type End = LinkLayer<NoiseCrypto, Address>;

impl LinkAddress for Address {
    fn is_connection(&self) -> bool {
        *self >= 10
    }
}

const LINK: LinkId = LinkId(7);

fn name(node: usize) -> NodeName {
    NodeName::new(["left", "right"][node]).unwrap()
}

fn key(node: usize) -> NeighbourKey {
    let public = NoiseCrypto::new([node as u8 + 1; 32]).public_key();
    NeighbourKey { node: NodeId::of(&name(node)), public }
}

fn link(node: usize, incarnation: u64, now: u64) -> Link {
    let expected = Some(name(1 - node));
    Link::new(
        LinkConfig { expected, ..LinkConfig::new(name(node), Incarnation(incarnation)) },
        at(now),
    )
}

/// A node of this number with its link to the other, which is at the address of that number.
fn end(node: usize, incarnation: u64, now: u64) -> End {
    let config = SealerConfig::new(NodeId::of(&name(node)), Incarnation(incarnation), "ranger");
    let crypto = NoiseCrypto::new([node as u8 + 1; 32]);
    let seed = [node as u8 + 10 * incarnation as u8; 32];
    let mut end = LinkLayer::new(Some(Sealer::new(config, crypto, seed, at(now))));
    end.handle_mtu(1_000, false);
    let added = end.insert(
        LINK,
        link(node, incarnation, now),
        1 - node as u32,
        Some(key(1 - node)),
        at(now),
    );
    added.expect("both have keys");
    end
}

/// The medium takes a millisecond.
struct World {
    ends: [End; 2],
    /// Where each end's frames come from, as the other sees it.
    from: [Address; 2],
    /// This end is not run.
    stopped: Option<usize>,
    now: u64,
    in_flight: Vec<(u64, usize, Bytes)>,
    sent: Vec<(usize, Address, Bytes)>,
    outputs: Vec<(u64, usize, LinkLayerOutput<Address>)>,
}

impl World {
    fn new() -> Self {
        World {
            ends: [end(0, 1, 0), end(1, 1, 0)],
            from: [0, 1],
            stopped: None,
            now: 0,
            in_flight: vec![],
            sent: vec![],
            outputs: vec![],
        }
    }

    fn up() -> Self {
        let mut world = World::new();
        world.run(500);
        assert_eq!(world.states(), [LinkState::Up; 2]);
        world.outputs.clear();
        world
    }

    fn states(&self) -> [LinkState; 2] {
        [0, 1].map(|node| self.ends[node].get(LINK).unwrap().state())
    }

    fn run(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now += 1;
            let now = at(self.now);
            let arrived: Vec<_> = self.in_flight.extract_if(.., |f| f.0 <= self.now).collect();
            for (_, node, frame) in arrived.into_iter().filter(|f| self.stopped != Some(1 - f.1)) {
                self.ends[1 - node].handle_frame(self.from[node], frame, now);
            }
            let stopped = self.stopped;
            for node in (0..2).filter(|node| stopped != Some(*node)) {
                // A turn each, as an actor has it.
                for _ in 0..3 {
                    if self.ends[node].poll_timeout().is_some_and(|due| due <= now) {
                        self.ends[node].handle_timeout(now);
                    }
                }
                self.poll(node);
            }
        }
    }

    fn poll(&mut self, node: usize) {
        while let Some(output) = self.ends[node].poll_output() {
            match output {
                LinkLayerOutput::Transmit { to, frame, .. } => {
                    let frame = frame.into_bytes();
                    self.in_flight.push((self.now + 1, node, frame.clone()));
                    self.sent.push((node, to, frame));
                }
                output => self.outputs.push((self.now, node, output)),
            }
        }
    }

    fn packet(&mut self, node: usize, text: &'static str) {
        let now = at(self.now);
        self.ends[node]
            .with_link(LINK, now, |link| link.handle_packet(Bytes::from_static(text.as_bytes())));
        self.poll(node);
    }

    fn packets(&self, node: usize) -> Vec<Bytes> {
        let of = |(_, at, output): &(u64, usize, LinkLayerOutput<Address>)| match output {
            LinkLayerOutput::Of(LINK, LinkOutput::Packet(bytes)) if *at == node => {
                Some(bytes.clone())
            }
            _ => None,
        };
        self.outputs.iter().filter_map(of).collect()
    }

    fn changes(&self, node: usize) -> Vec<(LinkState, &'static str)> {
        let of = |(_, at, output): &(u64, usize, LinkLayerOutput<Address>)| match output {
            LinkLayerOutput::Of(LINK, LinkOutput::Changed { state, reason, .. }) if *at == node => {
                Some((*state, *reason))
            }
            _ => None,
        };
        self.outputs.iter().filter_map(of).collect()
    }
}

/// A hello as the neighbour `node` would say it, not sealed.
fn hello(node: usize, incarnation: u64, sequence: u32) -> Bytes {
    let hello = Hello {
        node: name(node),
        incarnation: Incarnation(incarnation),
        sequence,
        interval_us: 50_000,
        skipped: 0,
        state: HelloState::Down,
        loss_permille: 0,
        echo: None,
    };
    Frame::Hello(hello).encode()
}

#[test]
fn links_come_up_over_seals_and_nothing_goes_out_that_can_be_read() {
    let mut world = World::up();

    world.packet(0, "to the right");
    world.packet(1, "to the left");
    world.run(5);

    assert_eq!(world.packets(1), [&b"to the right"[..]]);
    assert_eq!(world.packets(0), [&b"to the left"[..]]);
    let secrets = [&b"left"[..], b"right", b"to the"];
    for (_, _, frame) in &world.sent {
        let clear = secrets.iter().any(|text| frame.windows(text.len()).any(|part| part == *text));
        assert!(!clear, "{frame:?}");
    }
    assert!(world.ends.iter().all(|end| end.channel(LINK).is_some()));
}

#[test]
fn what_others_send_reaches_no_link_and_is_no_fault_of_the_neighbour() {
    let mut world = World::up();
    let recorded: Vec<_> =
        world.sent.iter().map(|(node, _, frame)| (*node, frame.clone())).collect();

    for round in 0..1_000 {
        let (node, frame) = &recorded[round % recorded.len()];
        let mut changed = frame.to_vec();
        changed[round % frame.len()] ^= 1;
        let now = at(world.now);
        for frame in [
            hello(1 - node, 1, world.now as u32 / 50),
            hello(1 - node, 9, 3),
            frame.clone(),
            changed.into(),
            Frame::Data(Bytes::from_static(b"forged").into()).encode(),
        ] {
            world.ends[*node].handle_frame(1 - *node as u32, frame.clone(), now);
            world.ends[1 - *node].handle_frame(*node as u32, frame, now);
        }
        world.run(1);
    }

    assert_eq!(world.states(), [LinkState::Up; 2]);
    assert_eq!((world.changes(0), world.changes(1)), (vec![], vec![]));
    assert_eq!(world.packets(0).len() + world.packets(1).len(), 0);
    for end in &world.ends {
        assert_eq!(end.refused_of(LINK).total(), 0);
        assert!(end.seal_refusals().unwrap().total() >= 4_000);
    }
}

#[test]
fn a_neighbour_that_restarts_takes_its_link_down_as_soon_as_it_has_proved_it() {
    for node in 0..2 {
        let mut world = World::up();
        world.run(20);
        // Long enough to be seen as silent, and shorter than its link needs to be down.
        let before = world.now;
        world.ends[node] = end(node, 2, world.now);
        world.run(2_000);

        let other = 1 - node;
        let downs: Vec<_> = world
            .changes(other)
            .into_iter()
            .filter(|(state, _)| *state == LinkState::Down)
            .collect();
        assert_eq!(downs.len(), 1, "{downs:?}");
        assert_eq!(world.states(), [LinkState::Up; 2], "since {before}");
        let known = world.ends[other].get(LINK).unwrap().neighbour().unwrap();
        assert_eq!(known.incarnation, Incarnation(2));
    }
}

#[test]
fn a_node_that_restarts_while_its_past_is_repeated_is_found() {
    for node in 0..2 {
        let mut world = World::up();
        let other = 1 - node;
        let past: Vec<_> =
            world.sent.iter().filter(|sent| sent.0 == node).map(|sent| sent.2.clone()).collect();
        world.ends[node] = end(node, 2, world.now);
        // Twice the time that a restarted neighbour needs while no frame is repeated.
        for n in 0..3_000 {
            let again = past[n % past.len()].clone();
            world.ends[other].handle_frame(node as u32, again, at(world.now));
            world.run(1);
        }

        assert_eq!(world.states(), [LinkState::Up; 2]);
        let known = world.ends[other].get(LINK).unwrap().neighbour().unwrap();
        assert_eq!(known.incarnation, Incarnation(2));
    }
}

#[test]
fn hellos_of_another_incarnation_than_the_keys_are_refused_and_are_the_neighbours_own() {
    let mut world = World::up();
    // A link in another incarnation over the keys of the first: a broken node.
    world.ends[1].links.insert(LINK, link(1, 5, world.now));

    world.run(1_000);

    assert_eq!(world.ends[0].get(LINK).unwrap().state(), LinkState::Down);
    assert!(world.ends[0].refused_of(LINK).unexpected > 10);
    let known = world.ends[0].get(LINK).unwrap().neighbour().unwrap();
    assert_eq!(known.incarnation, Incarnation(1));
}

#[test]
fn a_connection_is_the_neighbours_once_it_has_sealed_a_frame_there_and_not_before() {
    let mut world = World::new();
    // The right node's frames come over a connection that it has made.
    world.from = [0, 12];
    let stranger = Bytes::from_static(b"\xb1\x02who are you");
    world.ends[0].handle_frame(33, stranger, at(0));

    world.run(500);

    assert_eq!(world.states(), [LinkState::Up; 2]);
    let adopted = world.outputs.iter().filter_map(|(_, node, output)| match output {
        LinkLayerOutput::Adopt { connection, peer } => Some((*node, *connection, *peer)),
        _ => None,
    });
    assert_eq!(adopted.collect::<BTreeSet<_>>(), BTreeSet::from([(0, 12, 1)]));
    // From there on all goes to the neighbour's address.
    let last = world.sent.iter().rposition(|(_, to, _)| *to == 12).unwrap_or(0);
    assert!(world.sent[last + 1..].iter().any(|(node, to, _)| *node == 0 && *to == 1));
    world.sent.clear();
    world.run(500);
    assert!(world.sent.iter().all(|(_, to, _)| *to < 10));
}

#[test]
fn an_address_that_is_no_connections_proves_nothing_and_frames_go_where_the_user_has_said() {
    let mut world = World::new();
    // Another address of the medium, as a forger would write it, or that of a third node.
    world.from = [0, 5];

    world.run(500);

    assert_eq!(world.states(), [LinkState::Up; 2]);
    let adopts = |(_, _, output): &(u64, usize, LinkLayerOutput<Address>)| {
        matches!(output, LinkLayerOutput::Adopt { .. })
    };
    assert!(!world.outputs.iter().any(adopts));
    world.sent.clear();
    // New keys are asked for, and all frames are sent to the neighbour's own address.
    let now = at(world.now);
    world.ends[0].set_key(LINK, Some(key(1).public), now).expect("it is a key");
    world.ends[1] = end(1, 2, world.now);
    world.run(2_000);
    assert_eq!(world.states(), [LinkState::Up; 2]);
    assert!(world.sent.iter().all(|(node, to, _)| *node == 1 || [1, 5].contains(to)));
    let last = world.sent.iter().rposition(|(node, to, _)| *node == 0 && *to == 5).unwrap_or(0);
    assert!(world.sent.len() - last > 50, "what is answered there ends with the handshake");
}

#[test]
fn a_link_on_a_sealed_network_needs_a_key_and_each_node_has_one_link() {
    let mut end = end(0, 1, 0);
    let other = LinkId(8);
    let mut add = |address, key| end.insert(other, link(0, 1, 0), address, key, at(0));

    assert_eq!(add(5, None), Err(AddLinkError::NoKey));
    assert_eq!(add(5, Some(key(1))), Err(AddLinkError::PeerTwice));
    assert!(matches!(add(5, Some(key(0))), Err(AddLinkError::Key(_))));
    end.remove(LINK);
    assert_eq!(end.insert(other, link(0, 1, 0), 5, Some(key(1)), at(0)), Ok(()));
    assert_eq!(end.link_at(&5), Some(other));
    assert_eq!(end.link_at(&1), None);
}

#[test]
fn a_neighbour_that_is_revoked_loses_its_link_and_one_that_is_listed_again_gets_it_back() {
    let mut world = World::up();
    let revoke = |world: &mut World, key: Option<NeighbourKey>| {
        let now = at(world.now);
        world.ends[0].set_key(LINK, key.map(|key| key.public), now).expect("a key or none");
        world.poll(0);
    };

    revoke(&mut world, None);
    world.packet(1, "after its end");
    world.packet(0, "in plain text");
    world.run(2_000);

    let revoked = "the neighbour is not in the roster any more: it was revoked";
    assert_eq!(world.changes(0).last(), Some(&(LinkState::Down, revoked)));
    assert_eq!(world.packets(0).len() + world.packets(1).len(), 0);
    assert!(world.ends[0].channel(LINK).is_none());
    let sealed = |frame: &Bytes| [0xb0, 0xd0].contains(&(frame[0] & 0xf0)) && frame[0] != 0xb1;
    assert!(world.sent.iter().all(|(_, _, frame)| sealed(frame)), "nothing is sent in the clear");

    revoke(&mut world, Some(key(1)));
    world.run(3_000);
    assert_eq!(world.states(), [LinkState::Up; 2]);
    let since = world.ends[0].channel(LINK).unwrap().since;
    // The same key changes nothing.
    revoke(&mut world, Some(key(1)));
    world.run(100);
    assert_eq!(world.ends[0].channel(LINK).unwrap().since, since);

    let public = NoiseCrypto::new([9; 32]).public_key();
    revoke(&mut world, Some(NeighbourKey { public, ..key(1) }));
    let replaced = "the roster has another key for the neighbour: start it with its new key file";
    assert_eq!(world.changes(0).last(), Some(&(LinkState::Down, replaced)));
}

#[test]
fn on_a_slow_medium_sealed_hellos_take_a_tenth_of_what_it_carries() {
    let mut world = World::new();
    for end in &mut world.ends {
        end.handle_rate(20_000);
    }

    world.run(3_000);

    assert_eq!(world.states(), [LinkState::Up; 2]);
    assert!(world.sent.iter().all(|(_, to, _)| *to < 10), "nothing goes to all");
}

/// A third computer, at `COPY`, with the key of one of both is there for a while. Returns what it
/// is told.
fn with_a_copy(world: &mut World, of: usize, copy: &mut End, millis: u64) -> Vec<NameHolder> {
    let (peer, mut holders) = (1 - of, Vec::new());
    for _ in 0..millis {
        let before = world.sent.len();
        world.run(1);
        let now = at(world.now);
        if copy.poll_timeout().is_some_and(|due| due <= now) {
            copy.handle_timeout(now);
        }
        for (_, to, frame) in &world.sent[before..] {
            if *to == COPY {
                copy.handle_frame(peer as Address, frame.clone(), now);
            }
        }
        while let Some(output) = copy.poll_output() {
            match output {
                LinkLayerOutput::Transmit { frame, .. } => {
                    world.ends[peer].handle_frame(COPY, frame.into_bytes(), now);
                }
                LinkLayerOutput::Of(_, LinkOutput::Taken(holder)) => holders.push(holder),
                _ => {}
            }
        }
    }
    holders
}

/// Where the third computer is.
const COPY: Address = 7;

#[test]
fn a_second_node_with_a_key_is_told_where_the_first_is_once_that_has_answered() {
    // As initiator of handshakes and as responder, before the first in numbers and behind it.
    for (of, incarnation) in [(0, 2), (1, 2)] {
        let mut world = World::up();

        let holders = with_a_copy(&mut world, of, &mut end(of, incarnation, 500), 3_000);

        assert_eq!(holders[0], NameHolder::new(Incarnation(1), of));
        let in_use = world.outputs.iter().any(|(_, node, output)| {
            let (open, refused) = (Incarnation(1), Incarnation(incarnation));
            let expected = LinkLayerOutput::KeyInUse {
                link: LINK,
                open,
                refused,
                at: of as Address,
                address: COPY,
            };
            (*node, output) == (1 - of, &expected)
        });
        assert!(in_use);
        assert_eq!(world.states(), [LinkState::Up; 2]);
        assert_eq!(world.changes(1 - of), []);
    }
}

#[test]
fn a_node_whose_place_another_has_taken_while_it_was_stopped_is_the_one_that_is_told() {
    for of in 0..2 {
        let mut world = World::up();
        world.from[of] = 12;
        let mut first = std::mem::replace(&mut world.ends[of], end(of, 2, world.now));
        world.run(1_000);
        assert_eq!(world.states(), [LinkState::Up; 2]);
        world.outputs.clear();

        let holders = with_a_copy(&mut world, of, &mut first, 3_000);

        // It is at the end of the connection, and not where the link leads.
        assert_eq!(holders[0], NameHolder::new(Incarnation(2), 12));
        assert_eq!(world.states(), [LinkState::Up; 2]);
        assert_eq!(world.changes(1 - of), []);
    }
}

#[test]
fn a_node_that_is_received_and_does_not_receive_keeps_no_name_from_the_one_that_answers() {
    for of in 0..2 {
        let mut world = World::up();
        let mut copy = end(of, 2, world.now);
        world.stopped = Some(of);
        let holders = with_a_copy(&mut world, of, &mut copy, 1_000);
        assert_eq!(holders, []);
        let open = world.ends[1 - of].channel(LINK).expect("the copy has proved itself");
        assert_eq!(open.incarnation, Incarnation(2));

        world.stopped = None;
        let holders = with_a_copy(&mut world, of, &mut copy, 3_000);

        assert_eq!(world.states(), [LinkState::Up; 2]);
        let known = world.ends[1 - of].get(LINK).unwrap().neighbour().unwrap();
        assert_eq!(known.incarnation, Incarnation(1));
        assert_eq!(holders[0], NameHolder::new(Incarnation(1), of));
    }
}

#[test]
fn a_node_that_was_restarted_at_once_is_not_told_of_the_one_before_it() {
    for of in [0, 1] {
        let mut world = World::up();
        // It has ended, and its last frames are on their way.
        world.ends[of] = LinkLayer::new(None);

        let holders = with_a_copy(&mut world, of, &mut end(of, 2, 500), 3_000);

        assert_eq!(holders, []);
        let link = world.ends[1 - of].get(LINK).unwrap();
        assert_eq!(link.neighbour().unwrap().incarnation, Incarnation(2));
    }
}

#[test]
fn without_keys_a_frame_belongs_to_the_link_of_its_address() {
    let mut end: End = LinkLayer::new(None);
    end.insert(LINK, link(0, 1, 0), 1, None, at(0)).unwrap();

    end.handle_frame(1, hello(1, 4, 0), at(10));
    end.handle_frame(5, hello(1, 4, 1), at(60));
    end.handle_frame(5, hello(1, 4, 2), at(110));

    assert_eq!(end.get(LINK).unwrap().neighbour().unwrap().incarnation, Incarnation(4));
    assert_eq!(end.strangers().unexpected, 2);
    let strangers =
        std::iter::from_fn(|| end.poll_output()).filter(|o| *o == LinkLayerOutput::Stranger(5));
    assert_eq!(strangers.count(), 1);
    assert!(!end.is_sealed() && end.seal_refusals().is_none());
}

#[test]
fn what_a_link_carries_is_counted_with_its_seal_and_what_it_cannot_carry_as_dropped() {
    let mut world = World::new();
    world.packet(0, "too early");
    assert_eq!(
        world.ends[0].traffic(LINK),
        LinkTraffic { frames_dropped: 1, ..Default::default() }
    );
    assert_eq!(world.ends[0].refused_of(LINK).total(), 0, "the neighbour has sent nothing");

    let mut world = World::up();
    // Past the hello that is on its way, and before the next.
    world.run(10);
    let (before, sent) = (world.ends.each_ref().map(|end| end.traffic(LINK)), world.sent.len());
    world.packet(0, "0123456789");
    let frame = world.sent[sent].2.len() as u64;
    world.run(1);

    let after = world.ends.each_ref().map(|end| end.traffic(LINK));
    assert_eq!(after[0].frames_sent - before[0].frames_sent, 1);
    assert_eq!(after[0].bytes_sent - before[0].bytes_sent, frame);
    assert!(frame >= 10 + world.ends[0].overhead() as u64, "{frame} bytes");
    assert_eq!(after[1].frames_received - before[1].frames_received, 1);
    assert_eq!(after[1].bytes_received - before[1].bytes_received, frame);
}

#[test]
fn a_probe_is_as_large_as_the_medium_allows_with_its_seal() {
    let mut world = World::new();
    for end in &mut world.ends {
        end.handle_mtu(1_472, true);
    }

    world.run(50);
    let overhead = world.ends[0].overhead();
    assert_eq!(world.ends[0].get(LINK).unwrap().frame_limit(), 1_200 - overhead);
    world.run(450);

    assert_eq!(world.ends[0].get(LINK).unwrap().frame_limit(), 1_472 - overhead);
    assert_eq!(world.sent.iter().map(|(.., frame)| frame.len()).max(), Some(1_472));
}
