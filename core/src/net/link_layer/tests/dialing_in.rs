//! A node that comes to another one which has no link to it.

use super::*;

const LATER: LinkId = LinkId(8);

/// The left end has a link to the right one, which has none, and lets it dial in or not.
fn world(dials_in: bool) -> World {
    let mut world = World::new();
    world.ends[1].remove(LINK);
    let nodes = dials_in.then(|| key(0));
    world.ends[1].set_dial_in(nodes).expect("it is a key");
    world
}

fn dialed_in(world: &mut World) -> Vec<(NodeId, Address)> {
    let outputs = std::mem::take(&mut world.outputs).into_iter();
    let of = |(_, node, output)| match (node, output) {
        (1, LinkLayerOutput::DialedIn { peer, address }) => Some((peer, address)),
        _ => None,
    };
    let mut all: Vec<_> = outputs.filter_map(of).collect();
    // It is repeated with each frame.
    all.dedup();
    all
}

fn make_link(world: &mut World, number: LinkId, address: Address) -> bool {
    let (now, peer) = (world.now, NodeId::of(&name(0)));
    let made = world.ends[1].insert_dialed_in(number, link(1, 1, now), peer, address, at(now));
    world.poll(1);
    made
}

fn state(world: &World, number: LinkId) -> Option<LinkState> {
    world.ends[1].get(number).map(Link::state)
}

#[test]
fn a_node_that_may_dial_in_has_a_link_to_wherever_it_comes_from() {
    let mut world = world(true);
    world.from[0] = 5;
    world.run(200);
    assert_eq!(dialed_in(&mut world), [(NodeId::of(&name(0)), 5)]);

    assert!(make_link(&mut world, LATER, 5));
    assert!(!make_link(&mut world, LATER, 5), "there is one");
    world.run(500);

    assert_eq!(state(&world, LATER), Some(LinkState::Up));
    assert_eq!(world.ends[0].get(LINK).map(Link::state), Some(LinkState::Up));
    let mut to = world.sent.iter().filter(|(node, ..)| *node == 1).map(|(_, to, _)| *to);
    assert!(to.all(|to| to == 5 || to == 0));
    assert_eq!(world.sent.iter().rfind(|(node, ..)| *node == 1).map(|(_, to, _)| *to), Some(5));
}

#[test]
fn no_other_node_dials_in() {
    let mut world = world(false);
    world.run(500);

    assert_eq!(dialed_in(&mut world), []);
    assert!(!make_link(&mut world, LATER, 0), "it has not proved itself");
    let refusals = world.ends[1].seal_refusals().expect("it is sealed");
    assert!(refusals.unknown > 0, "{refusals:?}");
}

#[test]
fn a_node_dials_in_again_after_its_link_was_taken_out_and_from_another_place_meanwhile() {
    let mut world = world(true);
    world.run(200);
    dialed_in(&mut world);
    assert!(make_link(&mut world, LATER, 0));
    world.run(500);

    // It is started again elsewhere, while the link still stands.
    let now = world.now;
    world.ends[0] = end(0, 2, now);
    world.from[0] = 6;
    world.run(1_500);
    assert_eq!(dialed_in(&mut world), [], "there is a link");
    assert_eq!(world.sent.iter().rfind(|(node, ..)| *node == 1).map(|(_, to, _)| *to), Some(6));
    assert_eq!(state(&world, LATER), Some(LinkState::Up));

    world.ends[1].remove(LATER);
    world.run(100);
    assert_eq!(dialed_in(&mut world), [(NodeId::of(&name(0)), 6)], "without another handshake");
    assert!(make_link(&mut world, LATER, 6));
    world.run(1_500);
    assert_eq!(state(&world, LATER), Some(LinkState::Up));
}

#[test]
fn a_node_that_may_dial_in_no_more_is_not_opened() {
    let mut world = world(true);
    world.ends[1].set_dial_in([]).expect("there is none");
    world.run(500);
    assert_eq!(dialed_in(&mut world), []);
}

#[test]
fn a_node_that_may_dial_in_is_not_asked_any_more_where_its_link_was_taken_out() {
    for node in 0..2 {
        let mut end = end(node, 1, 0);
        end.set_dial_in([key(1 - node)]).expect("it is a key");
        end.remove(LINK);
        while end.poll_output().is_some() {}

        for now in 0..2_000 {
            end.handle_timeout(at(now));
            assert_eq!(end.poll_output(), None);
        }
    }
}
