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
    request(child, ChildAction::Restart(Some(fault(1, kind, child, incarnation))))
}

fn request(child: &str, action: ChildAction) -> ChildRequest {
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
async fn children_come_and_go_and_are_found_by_name() {
    let bench = Bench::new();
    let root = bench.serving(rules(Strategy::OneForOne), &["a"]).await;

    let added = |whole| {
        let (child, rules) = (bench.script.child("b"), ChildRules::default());
        root.address.send(AddChild { child, rules, whole })
    };
    let gone = || Recovered { object: object("b"), incarnation: None, waits: false };
    bench.script.answer("start b", &[ScriptedReply::Fails]);
    let undone = added(true).await.expect("it lives").expect_err("it does not start");
    assert!(matches!(undone.why, GiveUpReason::StartFailed { .. }), "{undone:?}");
    assert!(bench.directory.supervisor_of(&object("b")).is_none());
    assert_eq!(added(true).await.expect("it lives"), recovered("b", 1));
    let refused = added(false).await.expect("it lives");
    assert_eq!(refused.expect_err("the name is taken").why, GiveUpReason::NameTaken);
    assert!(bench.directory.supervisor_of(&object("b")).is_some());

    let removed = root.address.send(request("b", ChildAction::Remove)).await;
    assert_eq!(removed.expect("it lives"), Ok(gone()));
    assert!(bench.directory.supervisor_of(&object("b")).is_none());
    assert_eq!(added(false).await.expect("it lives"), Ok(gone()));
    assert_eq!(bench.script.done(), ["start b", "start b", "stop b", "start b"]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn resets_isolation_and_rest_reach_the_child() {
    let bench = Bench::new();
    let root = bench.serving(rules(Strategy::OneForOne), &["a", "b"]).await;
    bench.script.answer("reset b", &[ScriptedReply::Fails]);
    let reset = |child| request(child, ChildAction::Reset);

    assert_eq!(root.address.send(reset("a")).await.expect("it lives"), recovered("a", 1));
    let failed = root.address.send(reset("b")).await.expect("it lives");
    assert_eq!(
        failed.expect_err("it is jammed").why,
        GiveUpReason::ResetFailed { reason: "jammed".into() }
    );
    let isolate = ChildAction::Isolate { faulty: None, isolated: true, reason: String::new() };
    assert!(root.address.send(request("a", isolate)).await.expect("it lives").is_ok());
    let rest = ChildAction::SafeStop(None);
    assert!(root.address.send(request("b", rest)).await.expect("it lives").is_ok());
    assert_eq!(bench.script.done(), ["reset a", "reset b", "isolate a", "isolate b", "stop b"]);
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
