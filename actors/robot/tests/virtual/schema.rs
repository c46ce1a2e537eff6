//! The schema for editors, as `xmllint` reads it.

use std::fs;
use std::io::Write;
use std::path::PathBuf;
use std::process::Command;

/// Whether `xmllint` takes a file; `None`, and a line that no test run hides, where it is not
/// installed.
fn is_valid(file: &str) -> Option<bool> {
    let mut xmllint = Command::new("xmllint");
    xmllint.args(["--noout", "--schema", "robot-1.xsd", file]);
    match xmllint.output() {
        Ok(ended) => Some(ended.status.success()),
        Err(error) => {
            let skipped = format!("SKIPPED: the schema is not tried: xmllint: {error}\n");
            std::io::stderr().write_all(skipped.as_bytes()).expect("standard error is open");
            None
        }
    }
}

fn files_in(folder: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).expect("the folder is there");
    let paths = entries.map(|entry| entry.expect("it can be read").path());
    paths.filter(|path| path.extension().is_some_and(|end| end == "xml")).collect()
}

#[test]
fn xmllint_takes_right_files_and_finds_mistakes_of_shape() {
    let right = files_in("tests/right").into_iter().chain(files_in("tests/right/parts"));
    let of_shape = files_in("tests/wrong")
        .into_iter()
        .filter(|file| fs::read_to_string(file).expect("it is there").contains("<!-- shape -->"));
    let files = right.map(|file| (file, true)).chain(of_shape.map(|file| (file, false)));
    for (file, expected) in files {
        let file = file.display().to_string();
        let Some(valid) = is_valid(&file) else { return };
        assert_eq!(valid, expected, "{file}");
    }
}

#[test]
fn the_schema_is_xml_of_its_version() {
    assert!(blastema_robot::XSD.contains("schema version 1"));
    assert!(!blastema_robot::XSD.contains('\t'));
}
