//! An incarnation that fails to start runs its last hooks, and only then does the next one begin.

use crate::scenarios::puppet::{Pull, Strings, incarnation};
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::time::{Duration, Instant};

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

#[blastema_testkit::test]
async fn a_last_hook_of_one_that_fails_to_start_and_does_not_return_is_cut_off() {
    for (hook, last) in [("on_initialize", "on_finalize"), ("on_activated", "on_error")] {
        let strings = Strings::default();
        strings.pull("camera", hook, Pull::Fail("no answer"));
        strings.pull("camera", last, Pull::Wait(DAY));
        let camera = strings.spec("camera").shutdown_within(Duration::from_secs(2));

        let node = TestNode::start(Node::builder("module1").child(camera)).await;

        assert_eq!(incarnation(&node, "camera").await, 2, "{hook}");
        let diary = strings.lines("camera#1");
        assert_eq!(diary.last(), Some(&format!("camera#1 {last}")), "{hook}: {diary:?}");
    }
}

/// Keeps its thread for so long.
fn burn(millis: u64) {
    let began = Instant::now();
    while began.elapsed() < Duration::from_millis(millis) {
        std::hint::spin_loop();
    }
}

/// An arm on a port that only one incarnation can hold; each of its hooks works for a while.
struct Arm {
    port: Arc<AtomicBool>,
    met: Arc<AtomicBool>,
    failures: u64,
}

impl Component for Arm {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(3);
        if self.port.swap(true, SeqCst) {
            self.met.store(true, SeqCst);
        }
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        burn(3);
        match cx.incarnation().0 <= self.failures {
            true => Err("the arm does not answer".into()),
            false => Ok(()),
        }
    }

    async fn on_aborting(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(3);
        tokio::task::yield_now().await;
        Ok(())
    }

    async fn on_error(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        tokio::time::sleep(Duration::from_millis(20)).await;
        Ok(())
    }

    async fn on_finalize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(3);
        tokio::time::sleep(Duration::from_millis(20)).await;
        self.port.store(false, SeqCst);
        Ok(())
    }
}

/// Keeps its thread for most of the time.
struct Filter;
impl Component for Filter {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(15);
        Ok(())
    }
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn no_incarnation_meets_the_one_before_it_on_its_device() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let met = Arc::<AtomicBool>::default();
            let arms = ["left", "middle", "right"];
            let ports = arms.map(|_| Arc::<AtomicBool>::default());
            let mut builder = Node::builder("module1").work_threads(2);
            for name in ["one", "two"] {
                builder = builder.child(ChildSpec::new(name, || Filter).rate_hz(40.0));
            }
            for (name, port) in arms.into_iter().zip(ports) {
                let met = met.clone();
                let arm = move || Arm { port: port.clone(), met: met.clone(), failures: 2 };
                builder = builder.child(ChildSpec::new(name, arm));
            }

            let node = builder.start().await.expect("the node starts");

            let tree = node.tree().await.expect("the tree answers");
            let arms: Vec<_> = tree.children.iter().skip(2).map(|arm| arm.incarnation.0).collect();
            assert_eq!(arms, [3, 3, 3]);
            assert!(!met.load(SeqCst), "the port was still held by the incarnation before");
            node.shutdown().await;
        });
    }
}
