use super::*;
use crate::fault_chain::tests::scripted::{Bench, ScriptedReply, fault, object};
use blastema_contract::supervisor::{ChildAction, ChildRequest};
use blastema_core::recovery::{ChildState, Strategy};
use blastema_doubles::settle;

fn rules(strategy: Strategy) -> SupervisorRules {
    SupervisorRules { strategy, ..SupervisorRules::default() }
}

fn restart(bench: &Bench, child: &str, kind: FaultKind, incarnation: u64) -> ChildRequest {
    if kind == FaultKind::Panic {
        bench.script.dies(child);
    }
    let action = ChildAction::Restart(Some(fault(1, kind, child, incarnation)));
    ChildRequest { object: object(child), action }
}

fn recovered(child: &str, incarnation: u64) -> RecoveryResult {
    Ok(Recovered {
        object: object(child),
        incarnation: Some(Incarnation(incarnation)),
        waits: false,
    })
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn it_starts_its_children_in_order_and_tells_whom_it_reports_to() {
    let bench = Bench::new();
    let children = ["a", "b"].map(|name| (bench.script.child(name), ChildRules::default()));
    let mut root = bench.supervisor("root", SupervisorRules::default(), children.into());

    root.start(Incarnation(4), bench.above.recipient().into());

    let report = bench.above.expect().await;
    assert_eq!(report.event, ChildEvent::Started);
    assert_eq!((report.object, report.incarnation), (object("root"), Incarnation(4)));
    assert_eq!(bench.script.done(), ["start a", "start b"]);
    let states = [Lifecycle::Initialized, Lifecycle::Active];
    assert_eq!(
        bench.states.drain().iter().map(|reported| reported.state).collect::<Vec<_>>(),
        states
    );

    root.order(ChildOrder::Stop { again: false });
    assert_eq!(bench.above.expect().await.event, ChildEvent::Stopped);
    assert_eq!(bench.script.done(), ["stop b", "stop a"]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_nested_supervisor_answers_open_requests_after_its_restart() {
    let bench = Bench::new();
    let inner_rules = SupervisorRules { intensity: 0, ..rules(Strategy::OneForAll) };
    let wheels = vec![(bench.script.child("wheel"), ChildRules::default())];
    let inner = bench.supervisor("drive", inner_rules, wheels);
    let drive = inner.address.clone();
    let children: Vec<(Box<dyn Child>, _)> = vec![
        (Box::new(inner), ChildRules::supervisor()),
        (bench.script.child("planner"), ChildRules::default()),
    ];
    let mut root = bench.supervisor("root", rules(Strategy::RestForOne), children);
    root.start(Incarnation::FIRST, bench.above.recipient().into());
    assert_eq!(bench.above.expect().await.event, ChildEvent::Started);
    assert_eq!(bench.script.done(), ["start wheel", "start planner"]);

    let outcome = drive.send(restart(&bench, "wheel", FaultKind::Panic, 1)).await;

    assert_eq!(outcome.expect("it lives"), recovered("wheel", 2));
    settle().await;
    assert_eq!(bench.script.done(), ["stop planner", "start wheel", "start planner"]);
    let tree = root.tree().send(ReadTree).await.expect("it lives");
    assert_eq!(tree.restarts_left, 2);
    let drive = tree.children[0].below.as_ref().expect("it is a supervisor");
    assert_eq!((drive.incarnation, drive.children[0].restarts), (Incarnation(2), 1));
    assert!(tree.children[1].below.is_none());

    root.order(ChildOrder::Abandon);
    settle().await;
    assert_eq!(bench.script.done(), ["abandon planner", "abandon wheel"]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn after_a_panic_of_its_own_its_children_stay_at_work() {
    let bench = Bench::new();
    let root = bench.serving(rules(Strategy::OneForOne), &["a", "b"]).await;
    bench.script.answer("start b", &[ScriptedReply::Panics]);

    let lost = root.address.send(restart(&bench, "b", FaultKind::Panic, 1)).await;

    assert!(lost.is_err() || matches!(lost, Ok(Err(_))), "{lost:?}");
    let death = bench.deaths.expect().await;
    assert_eq!(death.object, object("chain/supervisor/root"));
    assert!(death.restarted_as.is_some());
    settle().await;
    assert_eq!(bench.script.done(), ["start b", "abandon b", "start b"]);
    let tree = root.tree().send(ReadTree).await.expect("it lives again");
    let states: Vec<_> = tree.children.iter().map(|leaf| leaf.state).collect();
    assert_eq!(states, [ChildState::Running, ChildState::Running]);
    assert_eq!(tree.children[0].incarnation, Incarnation::FIRST);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_restart_on_the_spot_is_counted_once() {
    let bench = Bench::new();
    let on_the_spot = ChildRules { on_the_spot: true, ..ChildRules::default() };
    let children = vec![(bench.script.child("a"), on_the_spot)];
    let mut root = bench.supervisor("root", rules(Strategy::OneForOne), children);
    root.start(Incarnation::FIRST, bench.above.recipient().into());
    settle().await;
    assert_eq!(bench.script.done(), ["start a", "order a"]);

    let (exit, restarted_as) = (ExitReason::Returned, Some(Incarnation(2)));
    let event = ChildEvent::Died { exit, restarted_as };
    let (object, incarnation) = (object("a"), Incarnation::FIRST);
    let report = ChildReport { object, incarnation, event };
    root.address.do_send(report.clone());
    root.address.do_send(report);

    let tree = root.tree().send(ReadTree).await.expect("it lives");
    assert_eq!((tree.restarts_left, tree.children[0].restarts), (2, 1));
    assert_eq!(tree.children[0].incarnation, Incarnation(2));
}
