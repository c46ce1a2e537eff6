//! What a robot does alone when it loses its commander, in virtual time.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Commander, Connected, Heartbeats, LostCommunicationPolicy, MemoryMedium,
    NodeBuilder, Rung,
};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, on_ethernet, plug_cable, pull_cable};
use std::cell::Cell;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

#[derive(Clone, Copy, Debug, PartialEq, Request)]
#[contract(name = "wheels/drive", reply = ())]
enum Drive {
    Safe,
    At(u32),
    Hold,
    Home,
    Stop,
    /// It is never finished.
    Hang,
}

/// What the wheels were told, each once, and when for the first time.
type Track = Arc<Mutex<Vec<(Drive, blastema::Instant)>>>;

struct Wheels(Track);

thread_local! {
    /// How often the wheels of this test were cut off: a node of a test has one thread.
    static CUT_OFFS: Cell<u32> = const { Cell::new(0) };
}

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        let spec = ActuatorSpec::new(Drive::Safe, 300 * MS);
        ports.actuator(spec.lease(200 * MS).cut_off(|| CUT_OFFS.set(CUT_OFFS.get() + 1)));
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) {
        {
            let mut track = self.0.lock().unwrap();
            if track.last().is_none_or(|(last, _)| *last != drive) {
                track.push((drive, now()));
            }
        }
        if drive == Drive::Hang {
            std::future::pending::<()>().await;
        }
    }
}

/// Drives the robot home.
struct Homing;

impl Component for Homing {
    fn ports(ports: &mut Ports<Self>) {
        ports.commands::<Drive>("out");
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let wheels: Commander<Drive> = cx.port("out")?;
        cx.spawn(async move {
            loop {
                if wheels.claim().await.is_ok() {
                    while wheels.command(Drive::Home).await.is_ok() {
                        blastema::sleep(50 * MS).await;
                    }
                }
                blastema::sleep(20 * MS).await;
            }
        });
        Ok(())
    }
}

struct Robot {
    rover: TestNode,
    operator: TestNode,
    track: Track,
    lost_at: blastema::Instant,
}

fn policy() -> LostCommunicationPolicy {
    let needs = Connected::heartbeat("operator/beat").timeout(SECOND);
    LostCommunicationPolicy::new("operator", needs)
        .commander("operator")
        .after(SECOND, Rung::command("hold", "wheels", Drive::Hold))
        .after(10 * SECOND, Rung::run("return", || ChildSpec::new("homing", || Homing)))
        .after(60 * SECOND, Rung::command("stop", "wheels", Drive::Stop))
}

impl Robot {
    async fn start(policy: LostCommunicationPolicy) -> Self {
        let has_homing = format!("{policy:?}").contains("return");
        let (medium, track) = (MemoryMedium::default(), Track::default());
        let kept = track.clone();
        let rover = on_ethernet("rover", "operator", &medium);
        let rover = match has_homing {
            true => rover.connect("homing#out", "wheels#wheels/drive"),
            false => rover,
        };
        let rover = rover
            .child(ChildSpec::new("wheels", move || Wheels(kept.clone())))
            .lost_communication(policy);
        let operator = TestNode::start(on_ethernet("operator", "rover", &medium)).await;
        let rover = TestNode::start(rover).await;
        rover.advance(2 * SECOND).await;
        Robot { rover, operator, track, lost_at: now() }
    }

    /// The operator commands for ten seconds.
    async fn operate(&self) -> (Heartbeats, Commander<Drive>) {
        let beats = self.operator.heartbeat("operator/beat", 100 * MS).unwrap();
        let commander = self.operator.commander::<Drive>("rover:wheels", "console").unwrap();
        commander.claim().await.unwrap();
        for speed in 0..100 {
            commander.command(Drive::At(speed / 100)).await.unwrap();
            self.rover.advance(100 * MS).await;
        }
        (beats, commander)
    }

    fn rung(&self) -> Option<String> {
        self.rover.lost_communication()[0].rung.clone()
    }

    /// What the wheels were told since the loss, and after how many seconds.
    fn told(&self) -> Vec<(Drive, u64)> {
        let track = self.track.lock().unwrap();
        let since = track.iter().filter(|(_, at)| *at > self.lost_at);
        since.map(|(drive, at)| (*drive, (*at - self.lost_at + 500 * MS).as_secs())).collect()
    }
}

#[blastema_testkit::test]
async fn a_robot_that_is_cut_off_holds_returns_and_stops_and_is_commanded_again_when_it_is_stable()
{
    let mut robot = Robot::start(policy()).await;
    let (_beats, commander) = robot.operate().await;
    assert_eq!(robot.rung(), None);

    pull_cable(&robot.rover);
    robot.lost_at = now();
    robot.rover.advance(100 * SECOND).await;

    // A second of silence, and then the times of the rungs. Nothing comes between two of them.
    use Drive::{At, Hold, Home, Safe, Stop};
    assert_eq!(robot.told(), [(Safe, 0), (Hold, 2), (Home, 11), (Stop, 61)]);
    assert_eq!(robot.rung().as_deref(), Some("stop"));
    assert_eq!(CUT_OFFS.get(), 0, "the operator's lease was over before the first rung");
    let kind = FaultKind::ConnectionLost;
    let never = robot.rover.await_fault(kind.clone(), "conditions/operator").await;
    assert_eq!(never.detail, "operator/beat: never heard", "before the operator came");
    let fault = robot.rover.await_fault(kind, "conditions/operator").await;
    let entries = robot.rover.faults().await.entries;
    let entry = entries.iter().find(|entry| entry.fault.id == fault.id).unwrap();
    assert!(entry.fault.detail.ends_with("the robot begins to stop"), "{}", entry.fault.detail);
    assert_eq!(entry.fault.count, 4, "the loss and each rung");

    plug_cable(&robot.rover);
    robot.rover.advance(3 * SECOND).await;
    assert!(robot.rover.lost_communication()[0].is_back);
    let refused = commander.claim().await.unwrap_err();
    assert!(refused.to_string().contains("the policy for lost communication"), "{refused}");
    robot.rover.advance(10 * SECOND).await;
    assert_eq!(robot.rung(), None);
    commander.claim().await.unwrap();
    commander.command(At(7)).await.unwrap();
    assert_eq!(robot.told().last(), Some(&(At(7), 114)));
    assert_eq!(CUT_OFFS.get(), 0, "it was given back in order");
}

#[blastema_testkit::test]
async fn a_component_of_a_rung_is_connected_again_in_each_ladder_and_ends_without_a_cut_off() {
    let mut robot = Robot::start(policy()).await;
    for round in 0..2 {
        let (beats, commander) = robot.operate().await;
        let before = CUT_OFFS.get();
        robot.lost_at = now();
        drop(beats);
        robot.rover.advance(12 * SECOND).await;
        use Drive::{Hold, Home, Safe};
        // The operator's last command has timed out.
        assert_eq!(robot.told(), [(Safe, 0), (Hold, 2), (Home, 11)], "round {round}");
        assert_eq!(robot.rung().as_deref(), Some("return"));

        let _beats = robot.operator.heartbeat("operator/beat", 100 * MS).unwrap();
        robot.rover.advance(10 * SECOND).await;
        assert_eq!((robot.rung(), robot.told().last()), (None, Some(&(Safe, 17))));
        assert_eq!(CUT_OFFS.get(), before, "its lease was taken in order");
        assert!(robot.rover.actor::<Homing>("homing").is_err());
        drop(commander);
        robot.rover.advance(SECOND).await;
    }
}

#[blastema_testkit::test]
async fn heartbeats_that_cease_take_the_lease_of_a_commander_that_still_renews_it() {
    let mut robot = Robot::start(policy().until_acknowledged()).await;
    let (beats, commander) = robot.operate().await;
    drop(beats);
    robot.lost_at = now();
    robot.rover.advance(3 * SECOND).await;
    assert!(!commander.holds());
    assert_eq!(robot.told().last(), Some(&(Drive::Hold, 2)));
    assert!(commander.claim().await.is_err());
    let early = robot.rover.acknowledge("operator").await.unwrap_err();
    assert!(early.to_string().contains("wait until communication is back"), "{early}");

    let _beats = robot.operator.heartbeat("operator/beat", 100 * MS).unwrap();
    robot.rover.advance(100 * SECOND).await;
    assert_eq!(robot.rung().as_deref(), Some("hold"), "it climbs no further, and waits");
    let unknown = robot.rover.acknowledge("pilot").await.unwrap_err();
    assert!(unknown.to_string().contains("it has operator"), "{unknown}");
    robot.rover.acknowledge("operator").await.unwrap();
    robot.rover.advance(SECOND).await;
    assert_eq!(robot.rung(), None);
    commander.claim().await.unwrap();
    assert_eq!(CUT_OFFS.get(), 0, "its lease was taken by the rung, and given back by it");
}

#[blastema_testkit::test]
async fn a_rung_that_is_never_finished_is_followed_by_the_cut_off() {
    let needs = Connected::heartbeat("operator/beat").timeout(SECOND);
    let policy = LostCommunicationPolicy::new("operator", needs)
        .after(SECOND, Rung::command("stop", "wheels", Drive::Hang));
    let robot = Robot::start(policy).await;
    let (beats, _commander) = robot.operate().await;
    drop(beats);
    robot.rover.advance(2050 * MS).await;
    assert_eq!((robot.rung().as_deref(), CUT_OFFS.get()), (Some("stop"), 0));
    robot.rover.advance(SECOND).await;
    assert!(CUT_OFFS.get() > 0);
}

#[blastema_testkit::test]
async fn the_last_rung_cuts_an_actuator_off_whose_component_is_dead() {
    let needs = Connected::heartbeat("operator/beat").timeout(SECOND);
    let policy = LostCommunicationPolicy::new("operator", needs)
        .after(SECOND, Rung::command("stop", "wheels", Drive::Stop));
    let mut robot = Robot::start(policy).await;
    let (beats, commander) = robot.operate().await;
    drop((beats, commander));
    robot.rover.fail_init("wheels", 1000);
    robot.rover.kill("wheels");
    robot.rover.advance(SECOND).await;
    let before = CUT_OFFS.get();
    robot.lost_at = now();
    robot.rover.advance(5 * SECOND).await;
    assert_eq!(robot.rung().as_deref(), Some("stop"));
    assert_eq!(robot.told(), []);
    assert!(CUT_OFFS.get() > before);
}

#[blastema_testkit::test]
async fn a_policy_that_cannot_work_is_refused_at_the_start() {
    let hold = || Rung::command("hold", "wheels", Drive::Hold);
    let named =
        |name: &str| LostCommunicationPolicy::new(name, Connected::heartbeat("operator/beat"));
    let empty = || named("operator");
    let lease = LostCommunicationPolicy::new("lease", Connected::commander("wheels"));
    let homing = || Rung::run("return", || ChildSpec::new("homing", || Homing));
    let second_brake = || Rung::run("return", || ChildSpec::new("brake", || Homing));
    let stop = |actuator| empty().after(SECOND, Rung::command("stop", actuator, Drive::Stop));
    let twice = hold().and_command("wheels", Drive::Stop);
    let brake = || Rung::command("stop", "brake", Drive::Stop);
    let base = || named("base").after(SECOND, brake()).commander("operator");
    for (policies, expected) in [
        (vec![empty()], "it has no rungs"),
        (vec![empty().after(SECOND, hold()).after(SECOND, hold())], "do not rise in time"),
        (vec![empty().after(SECOND, homing())], "its last rung, return, runs a component"),
        (
            vec![empty().after(SECOND, homing().and_command("wheels", Drive::Hold))],
            "its last rung, return, runs a component",
        ),
        (vec![stop("weels")], "commands weels by `wheels/drive`"),
        (vec![stop("weels")], "did you mean wheels?"),
        (vec![empty().after(SECOND, twice)], "two commands for wheels"),
        (vec![empty().after(Duration::MAX, hold())], "write an hour at most"),
        (vec![lease.after(SECOND, hold())], "its condition needs a commander"),
        (
            vec![empty().after(SECOND, second_brake()).after(2 * SECOND, hold())],
            "its rung return runs brake, and a component has that name: rename one",
        ),
        (vec![stop("wheels").commander("rover")], "its commander rover is this node"),
        (vec![stop("wheels").commander("a b")], "its commander: \"a b\" holds ' '"),
        (
            vec![stop("wheels"), named("base").after(SECOND, hold())],
            "the policy \"base\" for lost communication: it has the actuator wheels in common with \
             the policy operator",
        ),
        (
            vec![stop("wheels").commander("operator"), base()],
            "it has commander operator in common with the policy operator",
        ),
        (vec![stop("wheels"), empty().after(SECOND, brake())], "it has its name in common"),
    ] {
        let wheels = |name| ChildSpec::new(name, || Wheels(Track::default()));
        let builder = on_ethernet("rover", "operator", &MemoryMedium::default());
        let builder = builder.child(wheels("wheels")).child(wheels("brake"));
        let builder = policies.into_iter().fold(builder, NodeBuilder::lost_communication);
        let Err(error) = TestNode::try_start(builder).await else { panic!("{expected}") };
        let error = error.to_string();
        assert!(error.contains(expected), "{error}");
    }
    let wheels = ChildSpec::new("wheels", || Wheels(Track::default()));
    let alone =
        Node::builder("alone").child(wheels).lost_communication(stop("wheels").commander("base"));
    let Err(error) = TestNode::try_start(alone).await else { panic!("it has no networks") };
    assert!(error.to_string().contains("which has no networks"), "{error}");
}
