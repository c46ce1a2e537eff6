//! What only Unix-domain sockets do.

use actix::prelude::*;
use blastema_contract::transport::{
    Attach, Close, MediumAddress, ReadCounters, Received, Transmit, TransportReport,
};
use blastema_doubles::{PATIENCE, Probe};
use blastema_transports::{Unix, UnixConfig};
use std::future::Future;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

struct Node {
    transport: Addr<Unix>,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
}

fn run(test: impl Future<Output = ()>) {
    actix_rt::System::new().block_on(test);
}

impl Node {
    fn at(path: &Path) -> Self {
        Node::with(UnixConfig::new(path))
    }

    fn with(config: UnixConfig) -> Self {
        let transport = Unix::new(config).start();
        let (frames, reports) = (Probe::start(), Probe::start());
        let attach = Attach::new(frames.recipient(), reports.recipient());
        transport.do_send(attach);
        Node { transport, frames, reports }
    }

    async fn opened(&self) {
        let report = self.reports.expect().await;
        assert!(matches!(report, TransportReport::Opened { .. }), "{report:?}");
    }

    async fn closed(&self) -> String {
        match self.reports.expect().await {
            TransportReport::Closed { reason } => reason,
            other => panic!("{other:?}"),
        }
    }

    fn send(&self, to: &Path, frame: &'static str) {
        let to = MediumAddress::Unix(to.into());
        self.transport.do_send(Transmit::new(to, frame.into()));
    }
}

struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        Folder(TempDir::new().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
}

#[test]
fn a_socket_that_a_dead_process_has_left_is_taken_over() {
    let _turn = blastema_doubles::turn();
    run(async {
        let folder = Folder::new();
        let (a, b) = (folder.path("a"), folder.path("b"));
        // The file stays when a process dies, or when, as here, it is not removed.
        drop(UnixListener::bind(&a).unwrap());
        assert!(a.exists());

        let (left, right) = (Node::at(&a), Node::at(&b));
        left.opened().await;
        right.opened().await;
        right.send(&a, "hello");

        assert_eq!(left.frames.expect().await.from, MediumAddress::Unix(b.as_path().into()));
    });
}

#[test]
fn what_is_no_socket_or_is_another_programs_is_left_alone_and_named() {
    let _turn = blastema_doubles::turn();
    run(async {
        let folder = Folder::new();
        let (file, foreign) = (folder.path("file"), folder.path("foreign"));
        std::fs::write(&file, "precious").unwrap();
        let program = UnixListener::bind(&foreign).unwrap();

        let reason = Node::at(&file).closed().await;
        assert!(reason.contains("there is a file that is no socket: remove it"), "{reason}");
        let reason = Node::at(&foreign).closed().await;
        assert!(reason.contains("another process uses the socket"), "{reason}");
        let reason = Node::at(&folder.path("missing/x")).closed().await;
        assert!(reason.contains("its folder does not exist: create it"), "{reason}");
        let reason = Node::at(&folder.path(&"x".repeat(200))).closed().await;
        assert!(reason.contains("more than 107 bytes: choose a shorter one"), "{reason}");

        assert_eq!(std::fs::read(&file).unwrap(), b"precious");
        let mut caller = UnixStream::connect(&foreign).unwrap();
        caller.write_all(b"still there").unwrap();
        drop(program);
    });
}

#[test]
fn the_permissions_are_as_told_from_the_first_moment_and_the_file_goes_with_the_transport() {
    let _turn = blastema_doubles::turn();
    run(async {
        let folder = Folder::new();
        let (usual, group) = (folder.path("usual"), folder.path("group"));
        let mut config = UnixConfig::new(&group);
        config.mode = 0o660;
        let nodes = [Node::at(&usual), Node::with(config)];
        for (node, path, mode) in [(&nodes[0], &usual, 0o600), (&nodes[1], &group, 0o660)] {
            node.opened().await;
            let permissions = std::fs::metadata(path).unwrap().permissions();
            assert_eq!(permissions.mode() & 0o777, mode);
        }

        for node in nodes {
            node.transport.send(Close).await.unwrap();
        }
        assert!(!usual.exists() && !group.exists());
    });
}

#[test]
fn the_death_of_a_peer_is_reported_at_once_though_nothing_is_sent() {
    let _turn = blastema_doubles::turn();
    run(async {
        let folder = Folder::new();
        let (a, b) = (folder.path("a"), folder.path("b"));
        let (left, right) = (Node::at(&a), Node::at(&b));
        left.opened().await;
        right.opened().await;
        right.send(&a, "hello");
        left.frames.expect().await;

        right.transport.do_send(Close);

        let peer = MediumAddress::Unix(b.as_path().into());
        assert_eq!(left.reports.expect().await, TransportReport::PeerLost { peer });
    });
}

#[test]
fn whoever_claims_no_path_is_refused_and_counted() {
    let _turn = blastema_doubles::turn();
    run(async {
        let folder = Folder::new();
        let a = folder.path("a");
        let left = Node::at(&a);
        left.opened().await;

        let words = [&b"GET / HTTP/1.1\r\n"[..], b"BLST\x01\x01\0\0", b"BLST\x01\x01\xff\xff"];
        for (before, words) in words.into_iter().enumerate() {
            let mut stranger = UnixStream::connect(&a).unwrap();
            stranger.write_all(words).unwrap();
            // A connection that is closed before its preamble was read is no refusal.
            let refused = async {
                while left.transport.send(ReadCounters).await.unwrap().refused == before as u64 {
                    tokio::task::yield_now().await;
                }
            };
            assert!(tokio::time::timeout(PATIENCE, refused).await.is_ok());
        }
        assert!(left.reports.drain().is_empty());
    });
}
