//! Planted mistakes: each is found at its line, with a golden text, and nothing else is.

use crate::program::types;
use blastema::ActuatorSpec;
use blastema::prelude::*;
use blastema_robot::Types;
use std::path::Path;
use std::time::Duration;
use std::{env, fs};

/// Set, the texts are written instead of compared.
const WRITE: &str = "BLASTEMA_BLESS";

/// The line of a file that a comment names: `<!-- finding: 7 -->`, once for each finding.
fn expected_lines(text: &str) -> Vec<usize> {
    let marked = text.split("<!-- finding: ").skip(1);
    let numbers = marked.filter_map(|rest| rest.split(' ').next()?.parse().ok());
    numbers.collect()
}

#[test]
fn every_planted_mistake_is_found_at_its_line() {
    let folder = Path::new("tests/wrong");
    let entries = fs::read_dir(folder).expect("the folder is there");
    let paths = entries.map(|entry| entry.expect("it can be read").path());
    let mut files: Vec<_> =
        paths.filter(|path| path.extension().is_some_and(|e| e == "xml")).collect();
    files.sort();
    assert!(files.len() >= 25, "{} files", files.len());

    for file in files {
        let found = blastema::run(async { types().load(&file, &[]) });
        let text = format!("{}\n", found.expect_err(&file.display().to_string()));
        let golden = file.with_extension("txt");
        if env::var_os(WRITE).is_some() {
            fs::write(&golden, &text).expect("it can be written");
            continue;
        }
        let written = fs::read_to_string(&golden).unwrap_or_default();
        assert_eq!(text, written, "{}: set {WRITE}=1 to write it", file.display());

        let places = text.lines().filter_map(|line| {
            let place = line.trim_start().strip_prefix("╭─[")?.strip_suffix(']')?;
            place.split(':').nth(1)?.parse().ok()
        });
        let places: Vec<usize> = places.collect();
        let source = fs::read_to_string(&file).expect("it was read before");
        assert_eq!(places, expected_lines(&source), "{}", file.display());
    }
}

#[test]
fn a_file_that_is_not_there_is_no_mistake_of_the_robot() {
    let error = blastema::run(async { types().load(Path::new("tests/wrong/none.xml"), &[]) });
    assert!(error.expect_err("there is none").is_unreadable);
}

#[derive(Clone, Debug, Event)]
#[contract(name = "robot/brake")]
struct Brake;

/// Its code asks for a lease that no actuator has.
#[derive(Default)]
struct Brakes;

impl Component for Brakes {
    fn ports(ports: &mut Ports<Self>) {
        let lease = Duration::from_secs(3600);
        ports.actuator::<Brake>(ActuatorSpec::new(Brake, Duration::from_millis(200)).lease(lease));
    }
}

impl Handle<Brake> for Brakes {
    async fn handle(&mut self, _: Brake, _: &mut Context<Self>) {}
}

#[test]
fn a_mistake_of_the_code_is_found_once_at_the_component() {
    let folder = tempfile::TempDir::new().expect("a folder");
    let file = folder.path().join("brakes.robot.xml");
    let text = "<robot schema=\"1\" name=\"r\">\n<node name=\"base\">\n\
                <component name=\"brakes\" type=\"Brakes\"/>\n</node>\n</robot>\n";
    fs::write(&file, text).expect("it can be written");
    let types = Types::new().component::<Brakes>("Brakes");

    let found = blastema::run(async { types.load(&file, &[]) }).expect_err("it is refused");

    let found = found.to_string();
    assert_eq!(found.matches("robot::").count(), 1, "{found}");
    assert!(found.contains("brakes.robot.xml:3:"), "{found}");
}

#[test]
fn a_line_that_is_too_long_to_be_shown_is_refused() {
    let folder = tempfile::TempDir::new().expect("a folder");
    let file = folder.path().join("long.robot.xml");
    fs::write(&file, format!("<robot schema=\"1\"\nname=\"{}\"/>", "n".repeat(5_000)))
        .expect("it can be written");

    let found = blastema::run(async { types().load(&file, &[]) }).expect_err("it is refused");

    assert!(found.to_string().contains("line 2 has more than 4096 bytes"), "{found}");
}

#[test]
fn a_tree_without_end_is_a_mistake_and_no_crash() {
    let folder = tempfile::TempDir::new().expect("a folder");
    let file = folder.path().join("deep.robot.xml");
    let deep = 20_000;
    for element in ["supervisor", "process"] {
        let begins = (0..deep).map(|at| format!("<{element} name=\"s{at}\">\n"));
        let text = format!(
            "<robot schema=\"1\" name=\"r\"><node name=\"base\">\n{}{}</node></robot>\n",
            begins.collect::<String>(),
            format!("</{element}>\n").repeat(deep)
        );
        fs::write(&file, text).expect("it can be written");

        let found = blastema::run(async { types().load(&file, &[]) }).expect_err("it is refused");

        let text = "more than 64 elements stand within each other";
        assert!(found.to_string().contains(text), "{found}");
    }
}
