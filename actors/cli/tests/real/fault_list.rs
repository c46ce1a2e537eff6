//! The program reads the faults of running nodes, and of nodes that were killed.

use blastema::prelude::*;
use blastema::{FaultEvent, FaultTransition};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::time::{Duration, Instant};

/// For a process to start on a busy computer.
const TIMEOUT: Duration = Duration::from_secs(60);
/// What is wrong with the gripper for as long as it runs.
const WORN: &str = "GRIP";

/// Panics when it is started first, and then finds that it is worn.
struct Gripper;

impl Component for Gripper {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        assert!(cx.incarnation().0 > 1, "the finger is gone");
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.declare_fault(FaultKind::Custom(WORN.into()), "4 mm of 5 mm");
        Ok(())
    }
}

fn robot(name: &str) -> blastema::NodeBuilder {
    let worn = FaultKind::Custom(WORN.into());
    Node::builder(name)
        .work_threads(1)
        .fault_kind(WORN)
        .plan(Plan::default().on(worn, Ladder::first(RecoveryAction::Observe)))
        .child(ChildSpec::new("gripper", || Gripper))
}

/// In which folder the process that this test starts from itself keeps its journal and shows its
/// node.
const FOLDER: &str = "BLASTEMA_TEST_FOLDER";
/// Whether that process has a subscriber for its log.
const LOGS: &str = "BLASTEMA_TEST_LOGS";
/// How that process ends; it runs until its node has ended, where nothing is said.
const END: &str = "BLASTEMA_TEST_END";

#[test]
fn a_process_keeps_a_journal() {
    let Some(folder) = std::env::var_os(FOLDER).map(PathBuf::from) else { return };
    blastema::platform::end_with_parent(std::os::unix::process::parent_id()).expect("it has one");
    if std::env::var_os(LOGS).is_some() {
        let kept_by_nobody = tracing::subscriber::NoSubscriber::new();
        tracing::subscriber::set_global_default(kept_by_nobody).expect("it is the first");
    }
    blastema::run(async {
        let node = robot("module1")
            .journal(folder.join("faults"))
            .inspection_socket(folder.join("socket"));
        let node = node.start().await.expect("it starts");
        match std::env::var(END).as_deref() {
            Ok("shutdown") => node.shutdown().await,
            Ok("drop") => drop(node),
            Ok("panic") => panic!("the map is upside down"),
            Ok("until signal") => node.run_until_signal().await.expect("signals are told"),
            _ => {
                node.ended().await;
            }
        }
    });
}

/// A process that is killed at the latest when the test ends.
struct Robot(Child);

impl Robot {
    fn start(folder: &Path) -> Self {
        Robot::start_with(folder, &[])
    }

    fn start_with(folder: &Path, more: &[(&str, &str)]) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let child = Command::new(program)
            .args(["--exact", "fault_list::a_process_keeps_a_journal", "--nocapture"])
            .env(FOLDER, folder)
            .envs(more.iter().copied())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        Robot(child.expect("the test can be started again"))
    }

    /// Sends it a signal, if one is named, and waits until it has ended.
    fn end(mut self, signal: Option<&str>) {
        if let Some(signal) = signal {
            let sent = Command::new("kill").args([signal, &self.0.id().to_string()]).status();
            assert!(sent.expect("there is kill").success());
        }
        self.0.wait().expect("it was started here");
    }

    /// As `kill -9` does. Answers what it had printed on standard error.
    fn kill(mut self) -> Vec<String> {
        self.0.kill().expect("it still runs");
        self.0.wait().expect("it was started here");
        let printed = self.0.stderr.take().expect("it was piped");
        BufReader::new(printed).lines().map_while(Result::ok).collect()
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        // It may have been killed already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn list(arguments: &[&str]) -> Output {
    let mut program = Command::new(env!("CARGO_BIN_EXE_blastema"));
    program.args(["fault", "list"]).args(arguments).output().expect("the program can be started")
}

/// The rows of the list: kind and status.
fn rows(arguments: &[&str]) -> Vec<(String, String)> {
    let output = list(&[&["--json"], arguments].concat());
    if !output.status.success() {
        return Vec::new();
    }
    let rows: Vec<Value> = serde_json::from_slice(&output.stdout).expect("a JSON document");
    let text = |row: &Value, key: &str| row[key].as_str().expect("a text").to_owned();
    rows.iter().map(|row| (text(row, "code"), text(row, "status"))).collect()
}

fn until(so: impl Fn() -> bool) {
    let begun = Instant::now();
    while !so() {
        assert!(begun.elapsed() < TIMEOUT, "it takes no such time");
        // Each look starts a program: without a pause it would be this that loads the computer.
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn pairs(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
    pairs.iter().map(|(code, status)| ((*code).to_owned(), (*status).to_owned())).collect()
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of letters")
}

#[test]
fn faults_outlive_a_killed_process_and_those_that_stood_have_ended_with_it() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let (journal, socket) = (folder.path().join("faults"), folder.path().join("socket"));
    let (journal, socket) = (text(&journal), text(&socket));
    let robot = Robot::start(folder.path());

    let stands = pairs(&[(WORN, "open")]);
    let both = pairs(&[("B01", "closed"), (WORN, "open")]);
    until(|| rows(&["--journal", journal]) == stands);
    assert_eq!(rows(&["--all", "--journal", journal]), both);
    assert_eq!(rows(&[socket]), stands, "the node shows the same");
    assert_eq!(rows(&["--all", socket]), both);
    for source in [&["--journal", journal][..], &[socket]] {
        let misspelt = list(&[&["--node", "module2", "--all"], source].concat());
        assert!(!misspelt.status.success());
        let said = String::from_utf8_lossy(&misspelt.stderr);
        assert!(said.contains("module2") && said.contains("module1"), "{said}");
    }
    robot.kill();

    assert_eq!(rows(&["--journal", journal]), [], "nothing of it stands any more");
    let ended = pairs(&[("B01", "closed"), (WORN, "ended with the process")]);
    assert_eq!(rows(&["--all", "--journal", journal]), ended);
    let _robot = Robot::start(folder.path());
    until(|| rows(&["--journal", journal]) == stands);
    assert_eq!(rows(&["--all", "--journal", journal]), [ended, both].concat());

    let table = String::from_utf8(list(&["--all", "--journal", journal]).stdout).expect("text");
    for part in ["found", "module1:gripper", "the finger is gone", "4 mm of 5 mm", "ended with"] {
        assert!(table.contains(part), "{part} is missing in\n{table}");
    }
}

#[test]
fn the_last_entry_of_a_run_says_when_and_why_the_node_ended() {
    let _turn = blastema_doubles::turn();
    let cases = [
        ("shutdown", None, "shut it down"),
        ("drop", None, "dropped while it"),
        ("panic", None, "dropped by a panic while it"),
        ("until signal", Some("-TERM"), "SIGTERM"),
        ("", Some("-TERM"), "SIGTERM"),
        ("", Some("-INT"), "SIGINT"),
    ];
    for (how, signal, why) in cases {
        let folder = tempfile::tempdir().expect("a folder");
        let journal = folder.path().join("faults");
        let robot = Robot::start_with(folder.path(), &[(END, how)]);
        if signal.is_some() {
            // It runs, and handles signals.
            until(|| rows(&["--journal", text(&journal)]) == pairs(&[(WORN, "open")]));
        }
        robot.end(signal);

        let entries = blastema::journal::read(&journal).expect("it is a journal");
        let end = entries.last().expect("it has an entry");
        assert_eq!(end.code, blastema::journal::NODE_ENDED, "{how} {signal:?}: {entries:?}");
        assert!(end.detail.contains(why), "{how} {signal:?}: {end:?}");
        let later = entries.iter().all(|entry| entry.found_at <= end.found_at);
        assert!(later && !end.status.stands(), "{entries:?}");
        let all = rows(&["--all", "--journal", text(&journal)]);
        assert!(all.ends_with(&pairs(&[("B00", "closed")])), "{all:?}");
    }
}

#[test]
fn each_fault_is_printed_once_where_no_log_is_kept_and_never_where_one_is() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let journal = folder.path().join("faults");
    let begun = || rows(&["--journal", text(&journal)]) == pairs(&[(WORN, "open")]);
    let robot = Robot::start(folder.path());
    until(begun);

    let printed = robot.kill();
    let about = |words: &str| printed.iter().filter(|line| line.contains(words)).count();
    assert_eq!((about("the finger is gone"), about("4 mm of 5 mm")), (1, 1), "{printed:?}");
    assert_eq!((about("on node module1: "), about(" of module1:gripper: ")), (2, 2), "{printed:?}");
    assert_eq!(about("Z blastema: "), printed.len(), "each begins with its time: {printed:?}");

    let robot = Robot::start_with(folder.path(), &[(LOGS, "1")]);
    until(begun);
    let printed = robot.kill();
    assert!(!printed.iter().any(|line| line.contains("blastema: ")), "{printed:?}");
}

/// A robot with its journal at this path, and what is found wrong with that.
async fn start_with_journal(path: &Path) -> (Node, String) {
    let mut builder = robot("module1").journal(path);
    let mut faults = builder.fault_events();
    let node = builder.start().await.expect("it starts all the same");
    let found = async {
        while let Some(FaultEvent { fault, turn, .. }) = faults.next().await {
            let of_journal = fault.location.to_string().ends_with("chain/journal");
            if of_journal && turn == FaultTransition::Found {
                return fault.detail;
            }
        }
        panic!("the node has ended");
    };
    let detail = tokio::time::timeout(TIMEOUT, found).await.expect("it is found");
    (node, detail)
}

#[test]
fn a_journal_that_cannot_be_written_is_a_fault_and_the_node_goes_on() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("nowhere/faults");
        let (node, detail) = start_with_journal(&path).await;
        assert!(detail.contains(text(&path)) && detail.contains("goes on without"), "{detail}");
        assert_eq!(node.state(), NodeState::Running);
        node.shutdown().await;
    });
}

#[test]
fn a_folder_as_a_journal_is_refused_at_start() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");

        let refused = robot("module1").journal(folder.path()).start().await;

        let refused = refused.map(drop).expect_err("it is a folder").to_string();
        assert!(refused.contains(text(folder.path())) && refused.contains("folder"), "{refused}");
    });
}

#[test]
fn a_damaged_journal_is_set_aside_and_the_next_faults_are_kept() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("faults");
        robot("module1").journal(&path).start().await.expect("it starts").shutdown().await;
        let mut bytes = fs::read(&path).expect("a journal");
        bytes[100..].fill(0x5a); // behind the header
        fs::write(&path, &bytes).expect("it is ours");
        let (node, detail) = start_with_journal(&path).await;

        assert!(detail.contains("damaged") && detail.contains("faults.damaged-1"), "{detail}");
        assert!(folder.path().join("faults.damaged-1").exists());
        until(|| rows(&["--all", "--journal", text(&path)]).len() == 3);
        node.shutdown().await;
        let ended = blastema::journal::read(&path).expect("it is a journal");
        assert!(ended.iter().all(|entry| !entry.status.stands()), "{ended:?}");
        assert!(ended.iter().any(|entry| entry.status.to_string() == "ended with the node"));
    });
}

#[test]
fn a_file_that_is_no_journal_is_left_alone_and_the_fault_says_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("photograph.jpg");
        fs::write(&path, "no database at all, but a photograph").expect("a file");
        let (node, detail) = start_with_journal(&path).await;

        assert!(detail.contains("give the journal another path"), "{detail}");
        node.shutdown().await;
        let kept = fs::read_to_string(&path).expect("it is still there");
        assert_eq!(kept, "no database at all, but a photograph");
    });
}

#[test]
fn a_second_node_on_the_same_journal_is_refused_and_learns_who_writes_it() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("faults");
        let node = robot("module1").journal(&path).start().await.expect("it starts");

        let refused = robot("module2").journal(&path).start().await.expect_err("it is in use");
        assert!(refused.to_string().contains("node module1, process"), "{refused}");
        let relative =
            robot("module3").journal("faults").start().await.expect_err("it is relative");
        assert!(relative.to_string().contains("absolute"), "{relative}");
        node.shutdown().await;
        let next = robot("module2").journal(&path).start().await.expect("it is free");
        next.shutdown().await;
    });
}

#[test]
fn a_node_that_has_ended_leaves_its_files_and_its_socket_to_the_next_one_of_its_process() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    let start = || {
        robot("module1")
            .journal(path("faults"))
            .keep_variables(path("variables"))
            .inspection_socket(path("socket"))
            .start()
    };
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                while !over.load(SeqCst) {
                    std::hint::spin_loop();
                }
            });
        }
        let cycles = AssertUnwindSafe(|| {
            blastema::run(async {
                for cycle in 0..50 {
                    let node = start().await.unwrap_or_else(|why| panic!("{cycle}: {why}"));
                    node.shutdown().await;
                    assert!(!path("socket").exists(), "{cycle}: the socket is gone with the node");
                    let node = start().await.unwrap_or_else(|why| panic!("{cycle}: {why}"));
                    drop(node);
                }
            });
        });
        let outcome = catch_unwind(cycles);
        over.store(true, SeqCst);
        outcome.unwrap_or_else(|panic| resume_unwind(panic));
    });
}

#[test]
fn what_cannot_be_read_is_told_in_one_line() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let (missing, text_file) = (folder.path().join("missing"), folder.path().join("text"));
    fs::write(&text_file, "no database at all, but a text of some length").expect("a file");
    let check = |arguments: &[&str], words: &str| {
        let output = list(arguments);
        let told = String::from_utf8(output.stderr).expect("text");
        assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{told}");
        assert_eq!(told.lines().count(), 1, "{told}");
        assert!(told.contains(words), "{words:?} is not said in {told}");
    };
    check(&["--journal", text(&missing)], "there is no journal");
    check(&["--journal", text(&text_file)], "is no journal");
    check(&[text(&missing)], "nothing is there: start the node");
}
