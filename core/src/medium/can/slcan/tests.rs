use super::*;
use proptest::prelude::*;

fn standard(number: u32) -> CanId {
    CanId::standard(number).unwrap()
}

fn extended(number: u32) -> CanId {
    CanId::extended(number).unwrap()
}

fn frame(id: CanId, format: Format, data: &[u8]) -> CanFrame {
    CanFrame::new(id, format, data).unwrap()
}

fn hear(listener: &mut ReplyParser, bytes: &[u8]) -> Vec<AdapterReply> {
    bytes.iter().filter_map(|byte| listener.handle_byte(*byte)).collect()
}

fn came(frame: CanFrame) -> AdapterReply {
    AdapterReply::Frame(frame)
}

#[test]
fn the_lines_are_those_of_the_adapters() {
    let check = |command: AdapterCommand, expected: &[u8]| {
        let mut line = Vec::new();
        command.encode(&mut line);
        assert_eq!(line, expected, "{command:?}");
        assert_eq!(AdapterCommand::decode(&line[..line.len() - 1]), Some(command));
    };
    check(AdapterCommand::Close, b"C\r");
    check(AdapterCommand::Open, b"O\r");
    check(AdapterCommand::BitRate(BitRate::of(10_000).unwrap()), b"S0\r");
    check(AdapterCommand::BitRate(BitRate::of(500_000).unwrap()), b"S6\r");
    check(AdapterCommand::DataRate(DataRate::TwoMegabit), b"Y2\r");
    check(AdapterCommand::DataRate(DataRate::FiveMegabit), b"Y5\r");
    let fast = Format::Fd { fast: true };
    let slow = Format::Fd { fast: false };
    check(
        AdapterCommand::Send(frame(standard(0x123), Format::Classic, b"\x11\xab")),
        b"t123211AB\r",
    );
    check(AdapterCommand::Send(frame(standard(0), Format::Classic, b"")), b"t0000\r");
    check(
        AdapterCommand::Send(frame(extended(0x18da_0201), Format::Classic, b"\x01")),
        b"T18DA0201101\r",
    );
    check(
        AdapterCommand::Send(frame(standard(1), slow, &[0; 12])),
        b"d0019000000000000000000000000\r",
    );
    check(AdapterCommand::Send(frame(standard(1), fast, b"\xff")), b"b0011FF\r");
    check(AdapterCommand::Send(frame(extended(2), slow, b"")), b"D000000020\r");
    check(AdapterCommand::Send(frame(extended(2), fast, b"\x01\x02")), b"B0000000220102\r");
    let mut longest = Vec::new();
    AdapterCommand::Send(frame(extended(2), fast, &[7; 64])).encode(&mut longest);
    assert!(longest.starts_with(b"B00000002F0707") && longest.len() == LINE_MAX - 4 + 1);
}

#[test]
fn an_adapters_replies_are_understood() {
    let check = |line: &[u8], expected: AdapterReply| {
        let mut listener = ReplyParser::default();
        assert_eq!(hear(&mut listener, line), std::slice::from_ref(&expected), "{line:?}");
        let mut written = Vec::new();
        expected.encode(&mut written);
        assert_eq!(hear(&mut listener, &written), [expected]);
        assert_eq!(listener.refused(), 0);
    };
    check(b"\r", AdapterReply::Done);
    check(b"\r\n", AdapterReply::Done);
    check(b"\x07", AdapterReply::Refused);
    check(b"z\r", AdapterReply::Sent);
    check(b"Z\r", AdapterReply::Sent);
    check(b"V1013\r", AdapterReply::Answer);
    check(b"NA123\r", AdapterReply::Answer);
    check(b"F00\r", AdapterReply::Answer);
    check(b"t7e02aBCd\r", came(frame(standard(0x7e0), Format::Classic, b"\xab\xcd")));
    let timed = frame(standard(0x7e0), Format::Classic, b"\xab");
    check(b"t7E01ABEA5F\r", came(timed));
    check(b"R0000010040001\r", AdapterReply::Answer);
}

#[test]
fn what_is_no_line_is_refused() {
    let check = |line: &[u8]| assert_eq!(AdapterReply::decode(line), None, "{line:?}");
    check(b"?");
    check(b"\xff\x00");
    check(b"t");
    check(b"t12");
    check(b"t123");
    check(b"t1232A");
    check(b"t1232AABBC");
    check(b"t1232AABBEA60"); // A minute has 60,000 milliseconds.
    check(b"t8000");
    check(b"T200000000");
    check(b"t12G0");
    check(b"t1231G0");
    check(b"t1239");
    check(b"t1239000000000000000000000000"); // Classic frames have 8 bytes.
    check(b"V\x01");
    let command = |line: &[u8]| assert_eq!(AdapterCommand::decode(line), None, "{line:?}");
    command(b"");
    command(b"O1");
    command(b"S");
    command(b"S9");
    command(b"Y3");
    command(b"t12300001");
}

#[test]
fn after_garbage_the_next_line_is_understood() {
    let mut listener = ReplyParser::default();
    let good = came(frame(standard(0x123), Format::Classic, b""));

    assert_eq!(hear(&mut listener, b"\x00\xff!!\rt1230\r"), std::slice::from_ref(&good));
    assert_eq!(listener.refused(), 1);
    // A line that never ends is thrown away, and held no longer than the longest.
    assert_eq!(hear(&mut listener, &[b't'; 100_000]), []);
    assert!(listener.lines.line.len() <= LINE_MAX);
    assert_eq!(hear(&mut listener, b"t1230\rt1230\r"), std::slice::from_ref(&good));
    assert_eq!(listener.refused(), 2);
    // A refusal in the middle of a line voids it.
    assert_eq!(hear(&mut listener, b"t12\x07t1230\r"), [AdapterReply::Refused, good]);
    assert_eq!(listener.refused(), 3);
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    let id =
        prop_oneof![(0_u32..0x800).prop_map(standard), (0_u32..0x2000_0000).prop_map(extended),];
    let lengths: Vec<usize> = (0..=8).chain(FD_LENGTHS).collect();
    let length = prop::sample::select(lengths);
    (id, length, any::<[u8; FD_MAX]>(), any::<bool>()).prop_map(|(id, length, bytes, fast)| {
        match length {
            9.. => frame(id, Format::Fd { fast }, &bytes[..length]),
            _ => frame(id, Format::Classic, &bytes[..length]),
        }
    })
}

proptest! {
    #[test]
    fn every_frame_is_read_back_with_and_without_a_time(frame in any_frame(), time in 0..MINUTE) {
        for digits in [String::new(), format!("{time:04X}")] {
            let (reply, mut line) = (came(frame), Vec::new());
            reply.encode(&mut line);
            line.splice(line.len() - 1..line.len() - 1, digits.bytes());
            prop_assert!(line.len() <= LINE_MAX + 1);
            prop_assert_eq!(hear(&mut ReplyParser::default(), &line), vec![reply]);
        }
    }

    #[test]
    fn garbage_costs_no_more_than_the_line_that_it_is_in(
        garbage in prop::collection::vec(any::<u8>(), 0..400),
        frame in any_frame(),
    ) {
        let mut listener = ReplyParser::default();
        hear(&mut listener, &garbage);
        let mut line = vec![END];
        came(frame).encode(&mut line);

        let received = hear(&mut listener, &line);

        prop_assert_eq!(received.last(), Some(&came(frame)));
    }
}
