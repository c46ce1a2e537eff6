//! Files of behaviour trees: no text panics, each error points into the text, and what is loaded can
//! be ticked and halted.
#![no_main]

use blastema_trees::{Factory, Port, Status};
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

fuzz_target!(|text: &str| {
    let mut factory = Factory::new();
    factory.condition("C", [Port::input::<f64>("in").or("{x}")], |cx| {
        Ok(Status::from(cx.input::<f64>("in").is_ok()))
    });
    factory.action("Y", [Port::output::<i32>("out")], |cx| {
        cx.output("out", 1)?;
        Ok(Status::Success)
    });
    factory.condition("R", [], |_| Ok(Status::Running));
    let mut include = |path: &str| match path {
        "itself.xml" => Ok(text.to_owned()),
        _ => Err("no such file".to_owned()),
    };
    match factory.load_with("main.xml", text, None, &mut include) {
        Err(errors) => {
            assert!(errors.iter().next().is_some());
            for error in errors.iter() {
                assert!(error.line <= text.lines().count().max(1) + 1);
                assert!(error.column >= 1 && error.excerpt.chars().count() <= 100);
                assert!(error.to_string().lines().count() >= 3);
            }
        }
        Ok(mut tree) => {
            for tick in 0..8 {
                let _ = tree.tick(Duration::from_millis(tick * 100));
                let _ = tree.changes_as_text();
            }
            let _ = tree.tick_while_yielding(Duration::from_secs(1));
            let _ = tree.halt(Duration::from_secs(1));
            assert!(tree.nodes().all(|node| node.status == Status::Idle));
        }
    }
});
