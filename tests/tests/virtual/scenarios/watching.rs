//! Death watch of supervisors, of the middleware's own objects, and of objects of other nodes.

use crate::scenarios::puppet::{Deed, Strings, ask, strike};
use blastema::prelude::*;
use blastema::{Direction, MemoryMedium, Network};
use blastema_testkit::TestNode;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

/// Two nodes with a puppet each, `widow` on module1 and `laser` on module2.
struct Robot {
    medium: MemoryMedium,
    module1: TestNode,
    module2: TestNode,
    strings: Strings,
}

impl Robot {
    async fn start() -> Self {
        let (medium, strings) = (MemoryMedium::default(), Strings::default());
        let module1 = Self::node(&medium, ["module1", "module2"], "widow", &strings).await;
        let module2 = Self::node(&medium, ["module2", "module1"], "laser", &strings).await;
        module1.advance(2 * SECOND).await;
        Robot { medium, module1, module2, strings }
    }

    async fn node(
        medium: &MemoryMedium,
        [own, peer]: [&str; 2],
        puppet: &'static str,
        strings: &Strings,
    ) -> TestNode {
        let network = Network::memory("ethernet", medium, own).with_faults(7).peer(peer, peer);
        TestNode::start(Node::builder(own).network(network).child(strings.spec(puppet))).await
    }

    async fn watch(&self, name: &str) {
        ask(&self.module1, "widow", Deed::Watch(name.into())).await.unwrap();
    }

    async fn mourned(&self) -> Vec<String> {
        self.module1.advance(SECOND).await;
        self.strings.lines("mourns")
    }

    fn cut(&self) {
        let cable = self.module1.cable("ethernet").expect("it was described with faults");
        cable.cut(Direction::Both, false);
    }

    fn clear(&self) {
        self.module1.cable("ethernet").expect("it was described with faults").restore();
    }
}

#[blastema_testkit::test]
async fn who_watches_a_supervisor_is_told_when_it_gives_up_and_when_it_is_stopped() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForOne)
        .intensity(0, SECOND)
        .when_exceeded(WhenExceeded::Escalate)
        .child(strings.spec("arm"));
    let builder = Node::builder("module1").child(strings.spec("widow")).supervisor(group);
    let node = TestNode::start(builder).await;
    let mourned = async || {
        node.advance(2 * SECOND).await;
        strings.lines("mourns")
    };
    ask(&node, "widow", Deed::Watch("group".into())).await.unwrap();
    ask(&node, "widow", Deed::Watch("chain/supervisor/group".into())).await.unwrap();
    assert_eq!(mourned().await, [""; 0], "it is at work");

    strike(&node, "arm").await;
    assert_eq!(mourned().await, ["widow#1 mourns group#1: Fatal"]);
    node.remove_child("group").await.unwrap();

    let both =
        ["group#2", "chain/supervisor/group#1"].map(|of| format!("widow#1 mourns {of}: Stopped"));
    assert_eq!(mourned().await, both, "its actor ends with it");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_the_middleware_is_told_of_its_panic() {
    let robot = Robot::start().await;
    robot.watch("net/router").await;
    assert_eq!(robot.mourned().await, [""; 0]);

    robot.module1.panic_router();

    let mourned = robot.mourned().await;
    let [only] = &mourned[..] else { panic!("{mourned:?}") };
    assert!(only.starts_with("widow#1 mourns net/router#1: Panicked"), "{only}");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_another_node_is_told_of_every_end_once() {
    let robot = Robot::start().await;
    robot.watch("module2:laser").await;
    robot.watch("module2:laser").await;
    assert_eq!(robot.mourned().await, [""; 0], "it lives");

    strike(&robot.module2, "laser").await;
    let first = robot.mourned().await;
    robot.module1.advance(65 * SECOND).await;
    ask(&robot.module2, "laser", Deed::Stop).await.unwrap();
    let second = robot.mourned().await;
    robot.watch("module2:absent").await;
    let unknown = robot.mourned().await;
    strike(&robot.module1, "widow").await;
    strike(&robot.module2, "laser").await;

    let [first] = &first[..] else { panic!("{first:?}") };
    let expected = "widow#1 mourns module2:laser#1: Panicked { text: \"struck\"";
    assert!(first.starts_with(expected), "{first}");
    assert_eq!(second, ["widow#1 mourns module2:laser#2: Returned"]);
    assert_eq!(unknown, ["widow#1 mourns module2:absent#0: Unknown"]);
    assert_eq!(robot.mourned().await, [""; 0], "the incarnation that asked is over");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_a_node_that_cannot_be_reached_is_told_once_and_watches_on() {
    let robot = Robot::start().await;
    robot.watch("module2:laser").await;
    robot.watch("module9:laser").await;
    let nowhere = robot.mourned().await;
    assert_eq!(nowhere.len(), 1, "{nowhere:?}");
    assert!(nowhere[0].starts_with("widow#1 mourns module9:laser#0: NodeLost"), "{nowhere:?}");

    robot.cut();
    robot.module1.advance(20 * SECOND).await;
    let lost = robot.mourned().await;
    robot.clear();
    robot.module1.advance(10 * SECOND).await;
    let back = robot.mourned().await;
    strike(&robot.module2, "laser").await;
    let died = robot.mourned().await;

    assert_eq!(lost.len(), 1, "{lost:?}");
    assert!(lost[0].starts_with("widow#1 mourns module2:laser#0: NodeLost"), "{lost:?}");
    assert_eq!(back, [""; 0]);
    assert_eq!(died.len(), 1, "{died:?}");
    assert!(died[0].starts_with("widow#1 mourns module2:laser#1: Panicked"), "{died:?}");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_a_node_that_leaves_is_told_so_and_of_its_next_process_too() {
    let mut robot = Robot::start().await;
    robot.watch("module2:laser").await;
    assert_eq!(robot.mourned().await, [""; 0]);

    robot.module2.shutdown().await;
    let left = robot.mourned().await;
    let pair = ["module2", "module1"];
    robot.module2 = Robot::node(&robot.medium, pair, "laser", &robot.strings).await;
    robot.module1.advance(10 * SECOND).await;
    strike(&robot.module2, "laser").await;
    let died = robot.mourned().await;

    let of_node: Vec<_> = left.iter().filter(|line| line.contains("NodeLost")).collect();
    assert_eq!(of_node.len(), 1, "{left:?}");
    assert!(of_node[0].contains("module2"), "{left:?}");
    assert!(left.len() <= 2, "its own end perhaps, and its node's: {left:?}");
    assert_eq!(died.len(), 1, "{died:?}");
    assert!(died[0].starts_with("widow#1 mourns module2:laser#1: Panicked"), "{died:?}");
}
