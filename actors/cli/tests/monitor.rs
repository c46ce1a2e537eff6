//! The program looks at a real node through its window.

use blastema::prelude::*;
use blastema::{ServiceSpec, Stateful};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

struct Lamp;
impl Component for Lamp {}
impl Stateful for Lamp {
    fn save(&self) -> Vec<u8> {
        Vec::new()
    }

    fn load(&mut self, _: &[u8]) -> Result<(), Failure> {
        Ok(())
    }
}

/// Looks from a process of its own, while the node goes on here.
async fn monitor(arguments: &[&str]) -> Output {
    let mut program = tokio::process::Command::from(Command::new(env!("CARGO_BIN_EXE_blastema")));
    program.arg("monitor").args(arguments).output().await.expect("the program can be started")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of letters")
}

#[test]
fn a_running_node_is_shown_as_tables_and_as_json_and_no_more_once_it_has_stopped() {
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let window = folder.path().join("module1.window");
        let builder = Node::builder("module1")
            .work_threads(1)
            .child(ChildSpec::new("lamp", || Lamp))
            .service(ServiceSpec::new("light/room", ["module1", "module2"], || Lamp))
            .shown_at(&window);
        let node = builder.start().await.expect("the node starts");
        let _claim = node.claim_for("light", "lamp", blastema::ClaimPolicy::Refuse).await;

        let json = monitor(&["--json", text(&window)]).await;
        assert!(json.status.success(), "{json:?}");
        let picture: Value = serde_json::from_slice(&json.stdout).expect("a JSON document");
        assert_eq!((&picture["node"], &picture["state"]), (&"module1".into(), &"running".into()));
        let row = |part: &str, key: &str, value: &str| -> Value {
            let rows = picture[part].as_array().expect("a list");
            rows.iter().find(|row| row[key] == value).cloned().unwrap_or_default()
        };
        assert_eq!(row("table", "place", "module1:lamp")["state"], "active", "{picture}");
        let thread = row("threads", "kind", "shared");
        assert_eq!(thread["state"], "alive", "{picture}");
        assert_eq!(thread["components"], serde_json::json!(["lamp", "light/room/replica"]));
        let service = row("services", "name", "light/room");
        assert_eq!(service["state"], "candidate", "{picture}");
        assert_eq!(service["unheard"], serde_json::json!(["module2"]));
        assert_eq!(row("claims", "name", "light")["object"], "lamp");

        let tables = monitor(&[text(&window)]).await;
        let shown = String::from_utf8(tables.stdout).expect("text");
        for part in
            ["module1 running", "objects", "module1:lamp", "threads", "claimed names", "services"]
        {
            assert!(shown.contains(part), "{part} is missing in\n{shown}");
        }

        node.shutdown().await;
        let gone = monitor(&[text(&window)]).await;
        let told = String::from_utf8(gone.stderr).expect("text");
        assert_eq!(gone.status.code(), Some(2), "{told}");
        assert!(told.contains("no node answers at") && told.contains("shown_at"), "{told}");
    });
}

#[test]
fn a_window_that_cannot_be_opened_is_refused_at_start_with_what_to_do() {
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let window = folder.path().join("nowhere/module1.window");
        let error =
            Node::builder("module1").shown_at(&window).start().await.expect_err("no folder");
        assert!(error.to_string().contains("create it"), "{error}");
    });
}
