//! The program starts the programs of robot files, prints the schema, and writes a robot.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

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
    write("");
    let (output, text) = blastema(folder.path(), &["run", "a.xml"]);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("a.xml names no program: add `program="), "{text}");
    write(" program=\"./none\"");
    let (_, text) = blastema(folder.path(), &["graph", "a.xml"]);
    assert!(text.contains("none of the file does not start"), "{text}");
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
}
