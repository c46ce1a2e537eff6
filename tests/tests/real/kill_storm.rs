//! A sealed node whose process is killed and stopped again and again under load, and the books of
//! those that sent to it: what became of each request is what its sender was told.
//!
//! `BLASTEMA_STORM_SECONDS=600 cargo test -p blastema-tests --test real kill_storm` takes ten minutes.

use blastema::prelude::*;
use blastema::{Link, Network, Outcome, Publisher};
use blastema_tests::{Process, RobotKeys, addresses, burn, free_addresses, role, until};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(60);
const SCHEMES: [&str; 2] = ["udp", "tcp"];
/// How many senders of each kind there are at once.
const SENDERS: u64 = 3;

/// Writes the number down; answers it.
#[derive(Clone, Debug, Request)]
#[contract(name = "storm/enter", reply = u64)]
struct Enter(u64);

/// The same, without an answer.
#[derive(Clone, Debug, Event)]
#[contract(name = "storm/note")]
struct Note(u64);

/// The same, by a topic.
#[derive(Clone, Debug, Event)]
#[contract(name = "storm/news")]
struct News(u64);

/// What was done, in the order in which it was done, kept over the process: each line is written by
/// one call of the system, so that no kill leaves half of one.
struct Ledger(File);

impl Ledger {
    fn write(&mut self, kind: char, number: u64) {
        self.0.write_all(format!("{kind}{number}\n").as_bytes()).expect("there is room");
    }
}

impl Component for Ledger {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Enter>().accept::<Note>().listen::<News>().on("storm/news");
    }
}

impl Handle<Enter> for Ledger {
    async fn handle(&mut self, Enter(number): Enter, _: &mut Context<Self>) -> u64 {
        self.write('a', number);
        if number.is_multiple_of(16) {
            // Some keep their thread for a while.
            burn(Duration::from_millis(2));
        }
        number
    }
}

impl Handle<Note> for Ledger {
    async fn handle(&mut self, Note(number): Note, _: &mut Context<Self>) {
        self.write('t', number);
    }
}

impl Handle<News> for Ledger {
    async fn handle(&mut self, News(number): News, _: &mut Context<Self>) {
        self.write('e', number);
    }
}

fn network(scheme: &str, own: usize, at: &[String]) -> Network {
    let other = 1 - own;
    let link = Link::new(["left", "right"][other], at[other].parse().expect("an address"));
    Network::new("lan", &format!("{scheme}://{}", at[own]))
        .link(link.hello_every(Duration::from_millis(20)))
}

#[test]
fn a_process_plays_its_role() {
    let Some(scheme) = role() else { return };
    let at = addresses();
    let folder = Path::new(&at[2]);
    let file = ledger(folder);
    blastema::run(async {
        let ledger = ChildSpec::new("ledger", move || {
            let file = OpenOptions::new().append(true).create(true).open(&file);
            Ledger(file.expect("the folder is there"))
        });
        let builder = Node::builder("right").keys(folder.join("right.key")).child(ledger);
        let _node = builder.network(network(&scheme, 1, &at)).start().await.expect("it starts");
        std::future::pending::<()>().await;
    });
}

fn ledger(folder: &Path) -> PathBuf {
    folder.join("ledger")
}

/// What the senders were told.
#[derive(Default)]
struct Books {
    next: AtomicU64,
    over: AtomicBool,
    answered: AtomicU64,
    /// Requests by number, and notes and news that were accepted.
    asked: std::sync::Mutex<BTreeMap<u64, Result<u64, Outcome>>>,
}

impl Books {
    fn number(&self) -> u64 {
        self.next.fetch_add(1, Relaxed)
    }

    fn is_over(&self) -> bool {
        self.over.load(Relaxed)
    }
}

async fn ask(books: Arc<Books>, sender: blastema::Sender<Enter>) {
    while !books.is_over() {
        let number = books.number();
        // Some do not wait as long as a stop lasts.
        let within = Duration::from_millis(if number.is_multiple_of(5) { 40 } else { 3_000 });
        let asked = sender.ask_within(Enter(number), within).await;
        let told = asked.map_err(|error| error.kind.outcome());
        let was_not_taken = told == Err(Outcome::NotTaken);
        books.answered.fetch_add(u64::from(told.is_ok()), Relaxed);
        books.asked.lock().unwrap().insert(number, told);
        if was_not_taken {
            sleep(Duration::from_millis(2)).await;
        }
    }
}

async fn tell(books: Arc<Books>, sender: blastema::Sender<Note>) {
    while !books.is_over() {
        // It waits while there is no space, and fails while there is no node. In bursts: requests
        // wait behind what was told to the same object before.
        let number = books.number();
        if sender.deliver(Note(number)).await.is_err() || number.is_multiple_of(64) {
            sleep(Duration::from_millis(10)).await;
        }
    }
}

async fn publish(books: Arc<Books>, news: Publisher<News>) {
    while !books.is_over() {
        news.deliver(News(books.number())).await.expect("the node runs");
        sleep(Duration::from_millis(1)).await;
    }
}

/// A number below `below` that follows from all before it.
fn chance(state: &mut u64, below: u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state % below
}

async fn storm(scheme: &'static str, lasting: Duration) {
    let folder = tempfile::tempdir().expect("a folder");
    let keys = RobotKeys::new(folder.path(), &["left", "right"], 1);
    let mut at: Vec<_> = free_addresses(2).iter().map(ToString::to_string).collect();
    at.push(folder.path().display().to_string());
    let builder = Node::builder("left").keys(keys.of("left")).network(network(scheme, 0, &at));
    let node = builder.start().await.expect("it starts");
    let mut right = Process::start_with(module_path!(), scheme, &at, &[]);
    assert!(node.connected("right", PATIENCE).await);

    let books = Arc::new(Books::default());
    let mut senders = tokio::task::JoinSet::new();
    for _ in 0..SENDERS {
        let enter = node.sender::<Enter>("right:ledger").expect("a name");
        senders.spawn_local(ask(books.clone(), enter));
    }
    let note = node.sender::<Note>("right:ledger").expect("a name");
    senders.spawn_local(tell(books.clone(), note));
    let news = node.publisher::<News>("storm/news").expect("a topic");
    senders.spawn_local(publish(books.clone(), news));

    let (mut state, mut kills, mut answered) = (0x9e37_79b9_7f4a_7c15, 0, 0);
    let end = std::time::Instant::now() + lasting;
    while std::time::Instant::now() < end {
        // Each life answers some, so that the storm tries what it is to try.
        let some = books.answered.load(Relaxed) + 1 + chance(&mut state, 200);
        let is_served = async || books.answered.load(Relaxed) >= some;
        until(is_served, "the node is back each time").await;
        match chance(&mut state, 3) {
            0 => {
                right.signal("-STOP");
                sleep(Duration::from_millis(20 + chance(&mut state, 700))).await;
                right.signal("-CONT");
            }
            _ => {
                right.kill();
                kills += 1;
                answered = books.answered.load(Relaxed);
                sleep(Duration::from_millis(chance(&mut state, 400))).await;
                right = Process::start_with(module_path!(), scheme, &at, &[]);
            }
        }
    }
    books.over.store(true, Relaxed);
    let all = async { while senders.join_next().await.is_some() {} };
    tokio::time::timeout(PATIENCE, all).await.expect("every request resolves, and every wait ends");
    assert!(kills > 0 && answered > 0, "{kills} kills, {answered} answers");
    // What is under way comes to its end.
    let last = node.sender::<Enter>("right:ledger").expect("a name");
    let is_served = async || last.ask_within(Enter(books.number()), PATIENCE).await.is_ok();
    until(is_served, "the node is back").await;
    node.shutdown().await;
    right.kill();

    let text = std::fs::read_to_string(ledger(folder.path())).expect("it was written");
    check(&text, &books.asked.lock().unwrap(), scheme, kills);
}

/// Compares what was done with what the senders were told.
#[expect(clippy::print_stdout, reason = "the counts are for those who run it for long")]
fn check(ledger: &str, asked: &BTreeMap<u64, Result<u64, Outcome>>, scheme: &str, kills: u64) {
    let mut done = BTreeSet::new();
    for line in ledger.lines() {
        assert!(done.insert(line), "{scheme}: {line} was done twice");
    }
    // One sender each: what is done of it is done in its order, whichever life does it.
    for kind in ['t', 'e'] {
        let of_kind = ledger.lines().filter_map(|line| line.strip_prefix(kind));
        let numbers: Vec<u64> = of_kind.map(|number| number.parse().expect("a number")).collect();
        assert!(!numbers.is_empty(), "{scheme}: none of {kind} arrived");
        assert!(numbers.is_sorted(), "{scheme}: {kind} overtook another");
    }
    let (mut answered, mut unknown) = (0, 0);
    for (number, told) in asked {
        let was_done = done.contains(format!("a{number}").as_str());
        match told {
            Ok(answer) => {
                assert!(was_done && answer == number, "{scheme}: {number} was not done");
                answered += 1;
            }
            Err(Outcome::NotTaken) => assert!(!was_done, "{scheme}: {number} took effect"),
            Err(Outcome::TookEffect) => assert!(was_done, "{scheme}: {number} took no effect"),
            Err(Outcome::Unknown) => unknown += 1,
        }
    }
    // Those whose outcome is unknown were under way when the node was killed or stopped.
    println!(
        "{scheme}: {kills} kills, {} asked, {answered} answered, {unknown} unknown, {} done",
        asked.len(),
        done.len()
    );
}

/// How long the storm lasts.
fn storm_seconds() -> u64 {
    std::env::var("BLASTEMA_STORM_SECONDS")
        .map_or(8, |text| text.parse().expect("BLASTEMA_STORM_SECONDS is a number of seconds"))
}

#[test]
fn what_became_of_each_request_is_what_its_sender_was_told() {
    let _turn = blastema_doubles::turn_within(Duration::from_secs(300 + 2 * storm_seconds()));
    let seconds = storm_seconds();
    for scheme in SCHEMES {
        blastema::run(storm(scheme, Duration::from_secs(seconds) / SCHEMES.len() as u32));
    }
}
