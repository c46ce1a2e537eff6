//! Two sessions and the wire between them, every state with every input.

use super::*;
use crate::NodeName;
use crate::net::segment::{Ack, Open};

const MS: Duration = Duration::from_millis(1);

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn named(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn config(node: &str, incarnation: u64, peer: &str) -> SessionConfig {
    SessionConfig::new(named(node), Incarnation(incarnation), named(peer))
}

fn text(text: &'static str) -> Bytes {
    Bytes::from_static(text.as_bytes())
}

/// Says whether the wire loses what this end sends.
type Lose = Box<dyn FnMut(usize, &Segment) -> bool>;

/// A wire that takes a millisecond and loses what it is told to.
struct Pair {
    ends: [Session; 2],
    now: u64,
    wire: VecDeque<(u64, usize, Bytes)>,
    /// Bytes per second each way, where the wire is slow, and until when each way is taken.
    rate: Option<u64>,
    taken: [u64; 2],
    /// Every segment that went out, by its sender.
    sent: Vec<(usize, Segment)>,
    told: [Vec<SessionOutput>; 2],
    lose: Lose,
}

impl Pair {
    fn new() -> Self {
        Pair::of(config("left", 1, "right"), config("right", 1, "left"))
    }

    fn of(left: SessionConfig, right: SessionConfig) -> Self {
        Pair {
            ends: [Session::new(left, at(0)), Session::new(right, at(0))],
            now: 0,
            wire: VecDeque::new(),
            rate: None,
            taken: [0; 2],
            sent: vec![],
            told: [vec![], vec![]],
            lose: Box::new(|_, _| false),
        }
    }

    /// Both ends know a path, and a session is open.
    fn open() -> Self {
        let mut pair = Pair::new();
        pair.connect();
        assert_eq!(pair.take(0), [opened(1)]);
        assert_eq!(pair.take(1), [opened(1)]);
        pair
    }

    fn connect(&mut self) {
        self.connect_over(1389);
    }

    fn connect_over(&mut self, mtu: usize) {
        for end in 0..2 {
            self.ends[end].handle_path(mtu, at(self.now));
        }
        self.run(20);
    }

    fn run(&mut self, millis: u64) {
        let end = self.now + millis;
        while self.now <= end {
            while let Some(first) = self.wire.iter().position(|(due, ..)| *due <= self.now) {
                let (_, to, segment) = self.wire.remove(first).unwrap();
                self.ends[to].handle_segment(segment, at(self.now));
                self.drain();
            }
            for end in 0..2 {
                let session = &mut self.ends[end];
                if session.poll_timeout().is_some_and(|due| due <= at(self.now)) {
                    session.handle_timeout(at(self.now));
                }
            }
            self.drain();
            self.now += 1;
        }
    }

    fn drain(&mut self) {
        for end in 0..2 {
            while let Some(output) = self.ends[end].poll_output() {
                let SessionOutput::Transmit { segment, .. } = output else {
                    self.told[end].push(output);
                    continue;
                };
                let segment = segment.into_bytes();
                let decoded = Segment::decode(segment.clone()).unwrap();
                if !(self.lose)(end, &decoded) {
                    let takes = self.rate.map_or(1, |rate| segment.len() as u64 * 1000 / rate);
                    let begins = if self.rate.is_some() { self.taken[end] } else { 0 };
                    self.taken[end] = begins.max(self.now) + takes;
                    self.wire.push_back((self.taken[end], 1 - end, segment));
                }
                self.sent.push((end, decoded));
            }
        }
    }

    fn send(&mut self, from: usize, message: Bytes) {
        self.ends[from].handle_send(Stream::Data, message, at(self.now)).unwrap();
    }

    fn take(&mut self, end: usize) -> Vec<SessionOutput> {
        std::mem::take(&mut self.told[end])
    }

    fn parts(&self, from: usize) -> usize {
        self.sent.iter().filter(|(end, s)| *end == from && matches!(s, Segment::Data(_))).count()
    }
}

fn opened(incarnation: u64) -> SessionOutput {
    SessionOutput::Opened { incarnation: Incarnation(incarnation) }
}

fn message(message: Bytes) -> SessionOutput {
    SessionOutput::Message { stream: Stream::Data, message }
}

fn returned(message: Bytes, why: &Why) -> SessionOutput {
    SessionOutput::Returned { stream: Stream::Data, message, why: why.clone(), sent: true }
}

fn unreachable(node: &str) -> Why {
    Why::Unreachable { node: node.into() }
}

#[test]
fn a_message_sent_while_the_session_opens_is_delivered_once_it_is_open() {
    let mut pair = Pair::new();
    pair.ends[0].handle_path(1389, at(0));
    pair.send(0, text("early"));
    pair.ends[1].handle_path(1389, at(0));

    pair.run(20);

    assert_eq!(pair.take(1), [opened(1), message(text("early"))]);
}

#[test]
fn without_a_path_nothing_is_accepted() {
    let mut session = Session::new(config("left", 1, "right"), at(0));
    let refused = session.handle_send(Stream::Data, text("x"), at(0));
    assert_eq!(refused, Err((unreachable("right"), text("x"))));
    let refused = session.handle_send_newest(1, text("x"), at(0));
    assert_eq!(refused, Err((unreachable("right"), text("x"))));
}

#[test]
fn a_lost_part_is_sent_again_and_nothing_is_delivered_before_it() {
    let mut pair = Pair::open();
    let mut first = true;
    pair.lose = Box::new(move |_, segment| {
        matches!(segment, Segment::Data(_)) && std::mem::take(&mut first)
    });

    for n in ["a", "b", "c"] {
        pair.send(0, text(n));
        pair.run(0);
    }
    pair.run(60);

    assert_eq!(pair.take(1), ["a", "b", "c"].map(|n| message(text(n))));
    assert_eq!(pair.ends[0].counters().repeated, 1);
}

#[test]
fn a_lost_acknowledgement_costs_a_repetition_and_no_second_delivery() {
    let mut pair = Pair::open();
    let mut first = true;
    pair.lose = Box::new(move |end, segment| {
        let lost = end == 1 && matches!(segment, Segment::Acknowledge { .. });
        lost && std::mem::take(&mut first)
    });

    pair.send(0, text("a"));
    pair.run(300);

    assert_eq!(pair.take(1), [message(text("a"))]);
    assert_eq!(pair.ends[1].counters().doubled, 1);
    assert!(pair.ends[0].poll_timeout().is_none(), "nothing is owed any more");
}

#[test]
fn waiting_messages_travel_together_and_large_ones_in_parts() {
    let mut pair = Pair::open();
    let before = pair.parts(0);
    for _ in 0..100 {
        pair.send(0, text("ten bytes."));
    }
    pair.run(10);
    assert_eq!(pair.parts(0) - before, 1);
    assert_eq!(pair.take(1).len(), 100);

    let large = Bytes::from(vec![7; 100_000]);
    pair.send(0, large.clone());
    pair.run(50);

    assert_eq!(pair.take(1), [message(large)]);
}

#[test]
fn control_overtakes_data_that_waits() {
    let mut pair = Pair::open();
    pair.send(0, Bytes::from(vec![7; 500_000]));
    pair.ends[0].handle_send(Stream::Control, text("stop"), at(pair.now)).unwrap();

    pair.run(200);

    let told = pair.take(1);
    assert!(matches!(told[0], SessionOutput::Message { stream: Stream::Control, .. }));
    assert_eq!(told.len(), 2);
}

#[test]
fn a_new_path_repeats_what_is_unacknowledged_at_once() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| matches!(segment, Segment::Data(_)));
    pair.send(0, text("a"));
    pair.run(5);
    assert_eq!(pair.take(1), []);

    pair.lose = Box::new(|_, _| false);
    pair.ends[0].handle_path(1389, at(pair.now));
    pair.run(2);

    assert_eq!(pair.take(1), [message(text("a"))]);
}

#[test]
fn a_path_that_became_smaller_gets_pieces() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| matches!(segment, Segment::Data(_)));
    let large = Bytes::from(vec![7; 5000]);
    pair.send(0, large.clone());
    pair.run(5);

    pair.lose = Box::new(|_, segment| segment.encode().len() > 500);
    pair.ends[0].handle_path(500, at(pair.now));
    pair.run(50);

    assert_eq!(pair.take(1), [message(large)]);
}

#[test]
fn a_piece_with_an_acknowledgement_on_board_is_no_larger_than_the_narrow_path() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| matches!(segment, Segment::Data(_)));
    pair.send(0, Bytes::from(vec![7; 5000]));
    pair.run(5);
    let tag = pair.ends[0].tag;
    for sequence in [1, 3, 5] {
        let payload = Bytes::from_static(b"\x02hi");
        let (first, last, again) = (true, true, false);
        let stream = Stream::Data;
        let data = Data {
            tag,
            stream,
            sequence,
            first,
            last,
            again,
            piece: None,
            ack: None,
            payload: payload.into(),
        };
        pair.ends[0].handle_segment(Segment::Data(data).encode(), at(pair.now));
    }
    pair.sent.clear();

    pair.ends[0].handle_path(85, at(pair.now));
    pair.drain();

    let lengths: Vec<_> = pair.sent.iter().map(|(_, segment)| segment.encode().len()).collect();
    assert!(pair.parts(0) > 20, "{lengths:?}");
    assert!(lengths.iter().all(|length| *length <= 85), "{lengths:?}");
}

#[test]
fn a_short_outage_is_ridden_out_and_a_long_one_gives_everything_back() {
    let mut pair = Pair::open();
    pair.ends[0].handle_no_path(at(pair.now));
    pair.send(0, text("a"));
    pair.run(1000);
    assert_eq!(pair.take(1), []);
    pair.ends[0].handle_path(1389, at(pair.now));
    pair.run(5);
    assert_eq!(pair.take(1), [message(text("a"))]);

    pair.ends[0].handle_no_path(at(pair.now));
    pair.send(0, text("b"));
    pair.run(2100);

    let why = unreachable("right");
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: why.clone() };
    let never_sent = SessionOutput::Returned {
        stream: Stream::Data,
        message: text("b"),
        why: why.clone(),
        sent: false,
    };
    assert_eq!(pair.take(0), [never_sent, ended]);
    let refused = pair.ends[0].handle_send(Stream::Data, text("c"), at(pair.now));
    assert_eq!(refused, Err((why, text("c"))));
}

#[test]
fn a_node_that_stood_still_blames_no_peer_for_it() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, _| true);
    pair.send(0, text("a"));
    pair.run(5);

    pair.now += 3500;
    pair.lose = Box::new(|_, _| false);
    pair.run(100);

    assert_eq!(pair.take(1), [message(text("a"))]);
    assert_eq!(pair.take(0), []);
}

#[test]
fn a_peer_that_says_nothing_although_there_is_a_path_is_given_up() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, _| true);
    pair.send(0, text("a"));

    pair.run(2100);

    assert!(pair.take(0).contains(&returned(text("a"), &unreachable("right"))));
}

#[test]
fn a_restarted_peer_is_a_new_session_and_the_old_ones_messages_come_back() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| matches!(segment, Segment::Data(_)));
    pair.send(0, text("a"));
    pair.run(1);

    pair.lose = Box::new(|_, _| false);
    pair.ends[1] = Session::new(config("right", 2, "left"), at(pair.now));
    pair.ends[1].handle_path(1389, at(pair.now));
    pair.run(30);

    let why = Why::PeerDied { incarnation: Incarnation(1) };
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: why.clone() };
    assert_eq!(pair.take(0), [returned(text("a"), &why), ended, opened(2)]);
    assert_eq!(pair.take(1), [opened(1)]);
    pair.send(0, text("b"));
    pair.run(5);
    assert_eq!(pair.take(1), [message(text("b"))]);
}

#[test]
fn the_routers_word_of_a_new_life_ends_the_session_before_the_peer_says_anything() {
    let mut pair = Pair::open();

    pair.ends[0].handle_incarnation(Incarnation(2), at(pair.now));
    pair.drain();

    let why = Why::PeerDied { incarnation: Incarnation(1) };
    assert_eq!(pair.take(0), [SessionOutput::Ended { incarnation: Incarnation(1), why }]);
}

#[test]
fn a_peer_whose_new_life_has_a_smaller_number_is_talked_to_and_the_old_one_is_refused() {
    let mut pair = Pair::open();
    for life in [9, 3, 2] {
        let old: Vec<_> = pair.sent.iter().filter(|(end, _)| *end == 1).cloned().collect();
        pair.ends[0].handle_incarnation(Incarnation(life), at(pair.now));
        pair.ends[1] = Session::new(config("right", life, "left"), at(pair.now));
        pair.ends[1].handle_path(1389, at(pair.now));
        pair.run(30);
        assert_eq!(pair.take(0).last(), Some(&opened(life)));
        assert_eq!(pair.take(1), [opened(1)]);

        for (_, segment) in old {
            pair.ends[0].handle_segment(segment.encode(), at(pair.now));
        }
        pair.send(0, text("a"));
        pair.run(30);

        assert_eq!((pair.take(0), pair.take(1)), (vec![], vec![message(text("a"))]));
    }
}

#[test]
fn what_was_said_to_an_earlier_session_is_never_taken_for_the_present_one() {
    let mut pair = Pair::open();
    pair.send(0, text("old"));
    pair.drain();
    let replay: Vec<_> = pair.sent.iter().filter(|(end, _)| *end == 0).cloned().collect();
    pair.run(5);
    assert_eq!(pair.take(1), [message(text("old"))]);

    // The left process dies and lives again; the wire then repeats everything that it ever said.
    pair.ends[0] = Session::new(config("left", 2, "right"), at(pair.now));
    pair.ends[0].handle_path(1389, at(pair.now));
    pair.run(30);
    pair.take(0);
    pair.take(1);
    for (_, segment) in replay {
        pair.ends[1].handle_segment(segment.encode(), at(pair.now));
        pair.drain();
    }
    pair.run(50);

    assert_eq!(pair.take(1), []);
    assert_eq!(pair.ends[1].peer(), Some(Incarnation(2)));
    assert!(pair.ends[1].refusals().stale >= 2);
}

#[test]
fn a_session_that_lost_its_memory_makes_both_ends_begin_anew() {
    let mut pair = Pair::open();

    pair.ends[0].handle_begin_anew(at(pair.now));
    pair.run(30);

    for end in 0..2 {
        let told = pair.take(end);
        assert!(matches!(told[..], [SessionOutput::Ended { .. }, SessionOutput::Opened { .. }]));
    }
}

#[test]
fn a_machine_built_anew_is_found_out_by_its_peers_next_word() {
    let mut pair = Pair::open();
    let number = pair.ends[1].number() + 1000;
    let config = SessionConfig { number, ..config("right", 1, "left") };
    pair.ends[1] = Session::new(config, at(pair.now));
    pair.send(0, text("a"));
    pair.run(5);
    pair.ends[1].handle_path(1389, at(pair.now));
    pair.run(50);

    let told = pair.take(0);
    assert!(told.contains(&returned(text("a"), &unreachable("right"))), "{told:?}");
    assert_eq!(told.last(), Some(&opened(1)));
    assert_eq!(pair.take(1), [opened(1)]);
}

#[test]
fn a_close_delivers_what_was_sent_and_ends_both() {
    let mut pair = Pair::open();
    for n in ["a", "b"] {
        pair.send(0, text(n));
    }

    pair.ends[0].handle_close(at(pair.now));
    let refused = pair.ends[0].handle_send(Stream::Data, text("c"), at(pair.now));
    pair.run(50);

    assert_eq!(refused, Err((Why::Stopped, text("c"))));
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: Why::Stopped };
    assert_eq!(pair.take(1), [message(text("a")), message(text("b")), ended.clone()]);
    assert_eq!(pair.take(0), [ended]);
    assert!(pair.ends[0].is_closed());
}

#[test]
fn a_close_that_nobody_hears_ends_all_the_same() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| matches!(segment, Segment::Close { .. }));

    pair.ends[0].handle_close(at(pair.now));
    pair.run(3000);

    assert!(pair.ends[0].is_closed());
}

#[test]
fn a_full_stream_says_so_then_refuses_then_has_room_again() {
    let small = SessionConfig { buffer_messages: 4, ..config("left", 1, "right") };
    let mut pair = Pair::of(small, config("right", 1, "left"));
    pair.connect();
    pair.take(0);
    pair.lose = Box::new(|_, _| true);
    for _ in 0..8 {
        pair.send(0, text("x"));
    }
    let refused = pair.ends[0].handle_send(Stream::Data, text("x"), at(pair.now));
    assert_eq!(refused, Err((Why::Full, text("x"))));
    pair.run(1);
    assert_eq!(pair.take(0), [SessionOutput::Full { stream: Stream::Data }]);

    pair.lose = Box::new(|_, _| false);
    pair.run(200);

    assert_eq!(pair.take(0), [SessionOutput::Room { stream: Stream::Data }]);
    assert_eq!(pair.take(1).len(), 9, "opened, and eight messages");
}

#[test]
fn of_best_effort_messages_the_newest_counts_and_none_comes_twice() {
    let mut pair = Pair::open();
    let newest = |pair: &mut Pair, channel, n| {
        pair.ends[0].handle_send_newest(channel, text(n), at(pair.now)).unwrap();
        pair.drain();
    };
    newest(&mut pair, 1, "a");
    newest(&mut pair, 1, "b");
    newest(&mut pair, 2, "other");
    // The wire turns the first two round and repeats the newer one.
    pair.wire.swap(0, 1);
    let again = pair.wire[0].clone();
    pair.wire.push_back(again);

    pair.run(5);

    let newest = |channel, n| SessionOutput::Newest { channel, message: text(n) };
    assert_eq!(pair.take(1), [newest(1, "b"), newest(2, "other")]);
    let counters = pair.ends[1].counters();
    assert_eq!((counters.overtaken, counters.doubled), (1, 1));
}

#[test]
fn a_large_best_effort_message_comes_whole_or_not_at_all() {
    let mut pair = Pair::open();
    let large = Bytes::from(vec![7; 5000]);
    pair.ends[0].handle_send_newest(1, large.clone(), at(pair.now)).unwrap();
    pair.run(5);
    assert_eq!(pair.take(1), [SessionOutput::Newest { channel: 1, message: large.clone() }]);

    let mut first = true;
    pair.lose = Box::new(move |_, _| std::mem::take(&mut first));
    pair.ends[0].handle_send_newest(1, large, at(pair.now)).unwrap();
    pair.run(50);

    assert_eq!(pair.take(1), []);
}

#[test]
fn a_best_effort_message_of_too_many_pieces_is_refused_and_no_piece_is_larger_than_the_path() {
    let mut pair = Pair::new();
    pair.connect_over(85);
    pair.take(1);
    let limit = (85 - 28) * 4096;
    let mut send = |bytes| {
        let message = Bytes::from(vec![7; bytes]);
        pair.ends[0].handle_send_newest(1, message, at(pair.now))
    };

    let refused = send(limit + 1).unwrap_err();
    assert_eq!(refused.0, Why::TooLargeForSession { limit });
    assert_eq!(refused.1.len(), limit + 1);

    send(limit).unwrap();
    pair.run(5);
    assert!(pair.sent.iter().all(|(_, segment)| segment.encode().len() <= 85));
    let message = Bytes::from(vec![7; limit]);
    assert_eq!(pair.take(1), [SessionOutput::Newest { channel: 1, message }]);
}

#[test]
fn a_message_larger_than_the_limit_is_refused_before_it_is_sent() {
    let mut pair = Pair::open();
    let limit = pair.ends[0].config.message_max;
    let huge = Bytes::from(vec![0; limit + 1]);
    let refused = pair.ends[0].handle_send(Stream::Data, huge, at(pair.now)).unwrap_err();
    assert_eq!(refused.0, Why::TooLargeForSession { limit });
}

#[test]
fn another_version_is_told_once_and_nothing_opens() {
    let mut session = Session::new(config("left", 1, "right"), at(0));
    session.handle_path(1389, at(0));
    let open = Open { version: 9, tag: 1, echo: 0, incarnation: Incarnation(1), number: 1 };

    for _ in 0..3 {
        session.handle_segment(Segment::Open(open).encode(), at(1));
    }

    let told: Vec<_> = std::iter::from_fn(|| session.poll_output())
        .filter(|output| !matches!(output, SessionOutput::Transmit { .. }))
        .collect();
    assert_eq!(told, [SessionOutput::Incompatible { theirs: 9 }]);
    assert_eq!(session.refusals().version, 3);
}

#[test]
fn one_small_message_there_and_back_takes_three_segments() {
    let mut pair = Pair::open();
    let before = pair.sent.len();

    pair.send(0, text("request"));
    pair.run(1);
    pair.send(1, text("reply"));
    pair.run(20);

    // The reply carries the request's acknowledgement.
    assert_eq!(pair.sent.len() - before, 3);
    // A millisecond each way, and one in which the callee thinks.
    assert_eq!(pair.ends[0].round_trip(), Some(3 * MS));
}

#[test]
fn a_session_at_rest_is_silent() {
    let mut pair = Pair::open();
    pair.send(0, text("a"));
    pair.run(100);
    let before = pair.sent.len();

    pair.run(10_000);

    assert_eq!(pair.sent.len(), before);
}

#[test]
fn control_goes_before_data_that_waits_and_before_data_that_nobody_acknowledges() {
    let mut pair = Pair::open();
    for _ in 0..2000 {
        pair.send(0, Bytes::from(vec![7; 1000]));
    }
    pair.ends[0].handle_send(Stream::Control, text("now"), at(pair.now)).unwrap();
    pair.run(3);

    let told = pair.take(1);
    let place = told.iter().position(|output| {
        matches!(output, SessionOutput::Message { stream: Stream::Control, .. })
    });
    assert_eq!(place, Some(0), "of {}", told.len());

    // A full window of data is lost; control does not wait until that is noticed.
    pair.lose = Box::new(|end, segment| {
        end == 0 && matches!(segment, Segment::Data(data) if data.stream == Stream::Data)
    });
    pair.run(1);
    pair.ends[0].handle_send(Stream::Control, text("again"), at(pair.now)).unwrap();
    pair.run(3);
    let told = pair.take(1);
    let control = SessionOutput::Message { stream: Stream::Control, message: text("again") };
    assert!(told.contains(&control), "{told:?}");
}

#[test]
fn what_goes_every_way_does_not_wait_for_data_and_is_acknowledged_by_itself() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| match segment {
        Segment::Data(data) => data.stream == Stream::Data,
        Segment::Acknowledge { redundant, .. } => redundant.is_none(),
        _ => false,
    });
    for _ in 0..200 {
        pair.send(0, Bytes::from(vec![7; 1000]));
    }
    pair.run(5);

    for _ in 0..100 {
        pair.ends[0].handle_send(Stream::Redundant, text("x"), at(pair.now)).unwrap();
        pair.run(1);
        assert_eq!(pair.take(1).len(), 1, "at {}", pair.now);
    }

    pair.run(5);
    let again = pair.sent.iter().filter(|(_, segment)| {
        matches!(segment, Segment::Data(data) if data.stream == Stream::Redundant && data.again)
    });
    assert_eq!(again.count(), 0);
    assert_eq!(pair.ends[0].streams[Stream::Redundant as usize].outbound.flying(), 0);
}

#[test]
fn a_forged_session_does_not_end_the_present_one_and_a_true_one_does() {
    let mut pair = Pair::open();
    for end in 0..2 {
        pair.ends[end].handle_incarnation(Incarnation(1), at(pair.now));
    }
    let forged = |incarnation, number| {
        let incarnation = Incarnation(incarnation);
        let open = Open { version: VERSION, tag: 99, echo: 0, incarnation, number };
        Segment::Open(open).encode()
    };
    for segment in [forged(1, u32::MAX), forged(u64::MAX, 1), forged(2, 1)] {
        pair.ends[0].handle_segment(segment, at(pair.now));
        pair.run(50);
    }
    pair.send(0, text("a"));
    pair.run(50);
    assert_eq!(pair.take(0), []);
    assert_eq!(pair.take(1), [message(text("a"))]);
    assert_eq!(pair.ends[0].refusals().unexpected, 3);

    // The other machine is built anew within its life.
    let config = SessionConfig { number: 1000, ..config("right", 1, "left") };
    pair.ends[1] = Session::new(config, at(pair.now));
    pair.ends[1].handle_path(1389, at(pair.now));
    pair.run(50);
    assert!(matches!(
        pair.take(0)[..],
        [SessionOutput::Ended { .. }, SessionOutput::Opened { .. }]
    ));
    assert_eq!(pair.take(1), [opened(1)]);
}

#[test]
fn a_peer_that_promises_an_absurd_window_is_sent_no_more_than_ours() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|end, _| end == 1);
    for _ in 0..600 {
        pair.ends[0].handle_send(Stream::Redundant, text("x"), at(pair.now)).unwrap();
        pair.drain();
    }
    let tag = pair.ends[0].tag;
    let ack = Ack { next: 1, window: u32::MAX, ranges: vec![] };
    let greedy = Segment::Acknowledge { tag, control: None, data: None, redundant: Some(ack) };
    pair.ends[0].handle_segment(greedy.encode(), at(pair.now));
    pair.drain();

    let flying = pair.ends[0].streams[Stream::Redundant as usize].outbound.flying();
    assert_eq!(flying, 256);
}

/// Both ends of a line of 9,600 bits a second say something large at once. Answers how much was repeated.
fn over_9600_baud(mtu: usize) -> u64 {
    let mut pair = Pair::new();
    pair.rate = Some(960);
    pair.connect_over(mtu);
    pair.run(1000);
    assert_eq!((pair.take(0), pair.take(1)), (vec![opened(1)], vec![opened(1)]));

    pair.send(0, Bytes::from(vec![7; 300]));
    pair.send(1, Bytes::from(vec![7; 300]));
    pair.run(2000);
    for _ in 0..10 {
        pair.send(0, text("small"));
        pair.run(200);
    }
    pair.send(0, Bytes::from(vec![7; 12_000]));
    pair.send(1, Bytes::from(vec![7; 12_000]));
    pair.run(20_000);
    pair.send(0, text("last"));
    pair.run(3_000);

    assert_eq!((pair.take(0).len(), pair.take(1).len()), (2, 13));
    // Little of it is in the queue, not all of the twelve seconds.
    let parts = Duration::from_secs_f64(4.0 * mtu as f64 / 960.0);
    assert!(pair.ends[0].round_trip().unwrap() < parts, "{:?}", pair.ends[0].round_trip());
    [0, 1].map(|end| pair.ends[end].counters().repeated).iter().sum()
}

#[test]
fn a_session_takes_a_path_for_narrow_by_its_frames_as_the_router_does() {
    let is_narrow = |mtu| {
        let mut session = Session::new(config("left", 1, "right"), at(0));
        session.handle_path(mtu, at(0));
        session.is_narrow()
    };
    // Of CAN, and of a network that is configured for little, however many nodes pass on there.
    let [can, ethernet] = [1_024, 1_200].map(crate::net::topology::segment_limit);
    assert!(is_narrow(can) && !is_narrow(ethernet));
    assert!(!is_narrow(
        ethernet - crate::net::packet::passed_length(crate::net::packet::HOPS_MAX.into())
    ));
}

#[test]
fn the_least_segment_of_a_path_carries_everything() {
    const LEAST: usize = crate::net::topology::SEGMENT_MIN;
    let mut pair = Pair::open();
    pair.sent.clear();
    let large = Bytes::from(vec![7; 3_000]);
    for end in 0..2 {
        pair.ends[end].handle_path(LEAST, at(pair.now));
        pair.send(end, large.clone());
    }

    pair.run(20_000);

    let longest = pair.sent.iter().map(|(_, segment)| segment.encode().len()).max().unwrap();
    assert!(longest <= LEAST, "{longest} bytes");
    assert_eq!([pair.take(0), pair.take(1)], [vec![message(large.clone())], vec![message(large)]]);
}

#[test]
fn a_line_of_9600_baud_carries_everything_once_and_repeats_nothing() {
    assert_eq!(over_9600_baud(85), 0);
}

#[test]
fn a_line_whose_frames_take_longer_than_any_answer_before_repeats_little_until_it_is_known() {
    let repeated = over_9600_baud(600);
    assert!(repeated <= 22, "{repeated} parts of 44");
}

#[test]
fn whoever_cannot_be_reached_because_packets_come_back_is_told_why_and_what_to_do() {
    let cases = [
        (Undelivered::NoRoute, None),
        (Undelivered::TooManyHops, Some("too many nodes have passed it on; the path is too long")),
        (Undelivered::TooLarge, Some("larger than the next link can carry; let the links")),
    ];
    for (reason, expected) in cases {
        let mut pair = Pair::open();
        pair.lose = Box::new(|_, _| true);
        pair.ends[0].handle_send(Stream::Data, text("lost"), at(pair.now)).unwrap();
        pair.run(50);
        pair.ends[0].handle_undelivered(reason, at(pair.now));
        pair.run(10_000);

        let ended = pair.take(0).into_iter().find_map(|output| match output {
            SessionOutput::Ended { why, .. } => Some(why),
            _ => None,
        });
        match (ended.expect("the session ends"), expected) {
            (Why::Unreachable { .. }, None) => {}
            (Why::Undelivered { node, reason }, Some(expected)) => {
                assert_eq!(node, "right");
                assert!(reason.contains(expected), "{reason}");
            }
            (other, _) => panic!("{reason:?}: {other}"),
        }
    }
}
