//! Receivers that are slower than their senders, on another node.

use super::*;
use crate::{Event, Outcome};
use blastema_contract::child::ChildOrder;
use blastema_core::TrafficClass;
use blastema_core::contract::codec;
use blastema_core::net::peer_protocol::receive_backlog::MESSAGES_MAX;
use blastema_core::net::wire::message::PeerMessage;
use blastema_core::net::{NodeId, OrderingKey};
use bytes::Bytes;

/// Is worked at for a while.
#[derive(Clone, Debug, PartialEq, Event)]
struct Job(u64);

/// Another contract, taken by the same object and through the same queue.
#[derive(Clone, Debug, PartialEq, Event)]
struct Memo(u64);

/// A reading of which only the newest counts.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(delivery = "newest")]
struct Sampling(u64);

/// Is this one busy?
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = ())]
struct Busy;

/// The job that kills.
const DEADLY: u64 = 1_000_000;
const QUEUE: usize = 64;

/// Takes its time for each message.
struct Slow {
    log: Log,
    takes: Duration,
}

impl Component for Slow {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Job>().accept::<Memo>().accept::<Sampling>().serve::<Busy>();
    }
}

impl Slow {
    async fn work(&mut self, n: u64) {
        assert_ne!(n, DEADLY, "it kills");
        tokio::time::sleep(self.takes).await;
        self.log.0.lock().unwrap().push(n);
    }
}

impl Handle<Job> for Slow {
    async fn handle(&mut self, Job(n): Job, _: &mut Context<Self>) {
        self.work(n).await;
    }
}

impl Handle<Memo> for Slow {
    async fn handle(&mut self, Memo(n): Memo, _: &mut Context<Self>) {
        self.work(n).await;
    }
}

impl Handle<Sampling> for Slow {
    async fn handle(&mut self, Sampling(n): Sampling, _: &mut Context<Self>) {
        self.work(n).await;
    }
}

impl Handle<Busy> for Slow {
    async fn handle(&mut self, Busy: Busy, _: &mut Context<Self>) {}
}

/// A component `slow` at this module that needs so long for each message, and what it has done.
async fn slow(module: &Module, takes: Duration, full: WhenFull) -> (Box<dyn Child>, Log) {
    module.begin("slow", move |log| Slow { log, takes }, QUEUE, full).await
}

/// More jobs than `slow` has room for are on their way by this sender.
async fn flooded(left: &Module) -> Sender<Job> {
    let jobs = left.sender::<Job>("right:slow");
    for n in 0..200 {
        jobs.tell(Job(n)).unwrap();
    }
    advance(20 * MS).await;
    jobs
}

const NEVER: Duration = Duration::from_secs(1_000_000);

async fn deliver_all(sender: &Sender<Job>, jobs: impl Iterator<Item = u64>) {
    for n in jobs {
        sender.deliver(Job(n)).await.unwrap();
    }
}

fn lost(modules: [&Module; 2]) -> [u64; 2] {
    modules.map(|module| module.host.dead_letters.total())
}

fn dead_at(module: &Module) -> u64 {
    module.host.dead_letters.count(&ObjectName::new("slow").unwrap(), DeadReason::Full)
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_is_delivered_to_a_slow_object_of_another_node_arrives_all_and_in_order() {
    for full in [WhenFull::Refuse, WhenFull::Wait] {
        let (_robot, left, right) = pair().await;
        let (_slow, log) = slow(&right, MS, full).await;
        let jobs = left.sender::<Job>("right:slow");

        tokio::join!(deliver_all(&jobs, 0..3000), advance(6000 * MS));

        assert_eq!(log.take(), (0..3000).collect::<Vec<_>>());
        assert_eq!(lost([&left, &right]), [0, 0]);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_tells_a_full_object_of_another_node_gets_the_message_back_and_no_other_object_is_held_up()
 {
    let (_robot, left, right) = pair().await;
    let (_slow, log) = slow(&right, 10 * MS, WhenFull::Refuse).await;
    let jobs = flooded(&left).await;

    let error = jobs.tell(Job(200)).unwrap_err();
    assert_eq!((error.kind, error.message), (DeliveryError::Full, Job(200)));
    // Whatever the contract, it is the same queue.
    assert_eq!(
        left.sender::<Memo>("right:slow").tell(Memo(0)).unwrap_err().kind,
        DeliveryError::Full
    );
    let error = left.sender::<Busy>("right:slow").ask(Busy).await.unwrap_err();
    assert_eq!((error.outcome(), error.kind), (Outcome::NotTaken, DeliveryError::Full));

    let other = left.sender::<Add>("right:acc");
    for n in 1..=50 {
        assert_eq!(other.ask_within(Add(1), 5 * MS).await.unwrap(), n);
        left.sender::<Note>("right:acc").tell(Note(n)).unwrap();
    }
    advance(5 * MS).await;
    assert_eq!(right.log.take().len(), 50);
    assert!(log.take().len() < 50, "it is still busy");

    advance(3000 * MS).await;
    jobs.tell(Job(200)).unwrap();
    advance(100 * MS).await;
    assert_eq!(log.take().last(), Some(&200));
    assert_eq!(lost([&left, &right]), [0, 0]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_waits_for_room_is_overtaken_by_nothing_of_its_sender() {
    let (_robot, left, right) = pair().await;
    let (_slow, log) = slow(&right, MS, WhenFull::Refuse).await;
    let (jobs, memos) = (left.sender::<Job>("right:slow"), left.sender("right:slow"));
    jobs.tell(Job(0)).unwrap();
    memos.tell(Memo(1)).unwrap();
    left.sender::<Busy>("right:slow").ask(Busy).await.unwrap();

    for n in 1..500 {
        jobs.tell(Job(2 * n)).unwrap();
        memos.tell(Memo(2 * n + 1)).unwrap();
    }
    // It comes when others wait, and does not wait.
    let asked = left.sender::<Busy>("right:slow").ask(Busy).await.unwrap_err();
    advance(2000 * MS).await;

    assert_eq!(asked.kind, DeliveryError::Full);
    assert_eq!(log.take(), (0..1000).collect::<Vec<_>>());
    assert_eq!(lost([&left, &right]), [0, 0]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_restart_of_the_slow_object_costs_the_message_that_killed_it_and_no_other() {
    let (_robot, left, right) = pair().await;
    let (mut child, log) = slow(&right, MS, WhenFull::Refuse).await;
    let jobs = left.sender::<Job>("right:slow");
    let all = (0..500).chain([DEADLY]).chain(500..1500);
    let restart = async {
        advance(2500 * MS).await;
        assert_eq!(log.take(), (0..500).collect::<Vec<_>>());
        child.start(Incarnation(2), Probe::<ChildReport>::start().recipient().into());
        advance(3000 * MS).await;
    };

    tokio::join!(deliver_all(&jobs, all), restart);

    assert_eq!(log.take(), (500..1500).collect::<Vec<_>>());
    assert_eq!(lost([&left, &right]), [0, 1]);
    let name = ObjectName::new("slow").unwrap();
    assert_eq!(right.host.dead_letters.count(&name, DeadReason::PeerDied), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_object_that_is_stopped_for_good_turns_what_waits_into_dead_letters_and_nobody_waits_for_it()
 {
    let (_robot, left, right) = pair().await;
    let (mut child, _log) = slow(&right, NEVER, WhenFull::Refuse).await;
    let jobs = flooded(&left).await;
    assert_eq!(jobs.tell(Job(200)).unwrap_err().kind, DeliveryError::Full);

    child.order(ChildOrder::Stop { again: false });
    advance(10_000 * MS).await;

    let name = ObjectName::new("slow").unwrap();
    assert!(right.host.dead_letters.count(&name, DeadReason::Stopped) >= 199);
    jobs.tell(Job(200)).unwrap();
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_waits_when_the_session_ends_is_counted_and_the_next_session_begins_with_nothing_full()
{
    let (robot, left, right) = pair().await;
    let (_slow, log) = slow(&right, NEVER, WhenFull::Refuse).await;
    let jobs = flooded(&left).await;
    assert_eq!(jobs.tell(Job(200)).unwrap_err().kind, DeliveryError::Full);

    robot.part("left");
    advance(5000 * MS).await;
    assert!(matches!(jobs.tell(Job(200)).unwrap_err().kind, DeliveryError::Unreachable { .. }));
    robot.unite("left");
    advance(5000 * MS).await;

    // One is being served, and the queue is full.
    assert_eq!(lost([&left, &right]), [0, 200 - 1 - QUEUE as u64]);
    jobs.tell(Job(200)).unwrap();
    assert_eq!(log.take(), [0; 0]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_panic_of_the_stack_leaves_nothing_full_and_nothing_uncounted() {
    let (_robot, left, right) = pair().await;
    let (_slow, _log) = slow(&right, NEVER, WhenFull::Refuse).await;
    let jobs = flooded(&left).await;

    for module in [&right, &left] {
        module.net.panic_sessions();
        advance(2000 * MS).await;
    }

    assert_eq!(lost([&left, &right]), [0, 200 - 1 - QUEUE as u64]);
    jobs.tell(Job(200)).unwrap();
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn policies_that_drop_and_readings_keep_their_meaning() {
    for full in [WhenFull::DropOldest, WhenFull::DropNewest] {
        let (_robot, left, right) = pair().await;
        let (_slow, log) = slow(&right, MS, full).await;
        let jobs = left.sender::<Job>("right:slow");

        tokio::join!(deliver_all(&jobs, 0..1000), advance(2000 * MS));

        let done = log.take();
        assert!(done.len() < 1000 && done.is_sorted(), "{full:?}: {}", done.len());
        assert_eq!(done.contains(&999), full == WhenFull::DropOldest);
        assert_eq!(dead_at(&right), 1000 - done.len() as u64);
    }

    let (_robot, left, right) = pair().await;
    let (_slow, _log) = slow(&right, NEVER, WhenFull::Refuse).await;
    let glances = left.sender::<Sampling>("right:slow");
    for n in 0..200 {
        glances.tell(Sampling(n)).unwrap();
        advance(MS).await;
    }
    assert_eq!(dead_at(&right), 200 - 1 - QUEUE as u64);
}

/// Says this to `right`'s `slow` by the first binding of the session, whatever was heard.
fn blurt(left: &Module, count: usize) {
    let mut payload = Vec::new();
    codec::encode(&Job(7), &mut payload).unwrap();
    let payload = Bytes::from(payload);
    let message =
        PeerMessage::Tell { binding: 1, timestamp_us: 0, id: None, payload: payload.into() }
            .encode();
    let peer = NodeId::of(&NodeName::new("right").unwrap());
    left.net.on_stack(move |stack| {
        for _ in 0..count {
            let (stream, key) = (TrafficClass::Request, OrderingKey::default());
            let (message, now) = (message.clone(), platform::now());
            let right = stack.floors.gateway.protocol.peers.get_mut(peer).unwrap();
            right.session.handle_send_along(stream, key, message, None, now).unwrap();
        }
    });
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_peer_that_does_not_stop_loses_what_is_too_much_and_is_named_and_others_are_not_hindered()
{
    let (_robot, left, right) = pair().await;
    let (_slow, _log) = slow(&right, NEVER, WhenFull::Refuse).await;
    left.sender::<Job>("right:slow").tell(Job(0)).unwrap();
    advance(20 * MS).await;

    let fit = QUEUE + MESSAGES_MAX;
    for part in [4000, 4000, 4000, 4000, fit - 16_000] {
        blurt(&left, part);
        advance(100 * MS).await;
    }
    assert_eq!(lost([&left, &right]), [0, 0]);
    for _ in 0..4 {
        blurt(&left, 100);
        left.sender::<Add>("right:acc").ask_within(Add(1), 100 * MS).await.unwrap();
        advance(1000 * MS).await;
    }

    assert_eq!(dead_at(&right), 400);
    let declared = right.declared.drain();
    assert_eq!(declared.len(), 1, "{declared:?}");
    assert_eq!(declared[0].kind, FaultKind::CheckFailed);
    assert_eq!(declared[0].object.as_str(), "net/stack");
    assert!(declared[0].detail.contains("left does not stop"), "{}", declared[0].detail);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_reading_that_finds_its_receiver_between_two_incarnations_is_counted_as_that_and_not_as_full()
 {
    let (_robot, left, right) = pair().await;
    let (_slow, _log) = slow(&right, MS, WhenFull::Refuse).await;
    left.sender::<Job>("right:slow").tell(Job(DEADLY)).unwrap();
    advance(100 * MS).await;
    let glances = left.sender::<Sampling>("right:slow");
    for n in 0..100 {
        glances.tell(Sampling(n)).unwrap();
        advance(MS).await;
    }

    let name = ObjectName::new("slow").unwrap();
    let count = |reason| right.host.dead_letters.count(&name, reason);
    assert_eq!(count(DeadReason::Restarting), 100 - QUEUE as u64);
    assert_eq!((count(DeadReason::PeerDied), count(DeadReason::Full)), (1, 0));
}
