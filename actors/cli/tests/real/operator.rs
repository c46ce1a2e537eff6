//! The program as operator of a robot that runs: it checks keys, hands a changed roster over, and
//! isolates a node.

use blastema::prelude::*;
use blastema::{ComponentOrder, DeliveryError, Lifecycle, Network, OrderVerb};
use serde_json::Value;
use std::fs;
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);
const NODES: [&str; 2] = ["base", "arm"];

/// A robot whose nodes run in this process, each with a folder, and the operator's folder.
struct Robot {
    builder: TempDir,
    folders: [TempDir; 2],
    at: [SocketAddr; 2],
}

impl Robot {
    fn new() -> Self {
        let folder = || tempfile::tempdir().expect("a folder");
        let sockets = NODES.map(|_| UdpSocket::bind("127.0.0.1:0").expect("a free port"));
        let at = sockets.map(|socket| socket.local_addr().expect("it is bound"));
        let robot = Robot { builder: folder(), folders: NODES.map(|_| folder()), at };
        let new = ["keys", "new", "ranger", "base", "arm", "laptop", "--role", "laptop=operator"];
        assert_eq!(run_in(robot.builder.path(), &new).0, Some(0));
        for (node, folder) in NODES.iter().zip(&robot.folders) {
            for file in [format!("{node}.key"), "ranger.roster".to_owned()] {
                let from = robot.builder.path().join(&file);
                fs::copy(from, folder.path().join(file)).expect("a folder");
            }
        }
        robot
    }

    async fn start(&self, own: usize) -> Node {
        self.node(own).start().await.expect("it starts")
    }

    fn node(&self, own: usize) -> blastema::NodeBuilder {
        let keys = self.folders[own].path().join(format!("{}.key", NODES[own]));
        let network = Network::new("lan", &format!("udp://{}", self.at[own]));
        let network = network.peer(NODES[1 - own], &self.at[1 - own].to_string());
        let node = Node::builder(NODES[own]).keys(keys).network(network);
        node.journal(self.journal(own))
    }

    fn journal(&self, own: usize) -> PathBuf {
        self.folders[own].path().join("faults")
    }

    /// Runs the program in the folder of the robot's builder, with `{base}` as the base's address.
    async fn run(&self, arguments: &str) -> (Option<i32>, String) {
        let base = format!("base@{}", self.at[0]);
        let arguments = arguments.replace("{base}", &base);
        let folder = self.builder.path().to_owned();
        let ran = tokio::task::spawn_blocking(move || {
            let words: Vec<&str> = arguments.split_whitespace().collect();
            run_in(&folder, &words)
        });
        ran.await.expect("no panic")
    }
}

fn run_in(folder: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_blastema"))
        .args(arguments)
        .current_dir(folder)
        .env_remove("BLASTEMA_KEYS")
        .output()
        .expect("the program can be started");
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).expect("text"))
}

#[test]
fn the_keys_of_a_robot_are_checked_and_a_changed_roster_is_handed_over() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new();
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        assert!(base.connected("arm", PATIENCE).await);

        let (status, text) = robot.run("keys check {base} --keys laptop.key --within 60s").await;
        assert_eq!(status, Some(0), "{text}");
        assert!(text.starts_with("robot ranger, newest roster 1\n"), "{text}");
        assert_eq!(text.matches("lan sealed").count(), 2, "{text}");

        let push = "keys add gripper --push {base} --keys laptop.key --within 60s";
        let (status, text) = robot.run(push).await;
        assert_eq!(status, Some(0), "{text}");
        assert!(text.ends_with("base has roster 2, and gives it to the others\n"), "{text}");
        let there = robot.folders[0].path().join("ranger.roster");
        let there = fs::read_to_string(there).expect("it is there");
        assert!(there.contains("serial  2\n") && there.contains("gripper"), "{there}");

        let check = "keys check {base} --keys laptop.key --within 60s --json";
        let (status, text) = robot.run(check).await;
        assert_eq!(status, Some(1), "the gripper is off: {text}");
        let shown: Value = serde_json::from_str(&text).expect("a document");
        assert_eq!(
            (&shown["robot"], &shown["serial"], &shown["well"]),
            (&"ranger".into(), &2.into(), &false.into())
        );
        let rows = shown["nodes"].as_array().expect("a list");
        let names: Vec<_> = rows.iter().map(|row| row["node"].as_str().unwrap()).collect();
        assert_eq!(names, ["base", "arm", "gripper"]);
        for row in &rows[..2] {
            assert_eq!((&row["serial"], &row["problem"]), (&2.into(), &Value::Null), "{text}");
            assert_eq!(row["networks"][0]["sealed"], true);
        }
        assert_eq!(rows[2]["reached"], false);
        for node in [base, arm] {
            node.shutdown().await;
        }
    });
}

#[test]
fn a_node_is_isolated_and_admitted_by_the_operator_of_the_command_line() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new();
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        assert!(base.connected("arm", PATIENCE).await);

        let order = "node isolate arm --via {base} --keys laptop.key --within 60s --reason smoke";
        let (status, text) = robot.run(order).await;
        assert_eq!((status, text.as_str()), (Some(0), "base: isolates arm\n"));
        let faults = base.faults().await.entries;
        let is_named = faults.iter().any(|entry| {
            entry.stands() && entry.fault.detail.contains("by order of laptop: smoke")
        });
        assert!(is_named, "{faults:?}");

        let order = "node admit arm --via {base} --keys laptop.key --within 60s";
        let (status, text) = robot.run(order).await;
        assert_eq!((status, text.as_str()), (Some(0), "base: admits arm\n"));
        assert!(base.connected("arm", PATIENCE).await);
        for node in [base, arm] {
            node.shutdown().await;
        }
        let (status, text) = run_in(
            robot.folders[0].path(),
            &["fault", "list", "--all", "--json", "--journal", "faults"],
        );
        assert_eq!(status, Some(0), "{text}");
        assert!(text.contains("by order of laptop: smoke"), "the journal says who: {text}");
    });
}

#[derive(Clone, Debug, Event)]
struct Jam;

/// In error after each jam, until a person resets it.
struct Gripper;

impl Component for Gripper {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Jam>();
    }
}

impl Handle<Jam> for Gripper {
    async fn handle(&mut self, _: Jam, cx: &mut Context<Self>) {
        cx.fail("it is jammed");
    }
}

#[test]
fn a_component_is_ordered_at_the_inspection_socket_and_with_an_operators_key() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new();
        let waits =
            Plan::default().on(FaultKind::ErrorState, Ladder::first(RecoveryAction::Observe));
        let gripper = ChildSpec::new("gripper", || Gripper);
        let arm = robot
            .node(1)
            .plan(waits)
            .child(gripper)
            .inspection_socket(robot.builder.path().join("arm.sock"));
        let (base, arm) = (robot.start(0).await, arm.start().await.expect("it starts"));
        assert!(base.connected("arm", PATIENCE).await);
        let state = || arm.actor::<Gripper>("gripper").expect("it is there").state();
        let jam = async || {
            arm.sender::<Jam>("gripper").expect("it is there").tell(Jam).expect("it is taken");
            while state() != Lifecycle::Error {
                blastema::sleep(Duration::from_millis(5)).await;
            }
        };
        let by_network = "--via {base} --node arm --keys laptop.key --within 60s";
        for (to, count) in [("--socket arm.sock", 1), (by_network, 2)] {
            let check = async |order: &str, expected: i32, words: &[&str]| {
                let (status, text) = robot.run(&order.replace("{to}", to)).await;
                assert_eq!(status, Some(expected), "{order}: {text}");
                assert!(words.iter().all(|word| text.contains(word)), "{order}: {text}");
            };
            check("component list {to}", 0, &["gripper", "Gripper", "active"]).await;
            check("component list {to} --json", 0, &["\"name\":\"gripper\"", "\"active\""]).await;
            check("component activate gripper {to}", 2, &["gripper: it is active already"]).await;
            check("component deactivate gripper {to}", 0, &["gripper: initialized in"]).await;
            assert_eq!(state(), Lifecycle::Initialized);
            check("component reset gripper {to}", 2, &["only a component in error"]).await;
            check("component activate gripper {to}", 0, &["gripper: active in"]).await;
            assert_eq!(state(), Lifecycle::Active);

            jam().await;
            check("component list gripper {to}", 0, &["error", "it is jammed"]).await;
            check("component activate gripper {to}", 2, &["it is in error: reset it"]).await;
            check("component reset gripper {to}", 0, &["gripper: active in"]).await;
            let restarted = format!("gripper: active in incarnation {}", count + 1);
            check("component restart gripper {to}", 0, &[&restarted]).await;

            check("component restart griper {to}", 2, &["griper", "did you mean `gripper`?"]).await;
            check("component activate griper {to}", 2, &["did you mean `gripper`?"]).await;
            check("acknowledge {to}", 2, &["no policy for lost communication holds"]).await;
            check("acknowledge home {to}", 2, &["it has none"]).await;
        }
        let refused = async |order: &str, words: &[&str]| {
            let (status, text) = robot.run(order).await;
            assert_eq!(status, Some(2), "{order}: {text}");
            assert!(words.iter().all(|word| text.contains(word)), "{order}: {text}");
        };
        refused("component list", &["--socket <PATH>", "--via <NODE@ADDRESS>"]).await;
        refused("component list --via {base}", &["name it by --keys FILE"]).await;
        refused("component list --socket ar.sock", &["nothing is there: start the node"]).await;
        // A node of the robot that is no operator.
        let base_order = ComponentOrder { verb: OrderVerb::Restart, name: Some("gripper".into()) };
        let forbidden = base.order_at("arm", base_order, PATIENCE).await;
        assert!(matches!(forbidden, Err(DeliveryError::Forbidden { .. })), "{forbidden:?}");
        for node in [base, arm] {
            node.shutdown().await;
        }
    });
}

#[test]
fn what_cannot_be_done_says_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new();
        let check = async |arguments: &str, expected: i32, words: &[&str]| {
            let (status, text) = robot.run(arguments).await;
            assert_eq!(status, Some(expected), "{arguments}: {text}");
            assert!(words.iter().all(|word| text.contains(word)), "{arguments}: {text}");
        };

        check("keys check {base}", 2, &["name it by --keys FILE, or by BLASTEMA_KEYS"]).await;
        check("keys check 10.0.0.1:7400 --keys laptop.key", 2, &["write it as base@10.0"]).await;
        check("keys check leg@10.0.0.1:7400 --keys laptop.key", 2, &["lists base, arm"]).await;
        let silent = "keys check {base} --keys laptop.key --within 500ms";
        check(silent, 2, &["base has not answered at 127.0.0.1", "check the address"]).await;
        let guest = "keys check {base} --keys arm.key --within 500ms";
        check(guest, 2, &["arm is no operator in roster 1", "`role operator`"]).await;
        let oneself = "node isolate base --via {base} --keys laptop.key";
        check(oneself, 2, &["connect to another node by --via"]).await;
        let unknown = "node isolate leg --via {base} --keys laptop.key";
        check(unknown, 2, &["leg is not in the roster, which lists base, arm"]).await;

        // The command line is wrong: nothing was changed.
        check("keys add gripper --push {base}", 2, &["name it by --keys FILE"]).await;
        let roster = || fs::read_to_string(robot.builder.path().join("ranger.roster")).unwrap();
        assert!(roster().contains("serial  1\n"));
        // The robot is off: the list was changed.
        let push = "keys add gripper --push {base} --keys laptop.key --within 500ms";
        check(push, 1, &["was changed and signed", "`blastema keys check base@", "hands it over"])
            .await;
        assert!(roster().contains("serial  2\n"));
    });
}

#[test]
fn the_help_says_what_an_operator_needs() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    for command in
        [&["keys", "check"][..], &["node", "isolate"], &["node", "admit"], &["component", "reset"]]
    {
        let (status, help) = run_in(folder.path(), &[command, &["--help"]].concat());
        assert_eq!(status, Some(0));
        for part in ["role operator", "--own-endpoint", "Exit status", "--keys <FILE>"] {
            assert!(help.contains(part), "{part} is missing in\n{help}");
        }
    }
}
