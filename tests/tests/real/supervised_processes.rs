//! Programs as children of a supervisor: they die, hang, leak, flood, and leave nothing behind.

use blastema::prelude::*;
use blastema::{
    ComponentOrder, Fault, FaultEvents, FaultLocation, Lifecycle, MonitorRow, OrderVerb,
    ProcessSpec, launch_processes_by,
};
use blastema_tests::{found, next_fault, until};
use std::fs::{self, Permissions};
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

const PROGRAM: &str = env!("CARGO_BIN_EXE_trial_program");
/// Says that it is ready and who it is.
const READY: [&str; 3] = ["say-pid", "say", "READY=1"];

/// A process of the trial program.
fn trial(name: &str, words: &[&str]) -> ProcessSpec {
    launch_processes_by(PROGRAM);
    ProcessSpec::new(name, PROGRAM).arguments(READY).arguments(words.iter().copied())
}

/// A process of the shell, which finds the trial program as `$PROGRAM`.
fn shell(name: &str, script: &str) -> ProcessSpec {
    launch_processes_by(PROGRAM);
    ProcessSpec::new(name, "sh").arguments(["-c", script]).variable("PROGRAM", PROGRAM)
}

fn exists(process: &str) -> bool {
    Path::new("/proc").join(process).exists()
}

async fn gone(process: &str) {
    until(async || !exists(process), "it is ended").await;
}

fn signal(signal: &str, process: &str) {
    let sent = Command::new("kill").args([signal, process]).status();
    assert!(sent.expect("there is kill").success());
}

fn at(node: &Node, name: &str) -> FaultLocation {
    FaultLocation::Object(format!("{}:{name}", node.name()).parse().expect("an address"))
}

/// Waits for an incarnation at work.
async fn active(node: &Node, name: &str, incarnation: u64) -> MonitorRow {
    let location = at(node, name);
    let at_work = async || {
        let row = node.table().await.into_iter().find(|row| row.location == location);
        row.filter(|row| row.incarnation.0 == incarnation && row.state == Some(Lifecycle::Active))
    };
    found(at_work, "it comes to work").await
}

/// Waits until the program of an incarnation at work has said who it is.
async fn process(node: &Node, name: &str, incarnation: u64) -> String {
    loop {
        if let Some(process) = active(node, name, incarnation).await.note {
            return process;
        }
    }
}

/// Waits for the first fault at a place.
async fn fault(events: &mut FaultEvents, location: &FaultLocation) -> Fault {
    next_fault(events, |fault| fault.location == *location, "it is found").await
}

#[test]
fn a_program_that_ends_says_how_and_serves_again() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let mark = |name: &str| folder.path().join(name).display().to_string();
    blastema::run(async {
        let node = Node::builder("module1")
            .child(trial("killed", &["sleep"]).child())
            .child(trial("aborts", &["once", &mark("a"), "abort"]).child())
            .child(trial("exits", &["once", &mark("b"), "exit", "3"]).child())
            .child(trial("returns", &["once", &mark("c"), "exit", "0"]).child());
        let mut node = node;
        let mut events = node.fault_events();
        let node = node.start().await.unwrap();
        let killed = process(&node, "killed", 1).await;
        signal("-KILL", &killed);

        let record = async || {
            for name in ["killed", "aborts", "exits", "returns"] {
                assert_ne!(process(&node, name, 2).await, killed);
            }
            node.faults().await.entries
        };
        let entries = record().await;
        for (name, kind, text) in [
            ("killed", FaultKind::Fatal, "its program was ended by signal 9, SIGKILL: unless"),
            ("aborts", FaultKind::Fatal, "its program was ended by signal 6, SIGABRT"),
            ("exits", FaultKind::Fatal, "its program ended with exit status 3: see"),
            ("returns", FaultKind::UnexpectedExit, ""),
        ] {
            let entry = entries.iter().find(|entry| entry.fault.location == at(&node, name));
            let Fault { kind: found, detail, .. } = &entry.expect("it has failed").fault;
            assert_eq!(*found, kind, "{detail}");
            assert!(detail.contains(text), "{name}: {detail}");
        }
        assert!(!exists(&killed));
        signal("-KILL", &parent_of(&process(&node, "killed", 2).await));
        active(&node, "killed", 3).await;
        fault(&mut events, &at(&node, "killed")).await;
        node.shutdown().await;
    });
}

#[test]
fn a_program_that_hangs_or_was_stopped_is_silent_and_ended_by_its_watchdog() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let mark = folder.path().join("mark").display().to_string();
    let watchdog = Duration::from_millis(300);
    blastema::run(async {
        let short = Duration::from_millis(500);
        let script = format!(
            "\"$PROGRAM\" say STATUS=$$; \"$PROGRAM\" say READY=1; \
             [ -e {mark} ] && exec \"$PROGRAM\" beat; touch {mark}; exec \"$PROGRAM\" spin"
        );
        let hangs = shell("hangs", &script).watchdog(watchdog).child().shutdown_within(short);
        let beats = trial("beats", &["beat"]).watchdog(Duration::from_secs(1)).child();
        let mut node = Node::builder("module1").child(beats.shutdown_within(short)).child(hangs);
        let mut events = node.fault_events();
        let node = node.start().await.unwrap();
        let first = fault(&mut events, &at(&node, "hangs")).await;
        assert_eq!(first.kind, FaultKind::Silence, "{first}");
        let text = "it did not say that it is alive (WATCHDOG=1) for 300ms: it hangs, or `watchdog` \
                    is too short; its last STATUS was";
        assert!(first.detail.starts_with(text), "{first}");
        active(&node, "hangs", 2).await;

        let stopped = process(&node, "beats", 1).await;
        signal("-STOP", &stopped);
        let second = fault(&mut events, &at(&node, "beats")).await;
        assert_eq!(second.kind, FaultKind::Silence, "{second}");
        assert!(second.detail.contains(&stopped), "{second}");
        active(&node, "beats", 2).await;
        assert!(!exists(&stopped));
        node.shutdown().await;
    });
}

#[test]
fn a_program_above_its_memory_limit_is_ended_with_both_sizes() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let mark = folder.path().join("mark").display().to_string();
    blastema::run(async {
        // Its child's memory counts, too.
        let script = format!(
            "\"$PROGRAM\" say READY=1; [ -e {mark} ] && exec \"$PROGRAM\" sleep; touch {mark}; \
             \"$PROGRAM\" grow & wait"
        );
        let leaks = shell("leaks", &script).memory_limit(64 << 20);
        let mut node = Node::builder("module1").child(leaks.child());
        let mut events = node.fault_events();
        let node = node.start().await.unwrap();

        let found = fault(&mut events, &at(&node, "leaks")).await;
        assert_eq!(found.kind, FaultKind::Fatal);
        assert!(found.detail.starts_with("its processes have "), "{found}");
        assert!(found.detail.contains("resident, and 64.0 MiB are allowed"), "{found}");
        active(&node, "leaks", 2).await;
        node.shutdown().await;
    });
}

#[test]
fn what_a_program_has_started_ends_with_it_also_in_a_session_of_its_own() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("orphan");
    blastema::run(async {
        let script = format!(
            "(setsid sh -c 'trap \"\" TERM; echo $$ >{0}.new; mv {0}.new {0}; sleep 1000' &); \
             while [ ! -e {0} ]; do sleep 0.01; done; \
             \"$PROGRAM\" say STATUS=$$; \"$PROGRAM\" say READY=1; sleep 1000",
            file.display()
        );
        let parent = shell("parent", &script).child().shutdown_within(Duration::from_secs(1));
        let node = Node::builder("module1").child(parent).start().await.unwrap();
        let (program, read) =
            (process(&node, "parent", 1).await, || fs::read_to_string(&file).unwrap_or_default());
        let orphan = read().trim().to_owned();
        assert!(exists(&orphan));

        fs::remove_file(&file).unwrap();
        signal("-KILL", &program);
        active(&node, "parent", 2).await;
        assert!(!exists(&orphan) && !exists(&program));
        let orphan = read().trim().to_owned();
        assert!(exists(&orphan));
        node.shutdown().await;
        assert!(!exists(&orphan));
    });
}

/// A node of the trial program with a process for each of these scripts.
fn host(scripts: &[&str]) -> Command {
    let mut host = Command::new(PROGRAM);
    host.arg("host").args(scripts).stdout(Stdio::piped()).stderr(Stdio::piped());
    host
}

#[test]
fn a_flood_of_output_and_of_messages_is_counted_and_holds_nobody_up() {
    let _turn = blastema_doubles::turn();
    let script = "\"$PROGRAM\" say READY=1; \"$PROGRAM\" print 1000000; echo done >&2; \
                  \"$PROGRAM\" nonsense 10000; echo quiet >&2";
    let output = host(&[script]).output().unwrap();

    let printed = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{printed}");
    for part in ["[p0] line 0\n", "more lines were written within a second", "[p0] done\n"] {
        assert!(printed.contains(part), "{part}: {printed:.2000}");
    }
    assert!(printed.contains("[p0] quiet\n"));
    let lines = printed.lines().count();
    assert!(lines < 100_000, "{lines}");
}

#[test]
fn nothing_outlives_a_node_that_was_killed_nor_its_launcher() {
    let _turn = blastema_doubles::turn();
    // One ends at SIGTERM, one ignores it, and one has left its group.
    let scripts = [
        "echo $$ >0; \"$PROGRAM\" say READY=1; exec sleep 1000",
        "trap '' TERM; echo $$ >1; \"$PROGRAM\" say READY=1; while :; do sleep 1; done",
        "setsid sh -c 'echo $$ >2; sleep 1000' & while [ ! -s 2 ]; do sleep 0.01; done; \
         \"$PROGRAM\" say READY=1; wait",
    ];
    for kill_all in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let mut host = host(&scripts).current_dir(&folder).spawn().unwrap();
        let mut started = String::new();
        BufReader::new(host.stdout.as_mut().unwrap()).read_line(&mut started).unwrap();
        assert_eq!(started, "started\n", "{:?}", {
            let mut text = String::new();
            host.stderr.take().map(|mut error| error.read_to_string(&mut text))
        });
        let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
        let programs = ["0", "1", "2"].map(|name| read(name).trim().to_owned());
        assert!(programs.iter().all(|program| exists(program)));

        if kill_all {
            // As a service manager may, at last: the launchers first.
            for program in &programs[..2] {
                signal("-KILL", &parent_of(program));
            }
        }
        signal("-KILL", &host.id().to_string());
        host.wait().unwrap();
        blastema::run(async {
            for program in &programs {
                gone(program).await;
            }
        });
    }
}

#[test]
fn a_launcher_that_stands_still_is_killed_and_its_program_serves_again() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let mut node = Node::builder("module1").child(trial("sleeps", &["sleep"]).child());
        let mut events = node.fault_events();
        let node = node.start().await.unwrap();
        let first = process(&node, "sleeps", 1).await;
        signal("-STOP", &parent_of(&first));

        let detail = fault(&mut events, &at(&node, "sleeps")).await.detail;
        assert!(detail.contains("stood still for more than 3 s"), "{detail}");
        let second = process(&node, "sleeps", 2).await;
        gone(&first).await;

        signal("-STOP", &parent_of(&second));
        node.shutdown().await;
        gone(&second).await;
        let own = format!("blastema-{}-", std::process::id());
        let is_left = |entry: fs::DirEntry| entry.file_name().to_string_lossy().starts_with(&own);
        let left = || fs::read_dir(blastema::runtime_folder()).unwrap().flatten().any(is_left);
        until(async || !left(), "its folder is removed").await;
    });
}

fn parent_of(process: &str) -> String {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let fields = stat.rsplit_once(')').unwrap().1.split_whitespace();
    fields.map(str::to_owned).nth(1).unwrap()
}

/// Writes a line whenever it comes to work.
struct Line(PathBuf, &'static str);

impl Component for Line {
    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        let known = fs::read_to_string(&self.0).unwrap_or_default();
        Ok(fs::write(&self.0, known + self.1 + "\n")?)
    }
}

#[test]
fn a_group_of_components_and_processes_restarts_in_order() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    blastema::run(async {
        let line = |name: &'static str| {
            let log = log.clone();
            ChildSpec::new(name, move || Line(log.clone(), name))
        };
        let script = "sleep 0.2; \"$PROGRAM\" say STATUS=$$; echo vision >>log; \
                      \"$PROGRAM\" say READY=1; sleep 1000";
        let vision = shell("vision", script).folder(folder.path());
        let group = SupervisorSpec::new("drive", Strategy::RestForOne)
            .child(line("laser"))
            .child(vision.child())
            .child(line("planner").depends_on(["vision"]));
        let node = Node::builder("module1").supervisor(group).start().await.unwrap();
        signal("-KILL", &process(&node, "vision", 1).await);

        active(&node, "planner", 2).await;
        active(&node, "laser", 1).await;
        let written = fs::read_to_string(&log).unwrap();
        assert_eq!(written, "laser\nvision\nplanner\nvision\nplanner\n");

        let order = async |verb| {
            let reply = node.order(&ComponentOrder { verb, name: Some("vision".into()) }).await;
            assert_eq!(reply.refused, None);
        };
        let second = process(&node, "vision", 2).await;
        order(OrderVerb::Deactivate).await;
        gone(&second).await;
        order(OrderVerb::Activate).await;
        assert!(exists(&process(&node, "vision", 2).await));
        node.shutdown().await;
    });
}

#[test]
fn one_that_never_is_ready_one_that_ignores_sigterm_and_one_that_is_missing() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("vision");
    let (name, within) = (program.display().to_string(), Duration::from_millis(400));
    blastema::run(async {
        let start = async |spec: ProcessSpec| {
            let started = Node::builder("module1").child(spec.child()).start().await;
            started.map(|_| ()).expect_err("it is refused").to_string()
        };
        launch_processes_by(PROGRAM);
        let spec = ProcessSpec::new("vision", &program).ready_at_start();
        let text = start(spec.clone()).await;
        assert!(text.contains(&format!("there is no program {name}: build it, or")), "{text}");
        fs::write(&program, "#!/no/such/interpreter\n").unwrap();
        let text = start(spec.clone()).await;
        assert!(text.contains(&format!("not executable: allow it by `chmod +x {name}`")), "{text}");
        let text = start(ProcessSpec::new("vision", "no-such-command")).await;
        assert!(text.contains("there is no `no-such-command` in PATH: install it"), "{text}");
        let text = start(trial("vision", &[]).watchdog(Duration::ZERO)).await;
        assert!(text.contains("watchdog of vision is 0ns: write 10 ms to an hour"), "{text}");
        let text = start(trial("vision", &[]).memory_limit(512)).await;
        assert!(text.contains("memory_limit of vision is 512"), "{text}");

        // What a check cannot find is a fault at the start.
        fs::set_permissions(&program, Permissions::from_mode(0o755)).unwrap();
        let mute = shell("mute", "trap '' TERM; while :; do sleep 1; done");
        let mut node =
            Node::builder("module1").child_with(spec.child(), Restart::Temporary).child_with(
                mute.child().ready_within(within).shutdown_within(within),
                Restart::Temporary,
            );
        let mut events = node.fault_events();
        let node = node.start().await.unwrap();
        let found = fault(&mut events, &at(&node, "vision")).await;
        let text = "could not be started: No such file or directory";
        assert!(found.detail.contains(text), "{found}");
        let found = fault(&mut events, &at(&node, "mute")).await;
        assert_eq!(found.kind, FaultKind::Fatal);
        assert!(
            found.detail.contains("it was not ready within 400ms: have it say READY=1"),
            "{found}"
        );
        node.shutdown().await;

        let stubborn = "trap '' TERM; \"$PROGRAM\" say STATUS=$$; \"$PROGRAM\" say READY=1; \
                        while :; do sleep 1; done";
        let stubborn = shell("stubborn", stubborn).child().shutdown_within(within);
        let node = Node::builder("module1").child(stubborn).start().await.unwrap();
        let process = process(&node, "stubborn", 1).await;
        node.shutdown().await;
        assert!(!exists(&process));
    });
}

#[test]
fn a_hundred_programs_start_and_stop() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let names: Vec<String> = (0..100).map(|number| format!("p{number}")).collect();
        let children = names.iter().fold(Node::builder("module1"), |node, name| {
            node.child(shell(name, "echo started; exec sleep 1000").ready_at_start().child())
        });
        let node = children.start().await.unwrap();

        let below = || {
            let own = std::process::id().to_string();
            let listed = fs::read_dir("/proc").unwrap().flatten();
            let all = listed.filter_map(|entry| entry.file_name().into_string().ok());
            let launchers = all.filter(|process| {
                process.parse::<u32>().is_ok() && exists(process) && {
                    let stat = fs::read_to_string(format!("/proc/{process}/stat"));
                    stat.is_ok_and(|stat| {
                        let fields = stat.rsplit_once(')').map_or("", |(_, fields)| fields);
                        fields.split_whitespace().nth(1) == Some(&own)
                    })
                }
            });
            launchers.count()
        };
        assert_eq!(below(), 100);
        for name in &names {
            active(&node, name, 1).await;
        }
        node.shutdown().await;
        assert_eq!(below(), 0);
    });
}
