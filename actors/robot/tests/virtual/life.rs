//! A tree is started as one operation, which completes or is undone, and stopped as one.

use blastema::prelude::*;
use blastema_robot::Types;
use std::cell::RefCell;
use std::path::Path;

thread_local! {
    /// What the components of a test have done, in its order.
    static DONE: RefCell<Vec<String>> = const { RefCell::new(Vec::new()) };
}

fn note<C: Component>(cx: &Context<C>, what: &str) {
    DONE.with_borrow_mut(|done| done.push(format!("{} {what}", cx.name())));
}

/// Notes what becomes of it.
#[derive(Default)]
struct Part;

impl Component for Part {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        note(cx, "begins");
        Ok(())
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        note(cx, "ends");
        Ok(())
    }
}

/// Fails in `on_initialize`.
#[derive(Default)]
struct Broken;

impl Component for Broken {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        note(cx, "fails");
        Err(Failure::fatal("its device is on fire"))
    }
}

/// Starts and stops the only node of a file, and returns why it did not start.
fn run(file: &str) -> (Option<String>, Vec<String>) {
    let types = Types::new().component::<Part>("Part").component::<Broken>("Broken");
    let refused = blastema::run(async {
        let robot = types.load(Path::new(file), &[]).expect("it is right");
        let builder = types.node(&robot, "base").expect("it is there");
        match builder.on_this_thread().start().await {
            Ok(node) => {
                node.shutdown().await;
                None
            }
            Err(error) => Some(error.to_string()),
        }
    });
    (refused, DONE.take())
}

#[test]
fn children_start_in_the_order_of_the_file_and_stop_in_reverse() {
    let (refused, done) = run("tests/right/life.robot.xml");

    assert_eq!(refused, None);
    let begun = ["map", "laser", "filter", "motors"];
    let begins = begun.iter().map(|name| format!("{name} begins"));
    let ends = begun.iter().rev().map(|name| format!("{name} ends"));
    assert_eq!(done, begins.chain(ends).collect::<Vec<_>>());
}

#[test]
fn a_start_that_cannot_be_completed_is_undone_with_the_reason() {
    let (refused, mut done) = run("tests/right/undone.robot.xml");

    let refused = refused.expect("it cannot start");
    assert!(refused.contains("broken"), "{refused}");
    assert!(refused.contains("its device is on fire"), "{refused}");
    // The plan tries again before the supervisor gives up.
    done.dedup();
    assert_eq!(done, ["map begins", "laser begins", "broken fails", "laser ends", "map ends"]);
}

#[test]
fn a_temporary_component_that_cannot_start_may_be_missing() {
    let folder = tempfile::tempdir().expect("a folder");
    let (file, undone) = (folder.path().join("spare.xml"), "tests/right/undone.robot.xml");
    let text = std::fs::read_to_string(undone).expect("it is there");
    let text = text.replace("type=\"Broken\"", "type=\"Broken\" restart=\"temporary\"");
    std::fs::write(&file, text).expect("it can be written");

    let (refused, done) = run(&file.display().to_string());

    assert_eq!(refused, None);
    let begun = ["map begins", "laser begins", "broken fails", "motors begins"];
    assert_eq!(done, [&begun[..], &["motors ends", "laser ends", "map ends"]].concat());
}
