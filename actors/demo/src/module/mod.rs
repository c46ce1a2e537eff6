//! One module of the demonstration's robot: a node in a process of its own, which executes the
//! director's commands and reports its faults.
//!
//! ```text
//!  director ── commands ──► ModuleAgent ──► FaultTarget ──► objects (each harms itself)
//!           ◄── events ──── Measurements ◄── flows, echoes, ticks; fault events; monitor's table
//! ```
//!
//! Measurements are stored outside of the objects, so that they survive the injected faults.

mod agent;
mod cell;
mod fault_target;
mod harm;
mod laser;
mod measurements;
mod messages;
mod module_node;
mod motors;
mod odometry;
mod operator;
mod pacer;
mod planner;
mod report;
mod safety;
mod stopwatch;
mod ticker;

use crate::args::ModuleOptions;
use crate::control::{ControlError, enter};
use crate::protocol::{DirectorCommand, ModuleEvent, VERSION};
use crate::robot::Module;
use agent::ModuleAgent;
use std::io;
use tokio::sync::mpsc::channel;

/// Lines that may wait between the module and the director.
const QUEUE: usize = 4_096;

/// The reason why a module ends with a failure.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ModuleError {
    /// The name is not one of the robot's modules.
    #[error("{0:?} is no module of the robot; modules are started by `blastema-demo`")]
    Name(String),
    /// See [`ControlError`].
    #[error(transparent)]
    Control(#[from] ControlError),
    /// The operating system refuses something.
    #[error("the module cannot run: {0}")]
    System(#[from] io::Error),
}

/// Runs a module until the director ends or shuts it down.
///
/// # Errors
/// The module was not started by a director, or cannot reach it.
pub(crate) fn run(options: &ModuleOptions) -> Result<(), ModuleError> {
    let name = || ModuleError::Name(options.name.clone());
    let module = Module::from_name(&options.name).ok_or_else(name)?;
    blastema::platform::end_with_parent(options.parent)?;
    // The director is told of every fault. Printed as well, faults would push the reason of this
    // process's own end out of its last words. A subscriber that is there already is as good.
    let _ = tracing::subscriber::set_global_default(tracing::subscriber::NoSubscriber::new());
    let options = options.clone();
    blastema::run(async move { serve(module, &options).await })
}

async fn serve(module: Module, options: &ModuleOptions) -> Result<(), ModuleError> {
    let (mut reader, mut writer) = enter(&options.control, options.parent).await?;
    let hello = ModuleEvent::Hello { name: module.name().into(), version: VERSION };
    writer.send(&hello).await?;
    let Some(DirectorCommand::Start { wiring }) = reader.next().await? else { return Ok(()) };

    let (events, mut told) = channel::<ModuleEvent>(QUEUE);
    tokio::spawn(async move {
        while let Some(event) = told.recv().await {
            // A director that is gone is noticed by the reader.
            if writer.send(&event).await.is_err() {
                break;
            }
        }
    });
    let (commands_in, commands) = channel::<DirectorCommand>(QUEUE);
    tokio::spawn(async move {
        // An end of the channel is an end of the module; so is a line that cannot be understood.
        while let Ok(Some(command)) = reader.next().await {
            if commands_in.send(command).await.is_err() {
                break;
            }
        }
    });
    ModuleAgent::new(module, options.keys.clone(), events).hold(wiring, commands).await;
    Ok(())
}
