//! Paths that come, change, narrow and go.

use super::*;

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
    let tag = pair.ends[0].identity.tag;
    for sequence in [1, 3, 5] {
        let payload = Bytes::from_static(b"\x02hi");
        let (first, last, again) = (true, true, false);
        let stream = TrafficClass::Request;
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
    assert!(pair.parts(0) > 15, "{lengths:?}");
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
        stream: TrafficClass::Request,
        message: text("b"),
        why: why.clone(),
        sent: false,
    };
    assert_eq!(pair.take(0), [never_sent, ended]);
    let refused = pair.ends[0].handle_send(TrafficClass::Request, text("c"), at(pair.now));
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

    let why = unreachable("right");
    let ended = SessionOutput::Ended { incarnation: Incarnation(1), why: why.clone() };
    assert_eq!(pair.take(0), [ended]);
    pair.run(8100);
    assert_eq!(pair.take(0), [returned(text("a"), &why)]);
}

/// Both ends of a line of 9,600 bits a second say something large at once. Answers how much was
/// repeated.
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
    [0, 1].map(|end| pair.ends[end].counters().retransmitted).iter().sum()
}

#[test]
fn a_session_takes_a_path_for_narrow_by_its_frames_as_the_router_does() {
    let is_narrow = |mtu| {
        let mut session = Session::new(config("left", 1, "right"), at(0));
        session.handle_path(mtu, at(0));
        session.is_narrow()
    };
    // Of CAN, and of a network that is configured for little, however many nodes pass on there.
    let [can, ethernet] = [1_024, 1_200].map(crate::net::routing::topology::segment_limit);
    assert!(is_narrow(can) && !is_narrow(ethernet));
    assert!(!is_narrow(
        ethernet
            - crate::net::wire::packet::passed_length(crate::net::wire::packet::HOPS_MAX.into())
    ));
}

#[test]
fn the_least_segment_of_a_path_carries_everything() {
    const LEAST: usize = crate::net::routing::topology::SEGMENT_MIN;
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
        (UndeliveredReason::NoRoute, None),
        (
            UndeliveredReason::TooManyHops,
            Some("too many nodes have passed it on; the path is too long"),
        ),
        (UndeliveredReason::TooLarge, Some("larger than the next link can carry; let the links")),
    ];
    for (reason, expected) in cases {
        let mut pair = Pair::open();
        pair.lose = Box::new(|_, _| true);
        pair.ends[0].handle_send(TrafficClass::Request, text("lost"), at(pair.now)).unwrap();
        pair.run(50);
        pair.ends[0].handle_undelivered(reason, at(pair.now));
        pair.run(10_000);

        let ended = pair.take(0).into_iter().find_map(|output| match output {
            SessionOutput::Ended { why, .. } => Some(why),
            _ => None,
        });
        match (ended.expect("the session ends"), expected) {
            (DeliveryError::Unreachable { .. }, None) => {}
            (DeliveryError::Undelivered { node, reason }, Some(expected)) => {
                assert_eq!(node, "right");
                assert!(reason.contains(expected), "{reason}");
            }
            (other, _) => panic!("{reason:?}: {other}"),
        }
    }
}

#[test]
fn over_9600_baud_what_is_small_does_not_wait_for_the_rest_of_what_is_large() {
    let mut pair = Pair::new();
    pair.rate = Some(960);
    pair.connect_over(85);
    pair.run(1000);
    pair.take(1);
    let [camera, motor] = ["camera", "motor"].map(|name| OrderingKey::to(&name.parse().unwrap()));
    let image = Bytes::from(vec![7; 12_000]);
    let now = at(pair.now);
    pair.ends[0]
        .handle_send_along(TrafficClass::Request, camera, image.clone(), None, now)
        .unwrap();
    pair.run(3000);

    let now = at(pair.now);
    let order = Bytes::from(vec![8; 20]);
    pair.ends[0].handle_send_along(TrafficClass::Request, motor, order.clone(), None, now).unwrap();
    pair.run(1000);

    assert_eq!(pair.take(1), [message(order)], "within a second of twenty");
    pair.run(20_000);
    assert!(pair.take(1) == [message(image)]);
}

#[test]
fn the_round_trips_of_control_that_overtakes_do_not_make_data_repeat() {
    let mut pair = Pair::new();
    (pair.rate, pair.overtakes) = (Some(30_000), true);
    pair.connect();
    for _ in 0..50 {
        let now = at(pair.now);
        pair.ends[0].handle_send(TrafficClass::Control, text("command"), now).unwrap();
        pair.run(20);
    }

    for _ in 0..5 {
        // Each part takes 45 ms, and a command comes back in two.
        pair.send(0, Bytes::from(vec![7; 5_000]));
        pair.run(300);
        let now = at(pair.now);
        pair.ends[0].handle_send(TrafficClass::Control, text("command"), now).unwrap();
        pair.run(20);
    }

    let counters = pair.ends[0].counters();
    assert_eq!((counters.retransmitted, pair.take(1).len()), (0, 1 + 55 + 5), "{counters:?}");
}
