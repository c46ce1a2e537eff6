//! What a robot does alone when it loses its commander, in virtual time.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Commander, Connected, Direction, Heartbeats, Link, LostCommunicationPolicy,
    MemoryMedium, Network, NodeBuilder, Rung,
};
use blastema_testkit::{TestNode, now};
use std::cell::Cell;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);

#[derive(Clone, Copy, Debug, PartialEq, Request)]
#[contract(name = "wheels/drive", reply = ())]
enum Drive {
    Safe,
    At(u32),
    Hold,
    Home,
    Stop,
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
        let mut track = self.0.lock().unwrap();
        if track.last().is_none_or(|(last, _)| *last != drive) {
            track.push((drive, now()));
        }
    }
}

/// Drives the robot home.
struct Homing;

impl Component for Homing {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let wheels = cx.commander::<Drive>("wheels")?;
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

fn network(medium: &MemoryMedium, own: &str, other: &str) -> NodeBuilder {
    let network = Network::memory("radio", medium, own).link(Link::in_memory(other, other));
    Node::builder(own).network(network.with_faults(7))
}

impl Robot {
    async fn start(policy: LostCommunicationPolicy) -> Self {
        let (medium, track) = (MemoryMedium::default(), Track::default());
        let kept = track.clone();
        let rover = network(&medium, "rover", "operator")
            .child(ChildSpec::new("wheels", move || Wheels(kept.clone())))
            .lost_communication(policy);
        let operator = TestNode::start(network(&medium, "operator", "rover")).await;
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

    robot.rover.cable("radio").unwrap().cut(Direction::Both, false);
    robot.lost_at = now();
    robot.rover.advance(100 * SECOND).await;

    // A second of silence, and then the times of the rungs. Between them the leases end.
    use Drive::{At, Hold, Home, Safe, Stop};
    assert_eq!(
        robot.told(),
        [(Safe, 0), (Hold, 2), (Safe, 11), (Home, 11), (Safe, 61), (Stop, 61)]
    );
    assert_eq!(robot.rung().as_deref(), Some("stop"));
    let kind = FaultKind::ConnectionLost;
    let never = robot.rover.await_fault(kind.clone(), "conditions/operator").await;
    assert_eq!(never.detail, "operator/beat: never heard", "before the operator came");
    let fault = robot.rover.await_fault(kind, "conditions/operator").await;
    let entries = robot.rover.faults().await.entries;
    let entry = entries.iter().find(|entry| entry.fault.id == fault.id).unwrap();
    assert!(entry.fault.detail.ends_with("the robot begins to stop"), "{}", entry.fault.detail);
    assert_eq!(entry.fault.count, 4, "the loss and each rung");

    robot.rover.cable("radio").unwrap().restore();
    robot.rover.advance(3 * SECOND).await;
    assert!(robot.rover.lost_communication()[0].is_back);
    let refused = commander.claim().await.unwrap_err();
    assert!(refused.to_string().contains("the policy for lost communication"), "{refused}");
    robot.rover.advance(10 * SECOND).await;
    assert_eq!(robot.rung(), None);
    commander.claim().await.unwrap();
    commander.command(At(7)).await.unwrap();
    assert_eq!(robot.told().last(), Some(&(At(7), 114)));
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
    let empty = || LostCommunicationPolicy::new("operator", Connected::heartbeat("operator/beat"));
    let homing = || Rung::run("return", || ChildSpec::new("homing", || Homing));
    for (policy, expected) in [
        (empty(), "it has no rungs"),
        (empty().after(SECOND, hold()).after(SECOND, hold()), "do not rise in time"),
        (empty().after(SECOND, homing()), "its last rung, return, runs a component"),
        (
            empty().after(SECOND, Rung::command("hold", "weels", Drive::Hold)),
            "commands weels by `wheels/drive`",
        ),
        (empty().after(Duration::MAX, hold()), "more than an hour"),
    ] {
        let wheels = ChildSpec::new("wheels", || Wheels(Track::default()));
        let builder = Node::builder("rover").child(wheels).lost_communication(policy);
        let Err(error) = TestNode::try_start(builder).await else { panic!("{expected}") };
        let error = error.to_string();
        assert!(error.contains(expected), "{error}");
    }
}
