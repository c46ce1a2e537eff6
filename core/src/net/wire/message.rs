//! The messages between nodes within a session: bindings, requests, events.
//!
//! ```text
//! request, reply, tell, event  kind 1 │ fields in the order of the variant
//! all others                   0      │ the message, encoded by the codec
//! ```
//! Those of the first line are written by hand, with numbers of variable length, and end with the
//! application's bytes. Timestamps are microseconds since the session began, on the sender's clock;
//! those of requests, and their deadlines, tenths of a millisecond.
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
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The most bytes that the codec reads: 16 descriptions of contracts take 256 KiB.
const CODED_MAX: usize = 512 << 10;

/// The unit of a request's times, in microseconds: shorter numbers, and fine enough for deadlines.
pub const TICK_US: u64 = 100;
/// The most versions of one contract that a listener understands.
pub const FORMS_MAX: usize = 16;

/// What two nodes say to each other. The codec skips the last four, and numbers those before them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PeerMessage {
    /// I shall send messages of this contract to this object under this number.
    Bind {
        /// The number, chosen by the sender; good for this session.
        binding: u32,
        /// The object that the messages are for.
        object: ObjectName,
        /// The contract as the sender knows it, an encoded [`PeerIdentity`](crate::PeerIdentity).
        identity: Vec<u8>,
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
        identity: Vec<u8>,
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
        identities: Vec<Vec<u8>>,
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
        text: Vec<u8>,
    },
    /// A message of this node's directory to the peer's.
    Directory {
        /// The encoded message.
        message: Vec<u8>,
    },
    /// A message that wants a reply.
    #[serde(skip)]
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
    #[serde(skip)]
    Reply {
        /// The number of the request.
        call: u64,
        /// The encoded reply, or why there is none.
        result: Result<GatherBuffer, DeliveryError>,
    },
    /// A message that wants no reply.
    #[serde(skip)]
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
    /// Something was published.
    #[serde(skip)]
    Event {
        /// The number of the subscription.
        subscription: u32,
        /// When it was published.
        timestamp_us: u64,
        /// The encoded event.
        payload: GatherBuffer,
    },
}

const CODED: u8 = 0;
const REQUEST: u8 = 1;
const REPLY: u8 = 2;
const REPLY_FAILED: u8 = 3;
const TELL: u8 = 4;
const EVENT: u8 = 5;

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
            PeerMessage::Request { binding, call, timestamp, within, id, payload: _ } => {
                numbered(bytes, REQUEST, *binding);
                [call, timestamp, within].into_iter().for_each(|number| bytes.varint(*number));
                put_id(bytes, *id);
            }
            PeerMessage::Reply { call, result: Ok(_) } => numbered(bytes, REPLY, *call),
            PeerMessage::Reply { call, result: Err(why) } => {
                numbered(bytes, REPLY_FAILED, *call);
                bytes.put_slice(&codec::encode_unbounded(why));
            }
            PeerMessage::Tell { binding, timestamp_us, id, payload: _ } => {
                numbered(bytes, TELL, *binding);
                bytes.varint(*timestamp_us);
                put_id(bytes, *id);
            }
            PeerMessage::Event { subscription, timestamp_us, payload: _ } => {
                numbered(bytes, EVENT, *subscription);
                bytes.varint(*timestamp_us);
            }
            coded => {
                bytes.put_u8(CODED);
                bytes.put_slice(&codec::encode_unbounded(coded));
            }
        }
    }

    /// Reads a message.
    ///
    /// # Errors
    /// [`WireError`] for anything that [`encode`](PeerMessage::encode) does not write.
    pub fn decode(bytes: Bytes) -> Result<PeerMessage, WireError> {
        let reader = &mut Reader::new(bytes);
        Ok(match reader.u8()? {
            CODED => coded(reader, "a message")?,
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
                let call = reader.varint()?;
                PeerMessage::Reply { call, result: Err(coded(reader, "an error")?) }
            }
            TELL => PeerMessage::Tell {
                binding: number(reader)?,
                timestamp_us: reader.varint()?,
                id: read_id(reader)?,
                payload: reader.rest().into(),
            },
            EVENT => PeerMessage::Event {
                subscription: number(reader)?,
                timestamp_us: reader.varint()?,
                payload: reader.rest().into(),
            },
            _ => return Err(WireError::Malformed { what: "a message's kind" }),
        })
    }
}

fn numbered(bytes: &mut BytesMut, kind: u8, number: impl Into<u64>) {
    bytes.put_u8(kind);
    bytes.varint(number.into());
}

fn coded<T: DeserializeOwned>(reader: &mut Reader, what: &'static str) -> Result<T, WireError> {
    codec::decode_bounded::<T, CODED_MAX>(&reader.rest()).map_err(|_| WireError::Malformed { what })
}

fn number(reader: &mut Reader) -> Result<u32, WireError> {
    u32::try_from(reader.varint()?).map_err(|_| WireError::TooLarge { what: "a number" })
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
                PeerMessage::Bind { binding: 1, object: object.clone(), identity: b"xy".into() },
                b"\0\0\x01\x03arm\x02xy",
            ),
            (PeerMessage::Bound { binding: 200 }, b"\0\x01\xc8"),
            (
                PeerMessage::BindRefused { binding: 1, why: unknown.clone(), identity: vec![] },
                b"\0\x02\x01\x02\0",
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
                b"\x01\x01\x07\xac\x02\x05\0xy",
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
                b"\x01\x01\x07\0\0\x01\0\0\0\0\0\0\0\x02\xac\x02xy",
            ),
            (PeerMessage::Reply { call: 7, result: Ok(payload.clone().into()) }, b"\x02\x07xy"),
            (PeerMessage::Reply { call: 7, result: Err(unknown.clone()) }, b"\x03\x07\x02"),
            (
                PeerMessage::Tell {
                    binding: 1,
                    timestamp_us: 9,
                    id: None,
                    payload: payload.clone().into(),
                },
                b"\x04\x01\x09\0xy",
            ),
            (PeerMessage::TellRefused { binding: 1, why: unknown.clone() }, b"\0\x03\x01\x02"),
            (
                PeerMessage::Subscribe {
                    subscription: 3,
                    topic: "t".into(),
                    identities: vec![b"xy".into(), b"xy".into()],
                },
                b"\0\x04\x03\x01t\x02\x02xy\x02xy",
            ),
            (PeerMessage::SubscribeRefused { subscription: 3, why: unknown }, b"\0\x05\x03\x02"),
            (PeerMessage::SubscribeAgain { subscription: 3 }, b"\0\x06\x03"),
            (PeerMessage::Unsubscribe { subscription: 3 }, b"\0\x07\x03"),
            (
                PeerMessage::Event {
                    subscription: 3,
                    timestamp_us: 300,
                    payload: payload.clone().into(),
                },
                b"\x05\x03\xac\x02xy",
            ),
            (PeerMessage::Announced { timestamp_us: 300 }, b"\0\x08\xfb\x2c\x01"),
            (PeerMessage::Leaving, b"\0\x09"),
            (PeerMessage::NotReady { binding: 200 }, b"\0\x0a\xc8"),
            (PeerMessage::Ready { binding: 200 }, b"\0\x0b\xc8"),
            (PeerMessage::InSafeState { reason: "heat".into() }, b"\0\x0c\x04heat"),
            (PeerMessage::AtWork, b"\0\x0d"),
            (PeerMessage::RosterSerial { serial: 300 }, b"\0\x0e\xfb\x2c\x01"),
            (PeerMessage::RosterRequest, b"\0\x0f"),
            (PeerMessage::Roster { text: b"xy".into() }, b"\0\x10\x02xy"),
            (PeerMessage::Directory { message: b"xy".into() }, b"\0\x11\x02xy"),
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
            [&b"\x11"[..], b"\0\x01\x01!", b"\0\x12", b"\x03\x07\x63", b"\0\x04\x03\xfb\xff\xffa"]
        {
            assert!(PeerMessage::decode(Bytes::copy_from_slice(foreign)).is_err(), "{foreign:?}");
        }
    }
}
