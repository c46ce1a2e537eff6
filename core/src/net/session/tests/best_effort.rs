//! Messages of which the newest counts.

use super::*;

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
    assert_eq!((counters.superseded, counters.duplicates), (1, 1));
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
    assert_eq!(refused.0, DeliveryError::TooLargeForSession { limit });
    assert_eq!(refused.1.len(), limit + 1);

    send(limit).unwrap();
    pair.run(5);
    assert!(pair.sent.iter().all(|(_, segment)| segment.encode().len() <= 85));
    let message = Bytes::from(vec![7; limit]);
    assert_eq!(pair.take(1), [SessionOutput::Newest { channel: 1, message }]);
}

/// Images of 10 kB, 50 a second, over a wire that carries ten a second, for ten seconds; beside
/// them as much of `data` as is taken. Answers with the images and the data that have arrived, and
/// the longest queue before the wire after the first second, in milliseconds.
fn beside_images(pair: &mut Pair, data: bool) -> (Vec<Bytes>, usize, u64) {
    (pair.rate, pair.taken) = (Some(100_000), [pair.now; 2]);
    let (mut longest, mut waits) = (0, 0);
    for n in 0..500_u16 {
        let mut image = vec![7; 10_000];
        image[..2].copy_from_slice(&n.to_be_bytes());
        pair.ends[0].handle_send_newest(1, image, at(pair.now)).unwrap();
        while data && waits < 10 {
            pair.send(0, Bytes::from(vec![8; 1_000]));
            waits += 1;
        }
        for _ in 0..20 {
            pair.run(0);
            // The first ten parts alone are a queue of 140 ms.
            if n >= 50 {
                longest = longest.max(pair.taken[0].saturating_sub(pair.now));
            }
        }
        waits = pair.ends[0].status().unacknowledged;
    }
    pair.run(1_000);
    let (mut images, mut arrived) = (vec![], 0);
    for output in pair.take(1) {
        match output {
            SessionOutput::Newest { message, .. } => images.push(message.slice(..2)),
            SessionOutput::Message { message, .. } => arrived += message.len(),
            _ => {}
        }
    }
    (images, arrived, longest)
}

#[test]
fn images_of_which_the_newest_counts_fill_a_slow_wire_and_no_queue_before_it() {
    let mut pair = Pair::open();

    let (images, _, longest) = beside_images(&mut pair, false);

    assert!(images.len() > 70, "{} of 100", images.len());
    assert!(images.is_sorted() && images.last().is_some_and(|last| last[..] == [1, 243]));
    assert!(longest < 75, "{longest} ms");
    let counters = pair.ends[0].counters();
    assert_eq!(counters.replaced, 500 - images.len() as u64, "{counters:?}");
    assert_eq!(pair.ends[0].status().in_flight, 0);
}

#[test]
fn data_and_images_of_which_the_newest_counts_share_a_slow_wire() {
    let mut pair = Pair::open();

    let (images, data, longest) = beside_images(&mut pair, true);

    assert!(images.len() > 30 && data > 300_000, "{} images, {data} bytes", images.len());
    assert!(longest < 75, "{longest} ms");
}

#[test]
fn without_acknowledgements_datagrams_do_not_hold_back_others_for_ever() {
    let mut pair = Pair::open();
    pair.lose = Box::new(|end, segment| end == 1 && matches!(segment, Segment::Acknowledge { .. }));
    for _ in 0..100 {
        pair.ends[0].handle_send_newest(1, vec![7; 10_000], at(pair.now)).unwrap();
        pair.run(100);
    }
    assert!(pair.take(1).len() > 10);
}

#[test]
fn what_waits_when_the_path_goes_is_not_sent_when_there_is_another() {
    let mut pair = Pair::open();
    pair.rate = Some(10_000);
    pair.ends[0].handle_send_newest(1, vec![7; 100_000], at(pair.now)).unwrap();
    pair.ends[0].handle_send_newest(2, text("old"), at(pair.now)).unwrap();
    pair.run(10);
    pair.ends[0].handle_no_path(at(pair.now));
    pair.run(500);
    pair.ends[0].handle_path(1389, at(pair.now));
    pair.ends[0].handle_send_newest(3, text("new"), at(pair.now)).unwrap();
    pair.run(5_000);

    let new = SessionOutput::Newest { channel: 3, message: text("new") };
    assert_eq!(pair.take(1), [new]);
    assert_eq!(pair.ends[0].counters().replaced, 2);
}

#[test]
fn a_session_of_more_channels_than_are_remembered_goes_on_and_forgets_those_long_unused() {
    let mut pair = Pair::open();
    for channel in 0..3_000 {
        let now = at(pair.now);
        pair.ends[0].handle_send_newest(channel, text("reading"), now).unwrap();
        pair.ends[0].handle_send_newest(9_999, text("always"), now).unwrap();
        pair.run(5);
    }
    assert_eq!(pair.take(1).len(), 6_000, "of each");

    let late = |channel, sequence| {
        let (number, piece, payload) = (None, None, text("late").into());
        let tag = pair.ends[1].identity.tag;
        Segment::Datagram(Datagram { tag, channel, sequence, number, piece, payload }).encode()
    };
    let (late_always, late_reading) = (late(9_999, 2_999), late(2_999, 1));
    pair.ends[1].handle_segment(late_always, at(pair.now));
    pair.ends[1].handle_segment(late_reading, at(pair.now));
    pair.drain();
    assert_eq!(pair.take(1), [], "what is in use is remembered");
}
