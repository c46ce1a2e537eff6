//! Nodes that lack the processor for a while: their process is stopped and continued. What they
//! find afterwards, and what becomes of messages, is judged by counts and order.

use blastema::prelude::*;
use blastema::{Link, LinkState, Network, NodeBuilder};
use blastema_tests::{
    MS, Notes, Process, accepts, addresses, answers, burn, found, free_addresses, role, until,
};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::time::{Duration, Instant};

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(60);
/// The media between the two nodes. Each has a port, or a path, of its own at each end.
const MEDIA: [&str; 3] = ["udp", "tcp", "unix"];

/// The addresses of `module0` and `module1` on these media, in pairs.
fn endpoints(media: &[&str], folder: &tempfile::TempDir) -> Vec<String> {
    let endpoint = |medium: &str, end: usize| match medium {
        "unix" => format!("unix://{}", folder.path().join(format!("module{end}")).display()),
        medium => format!("{medium}://{}", free_addresses(1)[0]),
    };
    media.iter().flat_map(|medium| [0, 1].map(|end| endpoint(medium, end))).collect()
}

/// Node `own` of the two, with a link over each medium.
fn module(own: usize, endpoints: &[String]) -> NodeBuilder {
    let far = format!("module{}", 1 - own);
    endpoints.chunks(2).fold(Node::builder(&format!("module{own}")), |builder, pair| {
        let (medium, there) = pair[1 - own].split_once("://").expect("an endpoint has a medium");
        builder.network(Network::new(medium, &pair[own]).link(Link::to(&far, there)))
    })
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    blastema::run(async {
        match role.as_str() {
            "observer" => tell_faults().await,
            "receiver" => receive_work().await,
            other => panic!("there is no role {other}"),
        }
    });
}

/// Answers what its node has found so far: code, place, and the code of its root, or nothing.
#[derive(Clone, Debug, Request)]
#[contract(name = "faults/read", reply = Vec<(String, String, String)>)]
struct ReadFaults;

type Found = Vec<(String, String, String)>;

/// Works at 50 Hz, and is asked whether it is alive: it would be late by its rounds, and silent.
struct Pulse;

impl Component for Pulse {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Ok(())
    }
}

async fn tell_faults() {
    let (found, told) = tokio::sync::watch::channel(Vec::new());
    let watch = Liveness::pull(100 * MS, 100 * MS);
    let mut builder = module(1, &addresses())
        .child(answers::<ReadFaults>("faults", told))
        .child(ChildSpec::new("pulse", || Pulse).rate_hz(50.0).liveness(watch));
    let mut faults = builder.fault_events();
    let node = builder.start().await.unwrap();
    while faults.next().await.is_some() {
        let entries = node.faults().await.entries;
        let code = |id| {
            let root = entries.iter().find(|entry| Some(entry.fault.id) == id);
            root.map_or_else(String::new, |root| root.fault.kind.code().to_owned())
        };
        let row = |entry: &blastema::core::detection::FaultEntry| {
            let blastema::Fault { kind, location, symptom_of, .. } = &entry.fault;
            (kind.code().to_owned(), location.to_string(), code(*symptom_of))
        };
        found.send_replace(entries.iter().map(row).collect());
    }
}

/// Stops a node for so long, until links or nodes have suffered from it: what it finds of them is
/// a symptom of its pause, and no component is blamed.
fn blames_itself_after(span: Duration, media: &'static [&'static str]) {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let endpoints = endpoints(media, &folder);
        let node = module(0, &endpoints).start().await.unwrap();
        let process = Process::start(module_path!(), "observer", &endpoints);
        assert!(node.connected("module1", PATIENCE).await);
        let faults: Sender<ReadFaults> = node.sender("module1:faults").unwrap();
        let of_pause = |found: &Found| {
            let suffers = |row: &&(String, String, String)| row.0 == "B11" || row.0 == "B13";
            found.iter().filter(suffers).any(|row| row.2 == "B24")
        };

        let suffered = async {
            loop {
                let is_up =
                    async || node.links().await.iter().all(|row| row.state == LinkState::Up);
                until(is_up, "all links are up").await;
                process.signal("-STOP");
                sleep(span).await;
                process.signal("-CONT");
                let since = Instant::now();
                // Another session may begin first.
                while since.elapsed() < Duration::from_secs(3) {
                    match faults.ask_within(ReadFaults, 500 * MS).await {
                        Ok(found) if of_pause(&found) => return found,
                        _ => sleep(10 * MS).await,
                    }
                }
            }
        };
        let found = tokio::time::timeout(PATIENCE, suffered).await.expect("links suffer from it");
        let of_component = |row: &(String, String, String)| row.1.contains("pulse");
        assert!(!found.iter().any(of_component), "{found:?}");
        node.shutdown().await;
    });
}

#[test]
fn a_node_that_was_stopped_for_seconds_blames_itself_and_none_of_its_peers_or_components() {
    let _turn = blastema_doubles::turn();
    blames_itself_after(3000 * MS, &["udp"]);
}

#[test]
fn a_node_that_was_stopped_for_a_moment_blames_itself_and_none_of_its_peers_or_components() {
    let _turn = blastema_doubles::turn();
    blames_itself_after(400 * MS, &MEDIA);
}

/// One of many messages of one sender.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "slow/work")]
struct Work {
    sender: u32,
    number: u32,
}

/// Answers which work was done so far, in its order.
#[derive(Clone, Debug, Request)]
#[contract(name = "slow/read_done", reply = Vec<(u32, u32)>)]
struct ReadDone;

/// Answers how many dead letters its node has.
#[derive(Clone, Debug, Request)]
#[contract(name = "slow/read_dead", reply = u64)]
struct ReadDead;

type Done = Notes<(u32, u32)>;

/// Answers at once, beside the slow one.
struct Quick(Done, Arc<AtomicU64>);

impl Component for Quick {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<ReadDone>().serve::<ReadDead>();
    }
}

impl Handle<ReadDone> for Quick {
    async fn handle(&mut self, _: ReadDone, _: &mut Context<Self>) -> Vec<(u32, u32)> {
        self.0.all()
    }
}

impl Handle<ReadDead> for Quick {
    async fn handle(&mut self, _: ReadDead, _: &mut Context<Self>) -> u64 {
        self.1.load(SeqCst)
    }
}

async fn receive_work() {
    let (done, dead) = (Done::default(), Arc::new(AtomicU64::new(0)));
    let quick = dead.clone();
    // It needs 10, 20 or 30 ms for each message.
    let slow = accepts("slow", done.clone(), |done, work: Work, _| {
        burn(MS * (10 * (1 + work.number % 3)));
        done.note((work.sender, work.number));
    });
    let node = module(1, &addresses())
        .session_timeout(PATIENCE)
        .child(
            slow.queue(64, WhenFull::Wait)
                // A thread that a busy computer does not run is no hang.
                .max_block(PATIENCE)
                .on_own_thread(),
        )
        .child(ChildSpec::new("quick", move || Quick(done.clone(), quick.clone())))
        .start()
        .await
        .unwrap();
    loop {
        dead.store(node.dead_letters().total(), SeqCst);
        sleep(10 * MS).await;
    }
}

/// How many messages of each sender were accepted. A sender ends with the first that is not.
async fn deliver(slow: &Sender<Work>, sender: u32, count: u32) -> u32 {
    for number in 0..count {
        if slow.deliver(Work { sender, number }).await.is_err() {
            return number;
        }
    }
    count
}

/// Asks until an answer comes: while a process is stopped, sessions may end.
async fn ask<R: Request<Reply = T> + Clone, T>(sender: &Sender<R>, request: R) -> T {
    found(async || sender.ask_within(request.clone(), PATIENCE).await.ok(), "an answer").await
}

/// Each at most once, and those of one sender in their order.
fn assert_in_order(done: &[(u32, u32)]) {
    let mut last = BTreeMap::new();
    for (sender, number) in done {
        let before = last.insert(*sender, *number);
        assert!(before.is_none_or(|before| before < *number), "{sender}: {before:?}, {number}");
    }
}

/// Four senders fill the queue of a receiver that needs 10 to 30 ms for each message; its process
/// is stopped in between. Requests to its neighbour on the same link are answered meanwhile.
fn a_slow_receiver(medium: &'static str, stop: Duration, session: Duration, count: u32) {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let endpoints = endpoints(&[medium], &folder);
        let node = module(0, &endpoints).session_timeout(session).start().await.unwrap();
        let process = Process::start(module_path!(), "receiver", &endpoints);
        assert!(node.connected("module1", PATIENCE).await);
        let slow: Sender<Work> = node.sender("module1:slow").unwrap();
        let read: Sender<ReadDone> = node.sender("module1:quick").unwrap();
        let dead: Sender<ReadDead> = node.sender("module1:quick").unwrap();

        let senders = async {
            let [a, b, c, d] = [0, 1, 2, 3].map(|sender| deliver(&slow, sender, count));
            let (a, b, c, d) = tokio::join!(a, b, c, d);
            a + b + c + d
        };
        let beside = async {
            while ask(&read, ReadDone).await.len() < 3 {
                sleep(MS).await;
            }
            process.signal("-STOP");
            sleep(stop).await;
            process.signal("-CONT");
            for _ in 0..10 {
                let done = ask(&read, ReadDone).await;
                assert!(done.len() < 4 * count as usize, "it waited for all that was before it");
            }
        };
        let (accepted, ()) = tokio::join!(senders, beside);

        let accounted = async || {
            let done = ask(&read, ReadDone).await;
            assert_in_order(&done);
            let missing = u64::from(accepted).saturating_sub(done.len() as u64);
            let (here, there) = (node.dead_letters().total(), ask(&dead, ReadDead).await);
            (missing <= here + there).then_some((missing, here + there))
        };
        let (missing, reported) = found(accounted, "what was accepted, served or reported").await;
        if stop < session {
            assert_eq!((accepted, missing, reported), (4 * count, 0, 0), "the session outlasts it");
        }
        node.shutdown().await;
    });
}

#[test]
fn a_slow_receiver_loses_doubles_and_overtakes_nothing_when_it_is_stopped_for_a_moment_over_udp() {
    let _turn = blastema_doubles::turn();
    a_slow_receiver("udp", 500 * MS, PATIENCE, 40);
}

#[test]
fn a_slow_receiver_loses_doubles_and_overtakes_nothing_also_over_tcp_and_unix() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    for medium in &MEDIA[1..] {
        a_slow_receiver(medium, 500 * MS, PATIENCE, 40);
    }
}

#[test]
fn what_a_slow_receiver_was_sent_is_served_or_reported_when_its_session_ends() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    a_slow_receiver("udp", 1500 * MS, 500 * MS, 2000);
}
