//! A peer that is broken or hostile: it is counted and named, and others are not hindered.

use super::*;
use blastema_core::net::NodeId;
use blastema_core::net::session::VERSION;
use blastema_core::net::trust::access::AccessDenied;
use blastema_core::net::trust::policy::Verb;
use blastema_core::net::wire::segment::{Ack, DelayTicks, OpenSegment, Segment};
use bytes::Bytes;

/// Three nodes, each with a cable to both others.
async fn three() -> (Robot, [Module; 3]) {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("a", &["right"]), ("b", &["middle"])]).await;
    let right = robot.module("right", 1, &[("a", &["left"]), ("c", &["middle"])]).await;
    let middle = robot.module("middle", 1, &[("b", &["left"]), ("c", &["right"])]).await;
    advance(500 * MS).await;
    (robot, [left, right, middle])
}

/// Sends all this to `module` repeatedly, in the name of `source`, while a friend asks it and gets
/// answers. Returns the declared faults.
async fn under_fire(
    victim: &Module,
    friend: &Module,
    source: &str,
    authentic: bool,
    words: &[Segment],
) -> Vec<FaultDeclared> {
    let source = NodeId::of(&NodeName::new(source).unwrap());
    let words: Vec<Bytes> = words.iter().map(Segment::encode).collect();
    let sender = friend.sender::<Add>("left:acc");
    let before = sender.ask_within(Add(0), 100 * MS).await.unwrap();
    for n in 1..=50 {
        for segment in words.iter().cycle().take(20) {
            let segment = segment.clone();
            victim.net.on_stack(move |stack| {
                stack.floors.gateway.handle_segment(source, segment, authentic);
            });
        }
        assert_eq!(sender.ask_within(Add(1), 100 * MS).await.unwrap(), before + n);
        advance(100 * MS).await;
    }
    victim.declared.drain()
}

fn stale(tag: u32) -> Vec<Segment> {
    let ack = || {
        Some(Ack {
            next: u64::MAX >> 1,
            window: u32::MAX,
            arrived: DelayTicks::default(),
            ranges: vec![(1 << 63, 1 << 63)],
        })
    };
    let open = |incarnation, number| {
        let incarnation = Incarnation(incarnation);
        Segment::Open(OpenSegment {
            version: VERSION,
            tag,
            echo: 0,
            incarnation,
            number,
            before: None,
        })
    };
    vec![
        Segment::Acknowledge { tag, streams: [(); 6].map(|()| ack()), datagrams: None },
        Segment::Reset { tag },
        Segment::Close { tag },
        // Sessions of a past incarnation, of one to come, and of more sessions than there ever
        // were.
        open(0, 7),
        open(1000, 1),
        open(1, u32::MAX),
    ]
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn forged_and_replayed_sessions_are_refused_counted_and_named_and_the_forged_one_goes_on() {
    let (_robot, [left, right, middle]) = three().await;
    let before = right.sender::<Note>("left:acc");
    before.tell(Note(1)).unwrap();
    advance(10 * MS).await;

    let declared = under_fire(&left, &middle, "right", false, &stale(99)).await;

    assert_eq!(declared.len(), 1, "{declared:?}");
    assert_eq!(declared[0].kind, FaultKind::CheckFailed);
    assert_eq!(declared[0].object.as_str(), "net/stack");
    assert!(declared[0].detail.contains("from right"), "{}", declared[0].detail);
    // The session that they were forged for has not noticed.
    before.tell(Note(2)).unwrap();
    right.sender::<Add>("left:acc").ask(Add(0)).await.unwrap();
    left.sender::<Add>("right:acc").ask(Add(0)).await.unwrap();
    assert_eq!(left.log.take(), [1, 2]);
    let lost = left.host.dead_letters.total() + right.host.dead_letters.total();
    assert_eq!(lost, 0);
    // It was relayed by others: the node that forged it cannot be told.
    assert_eq!(offences(&left), Vec::<String>::new());
}

/// How long it stands after it was told last.
const QUIET: Duration = Duration::from_secs(60);

#[blastema_macros::test(crate = "blastema_doubles")]
async fn that_a_session_must_be_refused_ends_by_itself_and_is_told_again() {
    let (_robot, [left, _right, middle]) = three().await;
    let words = stale(99);
    let fire = async || {
        let declared = under_fire(&left, &middle, "right", false, &words).await;
        assert_eq!(declared.len(), 1, "{declared:?}");
        assert_eq!((declared[0].object.as_str(), declared[0].hold), ("net/stack", Some(QUIET)));
    };
    fire().await;
    advance(QUIET).await;
    left.declared.drain();
    advance(QUIET).await;
    assert_eq!(left.declared.drain(), [], "it is over");
    fire().await;
}

fn offences(module: &Module) -> Vec<String> {
    let offence = |report: NodeReported| match report.condition {
        NodeCondition::Offends { what } => Some(format!("{}: {what}", report.node)),
        _ => None,
    };
    module.nodes.drain().into_iter().filter_map(offence).collect()
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_floods_by_its_own_link_is_told_as_an_offender() {
    let (_robot, [left, _right, middle]) = three().await;

    under_fire(&left, &middle, "right", true, &stale(99)).await;

    assert_eq!(offences(&left), ["right: it sent for seconds what had to be refused"]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_is_of_the_past_is_told_and_held_against_absent_for_others_may_repeat_it() {
    let (_robot, [left, _right, middle]) = three().await;
    let past = &stale(99)[..4];

    let declared = under_fire(&left, &middle, "right", true, past).await;

    assert_eq!(declared.len(), 1, "{declared:?}");
    assert!(declared[0].detail.contains("200 stale"), "{}", declared[0].detail);
    assert_eq!(offences(&left), Vec::<String>::new());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_node_is_not_believed_about_others_and_about_its_own_objects_it_is() {
    let (_robot, [left, right, middle]) = three().await;
    let tell = |location: FaultLocation| {
        let name = NodeName::new("left").unwrap();
        let kind = FaultKind::NodeFaulty;
        let fault = Fault::of_node(name, kind, "it floods".into(), platform::now());
        let port = right.net.recoverer_of(&NodeName::new("left").unwrap());
        async move { port.send(Recover { fault: Fault { location, ..fault } }).await }
    };
    let object = |text: &str| FaultLocation::Object(text.parse().unwrap());
    let others = [
        FaultLocation::Node(NodeName::new("middle").unwrap()),
        FaultLocation::Node(NodeName::new("left").unwrap()),
        object("left:acc"),
        object("middle:acc"),
    ];
    for location in others {
        let reported = tell(location);
        let (reported, ()) = tokio::join!(reported, advance(100 * MS));
        reported.expect("it is not repeated");
    }
    assert!(left.faults.drain().is_empty());

    let (reported, ()) = tokio::join!(tell(object("right:acc")), advance(100 * MS));
    reported.expect("it is taken");
    assert_eq!(left.faults.drain().len(), 1);
    drop(middle);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_speaks_for_a_node_that_absent_knows_is_counted_and_told() {
    let (_robot, [left, _right, middle]) = three().await;

    let declared = under_fire(&left, &middle, "absent", false, &stale(99)).await;

    assert_eq!(declared.len(), 1, "{declared:?}");
    let detail = &declared[0].detail;
    assert!(detail.contains("no route leads to") && detail.contains("unexpected"), "{detail}");
    assert_eq!(left.net.read_sessions().await.len(), 2, "nothing is kept for it");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_is_refused_in_passing_is_no_fault() {
    let (_robot, [left, _right, _middle]) = three().await;
    let source = NodeId::of(&NodeName::new("right").unwrap());
    for _ in 0..200 {
        let segment = Segment::Reset { tag: 99 }.encode();
        left.net.on_stack(move |stack| {
            stack.floors.gateway.handle_segment(source, segment, false);
        });
    }
    advance(10_000 * MS).await;

    assert_eq!(left.declared.drain(), []);
}

/// Sends so much garbage in each of these seconds to `left`'s end of network `a`.
async fn garbage(sender: &Addr<FrameTransport>, seconds: &[usize]) {
    let to = MediumAddress::Memory("a/left".into());
    for count in seconds {
        for _ in 0..*count {
            let frame = Bytes::from_static(b"\xffgarbage");
            sender.do_send(blastema_contract::transport::Transmit::new(to.clone(), frame.into()));
        }
        advance(1000 * MS).await;
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn lasting_garbage_from_a_neighbours_address_is_a_fault_of_the_links_and_passing_garbage_is_none()
 {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("a", &["right"])]).await;

    let sender = FrameTransport::new(Memory::new(&robot.medium, "a/right")).start();
    settle().await;

    garbage(&sender, &[1000, 1000, 0, 1000, 40, 40]).await;
    assert_eq!(left.declared.drain(), []);

    garbage(&sender, &[100, 100, 100, 100]).await;
    let declared = left.declared.drain();
    assert_eq!(declared.len(), 1, "{declared:?}");
    assert_eq!(declared[0].kind, FaultKind::CheckFailed);
    assert_eq!(declared[0].object.as_str(), "net/links/a");
    let detail = &declared[0].detail;
    assert!(detail.contains("a/right") && detail.contains("100 foreign"), "{detail}");

    assert_eq!(declared[0].hold, Some(QUIET));

    advance(2 * QUIET).await;
    assert_eq!(left.declared.drain(), []);
    garbage(&sender, &[100, 100, 100, 100]).await;
    assert_eq!(left.declared.drain().len(), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn lasting_garbage_from_strangers_is_a_fault_of_the_links() {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("a", &["right"])]).await;

    let sender = FrameTransport::new(Memory::new(&robot.medium, "a/stranger")).start();
    settle().await;

    garbage(&sender, &[100, 100, 100, 100]).await;

    let declared = left.declared.drain();
    assert_eq!(declared.len(), 1, "{declared:?}");
    let detail = &declared[0].detail;
    assert!(detail.contains("no link of a leads to"), "{detail}");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_is_refused_a_thousand_times_a_second_is_told_as_an_offender() {
    let (_robot, [left, right, _middle]) = three().await;
    right.sender::<Add>("left:acc").ask(Add(0)).await.unwrap();
    let denied = AccessDenied {
        peer: NodeName::new("right").unwrap(),
        verb: Verb::Set,
        object: "left/speed".into(),
        contract: String::new(),
        line: Some(1),
        serial: 1,
    };
    let refuse = async |times| {
        (0..times).for_each(|_| left.host.registry.access().record(denied.clone()));
        advance(1_000 * MS).await;
    };
    refuse(999).await;
    assert_eq!(offences(&left), Vec::<String>::new());
    refuse(1_000).await;
    let what = "right: it asks a thousand times a second for what it may not";
    assert_eq!(offences(&left), [what]);
}
