//! Robots whose nodes are at two sites, over two routers of Zenoh that are processes of their own.

use blastema::prelude::*;
use blastema::{Link, LinkState, Network};
use blastema_tests::{Process, RobotKeys, free_addresses, role};
use blastema_zenoh::ZenohNetwork;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(120);

/// Counts: the answer is how often it was asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "sites/count", reply = u32)]
struct Count;

struct Counter(u32);

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Count>();
    }
}

impl Handle<Count> for Counter {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u32 {
        self.0 += 1;
        self.0
    }
}

#[test]
fn a_process_plays_its_role() {
    if role().is_some() {
        crate::router::run();
    }
}

/// A node of a robot with the seed `robot`, at the router of its site.
async fn node(keys: &RobotKeys, robot: &str, own: &str, other: &str, router: &str) -> Node {
    let zenoh = ZenohNetwork::new(&format!("fleet/{robot}"), own).connect(&format!("tcp/{router}"));
    let link = Link::to(other, other).hello_every(Duration::from_millis(50));
    let counter = ChildSpec::new("counter", || Counter(0));
    let builder = Node::builder(own).keys(keys.of(own)).child(counter);
    let builder = builder.network(Network::own("sites", zenoh).link(link));
    builder.start().await.expect("it starts")
}

async fn ask(node: &Node, of: &str) -> Option<u32> {
    let counter = node.sender::<Count>(&format!("{of}:counter")).expect("a name");
    counter.ask_within(Count, Duration::from_secs(5)).await.ok()
}

async fn until(mut holds: impl AsyncFnMut() -> bool, what: &str) {
    let held = async {
        while !holds().await {
            sleep(Duration::from_millis(5)).await;
        }
    };
    assert!(tokio::time::timeout(PATIENCE, held).await.is_ok(), "{what}");
}

#[test]
fn nodes_at_two_sites_are_one_robot_and_robots_that_share_routers_do_not_meet() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at: Vec<String> = free_addresses(2).iter().map(ToString::to_string).collect();
        let other_way: Vec<String> = at.iter().rev().cloned().collect();
        let mut here = Process::start_with(module_path!(), "router", &at, &[]);
        let _there = Process::start_with(module_path!(), "router", &other_way, &[]);
        let folders = [1, 2].map(|_| tempfile::tempdir().expect("a folder"));
        let mut robots = Vec::new();
        for (seed, (folder, robot)) in (1..).zip(folders.iter().zip(["ranger", "rover"])) {
            // The routers may start later than the nodes.
            let keys = RobotKeys::new(folder.path(), &["base", "arm"], seed);
            let base = node(&keys, robot, "base", "arm", &at[0]).await;
            let arm = node(&keys, robot, "arm", "base", &at[1]).await;
            robots.push((base, arm));
        }
        for (base, arm) in &robots {
            assert!(base.connected("arm", PATIENCE).await, "{:?}", base.links().await);
            assert!(arm.connected("base", PATIENCE).await, "{:?}", arm.links().await);
        }
        for number in 1..=20 {
            for (base, arm) in &robots {
                assert_eq!(ask(base, "arm").await, Some(number));
                assert_eq!(ask(arm, "base").await, Some(number));
            }
        }

        // The router of one site is killed and comes back; each request is served once at most.
        let mut served = [20; 2];
        for _ in 0..3 {
            here.kill();
            // A router that is back before the other one has counted it out stays deaf to it: see the README.
            for node in robots.iter().flat_map(|(base, arm)| [base, arm]) {
                let is_down =
                    async || node.links().await.iter().all(|row| row.state == LinkState::Down);
                until(is_down, "the link is down while the router is").await;
            }
            here = Process::start_with(module_path!(), "router", &at, &[]);
            for ((base, _), served) in robots.iter().zip(&mut served) {
                let mut answer = None;
                let is_served = async || {
                    answer = ask(base, "arm").await;
                    answer.is_some()
                };
                until(is_served, "the sites meet again").await;
                let number = answer.expect("it came");
                assert!(number > *served, "{number} after {served}");
                *served = number + 1;
                assert_eq!(ask(base, "arm").await, Some(*served));
            }
        }
        for (base, arm) in robots {
            // No frame of another robot was refused, for none came.
            for row in base.links().await {
                assert_eq!((row.refusals.foreign, row.refusals.forged), (0, 0), "{row:?}");
            }
            base.shutdown().await;
            arm.shutdown().await;
        }
    });
}

#[test]
fn without_a_router_a_node_says_so_and_goes_on_when_there_is_one() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at: Vec<String> = free_addresses(1).iter().map(ToString::to_string).collect();
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &["base", "arm"], 1);
        let base = node(&keys, "ranger", "base", "arm", &at[0]).await;
        let is_told = async || {
            let entries = base.faults().await.entries;
            entries.iter().any(|entry| entry.fault.detail.contains("is the router running"))
        };
        until(is_told, "a fault says that no router answers").await;

        let _router = Process::start_with(module_path!(), "router", &at, &[]);
        let arm = node(&keys, "ranger", "arm", "base", &at[0]).await;
        assert!(base.connected("arm", PATIENCE).await, "{:?}", base.links().await);
        assert_eq!(ask(&base, "arm").await, Some(1));
        for node in [base, arm] {
            node.shutdown().await;
        }
    });
}
