//! Parses the command line.

use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

const EXIT_STATUS: &str = "\
Exit status:
  0  every fault was found, located and recovered, and no reliable message was lost or doubled
  1  a fault was not recovered, or another promise was broken; the table states which
  2  the command line was wrong, or the demonstration could not be run to its end";

/// Start a robot of three processes, kill, hang and unplug parts of it, and show how it recovers
///
/// Three processes, module1 to module3, run a service robot with a hundred small objects. Two
/// networks on loopback addresses connect them, sealed with keys that are made for this run. Ten
/// faults are injected one after the other while numbered messages are sent. Lines say what is
/// broken, what the robot does about it, and what a user sees; tables follow at the end. It takes
/// less than 30 seconds. Ctrl-C ends all processes.
#[derive(Debug, Parser)]
#[command(name = "blastema-demo", version, args_conflicts_with_subcommands = true, after_help = EXIT_STATUS)]
pub(crate) struct DemoArguments {
    /// What the demonstration starts.
    #[command(subcommand)]
    pub(crate) part: Option<DemoPart>,
    /// Print one JSON document at the end, and nothing else
    #[arg(long)]
    pub(crate) json: bool,
}

/// A part of the demonstration that runs in a process of its own.
#[derive(Clone, Debug, PartialEq, Subcommand)]
pub(crate) enum DemoPart {
    /// Run one module of the demonstration's robot; started by the demonstration itself
    #[command(hide = true)]
    Module(ModuleOptions),
}

/// The options with which the demonstration starts one module.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct ModuleOptions {
    /// The module's name
    #[arg(long)]
    pub(crate) name: String,
    /// The folder of the run
    #[arg(long)]
    pub(crate) folder: PathBuf,
    /// The process of the director
    #[arg(long)]
    pub(crate) director: u32,
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_holds_together() {
        DemoArguments::command().debug_assert();
    }

    #[test]
    fn the_help_tells_the_exit_status_and_hides_the_module() {
        let help = DemoArguments::command().render_long_help().to_string();

        assert!(!help.contains("module  "), "{help}");
        for part in ["--json", "Exit status", "less than 30 seconds"] {
            assert!(help.contains(part), "{part} is missing in {help}");
        }
    }
}
