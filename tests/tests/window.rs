//! A node as another process sees it, through its window.

use blastema::StartError;
use blastema::prelude::*;
use std::path::Path;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(30);

/// Dies of whatever is asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "window/strike", reply = ())]
struct Strike;

struct Lamp;

impl Component for Lamp {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Strike>();
    }
}

impl Handle<Strike> for Lamp {
    async fn handle(&mut self, _: Strike, _: &mut Context<Self>) {
        panic!("struck");
    }
}

/// A node that comes to rest at the first blow.
fn fragile(window: &Path) -> blastema::NodeBuilder {
    Node::builder("module1")
        .child(ChildSpec::new("lamp", || Lamp))
        .intensity(0, Duration::from_secs(10))
        .shown_at(window)
}

async fn look(window: &Path) -> String {
    let seen = async {
        let mut text = String::new();
        let mut window = UnixStream::connect(window).await.expect("the node is shown");
        window.read_to_string(&mut text).await.expect("it is text");
        text
    };
    tokio::time::timeout(LONG, seen).await.expect("nobody looks so long")
}

#[test]
fn a_node_is_seen_at_safe_rest_with_the_reason_and_not_once_it_is_shut_down() {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let window = folder.path().join("module1.window");
        let node = fragile(&window).start().await.unwrap();
        assert!(look(&window).await.contains(r#""state":"running""#));

        let strike: Sender<Strike> = node.sender("lamp").unwrap();
        strike.ask_within(Strike, LONG).await.unwrap_err();
        assert!(matches!(node.ended().await, NodeState::AtRest { .. }));
        let seen = look(&window).await;
        assert!(seen.contains(r#""state":"at rest""#) && seen.contains("struck"), "{seen}");

        node.shutdown().await;
        while window.exists() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    });
}

#[test]
fn those_who_look_and_do_not_read_do_not_keep_others_from_looking() {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let window = folder.path().join("module1.window");
        let node = fragile(&window).start().await.unwrap();
        let mut gazing = Vec::new();
        for _ in 0..20 {
            gazing.push(UnixStream::connect(&window).await.unwrap());
        }

        assert_eq!(node.picture().await.node.as_str(), "module1");
        drop(gazing);
        assert!(look(&window).await.ends_with("}\n"));
        node.shutdown().await;
    });
}

#[test]
fn two_nodes_are_not_shown_at_one_window() {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let window = folder.path().join("module1.window");
        let node = fragile(&window).start().await.unwrap();

        let second = Node::builder("module2").shown_at(&window).start().await.unwrap_err();

        assert!(matches!(&second, StartError::Shown(why) if why.contains("another process")));
        assert!(look(&window).await.contains("module1"), "the first is unharmed");
        node.shutdown().await;
    });
}
