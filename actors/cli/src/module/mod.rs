//! One module of the demonstration's robot: a node in a process of its own, which does what the
//! director says and tells what it finds.

use crate::args::ModuleOptions;
use crate::demo::control::{ControlError, enter};
use crate::demo::protocol::{Command, Event, VERSION};
use crate::demo::robot::Module;
use std::io;

/// Why a module ends with a failure.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ModuleError {
    /// It was not started by a demonstration.
    #[error("{0:?} is no module of the robot; modules are started by `blastema demo`")]
    Name(String),
    /// See [`ControlError`].
    #[error(transparent)]
    Control(#[from] ControlError),
    /// The operating system refuses something.
    #[error("the module cannot run: {0}")]
    System(#[from] io::Error),
}

pub(crate) fn run(options: &ModuleOptions) -> Result<(), ModuleError> {
    let name = || ModuleError::Name(options.name.clone());
    let module = Module::from_name(&options.name).ok_or_else(name)?;
    blastema::platform::end_with_parent(options.parent)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let (mut reader, mut writer) = enter(&options.control, options.parent).await?;
        let hello = Event::Hello { name: module.name().into(), version: VERSION };
        writer.send(&hello).await?;
        while let Some(command) = reader.next::<Command>().await? {
            match command {
                Command::Start { .. } => writer.send(&Event::Ready).await?,
                Command::Shutdown => break,
                _ => {}
            }
        }
        Ok(())
    })
}
