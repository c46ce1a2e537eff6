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
