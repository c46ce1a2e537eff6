//! What is sent arrives once and in order, and how much may wait.

use super::*;
use crate::CreditPool;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

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
    let refused = session.handle_send(TrafficClass::Request, text("x"), at(0));
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
    assert_eq!(pair.ends[0].counters().retransmitted, 1);
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
    assert_eq!(pair.ends[1].counters().duplicates, 1);
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
    let (sent, received) = (pair.ends[0].counters(), pair.ends[1].counters());
    assert!((101_000..101_200).contains(&sent.bytes_sent), "{sent:?}");
    assert_eq!(sent.bytes_sent, received.bytes_received);
}

#[test]
fn control_overtakes_data_that_waits() {
    let mut pair = Pair::open();
    pair.send(0, Bytes::from(vec![7; 500_000]));
    pair.ends[0].handle_send(TrafficClass::Control, text("stop"), at(pair.now)).unwrap();

    pair.run(200);

    let outputs = pair.take(1);
    assert!(matches!(outputs[0], SessionOutput::Message { stream: TrafficClass::Control, .. }));
    assert_eq!(outputs.len(), 2);
}

/// How many bytes of its credit are held.
#[derive(Default)]
struct HeldBytes(AtomicUsize);

impl HeldBytes {
    fn take(self: &Arc<Self>, bytes: usize) -> Option<Credit> {
        self.0.fetch_add(bytes, Ordering::Relaxed);
        Some(Credit::new(self.clone(), bytes))
    }

    fn bytes(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }
}

impl CreditPool for HeldBytes {
    fn give_back(&self, bytes: usize) {
        self.0.fetch_sub(bytes, Ordering::Relaxed);
    }
}

#[test]
fn credit_is_held_until_the_peer_has_acknowledged_or_the_message_comes_back() {
    let mut pair = Pair::open();
    let pool = Arc::new(HeldBytes::default());
    let send = |pair: &mut Pair, length| {
        let (key, now) = (OrderingKey::default(), at(pair.now));
        let (message, credit) = (vec![7; length], pool.take(length));
        pair.ends[0].handle_send_along(TrafficClass::Bulk, key, message, credit, now)
    };
    pair.lose = Box::new(|end, segment| end == 1 && matches!(segment, Segment::Acknowledge { .. }));
    send(&mut pair, 5_000).unwrap();
    send(&mut pair, 20).unwrap();
    pair.run(100);
    assert_eq!(pair.take(1).len(), 2, "they have arrived");
    assert_eq!(pool.bytes(), 5_020, "and it is not known yet");

    pair.lose = Box::new(|_, _| false);
    pair.run(1_000);
    assert_eq!(pool.bytes(), 0);

    pair.lose = Box::new(|_, _| true);
    send(&mut pair, 20).unwrap();
    pair.run(5_000);
    assert_eq!((pool.bytes(), pair.take(0).len()), (0, 1), "the session ended");
    pair.run(6_000);
    assert_eq!((pool.bytes(), pair.take(0).len()), (0, 1), "it came back");

    let refused = send(&mut pair, 2 << 20);
    assert!(refused.is_err() && pool.bytes() == 0);
}

#[test]
fn what_has_no_credit_is_refused_where_its_stream_is_full_and_other_classes_are_not() {
    let small = SessionConfig { buffer_messages: 4, ..config("left", 1, "right") };
    let mut pair = Pair::of(small, config("right", 1, "left"));
    pair.connect();
    pair.lose = Box::new(|_, _| true);
    for _ in 0..4 {
        pair.send(0, text("x"));
    }
    let now = at(pair.now);
    let refused = pair.ends[0].handle_send(TrafficClass::Request, text("x"), now);
    let full = DeliveryError::WayFull { node: "right".into(), class: TrafficClass::Request };
    assert_eq!(refused, Err((full, text("x"))));
    pair.ends[0].handle_send(TrafficClass::Event, text("e"), now).unwrap();
    let pool = Arc::new(HeldBytes::default());
    let (stream, key) = (TrafficClass::Request, OrderingKey::default());
    pair.ends[0].handle_send_along(stream, key, text("x"), pool.take(1), now).unwrap();

    pair.lose = Box::new(|_, _| false);
    pair.run(200);

    assert_eq!(pair.take(1).len(), 7, "opened, and six messages");
}

#[test]
fn control_that_finds_no_capacity_ends_the_session_and_both_begin_again() {
    let small = SessionConfig { buffer_messages: 4, ..config("left", 1, "right") };
    let mut pair = Pair::of(small, config("right", 1, "left"));
    pair.connect();
    let before = pair.ends[0].number();
    pair.lose = Box::new(|_, _| true);
    let now = at(pair.now);
    let mut send = || pair.ends[0].handle_send(TrafficClass::Control, text("c"), now);
    assert!((0..4).all(|_| send().is_ok()));

    let (why, _) = send().unwrap_err();
    assert!(matches!(why, DeliveryError::WayFull { class: TrafficClass::Control, .. }), "{why}");
    pair.lose = Box::new(|_, _| false);
    pair.run(2_000);

    assert!(pair.ends[0].number() > before);
    pair.ends[0].handle_send(TrafficClass::Control, text("again"), at(pair.now)).unwrap();
    pair.take(1);
    pair.run(200);
    assert_eq!(pair.take(1).len(), 1);
}

#[test]
fn a_message_larger_than_the_limit_is_refused_before_it_is_sent() {
    let mut pair = Pair::open();
    let limit = pair.ends[0].config.message_max;
    let huge = Bytes::from(vec![0; limit + 1]);
    let refused = pair.ends[0].handle_send(TrafficClass::Request, huge, at(pair.now)).unwrap_err();
    assert_eq!(refused.0, DeliveryError::TooLargeForSession { limit });
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
    pair.ends[0].handle_send(TrafficClass::Control, text("now"), at(pair.now)).unwrap();
    pair.run(3);

    let outputs = pair.take(1);
    let place = outputs.iter().position(|output| {
        matches!(output, SessionOutput::Message { stream: TrafficClass::Control, .. })
    });
    assert_eq!(place, Some(0), "of {}", outputs.len());

    // A full window of data is lost; control does not wait until that is noticed.
    pair.lose = Box::new(|end, segment| {
        end == 0 && matches!(segment, Segment::Data(data) if data.stream == TrafficClass::Request)
    });
    pair.run(1);
    pair.ends[0].handle_send(TrafficClass::Control, text("again"), at(pair.now)).unwrap();
    pair.run(3);
    let outputs = pair.take(1);
    let control = SessionOutput::Message { stream: TrafficClass::Control, message: text("again") };
    assert!(outputs.contains(&control), "{outputs:?}");
}

#[test]
fn what_goes_every_way_does_not_wait_for_data_and_is_acknowledged_by_itself() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|_, segment| match segment {
        Segment::Data(data) => data.stream == TrafficClass::Request,
        Segment::Acknowledge { streams, .. } => streams[TrafficClass::Redundant as usize].is_none(),
        _ => false,
    });
    for _ in 0..200 {
        pair.send(0, Bytes::from(vec![7; 1000]));
    }
    pair.run(5);

    for _ in 0..100 {
        pair.ends[0].handle_send(TrafficClass::Redundant, text("x"), at(pair.now)).unwrap();
        pair.run(1);
        assert_eq!(pair.take(1).len(), 1, "at {}", pair.now);
    }

    pair.run(5);
    let again = pair.sent.iter().filter(|(_, segment)| {
        matches!(segment, Segment::Data(data) if data.stream == TrafficClass::Redundant && data.again)
    });
    assert_eq!(again.count(), 0);
    assert_eq!(pair.ends[0].streams[TrafficClass::Redundant as usize].outbound.flying(), 0);
}

#[test]
fn a_peer_that_promises_an_absurd_window_is_sent_no_more_than_ours() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|end, _| end == 1);
    for _ in 0..600 {
        pair.ends[0].handle_send(TrafficClass::Redundant, text("x"), at(pair.now)).unwrap();
        pair.drain();
    }
    let tag = pair.ends[0].identity.tag;
    let ack = Ack { next: 1, window: u32::MAX, arrived: DelayTicks::default(), ranges: vec![] };
    let streams = [None, Some(ack), None, None, None, None];
    let greedy = Segment::Acknowledge { tag, streams, datagrams: None };
    pair.ends[0].handle_segment(greedy.encode(), at(pair.now));
    pair.drain();

    let flying = pair.ends[0].streams[TrafficClass::Redundant as usize].outbound.flying();
    assert_eq!(flying, 256);
}
