//! The books of what was sent to another process: each message and each event that was accepted has
//! arrived, or is counted as lost, and none is both. During an outage that outlasts the session,
//! and where the receiver is slow.

use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema::{Blob, Contract, DeadLetterLog};
use blastema_tests::{
    MS, PATIENCE, Process, addresses, burn, free_addresses, pair_network, role, until,
};
use std::cell::Cell;
use std::rc::Rc;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// Longer than the session waits for its peer.
const OUTAGE: Duration = Duration::from_secs(4);
/// So many messages arrive before the outage, and after it.
const SOME: u64 = 3_000;

/// A number, and more bytes in flight than sockets hold.
#[derive(Clone, Debug, Event)]
#[contract(name = "books/note")]
struct Note(u64, Blob);

/// Takes its listener milliseconds.
#[derive(Clone, Debug, Event)]
#[contract(name = "books/news")]
struct News(u64);

/// How many notes and news have arrived, and how many its node has counted as lost.
#[derive(Clone, Debug, Request)]
#[contract(name = "books/tally", reply = (u64, u64))]
struct Tally;

#[derive(Default)]
struct Ledger {
    arrived: u64,
    last: Option<u64>,
    dead_letters: Arc<OnceLock<DeadLetterLog>>,
}

impl Component for Ledger {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Note>().serve::<Tally>();
        let _ = ports.listen::<News>();
    }
}

impl Handle<Note> for Ledger {
    async fn handle(&mut self, Note(number, _): Note, _: &mut Context<Self>) {
        assert!(self.last.replace(number).is_none_or(|last| last < number), "once and in order");
        self.arrived += 1;
    }
}

impl Handle<News> for Ledger {
    async fn handle(&mut self, News(number): News, _: &mut Context<Self>) {
        burn(2 * MS);
        assert!(self.last.replace(number).is_none_or(|last| last < number), "once and in order");
        self.arrived += 1;
    }
}

impl Handle<Tally> for Ledger {
    async fn handle(&mut self, _: Tally, _: &mut Context<Self>) -> (u64, u64) {
        (self.arrived, self.dead_letters.get().map_or(0, lost))
    }
}

/// How many notes and news are counted as lost.
fn lost(dead_letters: &DeadLetterLog) -> u64 {
    let counts = dead_letters.counts().into_iter();
    counts
        .filter(|count| [Note::NAME, News::NAME].contains(&&*count.contract))
        .map(|count| count.count)
        .sum()
}

#[test]
fn a_process_plays_its_role() {
    let Some(scheme) = role() else { return };
    blastema::run(async {
        let dead_letters = Arc::new(OnceLock::new());
        let theirs = dead_letters.clone();
        let ledger = ChildSpec::new("ledger", move || Ledger {
            dead_letters: theirs.clone(),
            ..Ledger::default()
        });
        let builder = Node::builder("right").child(ledger);
        let node = builder.network(pair_network(&scheme, 1, &addresses())).start().await;
        let node = node.expect("it starts");
        dead_letters.set(node.dead_letters().clone()).expect("it is set once");
        std::future::pending::<()>().await;
    });
}

/// What has become of the stream so far.
struct Observer<'a> {
    node: &'a Node,
    tally: blastema::Sender<Tally>,
}

impl Observer<'_> {
    /// How many arrived, and how many are counted as lost on both nodes.
    async fn look(&self) -> Option<(u64, u64)> {
        let (arrived, there) = self.tally.ask(Tally).await.ok()?;
        Some((arrived, there + lost(self.node.dead_letters())))
    }

    /// Waits until so many have arrived.
    async fn arrived(&self, some: u64) {
        let have = async || self.look().await.is_some_and(|(arrived, _)| arrived >= some);
        until(have, "they arrive").await;
    }

    /// The books once twenty looks in a row find the same.
    async fn settled(&self) -> (u64, u64) {
        let (mut last, mut same) = (None, 0);
        let is_settled = async || {
            sleep(50 * MS).await;
            let next = self.look().await;
            same = if next.is_some() && next == last { same + 1 } else { 0 };
            last = next;
            same == 20
        };
        until(is_settled, "nothing is in flight for ever").await;
        last.expect("it was looked at")
    }
}

/// Two nodes that are connected, the other one in a process of its own.
async fn pair(scheme: &'static str) -> (Node, Process) {
    let at = free_addresses(2);
    let node = Node::builder("left").network(pair_network(scheme, 0, &at)).start().await;
    let (node, right) = (node.expect("it starts"), Process::start(module_path!(), scheme, &at));
    assert!(node.connected("right", PATIENCE).await);
    (node, right)
}

async fn stop_for_longer_than_a_session(scheme: &'static str) {
    let (node, right) = pair(scheme).await;
    let tally = node.sender("right:ledger").expect("a name");
    let observer = Observer { node: &node, tally };

    let (accepted, is_over) = (Rc::new(Cell::new(0)), Rc::new(Cell::new(false)));
    let notes = node.sender::<Note>("right:ledger").expect("a name");
    let (count, over) = (accepted.clone(), is_over.clone());
    let stream = actix_rt::spawn(async move {
        for number in 0.. {
            match notes.deliver(Note(number, Blob::from(vec![7; 3_000]))).await {
                Ok(()) => count.set(count.get() + 1),
                Err(_) => sleep(5 * MS).await,
            }
            if number % 64 == 0 {
                tokio::task::yield_now().await;
            }
            if over.get() {
                return;
            }
        }
    });
    observer.arrived(SOME).await;
    right.signal("-STOP");
    sleep(OUTAGE).await;
    right.signal("-CONT");
    let before = accepted.get();
    observer.arrived(before.max(SOME)).await;
    is_over.set(true);
    stream.await.expect("it ends");

    let (arrived, lost) = observer.settled().await;
    assert_eq!(accepted.get(), arrived + lost, "{scheme}: {arrived} arrived, {lost} are lost");
    // The session has ended, though all that was accepted may have been in flight and have arrived.
    let entries = node.faults().await.entries;
    let is_told = |entry: &FaultEntry| {
        entry.fault.kind == FaultKind::ConnectionLost && entry.fault.detail.contains("for right")
    };
    assert!(entries.iter().any(is_told), "{scheme}: {entries:#?}");
    node.shutdown().await;
}

#[test]
fn each_accepted_message_of_an_outage_arrived_or_is_counted_as_lost() {
    let _turn = blastema_doubles::turn_within(3 * PATIENCE);
    for scheme in ["udp", "tcp"] {
        blastema::run(stop_for_longer_than_a_session(scheme));
    }
}

async fn publish_to_a_slow_listener(scheme: &'static str) {
    let (node, _right) = pair(scheme).await;
    let tally = node.sender("right:ledger").expect("a name");
    let observer = Observer { node: &node, tally };
    let news = node.publisher::<News>(News::NAME).expect("a topic");
    news.matched_at_least(1).await;

    let mut handed_over = 0;
    for number in 0..30_000 {
        handed_over += u64::from(news.publish(News(number)).is_ok());
        if number % 1_000 == 0 {
            sleep(20 * MS).await;
        }
    }

    let (arrived, missing) = observer.settled().await;
    let result = format!("{scheme}: {arrived} arrived, {missing} are lost");
    assert_eq!(handed_over, arrived + missing, "{result}");
    assert!(arrived > 0 && missing > arrived, "{result}");
    let told = async || {
        let entries = node.faults().await.entries;
        let is_told = |entry: &&FaultEntry| {
            entry.fault.kind == FaultKind::Overload && entry.fault.detail.contains(News::NAME)
        };
        entries.iter().filter(is_told).count()
    };
    // The other node loses what this one is fast enough to send, and tells of it there.
    if lost(node.dead_letters()) * 10 >= handed_over {
        until(async || told().await > 0, "a tenth is lost here").await;
    }
    assert!(told().await <= 1, "{scheme}: it is told once");
    node.shutdown().await;
}

#[test]
fn each_event_that_was_handed_over_arrived_or_is_counted_as_lost() {
    let _turn = blastema_doubles::turn_within(3 * PATIENCE);
    for scheme in ["udp", "tcp"] {
        blastema::run(publish_to_a_slow_listener(scheme));
    }
}
