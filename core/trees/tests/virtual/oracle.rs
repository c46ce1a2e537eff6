//! Agreement with the real library, BehaviorTree.CPP 4.8.2: its recorded answers to the study's
//! cases and to 2,000 random trees, tick by tick. `tests/oracle/record.py` records them.

use crate::scripted::{Answers, Calls, letter, register};
use blastema_trees::{Factory, LeafKind};
use serde_json::{Value as Json, json};
use std::collections::BTreeMap;
use std::process::Command;
use std::time::Duration;

/// Cases of the study that end otherwise here, each with the row of `differences.md` that says why.
const DIFFERENT: [(&str, &str); 7] = [
    ("09c", "`Switch` with a tail"),
    ("14b", "Grouping of operators"),
    ("15e", "Literals of subtrees are numbers"),
    ("16", "A leaf's error"),
    ("18c", "Halt of `WaitValueUpdate`"),
    ("T15", "`_onHalted` of a halted tree"),
    ("T18", "An entry that is erased and written again"),
];

/// What this crate answers to a recorded request, in the form of the record.
fn answers(request: &Json) -> (Vec<Json>, Option<String>) {
    let leaves: BTreeMap<String, Answers> = request["leaves"]
        .as_object()
        .unwrap()
        .iter()
        .map(|(name, leaf)| {
            let kind = match leaf["kind"].as_str().unwrap() {
                "action" => LeafKind::Action,
                "sync" => LeafKind::SyncAction,
                _ => LeafKind::Condition,
            };
            let letters = match &leaf["script"] {
                Json::String(letters) => letters.clone(),
                list => {
                    list.as_array().unwrap().iter().map(|letter| letter.as_str().unwrap()).collect()
                }
            };
            let again = leaf["loop"].as_bool().unwrap_or(false);
            (name.clone(), Answers { kind, letters, again })
        })
        .collect();
    let (mut factory, calls) = (Factory::new(), Calls::default());
    register(&mut factory, &leaves, &calls);
    let mut tree = match factory.load("case.xml", request["xml"].as_str().unwrap()) {
        Ok(tree) => tree,
        Err(errors) => return (Vec::new(), Some(format!("load: {errors}"))),
    };
    let mut answers = Vec::new();
    for tick in 0..request["ticks"].as_u64().unwrap() {
        let now = Duration::from_millis(tick);
        for set in request["set_before"][tick.to_string()].as_array().into_iter().flatten() {
            let key = set[0].as_str().unwrap();
            match &set[2] {
                Json::Bool(value) => tree.set(key, *value),
                Json::Number(value) => tree.set(key, value.as_i64().unwrap()),
                text => tree.set(key, text.as_str().unwrap().to_owned()),
            }
            .unwrap();
        }
        let halts = request["halt_at"].as_array();
        if halts.is_some_and(|halts| halts.contains(&json!(tick))) {
            tree.halt(now).unwrap();
            answers.push(json!(["H", calls.take(), {}]));
            continue;
        }
        let once = request["mode"] == "once";
        let status = if once { tree.tick_while_yielding(now) } else { tree.tick(now) };
        let status = match status {
            Ok(status) => letter(status).to_string(),
            Err(error) => return (answers, Some(format!("tick: {error}"))),
        };
        let mut watched = serde_json::Map::new();
        for watch in request["watch"].as_array().into_iter().flatten() {
            let key = watch[0].as_str().unwrap();
            let value = tree.value(key).and_then(blastema_trees::Value::as_int);
            watched.insert(key.to_owned(), json!(value));
        }
        answers.push(json!([status, calls.take(), watched]));
    }
    (answers, None)
}

/// Where this crate and the library part, if they do.
fn difference(line: &str) -> Option<String> {
    let request: Json = serde_json::from_str(line).unwrap();
    let (ours, error) = answers(&request);
    let theirs = request["answers"].as_array().unwrap();
    let name = request["title"].as_str().unwrap();
    let xml = request["xml"].as_str().unwrap();
    for (tick, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
        if ours != theirs {
            return Some(format!("{name}: tick {tick}:\n{xml}\nthey: {theirs}\nwe:   {ours}\n"));
        }
    }
    let their_error = request["error"].as_str();
    let our_error = error.as_deref().and_then(|error| error.split(':').next());
    (our_error != their_error || ours.len() != theirs.len()).then(|| {
        let text = request["text"].as_str().unwrap_or("no error");
        format!("{name}:\n{xml}\nthey end: {text}\nwe end:   {error:?}\n")
    })
}

#[test]
fn the_cases_of_the_study_end_as_in_the_library_or_are_named_differences() {
    let page = include_str!("../../src/differences.md");
    let mut wrong = Vec::new();
    let mut different = Vec::new();
    for line in include_str!("../oracle/cases.jsonl").lines() {
        let Some(difference) = difference(line) else { continue };
        let known = DIFFERENT.iter().find(|(case, _)| {
            difference.strip_prefix(case).is_some_and(|rest| !rest.starts_with(char::is_alphabetic))
        });
        match known {
            Some((case, row)) => {
                assert!(page.contains(&format!("| {row} ")), "no row `{row}` for {case}");
                different.push(*case);
            }
            None => wrong.push(difference),
        }
    }

    assert!(wrong.is_empty(), "{} cases:\n{}", wrong.len(), wrong.join("\n"));
    assert_eq!(different, DIFFERENT.map(|(case, _)| case));
}

/// The lines of a compressed record.
fn unpacked(record: &[u8]) -> String {
    let lines = miniz_oxide::inflate::decompress_to_vec_zlib(record).unwrap();
    String::from_utf8(lines).unwrap()
}

/// Scripts, subtrees and `TryCatch` by hand, and 500 random trees with many `TryCatch`.
#[test]
fn what_is_newer_than_the_recorded_trees_answers_as_in_version_4_10_of_the_library() {
    let lines = unpacked(include_bytes!("../oracle/later.z"));

    let wrong: Vec<String> = lines.lines().filter_map(difference).collect();

    assert!(lines.lines().count() > 550);
    assert!(wrong.is_empty(), "{} of them:\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn two_thousand_random_trees_answer_tick_by_tick_as_in_the_library() {
    let lines = unpacked(include_bytes!("../oracle/random.z"));

    let wrong: Vec<String> = lines.lines().filter_map(difference).collect();

    assert_eq!(lines.lines().count(), 2_000);
    assert!(
        wrong.is_empty(),
        "{} trees; the first ones:\n{}",
        wrong.len(),
        wrong[..wrong.len().min(3)].join("\n")
    );
}

/// With `BLASTEMA_LONG=1` where `BLASTEMA_PYTHON`, or `python3`, has the library.
#[test]
fn ten_thousand_fresh_random_trees_answer_as_in_the_library_where_it_is_installed() {
    if std::env::var_os("BLASTEMA_LONG").is_none() {
        return;
    }
    let python = std::env::var("BLASTEMA_PYTHON").unwrap_or_else(|_| "python3".into());
    let installed = Command::new(&python).args(["-c", "import behaviortreepy"]).output();
    if !installed.is_ok_and(|output| output.status.success()) {
        return;
    }
    let seed = std::env::var("BLASTEMA_SEED").ok().and_then(|seed| seed.parse().ok());
    let first: u64 = seed.unwrap_or(100_000);
    for from in (first..first + 10_000).step_by(1_000) {
        let output = Command::new(&python)
            .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle/record.py"))
            .args(["fresh", &from.to_string(), &(from + 1_000).to_string()])
            .output()
            .unwrap();
        let lines = String::from_utf8(output.stdout).unwrap();

        let wrong: Vec<String> = lines.lines().filter_map(difference).collect();

        assert_eq!(lines.lines().count(), 1_000);
        assert!(wrong.is_empty(), "{} trees from seed {from}:\n{}", wrong.len(), wrong[0]);
    }
}
