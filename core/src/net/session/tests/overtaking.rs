//! What is small does not wait for what is large, unless it is for the same object.

use super::*;
use crate::ObjectName;

fn key(object: &str) -> OrderingKey {
    OrderingKey::to(&ObjectName::new(object).unwrap())
}

fn push(outbound: &mut Outbound, key: OrderingKey, bytes: impl Into<GatherBuffer>) {
    outbound.push(key, OutboundMessage { bytes: bytes.into(), credit: None });
}

fn send_to(pair: &mut Pair, object: &str, message: Bytes) {
    let (stream, key, now) = (TrafficClass::Request, key(object), at(pair.now));
    pair.ends[0].handle_send_along(stream, key, message, None, now).unwrap();
}

#[test]
fn what_is_small_and_for_another_object_enters_between_the_parts_of_what_is_large() {
    let mut pair = Pair::open();
    let image = Bytes::from(vec![7; 500_000]);
    send_to(&mut pair, "camera", image.clone());
    send_to(&mut pair, "camera", text("shutter"));
    send_to(&mut pair, "motor", text("a"));
    send_to(&mut pair, "motor", text("b"));

    pair.run(500);

    let all = [text("a"), text("b"), image, text("shutter")].map(message);
    assert!(pair.take(1) == all, "of one object nothing is overtaken");
    assert_eq!(pair.ends[0].status().unacknowledged, 0);
}

#[test]
fn what_is_large_has_every_second_part_however_much_is_small() {
    let mut pair = Pair::open();
    let image = Bytes::from(vec![7; 100_000]);
    send_to(&mut pair, "camera", image.clone());
    for _ in 0..1000 {
        send_to(&mut pair, "motor", Bytes::from(vec![8; 1000]));
    }

    pair.run(500);

    let outputs = pair.take(1);
    let place = outputs.iter().position(|outputs| *outputs == message(image.clone())).unwrap();
    assert_eq!(outputs.len(), 1001);
    assert!((70..80).contains(&place), "a part for each small one: {place}");
}

#[test]
fn whatever_is_lost_each_object_gets_everything_once_and_in_order() {
    let mut pair = Pair::open();
    // One in five, in no rhythm that a burst could have.
    let mut random = 1_u32;
    pair.lose = Box::new(move |_, segment| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        matches!(segment, Segment::Data(_)) && (random >> 16).is_multiple_of(5)
    });
    for n in 0..90_u8 {
        let object = ["camera", "motor", "map"][usize::from(n) % 3];
        let length = [10, 3000, 40_000][usize::from(n / 3) % 3];
        send_to(&mut pair, object, Bytes::from(vec![n; length]));
    }

    pair.run(20_000);

    let outputs: Vec<_> = pair
        .take(1)
        .into_iter()
        .map(|outputs| match outputs {
            SessionOutput::Message { message, .. } => message[0],
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(outputs.len(), 90, "{:?}", pair.ends[0].status());
    for object in 0..3 {
        let of_it = || outputs.iter().filter(|n| **n % 3 == object);
        assert!(of_it().is_sorted() && of_it().count() == 30, "{object}: {outputs:?}");
    }
    assert!(!outputs.is_sorted(), "some were quicker");
    assert_eq!(pair.ends[0].status().unacknowledged, 0);
}

/// Takes out parts of so much until one of the messages of this text is in it. Answers with how
/// many that were.
fn parts_until(outbound: &mut Outbound, capacity: usize, text: &str) -> usize {
    let mut parts = (1..).map(|n| (n, outbound.transmit(capacity, at(0)).unwrap().1));
    let found = parts.find(|(_, part)| {
        part.first && part.last && part.payload.clone().into_bytes().ends_with(text.as_bytes())
    });
    found.unwrap().0
}

#[test]
fn an_order_is_next_however_many_large_ones_wait_for_another_object() {
    let mut outbound = Outbound::new(10_000);
    for _ in 0..123 {
        push(&mut outbound, key("map"), vec![7; 17 << 10]);
    }
    outbound.transmit(1300, at(0)).unwrap();
    push(&mut outbound, key("leg"), "stop");

    assert!(parts_until(&mut outbound, 1300, "stop") <= 2);
}

#[test]
fn an_order_is_next_however_many_small_ones_wait_behind_a_large_one_of_their_object() {
    let mut outbound = Outbound::new(10_000);
    push(&mut outbound, key("map"), vec![7; 1 << 20]);
    for _ in 0..32 {
        push(&mut outbound, key("map"), "reading");
    }
    outbound.transmit(1300, at(0)).unwrap();
    push(&mut outbound, key("leg"), "stop");

    assert!(parts_until(&mut outbound, 1300, "stop") <= 2);
}

#[test]
fn an_order_comes_soon_although_a_hundred_objects_have_large_ones_before_it() {
    let mut outbound = Outbound::new(10_000);
    for n in 0..100 {
        push(&mut outbound, key(&format!("camera{n}")), vec![7; 100_000]);
    }
    outbound.transmit(1300, at(0)).unwrap();
    push(&mut outbound, key("leg"), "stop");

    assert!(parts_until(&mut outbound, 1300, "stop") <= 8, "32 are looked at for each part");
}

#[test]
fn what_was_not_cut_when_the_session_ends_was_not_sent_and_all_come_back_in_order() {
    let mut outbound = Outbound::new(10_000);
    push(&mut outbound, key("map"), vec![7; 3000]);
    push(&mut outbound, key("map"), "after");
    push(&mut outbound, key("leg"), "stop");
    for _ in 0..2 {
        outbound.transmit(1300, at(0)).unwrap();
    }
    push(&mut outbound, key("leg"), "go");

    let all: Vec<_> = outbound.take_all().collect();

    let expected = [("stop", true), ("map", true), ("after", false), ("go", false)];
    let outputs = all
        .iter()
        .map(|(bytes, sent)| (if bytes.len() == 3000 { b"map" } else { &bytes[..] }, *sent));
    assert!(outputs.eq(expected.map(|(text, sent)| (text.as_bytes(), sent))), "{all:?}");
}

/// Sends so many messages of so many bytes to this object.
fn fill(pair: &mut Pair, stream: TrafficClass, object: &str, count: usize, length: usize) {
    for _ in 0..count {
        let (message, now) = (vec![7; length], at(pair.now));
        pair.ends[0].handle_send_along(stream, key(object), message, None, now).unwrap();
    }
    pair.drain();
}

/// The streams of the parts that were sent, repeated ones apart.
fn streams_sent(pair: &Pair) -> Vec<TrafficClass> {
    let part = |(_, segment): &(usize, Segment)| match segment {
        Segment::Data(data) if !data.again => Some(data.stream),
        _ => None,
    };
    pair.sent.iter().filter_map(part).collect()
}

#[test]
fn control_is_next_however_much_data_is_on_its_way_and_waits() {
    let mut pair = Pair::open();
    fill(&mut pair, TrafficClass::Request, "map", 100, 15_000);
    pair.sent.clear();

    fill(&mut pair, TrafficClass::Control, "wheels", 1, 20);
    pair.ends[0].handle_timeout(at(pair.now));
    pair.drain();

    assert_eq!(streams_sent(&pair).first(), Some(&TrafficClass::Control));
}

#[test]
fn control_without_end_leaves_data_every_ninth_part() {
    for rate in [None, Some(100_000)] {
        let mut pair = Pair::open();
        pair.rate = rate;
        fill(&mut pair, TrafficClass::Control, "wheels", 270, 1000);
        fill(&mut pair, TrafficClass::Request, "map", 10, 15_000);
        pair.sent.clear();

        pair.run(5_000);

        let sent = streams_sent(&pair);
        let runs = sent.split(|stream| *stream == TrafficClass::Request);
        let longest = runs.map(<[TrafficClass]>::len).max();
        assert!(longest <= Some(Session::CONTROL_RUN), "{rate:?}: {sent:?}");
        let data = sent.iter().filter(|stream| **stream == TrafficClass::Request).count();
        assert!(
            data > 100 && sent.len() - data > 100,
            "{rate:?}: both went: {data} {:?}",
            pair.ends[0].status()
        );
        assert_eq!(pair.ends[0].status().unacknowledged, 0);
    }
}

#[test]
fn requests_events_and_bulk_share_a_path_by_their_weights_and_a_new_request_goes_next() {
    use TrafficClass::{Bulk, Event, Request};
    let mut pair = Pair::open();
    pair.rate = Some(100_000);
    for class in [Bulk, Event, Request] {
        fill(&mut pair, class, "map", 40, 15_000);
    }
    pair.run(2_000);
    pair.sent.clear();
    pair.run(2_000);

    let sent = streams_sent(&pair);
    let count = |class| sent.iter().filter(|stream| **stream == class).count();
    let (requests, events, bulk) = (count(Request), count(Event), count(Bulk));
    assert!(bulk > 10, "{sent:?}");
    assert!(events.abs_diff(2 * bulk) <= 4 && requests.abs_diff(4 * bulk) <= 8, "{sent:?}");

    pair.run(60_000);
    assert_eq!(pair.ends[0].status().unacknowledged, 0);
    pair.take(1);
    fill(&mut pair, Bulk, "map", 8, 1 << 20);
    pair.run(2_000);
    pair.sent.clear();
    fill(&mut pair, Request, "arm", 1, 20);
    pair.run(2_000);
    let sent = streams_sent(&pair);
    let before = sent.iter().position(|stream| *stream == Request);
    assert!(before <= Some(1), "no more than a part that was begun: {sent:?}");
}
