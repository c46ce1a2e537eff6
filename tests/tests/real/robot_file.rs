//! Robots from files, as processes: `run` keeps all nodes, stops them in order, and gives up; keys
//! seal them; `check` and `describe` need no robot.

use blastema_tests::{RobotKeys, free_addresses, until};
use std::fs::{self, Permissions};
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;
use std::time::Duration;

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(120);
/// More lines than a test reads before it ends.
const LINES: usize = 10_000;

/// Where Cargo puts the example, beside the folder of this test.
fn program() -> PathBuf {
    let test = std::env::current_exe().expect("a running program has a path");
    let profile = test.ancestors().nth(2).expect("a test lies in a folder of its profile");
    let program = profile.join("examples/robot");
    assert!(program.exists(), "{} is not built: cargo test -p blastema-tests", program.display());
    program
}

/// A running robot. Dropping it kills the process that was started, with which its nodes end.
struct RunningRobot {
    process: Child,
    lines: Receiver<String>,
    /// What was printed up to now.
    seen: Vec<String>,
    _stdin: Option<ChildStdin>,
}

impl RunningRobot {
    fn start(file: &Path, arguments: &[&str]) -> Self {
        let mut command = Command::new(program());
        command.arg("run").arg(file).args(arguments);
        // The sockets of its processes, where no other robot has any.
        command.env("XDG_RUNTIME_DIR", file.parent().expect("a folder"));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut process = command.spawn().expect("it starts");
        let (printed, lines) = sync_channel(LINES);
        let outputs: [Box<dyn Read + Send>; 2] = [
            Box::new(process.stdout.take().expect("it was asked for")),
            Box::new(process.stderr.take().expect("it was asked for")),
        ];
        for output in outputs {
            let printed = printed.clone();
            thread::spawn(move || {
                for line in BufReader::new(output).lines().map_while(Result::ok) {
                    // The test may have ended.
                    let _ = printed.try_send(line);
                }
            });
        }
        let stdin = process.stdin.take();
        RunningRobot { process, lines, seen: Vec::new(), _stdin: stdin }
    }

    /// Waits for a line with this text.
    fn until(&mut self, text: &str) {
        while !self.seen.last().is_some_and(|line| line.contains(text)) {
            match self.lines.recv_timeout(PATIENCE) {
                Ok(line) => self.seen.push(line),
                Err(error) => panic!("{text:?} did not come: {error}: {:#?}", self.seen),
            }
        }
    }

    /// Waits until each of these texts has been printed, in any order.
    fn until_each(&mut self, texts: &[&str]) {
        for text in texts {
            if !self.seen.iter().any(|line| line.contains(text)) {
                self.until(text);
            }
        }
    }

    fn interrupt(&self) {
        self.signal("-INT");
    }

    fn signal(&self, signal: &str) {
        let id = self.process.id().to_string();
        let status = Command::new("kill").args([signal, &id]).status();
        assert!(status.expect("there is kill").success());
    }

    /// Waits for the end, and returns the exit status.
    fn status(&mut self) -> i32 {
        // Standard output and standard error close when the last process has ended.
        while let Ok(line) = self.lines.recv_timeout(PATIENCE) {
            self.seen.push(line);
        }
        let status = self.process.wait().expect("it was started here");
        status.code().expect("it ended by itself")
    }

    /// The lines with this text, in their order.
    fn lines_with(&self, text: &str) -> Vec<&str> {
        self.seen.iter().map(String::as_str).filter(|line| line.contains(text)).collect()
    }
}

impl Drop for RunningRobot {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A robot of a node that counts and a node that prints, on one network.
fn two_nodes(folder: &Path, more: &str, ends: [&str; 2], display: &str) -> PathBuf {
    let file = folder.join("two.robot.xml");
    let text = format!(
        r#"<robot schema="1" name="ranger">
  <argument name="rate" type="rate" default="20Hz"/>
  <network name="lan" hello-every="20ms" {more}/>
  <node name="left" work-threads="1" {}>
    <component name="counter" type="Counter" rate="${{rate}}"/>
  </node>
  <node name="right" work-threads="1" {}>
    <component name="display" type="Display"><param name="dies_at" value="{display}"/></component>
  </node>
  <connect from="left:counter#count" to="right:display#count"/>
</robot>
"#,
        ends[0], ends[1]
    );
    fs::write(&file, text).expect("it can be written");
    file
}

/// The same with endpoints at these addresses.
fn with_endpoints(file: &Path, ends: [String; 2]) {
    let text = fs::read_to_string(file).expect("it was written");
    let text = text.replacen(
        "    <comp",
        &format!("    <endpoint network=\"lan\" at=\"{}\"/>\n    <comp", ends[0]),
        1,
    );
    let (left, right) = text.split_once("<node name=\"right\"").expect("it is there");
    let right = right.replacen(
        "    <comp",
        &format!("    <endpoint network=\"lan\" at=\"{}\"/>\n    <comp", ends[1]),
        1,
    );
    fs::write(file, format!("{left}<node name=\"right\"{right}")).expect("it can be written");
}

fn unix_ends(folder: &Path) -> [String; 2] {
    ["left", "right"].map(|name| format!("unix://{}/{name}.sock", folder.display()))
}

#[test]
fn all_nodes_run_until_an_interrupt_and_stop_in_reverse_order() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "0");
    with_endpoints(&file, unix_ends(folder.path()));

    let mut robot = RunningRobot::start(&file, &["--set", "rate=50Hz"]);
    robot.until("[right] heard 3");
    robot.interrupt();

    assert_eq!(robot.status(), 0, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with(" ends"), ["[right] display ends", "[left] counter ends"]);
}

#[test]
fn a_robot_whose_output_is_not_read_stops_at_an_interrupt() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "0");
    let ends = unix_ends(folder.path());
    with_endpoints(&file, ends.clone());
    let (_reader, mut writer) = std::io::pipe().expect("a pipe");
    writer.write_all(&[b'\n'; 65_536]).expect("so much fits into a pipe");
    let mut command = Command::new(program());
    command.arg("run").arg(&file).stdin(Stdio::piped()).stdout(writer);
    let mut process = command.spawn().expect("it starts");

    let sockets = ends.map(|end| PathBuf::from(end.trim_start_matches("unix://")));
    blastema::run(async {
        until(async || sockets.iter().all(|socket| socket.exists()), "both nodes are up").await;
        let id = process.id().to_string();
        let status = Command::new("kill").args(["-INT", &id]).status();
        assert!(status.expect("there is kill").success());
        until(async || process.try_wait().is_ok_and(|end| end.is_some()), "it ends").await;
    });
}

#[test]
fn a_second_interrupt_ends_all_nodes_at_once_with_safe_outputs() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("slow.robot.xml");
    let node = |name: &str| {
        format!(
            r#"<node name="{name}" safe-outputs="brakes">
            <component name="slow" type="Slow" shutdown-within="10min"/></node>"#
        )
    };
    let text = format!("<robot schema=\"1\" name=\"r\">{}{}</robot>", node("base"), node("arm"));
    fs::write(&file, text).expect("it can be written");

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until_each(&["[base] slow works", "[arm] slow works"]);
    robot.interrupt();
    robot.until("[arm] slow slows down");
    robot.interrupt();

    assert_eq!(robot.status(), 130, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("the brakes are on").len(), 2, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("a second signal ended the nodes at once").len(), 1);
    assert_eq!(robot.lines_with("slow rests"), [""; 0]);
}

#[test]
fn a_process_that_dies_is_started_again() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "2");
    with_endpoints(&file, unix_ends(folder.path()));

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until("[right] its process ended with exit status: 7, and is started again");
    robot.until("[right] display begins");
    robot.until("[right] heard 1");
}

#[test]
fn a_node_that_dies_too_often_stops_the_robot_with_a_status() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "1");
    with_endpoints(&file, unix_ends(folder.path()));

    let mut robot = RunningRobot::start(&file, &[]);

    assert_eq!(robot.status(), 1, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("[right] its process ended").len(), 3, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("node right: its process ended 4 times in 10s").len(), 1);
    assert_eq!(robot.lines_with("[left] counter ends").len(), 1);
}

#[test]
fn a_process_whose_output_is_held_is_started_again_and_stops() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "3");
    with_endpoints(&file, unix_ends(folder.path()));
    let text = fs::read_to_string(&file).expect("it was written");
    let more = "<param name=\"leaves_process\" value=\"true\"/><param name=\"dies_at\"";
    fs::write(&file, text.replace("<param name=\"dies_at\"", more)).expect("it can be written");

    // So slow that it does not die four times in ten seconds.
    let mut robot = RunningRobot::start(&file, &["--set", "rate=1Hz"]);
    robot.until("[right] its process ended with exit status: 7, and is started again");
    robot.until("[right] display begins");
    robot.interrupt();

    let status = robot.status();
    assert!([0, 3].contains(&status), "{status}: {:#?}", robot.seen);
}

/// A robot of two nodes: a map and a group with these components, and an arm that needs them.
fn composed(folder: &Path, group: &str) -> PathBuf {
    let (file, [base, arm]) = (folder.join("composed.robot.xml"), unix_ends(folder));
    let text = format!(
        r#"<robot schema="1" name="ranger">
  <network name="lan" hello-every="20ms"/>
  <node name="base" work-threads="1">
    <endpoint network="lan" at="{base}"/>
    <component name="map" type="Part"><param name="mass" value="2.5 kg"/></component>
    <supervisor name="drive">
      <component name="wheels" type="Part" depends-on="map"/>
      {group}
    </supervisor>
  </node>
  <node name="arm" work-threads="1">
    <endpoint network="lan" at="{arm}"/>
    <component name="gripper" type="Part" depends-on="base:wheels"/>
  </node>
</robot>
"#
    );
    fs::write(&file, text).expect("it can be written");
    file
}

/// What the parts of a node have printed.
fn steps<'r>(robot: &'r RunningRobot, node: &str) -> Vec<&'r str> {
    let lines = robot.seen.iter().filter_map(|line| line.strip_prefix(node));
    let steps = ["is initialized", "is active", "is inactive", "is finalized"];
    lines.filter(|line| steps.iter().any(|step| line.contains(step))).collect()
}

#[test]
fn components_are_configured_and_start_in_order_and_are_finalized_in_reverse() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let motors = "<component name=\"motors\" type=\"Part\" depends-on=\"wheels\"/>";
    let file = composed(folder.path(), motors);

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until_each(&["[base] motors is active", "[arm] gripper is active"]);
    robot.interrupt();

    // 3 where the signal came before the whole node was up: its start was undone.
    let status = robot.status();
    assert!([0, 3].contains(&status), "{status}: {:#?}", robot.seen);
    let expected = [
        "map is initialized with 2.5 kg",
        "map is active",
        "wheels is initialized with 1 kg",
        "wheels is active",
        "motors is initialized with 1 kg",
        "motors is active",
        "motors is inactive",
        "motors is finalized",
        "wheels is inactive",
        "wheels is finalized",
        "map is inactive",
        "map is finalized",
    ];
    assert_eq!(steps(&robot, "[base] "), expected);
    let of = |text: &str| robot.seen.iter().position(|line| line == text);
    assert!(
        of("[arm] gripper is finalized") < of("[base] motors is inactive"),
        "{:#?}",
        robot.seen
    );
}

#[test]
fn a_robot_whose_first_start_fails_is_undone_with_the_reason() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let group = "<component name=\"broken\" type=\"Broken\" depends-on=\"wheels\"/>\n\
                 <component name=\"motors\" type=\"Part\"/>";
    let file = composed(folder.path(), group);

    let mut robot = RunningRobot::start(&file, &[]);

    assert_eq!(robot.status(), 3, "{:#?}", robot.seen);
    let expected = [
        "map is initialized with 2.5 kg",
        "map is active",
        "wheels is initialized with 1 kg",
        "wheels is active",
        "wheels is inactive",
        "wheels is finalized",
        "map is inactive",
        "map is finalized",
    ];
    assert_eq!(steps(&robot, "[base] "), expected);
    let begun = robot.lines_with("[arm] gripper is active").len();
    assert_eq!(robot.lines_with("[arm] gripper is finalized").len(), begun, "{:#?}", robot.seen);
    let why = robot.lines_with("[base] node base: the node did not come up: drive could not be");
    assert!(why.len() == 1 && why[0].ends_with("it is broken"), "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("is started again"), [""; 0]);
    assert_eq!(robot.lines_with("node base: it did not come up, and the start of").len(), 1);
}

#[test]
fn a_signal_during_the_start_undoes_it_in_reverse_order() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("slow.robot.xml");
    let node = |name: &str, parts: &str| format!("<node name=\"{name}\">{parts}</node>");
    let parts = r#"<component name="map" type="Part"/><component name="wheels" type="Wheels"/>
      <component name="driver" type="Driver"/><component name="late" type="Part"/>"#;
    let base = node("base", parts);
    let both = base.clone() + &node("arm", r#"<component name="gripper" type="Part"/>"#);
    // A node that runs alone, and one that is started by the process that has the signal.
    for (signal, by, nodes, at) in [
        ("-INT", "SIGINT", &base, ""),
        ("-TERM", "SIGTERM", &base, ""),
        ("-INT", "the program", &both, "[base] "),
    ] {
        let text = format!("<robot schema=\"1\" name=\"ranger\">{nodes}</robot>");
        fs::write(&file, text).expect("it can be written");

        let mut robot = RunningRobot::start(&file, &[]);
        robot.until("drive 1");
        robot.signal(signal);

        assert_eq!(robot.status(), 3, "{:#?}", robot.seen);
        let parts = ["map is ", "drive", "wheels", "late"];
        let steps = robot.seen.iter().filter_map(|line| line.strip_prefix(at));
        let steps: Vec<_> =
            steps.filter(|line| parts.iter().any(|part| line.starts_with(part))).collect();
        let expected = [
            "map is initialized with 1 kg",
            "map is active",
            "drive 1",
            "driver is initialized",
            "driver ends",
            "drive 0",
            "wheels ends",
            "map is inactive",
            "map is finalized",
        ];
        assert_eq!(steps, expected, "{signal} {at}");
        let why = format!("{at}node base: {by} ended the node while it started");
        assert_eq!(robot.lines_with(&why).len(), 1, "{:#?}", robot.seen);
    }
}

#[test]
fn a_program_in_a_file_runs_in_its_folder_and_is_started_again_and_stopped_with_its_node() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let script = "#!/bin/sh\ntrap 'echo it stops; exit 0' TERM\necho \"$1 of $WHO\"\n\
                  while [ ! -e end ]; do sleep 0.02; done\nrm end\nexit 3\n";
    fs::write(path("talker"), script).expect("it can be written");
    fs::set_permissions(path("talker"), Permissions::from_mode(0o755)).expect("it is ours");
    let text = r#"<robot schema="1" name="ranger"><node name="base">
  <process name="talker" program="./talker" ready="started">
    <arg value="the voice"/><env name="WHO" value="base"/>
  </process>
  <component name="display" type="Display"/>
</node></robot>"#;
    let file = path("one.robot.xml");
    fs::write(&file, text).expect("it can be written");

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until_each(&["[talker] the voice of base", "display begins"]);
    fs::write(path("end"), "").expect("it can be written");
    robot.until("base:talker: its program ended with exit status 3");
    robot.until("[talker] the voice of base");
    robot.interrupt();
    assert_eq!(robot.status(), 0, "{:#?}", robot.seen);
    assert_eq!(robot.lines_with("[talker] it stops").len(), 1, "{:#?}", robot.seen);
}

#[test]
fn nodes_end_with_the_process_that_started_them() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "0");
    with_endpoints(&file, unix_ends(folder.path()));

    let ended = folder.path().join("ended");
    let text = fs::read_to_string(&file).expect("it was written");
    let more =
        format!("<param name=\"ends_in\" value=\"{}\"/></component>\n  </node>", ended.display());
    let (left, right) = text.rsplit_once("</component>\n  </node>").expect("it is there");
    fs::write(&file, format!("{left}{more}{right}")).expect("it can be written");

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until("[right] heard 1");
    robot.process.kill().expect("it runs");

    for _ in 0..PATIENCE.as_millis() / 10 {
        if ended.exists() {
            return;
        }
        let (_keep, never) = sync_channel::<()>(1);
        let _ = never.recv_timeout(Duration::from_millis(10));
    }
    panic!("a node goes on");
}

#[test]
fn a_sealed_robot_of_two_nodes_runs_from_a_file() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let keys = RobotKeys::new(folder.path(), &["left", "right"], 1);
    let key = |node| format!("keys=\"{}\"", keys.of(node).display());
    let file = two_nodes(folder.path(), "", [&key("left"), &key("right")], "0");
    let addresses = free_addresses(2);
    with_endpoints(&file, [0, 1].map(|at| format!("udp://{}", addresses[at])));

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until("[right] heard 3");
    robot.interrupt();

    assert_eq!(robot.status(), 0, "{:#?}", robot.seen);
}

#[test]
fn what_moves_into_a_process_is_reached_by_its_name_over_its_node_also_sealed() {
    let _turn = blastema_doubles::turn();
    for (is_sealed, is_nested) in [(false, false), (true, false), (false, true)] {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &["left", "right", "eye"], 1);
        let key = |node| match is_sealed {
            true => format!("keys=\"{}\"", keys.of(node).display()),
            false => String::new(),
        };
        let file = two_nodes(folder.path(), "", [&key("left"), &key("right")], "0");
        with_endpoints(&file, unix_ends(folder.path()));
        let text = fs::read_to_string(&file).expect("it was written");
        let counter = r#"<component name="counter" type="Counter" rate="${rate}"/>"#;
        let process = format!("<process name=\"eye\">{counter}</process>");
        let (process, ends) = match is_nested {
            false => (process, "[left] [eye] counter ends"),
            true => {
                let head = format!("<process name=\"head\">{process}</process>");
                (head, "[left] [head] [eye] counter ends")
            }
        };
        fs::write(&file, text.replace(counter, &process)).expect("it can be written");

        let mut robot = RunningRobot::start(&file, &["--set", "rate=50Hz"]);
        robot.until("[right] heard 3");
        robot.interrupt();

        assert_eq!(robot.status(), 0, "{:#?}", robot.seen);
        assert_eq!(robot.lines_with(" ends"), ["[right] display ends", ends]);
    }
}

#[test]
fn a_process_ends_when_a_component_in_it_fails_for_good_and_its_group_answers() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("one.robot.xml");
    let text = r#"<robot schema="1" name="ranger"><node name="base">
  <supervisor name="drive" strategy="rest-for-one">
    <process name="unit" restart="transient">
      <component name="motors" type="Faulty" rate="50Hz"/>
    </process>
    <component name="map" type="Part"><param name="mass" value="2 kg"/></component>
  </supervisor>
</node></robot>"#;
    fs::write(&file, text).expect("it can be written");

    let mut robot = RunningRobot::start(&file, &[]);
    robot.until("map is active");
    robot.until_each(&[
        "[unit] node unit: motors needed more than 3 restarts in 10s",
        "fatal error of base:unit: its program ended with exit status 1",
        "its last STATUS was \"motors needed more than 3 restarts in 10s",
        "map is finalized",
    ]);
    if robot.lines_with("map is active").len() == 1 {
        robot.until("map is active");
    }

    robot.interrupt();
    robot.status();
}

fn run(arguments: &[&str]) -> Output {
    Command::new(program()).args(arguments).output().expect("it starts")
}

#[test]
fn far_nodes_are_started_one_by_one_and_the_error_lists_them() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "insecure=\"true\"", ["", ""], "0");
    with_endpoints(&file, ["10.9.8.7", "10.9.8.6"].map(|host| format!("udp://{host}:7400")));

    let output = run(&["run", &file.display().to_string()]);

    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("--node NAME`; the nodes are left, right"), "{text}");
}

#[test]
fn check_graph_and_describe_say_what_there_is() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let file = two_nodes(folder.path(), "", ["", ""], "many");
    with_endpoints(&file, unix_ends(folder.path()));
    let file = file.display().to_string();
    let text = |output: &Output| String::from_utf8_lossy(&output.stdout).into_owned();

    let checked = run(&["check", &file]);
    let errors = String::from_utf8_lossy(&checked.stderr);
    assert_eq!(checked.status.code(), Some(1), "{errors}");
    assert!(errors.contains("two.robot.xml:10:") && errors.contains("`many`"), "{errors}");
    assert_eq!(run(&["check", "/nowhere.xml"]).status.code(), Some(2));
    let full = fs::File::options().write(true).open("/dev/full").expect("Linux has it");
    let described = Command::new(program()).arg("describe").stdout(full).output();
    let described = described.expect("it starts");
    let errors = String::from_utf8_lossy(&described.stderr);
    assert_eq!(described.status.code(), Some(1), "{errors}");
    assert!(errors.starts_with("standard output cannot be written: "), "{errors}");

    fs::write(&file, fs::read_to_string(&file).unwrap().replace("many", "0")).unwrap();
    let drawn = run(&["graph", &file, "--format", "dot"]);
    assert!(text(&drawn).contains("\"left:counter\" -> \"right:display\" [label=\"count\"];"));

    let types: serde_json::Value = serde_json::from_str(&text(&run(&["describe"]))).unwrap();
    assert_eq!(types["types"]["Display"]["parameters"][0]["name"], "dies_at");
    assert_eq!(types["types"]["Display"]["gives"], "not declared");
    assert_eq!(types["types"]["Counter"]["gives"][0]["name"], "count");
}
