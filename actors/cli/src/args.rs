//! Parses the command line.

use clap::{ArgGroup, Args, Parser};
use std::ffi::OsString;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Duration;

const MONITOR_HELP: &str = "\
Examples:
  blastema monitor /run/robot/module1.sock
  blastema monitor --json /run/robot/module1.sock /run/robot/module2.sock
  watch -n 1 blastema monitor /run/robot/module1.sock

Exit status:
  0  every node was shown
  2  the command line was wrong, or a node could not be shown: those named before it were";

const FAULT_LIST_HELP: &str = "\
Examples:
  blastema fault list /run/robot/module1.sock
  blastema fault list --journal /var/lib/robot/module1.faults
  blastema fault list --all --json --journal /var/lib/robot/module1.faults

Exit status:
  0  the list was shown, whatever stands in it
  2  the command line was wrong, or a node or the journal could not be read";

const KEYS_HELP: &str = "\
Examples:
  blastema keys new ranger base arm laptop --role laptop=operator
  blastema keys add gripper --robot ranger.robot
  blastema keys show
  blastema keys revoke arm --push base@10.0.0.1:7400 --keys laptop.key

A node uses its key if its program says `.keys(\"base.key\")` at its builder, or the environment
variable BLASTEMA_KEYS names the file. ROBOT.roster must be in the same folder. Both are read when
the node starts, and ROBOT.roster again when it is replaced.

Exit status:
  0  it was done
  1  the list was changed, and was not handed over by --push
  2  the command line or a file was wrong, or could not be read or written";

const OPERATOR_HELP: &str = "\
Examples:
  blastema keys check base@10.0.0.1:7400 --keys laptop.key
  blastema keys add gripper --push base@10.0.0.1:7400 --keys laptop.key
  blastema node isolate arm --via base@10.0.0.1:7400 --keys laptop.key --reason \"it smokes\"

The key is that of a node with `role operator`, and ROBOT.roster must be in the same folder. The
command is a node of the robot while it runs: it connects over UDP from any address and port, and
the node that it connects to need not describe it. Over other media that node must describe it as a
neighbour, and --own-endpoint says where it is.

Exit status:
  0  it was done, and of `check`: nothing is wrong
  1  only a part of it was done: the roster was not handed over, a node was not reached or has
     refused; of `check`: a node is off, has an older roster or another key, or is not sealed
  2  the command line or a file was wrong, or the robot could not be reached";

const ORDER_HELP: &str = "\
Examples:
  blastema component list --socket /run/robot/arm.sock
  blastema component deactivate gripper --socket /run/robot/arm.sock
  blastema component restart gripper --via base@10.0.0.1:7400 --node arm --keys laptop.key
  blastema acknowledge --socket /run/robot/base.sock

A device is a component: its proxy passes the order on. --socket names the inspection socket of a node
of this computer, at which the user who runs the node, and root, may order. --via connects to a node by
the network with the key of a node with `role operator`, who is named in the node's log.

Exit status:
  0  it was done
  2  it was not done: the order was refused, which says why; the command line was wrong, or the node
     could not be reached";

const ROBOT_HELP: &str = "\
Examples:
  blastema check ranger.robot.xml
  blastema graph ranger.robot.xml --format dot | dot -Tsvg
  blastema run ranger.robot.xml --set lidar=/dev/pts/7

The exit status is that of the program: 0 it was done, 1 the file has a mistake or the robot did not
run to its end, 2 the command line is wrong or a file cannot be read, 3 a node did not come up.";

/// The shortest and the longest `--within`.
const WITHIN: RangeInclusive<Duration> = Duration::from_millis(10)..=Duration::from_secs(60 * 60);

/// The whole command line.
#[derive(Debug, Parser)]
#[command(
    name = "blastema",
    version,
    about = "Fault-tolerant middleware for robots",
    arg_required_else_help = true
)]
pub(crate) struct Arguments {
    /// What to do.
    #[command(subcommand)]
    pub(crate) subcommand: Subcommand,
}

/// The subcommands of the program.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum Subcommand {
    /// Show the state of a running node
    ///
    /// Its objects with what the monitor thinks of each, the threads that components live on,
    /// links, sessions with other nodes, behaviour trees, global names, services and who serves
    /// them, actuators and who commands them, and faults, as they are now. A node is shown if its
    /// program opens an inspection socket, by `NodeBuilder::inspection_socket`, to the user who
    /// runs it and no other. A value that is not known is a dash; a table that is left out is
    /// empty, and one whose part of the node has not answered says so. Nothing can be changed from
    /// here.
    #[command(after_help = MONITOR_HELP)]
    Monitor(MonitorOptions),
    /// Print what editors of behaviour trees need
    #[command(subcommand)]
    Tree(TreeJob),
    /// Show faults, also those of nodes that have ended
    #[command(subcommand)]
    Fault(FaultJob),
    /// Make and change the keys of a robot's nodes
    ///
    /// A node that has its key seals all its networks that leave the process: without a key of this
    /// robot nothing is heard or, but on CAN, read. Roles and the policy say who may do what.
    ///
    /// ROBOT.robot signs the list of nodes: keep it off the robot, with a copy in a safe place.
    /// NODE.key is the secret of one node. ROBOT.roster is the signed list of all nodes, with their
    /// public keys, their roles and the policy. No secret is ever printed.
    #[command(subcommand)]
    Keys(KeysJob),
    /// Order the nodes of a robot what to do with one of them
    #[command(subcommand)]
    Node(NodeJob),
    /// Order components, devices among them: leave work, return to it, reset, restart
    #[command(subcommand)]
    Component(ComponentJob),
    /// Let others command again after communication was lost, once it is back
    ///
    /// A policy for lost communication that waits for a person goes on with its last step until
    /// then: look at the robot first.
    #[command(after_help = ORDER_HELP)]
    Acknowledge {
        /// The policy; by default each that waits
        policy: Option<String>,
        #[command(flatten)]
        to: OrderOptions,
    },
    /// Write C for the firmware of a microcontroller
    #[command(subcommand)]
    Device(DeviceJob),
    /// Find all mistakes in a robot file, by the robot's program
    #[command(after_help = ROBOT_HELP)]
    Check(RobotOptions),
    /// Print the supervision trees and connections of a robot file, by the robot's program
    #[command(after_help = ROBOT_HELP)]
    Graph(RobotOptions),
    /// Start the nodes of a robot file, by the robot's program
    #[command(after_help = ROBOT_HELP)]
    Run(RobotOptions),
    /// Print the schema of robot files, for editors and xmllint
    Schema,
    /// Write the package of a small robot that builds, runs, and has a test
    New(NewOptions),
}

/// What the program of a robot is given.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct RobotOptions {
    /// The robot file; its attribute `program` names the program, from the folder of the file
    pub(crate) file: PathBuf,
    /// Options of the program, as in `--node base` or `--set rate=20Hz`
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub(crate) more: Vec<OsString>,
}

/// The options of `new`.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct NewOptions {
    /// The folder to make; its name is that of the robot and of its package
    pub(crate) folder: PathBuf,
    /// The folder of Blastema's sources [default: those that this program was built from]
    #[arg(long, value_name = "FOLDER")]
    pub(crate) blastema: Option<PathBuf>,
}

/// The options of the monitor.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct MonitorOptions {
    /// The path of a node's inspection socket; several are shown one after the other
    #[arg(required = true, value_name = "PATH")]
    pub(crate) sockets: Vec<PathBuf>,
    /// Print one JSON document for each node, each on one line, instead of tables: texts are whole
    /// there, spans are in milliseconds (`_ms`), and what is not known is null
    #[arg(long)]
    pub(crate) json: bool,
    /// Wait this long for each node to answer, 10ms to 1h, such as 500ms, 10s or 1m
    #[arg(long, value_name = "DURATION", default_value = "10s", value_parser = parse_within)]
    pub(crate) within: Duration,
}

/// What can be done with behaviour trees.
#[derive(Clone, Copy, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum TreeJob {
    /// Print the TreeNodesModel of the leaves that come with every tree, which Groot2 loads
    ///
    /// A program prints the model with its own leaves by `TreeLeaves::model`.
    Model,
}

/// What can be done with faults.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum FaultJob {
    /// Show the faults that stand, of running nodes or of a journal
    ///
    /// A fault stands until its cause is away: a cable that is out stands although the traffic
    /// takes another path. `service restored after` and `part repaired after` are the two times
    /// from finding it. A journal is what a program keeps by `NodeBuilder::journal`; it can be read
    /// while the node runs, and after it has died. What stood then has ended with the process, and
    /// is shown by --all.
    #[command(after_help = FAULT_LIST_HELP)]
    List(FaultListOptions),
}

/// What can be done with keys.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum KeysJob {
    /// Make a robot's key, a key for each of its nodes, and the signed list of them
    ///
    /// Copy each NODE.key and ROBOT.roster to the node's computer, into one folder. A file that is
    /// there is never overwritten.
    #[command(after_help = KEYS_HELP)]
    New {
        /// The robot's name
        robot: String,
        /// The names of its nodes
        #[arg(required = true, value_name = "NODE")]
        nodes: Vec<String>,
        /// The folder for the files
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
        /// A node's role, where it is not `node`: operator or guest
        #[arg(long = "role", value_name = "NODE=ROLE")]
        roles: Vec<String>,
    },
    /// Show names, roles, fingerprints and serial numbers, and never a secret
    ///
    /// The signature of a list is checked by the robot's public key, which stands in ROBOT.robot
    /// and in each NODE.key: name one of them too.
    #[command(after_help = KEYS_HELP)]
    Show {
        /// Files of robots, nodes and lists; by default all of them in this folder
        #[arg(value_name = "FILE")]
        files: Vec<PathBuf>,
    },
    /// Make keys for further nodes, and list them
    #[command(after_help = KEYS_HELP)]
    Add {
        #[command(flatten)]
        listed: ListedNodes,
        /// A node's role, where it is not `node`: operator or guest
        #[arg(long = "role", value_name = "NODE=ROLE")]
        roles: Vec<String>,
    },
    /// Take nodes off the list, and out of the lines of the policy
    #[command(after_help = KEYS_HELP)]
    Revoke(ListedNodes),
    /// Make new keys for listed nodes; the files of the old ones must be moved away before
    #[command(after_help = KEYS_HELP)]
    Replace(ListedNodes),
    /// Change roles and the policy in an editor ($VISUAL, $EDITOR or vi)
    ///
    /// The text is checked, and signed with the next serial number. Names, keys and the serial
    /// number stay as they are.
    #[command(after_help = KEYS_HELP)]
    Edit {
        #[command(flatten)]
        robot: RobotOption,
        #[command(flatten)]
        push: PushOptions,
        /// Take the changed text from this file instead
        #[arg(long = "from", value_name = "FILE")]
        text: Option<PathBuf>,
    },
    /// Ask the nodes of a running robot for their rosters, keys, and whether networks are sealed
    ///
    /// A roster beside the operator's key that is newer than that of the robot is handed over.
    #[command(after_help = OPERATOR_HELP)]
    Check(KeysCheckOptions),
}

/// Nodes of a robot's list, and whom the changed list is handed over to.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct ListedNodes {
    /// The names of the nodes
    #[arg(required = true, value_name = "NODE")]
    pub(crate) nodes: Vec<String>,
    #[command(flatten)]
    pub(crate) robot: RobotOption,
    #[command(flatten)]
    pub(crate) push: PushOptions,
}

/// Which robot is to be asked for its keys, and how.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct KeysCheckOptions {
    /// The node to connect to, and its address there, such as base@10.0.0.1:7400
    #[arg(value_name = "NODE@ADDRESS", value_parser = parse_node_address)]
    pub(crate) to: NodeAddress,
    #[command(flatten)]
    pub(crate) operator: OperatorOptions,
    /// Print one JSON document instead of a table
    #[arg(long)]
    pub(crate) json: bool,
}

/// What can be ordered of a node.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum NodeJob {
    /// Isolate a node: all others that are reached take nothing from it any more
    ///
    /// Their faults and journals name the operator and the reason. It stands until it is admitted.
    #[command(after_help = OPERATOR_HELP)]
    Isolate(NodeOrderOptions),
    /// Admit an isolated node again
    #[command(after_help = OPERATOR_HELP)]
    Admit(NodeOrderOptions),
}

/// What can be written for a device.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum DeviceJob {
    /// Print the C header of a device's firmware: structs, port numbers, fingerprints
    Header(DescribedDevice),
    /// Print an example of a device's firmware, which compiles and does nothing yet
    Firmware(DescribedDevice),
}

/// A device as data.
#[derive(Clone, Debug, PartialEq, clap::Args)]
pub(crate) struct DescribedDevice {
    /// The JSON of `DeviceSpec::describe`; with `--type`, of `describe` of the robot's program
    pub(crate) file: PathBuf,
    /// The type of devices in a robot file
    #[arg(long = "type", value_name = "TYPE")]
    pub(crate) of_type: Option<String>,
}

/// What can be ordered of components.
#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub(crate) enum ComponentJob {
    /// Show components with their states, and the policies for lost communication
    #[command(after_help = ORDER_HELP)]
    List {
        /// Only this component or policy
        name: Option<String>,
        #[command(flatten)]
        to: OrderOptions,
        /// Print one JSON document instead of a table
        #[arg(long)]
        json: bool,
    },
    /// Have an initialized component return to work
    #[command(after_help = ORDER_HELP)]
    Activate(ComponentOptions),
    /// Have an active component leave work in order: messages wait until it returns
    #[command(after_help = ORDER_HELP)]
    Deactivate(ComponentOptions),
    /// Have a component in error recover by itself
    #[command(after_help = ORDER_HELP)]
    Reset(ComponentOptions),
    /// Start the next incarnation of a component, or of a supervisor with all below it
    #[command(after_help = ORDER_HELP)]
    Restart(ComponentOptions),
}

/// Which component is meant.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct ComponentOptions {
    /// The name of the component
    pub(crate) name: String,
    #[command(flatten)]
    pub(crate) to: OrderOptions,
}

/// Which node is given an order, and how.
#[derive(Args, Clone, Debug, PartialEq)]
#[command(group(ArgGroup::new("to").required(true).args(["socket", "via"])))]
pub(crate) struct OrderOptions {
    /// The path of the node's inspection socket
    #[arg(long, value_name = "PATH")]
    pub(crate) socket: Option<PathBuf>,
    /// A node to connect to by the network, such as base@10.0.0.1:7400
    #[arg(long, value_name = "NODE@ADDRESS", value_parser = parse_node_address)]
    pub(crate) via: Option<NodeAddress>,
    /// The node that is meant, where it is another one than that of --via
    #[arg(long, value_name = "NODE", requires = "via")]
    pub(crate) node: Option<String>,
    #[command(flatten)]
    pub(crate) operator: OperatorOptions,
}

/// Which node is meant, and by way of which one the others are reached.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct NodeOrderOptions {
    /// The name of the node
    pub(crate) node: String,
    /// Another node, to connect to, and its address there, such as base@10.0.0.1:7400
    #[arg(long, value_name = "NODE@ADDRESS", value_parser = parse_node_address)]
    pub(crate) via: NodeAddress,
    #[command(flatten)]
    pub(crate) operator: OperatorOptions,
    /// Why, for the journals: 160 characters of it are kept
    #[arg(long, value_name = "TEXT", default_value = "")]
    pub(crate) reason: String,
}

/// How an operator connects.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct OperatorOptions {
    /// The operator's key, with the roster beside it; by default what BLASTEMA_KEYS names
    #[arg(long, value_name = "FILE")]
    pub(crate) keys: Option<PathBuf>,
    /// The endpoint of the operator's own node, such as tcp://10.0.0.9:7400, where the node that it
    /// connects to describes it; by default a free UDP port
    #[arg(long = "own-endpoint", value_name = "ENDPOINT")]
    pub(crate) from: Option<String>,
    /// Wait so long for the first node, and for each answer, 10ms to 1h
    #[arg(long, value_name = "DURATION", default_value = "10s", value_parser = parse_within)]
    pub(crate) within: Duration,
}

/// Whom a changed roster is handed over to.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct PushOptions {
    /// Hand the changed list over to this node of the running robot, which gives it to the others
    #[arg(long, value_name = "NODE@ADDRESS", value_parser = parse_node_address)]
    pub(crate) push: Option<NodeAddress>,
    #[command(flatten)]
    pub(crate) operator: OperatorOptions,
}

/// A node, and where it is.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct NodeAddress {
    pub(crate) node: String,
    pub(crate) address: String,
}

/// Which robot is meant.
#[derive(Args, Clone, Debug, PartialEq)]
pub(crate) struct RobotOption {
    /// The robot's file; by default the only one in this folder. Keys and the list are written
    /// beside it
    #[arg(long = "robot", value_name = "FILE")]
    pub(crate) file: Option<PathBuf>,
}

/// Which faults are to be shown, and how.
#[derive(Args, Clone, Debug, PartialEq)]
#[command(group(ArgGroup::new("source").required(true).args(["sockets", "journal"])))]
pub(crate) struct FaultListOptions {
    /// The path of a running node's inspection socket; several are shown in one list
    #[arg(value_name = "PATH")]
    pub(crate) sockets: Vec<PathBuf>,
    /// Show also what is over
    #[arg(long)]
    pub(crate) all: bool,
    /// Read this journal instead of running nodes
    #[arg(long, value_name = "FILE")]
    pub(crate) journal: Option<PathBuf>,
    /// Show only what this node has found
    #[arg(long, value_name = "NAME")]
    pub(crate) node: Option<String>,
    /// Print one JSON document instead of a table: texts are whole there
    #[arg(long)]
    pub(crate) json: bool,
    /// Wait so long for each node to answer, 10ms to 1h, such as 500ms, 10s or 1m
    #[arg(long, value_name = "DURATION", default_value = "10s", value_parser = parse_within)]
    pub(crate) within: Duration,
}

fn parse_node_address(text: &str) -> Result<NodeAddress, String> {
    let form = || format!("{text} is no node with its address: write it as base@10.0.0.1:7400");
    let (node, address) = text.split_once('@').ok_or_else(form)?;
    let address = address.strip_prefix("udp://").unwrap_or(address);
    if node.is_empty() || address.is_empty() {
        return Err(form());
    }
    Ok(NodeAddress { node: node.to_owned(), address: address.to_owned() })
}

fn parse_within(text: &str) -> Result<Duration, String> {
    match parse_span(text)? {
        span if WITHIN.contains(&span) => Ok(span),
        _ => Err(format!("{text} is not between 10ms and 1h")),
    }
}

fn parse_span(text: &str) -> Result<Duration, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let millis_of_unit = match unit {
        "ms" => 1,
        "s" => 1_000,
        "m" | "min" => 60_000,
        "h" => 3_600_000,
        "" => return Err(format!("a duration needs its unit: did you mean {text}s?")),
        other => return Err(format!("{other:?} is no unit; write 1500ms, 60s, 5m or 1h")),
    };
    if number.is_empty() {
        return Err(format!("{text:?} does not begin with a whole number"));
    }
    // A number that does not fit is too long, as is the largest one.
    let number: u64 = number.parse().unwrap_or(u64::MAX);
    Ok(Duration::from_millis(number.saturating_mul(millis_of_unit)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(line: &str) -> Result<Subcommand, String> {
        Arguments::try_parse_from(line.split_whitespace())
            .map(|arguments| arguments.subcommand)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn the_definition_holds_together() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn what_is_unknown_is_refused_with_the_nearest_right_spelling() {
        let refusal = parse("blastema monitor --jso /a").expect_err("an unknown flag");

        assert!(refusal.contains("--json"), "{refusal}");
        assert!(parse("blastema dance").is_err());
    }

    #[test]
    fn the_help_tells_what_is_shown_and_the_exit_status() {
        let monitor = Arguments::command().find_subcommand_mut("monitor").map(|monitor| {
            let help = monitor.render_long_help().to_string();
            let parts = [
                "<PATH>...",
                "--json",
                "--within <DURATION>",
                "10ms to 1h",
                "[default: 10s]",
                "inspection_socket",
                "services and who serves them",
                "watch -n 1",
                "Exit status",
                "those named before it were",
                "Nothing can be changed",
            ];
            for part in parts {
                assert!(help.contains(part), "{part} is missing in {help}");
            }
        });
        assert!(monitor.is_some());
    }

    #[test]
    fn the_fault_list_is_that_of_nodes_or_of_a_journal_and_not_of_both() {
        let options = |sockets: &[&str], journal: Option<&str>| FaultListOptions {
            sockets: sockets.iter().map(PathBuf::from).collect(),
            all: false,
            journal: journal.map(PathBuf::from),
            node: None,
            json: false,
            within: Duration::from_secs(10),
        };
        let list = |options| Ok(Subcommand::Fault(FaultJob::List(options)));
        assert_eq!(parse("blastema fault list /a /b"), list(options(&["/a", "/b"], None)));
        let rest = FaultListOptions {
            all: true,
            json: true,
            node: Some("m".to_owned()),
            ..options(&[], Some("/j"))
        };
        assert_eq!(parse("blastema fault list --all --json --node m --journal /j"), list(rest));
        let refusal = parse("blastema fault list").expect_err("no source is named");
        assert!(refusal.contains("PATH") && refusal.contains("--journal"), "{refusal}");
        assert!(parse("blastema fault list /a --journal /j").is_err());
    }

    #[test]
    fn the_monitor_takes_the_paths_of_sockets() {
        let sockets = ["/run/a", "/run/b"].map(PathBuf::from).to_vec();
        let within = Duration::from_secs(10);
        let wanted = MonitorOptions { sockets: sockets.clone(), json: true, within };
        assert_eq!(parse("blastema monitor --json /run/a /run/b"), Ok(Subcommand::Monitor(wanted)));
        let within = Duration::from_millis(500);
        let wanted = MonitorOptions { sockets, json: false, within };
        assert_eq!(
            parse("blastema monitor --within 500ms /run/a /run/b"),
            Ok(Subcommand::Monitor(wanted))
        );
        for (wrong, told) in [("10", "mean 10s?"), ("0s", "10ms and 1h"), ("2h", "10ms and 1h")] {
            let refusal = parse(&format!("blastema monitor /a --within {wrong}")).expect_err(wrong);
            assert!(refusal.contains(told), "{wrong}: {refusal}");
        }
        let refusal = parse("blastema monitor").expect_err("no node is named");
        assert!(refusal.contains("<PATH>"), "{refusal}");
    }
}
