//! A module: one process with a node of the robot, as `robot.xml` describes it, and a node of the
//! director's network, by which it is broken and looked at.

mod agent;
mod cell;
mod counters;
mod flows;
mod laser;
mod messages;
mod motors;
mod odometry;
mod operator;
mod planner;
mod safety;
mod stopwatch;
mod ticker;

use crate::args::ModuleOptions;
use crate::robot::Module;
use crate::run_folder::{AGENT, ROBOT_FILE, control_network, reason_of, remove_orphan};
use agent::Agent;
use blastema::platform::Terminations;
use blastema::prelude::*;
use blastema_robot::Types;
use std::error::Error;
use std::fs;
use std::time::Duration;
use tokio::time::timeout;

/// How long the nodes may take to stop in order; what is left ends with the process.
const FAREWELL: Duration = Duration::from_secs(1);

/// A debug build takes ten times as long for each message.
const SETTINGS: [(&str, &str); 2] = if cfg!(debug_assertions) {
    [("hello", "100ms"), ("probes", "20Hz")]
} else {
    [("hello", "50ms"), ("probes", "100Hz")]
};

/// The types of the robot's components.
fn types() -> Types {
    Types::new()
        .component::<safety::Safety>("Safety")
        .component::<planner::Planner>("Planner")
        .component::<laser::Laser>("Laser")
        .component::<operator::OperatorPanel>("Operator")
        .component::<motors::Motors>("Motors")
        .component::<odometry::Odometry>("Odometry")
        .component::<cell::SkinCell>("Cell")
        .component::<flows::FlowSource>("FlowSource")
        .component::<stopwatch::Stopwatch>("Stopwatch")
        .component::<stopwatch::Answerer>("Answerer")
        .component::<ticker::Ticker>("Ticker")
        .component::<ticker::PlainListener>("PlainListener")
        .component::<ticker::ChoosyListener>("ChoosyListener")
}

/// Runs a module until the director, whose child it is, stops it.
///
/// # Errors
/// The module cannot be started.
pub(crate) fn run(options: &ModuleOptions) -> Result<(), Box<dyn Error>> {
    let outcome: Result<(), Box<dyn Error>> = blastema::run(async {
        let mut signals = Terminations::listen()?;
        let nodes = tokio::select! {
            nodes = start(options) => nodes?,
            _ = signals.next() => return Ok(()),
        };
        signals.next().await;
        // Who stops it may kill it before it has ended.
        remove_orphan(&options.folder);
        let [control, robot] = nodes;
        let _ =
            timeout(FAREWELL, async { tokio::join!(control.shutdown(), robot.shutdown()) }).await;
        Ok(())
    });
    if let Err(error) = &outcome {
        // Without the folder the director has ended, and needs no reason.
        let _ = fs::write(reason_of(&options.folder, &options.name), error.to_string());
    }
    remove_orphan(&options.folder);
    outcome
}

/// Starts the node of the robot, and beside it the one of the director's network.
async fn start(options: &ModuleOptions) -> Result<[Node; 2], Box<dyn Error>> {
    let ModuleOptions { name, folder, director } = options;
    let addresses = Module::ALL.map(|module| (module.name(), address(module, *director)));
    let mut set: Vec<(&str, &str)> = SETTINGS.into();
    set.extend(addresses.iter().map(|(name, address)| (*name, address.as_str())));
    let types = types();
    let robot = types.load(&folder.join(ROBOT_FILE), &set)?;
    let robot = types.node(&robot, name)?.with_faults(u64::from(*director));
    let robot = robot.without_signal_handling().notify_systemd().start().await?;
    let agent = Agent { robot: robot.clone() };
    let control = Node::builder(name)
        .child(ChildSpec::new(AGENT, move || Agent { robot: agent.robot.clone() }))
        .network(control_network(folder, name))
        .components_on_this_thread()
        .without_signal_handling()
        .start()
        .await?;
    Ok([control, robot])
}

/// Returns the address of a module on the loopback interface. A director has a block of four to
/// itself, so that several robots can run on one computer.
fn address(module: Module, director: u32) -> String {
    let [_, high, middle, low] = ((director << 2) | (module as u32 + 1)).to_be_bytes();
    format!("127.{high}.{middle}.{low}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_modules_of_two_directors_have_one_address() {
        let all = [1, 2, 4_194_303].map(|director| Module::ALL.map(|of| address(of, director)));

        assert_eq!(all[0], ["127.0.0.5", "127.0.0.6", "127.0.0.7"]);
        assert_eq!(all[2], ["127.255.255.253", "127.255.255.254", "127.255.255.255"]);
        assert_eq!(all.iter().flatten().collect::<std::collections::BTreeSet<_>>().len(), 9);
    }
}
