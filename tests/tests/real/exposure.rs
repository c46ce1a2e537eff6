//! Which networks a node starts on, how insecure ones are shown, and which users' processes are
//! refused. No other test here keeps a log: a subscriber counts for all threads.

use blastema::medium::{
    Bytes, FrameLane, FrameMedium, MediumAddress, MediumEvent, OpenedMedium, Reach, SendResult,
};
use blastema::prelude::*;
use blastema::{MemoryMedium, Network, NodeBuilder, StartError};
use blastema_tests::{LogLines, PATIENCE, Process, addresses, role, until};
use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::OnceLock;
use std::task::{self, Poll};
use tokio::io::AsyncReadExt;
use tokio::net::UnixStream;
use tracing::Level;

/// The user that owns no files, by its number on every Linux system.
const OTHER_USER: u32 = 65_534;
/// What the process of the other user accepts.
const USERS: &str = "BLASTEMA_TEST_USERS";

/// What was logged at INFO and above.
static LOG: OnceLock<LogLines> = OnceLock::new();

fn keep_log() {
    LOG.get_or_init(|| {
        let log = LogLines::of(|metadata| *metadata.level() <= Level::INFO);
        tracing::subscriber::set_global_default(log.clone()).expect("it is the first");
        log
    });
}

/// How many messages have all of these words.
fn logged(words: &[&str]) -> usize {
    let log = LOG.get().expect("it is kept").lines.all();
    let messages = log.iter().filter_map(|line| line.get("message"));
    messages.filter(|line| words.iter().all(|word| line.contains(word))).count()
}

/// A medium that does not say how far it reaches.
struct Silent;

impl FrameMedium for Silent {
    fn name(&self) -> String {
        "silent".to_owned()
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        Ok(OpenedMedium { local: MediumAddress::Line, mtu: 1_000 })
    }

    fn knows(&self, _: &MediumAddress) -> bool {
        true
    }

    fn poll_send(
        &mut self,
        _: &mut task::Context<'_>,
        _: &MediumAddress,
        _: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        Poll::Ready(Ok(SendResult::Dropped))
    }

    fn poll_receive(&mut self, _: &mut task::Context<'_>) -> Poll<io::Result<MediumEvent>> {
        Poll::Pending
    }

    fn close(&mut self) {}
}

fn with(network: Network) -> NodeBuilder {
    Node::builder("module1").work_threads(1).network(network)
}

async fn insecure_faults(node: &Node) -> Vec<String> {
    let entries = node.faults().await.entries.into_iter();
    let standing =
        entries.filter(|entry| entry.stands() && entry.fault.kind == FaultKind::Insecure);
    standing.map(|entry| entry.fault.to_string()).collect()
}

#[test]
fn a_network_that_leaves_the_computer_starts_only_when_it_is_insecure_and_is_shown_as_that() {
    let _turn = blastema_doubles::turn();
    keep_log();
    blastema::run(async {
        let at = |endpoint: &'static str| move || Network::new("lan", endpoint);
        let group = || Network::new("lan", "udp://[::1]:0").discover_all("[ff15::1]:7399");
        type Describe = Box<dyn Fn() -> Network>;
        let leaving: [(&str, Describe); 8] = [
            ("udp://0.0.0.0:0", Box::new(at("udp://0.0.0.0:0"))),
            ("udp://[::]:0", Box::new(at("udp://[::]:0"))),
            ("tcp://0.0.0.0:0", Box::new(at("tcp://0.0.0.0:0"))),
            ("serial:///dev/ttyS99", Box::new(at("serial:///dev/ttyS99"))),
            ("can://can99", Box::new(at("can://can99"))),
            ("slcan:///dev/ttyS99", Box::new(at("slcan:///dev/ttyS99"))),
            ("silent", Box::new(|| Network::own("lan", Silent))),
            ("udp://[::1]:0", Box::new(group)),
        ];
        for (medium, network) in leaving {
            let Err(error) = with(network()).start().await else { panic!("{medium} started") };
            assert!(matches!(error, StartError::Insecure { .. }), "{error}");
            let text = error.to_string();
            for words in ["network lan", medium, "blastema keys new", ".keys(", "`.insecure()`"] {
                assert!(text.contains(words), "{text}");
            }

            let node = with(network().insecure()).start().await.expect(medium);
            until(async || !insecure_faults(&node).await.is_empty(), "a fault").await;
            assert_eq!(
                insecure_faults(&node).await,
                [format!(
                    "warning: insecure of module1:transport/lan: network lan ({medium}) is \
                     insecure: every station on it can command this robot"
                )]
            );
            let row = &node.networks()[0];
            assert_eq!((&*row.network, &*row.medium), ("lan", medium));
            assert!(row.insecure && row.reach == Reach::Network, "{row:?}");
            let json = node.snapshot().await;
            let shown = format!(r#""insecure":true,"medium":"{medium}""#);
            assert!(json.contains(&shown), "{shown} in {json}");
            node.shutdown().await;
        }
        // The word may stand in the text, with other settings and with a value.
        for text in ["udp://0.0.0.0:0?insecure", "udp://0.0.0.0:0?mtu=999&insecure=true"] {
            with(Network::new("lan", text)).start().await.expect(text).shutdown().await;
        }
        let Err(error) = with(Network::new("lan", "udp://0.0.0.0:0?insecure=false")).start().await
        else {
            panic!("it started")
        };
        assert!(matches!(error, StartError::Insecure { .. }), "{error}");
    });
}

#[test]
fn a_network_that_stays_in_the_computer_starts_and_one_at_a_loopback_address_logs_who_reaches_it() {
    let _turn = blastema_doubles::turn();
    keep_log();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let unix = format!("unix://{}", folder.path().join("module1.sock").display());
        let memory = MemoryMedium::default();
        let here: [(&str, Network); 6] = [
            ("memory://exposure", Network::new("inner", "memory://exposure")),
            ("memory://end", Network::memory("inner", &memory, "end")),
            (&unix, Network::new("inner", &unix)),
            ("udp://127.0.0.1:0", Network::new("inner", "udp://127.0.0.1:0")),
            ("tcp://[::1]:0", Network::new("inner", "tcp://[::1]:0").insecure()),
            (
                "udp://127.0.0.2:0",
                Network::new("inner", "udp://127.0.0.2:0").discover_all("239.255.77.8:7399"),
            ),
        ];
        for (medium, network) in here {
            let node = with(network).start().await.expect(medium);

            assert!(!node.networks()[0].insecure, "{medium}");
            let text = format!("any user of this computer can speak to this node over {medium}");
            let is_ip = medium.starts_with("udp") || medium.starts_with("tcp");
            assert_eq!(logged(&[&text]), usize::from(is_ip), "{medium}");
            assert_eq!(insecure_faults(&node).await, [""; 0], "{medium}");
            node.shutdown().await;
        }
    });
}

fn socket(folder: &Path, name: &str) -> String {
    folder.join(name).display().to_string()
}

/// The node `own` at a Unix socket that every user may open, with its neighbour there.
fn on_socket(folder: &Path, own: &str, peer: &str, users: &str) -> NodeBuilder {
    let endpoint = format!("unix://{}?mode=666{users}", socket(folder, own));
    let network = Network::new("local", &endpoint).peer(peer, &socket(folder, peer));
    Node::builder(own).work_threads(1).network(network)
}

/// Whether there are other users here: only root can become one.
fn can_be_another_user() -> bool {
    let root = rustix::process::geteuid().is_root();
    if !root {
        let skipped = "SKIPPED: processes of another user are started by root only\n";
        io::stderr().write_all(skipped.as_bytes()).expect("standard error is open");
    }
    root
}

/// A folder in which every user may create sockets.
fn open_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    fs::set_permissions(folder.path(), Permissions::from_mode(0o777)).expect("it is ours");
    folder
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    keep_log();
    let folder = addresses::<String>().remove(0);
    let folder = Path::new(&folder);
    let users = std::env::var(USERS).unwrap_or_default();
    blastema::run(async {
        match role.as_str() {
            "node" => {
                let builder = on_socket(folder, "module2", "module1", &users);
                let node = builder.start().await.expect("it starts");
                if users.is_empty() {
                    refused_both_ways(0).await;
                    node.shutdown().await;
                } else {
                    std::future::pending::<()>().await;
                }
            }
            "client" => assert_eq!(read_socket(&folder.join("shown")).await, ""),
            other => panic!("there is no role {other}"),
        }
    });
}

/// Both the process that listens and the one that connected are refused for their user.
async fn refused_both_ways(user: u32) {
    for process in ["the process there", "a process that connected"] {
        let words = [process, &format!("runs as uid {user}"), &format!("add users={user}")];
        until(async || logged(&words) > 0, &format!("{process} is refused")).await;
    }
}

async fn read_socket(path: &Path) -> String {
    let mut text = String::new();
    let mut stream = UnixStream::connect(path).await.expect("the socket's mode permits it");
    stream.read_to_string(&mut text).await.expect("it is text");
    text
}

#[test]
fn a_process_of_another_user_speaks_over_a_unix_socket_only_where_both_ends_list_the_user() {
    let _turn = blastema_doubles::turn();
    if !can_be_another_user() {
        return;
    }
    keep_log();
    let start = |folder: &Path, users: &str| {
        let (addresses, users) = ([folder.display().to_string()], users.to_owned());
        Process::start_as(
            OTHER_USER,
            folder,
            module_path!(),
            "node",
            &addresses,
            &[(USERS, &users)],
        )
    };
    let ours = format!("&users=1,{OTHER_USER}");
    blastema::run(async {
        // Neither end lists the other.
        let folder = open_folder();
        let node = on_socket(folder.path(), "module1", "module2", "").start().await.unwrap();
        let mut process = start(folder.path(), "");
        refused_both_ways(OTHER_USER).await;
        assert!(process.succeeds(), "it refuses us, too");
        assert_eq!(node.sessions().await.len(), 0);
        node.shutdown().await;

        // One end does.
        let folder = open_folder();
        let node = on_socket(folder.path(), "module1", "module2", &ours).start().await.unwrap();
        let mut process = start(folder.path(), "");
        assert!(process.succeeds(), "it refuses us");
        assert_eq!(node.sessions().await.len(), 0);
        node.shutdown().await;

        // Both do.
        let folder = open_folder();
        let node = on_socket(folder.path(), "module1", "module2", &ours).start().await.unwrap();
        let _process = start(folder.path(), "&users=0");
        assert!(node.connected("module2", PATIENCE).await, "{:?}", node.links().await);
        node.shutdown().await;
    });
}

#[test]
fn the_inspection_socket_shows_nothing_to_another_user_whatever_its_mode() {
    let _turn = blastema_doubles::turn();
    if !can_be_another_user() {
        return;
    }
    keep_log();
    blastema::run(async {
        let folder = open_folder();
        let path = folder.path().join("shown");
        let builder = Node::builder("module1").work_threads(1).inspection_socket(&path);
        let node = builder.start().await.expect("it starts");
        fs::set_permissions(&path, Permissions::from_mode(0o666)).expect("it is ours");

        let addresses = [folder.path().display().to_string()];
        let mut process =
            Process::start_as(OTHER_USER, folder.path(), module_path!(), "client", &addresses, &[]);
        assert!(tokio::task::spawn_blocking(move || process.succeeds()).await.unwrap());

        assert_eq!(logged(&["inspection socket is refused", &format!("uid {OTHER_USER}")]), 1);
        assert!(read_socket(&path).await.contains("\"node\":\"module1\""));
        node.shutdown().await;
    });
}
