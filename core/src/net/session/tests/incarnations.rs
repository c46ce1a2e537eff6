//! How sessions end, and one follows the other.

use super::*;
use crate::delivery::dead_letters::DeadReason;

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

    let why = DeliveryError::PeerDied { incarnation: Incarnation(1) };
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: why.clone() };
    assert_eq!(pair.take(0), [returned(text("a"), &why), ended, opened(2)]);
    assert_eq!(pair.take(1), [opened(1)]);
    pair.send(0, text("b"));
    pair.run(5);
    assert_eq!(pair.take(1), [message(text("b"))]);
}

#[test]
fn the_routers_word_of_a_new_incarnation_ends_the_session_before_the_peer_says_anything() {
    let mut pair = Pair::open();

    pair.ends[0].handle_incarnation(Incarnation(2), at(pair.now));
    pair.drain();

    let why = DeliveryError::PeerDied { incarnation: Incarnation(1) };
    assert_eq!(pair.take(0), [SessionOutput::Ended { incarnation: Incarnation(1), why }]);
}

#[test]
fn a_peer_whose_new_incarnation_has_a_smaller_number_is_talked_to_and_the_old_one_is_refused() {
    let mut pair = Pair::open();
    for incarnation in [9, 3, 2] {
        let old: Vec<_> = pair.sent.iter().filter(|(end, _)| *end == 1).cloned().collect();
        pair.ends[0].handle_incarnation(Incarnation(incarnation), at(pair.now));
        pair.ends[1] = Session::new(config("right", incarnation, "left"), at(pair.now));
        pair.ends[1].handle_path(1389, at(pair.now));
        pair.run(30);
        assert_eq!(pair.take(0).last(), Some(&opened(incarnation)));
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

    pair.ends[0].handle_restart(at(pair.now));
    pair.run(30);

    for end in 0..2 {
        let outputs = pair.take(end);
        assert!(matches!(outputs[..], [SessionOutput::Ended { .. }, SessionOutput::Opened { .. }]));
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

    let outputs = pair.take(0);
    assert!(outputs.contains(&returned(text("a"), &unreachable("right"))), "{outputs:?}");
    assert_eq!(outputs.last(), Some(&opened(1)));
    assert_eq!(pair.take(1), [opened(1)]);
}

#[test]
fn a_close_delivers_what_was_sent_and_ends_both() {
    let mut pair = Pair::open();
    for n in ["a", "b"] {
        pair.send(0, text(n));
    }

    pair.ends[0].handle_close(at(pair.now));
    let refused = pair.ends[0].handle_send(TrafficClass::Request, text("c"), at(pair.now));
    pair.run(50);

    assert_eq!(refused, Err((DeliveryError::Stopped, text("c"))));
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: DeliveryError::Stopped };
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
fn another_version_is_told_once_and_nothing_opens() {
    let mut session = Session::new(config("left", 1, "right"), at(0));
    session.handle_path(1389, at(0));
    // Before 2, nothing came between the parts of a large message: such a node would end session
    // after session.
    let (incarnation, before) = (Incarnation(1), None);
    let open = OpenSegment { version: 1, tag: 1, echo: 0, incarnation, number: 1, before };

    for _ in 0..3 {
        session.handle_segment(Segment::Open(open).encode(), at(1));
    }

    let outputs: Vec<_> = std::iter::from_fn(|| session.poll_output())
        .filter(|output| !matches!(output, SessionOutput::Transmit { .. }))
        .collect();
    assert_eq!(outputs, [SessionOutput::Incompatible { theirs: 1 }]);
    assert_eq!(session.refusals().version, 3);
}

#[test]
fn what_comes_back_from_a_peer_that_breaks_the_protocol_was_good_itself() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|end, _| end == 0);
    pair.send(0, text("good"));
    let tag = pair.ends[0].identity.tag;
    let (first, last, again) = (false, true, false);
    let (piece, ack, payload) = (None, None, text("an end without a start").into());
    let (stream, sequence) = (TrafficClass::Request, 0);
    let broken = Data { tag, stream, sequence, first, last, again, piece, ack, payload };
    pair.ends[0].handle_segment(Segment::Data(broken).encode(), at(pair.now));
    pair.drain();

    let outputs = pair.take(0);
    let Some(SessionOutput::Returned { why, .. }) = outputs.first() else { panic!("{outputs:?}") };
    assert_eq!(DeadReason::from(why), DeadReason::Unreachable, "{why}");
    assert!(why.to_string().contains("a message without a start"), "{why}");
}

#[test]
fn what_a_machine_holds_or_has_returned_when_it_is_replaced_says_whether_it_was_sent() {
    for ended in [false, true] {
        let mut pair = Pair::open();
        pair.lose = Box::new(|end, _| end == 0);
        pair.send(0, text("sent"));
        pair.drain();
        pair.send(0, text("not sent"));
        if ended {
            pair.ends[0].handle_incarnation(Incarnation(2), at(pair.now));
        }

        let held = pair.ends[0].take_unacknowledged();

        let sent = [("sent", true), ("not sent", false)];
        let sent = sent.map(|(message, sent)| (TrafficClass::Request, text(message), sent));
        assert_eq!(held, sent, "its session had ended: {ended}");
    }
}

#[test]
fn a_forged_session_does_not_end_the_present_one_and_a_true_one_does() {
    let mut pair = Pair::open();
    for end in 0..2 {
        pair.ends[end].handle_incarnation(Incarnation(1), at(pair.now));
    }
    let forged = |incarnation, number| {
        let incarnation = Incarnation(incarnation);
        let before = None;
        let open = OpenSegment { version: VERSION, tag: 99, echo: 0, incarnation, number, before };
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

    // The other machine is rebuilt within its incarnation.
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
