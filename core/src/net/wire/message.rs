//! The messages between nodes within a session: bindings, requests, events.
//!
//! ```text
//! kind 1 │ fields in the order of the variant
//! ```
//! Numbers are of variable length, texts and byte strings stand after their length, a last byte
//! string without. Timestamps are microseconds since the session began, on the sender's clock;
//! those of requests, and their deadlines, tenths of a millisecond. An error is encoded as
//! [`DeliveryError`] by the codec; it is no daily traffic.
//!
//! ```text
//!   one node                                  the other
//!      │ bind 1: laser, laser/scan v1 ──────────► │  the first message of a contract to an object
//!      │ ◄─────────────────────────── bound 1     │
//!      │ request 7 through binding 1 ───────────► │  9 bytes before the message's own, in an hour 10
//!      │ ◄─────────────────────────── reply 7     │
//!      │ tell through binding 1 ────────────────► │  the laser's queue is full: it waits there
//!      │ ◄─────────────────────────── full 1      │  no more of these, until
//!      │ ◄─────────────────────────── room 1      │
//! ```

use super::{Reader, WireError, Write};
use crate::contract::codec;
use crate::{DeliveryError, GatherBuffer, MessageId, ObjectName};
use bytes::{BufMut, Bytes, BytesMut};

/// The longest name of a topic, in bytes.
const TOPIC_MAX: usize = 255;
/// The most bytes of a contract's identity: what
/// [`PeerIdentity::decode`](crate::PeerIdentity::decode) takes.
const IDENTITY_MAX: usize = 16 * 1024;
/// The longest reason of a safe state, in bytes: a panic's text, shortened.
pub const REASON_MAX: usize = 1024;
/// The most bytes of a roster.
const ROSTER_MAX: usize = 128 * 1024;
/// The most bytes of an error. The longest shows 24 lines of differences.
const WHY_MAX: usize = 8 * 1024;

/// The unit of a request's times, in microseconds: shorter numbers, and fine enough for deadlines.
pub const TICK_US: u64 = 100;
/// The most versions of one contract that a listener understands.
pub const FORMS_MAX: usize = 16;

/// What two nodes say to each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PeerMessage {
    /// I shall send messages of this contract to this object under this number.
    Bind {
        /// The number, chosen by the sender; good for this session.
        binding: u32,
        /// The object that the messages are for.
        object: ObjectName,
        /// The contract as the sender knows it, an encoded [`PeerIdentity`](crate::PeerIdentity).
        identity: Bytes,
    },
    /// The contract is the same here, and the object takes it.
    Bound {
        /// The number that the binding was asked for under.
        binding: u32,
    },
    /// It cannot be.
    BindRefused {
        /// The number that the binding was asked for under.
        binding: u32,
        /// Why it is refused.
        why: DeliveryError,
        /// The contract as the receiver knows it; empty if it does not.
        identity: Bytes,
    },
    /// A message that wants a reply.
    Request {
        /// The number of the binding.
        binding: u32,
        /// The number that the reply names.
        call: u64,
        /// When it was sent, in ticks.
        timestamp: u64,
        /// How long after that it may begin to be served, in ticks; 0 for ever.
        within: u64,
        /// By which identity a repeated message is known.
        id: Option<MessageId>,
        /// The encoded message.
        payload: GatherBuffer,
    },
    /// The reply to a request.
    Reply {
        /// The number of the request.
        call: u64,
        /// The encoded reply, or why there is none.
        result: Result<GatherBuffer, DeliveryError>,
    },
    /// A message that wants no reply.
    Tell {
        /// The number of the binding.
        binding: u32,
        /// When it was sent.
        timestamp_us: u64,
        /// By which identity a repeated message is known.
        id: Option<MessageId>,
        /// The encoded message.
        payload: GatherBuffer,
    },
    /// A message that wants no reply may not come this way.
    TellRefused {
        /// The binding that it came through.
        binding: u32,
        /// Why it is refused.
        why: DeliveryError,
    },
    /// Send me what is published with you on this topic.
    Subscribe {
        /// The number, chosen by the listener; good for this session. Events of the n-th version
        /// below come under this number and n.
        subscription: u32,
        /// The name of the topic.
        topic: String,
        /// The contract as the listener knows it, and then the earlier versions that it
        /// understands.
        identities: Vec<Bytes>,
    },
    /// The contract is another here; nothing will come.
    SubscribeRefused {
        /// The number of the subscription.
        subscription: u32,
        /// Why nothing will come.
        why: DeliveryError,
    },
    /// What was refused by the policy is not any more: subscribe again.
    SubscribeAgain {
        /// The number of the subscription.
        subscription: u32,
    },
    /// No object of this node listens any more.
    Unsubscribe {
        /// The number of the subscription.
        subscription: u32,
    },
    /// Something was published.
    Event {
        /// The number of the subscription.
        subscription: u32,
        /// When it was published.
        timestamp_us: u64,
        /// The encoded event.
        payload: GatherBuffer,
    },
    /// All that this node listens to was told, and its objects answer. Each session with a node
    /// that has started begins so, that the age of what follows can be measured against a message
    /// that came without delay.
    Announced {
        /// When this was sent.
        timestamp_us: u64,
    },
    /// This node ends in order and will not be back soon: do not take it for lost.
    Leaving,
    /// The object behind this binding has no room: send it nothing until I say so. What is under
    /// way waits here.
    NotReady {
        /// The number of the binding.
        binding: u32,
    },
    /// It has room again.
    Ready {
        /// The number of the binding.
        binding: u32,
    },
    /// This node is in the safe state.
    InSafeState {
        /// Why it is.
        reason: String,
    },
    /// This node is in the safe state no more.
    AtWork,
    /// This node uses a roster of this robot.
    RosterSerial {
        /// The roster's serial number.
        serial: u64,
    },
    /// The peer's roster is newer than this node's: it is to send it.
    RosterRequest,
    /// The roster that this node uses, for a peer that has asked for it.
    Roster {
        /// The signed text.
        text: Bytes,
    },
    /// A message of this node's directory to the peer's.
    Directory {
        /// The encoded message.
        message: Bytes,
    },
}

const BIND: u8 = 0;
const BOUND: u8 = 1;
const BIND_REFUSED: u8 = 2;
const REQUEST: u8 = 3;
const REPLY: u8 = 4;
const REPLY_FAILED: u8 = 5;
const TELL: u8 = 6;
const SUBSCRIBE: u8 = 7;
const SUBSCRIBE_REFUSED: u8 = 8;
const UNSUBSCRIBE: u8 = 9;
const EVENT: u8 = 10;
const ANNOUNCED: u8 = 13;
const BYE: u8 = 14;
const FULL: u8 = 15;
const ROOM: u8 = 16;
const SUBSCRIBE_AGAIN: u8 = 17;
const TELL_REFUSED: u8 = 18;
const IN_SAFE_STATE: u8 = 19;
const AT_WORK: u8 = 20;
const ROSTER_SERIAL: u8 = 21;
const ROSTER_REQUEST: u8 = 22;
const ROSTER: u8 = 23;
const DIRECTORY: u8 = 24;

impl PeerMessage {
    /// The message's bytes. A large payload is not copied.
    pub fn encode(&self) -> GatherBuffer {
        let payload = self.payload();
        let mut bytes = BytesMut::with_capacity(24 + payload.map_or(0, GatherBuffer::copied));
        self.put_head(&mut bytes);
        match payload {
            Some(payload) => payload.behind(bytes),
            None => bytes.freeze().into(),
        }
    }

    /// What it ends with, as it is.
    fn payload(&self) -> Option<&GatherBuffer> {
        match self {
            PeerMessage::Request { payload, .. }
            | PeerMessage::Tell { payload, .. }
            | PeerMessage::Event { payload, .. }
            | PeerMessage::Reply { result: Ok(payload), .. } => Some(payload),
            _ => None,
        }
    }

    /// Writes all that stands before the payload.
    fn put_head(&self, bytes: &mut BytesMut) {
        match self {
            PeerMessage::Bind { binding, object, identity } => {
                numbered(bytes, BIND, *binding);
                bytes.sized(object.as_str().as_bytes());
                bytes.put_slice(identity);
            }
            PeerMessage::Bound { binding } => numbered(bytes, BOUND, *binding),
            PeerMessage::BindRefused { binding, why, identity } => {
                numbered(bytes, BIND_REFUSED, *binding);
                bytes.sized(&encode_why(why));
                bytes.put_slice(identity);
            }
            PeerMessage::Request { binding, call, timestamp, within, id, payload: _ } => {
                numbered(bytes, REQUEST, *binding);
                [call, timestamp, within].into_iter().for_each(|number| bytes.varint(*number));
                put_id(bytes, *id);
            }
            PeerMessage::Reply { call, result: Ok(_) } => numbered(bytes, REPLY, *call),
            PeerMessage::Reply { call, result: Err(why) } => {
                numbered(bytes, REPLY_FAILED, *call);
                bytes.sized(&encode_why(why));
            }
            PeerMessage::Tell { binding, timestamp_us, id, payload: _ } => {
                numbered(bytes, TELL, *binding);
                bytes.varint(*timestamp_us);
                put_id(bytes, *id);
            }
            PeerMessage::TellRefused { binding, why } => {
                numbered(bytes, TELL_REFUSED, *binding);
                bytes.sized(&encode_why(why));
            }
            PeerMessage::Subscribe { subscription, topic, identities } => {
                numbered(bytes, SUBSCRIBE, *subscription);
                bytes.sized(topic.as_bytes());
                identities.iter().for_each(|identity| bytes.sized(identity));
            }
            PeerMessage::SubscribeRefused { subscription, why } => {
                numbered(bytes, SUBSCRIBE_REFUSED, *subscription);
                bytes.sized(&encode_why(why));
            }
            PeerMessage::SubscribeAgain { subscription: n } => numbered(bytes, SUBSCRIBE_AGAIN, *n),
            PeerMessage::Unsubscribe { subscription: n } => numbered(bytes, UNSUBSCRIBE, *n),
            PeerMessage::Event { subscription, timestamp_us, payload: _ } => {
                numbered(bytes, EVENT, *subscription);
                bytes.varint(*timestamp_us);
            }
            PeerMessage::Announced { timestamp_us } => numbered(bytes, ANNOUNCED, *timestamp_us),
            PeerMessage::Leaving => bytes.put_u8(BYE),
            PeerMessage::NotReady { binding } => numbered(bytes, FULL, *binding),
            PeerMessage::Ready { binding } => numbered(bytes, ROOM, *binding),
            PeerMessage::InSafeState { reason } => {
                bytes.put_u8(IN_SAFE_STATE);
                bytes.sized(reason.as_bytes());
            }
            PeerMessage::AtWork => bytes.put_u8(AT_WORK),
            PeerMessage::RosterSerial { serial } => numbered(bytes, ROSTER_SERIAL, *serial),
            PeerMessage::RosterRequest => bytes.put_u8(ROSTER_REQUEST),
            PeerMessage::Roster { text } => {
                bytes.put_u8(ROSTER);
                bytes.put_slice(text);
            }
            PeerMessage::Directory { message } => {
                bytes.put_u8(DIRECTORY);
                bytes.put_slice(message);
            }
        }
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](PeerMessage::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<PeerMessage, WireError> {
        let reader = &mut Reader::new(bytes);
        let message = match reader.u8()? {
            BIND => PeerMessage::Bind {
                binding: number(reader)?,
                object: reader.parsed("an object's name")?,
                identity: rest(reader, IDENTITY_MAX, "a contract's identity")?,
            },
            BOUND => PeerMessage::Bound { binding: number(reader)? },
            BIND_REFUSED => PeerMessage::BindRefused {
                binding: number(reader)?,
                why: read_why(reader)?,
                identity: rest(reader, IDENTITY_MAX, "a contract's identity")?,
            },
            REQUEST => PeerMessage::Request {
                binding: number(reader)?,
                call: reader.varint()?,
                timestamp: reader.varint()?,
                within: reader.varint()?,
                id: read_id(reader)?,
                payload: reader.rest().into(),
            },
            REPLY => {
                PeerMessage::Reply { call: reader.varint()?, result: Ok(reader.rest().into()) }
            }
            REPLY_FAILED => {
                PeerMessage::Reply { call: reader.varint()?, result: Err(read_why(reader)?) }
            }
            TELL => PeerMessage::Tell {
                binding: number(reader)?,
                timestamp_us: reader.varint()?,
                id: read_id(reader)?,
                payload: reader.rest().into(),
            },
            TELL_REFUSED => {
                PeerMessage::TellRefused { binding: number(reader)?, why: read_why(reader)? }
            }
            SUBSCRIBE => PeerMessage::Subscribe {
                subscription: number(reader)?,
                topic: reader.text(TOPIC_MAX, "a topic's name")?,
                identities: read_identities(reader)?,
            },
            SUBSCRIBE_REFUSED => PeerMessage::SubscribeRefused {
                subscription: number(reader)?,
                why: read_why(reader)?,
            },
            SUBSCRIBE_AGAIN => PeerMessage::SubscribeAgain { subscription: number(reader)? },
            UNSUBSCRIBE => PeerMessage::Unsubscribe { subscription: number(reader)? },
            EVENT => PeerMessage::Event {
                subscription: number(reader)?,
                timestamp_us: reader.varint()?,
                payload: reader.rest().into(),
            },
            ANNOUNCED => PeerMessage::Announced { timestamp_us: reader.varint()? },
            BYE => PeerMessage::Leaving,
            FULL => PeerMessage::NotReady { binding: number(reader)? },
            ROOM => PeerMessage::Ready { binding: number(reader)? },
            IN_SAFE_STATE => {
                PeerMessage::InSafeState { reason: reader.text(REASON_MAX, "a reason")? }
            }
            AT_WORK => PeerMessage::AtWork,
            ROSTER_SERIAL => PeerMessage::RosterSerial { serial: reader.varint()? },
            ROSTER_REQUEST => PeerMessage::RosterRequest,
            ROSTER => PeerMessage::Roster { text: rest(reader, ROSTER_MAX, "a roster")? },
            DIRECTORY => PeerMessage::Directory { message: reader.rest() },
            _ => return Err(WireError::Malformed { what: "a message's kind" }),
        };
        reader.end("a message")?;
        Ok(message)
    }
}

fn numbered(bytes: &mut BytesMut, kind: u8, number: impl Into<u64>) {
    bytes.put_u8(kind);
    bytes.varint(number.into());
}

fn number(reader: &mut Reader) -> Result<u32, WireError> {
    u32::try_from(reader.varint()?).map_err(|_| WireError::TooLarge { what: "a number" })
}

fn rest(reader: &mut Reader, limit: usize, what: &'static str) -> Result<Bytes, WireError> {
    let rest = reader.rest();
    if rest.len() > limit { Err(WireError::TooLarge { what }) } else { Ok(rest) }
}

fn read_identities(reader: &mut Reader) -> Result<Vec<Bytes>, WireError> {
    let what = "a contract's identity";
    let mut identities = Vec::new();
    while !reader.is_empty() {
        if identities.len() == FORMS_MAX {
            return Err(WireError::TooLarge { what });
        }
        identities.push(reader.sized(IDENTITY_MAX, what)?);
    }
    Ok(identities)
}

/// One byte, 0, where there is none.
fn put_id(bytes: &mut BytesMut, id: Option<MessageId>) {
    bytes.put_u8(id.is_some().into());
    if let Some(MessageId { sender, sequence }) = id {
        bytes.put_u64(sender);
        bytes.varint(sequence);
    }
}

fn read_id(reader: &mut Reader) -> Result<Option<MessageId>, WireError> {
    match reader.u8()? {
        0 => Ok(None),
        1 => Ok(Some(MessageId { sender: reader.u64()?, sequence: reader.varint()? })),
        _ => Err(WireError::Malformed { what: "a message's identity" }),
    }
}

fn encode_why(why: &DeliveryError) -> Vec<u8> {
    let mut bytes = Vec::new();
    if codec::encode_bounded(why, WHY_MAX, &mut bytes).is_err() {
        // Its text is longer than any that this program writes: the kind is what counts.
        let reason = why.to_string().chars().take(1024).collect();
        let short = DeliveryError::Undecodable { reason };
        codec::encode_bounded(&short, WHY_MAX, &mut bytes).expect("1024 letters fit");
    }
    bytes
}

fn read_why(reader: &mut Reader) -> Result<DeliveryError, WireError> {
    let bytes = reader.sized(WHY_MAX, "an error")?;
    codec::decode_bounded::<DeliveryError, WHY_MAX>(&bytes)
        .map_err(|_| WireError::Malformed { what: "an error" })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn examples() -> Vec<(PeerMessage, &'static [u8])> {
        let object = ObjectName::new("arm").unwrap();
        let payload = Bytes::from_static(b"xy");
        let id = Some(MessageId { sender: 2, sequence: 300 });
        let unknown = DeliveryError::Stopped;
        vec![
            (
                PeerMessage::Bind { binding: 1, object: object.clone(), identity: payload.clone() },
                b"\0\x01\x03armxy",
            ),
            (PeerMessage::Bound { binding: 200 }, b"\x01\xc8\x01"),
            (
                PeerMessage::BindRefused {
                    binding: 1,
                    why: unknown.clone(),
                    identity: Bytes::new(),
                },
                b"\x02\x01\x01\x02",
            ),
            (
                PeerMessage::Request {
                    binding: 1,
                    call: 7,
                    timestamp: 300,
                    within: 5,
                    id: None,
                    payload: payload.clone().into(),
                },
                b"\x03\x01\x07\xac\x02\x05\0xy",
            ),
            (
                PeerMessage::Request {
                    binding: 1,
                    call: 7,
                    timestamp: 0,
                    within: 0,
                    id,
                    payload: payload.clone().into(),
                },
                b"\x03\x01\x07\0\0\x01\0\0\0\0\0\0\0\x02\xac\x02xy",
            ),
            (PeerMessage::Reply { call: 7, result: Ok(payload.clone().into()) }, b"\x04\x07xy"),
            (PeerMessage::Reply { call: 7, result: Err(unknown.clone()) }, b"\x05\x07\x01\x02"),
            (
                PeerMessage::Tell {
                    binding: 1,
                    timestamp_us: 9,
                    id: None,
                    payload: payload.clone().into(),
                },
                b"\x06\x01\x09\0xy",
            ),
            (PeerMessage::TellRefused { binding: 1, why: unknown.clone() }, b"\x12\x01\x01\x02"),
            (
                PeerMessage::Subscribe {
                    subscription: 3,
                    topic: "t".into(),
                    identities: vec![payload.clone(), payload.clone()],
                },
                b"\x07\x03\x01t\x02xy\x02xy",
            ),
            (PeerMessage::SubscribeRefused { subscription: 3, why: unknown }, b"\x08\x03\x01\x02"),
            (PeerMessage::SubscribeAgain { subscription: 3 }, b"\x11\x03"),
            (PeerMessage::Unsubscribe { subscription: 3 }, b"\x09\x03"),
            (
                PeerMessage::Event {
                    subscription: 3,
                    timestamp_us: 300,
                    payload: payload.clone().into(),
                },
                b"\x0a\x03\xac\x02xy",
            ),
            (PeerMessage::Announced { timestamp_us: 300 }, b"\x0d\xac\x02"),
            (PeerMessage::Leaving, b"\x0e"),
            (PeerMessage::NotReady { binding: 200 }, b"\x0f\xc8\x01"),
            (PeerMessage::Ready { binding: 200 }, b"\x10\xc8\x01"),
            (PeerMessage::InSafeState { reason: "heat".into() }, b"\x13\x04heat"),
            (PeerMessage::AtWork, b"\x14"),
            (PeerMessage::RosterSerial { serial: 300 }, b"\x15\xac\x02"),
            (PeerMessage::RosterRequest, b"\x16"),
            (PeerMessage::Roster { text: payload.clone() }, b"\x17xy"),
            (PeerMessage::Directory { message: payload.clone() }, b"\x18xy"),
        ]
    }

    #[test]
    fn the_bytes_of_messages_are_these_for_ever_and_come_back() {
        for (message, golden) in examples() {
            assert_eq!(message.encode().into_bytes(), golden, "{message:?}");
            assert_eq!(PeerMessage::decode(Bytes::from_static(golden)), Ok(message));
        }
    }

    #[test]
    fn cut_and_foreign_messages_are_refused() {
        for (message, golden) in examples() {
            // Whatever is cut off a last byte string is not missed here.
            for cut in 0..golden.len().saturating_sub(2) {
                if let Ok(other) = PeerMessage::decode(Bytes::from_static(&golden[..cut])) {
                    assert_ne!(other, message);
                }
            }
        }
        for foreign in
            [&b"\x11"[..], b"\x01\x01!", b"\x0d\0\0\xff\xff\x7f\x01a", b"\x05\x07\x01\x63"]
        {
            assert!(PeerMessage::decode(Bytes::copy_from_slice(foreign)).is_err(), "{foreign:?}");
        }
    }

    #[test]
    fn an_error_too_long_to_send_is_sent_short() {
        let why = DeliveryError::ContractDiffers { difference: "x".repeat(100_000) };
        let message = PeerMessage::Reply { call: 1, result: Err(why) };
        let Ok(PeerMessage::Reply { result: Err(short), .. }) =
            PeerMessage::decode(message.encode().into_bytes())
        else {
            panic!("it did not come back");
        };
        assert!(short.to_string().contains("the contract differs"));
    }
}
