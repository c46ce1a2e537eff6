//! The paper's robot with its motors as a component, and as a process by moving one element.

use super::examples::program;
use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(120);

struct Running {
    process: Child,
    lines: Receiver<String>,
    seen: Vec<String>,
}

impl Running {
    /// Its sockets are in this folder, where no other robot has any.
    fn start(file: &Path, folder: &Path) -> Self {
        let mut command = Command::new(program("paper_robot"));
        command.arg("run").arg(file).env("XDG_RUNTIME_DIR", folder);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut process = command.spawn().expect("it starts");
        let (printed, lines) = channel();
        let outputs: [Box<dyn Read + Send>; 2] = [
            Box::new(process.stdout.take().expect("it was asked for")),
            Box::new(process.stderr.take().expect("it was asked for")),
        ];
        for output in outputs {
            let printed = printed.clone();
            thread::spawn(move || {
                for line in BufReader::new(output).lines().map_while(Result::ok) {
                    // The test may have ended.
                    let _ = printed.send(line);
                }
            });
        }
        Running { process, lines, seen: Vec::new() }
    }

    /// Waits for lines with each of these texts, in any order.
    fn until(&mut self, texts: &[&str]) {
        let mut missing: BTreeSet<&str> = texts.iter().copied().collect();
        while !missing.is_empty() {
            match self.lines.recv_timeout(PATIENCE) {
                Ok(line) => {
                    missing.retain(|text| !line.contains(text));
                    self.seen.push(line);
                }
                Err(error) => panic!("{missing:?} did not come: {error}: {:#?}", self.seen),
            }
        }
    }

    /// Ends it in order.
    fn end(mut self) {
        signal("-TERM", self.process.id());
        let status = self.process.wait().expect("it was started here");
        assert!(status.success(), "{status}: {:#?}", self.seen);
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn signal(signal: &str, process: u32) {
    let sent = Command::new("kill").args([signal, &process.to_string()]).status();
    assert!(sent.expect("there is kill").success());
}

/// The processes of this node of the robot of this file.
fn processes(file: &Path, node: &str) -> Vec<u32> {
    let mut found = Vec::new();
    for entry in fs::read_dir("/proc").expect("Linux lists processes").flatten() {
        let Ok(id) = entry.file_name().to_string_lossy().parse() else { continue };
        let words = fs::read(entry.path().join("cmdline")).unwrap_or_default();
        let words: Vec<_> = words.split(|byte| *byte == 0).map(String::from_utf8_lossy).collect();
        // The program itself, and not its launcher.
        let is_robots =
            words.get(1..3).is_some_and(|words| words == ["run", &file.to_string_lossy()]);
        if is_robots && words.windows(2).any(|pair| pair == ["--node", node]) {
            found.push(id);
        }
    }
    found
}

#[test]
fn the_motors_are_a_process_by_moving_one_element_and_their_group_restarts_with_it() {
    let _turn = blastema_doubles::turn();
    let paper = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/paper.robot.xml");
    let paper = fs::read_to_string(paper).expect("it is there");
    let begin = paper.find(r#"<component name="motors""#).expect("the motors");
    let end = begin + paper[begin..].find("</component>").expect("their end") + 12;
    let motors = &paper[begin..end];
    let process = format!(r#"<process name="drive_unit" watchdog="2s">{motors}</process>"#);
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("paper.robot.xml");

    fs::write(&file, &paper).expect("a folder");
    let mut robot = Running::start(&file, folder.path());
    robot.until(&["laser starting", "the motors drive"]);
    assert!(processes(&file, "drive_unit").is_empty());
    robot.end();

    fs::write(&file, paper.replace(motors, &process)).expect("a folder");
    let mut robot = Running::start(&file, folder.path());
    robot.until(&[
        "[drive_unit] motors starting",
        "laser starting",
        "[drive_unit] the motors drive",
    ]);
    for cause in ["-KILL", "-ABRT", "-STOP"] {
        let struck = processes(&file, "drive_unit");
        struck.iter().for_each(|process| signal(cause, *process));
        // All for one: what commands the motors begins again with them.
        robot.until(&["local_pp starting", "global_pp starting", "[drive_unit] motors starting"]);
        robot.until(&["[drive_unit] the motors drive"]);
        let now = processes(&file, "drive_unit");
        assert!(!now.is_empty() && now.iter().all(|process| !struck.contains(process)));
    }
    let others = robot.seen.iter().filter(|line| line.contains("laser starting"));
    assert_eq!(others.count(), 1, "the rest of the robot goes on: {:#?}", robot.seen);
    robot.end();
    let (_sender, never) = channel::<()>();
    let deadline = Instant::now() + PATIENCE;
    while !processes(&file, "drive_unit").is_empty() {
        assert!(Instant::now() < deadline, "the process outlives the robot");
        let _ = never.recv_timeout(Duration::from_millis(20));
    }
}
