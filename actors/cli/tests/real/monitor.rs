//! The program reads the snapshot of a running node.

use blastema::prelude::*;
use blastema::{Network, ServiceSpec, Stateful};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::fs::Permissions;
use std::net::UdpSocket;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixDatagram, UnixListener};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use tokio::io::AsyncWriteExt;

/// For a process to begin on a busy computer.
const PATIENCE: Duration = Duration::from_secs(30);

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
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("module1.sock");
        let builder = Node::builder("module1")
            .work_threads(1)
            .child(ChildSpec::new("lamp", || Lamp))
            .service(ServiceSpec::new("light/room", ["module1", "module2"], || Lamp))
            .inspection_socket(&socket);
        let node = builder.start().await.expect("the node starts");
        let _claim = node.claim_for("light", "lamp", blastema::ClaimPolicy::Refuse).await;

        let json = monitor(&["--json", text(&socket)]).await;
        assert!(json.status.success(), "{json:?}");
        let snapshot: Value = serde_json::from_slice(&json.stdout).expect("a JSON document");
        assert_eq!((&snapshot["node"], &snapshot["state"]), (&"module1".into(), &"running".into()));
        let row = |part: &str, key: &str, value: &str| -> Value {
            let rows = snapshot[part].as_array().expect("a list");
            rows.iter().find(|row| row[key] == value).cloned().unwrap_or_default()
        };
        assert_eq!(row("table", "location", "module1:lamp")["state"], "active", "{snapshot}");
        let thread = row("threads", "kind", "shared");
        assert_eq!(thread["state"], "alive", "{snapshot}");
        assert_eq!(thread["components"], serde_json::json!(["lamp", "light/room/replica"]));
        let service = row("services", "name", "light/room");
        assert_eq!(service["state"], "candidate", "{snapshot}");
        assert_eq!(service["missing_members"], serde_json::json!(["module2"]));
        assert_eq!(row("global_names", "name", "light")["object"], "lamp");

        let tables = monitor(&[text(&socket)]).await;
        let shown = String::from_utf8(tables.stdout).expect("text");
        for part in
            ["module1 running", "objects", "module1:lamp", "threads", "global names", "services"]
        {
            assert!(shown.contains(part), "{part} is missing in\n{shown}");
        }

        node.shutdown().await;
        let gone = monitor(&[text(&socket)]).await;
        let told = String::from_utf8(gone.stderr).expect("text");
        assert_eq!(gone.status.code(), Some(2), "{told}");
        assert!(
            told.contains("no node answers at") && told.contains("inspection_socket"),
            "{told}"
        );
    });
}

#[derive(Clone, Debug, Event)]
#[contract(name = "monitor/pose")]
struct Pose(u32);

/// Dims a lamp.
#[derive(Clone, Debug, Request)]
#[contract(name = "monitor/dim", reply = ())]
struct Dim;

struct Ear;
impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Pose>();
    }
}
impl Handle<Pose> for Ear {
    async fn handle(&mut self, _: Pose, _: &mut Context<Self>) {}
}

#[test]
fn what_two_sealed_nodes_have_exchanged_is_shown_as_tables() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let mut keys = Command::new(env!("CARGO_BIN_EXE_blastema"));
        keys.args(["keys", "new", "ranger", "base", "arm"]).current_dir(folder.path());
        assert!(keys.output().expect("it can be started").status.success());
        let held = [0, 1].map(|_| UdpSocket::bind("127.0.0.1:0").expect("a free port"));
        let at = held.each_ref().map(|socket| socket.local_addr().expect("it is bound"));
        drop(held);
        let socket = folder.path().join("base.sock");
        let node = |own: usize| {
            let [name, peer] = if own == 0 { ["base", "arm"] } else { ["arm", "base"] };
            let network = Network::new("wire", &format!("udp://{}", at[own]));
            Node::builder(name)
                .work_threads(1)
                .keys(folder.path().join(format!("{name}.key")))
                .network(network.peer(peer, &at[1 - own].to_string()))
        };
        let base = node(0).inspection_socket(&socket).start().await.expect("it starts");
        let arm = node(1).child(ChildSpec::new("ear", || Ear));
        let arm = arm.start().await.expect("it starts");
        assert!(base.connected("arm", PATIENCE).await, "{:?}", base.links().await);
        let poses = base.publisher::<Pose>("monitor/pose").expect("a topic");
        poses.publish(Pose(1)).expect("the node runs");
        let absent = base.sender::<Dim>("arm:absent").expect("a name");
        absent.tell(Dim).expect("the arm can be reached");

        let begun = std::time::Instant::now();
        let shown = loop {
            let tables = monitor(&[text(&socket)]).await;
            let shown = String::from_utf8(tables.stdout).expect("text");
            if shown.contains("dead letters") || begun.elapsed() > PATIENCE {
                break shown;
            }
        };

        // The cells of the first row of a table, by their headings; no cell of these has two words.
        let row = |title: &str| -> Vec<String> {
            let table = shown.split("\n\n").find(|table| table.starts_with(title));
            let table = table.unwrap_or_else(|| panic!("{title} is missing in\n{shown}"));
            let cells = table.lines().nth(2).expect("a row").split("  ");
            cells.map(|cell| cell.trim().to_owned()).filter(|cell| !cell.is_empty()).collect()
        };
        assert_eq!(row("roster")[..1], ["ranger"]);
        assert_eq!(row("roster")[2], "2");
        assert_eq!(row("routes")[0], "arm");
        assert_eq!(row("routes")[2..6], ["wire", "wire", "-", "-"]);
        let link = row("links");
        let figure = |place: usize| link[place].parse::<u64>().expect("a figure");
        assert!((9..13).all(|place| figure(place) > 0), "{link:?}");
        assert_eq!(figure(13), 0, "nothing was dropped: {link:?}");
        let letters = row("dead letters");
        assert_eq!(letters[..4], ["arm", "absent", "monitor/dim", "receiver unknown"]);
        assert!(shown.contains("listening nodes") && row("topics").contains(&"arm".to_owned()));
        for node in [base, arm] {
            node.shutdown().await;
        }
    });
}

/// The program does not show what is there, and says these words, in one line.
async fn not_shown(arguments: &[&str], words: &[&str]) {
    let output = monitor(arguments).await;
    let told = String::from_utf8(output.stderr).expect("text");
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{told}");
    assert_eq!(told.lines().count(), 1, "{told}");
    for word in words {
        assert!(told.contains(word), "{word:?} is not said in {told}");
    }
    assert!(!told.contains("os error"), "a number is no help: {told}");
}

#[test]
fn a_path_at_which_there_is_no_socket_is_told_with_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("file"), "{}").expect("a file");
        let dead = at("dead.sock");
        drop(UnixListener::bind(&dead).expect("a socket"));
        let _datagrams = UnixDatagram::bind(at("datagrams")).expect("a socket");
        let check = async |path: PathBuf, words: &[&str]| {
            let words = [&[text(&path)], words].concat();
            not_shown(&[text(&path)], &words).await;
        };

        check(at("nothing"), &["nothing is there: start the node"]).await;
        check(at("no/socket"), &["there is no folder", "correct the path"]).await;
        check(at("file"), &["it is a file and no socket"]).await;
        check(at("file/socket"), &["is a file: correct the path"]).await;
        check(folder.path().to_owned(), &["it is a folder: name the inspection socket in it"])
            .await;
        check(at(&"w".repeat(120)), &["at most 107 bytes"]).await;
        check(dead, &["has died", "restart it"]).await;
        check(at("datagrams"), &["inspection_socket"]).await;
    });
}

#[test]
fn who_may_not_look_is_told_who_may() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("module1.sock");
        let _listener = UnixListener::bind(&socket).expect("a socket");
        std::fs::set_permissions(&socket, Permissions::from_mode(0o000)).expect("it is ours");
        // Root may do everything, and so looks as another user, who can reach the program there.
        let own = Path::new(env!("CARGO_BIN_EXE_blastema"));
        let own = blastema_doubles::program_in(folder.path(), own);
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).expect("it is ours");
        let mut program = Command::new(own);
        if rustix::process::geteuid().is_root() {
            program.uid(65_534);
        }
        let output = program.arg("monitor").arg(&socket).output().expect("it can be started");

        let told = String::from_utf8(output.stderr).expect("text");
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains("only the user who runs the node may look: run this as"), "{told}");
    });
}

/// Shows this to one who comes, and ends.
async fn shows(socket: &Path, shown: &[u8]) {
    let listener = tokio::net::UnixListener::bind(socket).expect("a socket");
    let (mut client, _) = listener.accept().await.expect("a client connects");
    client.write_all(shown).await.expect("the client reads");
}

#[test]
fn what_is_shown_by_somebody_else_is_not_taken_for_a_node() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for (shown, word) in [
            (&b"{\"temperature\":21.5}"[..], "without \"node\""),
            (b"[1,2,3]", "without \"node\""),
            (b"HTTP/1.1 400 Bad Request\r\n", "no JSON document"),
            (b"\xff\x00", "no text"),
            (b"", "nothing"),
        ] {
            let folder = tempfile::tempdir().expect("a folder");
            let socket = folder.path().join("other.socket");
            let (tables, json) = ([text(&socket)], ["--json", text(&socket)]);
            let words = ["this is no inspection socket of a node", text(&socket), word];
            tokio::join!(shows(&socket, shown), not_shown(&tables, &words));
            std::fs::remove_file(&socket).expect("it is there");
            tokio::join!(shows(&socket, shown), not_shown(&json, &words));
        }
    });
}

/// At which inspection socket the process is shown that this test starts from itself.
const SOCKET: &str = "BLASTEMA_TEST_SOCKET";

#[test]
fn a_process_shows_its_node() {
    let Some(socket) = std::env::var_os(SOCKET) else { return };
    blastema::platform::end_with_parent(std::os::unix::process::parent_id()).expect("it has one");
    blastema::run(async {
        let node =
            Node::builder("module1").inspection_socket(socket).start().await.expect("it starts");
        node.ended().await;
    });
}

#[test]
fn a_node_whose_process_is_stopped_is_told_as_such_and_how_to_let_it_go_on() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("module1.sock");
        let program = std::env::current_exe().expect("a running program has a path");
        let mut process = tokio::process::Command::new(program)
            .args(["--exact", "monitor::a_process_shows_its_node", "--nocapture"])
            .env(SOCKET, &socket)
            .stdout(Stdio::null())
            .kill_on_drop(true)
            .spawn()
            .expect("the test can be started again");
        let begun = async {
            while !monitor(&[text(&socket)]).await.status.success() {
                assert_eq!(process.try_wait().expect("it is ours"), None, "it goes on");
            }
        };
        tokio::time::timeout(PATIENCE, begun).await.expect("it begins");
        let number = process.id().expect("it lives").to_string();
        let own = Pid::from_raw(number.parse().expect("a number"));
        let signal = |signal| kill_process(own.expect("it lives"), signal).expect("it is ours");

        signal(Signal::STOP);
        let hint = format!("`kill -CONT {number}`");
        let words = &["did not answer within 0.2 s", "is stopped", &hint];
        not_shown(&["--within", "200ms", text(&socket)], words).await;

        signal(Signal::CONT);
        assert!(monitor(&[text(&socket)]).await.status.success(), "it goes on");
        process.kill().await.expect("it is ours");
    });
}

#[test]
fn who_takes_connections_and_says_nothing_is_not_waited_for_without_end() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("silent");
        let listener = UnixListener::bind(&socket).expect("a socket");

        let words = &["did not answer within 0.1 s", "--within"];
        not_shown(&["--within", "100ms", text(&socket)], words).await;

        // As many wait now as the system lets: no more can even connect.
        listener.set_nonblocking(true).expect("it is a socket");
        let mut waiting = Vec::new();
        let full = loop {
            match tokio::net::UnixStream::connect(&socket).await {
                Ok(client) => waiting.push(client),
                Err(error) => break error,
            }
        };
        assert_eq!(full.kind(), std::io::ErrorKind::WouldBlock);
        let words = &["did not answer within 0.1 s", "others wait there, too"];
        not_shown(&["--within", "100ms", text(&socket)], words).await;
    });
}

#[test]
fn a_socket_that_cannot_be_opened_is_refused_at_start_with_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("nowhere/module1.sock");
        let error = Node::builder("module1")
            .inspection_socket(&socket)
            .start()
            .await
            .expect_err("no folder");
        assert!(error.to_string().contains("create it"), "{error}");
    });
}
