//! The program of a robot: `run`, `check`, `graph` and `describe`.

use crate::check::check;
use crate::description::RobotDescription;
use crate::finding::{RobotFinding, report};
use crate::graph::{GraphFormat, graph};
use crate::launch::{FAILED, Launch, LaunchFailure, NOT_UP};
use crate::own_process::run_arguments;
use crate::reader::{self, RobotReading};
use crate::types::Types;
use blastema::{NodeState, StartError, platform};
use clap::{Parser, Subcommand};
use serde_json::json;
use std::fmt;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The command line is wrong, or the file cannot be read.
const UNREADABLE: u8 = 2;

/// Why a robot file was refused. Its text has all findings.
#[derive(Clone, PartialEq, Eq)]
pub struct RobotFileError {
    report: String,
    /// The file could not be read at all.
    pub is_unreadable: bool,
}

impl fmt::Display for RobotFileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.report.trim_end())
    }
}

impl fmt::Debug for RobotFileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

impl std::error::Error for RobotFileError {}

/// Returns the program that a robot file names, with these values of its arguments. The program has
/// the types of its components.
///
/// # Errors
/// The file cannot be read, is no XML, or names no program.
pub fn program_of(file: &Path, set: &[(String, String)]) -> Result<PathBuf, RobotFileError> {
    let refused = |report, is_unreadable| RobotFileError { report, is_unreadable };
    let read = reader::read(file, set);
    let reading = read.map_err(|report| refused(report, true))?;
    reading.robot.program.ok_or_else(|| match reading.findings.is_empty() {
        true => {
            let help = "add `program=\"…\"` to `robot`, with the path of the program from the \
                        folder of the file";
            refused(format!("{} names no program: {help}", file.display()), false)
        }
        false => refused(report(&reading.findings, &reading.sources), false),
    })
}

/// A robot whose components are compiled into this program.
#[derive(Parser)]
struct RobotArguments {
    #[command(subcommand)]
    command: RobotCommand,
}

#[derive(Subcommand)]
enum RobotCommand {
    /// Starts a node of the robot, or, where all endpoints are on this computer, all nodes
    Run {
        #[command(flatten)]
        file: FileArguments,
        /// The node to start
        #[arg(long)]
        node: Option<String>,
        #[arg(long, hide = true)]
        until_stdin_ends: bool,
    },
    /// Finds all mistakes in the file, and starts nothing
    Check {
        #[command(flatten)]
        file: FileArguments,
    },
    /// Prints the supervision trees and the connections
    Graph {
        #[command(flatten)]
        file: FileArguments,
        /// The format of the graph
        #[arg(long, value_enum, default_value = "text")]
        format: GraphFormat,
    },
    /// Prints the registered types with their parameters and ports as JSON
    Describe,
}

#[derive(clap::Args)]
struct FileArguments {
    /// The robot file
    file: PathBuf,
    /// Sets an argument of the file: NAME=VALUE
    #[arg(long, value_name = "NAME=VALUE", value_parser = name_and_value)]
    set: Vec<(String, String)>,
}

fn name_and_value(text: &str) -> Result<(String, String), String> {
    let parts = text.split_once('=').ok_or("write NAME=VALUE")?;
    Ok((parts.0.to_owned(), parts.1.to_owned()))
}

fn print(text: &str) -> ExitCode {
    ended(platform::print(text).map_err(|reason| LaunchFailure { status: FAILED, reason }))
}

fn complain(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{}", text.trim_end());
}

/// Says why a robot has not run to its end, if it has not.
fn ended(ran: Result<(), LaunchFailure>) -> ExitCode {
    let Err(LaunchFailure { status, reason }) = ran else { return ExitCode::SUCCESS };
    complain(&reason);
    ExitCode::from(status)
}

impl Types {
    /// Reads a robot file, with these values of its arguments, and checks it. It must be called in
    /// Blastema's runtime, as [`blastema::run`] gives it; nothing is started.
    ///
    /// # Errors
    /// The file cannot be read, or has mistakes: the text shows all of them with their places.
    pub fn load(
        &self,
        file: &Path,
        set: &[(&str, &str)],
    ) -> Result<RobotDescription, RobotFileError> {
        let own = |(name, value): &(&str, &str)| ((*name).to_owned(), (*value).to_owned());
        self.load_with(file, &set.iter().map(own).collect::<Vec<_>>())
    }

    fn load_with(
        &self,
        file: &Path,
        set: &[(String, String)],
    ) -> Result<RobotDescription, RobotFileError> {
        let refused = |report, is_unreadable| RobotFileError { report, is_unreadable };
        if let Some(name) = self.twice.first() {
            let text = format!("`{name}` is registered twice: give each type a name of its own");
            return Err(refused(text, false));
        }
        let read = reader::read(file, set);
        let RobotReading { robot, mut sources, mut findings, .. } =
            read.map_err(|report| refused(report, true))?;
        // Of a file that is no XML, nothing else is known.
        if !findings.iter().any(|finding| matches!(finding.code, "robot::xml" | "robot::schema")) {
            findings = check(&robot, &mut sources, self, findings);
        }
        findings.sort_by_key(RobotFinding::order);
        match findings.is_empty() {
            true => Ok(robot),
            false => Err(refused(report(&findings, &sources), false)),
        }
    }

    /// Reads the command line `run | check | graph | describe`, and does what it says.
    ///
    /// | command | does |
    /// | --- | --- |
    /// | `run FILE [--node NAME] [--set NAME=VALUE]…` | starts the node, or the only one; without `--node` all of them, each as a process, where all endpoints are on this computer |
    /// | `check FILE [--set …]` | prints all mistakes |
    /// | `graph FILE [--format text\|dot\|mermaid]` | prints the trees and the connections |
    /// | `describe` | prints the types as JSON |
    ///
    /// It returns 0, 1 where the file has a mistake or the robot did not run to its end, 2 where
    /// the command line is wrong or the file cannot be read, and 3 where a node did not come up, as
    /// after a signal during its start, so that the start of the robot was undone. A node that a
    /// signal ends and whose hooks do not finish in time sets its outputs to safe values, and
    /// returns 128 and the signal's number.
    pub fn main(self) -> ExitCode {
        blastema::launch_processes();
        match RobotArguments::parse().command {
            RobotCommand::Run { file, node, until_stdin_ends } => {
                self.run(&file, node.as_deref(), until_stdin_ends)
            }
            RobotCommand::Check { file } => self.with_robot(&file, |robot| {
                let components: usize =
                    robot.nodes.iter().map(|node| node.components().len()).sum();
                let (name, nodes) = (&robot.name, robot.nodes.len());
                print(&format!("{name}: {nodes} nodes, {components} components, no mistake\n"))
            }),
            RobotCommand::Graph { file, format } => {
                self.with_robot(&file, |robot| print(&graph(&robot, format)))
            }
            RobotCommand::Describe => print(&self.describe()),
        }
    }

    fn with_robot(
        &self,
        FileArguments { file, set }: &FileArguments,
        use_it: impl FnOnce(RobotDescription) -> ExitCode,
    ) -> ExitCode {
        match blastema::run(async { self.load_with(file, set) }) {
            Ok(robot) => use_it(robot),
            Err(error) => {
                complain(&error.to_string());
                ExitCode::from(if error.is_unreadable { UNREADABLE } else { FAILED })
            }
        }
    }

    fn run(&self, file: &FileArguments, node: Option<&str>, until_stdin_ends: bool) -> ExitCode {
        self.with_robot(file, |robot| {
            let nodes = robot.nodes.iter().filter(|node| node.process_of.is_none());
            let names: Vec<&str> = nodes.map(|node| node.name.as_str()).collect();
            let node = node.or(match names[..] {
                [only] => Some(only),
                _ => None,
            });
            if let Some(name) = node {
                return self.run_node(&robot, name, until_stdin_ends);
            }
            if let Some((node, at)) = self.far_endpoint(&robot) {
                complain(&format!(
                    "the endpoint {at} of node {node} is not on this computer alone: start each node \
                     by `run {} --node NAME`; the nodes are {}",
                    file.file.display(),
                    names.join(", ")
                ));
                return ExitCode::from(UNREADABLE);
            }
            let arguments = run_arguments(&file.file, &file.set);
            ended(blastema::run(Launch { nodes: names, arguments }.run()))
        })
    }

    fn run_node(&self, robot: &RobotDescription, name: &str, until_stdin_ends: bool) -> ExitCode {
        let failed = |status, error: String| {
            let reason = format!("node {name}: {error}");
            LaunchFailure { status, reason }
        };
        let not_up = |error: StartError| failed(NOT_UP, error.to_string());
        ended(blastema::run(async {
            let builder = self.node(robot, name).map_err(|error| failed(FAILED, error))?;
            let (ended, stdin_ended) = tokio::sync::oneshot::channel();
            if until_stdin_ends {
                std::thread::spawn(move || {
                    // What is written there is of no interest.
                    let _ = io::copy(&mut io::stdin().lock().take(u64::MAX), &mut io::sink());
                    let _ = ended.send(());
                });
            }
            let end = async {
                // Without the thread the sender is gone.
                if stdin_ended.await.is_err() {
                    std::future::pending().await
                }
            };
            let is_process = robot.node(name).is_some_and(|node| node.process_of.is_some());
            if is_process {
                let ended = builder.notify_systemd().run_to_safe_state(end).await;
                return match ended.map_err(not_up)? {
                    NodeState::InSafeState { reason } => Err(failed(FAILED, reason)),
                    _ => Ok(()),
                };
            }
            builder.run_until(end).await.map_err(not_up)
        }))
    }

    /// An endpoint that other computers reach.
    fn far_endpoint<'a>(&self, robot: &'a RobotDescription) -> Option<(&'a str, &'a str)> {
        let ends = robot.nodes.iter().flat_map(|node| {
            node.endpoints.iter().map(move |end| (node.name.as_str(), end.at.as_str()))
        });
        // A pty is a serial line whose other end is on this computer.
        let is_near = |at: &str| {
            at.starts_with("serial:///dev/pts/")
                || !blastema::Network::new("endpoint", at).leaves_computer()
        };
        ends.into_iter().find(|(_, at)| !is_near(at))
    }

    /// The registered types as JSON.
    fn describe(&self) -> String {
        let [types, strategies, safe_outputs] = self.names();
        let described = types.iter().map(|name| {
            let mut description = match self.description(name) {
                Some(of) if of.gives.is_none() => {
                    let mut value = json!(of);
                    value["gives"] = json!("not declared");
                    value
                }
                Some(of) => json!(of),
                None => json!("its `ports` panicked"),
            };
            if let Some(device) = self.device_description(name) {
                description["device"] = match device {
                    Ok(device) => json!(device),
                    Err(why) => json!(why),
                };
            }
            ((*name).to_owned(), description)
        });
        let types: serde_json::Map<_, _> = described.collect();
        let all = json!({
            "types": types,
            "strategies": strategies,
            "safe_outputs": safe_outputs,
            "leaves": self.leaves.names().collect::<Vec<_>>(),
        });
        format!("{all:#}\n")
    }
}
