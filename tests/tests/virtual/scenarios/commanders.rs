//! Commanders and the actuators that they hold, in virtual time.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Commander, Direction, FaultTransition, Hold, Impairment, LeaseStatus,
    MemoryMedium, NodeBuilder,
};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, Notes, Part, accepts, moves, on_ethernet, plug_cable, pull_cable};
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

const LEASE: Duration = Duration::from_millis(100);
/// The lease and one beat.
const BOUND: Duration = Duration::from_millis(110);

/// Turns the wheels; answers how fast they turn now.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(f32);

/// What the wheels did, and when.
type Track = Notes<(f32, blastema::Instant)>;

fn wheels(track: &Track) -> ChildSpec<Part<Track, Drive>> {
    let safe = ActuatorSpec::new(Drive(0.0), Hold).lease(LEASE);
    moves("wheels", safe, track.clone(), |track, Drive(speed), _| {
        track.note((speed, now()));
        speed
    })
}

struct Robot {
    here: TestNode,
    there: TestNode,
    track: Track,
}

impl Robot {
    async fn start() -> Self {
        Robot::start_with(|node| node).await
    }

    async fn start_with(more: impl FnOnce(NodeBuilder) -> NodeBuilder) -> Self {
        let (track, medium) = (Track::default(), MemoryMedium::default());
        let here = TestNode::start(more(on_ethernet("module1", "module2", &medium))).await;
        let there = on_ethernet("module2", "module1", &medium).child(wheels(&track));
        let there = TestNode::start(there).await;
        here.advance(2000 * MS).await;
        Robot { here, there, track }
    }

    fn commander(&self, own: &str) -> Commander<Drive> {
        self.here.commander("module2:wheels", own).unwrap()
    }

    fn speeds(&self) -> Vec<f32> {
        self.track.lock().iter().map(|(speed, _)| *speed).collect()
    }
}

/// The answer to a command without a lease, as the commander, or the actuator's node, gives it.
fn ended(actuator: &str) -> Result<f32, DeliveryError> {
    Err(DeliveryError::LeaseEnded { actuator: actuator.to_owned() })
}

#[blastema_testkit::test]
async fn a_commander_holds_the_wheels_for_as_long_as_it_lives_and_gives_them_back() {
    let robot = Robot::start().await;
    let commander = robot.commander("console");
    let around = robot.here.sender::<Drive>("module2:wheels").unwrap().ask(Drive(9.0)).await;
    assert!(matches!(around.unwrap_err().kind, DeliveryError::NotServed { .. }));

    assert_eq!(commander.command(Drive(1.0)).await, ended("module2:wheels"));
    commander.claim().await.unwrap();
    assert_eq!(commander.command(Drive(1.0)).await, Ok(1.0));
    robot.here.advance(10_000 * MS).await;
    assert!(commander.holds());
    assert_eq!(robot.speeds(), [1.0]);
    let shown = robot.there.actuators().remove(0).status;
    let LeaseStatus::Held { commander: who, left, .. } = shown else { panic!("{shown:?}") };
    assert_eq!((who.name.as_str(), left <= LEASE), ("module1:console", true));

    drop(commander);
    robot.here.advance(100 * MS).await;
    assert_eq!(robot.there.actuators()[0].status, LeaseStatus::Free);
    assert_eq!(robot.speeds(), [1.0, 0.0]);
    robot.there.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_cut_cable_stops_the_wheels_within_the_lease_and_one_beat() {
    let mut robot = Robot::start().await;
    let commander = robot.commander("console");
    commander.claim().await.unwrap();
    commander.command(Drive(1.0)).await.unwrap();

    let cut_at = now();
    pull_cable(&robot.here);
    robot.here.advance(BOUND).await;

    let (speed, at) = *robot.track.lock().last().unwrap();
    assert_eq!(speed, 0.0);
    assert!(at - cut_at <= BOUND, "{:?}", at - cut_at);
    assert!(!commander.holds(), "it knows by itself");
    assert_eq!(commander.command(Drive(2.0)).await, ended("module2:wheels"));
    robot.there.await_fault(FaultKind::CommanderGone, "wheels").await;

    plug_cable(&robot.here);
    robot.here.advance(1000 * MS).await;
    assert_eq!(robot.speeds(), [1.0, 0.0], "what came late was not carried out");
    commander.claim().await.unwrap();
    assert_eq!(commander.command(Drive(3.0)).await, Ok(3.0));
}

#[blastema_testkit::test]
async fn a_commanders_loss_is_told_each_time_and_stands_until_somebody_commands_again() {
    let robot = Robot::start().await;
    let mut events = robot.there.fault_events();
    let lost = async || {
        let record = robot.there.faults().await;
        let gone = record.entries.into_iter().filter(|e| e.fault.kind == FaultKind::CommanderGone);
        gone.map(|entry| entry.stands()).collect::<Vec<_>>()
    };

    for round in 1..=5 {
        let commander = robot.commander("console");
        commander.claim().await.unwrap();
        robot.here.settle().await;
        assert_eq!(lost().await, vec![false; round - 1], "a commander holds the lease");
        pull_cable(&robot.here);
        robot.here.advance(2 * BOUND).await;
        assert_eq!(lost().await.last(), Some(&true), "round {round}");
        plug_cable(&robot.here);
        robot.here.advance(1000 * MS).await;
    }

    let mut turns = Vec::new();
    while let Ok(Some(event)) = tokio::time::timeout(MS, events.next()).await {
        if event.fault.kind == FaultKind::CommanderGone {
            turns.push(event.turn);
        }
    }
    let told = |wanted: &FaultTransition| turns.iter().filter(|turn| *turn == wanted).count();
    assert_eq!(
        (told(&FaultTransition::Found), told(&FaultTransition::Cleared)),
        (5, 4),
        "{turns:?}"
    );
}

#[blastema_testkit::test]
async fn a_second_commander_is_refused_while_the_lease_holds_and_the_first_once_it_has_lost_it() {
    let robot = Robot::start().await;
    let (first, second) = (robot.commander("planner"), robot.commander("console"));
    let old = first.claim().await.unwrap();

    let by = format!("module1:planner{}", robot.here.incarnation());
    let held = DeliveryError::Held { actuator: "wheels".into(), by };
    assert_eq!(second.claim().await, Err(held));
    assert_eq!(second.command(Drive(2.0)).await, ended("module2:wheels"));
    first.release().await.unwrap();
    robot.here.advance(10 * MS).await;
    let new = second.claim().await.unwrap();

    assert!(new > old);
    assert_eq!(first.command(Drive(1.0)).await, ended("module2:wheels"));
    assert_eq!(second.command(Drive(2.0)).await, Ok(2.0));
    assert_eq!(robot.speeds(), [0.0, 2.0]);
}

#[blastema_testkit::test]
async fn two_of_one_name_fence_each_other_by_epoch() {
    let robot = Robot::start().await;
    let (first, second) = (robot.commander("planner"), robot.commander("planner"));
    first.claim().await.unwrap();
    let epoch = second.claim().await.unwrap();

    // Its own renewal may have told it already.
    let refused = first.command(Drive(1.0)).await.unwrap_err();
    assert!(
        refused == DeliveryError::Superseded { epoch }
            || matches!(refused, DeliveryError::LeaseEnded { .. }),
        "{refused}"
    );
    assert_eq!(second.command(Drive(2.0)).await, Ok(2.0));
    assert_eq!(robot.speeds(), [2.0]);
}

/// Drives, for as long as it lives.
struct Planner;

impl Component for Planner {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let wheels = cx.commander::<Drive>("module2:wheels")?;
        // The first incarnation of all finds no network yet.
        cx.spawn(async move {
            while wheels.claim().await.is_err() {
                tokio::time::sleep(10 * MS).await;
            }
            let _ = wheels.command(Drive(1.0)).await;
            std::future::pending::<()>().await;
            drop(wheels);
        });
        Ok(())
    }
}

#[blastema_testkit::test]
async fn the_next_incarnation_of_a_commander_goes_on_without_a_stop() {
    let planner = ChildSpec::new("planner", || Planner);
    let mut robot = Robot::start_with(|node| node.child(planner)).await;
    assert_eq!(robot.speeds(), [1.0]);

    robot.here.kill("planner");
    robot.here.await_recovered(FaultKind::Panic, "planner").await;
    robot.here.advance(500 * MS).await;

    let speeds = robot.speeds();
    assert!(matches!(speeds[..], [1.0, 1.0] | [1.0, 0.0, 1.0]), "{speeds:?}");
}

/// The scan of a laser: no bulk.
#[derive(Clone, Debug, Event)]
#[contract(max_size = 32 * 1024)]
struct Scan(u32, Vec<u8>);

#[blastema_testkit::test]
async fn a_lease_is_kept_and_commands_are_answered_beside_scans_as_fast_as_they_are_taken() {
    const SCANS: u32 = 4000;
    let scans = Arc::new(AtomicU32::new(0));
    let (track, medium) = (Track::default(), MemoryMedium::default());
    let map = accepts("map", scans.clone(), |scans, scan: Scan, _| {
        assert_eq!(scan.0, scans.fetch_add(1, SeqCst), "none is lost, doubled or overtaken");
    });
    let map = map.queue(16, WhenFull::Wait);
    let here = TestNode::start(on_ethernet("module1", "module2", &medium)).await;
    let there = on_ethernet("module2", "module1", &medium).child(wheels(&track)).child(map);
    let there = TestNode::start(there).await;
    here.advance(2000 * MS).await;
    let commander = here.commander::<Drive>("module2:wheels", "console").unwrap();
    let delay = 15 * MS;
    for node in [&here, &there] {
        let long = Impairment { delay, ..Impairment::default() };
        node.cable("ethernet").unwrap().impair(Direction::Outgoing, long);
    }
    commander.claim().await.unwrap();

    let sender = here.sender::<Scan>("module2:map").unwrap();
    let burst = tokio::task::spawn_local(async move {
        for n in 0..SCANS {
            sender.deliver(Scan(n, vec![7; 15_000])).await.expect("it is taken");
        }
    });
    let mut commands = 0_u16;
    while !burst.is_finished() {
        commands += 1;
        let speed = f32::from(commands);
        assert_eq!(commander.command(Drive(speed)).await, Ok(speed), "command {commands}");
        assert!(commander.holds());
    }
    burst.await.expect("all were taken");
    here.advance(3000 * MS).await;

    assert!(commands > 10, "{commands}");
    assert_eq!(scans.load(SeqCst), SCANS);
    assert!(track.lock().iter().all(|(speed, _)| *speed != 0.0), "the lease was never lost");
    there.expect_no_faults().await;
}
