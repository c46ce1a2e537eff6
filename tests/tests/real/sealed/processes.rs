//! Nodes with keys whose processes are killed, stopped and starved.

use super::{Count, PATIENCE, ask, node, until};
use blastema::prelude::*;
use blastema::{LinkState, Network};
use blastema_tests::{Process, RobotKeys, addresses, free_addresses, role};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

const NODES: [&str; 2] = ["left", "right"];

fn network(scheme: &str, own: usize, at: &[String]) -> Network {
    Network::new("lan", &format!("{scheme}://{}", at[own])).peer(NODES[1 - own], &at[1 - own])
}

/// Is the right node: with the addresses of both, the medium, and the folder of the keys.
#[test]
fn a_process_plays_its_role() {
    let Some(scheme) = role() else { return };
    let at = addresses();
    let file = Path::new(&at[2]).join("right.key");
    blastema::run(async {
        let counter = super::counter("right");
        let builder = Node::builder("right").work_threads(1).keys(file).child(counter);
        let node = builder.network(network(&scheme, 1, &at)).start().await.expect("it starts");
        node.run_until_signal().await.expect("the system tells of signals");
    });
}

/// The left node here, the right one in a process.
struct Pair {
    left: Node,
    right: Process,
    at: Vec<String>,
    _folder: tempfile::TempDir,
}

impl Pair {
    async fn start(scheme: &'static str) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let mut at: Vec<_> = match scheme {
            "unix" => NODES.map(|node| folder.path().join(node).display().to_string()).into(),
            _ => free_addresses(2).iter().map(ToString::to_string).collect(),
        };
        at.push(folder.path().display().to_string());
        let right = Self::start_right(scheme, &at);
        let left = node(&keys, "left", network(scheme, 0, &at)).start().await.expect("it starts");
        assert!(left.connected("right", PATIENCE).await, "{:?}", left.links().await);
        Pair { left, right, at, _folder: folder }
    }

    /// Starts a process of the right node, which writes its errors to a file of its own.
    fn start_right(scheme: &str, at: &[String]) -> Process {
        let errors = std::fs::File::create(Path::new(&at[2]).join("right.errors"));
        Process::start_into(errors.expect("a folder"), module_path!(), scheme, at)
    }

    /// Waits until a process of the right node that is later than `before` is connected.
    async fn is_back(&self, before: u64) {
        let back = async {
            while !self.is_up().await || self.incarnation().await <= before {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            self.left.connected("right", PATIENCE).await
        };
        if tokio::time::timeout(PATIENCE, back).await != Ok(true) {
            let errors = std::fs::read_to_string(Path::new(&self.at[2]).join("right.errors"));
            let (links, sessions) = (self.left.links().await, self.left.sessions().await);
            panic!("it is not back after {before}: {links:#?}\n{sessions:#?}\n{errors:?}");
        }
    }

    /// The incarnation that the right node's link is with.
    async fn incarnation(&self) -> u64 {
        let links = self.left.links().await;
        links[0].neighbour.as_ref().map_or(0, |neighbour| neighbour.incarnation.0)
    }

    /// Asks until there is an answer.
    async fn first_answer(&self) -> u32 {
        let counter = self.left.sender::<Count>("right:right-counter").expect("a name");
        let mut answer = None;
        until(
            async || {
                answer = counter.ask_within(Count, PATIENCE).await.ok();
                answer.is_some()
            },
            "an answer",
        )
        .await;
        answer.expect("it came")
    }

    async fn is_up(&self) -> bool {
        self.left.links().await[0].state == LinkState::Up
    }
}

/// How often a process is killed.
fn rounds() -> u64 {
    if blastema_doubles::long() { 1_000 } else { 20 }
}

#[test]
fn a_killed_process_is_found_again_with_new_keys_and_serves_no_request_of_the_past() {
    // A thousand restarts take longer than any other test.
    let _turn = blastema_doubles::turn_within(Duration::from_secs(300 + 10 * rounds()));
    blastema::run(async {
        for scheme in ["udp", "tcp", "unix"] {
            let mut pair = Pair::start(scheme).await;
            for round in 0..rounds() {
                let before = pair.incarnation().await;
                // A request to the process that was killed is told to be lost, and is not served.
                let first = pair.first_answer().await;
                assert_eq!(first, 1, "{scheme}, {round}");
                for number in 2..=4 {
                    assert_eq!(ask(&pair.left, "right").await, number, "{scheme}, {round}");
                }
                assert_eq!(pair.right.exit_status(), None, "{scheme}, {round}: it was not refused");
                pair.right.kill();
                pair.right = Pair::start_right(scheme, &pair.at);
                pair.is_back(before).await;
            }
            // A restart within tenths of a second is no second computer with the key.
            let mut faults = pair.left.faults().await.entries.into_iter();
            assert!(!faults.any(|entry| entry.fault.kind == FaultKind::NameTaken), "{scheme}");
            pair.left.shutdown().await;
        }
    });
}

/// Starts a second right node at an address of its own, with the key of the first. Returns the
/// address, and where its standard error goes.
fn start_twin(pair: &Pair, scheme: &str) -> (Process, String, std::path::PathBuf) {
    let folder = Path::new(&pair.at[2]);
    let address = match scheme {
        "unix" => folder.join("twin").display().to_string(),
        _ => free_addresses(1)[0].to_string(),
    };
    let errors = folder.join("twin.errors");
    let at = [pair.at[0].clone(), address.clone(), pair.at[2].clone()];
    let file = std::fs::File::create(&errors).expect("a folder");
    (Process::start_into(file, module_path!(), scheme, &at), address, errors)
}

#[test]
fn a_twin_stops_with_a_text_and_a_status_of_its_own_while_the_first_serves_every_request() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for scheme in ["udp", "tcp", "unix"] {
            let mut pair = Pair::start(scheme).await;
            let (incarnation, mut served) = (pair.incarnation().await, 0);
            let (mut twin, address, errors) = start_twin(&pair, scheme);

            let ends = async || {
                served += 1;
                assert_eq!(ask(&pair.left, "right").await, served, "{scheme}");
                twin.exit_status().is_some()
            };
            until(ends, "the twin stops").await;

            for number in served + 1..=served + 20 {
                assert_eq!(ask(&pair.left, "right").await, number, "{scheme}");
            }
            assert_eq!(pair.incarnation().await, incarnation, "{scheme}");
            let text = std::fs::read_to_string(errors).expect("it was made");
            assert_eq!(twin.exit_status(), Some(3), "{scheme}: {text}");
            for part in [&pair.at[1], &address, "left reaches another process called right"] {
                assert!(text.contains(part), "{scheme}: {part} is not in {text}");
            }
            let entries = pair.left.faults().await.entries;
            let taken = entries.iter().find(|entry| entry.fault.kind == FaultKind::NameTaken);
            let detail = &taken.expect("it is a fault of the left node").fault.detail;
            assert!(detail.contains(&pair.at[1]) && detail.contains("told to stop"), "{detail}");
            assert_eq!(pair.right.exit_status(), None, "{scheme}");
            pair.left.shutdown().await;
        }
    });
}

#[test]
fn a_process_whose_place_a_twin_has_taken_while_it_was_stopped_is_the_one_that_stops() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for scheme in ["tcp", "unix"] {
            let mut pair = Pair::start(scheme).await;
            let before = pair.incarnation().await;
            pair.right.signal("-STOP");
            until(async || !pair.is_up().await, "the left node finds it silent").await;
            let (mut twin, address, _) = start_twin(&pair, scheme);
            until(async || pair.is_up().await && pair.incarnation().await > before, "a twin").await;
            let mut served = pair.first_answer().await;
            assert_eq!(served, 1, "{scheme}: it is the twin that serves");

            pair.right.signal("-CONT");
            let mut status = None;
            let ends = async || {
                served += 1;
                assert_eq!(ask(&pair.left, "right").await, served, "{scheme}");
                status = pair.right.exit_status();
                status.is_some()
            };
            until(ends, "the first stops").await;

            let errors = Path::new(&pair.at[2]).join("right.errors");
            let text = std::fs::read_to_string(errors).expect("it was made");
            assert_eq!(status, Some(3), "{scheme}: {text}");
            for part in [&pair.at[1], "left reaches another process called right"] {
                assert!(text.contains(part), "{scheme}: {part} is not in {text}");
            }
            assert_eq!(twin.exit_status(), None, "{scheme}, {address}");
            pair.left.shutdown().await;
        }
    });
}

/// Over UDP the left node sends to the address that it was given. A twin elsewhere does not receive
/// it, and so keeps no name.
#[test]
fn a_twin_at_an_address_that_no_link_leads_to_gives_way_to_the_process_that_is_continued() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let mut pair = Pair::start("udp").await;
        let (before, served) = (pair.incarnation().await, pair.first_answer().await);
        pair.right.signal("-STOP");
        until(async || !pair.is_up().await, "the left node finds it silent").await;
        let (mut twin, _, errors) = start_twin(&pair, "udp");
        until(async || pair.incarnation().await > before, "the twin is received").await;

        pair.right.signal("-CONT");
        until(async || pair.is_up().await, "the first is back").await;
        until(async || twin.exit_status().is_some(), "the twin stops").await;

        let text = std::fs::read_to_string(errors).expect("it was made");
        assert_eq!(twin.exit_status(), Some(3), "{text}");
        assert!(text.contains(&pair.at[1]), "{text}");
        assert_eq!(pair.right.exit_status(), None);
        assert!(pair.first_answer().await > served, "it is the first that serves");
        pair.left.shutdown().await;
    });
}

#[test]
fn a_stopped_process_goes_on_in_its_incarnation() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let pair = Pair::start("udp").await;
        let (mut served, incarnation) = (0, pair.incarnation().await);
        for _ in 0..5 {
            served += 1;
            assert_eq!(ask(&pair.left, "right").await, served);
            pair.right.signal("-STOP");
            until(async || !pair.is_up().await, "the left node sees that it is silent").await;
            pair.right.signal("-CONT");
            until(async || pair.is_up().await, "it is back").await;
        }
        assert_eq!(pair.incarnation().await, incarnation);
        assert!(pair.left.connected("right", PATIENCE).await);
        served += 1;
        assert_eq!(ask(&pair.left, "right").await, served);
        pair.left.shutdown().await;
    });
}

#[test]
fn beside_four_times_as_many_busy_threads_as_processors_keys_are_agreed_on_and_kept() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let busy = Arc::new(());
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        for _ in 0..4 * cores {
            let busy = Arc::downgrade(&busy);
            std::thread::spawn(move || while busy.strong_count() > 0 {});
        }
        let pair = Pair::start("udp").await;
        for number in 1..=50 {
            assert_eq!(ask(&pair.left, "right").await, number);
            blastema::sleep(Duration::from_millis(10)).await;
        }
        let refusals = pair.left.links().await[0].refusals;
        assert_eq!(refusals.forged + refusals.malformed, 0, "{refusals:?}");
        drop(busy);
        pair.left.shutdown().await;
    });
}
