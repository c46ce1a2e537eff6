//! A handler that keeps its thread: on real threads, since only there can it be given up.
//!
//! Nothing here measures time, and no test sleeps: each test waits for what it says.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings, incarnation};
use blastema::core::detection::{FaultEntry, Opinion};
use blastema::prelude::*;
use blastema::{Incarnation, NodeBuilder, RestartError, ThreadKind, ThreadRow, ThreadState};
use blastema_testkit::TestNode;
use blastema_tests::until;
use std::time::Duration;

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(30);

/// An `arm` and a `leg` on one shared thread, and an `ear` on its own.
fn robot(strings: &Strings) -> NodeBuilder {
    Node::builder("module1")
        .work_threads(1)
        .child(strings.spec("arm").max_block(Duration::from_millis(150)))
        .child(strings.spec("leg"))
        .child(strings.spec("ear").on_own_thread())
}

async fn start(builder: NodeBuilder) -> TestNode {
    TestNode::of(builder.start().await.expect("the node starts")).await
}

/// Asks, and waits as long as a busy machine needs.
async fn patiently(node: &Node, name: &str) -> u64 {
    let sender = node.sender::<Do>(name).expect("a puppet of this name");
    sender.ask_within(Do(Deed::Nothing), LONG).await.expect("the puppet answers")
}

#[test]
fn a_hang_is_named_fenced_and_replaced_and_its_neighbours_resume() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let mut node = start(robot(&strings).grace(LONG)).await;
        let arm = node.sender::<Do>("arm").unwrap();
        let (hung, leg) = (arm.clone(), node.sender::<Do>("leg").unwrap());
        let hung = tokio::task::spawn_local(async move {
            hung.ask_within(Do(Deed::Block("ear".into())), LONG).await
        });

        let fault = node.await_fault(FaultKind::Hang, "arm").await;
        let waiting =
            tokio::task::spawn_local(async move { leg.ask_within(Do(Deed::Nothing), LONG).await });
        node.sender("arm").unwrap().tell(Note(1)).unwrap();
        node.await_recovered(FaultKind::Hang, "arm").await;

        assert!(fault.detail.contains("test/do"), "{}", fault.detail);
        let error = hung.await.unwrap().expect_err("it was given up, though it still blocks");
        assert_eq!(error.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
        assert_eq!(patiently(&node, "arm").await, 2, "on another thread");
        until(async || strings.lines("note") == ["arm#2 note 1"], "its queue came along").await;
        let leg = node.row("leg").await;
        assert_eq!((leg.opinion, leg.incarnation), (Opinion::Suspect, Incarnation(1)), "{leg:?}");

        strings.release();
        assert_eq!(waiting.await.unwrap().unwrap(), 1, "the neighbour never moved");
        assert_eq!(patiently(&node, "ear").await, 1);
        assert_eq!(strings.lines("99"), [""; 0], "what the zombie said went nowhere");
        assert_eq!(node.abandoned_threads(), 0);
        node.expect_no_faults().await;
        node.shutdown().await;
    });
}

/// The thread that this component lives on.
fn thread_of(node: &Node, component: &str) -> Option<ThreadRow> {
    let hosts = |row: &ThreadRow| row.components.iter().any(|name| name.as_str() == component);
    node.threads().into_iter().find(hosts)
}

#[test]
fn neighbours_of_a_hang_are_moved_with_their_queues_and_rows_tell_to_whom_a_thread_was_lost() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let grace = Duration::from_millis(700);
        let mut node = start(robot(&strings).grace(grace)).await;
        let [shared, own] = ["arm", "ear"].map(|name| thread_of(&node, name).expect("it lives"));
        assert_eq!((shared.kind, own.kind), (ThreadKind::Shared, ThreadKind::Own));
        assert_eq!(shared.components.len(), 2, "the arm and the leg");
        let shown = Node::clone(&node);
        let row = |number| shown.threads().into_iter().find(|row| row.number == number);

        node.sender("arm").unwrap().tell(Do(Deed::Block("ear".into()))).unwrap();
        node.sender("leg").unwrap().tell(Note(1)).unwrap();
        let arm = || "arm".parse().expect("a name");
        let state = |number| row(number).map(|row| row.state);
        let kept = |state| matches!(state, Some(ThreadState::Blocked { by, .. }) if by == arm());
        until(async || kept(state(shared.number)), "it is kept").await;
        let blocked = row(shared.number).expect("it was there just now");
        assert!(blocked.busy > own.busy, "{blocked:?}");
        assert_eq!((state(own.number), blocked.queued), (Some(ThreadState::Alive), 1));

        let lost = Some(ThreadState::Abandoned { by: arm() });
        until(async || state(shared.number) == lost, "it is lost").await;
        let root = node.await_fault(FaultKind::Hang, "arm").await;
        node.await_recovered(FaultKind::Hang, "arm").await;
        let symptom = node.await_fault(FaultKind::Hang, "leg").await;
        node.await_recovered(FaultKind::Hang, "leg").await;
        assert_eq!(symptom.symptom_of, Some(root.id));
        assert_eq!((patiently(&node, "arm").await, patiently(&node, "leg").await), (2, 2));
        until(async || strings.lines("note") == ["leg#2 note 1"], "its queue came along").await;
        assert_eq!((node.abandoned_threads(), incarnation(&node, "ear").await), (1, 1));
        let elsewhere = thread_of(&node, "leg").expect("it lives again");
        assert!(elsewhere.number > own.number && elsewhere.state == ThreadState::Alive);

        strings.release();
        until(async || row(shared.number).is_none(), "the thread has come back, and ends").await;
        node.shutdown().await;
    });
}

#[test]
fn a_node_that_has_given_up_four_threads_comes_to_safe_rest() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let mut builder = Node::builder("module1").work_threads(1).grace(Duration::from_millis(50));
        for name in ["a", "b", "c", "d"] {
            let spec = strings.spec(name).on_own_thread().max_block(Duration::from_millis(100));
            builder = builder.child(spec);
        }
        let node = start(builder).await;
        for name in ["a", "b", "c", "d"] {
            node.sender(name).unwrap().tell(Do(Deed::Block(String::new()))).unwrap();
        }

        let ended = tokio::time::timeout(LONG, node.ended()).await;

        let Ok(NodeState::InSafeState { reason }) = &ended else { panic!("{ended:?}") };
        assert!(["a", "b", "c", "d"].iter().all(|name| reason.contains(name)), "{reason}");
        until(async || node.abandoned_threads() == 4, "all four are given up").await;
        assert_eq!(node.restart().await, Err(RestartError::ThreadsHang { count: 4 }));

        // They return after all: what was in the safe state is restarted.
        strings.release();
        until(async || node.abandoned_threads() == 0, "the threads come back").await;
        node.restart().await.unwrap();
        for name in ["a", "b", "c", "d"] {
            node.sender(name).unwrap().ask(Do(Deed::Nothing)).await.unwrap();
        }
        node.shutdown().await;
        assert_eq!(node.state(), NodeState::Stopped);
    });
}

/// Where this line of the diary stands.
fn at(diary: &[String], line: &str) -> usize {
    diary.iter().position(|l| l == line).unwrap_or_else(|| panic!("no {line:?} in {diary:?}"))
}

#[test]
fn a_hang_in_a_group_is_over_with_the_grace_and_moves_each_outsider_once() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        // They share one thread: none can stop in order, and no deadline is waited for.
        let patient = |name| strings.spec(name).shutdown_within(Duration::from_secs(3600));
        let group = SupervisorSpec::new("group", Strategy::RestForOne)
            .child(strings.spec("a").max_block(Duration::from_millis(150)))
            .child(patient("b"))
            .child(patient("c").ready_within(LONG));
        let builder = Node::builder("module1")
            .work_threads(1)
            .supervisor(group)
            .child(patient("outsider"))
            .child(strings.spec("ear").on_own_thread());
        let mut node = start(builder).await;
        strings.diary();
        // It waits for no group: the group waits for it.
        strings.pull("c", "on_initialize", Pull::WaitFor("outsider#2 on_activated"));

        node.sender("a").unwrap().tell(Do(Deed::Block("ear".into()))).unwrap();
        let recovered = async {
            node.await_recovered(FaultKind::Hang, "a").await;
            node.await_recovered(FaultKind::Hang, "outsider").await;
        };
        tokio::time::timeout(LONG, recovered).await.expect("no deadline of an hour is waited for");

        for name in ["a", "b", "c", "outsider"] {
            assert_eq!(patiently(&node, name).await, 2, "{name}");
        }
        assert_eq!(incarnation(&node, "ear").await, 1);
        let diary = strings.diary();
        let order = ["a#2 on_activated", "b#2 on_initialize", "b#2 on_activated"];
        let order = order.map(|line| at(&diary, line));
        assert!(order.is_sorted() && order[2] < at(&diary, "c#2 on_initialize"), "{diary:?}");
        strings.release();
        node.shutdown().await;
    });
}

#[test]
fn victims_of_a_hang_whose_thread_returns_as_it_is_lost_suffer_nothing_else() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        let victims = ["a", "b", "c", "d", "e", "f", "g", "h"];
        let builder = robot(&strings).grace(Duration::from_millis(50));
        let builder =
            victims.iter().fold(builder, |builder, name| builder.child(strings.spec(name)));
        let node = start(builder).await;
        let (seen, released) = (Node::clone(&node), strings.clone());
        let returns = std::thread::spawn(move || {
            while seen.abandoned_threads() == 0 {
                std::thread::yield_now();
            }
            released.release();
        });

        node.sender("arm").unwrap().tell(Do(Deed::Block("ear".into()))).unwrap();
        until(async || returns.is_finished(), "it is lost, and returns").await;
        for name in victims {
            assert_eq!(patiently(&node, name).await, 2, "{name}");
        }

        let record = node.faults().await;
        let hangs = |entry: &FaultEntry| entry.fault.kind == FaultKind::Hang;
        assert!(record.entries.iter().all(hangs), "{record:?}");
        node.shutdown().await;
    });
}

#[test]
fn a_shutdown_waits_for_nobody_who_stands_still_behind_a_hang() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let strings = Strings::default();
        // They share one thread: a component that is asked to stop does not receive that.
        let patient = |name| strings.spec(name).shutdown_within(Duration::from_secs(3600));
        let pair = SupervisorSpec::new("pair", Strategy::OneForAll)
            .child(patient("c"))
            .child(patient("d"));
        let builder = Node::builder("module1")
            .work_threads(1)
            .child(patient("a"))
            .child(patient("b").max_block(Duration::from_millis(150)))
            .supervisor(pair)
            .child(strings.spec("ear").on_own_thread());
        let node = start(builder).await;
        node.sender("b").unwrap().tell(Do(Deed::Block("ear".into()))).unwrap();
        strings.diary();

        let ended = tokio::time::timeout(LONG, node.shutdown()).await;

        ended.expect("no deadline of an hour is waited for");
        assert_eq!(node.state(), NodeState::Stopped);
        let diary = strings.diary();
        let stopped = |name| diary.contains(&format!("{name}#1 on_finalize"));
        assert!(stopped("ear"), "who can stop in order does: {diary:?}");
        assert!(!["a", "b", "c", "d"].into_iter().any(stopped), "{diary:?}");
        assert!(!diary.iter().any(|line| line.contains("#2")), "nothing restarts: {diary:?}");
        strings.release();
    });
}

#[test]
fn a_hang_restarts_a_group_with_a_supervisor_in_it_in_order_and_once() {
    let _turn = blastema_doubles::turn();
    for strategy in [Strategy::RestForOne, Strategy::OneForAll] {
        blastema::run(async move {
            let strings = Strings::default();
            let pair = SupervisorSpec::new("pair", Strategy::OneForOne)
                .child(strings.spec("b"))
                .child(strings.spec("c"));
            let group = SupervisorSpec::new("group", strategy)
                .child(strings.spec("a").max_block(Duration::from_millis(150)))
                .supervisor(pair)
                .child(strings.spec("d"));
            let builder = Node::builder("module1")
                .work_threads(1)
                .supervisor(group)
                .child(strings.spec("ear").on_own_thread());
            let mut node = start(builder).await;
            strings.diary();

            node.sender("a").unwrap().tell(Do(Deed::Block("ear".into()))).unwrap();
            let recovered = async {
                for name in ["a", "b", "c", "d"] {
                    node.await_recovered(FaultKind::Hang, name).await;
                }
            };
            tokio::time::timeout(LONG, recovered).await.expect("all come back");

            for name in ["a", "b", "c", "d"] {
                assert_eq!(patiently(&node, name).await, 2, "{strategy:?}: {name}");
            }
            let begun = strings.lines("on_initialize");
            let in_order = ["a", "b", "c", "d"].map(|name| format!("{name}#2 on_initialize"));
            assert_eq!(begun, in_order, "{strategy:?}");
            strings.release();
            node.shutdown().await;
        });
    }
}

#[test]
fn a_start_that_keeps_its_thread_is_a_hang_as_soon_as_it_has_had_its_time() {
    let _turn = blastema_doubles::turn();
    for hook in ["on_initialize", "factory"] {
        blastema::run(async {
            let strings = Strings::default();
            // Longer than the test: neither its stop nor the hang detector may be waited for.
            let for_ever = Duration::MAX;
            let arm = strings.spec("arm").max_block(for_ever).shutdown_within(for_ever);
            let arm = arm.ready_within(Duration::from_secs(1));
            let builder = Node::builder("module1").work_threads(1).child(strings.spec("leg"));
            let mut node = start(builder.child(arm).grace(Duration::from_millis(50))).await;
            strings.pull("arm", hook, Pull::Block);

            let restarted = tokio::task::spawn_local({
                let node = Node::clone(&node);
                async move { node.restart_child("arm").await }
            });
            let arm = node.await_fault(FaultKind::Hang, "arm").await;
            let leg = node.await_fault(FaultKind::Hang, "leg").await;

            let named = if hook == "factory" { "its factory" } else { hook };
            assert!(arm.detail.contains(named), "{arm:?}");
            assert_eq!((arm.symptom_of, leg.symptom_of), (None, Some(arm.id)), "{leg:?}");
            assert!(restarted.await.unwrap().is_err(), "this one does not come to work");
            assert_eq!((patiently(&node, "arm").await, patiently(&node, "leg").await), (3, 2));
            let kinds = node.faults().await.entries.into_iter().map(|entry| entry.fault.kind);
            assert!(
                kinds.clone().all(|kind| kind == FaultKind::Hang),
                "{:?}",
                Vec::from_iter(kinds)
            );
            strings.release();
            node.shutdown().await;
        });
    }
}

#[test]
fn a_stop_that_keeps_its_thread_is_a_hang_and_what_stands_behind_it_its_symptom() {
    let _turn = blastema_doubles::turn();
    for (what, named) in [
        ("on_deactivated", "on_deactivated"),
        ("on_finalize", "on_finalize"),
        ("drop", "its Drop"),
        ("a handler", "test/do"),
    ] {
        blastema::run(async {
            let strings = Strings::default();
            // It may compute for long: its stop is cut off before the hang detector minds.
            let arm = strings.spec("arm").max_block(LONG).shutdown_within(Duration::ZERO);
            let builder = Node::builder("module1").work_threads(1).child(arm);
            let builder = builder.child(strings.spec("leg")).grace(Duration::from_millis(50));
            let mut node = start(builder).await;
            strings.pull("arm", what, Pull::Block);
            if what == "a handler" {
                node.sender("arm").unwrap().tell(Do(Deed::Block("leg".into()))).unwrap();
                let begins = async {
                    while node.row("arm").await.current.is_none() {
                        tokio::time::sleep(Duration::from_millis(5)).await;
                    }
                };
                tokio::time::timeout(LONG, begins).await.expect("the handler begins");
            }

            let restarted = tokio::task::spawn_local({
                let node = Node::clone(&node);
                async move { node.restart_child("arm").await }
            });
            let arm = node.await_fault(FaultKind::Hang, "arm").await;
            let leg = node.await_fault(FaultKind::Hang, "leg").await;

            assert!(arm.detail.contains(named), "{arm:?}");
            assert_eq!((arm.symptom_of, leg.symptom_of), (None, Some(arm.id)), "{leg:?}");
            restarted.await.unwrap().expect("it is replaced on another thread");
            for name in ["arm", "leg"] {
                assert_eq!(patiently(&node, name).await, 2, "{what}: {name}");
            }
            strings.release();
            node.shutdown().await;
        });
    }
}
