//! Networks of a few nodes, in which every failure is tried.

use super::*;
use crate::net::link::Neighbour;
use crate::net::routing::LinkHealth;
use crate::net::routing::topology::Adjacency;
use crate::net::wire::advertisement::{Advertisement, AdvertisementId, Edge as Announced};
use crate::random::Random;
use crate::sorted::SortedSet;
use crate::{Incarnation, Instant, NodeName};

/// Between which nodes, and how dear.
type Cable = (usize, usize, u16);

fn name(index: usize) -> NodeName {
    NodeName::new(&format!("n{index}")).unwrap()
}

fn id(index: usize) -> NodeId {
    NodeId::of(&name(index))
}

/// The ways from node 0 to node 1, as the cost of each, the number of its first cable and the nodes
/// between.
fn ways(nodes: usize, cables: &[Cable]) -> Vec<(u64, usize, Vec<usize>)> {
    let at_end = |node: usize| {
        let far = move |&(a, b, cost): &Cable| match node {
            node if node == a => Some((b, cost)),
            node if node == b => Some((a, cost)),
            _ => None,
        };
        cables.iter().enumerate().filter_map(move |(n, cable)| Some((n, far(cable)?)))
    };
    let links: SortedMap<_, _> = at_end(0)
        .map(|(number, (far, cost))| {
            let neighbour = Neighbour { node: name(far), incarnation: Incarnation(1) };
            let (health, pending, compare_at) = (LinkHealth::Up, SortedMap::new(), Instant::ORIGIN);
            let link = Adjacency {
                neighbour,
                id: id(far),
                cost,
                mtu: 1400,
                health,
                number_there: None,
                pending,
                compare_at,
                differs_since: None,
                keys_differ: false,
                checks: Default::default(),
            };
            (LinkId(number as u16), link)
        })
        .collect();
    let known: Vec<_> = (1..nodes)
        .map(|node| {
            let (origin, incarnation) = (id(node), Incarnation(1));
            let edges = at_end(node).map(|(_, (far, cost))| Announced {
                to: id(far),
                incarnation: 1,
                cost,
                mtu: 1400,
            });
            let edges = edges.collect();
            let advertisement_id = AdvertisementId { origin, sequence: 1 };
            let (node, signature) = (name(node), None);
            Advertisement { id: advertisement_id, incarnation, node, edges, signature }
        })
        .collect();
    let known = known.iter().map(|known| (known.id.origin, known));
    let ways = Topology::new((id(0), 0), &links, known).ways(id(1));
    let index = |relay: &NodeId| (0..nodes).find(|node| id(*node) == *relay).unwrap();
    ways.iter()
        .map(|way| (way.cost, way.link.0.into(), way.relays.iter().map(index).collect()))
        .collect()
}

fn connected(nodes: usize, cables: &[Cable], without: Option<usize>) -> bool {
    let mut reached = SortedSet::from([0]);
    for _ in 0..nodes {
        for &(a, b, _) in cables {
            if Some(a) != without && Some(b) != without {
                if reached.contains(&a) {
                    reached.insert(b);
                }
                if reached.contains(&b) {
                    reached.insert(a);
                }
            }
        }
    }
    reached.contains(&1)
}

#[test]
fn two_ways_are_the_cheapest_pair_and_not_the_cheapest_way_and_what_is_left_of_it() {
    // By the shortest, 0-2-3-1, both others are cut in two.
    let cables = [(0, 2, 1), (2, 3, 1), (3, 1, 1), (0, 3, 4), (2, 1, 4)];

    assert_eq!(ways(4, &cables), [(5, 0, vec![2]), (5, 3, vec![3])]);
}

#[test]
fn every_cable_to_a_neighbour_is_a_way_and_so_is_the_detour() {
    let cables = [(0, 1, 1), (0, 1, 5), (0, 2, 1), (2, 1, 1)];

    assert_eq!(ways(3, &cables), [(1, 0, vec![]), (2, 2, vec![2]), (5, 1, vec![])]);
}

#[test]
fn what_cannot_be_avoided_is_shared_and_nothing_else() {
    // Two triangles that meet in node 2, and a bridge from 5 to 1.
    let triangles = [(0, 2, 1), (0, 3, 1), (3, 2, 1), (2, 5, 1), (2, 4, 1), (4, 5, 1), (5, 1, 1)];
    assert_eq!(ways(6, &triangles), [(3, 0, vec![2, 5]), (5, 1, vec![3, 2, 4, 5])]);

    // Behind the only neighbour.
    let behind = [(0, 2, 1), (2, 3, 1), (2, 4, 1), (3, 1, 1), (4, 1, 1)];
    let ways_behind = ways(5, &behind).into_iter().map(|(_, link, relays)| (link, relays));
    assert_eq!(ways_behind.collect::<SortedSet<_>>(), [(0, vec![2, 3]), (0, vec![2, 4])].into());
}

#[test]
fn one_way_is_one_and_none_is_none() {
    assert_eq!(ways(3, &[(0, 2, 1), (2, 1, 1)]), [(2, 0, vec![2])]);
    // Where both cables of a pair may be used, two copies go by the same nodes.
    assert_eq!(ways(3, &[(0, 2, 1), (0, 2, 1), (2, 1, 1), (2, 1, 1)]).len(), 2);
    assert_eq!(ways(3, &[(0, 2, 1)]), []);
}

#[test]
fn a_way_that_is_too_long_to_be_written_down_is_left_out() {
    let ring =
        |nodes: usize| -> Vec<Cable> { (0..nodes).map(|n| (n, (n + 1) % nodes, 1)).collect() };

    assert_eq!(ways(RELAYS_MAX + 3, &ring(RELAYS_MAX + 3)).len(), 2);
    assert_eq!(ways(RELAYS_MAX + 4, &ring(RELAYS_MAX + 4)).len(), 1);
}

#[test]
fn in_any_network_no_single_failure_stops_both_ways_unless_it_parts_the_network() {
    let mut random = Random::new(11);
    let mut pairs = 0;
    for _ in 0..400 {
        let nodes = 3 + random.below(6) as usize;
        let mut cables = SortedMap::new();
        for _ in 0..nodes + random.below(2 * nodes as u64) as usize {
            let (a, b) = (random.below(nodes as u64) as usize, random.below(nodes as u64) as usize);
            if a != b {
                cables.insert((a.min(b), a.max(b)), 1 + random.below(50) as u16);
            }
        }
        let cables: Vec<Cable> = cables.into_iter().map(|((a, b), cost)| (a, b, cost)).collect();
        let found = ways(nodes, &cables);
        assert_eq!(found.is_empty(), !connected(nodes, &cables, None), "{cables:?}");
        pairs += usize::from(found.len() > 1);
        let paths: Vec<Vec<usize>> =
            found.iter().map(|(_, _, relays)| [&[0], &relays[..], &[1]].concat()).collect();
        for node in 2..nodes {
            let intact = paths.iter().any(|path| !path.contains(&node));
            assert_eq!(intact, connected(nodes, &cables, Some(node)), "{node} of {cables:?}");
        }
        for &(a, b, _) in &cables {
            let uses = |path: &Vec<usize>| path.windows(2).any(|w| w == [a, b] || w == [b, a]);
            let left: Vec<Cable> =
                cables.iter().copied().filter(|c| (c.0, c.1) != (a, b)).collect();
            let intact = !paths.iter().all(uses);
            assert_eq!(intact, connected(nodes, &left, None), "{a} to {b} of {cables:?}");
        }
    }
    assert!(pairs > 150, "{pairs}");
}
