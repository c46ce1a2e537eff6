//! The demonstration on real processes: its promises, and that it leaves nothing behind.
//!
//! These tests wait in real time: processes do not run in virtual time.

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// A run of the program with a folder for its temporary files, so that what it leaves is seen.
struct Run {
    child: Option<Child>,
    id: u32,
    folder: TempDir,
}

impl Run {
    fn start(arguments: &[&str]) -> Run {
        let folder = tempfile::tempdir().expect("a folder can be made");
        let child = Command::new(env!("CARGO_BIN_EXE_blastema-demo"))
            .args(arguments)
            .env("TMPDIR", folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program can be started");
        Run { id: child.id(), child: Some(child), folder }
    }

    fn output(&mut self) -> Output {
        let child = self.child.take().expect("a run ends once");
        child.wait_with_output().expect("the program can be waited for")
    }

    /// The lines of standard output until its end.
    fn lines(&mut self) -> impl Iterator<Item = String> + use<> {
        let child = self.child.as_mut().expect("a run ends once");
        let stdout = child.stdout.take().expect("standard output is piped");
        BufReader::new(stdout).lines().map(|line| line.expect("text"))
    }

    fn signal(&self, signal: Signal) {
        let child = self.child.as_ref().expect("a run ends once");
        kill_process(Pid::from_child(child), signal).expect("it is ours");
    }

    /// The processes that run the modules of this director. Their launchers, whose first argument is
    /// an order, are none.
    fn modules(&self) -> Vec<(Pid, String)> {
        let director = format!("--director\0{}\0", self.id);
        let processes = fs::read_dir("/proc").expect("there is a /proc").flatten();
        let lines = processes.filter_map(|entry| {
            let number = entry.file_name().to_str()?.parse().ok()?;
            let line = fs::read(entry.path().join("cmdline")).ok()?;
            Some((Pid::from_raw(number)?, String::from_utf8_lossy(&line).into_owned()))
        });
        lines
            .filter(|(_, line)| {
                line.contains(&director) && line.split('\0').nth(1) == Some("module")
            })
            .collect()
    }

    /// The process that runs this module.
    fn process_of(&self, module: &str) -> Pid {
        let name = format!("--name\0{module}\0");
        let found = self.modules().into_iter().find(|(_, line)| line.contains(&name));
        found.expect("the module's process is there").0
    }

    fn await_modules(&self, count: usize) {
        await_that(&format!("{count} modules"), || self.modules().len() == count);
    }

    fn assert_nothing_is_left(&self) {
        await_that("no module", || self.modules().is_empty());
        await_that("no folder", || names_in(self.folder.path()).is_empty());
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            // The test has failed already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn names_in(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("the folder is there").flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

fn await_that(what: &str, holds: impl Fn() -> bool) {
    let due = Instant::now() + Duration::from_secs(60);
    while !holds() {
        assert!(Instant::now() < due, "{what}: not within 60 s");
        sleep(Duration::from_millis(20));
    }
}

#[test]
fn the_robot_recovers_from_every_fault_of_the_story_and_leaves_nothing_behind() {
    let _turn = blastema_doubles::turn();
    let mut run = Run::start(&["--json"]);
    let output = run.output();

    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    let report: Value = serde_json::from_str(&text).unwrap_or_else(|error| {
        panic!("no document: {error}\n{text}\n{errors}");
    });
    let rows = report["rows"].as_array().expect("there are rows");
    assert_eq!(rows.len(), 10, "{text}");
    for row in rows {
        assert_eq!(row["problems"], Value::Array(vec![]), "{row}");
        assert!(row["named"]["code"].is_string(), "{row}");
        assert!(row["detected_after_ms"].is_number(), "{row}");
        assert!(row["recovered_after_ms"].is_number(), "{row}");
    }
    assert_eq!(report["messages"]["lost"], 0, "{text}");
    assert_eq!(report["messages"]["doubled"], 0, "{text}");
    assert!(report["received"].as_u64() > Some(100), "{text}");
    // On a busy machine an answer may take longer than one pair of modules waits.
    let latencies = report["latencies"].as_array().expect("there are latencies");
    let times: Option<u64> = latencies.iter().map(|row| row["count"].as_u64()).sum();
    assert!(times > Some(0), "{text}");
    assert_eq!(report["promises_kept"], true, "{text}");
    assert_eq!(output.status.code(), Some(0), "{errors}");
    run.assert_nothing_is_left();
}

#[test]
fn a_signal_ends_all_processes_and_says_so() {
    let _turn = blastema_doubles::turn();
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let mut run = Run::start(&[]);
        run.await_modules(3);

        run.signal(signal);
        let output = run.output();

        assert_eq!(output.status.code(), Some(2), "{signal:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("interrupted by"), "{signal:?}");
        run.assert_nothing_is_left();
    }
}

#[test]
fn no_module_outlives_a_director_that_is_killed() {
    let _turn = blastema_doubles::turn();
    let mut run = Run::start(&[]);
    run.await_modules(3);

    run.signal(Signal::KILL);
    run.output();

    run.assert_nothing_is_left();
}

#[test]
fn a_module_that_is_stopped_for_good_is_restarted_and_the_run_ends_as_broken() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let mut run = Run::start(&[]);
    // Before the first fault is injected, a stopped module only delays the start.
    let mut lines = run.lines();
    let first = lines.by_ref().find(|line| line.contains("1 of 10"));
    assert!(first.is_some(), "no fault was injected");
    kill_process(run.process_of("module2"), Signal::STOP).expect("it is ours");

    let rest: Vec<_> = lines.collect();
    let output = run.output();

    let text = rest.join("\n");
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("module2 ended by itself"), "{text}");
    assert!(text.contains("module2 is ready"), "it was not restarted: {text}");
    run.assert_nothing_is_left();
}

#[test]
fn without_what_it_needs_it_says_so_and_is_not_run() {
    let _turn = blastema_doubles::turn();
    let program = env!("CARGO_BIN_EXE_blastema-demo");
    let line = format!("ulimit -n 30; exec {program}");
    let output = Command::new("sh").args(["-c", &line]).output().expect("there is a shell");

    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(errors.contains("may open 30 files") && errors.contains("ulimit -n 96"), "{errors}");
}

#[test]
fn a_wrong_command_line_is_refused() {
    let _turn = blastema_doubles::turn();
    for arguments in [&["--for", "60"][..], &["--jsn"], &["dance"]] {
        let output = Run::start(arguments).output();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(output.stdout.is_empty(), "{arguments:?}");
    }
}

#[test]
fn a_module_without_the_folder_of_a_run_says_so() {
    let _turn = blastema_doubles::turn();
    let arguments = ["module", "--name", "module1", "--director", "1", "--folder", "/nonexistent"];
    let output = Run::start(&arguments).output();

    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/nonexistent/robot.xml"));
}
