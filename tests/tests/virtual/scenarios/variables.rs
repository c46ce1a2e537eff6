//! Variables of objects here and on another node, in virtual time.

use blastema::prelude::*;
use blastema::{MemoryMedium, RestoreDecision, RestorePolicy, Transaction, ValueState};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Notes, on_ethernet, plug_cable, pull_cable};

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "arm/speed")]
struct Speed(f32);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "arm/height")]
struct Height(f32);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "arm/target")]
struct Target(String);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "arm/tool")]
struct Tool(u8);

struct Arm;

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        let speed = VariableSpec::new(Speed(0.5)).check(|speed| {
            assert!(speed.0 >= 0.0, "no arm moves backwards in time");
            if speed.0 <= 2.0 { Ok(()) } else { Err("too fast".into()) }
        });
        let height = VariableSpec::new(Height(0.0)).after_restart(RestorePolicy::Hold);
        let target = VariableSpec::new(Target("rest".into()));
        let tool = VariableSpec::new(Tool(0)).after_restart(RestorePolicy::Default);
        ports
            .variable(speed)
            .variable(height)
            .variable(target.after_restart(RestorePolicy::AskFirst))
            .variable(tool);
    }
}

/// The arm's node, and another one.
async fn two_nodes(medium: &MemoryMedium) -> (TestNode, TestNode) {
    let here = TestNode::start(on_ethernet("module1", "module2", medium)).await;
    let arm = on_ethernet("module2", "module1", medium).child(ChildSpec::new("arm", || Arm));
    let there = TestNode::start(arm).await;
    here.advance(2000 * MS).await;
    (here, there)
}

#[blastema_testkit::test]
async fn variables_are_read_written_and_checked_alike_here_and_on_another_node() {
    let (here, there) = two_nodes(&MemoryMedium::default()).await;

    for (node, name) in [(&there, "arm"), (&there, "module2:arm"), (&here, "module2:arm")] {
        let (speed, height) =
            (node.variable::<Speed>(name).unwrap(), node.variable::<Height>(name).unwrap());
        let first = speed.write(Speed(1.0)).await.unwrap();
        assert_eq!(speed.read().await.unwrap().value, Speed(1.0), "{name}");

        let refused = speed.write(Speed(3.0)).await;
        assert_eq!(refused, Err(DeliveryError::CheckFailed { reason: "too fast".into() }));
        let Err(DeliveryError::CheckFailed { reason }) = speed.write(Speed(-1.0)).await else {
            panic!("the check panicked")
        };
        assert!(reason.contains("backwards"), "{reason}");

        let both = Transaction::new().write(&height, Height(9.0)).write(&speed, Speed(3.0));
        assert!(both.commit().await.is_err());
        assert_ne!(height.read().await.unwrap().value, Height(9.0), "not one without the other");
        let late = speed.write_if(Speed(0.1), first - 1).await;
        assert!(
            matches!(late, Err(DeliveryError::Changed { revision, .. }) if revision == first),
            "{late:?}"
        );
        let both =
            Transaction::new().write(&height, Height(0.3)).write_if(&speed, Speed(0.2), first);
        both.commit().await.unwrap();
        assert_eq!(height.read().await.unwrap().value, Height(0.3));
    }
    here.expect_no_faults().await;
    there.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn what_is_no_variable_or_another_one_is_told_so() {
    #[derive(Clone, Debug, Variable)]
    #[contract(name = "arm/speed")]
    struct OtherSpeed {
        wheel: String,
    }
    #[derive(Clone, Debug, Variable)]
    #[contract(name = "arm/colour")]
    struct Colour(u8);

    let (here, there) = two_nodes(&MemoryMedium::default()).await;
    let other = OtherSpeed { wheel: "left".into() };
    assert_eq!(other.wheel, "left");

    assert!(matches!(there.variable::<Speed>("leg"), Err(DeliveryError::Unknown { .. })));
    for (node, name) in [(&there, "arm"), (&here, "module2:arm")] {
        let colour = node.variable::<Colour>(name).unwrap().read().await;
        assert!(matches!(colour, Err(DeliveryError::NoVariable { .. })), "{colour:?}");
        let speed = node.variable::<OtherSpeed>(name).unwrap();
        let Err(DeliveryError::ContractDiffers { difference }) = speed.read().await else {
            panic!("it is another one")
        };
        assert!(difference.contains("fields with names here"), "{difference}");
        let written = speed.write(other.clone()).await;
        assert!(matches!(written, Err(DeliveryError::ContractDiffers { .. })), "{written:?}");
    }
    let nowhere = here.variable::<Speed>("module9:arm").unwrap().read().await;
    assert!(matches!(nowhere, Err(DeliveryError::Unreachable { .. })), "{nowhere:?}");
    let mut colour = here.variable::<Colour>("module2:arm").unwrap().watch();
    assert!(matches!(colour.next().await, Err(DeliveryError::NoVariable { .. })));
    let mut nothing = here.variable::<Speed>("module2:lag").unwrap().watch();
    assert!(matches!(nothing.next().await, Err(DeliveryError::Unknown { .. })));
    let apart = Transaction::new()
        .write(&here.variable::<Speed>("module2:arm").unwrap(), Speed(1.0))
        .write(&here.variable::<Speed>("module9:arm").unwrap(), Speed(1.0));
    assert!(matches!(apart.commit().await, Err(DeliveryError::CheckFailed { .. })));
}

#[blastema_testkit::test]
async fn each_variable_becomes_what_was_declared_when_its_owner_dies() {
    let (here, mut there) = two_nodes(&MemoryMedium::default()).await;
    let speed = here.variable::<Speed>("module2:arm").unwrap();
    let height = here.variable::<Height>("module2:arm").unwrap();
    let target = here.variable::<Target>("module2:arm").unwrap();
    let tool = here.variable::<Tool>("module2:arm").unwrap();
    Transaction::new()
        .write(&speed, Speed(1.5))
        .write(&height, Height(0.7))
        .write(&target, Target("shelf".into()))
        .write(&tool, Tool(3))
        .commit()
        .await
        .unwrap();

    there.kill("arm");
    there.await_recovered(FaultKind::Panic, "arm").await;

    let left = speed.read().await.unwrap();
    assert_eq!((left.value, left.state), (Speed(1.5), ValueState::Current));
    let held = height.read().await.unwrap();
    assert_eq!((held.value, held.state), (Height(0.7), ValueState::Held));
    assert_eq!(tool.read().await.unwrap().value, Tool(0));
    assert!(matches!(target.read().await, Err(DeliveryError::Undecided { .. })));
    assert!(matches!(
        target.write(Target("floor".into())).await,
        Err(DeliveryError::Undecided { .. })
    ));

    target.decide(RestoreDecision::Restore).await.unwrap();
    assert_eq!(target.read().await.unwrap().value, Target("shelf".into()));
    assert!(matches!(
        target.decide(RestoreDecision::Default).await,
        Err(DeliveryError::Changed { .. })
    ));
}

#[blastema_testkit::test]
async fn a_watcher_hears_of_every_change_and_after_a_cut_of_what_is_true_then() {
    let medium = MemoryMedium::default();
    let (here, there) = two_nodes(&medium).await;
    let heard = Notes::<String>::default();
    let mut watch = here.variable::<Speed>("module2:arm").unwrap().watch();
    let kept = heard.clone();
    tokio::task::spawn_local(async move {
        while let Ok(reading) = watch.next().await {
            kept.note(reading.value.0.to_string());
        }
        kept.note("the watch has ended");
    });
    let speed = there.variable::<Speed>("arm").unwrap();
    here.advance(50 * MS).await;

    for value in [1.0, 1.5] {
        speed.write(Speed(value)).await.unwrap();
        here.advance(50 * MS).await;
    }
    here.advance(10_000 * MS).await;
    speed.write(Speed(1.75)).await.unwrap();
    here.advance(50 * MS).await;
    assert_eq!(*heard.lock(), ["0.5", "1", "1.5", "1.75"]);

    pull_cable(&here);
    here.advance(5000 * MS).await;
    speed.write(Speed(0.25)).await.unwrap();
    speed.write(Speed(0.75)).await.unwrap();
    plug_cable(&here);
    here.advance(5000 * MS).await;
    assert_eq!(heard.lock()[4..], ["0.75"]);

    // Its node ends, and comes back later without the arm at first.
    there.shutdown().await;
    here.advance(5000 * MS).await;
    let there = TestNode::start(on_ethernet("module2", "module1", &medium)).await;
    here.advance(5000 * MS).await;
    there.shutdown().await;
    let arm = on_ethernet("module2", "module1", &medium).child(ChildSpec::new("arm", || Arm));
    let _there = TestNode::start(arm).await;
    here.advance(5000 * MS).await;
    assert_eq!(heard.lock()[5..], ["0.5"]);
}
