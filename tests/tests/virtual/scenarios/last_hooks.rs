//! An incarnation that fails to start runs its last hooks, and only then does the next one begin.

use crate::scenarios::puppet::{Pull, Strings, incarnation};
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

/// Those of an incarnation that fails while it is activated.
const LAST_HOOKS: [&str; 4] = ["on_aborting", "on_error", "on_shutdown", "on_finalize"];
const DAY: Duration = Duration::from_secs(86_400);

#[blastema_testkit::test]
async fn the_last_hooks_of_one_that_fails_to_start_run_before_the_next_one_begins() {
    let failing = [
        ("on_initialize", Pull::Fail("no answer"), &LAST_HOOKS[3..]),
        ("on_initialize", Pull::Wait(DAY), &LAST_HOOKS[3..]),
        ("on_startup", Pull::Fail("no answer"), &LAST_HOOKS[..]),
        ("on_activated", Pull::Fail("no answer"), &LAST_HOOKS[..]),
        ("on_activated", Pull::Fatal("no answer"), &LAST_HOOKS[3..]),
        ("on_activated", Pull::Wait(DAY), &LAST_HOOKS[3..]),
    ];
    for (hook, pull, expected) in failing {
        for strategy in [Strategy::OneForOne, Strategy::OneForAll] {
            let strings = Strings::default();
            strings.pull("camera", hook, pull.clone());
            // Together they take less than a stop may.
            let wait = Duration::from_secs(1);
            LAST_HOOKS.iter().for_each(|last| strings.pull("camera", last, Pull::Wait(wait)));
            let eyes = SupervisorSpec::new("eyes", strategy).child(strings.spec("camera"));

            let node = TestNode::start(Node::builder("module1").supervisor(eyes)).await;

            let diary = strings.lines("camera");
            let second = diary.iter().position(|line| line == "camera#2 on_initialize");
            let second = second.expect("there is a second incarnation");
            let last: Vec<_> = expected.iter().map(|last| format!("camera#1 {last}")).collect();
            assert!(diary[..second].ends_with(&last), "{hook} {pull:?} {strategy:?}: {diary:?}");
            assert_eq!(incarnation(&node, "camera").await, 2, "{hook} {pull:?} {strategy:?}");
            let tree = node.tree().await.unwrap();
            let camera = &tree.children[0].below.as_ref().expect("a supervisor").children[0];
            assert_eq!(camera.restarts, 1, "{hook} {pull:?} {strategy:?}");
        }
    }
}
