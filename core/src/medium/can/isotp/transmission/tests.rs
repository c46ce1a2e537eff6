use super::*;
use crate::medium::can::{CanId, Format};
use crate::testing::at;

fn writer() -> PduWriter {
    PduWriter { id: CanId::standard(1).unwrap(), format: Format::Classic }
}

fn word(status: FlowStatus, block_size: u8, separation_ms: u64) -> FlowControl {
    let separation = SeparationTime::at_least(Duration::from_millis(separation_ms));
    FlowControl { status, block_size, separation }
}

const GO_ON: FlowStatus = FlowStatus::Continue;

fn poll(transmission: &mut Transmission, now: Instant) -> Option<Vec<u8>> {
    transmission.poll_frame(&writer(), now).map(|frame| frame.data().to_vec())
}

fn start(length: u8, target: TargetType) -> Transmission {
    Transmission::new((0..length).collect(), target, at(0))
}

/// One that is in each of its states at 0 ms.
fn ready() -> Transmission {
    start(100, TargetType::One)
}

fn asking() -> Transmission {
    let mut transmission = ready();
    assert!(poll(&mut transmission, at(0)).is_some());
    transmission
}

fn paced() -> Transmission {
    let mut transmission = asking();
    assert!(transmission.handle_flow(word(GO_ON, 0, 20), at(0)));
    assert!(poll(&mut transmission, at(0)).is_some());
    transmission
}

fn ended() -> Transmission {
    let mut transmission = start(3, TargetType::One);
    assert!(poll(&mut transmission, at(0)).is_some());
    transmission
}

#[test]
fn a_short_message_is_one_frame_and_done() {
    let mut transmission = start(7, TargetType::One);

    assert_eq!(poll(&mut transmission, at(0)).unwrap(), b"\x07\0\x01\x02\x03\x04\x05\x06");
    assert_eq!(transmission.ended(), Some(Ok(())));
    assert_eq!(poll(&mut transmission, at(0)), None);
}

#[test]
fn a_long_message_waits_for_the_word_and_goes_in_blocks() {
    let mut transmission = start(30, TargetType::One);
    assert_eq!(poll(&mut transmission, at(0)).unwrap(), b"\x10\x1e\0\x01\x02\x03\x04\x05");
    assert_eq!(poll(&mut transmission, at(1)), None);

    assert!(transmission.handle_flow(word(GO_ON, 2, 0), at(2)));
    let block: Vec<_> = std::iter::from_fn(|| poll(&mut transmission, at(2))).collect();
    assert_eq!(block.iter().map(|frame| frame[0]).collect::<Vec<_>>(), [0x21, 0x22]);

    assert!(transmission.handle_flow(word(GO_ON, 0, 0), at(3)));
    let rest: Vec<_> = std::iter::from_fn(|| poll(&mut transmission, at(3))).collect();
    assert_eq!(rest, [&b"\x23\x14\x15\x16\x17\x18\x19\x1a"[..], b"\x24\x1b\x1c\x1d"]);
    assert_eq!(transmission.ended(), Some(Ok(())));
}

#[test]
fn frames_keep_the_distance_that_the_receiver_asks_for() {
    let mut transmission = paced();

    assert_eq!(transmission.poll_timeout(), Some(at(20)));
    transmission.handle_timeout(at(19));
    assert_eq!(poll(&mut transmission, at(19)), None);
    transmission.handle_timeout(at(20));
    assert_eq!(poll(&mut transmission, at(20)).unwrap()[0], 0x22);
}

#[test]
fn the_number_goes_round_after_fifteen() {
    let mut transmission = start(200, TargetType::One);
    poll(&mut transmission, at(0));
    transmission.handle_flow(word(GO_ON, 0, 0), at(0));

    let numbers: Vec<_> =
        std::iter::from_fn(|| poll(&mut transmission, at(0))).map(|frame| frame[0] & 15).collect();

    let expected: Vec<u8> = (1..=28).map(|number: u8| number % 16).collect();
    assert_eq!(numbers, expected);
}

#[test]
fn to_all_nobody_is_asked_and_the_pace_is_ours() {
    let mut transmission = start(20, TargetType::All);
    let mut numbers = vec![];

    let mut now = at(0);
    while transmission.ended().is_none() {
        numbers.extend(poll(&mut transmission, now).map(|frame| frame[0]));
        now = transmission.poll_timeout().unwrap_or(now);
        transmission.handle_timeout(now);
    }

    assert_eq!(numbers, [0x10, 0x21, 0x22]);
    assert_eq!(now - at(0), 2 * SEPARATION_TO_ALL);
}

#[test]
fn every_word_in_every_state() {
    let later = at(5);
    let words = [word(GO_ON, 3, 0), word(FlowStatus::Wait, 0, 0), word(FlowStatus::Overflow, 0, 0)];
    for unasked in [ready, paced, ended] {
        for flow in words {
            let mut transmission = unasked();
            let before = transmission.state;
            assert!(!transmission.handle_flow(flow, later), "{before:?} {flow:?}");
            assert_eq!(transmission.state, before);
        }
    }
    let expected = [
        State::Ready { until: later + TIMEOUT },
        State::Asking { until: later + TIMEOUT, waits: 1 },
        State::Ended(Err(TransmissionError::Overflow)),
    ];
    for (flow, expected) in words.into_iter().zip(expected) {
        let mut transmission = asking();
        assert!(transmission.handle_flow(flow, later));
        assert_eq!(transmission.state, expected, "{flow:?}");
    }
}

#[test]
fn every_timeout_in_every_state() {
    let check = |transmission: fn() -> Transmission, due: Option<u64>, expected: Option<State>| {
        let mut transmission = transmission();
        let before = transmission.state;
        let due = due.map(at);
        assert_eq!(transmission.poll_timeout(), due, "{before:?}");
        // Early is harmless.
        transmission.handle_timeout(at(1));
        assert_eq!(transmission.state, before);
        let far = at(9_000);
        transmission.handle_timeout(far);
        assert_eq!(transmission.state, expected.unwrap_or(before));
    };
    check(ready, Some(1000), Some(State::Ended(Err(TransmissionError::BusStuck))));
    check(asking, Some(1000), Some(State::Ended(Err(TransmissionError::Unanswered))));
    let again = State::Ready { until: at(9_000) + TIMEOUT };
    check(paced, Some(20), Some(again));
    check(ended, None, None);
}

#[test]
fn only_what_is_ready_gives_a_frame() {
    for (state, gives) in
        [(ready as fn() -> _, true), (asking, false), (paced, false), (ended, false)]
    {
        let mut transmission = state();
        assert_eq!(transmission.is_ready(), gives);
        assert_eq!(poll(&mut transmission, at(1)).is_some(), gives);
    }
}

#[test]
fn nobody_can_make_us_wait_for_ever() {
    let mut transmission = asking();
    let mut count = 0;

    while transmission.handle_flow(word(FlowStatus::Wait, 0, 0), at(count)) {
        count += 1;
    }

    assert_eq!(count, u64::from(WAITS_MAX) + 1);
    assert_eq!(transmission.ended(), Some(Err(TransmissionError::WaitedTooLong)));
}
