//! Death watch of supervisors, of the middleware's own objects, and of objects of other nodes.

use crate::scenarios::puppet::{Deed, Do, Pull, Strings, ask, strike};
use blastema::MemoryMedium;
use blastema::prelude::*;
use blastema_testkit::TestNode;
use blastema_tests::{on_ethernet, plug_cable, pull_cable};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

/// Two nodes with a puppet each, `watcher` on module1 and `laser` on module2.
struct Robot {
    medium: MemoryMedium,
    module1: TestNode,
    module2: TestNode,
    strings: Strings,
}

impl Robot {
    async fn start() -> Self {
        let (medium, strings) = (MemoryMedium::default(), Strings::default());
        let module1 = Self::node(&medium, "module1", "module2", "watcher", &strings).await;
        let module2 = Self::node(&medium, "module2", "module1", "laser", &strings).await;
        module1.advance(2 * SECOND).await;
        Robot { medium, module1, module2, strings }
    }

    async fn node(
        medium: &MemoryMedium,
        own: &str,
        peer: &str,
        puppet: &'static str,
        strings: &Strings,
    ) -> TestNode {
        let builder = on_ethernet(own, peer, medium).intensity(100, SECOND);
        TestNode::start(builder.child(strings.spec(puppet))).await
    }

    async fn watch(&self, name: &str) {
        ask(&self.module1, "watcher", Deed::Watch(name.into())).await.unwrap();
    }

    async fn watched(&self) -> Vec<String> {
        self.module1.advance(SECOND).await;
        self.strings.lines("watched")
    }
}

#[blastema_testkit::test]
async fn who_watches_a_supervisor_is_told_when_it_gives_up_and_when_it_is_stopped() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForOne)
        .intensity(0, SECOND)
        .when_exceeded(WhenExceeded::Escalate)
        .child(strings.spec("arm"));
    let builder = Node::builder("module1").child(strings.spec("watcher")).supervisor(group);
    let node = TestNode::start(builder).await;
    let watched = async || {
        node.advance(2 * SECOND).await;
        strings.lines("watched")
    };
    ask(&node, "watcher", Deed::Watch("group".into())).await.unwrap();
    ask(&node, "watcher", Deed::Watch("chain/supervisor/group".into())).await.unwrap();
    assert_eq!(watched().await, [""; 0], "it is at work");

    strike(&node, "arm").await;
    assert_eq!(watched().await, ["watcher#1 watched group#1: Fatal"]);
    node.remove_child("group").await.unwrap();

    let both = ["group#2", "chain/supervisor/group#1"]
        .map(|of| format!("watcher#1 watched {of}: Stopped"));
    assert_eq!(watched().await, both, "its actor ends with it");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_the_middleware_is_told_of_its_panic() {
    let robot = Robot::start().await;
    robot.watch("net/stack").await;
    assert_eq!(robot.watched().await, [""; 0]);

    robot.module1.panic_router();

    let watched = robot.watched().await;
    let [only] = &watched[..] else { panic!("{watched:?}") };
    assert!(only.starts_with("watcher#1 watched net/stack#1: Panicked"), "{only}");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_another_node_is_told_of_every_end_once() {
    let robot = Robot::start().await;
    robot.watch("module2:laser").await;
    robot.watch("module2:laser").await;
    assert_eq!(robot.watched().await, [""; 0], "it lives");

    strike(&robot.module2, "laser").await;
    let first = robot.watched().await;
    robot.module1.advance(65 * SECOND).await;
    ask(&robot.module2, "laser", Deed::Stop).await.unwrap();
    let second = robot.watched().await;
    robot.watch("module2:absent").await;
    let unknown = robot.watched().await;
    strike(&robot.module1, "watcher").await;
    strike(&robot.module2, "laser").await;

    let [first] = &first[..] else { panic!("{first:?}") };
    let expected = "watcher#1 watched module2:laser#1: Panicked { text: \"struck\"";
    assert!(first.starts_with(expected), "{first}");
    assert_eq!(second, ["watcher#1 watched module2:laser#2: Returned"]);
    assert_eq!(unknown, ["watcher#1 watched module2:absent#0: Unknown"]);
    assert_eq!(robot.watched().await, [""; 0], "the incarnation that asked is over");
}

#[blastema_testkit::test]
async fn who_watches_an_object_of_a_node_that_cannot_be_reached_is_told_each_time_and_watches_on() {
    let robot = Robot::start().await;
    robot.watch("module2:laser").await;
    robot.watch("module9:laser").await;
    let nowhere = robot.watched().await;
    assert_eq!(nowhere.len(), 1, "{nowhere:?}");
    assert!(nowhere[0].starts_with("watcher#1 watched module9:laser#0: NodeLost"), "{nowhere:?}");

    for _ in 0..3 {
        pull_cable(&robot.module1);
        robot.module1.advance(20 * SECOND).await;
        let lost = robot.watched().await;
        plug_cable(&robot.module1);
        robot.module1.advance(10 * SECOND).await;
        let back = robot.watched().await;
        assert_eq!(lost.len(), 1, "{lost:?}");
        assert!(lost[0].starts_with("watcher#1 watched module2:laser#0: NodeLost"), "{lost:?}");
        assert_eq!(back, [""; 0]);
    }
    strike(&robot.module2, "laser").await;
    let died = robot.watched().await;

    assert_eq!(died.len(), 1, "{died:?}");
    assert!(died[0].starts_with("watcher#1 watched module2:laser#1: Panicked"), "{died:?}");
}

/// When the laser ends while the watcher's node cannot be told, and then.
#[derive(Clone, Copy, Debug)]
enum Ends {
    /// So often in the outage.
    Within(u64),
    /// When the cable is whole again, and no session is open.
    BeforeTheSession,
    /// When the watcher's node is connected.
    OnceConnected,
    /// When the other node is connected.
    OnceConnectedThere,
}

#[blastema_testkit::test]
async fn an_end_in_an_outage_or_right_after_it_is_told_and_its_incarnation_counts_all() {
    for outage in [SECOND / 2, 3 * SECOND, 10 * SECOND] {
        for (since, ends) in [true, false].into_iter().flat_map(|since| {
            let once = [Ends::BeforeTheSession, Ends::OnceConnected, Ends::OnceConnectedThere];
            [Ends::Within(1), Ends::Within(20)].into_iter().chain(once).map(move |e| (since, e))
        }) {
            let robot = Robot::start().await;
            if since {
                robot.watch("module2:laser").await;
                assert_eq!(robot.watched().await, [""; 0], "it lives");
            }
            pull_cable(&robot.module1);
            robot.module1.advance(outage).await;
            if !since {
                robot.watch("module2:laser").await;
                robot.module1.settle().await;
            }
            let stop = async || ask(&robot.module2, "laser", Deed::Stop).await.unwrap();
            let mut last = 0;
            if let Ends::Within(times) = ends {
                for _ in 0..times {
                    last = stop().await;
                    robot.module1.advance(SECOND / 50).await;
                }
            }
            plug_cable(&robot.module1);
            match ends {
                Ends::Within(_) => {}
                Ends::BeforeTheSession => last = stop().await,
                Ends::OnceConnected => {
                    assert!(robot.module1.connected("module2", 20 * SECOND).await);
                    last = stop().await;
                }
                Ends::OnceConnectedThere => {
                    assert!(robot.module2.connected("module1", 20 * SECOND).await);
                    last = stop().await;
                }
            }
            robot.module1.advance(10 * SECOND).await;

            let told = robot.strings.lines("watched");
            let case = format!("{outage:?}, watched before: {since}, {ends:?}: {told:?}");
            // A watch that begins in the outage holds from the next session on, if there is
            // another.
            let once = matches!(ends, Ends::OnceConnected | Ends::OnceConnectedThere);
            if since || once || outage < SECOND {
                let expected = format!("watcher#1 watched module2:laser#{last}: Returned");
                assert_eq!(told.iter().filter(|line| **line == expected).count(), 1, "{case}");
                assert_eq!(told.last(), Some(&expected), "{case}");
            }
            assert!(told.iter().filter(|line| line.contains("NodeLost")).count() <= 1, "{case}");
        }
    }
}

#[blastema_testkit::test]
async fn an_end_right_after_the_start_of_the_next_process_of_its_node_is_told() {
    for watched in [true, false] {
        let mut robot = Robot::start().await;
        if watched {
            robot.watch("module2:laser").await;
            assert_eq!(robot.watched().await, [""; 0]);
        }
        robot.module2.shutdown().await;
        robot.module1.advance(5 * SECOND).await;
        if !watched {
            robot.watch("module2:laser").await;
        }
        robot.watched().await;
        let medium = &robot.medium;
        robot.module2 = Robot::node(medium, "module2", "module1", "laser", &robot.strings).await;
        assert!(robot.module1.connected("module2", 20 * SECOND).await);

        ask(&robot.module2, "laser", Deed::Stop).await.unwrap();

        assert_eq!(robot.watched().await, ["watcher#1 watched module2:laser#1: Returned"]);
    }
}

#[blastema_testkit::test]
async fn a_supervisor_that_starts_later_is_not_alive_yet_and_its_end_is_told() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForOne)
        .intensity(0, SECOND)
        .when_exceeded(WhenExceeded::Escalate)
        .child(strings.spec("arm"));
    strings.pull("watcher", "on_activated", Pull::Watch("group"));
    let builder = Node::builder("module1").child(strings.spec("watcher")).supervisor(group);
    let node = TestNode::start(builder).await;
    node.advance(SECOND).await;

    strike(&node, "arm").await;
    node.advance(SECOND).await;

    let told = ["group#0: NotAlive", "group#1: Fatal"];
    assert_eq!(strings.lines("watched"), told.map(|told| format!("watcher#1 watched {told}")));
}

#[blastema_testkit::test]
async fn a_sender_of_another_node_reaches_the_component_that_has_the_name() {
    let robot = Robot::start().await;
    robot.module2.add(None, robot.strings.spec("later")).await.unwrap();
    robot.module1.advance(SECOND).await;
    let later = robot.module1.sender::<Do>("module2:later").unwrap();
    assert_eq!(later.ask(Do(Deed::Nothing)).await.unwrap(), 1);

    for _ in 0..2 {
        robot.module2.remove_child("later").await.unwrap();
        let gone = later.ask(Do(Deed::Nothing)).await.unwrap_err();
        assert_eq!(gone.kind, DeliveryError::Stopped);
        robot.module2.add(None, robot.strings.spec("later")).await.unwrap();
        assert_eq!(later.ask(Do(Deed::Nothing)).await.unwrap(), 1);
    }
}

#[blastema_testkit::test]
async fn a_name_of_another_node_is_watched_before_an_object_has_it_and_after() {
    let robot = Robot::start().await;
    robot.watch("module2:later").await;
    assert_eq!(robot.watched().await, ["watcher#1 watched module2:later#0: Unknown"]);
    robot.module1.advance(10 * SECOND).await;
    assert_eq!(robot.watched().await, [""; 0], "it is said once");

    for _ in 0..2 {
        robot.module2.add(None, robot.strings.spec("later")).await.unwrap();
        robot.module1.advance(3 * SECOND).await;
        strike(&robot.module2, "later").await;
        let told = robot.watched().await;
        let expected = "watcher#1 watched module2:later#1: Panicked";
        assert!(told.len() == 1 && told[0].starts_with(expected), "{told:?}");
        robot.module2.remove_child("later").await.unwrap();
        robot.module1.advance(3 * SECOND).await;
        assert_eq!(robot.watched().await, ["watcher#1 watched module2:later#2: Stopped"]);
    }
}
