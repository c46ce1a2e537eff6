//! Runs every example as its reader would, and checks what it prints.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::sync_channel;
use std::time::Duration;
use std::{fs, thread};

/// The slowest example takes about twenty seconds; the rest is for a machine that is busy with other
/// tests.
const PATIENCE: Duration = Duration::from_secs(180);

/// Where Cargo puts the example, beside the folder of this test.
pub(crate) fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a running program has a path");
    let profile = test.ancestors().nth(2).expect("a test lies in a folder of its profile");
    let program = profile.join("examples").join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    // `cargo test --test real` builds no examples.
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(format!("{name}.rs"));
    let changed = |path: &Path| fs::metadata(path).and_then(|file| file.modified()).ok();
    assert!(
        changed(&program) >= changed(&source),
        "{name} is not built, or has changed since: run `cargo test -p blastema-examples`"
    );
    program
}

/// What the example prints until it ends, which it must do in time and well.
fn output(name: &str) -> String {
    let mut child = Command::new(program(name))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("{name}: {error}"));
    let mut stdout = child.stdout.take().expect("it was asked for");
    let mut stderr = child.stderr.take().expect("it was asked for");
    let told = thread::spawn(move || {
        let mut text = String::new();
        stderr.read_to_string(&mut text).map(|_| text)
    });
    let (done, printed) = sync_channel(1);
    thread::spawn(move || {
        let mut text = String::new();
        let read = stdout.read_to_string(&mut text);
        // The test may have given up by now.
        let _ = done.send(read.map(|_| text));
    });
    let Ok(text) = printed.recv_timeout(PATIENCE) else {
        child.kill().expect("it still runs");
        panic!("{name} did not end within {PATIENCE:?}");
    };
    let status = child.wait().expect("it was started here");
    let text = text.expect("examples print UTF-8");
    assert!(status.success(), "{name} ended with {status}; it had printed:\n{text}");
    let told = told.join().expect("it reads").expect("examples print UTF-8");
    let ends_wrongly =
        |line: &&str| line.contains("was dropped") || line.contains("unexpected exit");
    assert_eq!(told.lines().find(ends_wrongly), None, "{name} does not end in order:\n{told}");
    text
}

/// The example prints these lines in this order, perhaps with others in between.
#[track_caller]
fn check(name: &str, expected: &[&str]) {
    let text = output(name);
    let mut lines = text.lines();
    for line in expected {
        assert!(lines.any(|printed| printed == *line), "{line:?} is missing in:\n{text}");
    }
}

#[test]
fn hello_outlives_the_death_of_its_laser() {
    let _turn = blastema_doubles::turn();
    check(
        "hello",
        &[
            "`laser/nearest` to module1:laser failed: the receiver died in its incarnation #1 while it served \
             this message",
            "0.8 m",
        ],
    );
}

#[test]
fn supervised_restarts_what_depends_on_the_laser_and_comes_to_rest_with_its_brakes_on() {
    let _turn = blastema_doubles::turn();
    check(
        "supervised",
        &[
            "laser#1 works",
            "planner#1 works",
            "motors#1 works",
            "-- the laser is struck",
            "motors#1 rests",
            "planner#1 rests",
            "laser#2 works",
            "planner#2 works",
            "motors#2 works",
            "-- the laser is struck",
            "motors#2 rests",
            "planner#2 rests",
            "brakes on: restart storm of module1",
            "in safe state: drive needed more than 0 restarts in 10s: laser needed more than 1 restarts in 10s: \
             it died",
        ],
    );
}

#[test]
fn own_strategy_regrasps_until_it_holds() {
    let _turn = blastema_doubles::turn();
    check("own_strategy", &["attempt 1 at regrasp", "attempt 2 at regrasp"]);
    check(
        "own_strategy",
        &["GRIPPER-SLIP of module1:gripper: Found", "GRIPPER-SLIP of module1:gripper: Recovered"],
    );
}

#[test]
fn hang_replaces_the_culprit_and_moves_its_neighbour_with_what_waited() {
    let _turn = blastema_doubles::turn();
    check(
        "hang",
        &["count 1", "hang of module1:map", "found again: true", "count 2", "threads given up: 1"],
    );
}

#[test]
fn serial_and_udp_carry_out_every_order_once_whichever_cable_is_pulled() {
    let _turn = blastema_doubles::turn();
    check(
        "serial_and_udp",
        &[
            "link down: body -ethernet- arm",
            "link down: body -serial- arm",
            "300 orders carried out, each once",
            "both cables are back",
        ],
    );
}

#[test]
fn small_devices_are_recovered_with_no_line_for_that_on_their_chips() {
    let _turn = blastema_doubles::turn();
    check(
        "small_devices",
        &[
            "the gripper holds at 30 mm",
            "gripper: the device is lost: it does not answer: it is hung, switched off or unplugged",
            "the gripper holds at 30 mm",
            "the gripper works again; its chip knows nothing of it",
        ],
    );
}

#[test]
fn python_process_is_killed_and_hangs_and_serves_again() {
    let _turn = blastema_doubles::turn();
    if Command::new("python3").arg("-V").output().is_err() {
        return check("python_process", &["this example needs python3: install it"]);
    }
    check(
        "python_process",
        &[
            "planner: incarnation 1 plans",
            "-- kill -KILL",
            "vision: fatal error: its program was ended by signal 9, SIGKILL",
            "planner: incarnation 2 plans",
            "-- kill -USR1",
            "vision: silence: it did not say that it is alive (WATCHDOG=1) for 1s",
            "planner: incarnation 3 plans",
            "-- the node has ended, and the program with it",
        ],
    );
}

#[test]
fn own_medium_carries_requests_over_two_fifos() {
    let _turn = blastema_doubles::turn();
    check("own_medium", &["3 squared is 9", "12 squared is 144"]);
}

#[test]
fn variables_of_another_node_are_written_together_and_outlive_their_owner_as_declared() {
    let _turn = blastema_doubles::turn();
    check(
        "variables",
        &[
            "limit: 0.5 rad/s",
            "limit: 0.2 rad/s",
            "refused by a check: the arm breaks above 2 rad/s; the load is still 3 kg",
            "target: shelf",
            "after a blow: Undecided",
            "arm/target of arm awaits a decision: restore it, take its default, or give it a value",
            "target: rest",
            "the load is still 3 kg",
        ],
    );
}

#[test]
fn standby_goes_on_counting_when_the_node_that_serves_is_cut_off() {
    let _turn = blastema_doubles::turn();
    check(
        "standby",
        &[
            "100 counted",
            "-- the node that serves is cut off",
            "200 counted, by another node: true",
            "the first one is back, and stands by",
        ],
    );
}

#[test]
fn an_example_whose_reader_has_gone_says_no_more_than_that_its_node_ends() {
    let _turn = blastema_doubles::turn();
    let mut child = Command::new(program("hello"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the example can be started");
    drop(child.stdout.take());

    let output = child.wait_with_output().expect("it was started here");

    assert_eq!(output.status.code(), Some(141), "as after SIGPIPE");
    // Its laser panics before, which is a fault and is printed as one.
    let told = String::from_utf8_lossy(&output.stderr);
    let is_known = |line: &str| {
        let of_laser = line.contains("Z blastema: error on node ") && line.contains("laser");
        of_laser || line.contains("was dropped by a panic while it ran")
    };
    assert!(told.lines().all(is_known), "{told}");
}

#[test]
fn paper_robot_reacts_to_errors_as_the_listing_of_its_source_does() {
    let _turn = blastema_doubles::turn();
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/paper_robot.txt");
    let golden = fs::read_to_string(golden).expect("it is there");
    assert_eq!(output("paper_robot"), golden);
}

#[test]
fn rover_returns_stands_and_drives_as_its_radio_and_its_operator_come_and_go() {
    let _turn = blastema_doubles::turn();
    let manual = Path::new(env!("CARGO_MANIFEST_DIR")).join("../actors/src/manual/trees.md");
    let manual = fs::read_to_string(manual).expect("it is there");
    let shown = manual.split("```text\nrover.tree.xml\n").nth(1).expect("the page has the table");
    let shown = shown.split("```").next().unwrap_or_default();
    // All but the times.
    let rows = |table: &str| -> Vec<String> {
        let rows = table.lines().filter_map(|row| row.split_once(" | "));
        rows.map(|(_, row)| row.to_owned()).collect()
    };
    assert!(rows(shown).len() > 10);
    assert_eq!(rows(&output("rover")), rows(shown));
}
