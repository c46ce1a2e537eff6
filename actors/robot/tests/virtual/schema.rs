//! The schema for editors, as `xmllint` reads it.

use std::fs;
use std::path::PathBuf;
use std::process::Command;

/// Whether `xmllint` takes a file; `None` where it is not installed.
fn is_valid(file: &str) -> Option<bool> {
    let mut xmllint = Command::new("xmllint");
    xmllint.args(["--noout", "--schema", "robot-1.xsd", file]);
    let ended = xmllint.output().ok()?;
    Some(ended.status.success())
}

fn files_in(folder: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("the folder is there");
    let paths = entries.map(|entry| entry.expect("it can be read").path());
    paths.filter(|path| path.extension().is_some_and(|end| end == "xml")).collect()
}

#[test]
fn xmllint_takes_right_files_and_finds_mistakes_of_shape() {
    for file in files_in("tests/right").into_iter().chain(files_in("tests/right/parts")) {
        let file = file.display().to_string();
        assert_ne!(is_valid(&file), Some(false), "{file}");
    }
    for file in files_in("tests/wrong") {
        let text = fs::read_to_string(&file).expect("it is there");
        let file = file.display().to_string();
        if text.contains("<!-- shape -->") {
            assert_ne!(is_valid(&file), Some(true), "{file}");
        }
    }
}

#[test]
fn the_schema_is_xml_of_its_version() {
    assert!(blastema_robot::XSD.contains("schema version 1"));
    assert!(!blastema_robot::XSD.contains('\t'));
}
