//! What becomes of messages that were in flight when the peer fell silent.

use super::*;

const TEXTS: [&str; 6] = ["a", "b", "c", "d", "e", "f"];

/// The messages among these outputs that arrived, or that came back.
fn texts(outputs: &[SessionOutput], of: fn(&SessionOutput) -> Option<&Bytes>) -> Vec<Bytes> {
    outputs.iter().filter_map(of).cloned().collect()
}

fn arrived(output: &SessionOutput) -> Option<&Bytes> {
    match output {
        SessionOutput::Message { message, .. } => Some(message),
        _ => None,
    }
}

fn lost(output: &SessionOutput) -> Option<&Bytes> {
    match output {
        SessionOutput::Returned { message, .. } => Some(message),
        _ => None,
    }
}

fn is_acknowledgement(segment: &Segment) -> bool {
    matches!(segment, Segment::Acknowledge { .. })
}

/// Three messages arrive and their acknowledgement is lost, then three are lost.
fn cut_off() -> Pair {
    let mut pair = Pair::open();
    pair.lose = Box::new(|end, segment| end == 1 && is_acknowledgement(segment));
    for one in &TEXTS[..3] {
        pair.send(0, text(one));
        pair.run(0);
    }
    pair.run(5);
    pair.lose = Box::new(|_, _| true);
    for one in &TEXTS[3..] {
        pair.send(0, text(one));
        pair.run(0);
    }
    pair
}

#[test]
fn each_message_of_an_outage_arrived_or_came_back_and_none_did_both() {
    // The other end has noticed the outage by itself, too, or stood still meanwhile.
    for notices in [true, false] {
        let mut pair = cut_off();
        for end in if notices { 0..2 } else { 0..1 } {
            pair.ends[end].handle_no_path(at(pair.now));
        }
        pair.run(4_000);
        let outputs = pair.take(0);
        assert_eq!(texts(&outputs, lost), Vec::<Bytes>::new(), "the peer may still tell");
        assert!(matches!(outputs.last(), Some(SessionOutput::Ended { .. })), "{outputs:?}");

        pair.lose = Box::new(|_, _| false);
        pair.connect();
        pair.run(1_000);

        let outputs = pair.take(0);
        assert_eq!(texts(&pair.take(1), arrived), TEXTS[..3], "it noticed: {notices}");
        assert_eq!(texts(&outputs, lost), TEXTS[3..], "it noticed: {notices}");
        let sent =
            |output: &SessionOutput| matches!(output, SessionOutput::Returned { sent: true, .. });
        assert!(!outputs.iter().any(sent), "they certainly did not arrive");
        assert_eq!(outputs.last(), Some(&opened(1)), "they come back before the next session");
    }
}

#[test]
fn a_peer_that_does_not_return_leaves_them_as_perhaps_delivered() {
    let mut pair = cut_off();
    pair.ends[0].handle_no_path(at(pair.now));

    pair.run(9_000);
    assert_eq!(texts(&pair.take(0), lost), Vec::<Bytes>::new());
    pair.run(2_000);

    let back = TEXTS.map(|one| returned(text(one), &unreachable("right")));
    assert_eq!(pair.take(0), back);
    assert_eq!(pair.ends[0].poll_timeout(), None);
}

#[test]
fn a_peer_that_returns_in_another_incarnation_has_died_with_them() {
    let mut pair = cut_off();
    pair.ends[0].handle_no_path(at(pair.now));
    pair.run(4_000);
    pair.take(0);

    pair.lose = Box::new(|_, _| false);
    pair.ends[1] = Session::new(config("right", 2, "left"), at(pair.now));
    pair.connect();

    let why = DeliveryError::PeerDied { incarnation: Incarnation(1) };
    let back = TEXTS.map(|one| returned(text(one), &why));
    assert_eq!(pair.take(0), [&back[..], &[opened(2)]].concat());
}

#[test]
fn what_is_unsettled_is_taken_out_with_the_machine() {
    let mut pair = cut_off();
    pair.ends[0].handle_no_path(at(pair.now));
    pair.run(4_000);

    let held = pair.ends[0].take_unacknowledged();

    assert_eq!(held, TEXTS.map(|one| (TrafficClass::Request, text(one), true)));
    assert!(pair.ends[0].take_unacknowledged().is_empty());
}
