//! The program starts the programs of robot files, prints the schema, and writes a robot.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

/// The product is compiled for minutes, on a busy computer for many.
const COMPILED_WITHIN: Duration = Duration::from_secs(3600);

fn blastema(folder: &Path, arguments: &[&str]) -> (Output, String) {
    let mut program = Command::new(env!("CARGO_BIN_EXE_blastema"));
    let output = program.args(arguments).current_dir(folder).output().expect("it starts");
    let text = [output.stdout.clone(), output.stderr.clone()].concat();
    (output, String::from_utf8(text).expect("text"))
}

#[test]
fn the_program_of_a_robot_file_is_started_with_its_options_and_gives_its_status() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");
    let write = |program: &str| {
        let text = format!("<robot schema=\"1\" name=\"a\"{program}><node name=\"b\"/></robot>");
        fs::write(folder.path().join("a.xml"), text).expect("it can be written");
    };

    write(" program=\"../../usr/bin/env\"");
    let (output, text) = blastema(folder.path(), &["check", "a.xml", "--set", "rate=5Hz"]);
    // `env` has no command `check`, and says so.
    assert_eq!((output.status.code(), text.contains("check")), (Some(127), true), "{text}");
    write(" program=\"../../usr/bin/${prog}\"><argument name=\"prog\"/");
    for set in [&["check", "a.xml", "--set", "prog=env"][..], &["run", "a.xml", "--set=prog=env"]] {
        let (output, text) = blastema(folder.path(), set);
        assert_eq!(output.status.code(), Some(127), "{text}");
    }
    write("");
    let (output, text) = blastema(folder.path(), &["run", "a.xml"]);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("a.xml names no program: add `program="), "{text}");
    write(" program=\"./none\"");
    let (_, text) = blastema(folder.path(), &["graph", "a.xml"]);
    assert!(text.contains("none of the file does not start"), "{text}");
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_blastema"), folder.path().join("own"))
        .expect("a link");
    write(" program=\"own\"");
    let (output, text) = blastema(folder.path(), &["check", "a.xml"]);
    assert_eq!(
        (output.status.code(), text.contains("`blastema` itself")),
        (Some(2), true),
        "{text}"
    );
}

#[test]
fn the_schema_is_printed() {
    let _turn = blastema_doubles::turn();
    let (output, text) = blastema(Path::new("."), &["schema"]);
    assert!(output.status.success());
    assert_eq!(text, blastema_robot::XSD);
}

#[test]
fn a_new_robot_is_written_once_with_a_file_and_a_test() {
    let _turn = blastema_doubles::turn();
    let folder = tempfile::tempdir().expect("a folder");

    let (output, text) = blastema(folder.path(), &["new", "rover"]);
    assert!(output.status.success(), "{text}");
    let file = fs::read_to_string(folder.path().join("rover/rover.robot.xml")).expect("a file");
    assert!(file.contains("program=\"target/debug/rover\""), "{file}");
    let test = fs::read_to_string(folder.path().join("rover/tests/robot.rs")).expect("a test");
    assert!(test.contains("use rover::{Speed, types};") && !test.contains("{{"), "{test}");

    let (output, text) = blastema(folder.path(), &["new", "rover"]);
    assert_eq!(output.status.code(), Some(2), "{text}");
    let (_, text) = blastema(folder.path(), &["new", "Rover 2"]);
    assert!(text.contains("small letters"), "{text}");
    for taken in ["std", "fn", "blastema", "test"] {
        let (output, text) = blastema(folder.path(), &["new", taken]);
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains(&format!("as in `my_{taken}`")), "{text}");
    }
}

/// At night: it compiles the product with the features of a user's package.
#[test]
fn a_new_robot_builds_and_passes_its_test() {
    let _turn = blastema_doubles::turn_within(COMPILED_WITHIN);
    if !blastema_doubles::long() {
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let (output, text) = blastema(folder.path(), &["new", "rover"]);
    assert!(output.status.success(), "{text}");
    let rover = folder.path().join("rover");
    // The versions that are here already: the test needs no network.
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    fs::copy(sources.join("Cargo.lock"), rover.join("Cargo.lock")).expect("it can be copied");
    let cargo = |arguments: &[&str]| {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(arguments).arg("--offline").current_dir(&rover);
        // What is compiled lies beside what this test is from, and is there the next time.
        let output = cargo.env("CARGO_TARGET_DIR", sources.join("target")).output();
        let output = output.expect("there is a cargo");
        let text = [output.stdout, output.stderr].concat();
        (output.status.success(), String::from_utf8_lossy(&text).into_owned())
    };

    let (passed, text) = cargo(&["test"]);
    assert!(
        passed && text.contains("the_wheels_turn_again_after_the_laser_has_died ... ok"),
        "{text}"
    );
    fs::create_dir_all(rover.join("target/debug")).expect("a folder");
    let program = sources.join("target/debug/rover");
    fs::copy(program, rover.join("target/debug/rover")).expect("it was built");
    let (output, text) = blastema(&rover, &["check", "rover.robot.xml"]);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("rover: 1 nodes, 2 components, no mistake"), "{text}");
}
