use super::super::pdu::Pdu;
use super::*;
use crate::medium::can::{CanId, Format};
use crate::testing::at;

fn config() -> IsoTpConfig {
    IsoTpConfig { message_max: 100, block_size: 2, ..IsoTpConfig::default() }
}

fn with(test: impl FnOnce(ReceptionContext<'_>)) {
    test(ReceptionContext { config: &config(), now: at(0) });
}

fn poll(reception: &mut Reception) -> Option<FlowStatus> {
    let id = CanId::standard(1).unwrap();
    let writer = PduWriter { id, format: Format::Classic };
    let mut sent = None;
    with(|cx| {
        sent = reception.poll_frame(&writer, cx).map(|frame| match Pdu::decode(frame.data()) {
            Some(Pdu::Flow(flow)) => flow.status,
            other => panic!("{other:?} is no word on how to go on"),
        });
    });
    sent
}

fn first(reception: &mut Reception, length: u32) -> FrameResult {
    let mut result = FrameResult::default();
    with(|cx| result = reception.handle_first(length, b"abcdef", true, cx));
    result
}

fn next(reception: &mut Reception, sequence: u8, data: &[u8]) -> FrameResult {
    let mut result = FrameResult::default();
    with(|cx| result = reception.handle_consecutive(sequence, data, cx));
    result
}

fn kind(reception: &Reception) -> &'static str {
    match reception.state {
        State::Idle => "idle",
        State::Answering { .. } => "answering",
        State::Refusing { .. } => "refusing",
        State::Receiving { .. } => "receiving",
    }
}

/// One in each of its states, 30 bytes under way where any are.
fn idle() -> Reception {
    Reception::new(TargetType::One)
}

fn answering() -> Reception {
    let mut reception = idle();
    first(&mut reception, 30);
    reception
}

fn refusing() -> Reception {
    let mut reception = idle();
    first(&mut reception, 101);
    reception
}

fn receiving() -> Reception {
    let mut reception = answering();
    assert_eq!(poll(&mut reception), Some(FlowStatus::Continue));
    reception
}

const ALL: [fn() -> Reception; 4] = [idle, answering, refusing, receiving];

#[test]
fn a_message_comes_in_blocks_each_of_which_is_asked_for() {
    let mut reception = receiving();

    assert_eq!(next(&mut reception, 1, b"ghijklm"), FrameResult::default());
    assert_eq!(next(&mut reception, 2, b"nopqrst"), FrameResult::default());
    assert_eq!(kind(&reception), "answering");
    assert_eq!(poll(&mut reception), Some(FlowStatus::Continue));
    assert_eq!(next(&mut reception, 3, b"uvwxyzA"), FrameResult::default());
    let result = next(&mut reception, 4, b"BCD\xcc\xcc\xcc\xcc");

    let message = Some(Bytes::from("abcdefghijklmnopqrstuvwxyzABCD"));
    assert_eq!(result, FrameResult { failed: None, message });
    assert!(reception.is_idle());
}

#[test]
fn a_whole_message_is_taken_in_every_state_and_ends_what_was_under_way() {
    for (state, interrupts) in ALL.into_iter().zip([false, true, false, true]) {
        let mut reception = state();
        let failed = interrupts.then_some(ReceptionError::Interrupted);

        let result = reception.handle_single(b"hi");

        assert_eq!(result, FrameResult { failed, message: Some(Bytes::from("hi")) });
        assert!(reception.is_idle());
    }
}

#[test]
fn a_beginning_is_taken_in_every_state_and_ends_what_was_under_way() {
    for (state, interrupts) in ALL.into_iter().zip([false, true, false, true]) {
        let mut reception = state();
        let failed = interrupts.then_some(ReceptionError::Interrupted);

        let result = first(&mut reception, 40);

        assert_eq!(result, FrameResult { failed, message: None });
        assert_eq!(kind(&reception), "answering");
    }
}

#[test]
fn more_is_taken_only_where_it_was_asked_for() {
    for state in [idle, answering, refusing] {
        let mut reception = state();
        let before = kind(&reception);

        let result = next(&mut reception, 1, b"ghijklm");

        assert_eq!(result, FrameResult::failure(ReceptionError::Unexpected));
        assert_eq!(kind(&reception), before);
    }
}

#[test]
fn a_number_out_of_turn_ends_the_message() {
    for found in [0, 2, 15] {
        let mut reception = receiving();

        let result = next(&mut reception, found, b"ghijklm");

        assert_eq!(result, FrameResult::failure(ReceptionError::Sequence { expected: 1, found }));
        assert!(reception.is_idle());
    }
}

#[test]
fn a_frame_that_is_too_short_and_not_the_last_ends_the_message() {
    let mut reception = receiving();

    assert_eq!(next(&mut reception, 1, b"ghi"), FrameResult::failure(ReceptionError::ShortFrame));
    assert!(reception.is_idle());
}

#[test]
fn what_is_too_long_or_one_too_many_is_refused_by_a_word() {
    let mut reception = idle();
    let result = first(&mut reception, 101);
    assert_eq!(result, FrameResult::failure(ReceptionError::TooLong { length: 101 }));
    assert_eq!(poll(&mut reception), Some(FlowStatus::Overflow));
    assert!(reception.is_idle());

    with(|cx| {
        let result = reception.handle_first(50, b"abcdef", false, cx);
        assert_eq!(result, FrameResult::failure(ReceptionError::TooMany));
    });
    assert_eq!(poll(&mut reception), Some(FlowStatus::Overflow));
}

#[test]
fn what_goes_to_all_is_never_answered() {
    let mut reception = Reception::new(TargetType::All);

    first(&mut reception, 101);
    assert!(reception.is_idle());
    first(&mut reception, 10);
    assert_eq!((kind(&reception), poll(&mut reception)), ("receiving", None));
    let result = next(&mut reception, 1, b"ghij");
    assert_eq!(result.message, Some(Bytes::from("abcdefghij")));
}

#[test]
fn every_timeout_in_every_state() {
    let check = |state: fn() -> Reception, due: Option<u64>, failed, expected| {
        let mut reception = state();
        let before = kind(&reception);
        assert_eq!(reception.poll_timeout(), due.map(at), "{before}");
        // Early is harmless.
        assert_eq!((reception.handle_timeout(at(1)), kind(&reception)), (None, before));
        assert_eq!(reception.handle_timeout(at(9_000)), failed, "{before}");
        assert_eq!(kind(&reception), expected, "{before}");
    };
    check(idle, None, None, "idle");
    check(answering, Some(1000), Some(ReceptionError::BusStuck), "idle");
    check(refusing, Some(1000), Some(ReceptionError::BusStuck), "idle");
    check(receiving, Some(1000), Some(ReceptionError::Silent), "idle");
}

#[test]
fn only_what_has_a_word_to_say_gives_a_frame() {
    for (state, gives) in ALL.into_iter().zip([false, true, true, false]) {
        let mut reception = state();
        assert_eq!(reception.is_ready(), gives);
        assert_eq!(poll(&mut reception).is_some(), gives);
    }
}
