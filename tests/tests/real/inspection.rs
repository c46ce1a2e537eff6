//! A node as another process sees it, through its inspection socket.

use blastema::StartError;
use blastema::prelude::*;
use blastema_tests::{Part, serves, until};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(30);

/// Dies of whatever is asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "inspection/strike", reply = ())]
struct Strike;

fn lamp(name: &str) -> ChildSpec<Part<(), Strike>> {
    serves(name, (), |_, _: Strike, _| panic!("struck"))
}

/// A node that enters the safe state at the first panic.
fn fragile(socket: &Path) -> blastema::NodeBuilder {
    Node::builder("module1")
        .child(lamp("lamp").essential())
        .intensity(0, Duration::from_secs(10))
        .inspection_socket(socket)
}

async fn look(socket: &Path) -> String {
    let seen = async {
        let mut text = String::new();
        let mut socket = loop {
            match UnixStream::connect(socket).await {
                // As many as the system lets wait do so already.
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                connected => break connected.expect("the node is shown"),
            }
        };
        socket.read_to_string(&mut text).await.expect("it is text");
        text
    };
    tokio::time::timeout(LONG, seen).await.expect("the node answers a client")
}

/// Such a node, and where it is shown.
struct Shown {
    /// It goes with the test.
    folder: tempfile::TempDir,
    socket: PathBuf,
    node: Node,
}

impl Shown {
    async fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("module1.sock");
        let node = fragile(&socket).start().await.unwrap();
        Shown { folder, socket, node }
    }
}

#[test]
fn a_node_is_seen_at_safe_rest_with_the_reason_and_not_once_it_is_shut_down() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let Shown { folder: _folder, socket, node } = Shown::start().await;
        assert!(look(&socket).await.contains(r#""state":"running""#));

        let strike: Sender<Strike> = node.sender("lamp").unwrap();
        strike.ask_within(Strike, LONG).await.unwrap_err();
        assert!(matches!(node.ended().await, NodeState::InSafeState { .. }));
        let seen = look(&socket).await;
        assert!(seen.contains(r#""state":"in safe state""#) && seen.contains("struck"), "{seen}");

        node.shutdown().await;
        until(async || !socket.exists(), "the socket goes").await;
    });
}

#[test]
fn those_who_look_and_do_not_read_do_not_keep_others_from_looking() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let Shown { folder: _folder, socket, node } = Shown::start().await;
        let mut gazing = Vec::new();
        while gazing.len() < 200 {
            match UnixStream::connect(&socket).await {
                Ok(stranger) => gazing.push(stranger),
                // As many as the system lets wait do so already.
                Err(_) => tokio::time::sleep(Duration::from_millis(1)).await,
            }
        }

        assert!(look(&socket).await.ends_with("}\n"));
        assert!(node.snapshot().await.contains(r#""node":"module1""#));
        node.shutdown().await;
    });
}

#[test]
fn a_picture_that_nobody_takes_keeps_nobody_from_taking_his() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("module1.sock");
        // More than the system buffers for a client that does not read.
        let lamps = (0..1500).map(|n| lamp(&format!("lamp/{n}")));
        let node =
            lamps.fold(fragile(&socket), blastema::NodeBuilder::child).start().await.unwrap();
        let mut gazing = Vec::new();
        for _ in 0..20 {
            gazing.push(UnixStream::connect(&socket).await.unwrap());
        }

        let seen = look(&socket).await;

        assert!(seen.len() > 300_000 && seen.ends_with("}\n"), "{}", seen.len());
        node.shutdown().await;
    });
}

/// What is said to a node with safe outputs that cannot be shown there.
async fn refused(socket: &Path) -> String {
    let applied = Arc::new(AtomicBool::new(false));
    let applies = applied.clone();
    let builder = Node::builder("module2").safe_outputs(move |_| applies.store(true, SeqCst));
    let refused = builder.inspection_socket(socket).start().await.unwrap_err();
    assert!(
        matches!(refused, StartError::Setting { setting: "inspection_socket", .. }),
        "{refused}"
    );
    assert!(!applied.load(SeqCst), "the outputs may be those of a robot that runs");
    refused.to_string()
}

#[test]
fn two_nodes_are_not_shown_at_one_socket() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let Shown { folder: _folder, socket, node } = Shown::start().await;

        let second = refused(&socket).await;

        assert!(second.contains("another process uses the socket"), "{second}");
        assert!(look(&socket).await.contains("module1"), "the first is unharmed");
        node.shutdown().await;
    });
}

#[test]
fn a_path_that_can_be_no_socket_is_refused_at_start_with_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "precious").unwrap();
        let long = folder.path().join("w".repeat(120));
        let cases: [(&Path, &str); 7] = [
            (Path::new("module1.sock"), "give the absolute path"),
            (Path::new(""), "give the absolute path"),
            (folder.path(), "the path is that of a folder: give the path of a file in it"),
            (&file, "no socket: remove it, or choose another path"),
            (&file.join("socket"), "what should be its folder is none: choose another"),
            (&long, "choose a shorter one"),
            // Not even root may create anything there, whether it is forbidden or cannot be written
            // to.
            (Path::new("/sys/module1.sock"), "choose another"),
        ];
        for (path, advice) in cases {
            let told = refused(path).await;
            assert!(told.contains(advice), "{path:?}: {told}");
        }
        assert_eq!(std::fs::read(&file).unwrap(), b"precious");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left there");
    });
}
