//! How many bytes stand before a small message on the wire. The page on networks and the module
//! `net` state these numbers.

use blastema_core::TrafficClass;
use blastema_core::net::wire::frame::Frame;
use blastema_core::net::wire::message::PeerMessage;
use blastema_core::net::wire::packet::{Packet, Payload};
use blastema_core::net::wire::segment::{Ack, Data, Datagram, DelayTicks, Segment};
use blastema_core::net::{NodeId, PacketPriority};
use bytes::{BufMut, Bytes, BytesMut};

const PAYLOAD: &[u8] = b"sixty-four bytes of a message, or none at all";

fn frame(segment: &Segment) -> usize {
    let packet = Packet {
        class: PacketPriority::Data,
        hops: 16,
        destination: NodeId(1),
        source: NodeId(2),
        passed: vec![],
        payload: Payload::Segment(segment.encode().into()),
    };
    Frame::Data(packet.encode().into()).encode().len() - PAYLOAD.len()
}

#[test]
fn who_passes_a_packet_on_adds_five_bytes_and_then_four() {
    let length = |relays: u32| {
        let packet = Packet {
            class: PacketPriority::Data,
            hops: 16,
            destination: NodeId(1),
            source: NodeId(2),
            passed: (0..relays).map(|relay| NodeId(10 + relay)).collect(),
            payload: Payload::Segment(Bytes::from_static(PAYLOAD).into()),
        };
        packet.encode().len()
    };
    assert_eq!([1, 2, 3].map(|relays| length(relays) - length(0)), [5, 9, 13]);
}

/// The overhead of one message alone in its part, without and with an acknowledgement on board.
fn reliable(message: &PeerMessage, stream: TrafficClass, sequence: u64) -> [usize; 2] {
    let message = message.encode().into_bytes();
    let mut payload = BytesMut::new();
    payload.put_u8(u8::try_from(message.len()).unwrap());
    payload.put_slice(&message);
    let data = Data {
        tag: 7,
        stream,
        sequence,
        first: true,
        last: true,
        again: false,
        piece: None,
        ack: None,
        payload: payload.freeze().into(),
    };
    let ack =
        Some(Ack { next: sequence, window: 256, arrived: DelayTicks::default(), ranges: vec![] });
    let acking = Data { ack, ..data.clone() };
    [Segment::Data(data), Segment::Data(acking)].map(|segment| frame(&segment))
}

/// In the first milliseconds of a session, and after an hour and a million messages.
const TIMES: [(u64, u64); 2] = [(100, 10_000), (1_000_000, 3_600_000_000)];

#[test]
fn a_small_message_has_the_overhead_that_the_documentation_states() {
    let payload = Bytes::from_static(PAYLOAD);
    let tell = |timestamp_us| PeerMessage::Tell {
        binding: 5,
        timestamp_us,
        id: None,
        payload: payload.clone().into(),
    };
    let event = |timestamp_us| PeerMessage::Event {
        subscription: 5,
        timestamp_us,
        payload: payload.clone().into(),
    };
    let request = |call, timestamp_us: u64| PeerMessage::Request {
        binding: 5,
        call,
        timestamp: timestamp_us / 100,
        within: 10_000,
        id: None,
        payload: payload.clone().into(),
    };
    let reply = |call| PeerMessage::Reply { call, result: Ok(payload.clone().into()) };

    let [fresh, late] = TIMES.map(|(count, us)| {
        [
            reliable(&tell(us), TrafficClass::Request, count),
            reliable(&event(us), TrafficClass::Event, count),
            reliable(&event(us), TrafficClass::Redundant, count),
            reliable(&request(count, us), TrafficClass::Request, count),
            reliable(&reply(count), TrafficClass::Request, count),
        ]
    });

    assert_eq!(fresh, [[23, 29], [22, 28], [22, 28], [25, 31], [20, 26]]);
    assert_eq!(late, [[28, 36], [27, 35], [27, 35], [32, 40], [24, 32]]);
}

#[test]
fn a_small_reading_of_which_the_newest_counts_has_the_overhead_that_is_stated() {
    let payload = Bytes::from_static(PAYLOAD);
    let overhead = TIMES.map(|(sequence, timestamp_us)| {
        let message =
            PeerMessage::Event { subscription: 5, timestamp_us, payload: payload.clone().into() };
        let payload = message.encode().into_bytes();
        frame(&Segment::Datagram(Datagram {
            tag: 7,
            channel: 10,
            sequence,
            number: Some(sequence),
            piece: None,
            payload: payload.into(),
        }))
    });
    assert_eq!(overhead, [23, 30]);
}
