//! A robot whose pose is a plain key of Zenoh, and which drives to what is written to another:
//! `tests/zenoh/client.py` is the other side. It ends when its input does.
//!
//! ```text
//! zenoh_bridge tcp/127.0.0.1:7447
//! ```

use blastema::prelude::*;
use blastema_zenoh::ZenohBridge;
use std::io::Read;

/// Where the robot is.
#[derive(Clone, Debug, Event)]
#[contract(name = "demo/pose")]
struct Pose {
    #[contract(unit = "m", frame = "map")]
    x: f64,
}

/// Where it is to be.
#[derive(Clone, Debug, Event)]
#[contract(name = "demo/goal")]
struct Goal {
    #[contract(unit = "m", frame = "map")]
    x: f64,
}

/// Is where it is told to be.
struct Drive(f64);

impl Component for Drive {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Goal>().on("goal");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.publisher("pose")?.publish(Pose { x: self.0 })?;
        Ok(())
    }
}

impl Handle<Goal> for Drive {
    async fn handle(&mut self, goal: Goal, _: &mut Context<Self>) {
        self.0 = goal.x;
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let at = std::env::args().nth(1).unwrap_or_else(|| "tcp/127.0.0.1:7447".to_owned());
    let bridge = ZenohBridge::new("ranger")
        .listen(&at)
        .publish::<Pose>("pose", "pose")
        .subscribe::<Goal>("goal", "goal");
    let node = Node::builder("base")
        .supervisor(bridge.try_into()?)
        .child(ChildSpec::new("drive", || Drive(0.0)).rate_hz(20.0))
        .start()
        .await?;
    let (ended, ends) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        let _ = std::io::stdin().read_to_end(&mut Vec::new());
        let _ = ended.send(());
    });
    let _ = ends.await;
    node.shutdown().await;
    Ok(())
}
