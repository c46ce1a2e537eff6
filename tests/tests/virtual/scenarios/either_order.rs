//! Commanders and actuators that start in either order, and restart, in virtual time.

use blastema::prelude::*;
use blastema::{ActuatorSpec, Commander, Hold, MemoryMedium};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, Notes, on_ethernet};
use std::time::Duration;

const LEASE: Duration = Duration::from_millis(100);
/// How long the motors take to start: longer than the lease.
const START: Duration = Duration::from_millis(300);

/// Turns the motors; answers which incarnation of theirs does.
#[derive(Clone, Debug, Request)]
#[contract(name = "motors/drive", reply = u64)]
struct Drive(f32);

/// Motors that start slowly.
struct Motors;

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0), Hold).lease(LEASE));
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        blastema::sleep(START).await;
        Ok(())
    }
}

impl Handle<Drive> for Motors {
    async fn handle(&mut self, _: Drive, cx: &mut Context<Self>) -> u64 {
        cx.incarnation().0
    }
}

/// What the planner's commands came to.
type Track = Notes<Result<u64, DeliveryError>>;

/// Claims the motors, and turns them twenty times a second.
struct Planner(Track);

impl Component for Planner {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let (motors, track) = (cx.commander::<Drive>("motors")?, self.0.clone());
        cx.spawn(async move {
            loop {
                match motors.claim_within(Duration::from_secs(5)).await {
                    Ok(_) => {
                        while let Ok(incarnation) = motors.command(Drive(1.0)).await {
                            track.note(Ok(incarnation));
                            blastema::sleep(50 * MS).await;
                        }
                    }
                    Err(why) => track.note(Err(why)),
                }
                blastema::sleep(20 * MS).await;
            }
        });
        Ok(())
    }
}

fn motors() -> ChildSpec<Motors> {
    ChildSpec::new("motors", || Motors)
}

#[blastema_testkit::test]
async fn a_planner_commands_its_motors_in_either_order_of_a_group_and_after_each_restart() {
    for planner_first in [true, false] {
        for strategy in [Strategy::OneForOne, Strategy::RestForOne, Strategy::OneForAll] {
            let track = Track::default();
            let kept = track.clone();
            let planner = ChildSpec::new("planner", move || Planner(kept.clone()));
            let group = SupervisorSpec::new("drive", strategy);
            let group = match planner_first {
                true => group.child(planner).child(motors()),
                false => group.child(motors()).child(planner),
            };
            let node = TestNode::start(Node::builder("module1").supervisor(group)).await;
            let case = format!("planner first: {planner_first}, {strategy:?}");
            let turned_by = |incarnation: u64| {
                let track = track.lock();
                track.iter().filter(|turned| **turned == Ok(incarnation)).count()
            };

            node.advance(1000 * MS).await;
            assert!(turned_by(1) > 5, "{case}: {track:?}");
            for incarnation in 2..=3 {
                node.kill("motors");
                node.advance(2000 * MS).await;
                assert!(turned_by(incarnation) > 5, "{case}: {track:?}");
            }
            assert!(track.lock().iter().all(Result::is_ok), "{case}: {track:?}");
            node.shutdown().await;
        }
    }
}

#[blastema_testkit::test]
async fn a_claim_waits_for_an_actuator_that_is_being_restarted() {
    let node = TestNode::start(Node::builder("module1").child(motors())).await;
    node.kill("motors");
    node.settle().await;
    let commander = node.commander::<Drive>("motors", "console").unwrap();
    let asked = now();

    commander.claim().await.unwrap();

    assert!(now() - asked >= START - 10 * MS, "{:?}", now() - asked);
    assert_eq!(commander.command(Drive(1.0)).await, Ok(2), "within the lease");
}

#[blastema_testkit::test]
async fn a_claim_waits_for_an_actuator_that_another_commander_holds() {
    let node = TestNode::start(Node::builder("module1").child(motors())).await;
    let holder = node.commander::<Drive>("motors", "planner").unwrap();
    let waiting = node.commander::<Drive>("motors", "console").unwrap();
    holder.claim().await.unwrap();
    let asked = now();

    let refused = waiting.claim_within(200 * MS).await;
    let took = now() - asked;
    let released = async {
        node.advance(300 * MS).await;
        holder.release().await
    };
    let (claimed, released) = tokio::join!(waiting.claim_within(5000 * MS), released);

    assert!(matches!(refused, Err(DeliveryError::Held { .. })), "{refused:?}");
    assert!((200 * MS..220 * MS).contains(&took), "{took:?}");
    released.unwrap();
    claimed.expect("the lease was given back");
    assert_eq!(waiting.command(Drive(1.0)).await, Ok(1));
}

#[blastema_testkit::test]
async fn a_claim_waits_for_the_node_of_its_actuator() {
    let medium = MemoryMedium::default();
    let here = TestNode::start(on_ethernet("module1", "module2", &medium)).await;
    let commander: Commander<Drive> = here.commander("module2:motors", "console").unwrap();

    let claim = commander.claim_within(Duration::from_secs(20));
    let start = async {
        here.advance(3000 * MS).await;
        TestNode::start(on_ethernet("module2", "module1", &medium).child(motors())).await
    };
    let (claimed, _there) = tokio::join!(claim, start);

    claimed.expect("the node has come");
    assert_eq!(commander.command(Drive(1.0)).await, Ok(1));
}
