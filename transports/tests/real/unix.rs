//! What only Unix-domain sockets do.

use crate::conformance::end::End;
use actix::Actor;
use blastema_contract::transport::{Close, MediumAddress, TransportReport};
use blastema_transports::{Unix, UnixConfig};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

fn at(path: &Path) -> End {
    with(UnixConfig::new(path))
}

fn with(config: UnixConfig) -> End {
    End::new(Unix::new(config).start())
}

fn address(path: &Path) -> MediumAddress {
    MediumAddress::Unix(path.into())
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

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_socket_that_a_dead_process_has_left_is_taken_over() {
    let folder = Folder::new();
    let (a, b) = (folder.path("a"), folder.path("b"));
    // The file stays when a process dies, or when, as here, it is not removed.
    drop(UnixListener::bind(&a).unwrap());
    assert!(a.exists());

    let (left, right) = (at(&a), at(&b));
    left.opened().await;
    right.opened().await;
    right.send(address(&a), "hello");

    left.expect(address(&b), "hello").await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_is_no_socket_or_is_another_programs_is_left_alone_and_named() {
    let folder = Folder::new();
    let (file, foreign) = (folder.path("file"), folder.path("foreign"));
    std::fs::write(&file, "precious").unwrap();
    let program = UnixListener::bind(&foreign).unwrap();

    let reason = at(&file).closed().await;
    assert!(reason.contains("there is a file that is no socket: remove it"), "{reason}");
    let reason = at(&foreign).closed().await;
    assert!(reason.contains("another process uses the socket"), "{reason}");
    let reason = at(&folder.path("missing/x")).closed().await;
    assert!(reason.contains("its folder does not exist: create it"), "{reason}");
    let reason = at(&folder.path(&"x".repeat(200))).closed().await;
    assert!(reason.contains("more than 107 bytes: choose a shorter one"), "{reason}");

    assert_eq!(std::fs::read(&file).unwrap(), b"precious");
    let mut caller = UnixStream::connect(&foreign).unwrap();
    caller.write_all(b"still there").unwrap();
    drop(program);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn the_permissions_are_as_told_from_the_first_moment_and_the_file_goes_with_the_transport() {
    let folder = Folder::new();
    let (usual, group) = (folder.path("usual"), folder.path("group"));
    let mut config = UnixConfig::new(&group);
    config.mode = 0o660;
    let nodes = [at(&usual), with(config)];
    for (node, path, mode) in [(&nodes[0], &usual, 0o600), (&nodes[1], &group, 0o660)] {
        node.opened().await;
        let permissions = std::fs::metadata(path).unwrap().permissions();
        assert_eq!(permissions.mode() & 0o777, mode);
    }

    for node in nodes {
        node.transport.close.send(Close).await.unwrap();
    }
    assert!(!usual.exists() && !group.exists());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn the_death_of_a_peer_is_reported_at_once_though_nothing_is_sent() {
    let folder = Folder::new();
    let (a, b) = (folder.path("a"), folder.path("b"));
    let (left, right) = (at(&a), at(&b));
    left.opened().await;
    right.opened().await;
    right.send(address(&a), "hello");
    left.frames.expect().await;

    right.transport.close.do_send(Close);

    let peer = address(&b);
    assert_eq!(left.reports.expect().await, TransportReport::PeerLost { peer });
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn whoever_claims_no_path_is_refused_and_counted() {
    let folder = Folder::new();
    let a = folder.path("a");
    let left = at(&a);
    left.opened().await;

    let words = [&b"GET / HTTP/1.1\r\n"[..], b"BLST\x01\x01\0\0", b"BLST\x01\x01\xff\xff"];
    for (before, words) in words.into_iter().enumerate() {
        let mut stranger = UnixStream::connect(&a).unwrap();
        stranger.write_all(words).unwrap();
        // A connection that is closed before its preamble was read is no refusal.
        left.counted(|counters| counters.refused > before as u64).await;
    }
    assert!(left.reports.drain().is_empty());
}
