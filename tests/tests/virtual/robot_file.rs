//! What a robot from a file does when it loses its commander, in virtual time: as one from code.

use blastema::prelude::*;
use blastema::trees::{BehaviorTree, Status, TreeLeaves};
use blastema::{ActuatorSpec, Connected, Hold, LostCommunicationPolicy, NodeBuilder, Rung};
use blastema_robot::Types;
use blastema_testkit::{TestNode, now};
use blastema_tests::MS;
use std::fs;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

const ROBOT: &str = r#"<robot schema="1" name="rover"><node name="rover">
  <component name="wheels" type="Wheels"/>
  <component name="homing" tree="homing.xml"/>
  <lost-communication name="operator">
    <needs heartbeat="operator/beat" timeout="1s"/>
    <after time="1s" do="hold">
      <command actuator="wheels#drive"><field name="speed" value="0.1 m/s"/></command>
    </after>
    <after time="10s" do="return" run="homing"/>
    <after time="60s" do="stop"><command actuator="wheels#drive"/></after>
  </lost-communication>
</node></robot>"#;
const HOMING: &str =
    r#"<root BTCPP_format="4"><BehaviorTree ID="Homing"><Home/></BehaviorTree></root>"#;

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "wheels/drive", reply = ())]
struct Drive {
    #[contract(unit = "m/s")]
    speed: f32,
}

/// The speeds that the wheels were given, each once in a row, and when.
type Track = Arc<Mutex<Vec<(f32, blastema::Instant)>>>;

struct Wheels(Track);

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive { speed: 0.0 }, Hold)).named("drive");
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) {
        let mut track = self.0.lock().unwrap();
        if track.last().is_none_or(|(last, _)| *last != drive.speed) {
            track.push((drive.speed, now()));
        }
    }
}

fn leaves() -> TreeLeaves {
    TreeLeaves::new().task("Home", [], |mut leaf| async move {
        let wheels = leaf.context().commander::<Drive>("wheels")?;
        wheels.claim().await?;
        wheels.command(Drive { speed: -0.5 }).await?;
        blastema::sleep(30 * SECOND).await;
        Ok(Status::Success)
    })
}

/// What the wheels do in a minute and a half after the loss, in seconds, and when it is back.
async fn told(builder: NodeBuilder, track: Track) -> Vec<(f32, u64)> {
    let rover = TestNode::start(builder).await;
    assert!(rover.actor::<BehaviorTree>("homing").is_err(), "it runs on its rung alone");
    let beats = rover.heartbeat("operator/beat", 100 * MS).unwrap();
    rover.advance(5 * SECOND).await;
    assert_eq!(track.lock().unwrap().len(), 0);
    drop(beats);
    let lost_at = now();
    rover.advance(90 * SECOND).await;
    assert_eq!(rover.lost_communication()[0].rung.as_deref(), Some("stop"));
    let _beats = rover.heartbeat("operator/beat", 100 * MS).unwrap();
    rover.advance(10 * SECOND).await;
    assert_eq!(rover.lost_communication()[0].rung, None);
    let track = track.lock().unwrap();
    track.iter().map(|(speed, at)| (*speed, (*at - lost_at + 500 * MS).as_secs())).collect()
}

#[blastema_testkit::test]
async fn a_robot_from_a_file_holds_returns_by_a_tree_and_stops_as_one_from_code() {
    let folder = tempfile::tempdir().unwrap();
    let files = [("rover.xml", ROBOT), ("homing.xml", HOMING)];
    let [robot, homing] = files.map(|(name, text)| {
        let file = folder.path().join(name);
        fs::write(&file, text).unwrap();
        file
    });
    let track = Track::default();
    let kept = track.clone();
    let types = Types::new().component_with("Wheels", move || Wheels(kept.clone()));
    let types = types.leaves(leaves());
    let robot = types.load(&robot, &[]).unwrap_or_else(|error| panic!("{error}"));

    let from_file = told(types.node(&robot, "rover").unwrap(), track).await;

    assert_eq!(from_file, [(0.1, 2), (-0.5, 11), (0.1, 41), (-0.5, 41), (0.0, 61)]);
    let track = Track::default();
    let kept = track.clone();
    let homing = BehaviorTree::read(&leaves(), homing).unwrap();
    let needs = Connected::heartbeat("operator/beat").timeout(SECOND);
    let policy = LostCommunicationPolicy::new("operator", needs)
        .after(SECOND, Rung::command("hold", "wheels", Drive { speed: 0.1 }))
        .after(10 * SECOND, Rung::run("return", move || homing("homing")))
        .after(60 * SECOND, Rung::command("stop", "wheels", Drive { speed: 0.0 }));
    let rover = Node::builder("rover")
        .child(ChildSpec::new("wheels", move || Wheels(kept.clone())))
        .lost_communication(policy);
    assert_eq!(told(rover, track).await, from_file);
}
