//! The encoding of messages. Only this file depends on the codec.
//!
//! The format is bincode 2.0.1, standard configuration: little-endian, integers of variable length,
//! fields and variants in their order without names. The receiver must know that the sender
//! means the same contract, which [`ContractIdentity::check`](crate::ContractIdentity::check)
//! tells.
//!
//! Bytes are never trusted. A message has a size limit; what it claims to hold is held against that
//! limit before memory is taken; bytes after its end are refused; structures within structures are
//! followed to a depth of [`DEPTH_LIMIT`](crate::contract::field::DEPTH_LIMIT).
#![expect(clippy::disallowed_methods, reason = "the one file that knows bincode")]

use crate::contract::blob::{given, sharing};
use crate::contract::gather_buffer::GatherBuffer;
use crate::contract::layout::{Described, LayoutOf};
use crate::{Contract, DeliveryError};
use bincode::config::{self, Config};
use bincode::enc::EncoderImpl;
use bincode::enc::write::Writer;
use bincode::error::{DecodeError as Malformed, EncodeError as Refusal};
use bytes::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// The largest message that any contract may allow: larger data is sent in parts.
pub const SIZE_LIMIT: usize = 16 * 1024 * 1024;

/// Why a message could not be encoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The message takes more bytes than its contract, or the buffer, allows. Send less at once, or
    /// raise `max_size`.
    #[error("the message takes more than the {limit} bytes that it may")]
    TooLarge {
        /// The limit in bytes.
        limit: usize,
    },
    /// The message holds what has no encoding, such as structures nested too deep.
    #[error("the message cannot be encoded: {reason}")]
    Impossible {
        /// What the codec said.
        reason: String,
    },
}

/// Why bytes are not the message that they should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// There are more bytes than the contract allows; nothing was read.
    #[error("{size} bytes are more than the {limit} that a message of this kind may take")]
    TooLarge {
        /// How many there are.
        size: usize,
        /// The limit in bytes.
        limit: usize,
    },
    /// The bytes end before the message does.
    #[error("the message is cut short")]
    Truncated,
    /// Bytes follow the message: the sender means another contract, or two frames ran together.
    #[error("{count} bytes follow the message")]
    Trailing {
        /// The number of bytes that follow.
        count: usize,
    },
    /// The bytes mean no value of the type.
    #[error("the bytes are no such message: {reason}")]
    Malformed {
        /// What the codec said.
        reason: String,
    },
}

impl From<DecodeError> for DeliveryError {
    fn from(error: DecodeError) -> Self {
        DeliveryError::Undecodable { reason: error.to_string() }
    }
}

/// Encodes a message at the end of `buffer`. Reuse the buffer: a fresh one costs more than the
/// rest.
///
/// # Errors
/// [`EncodeError`]; the buffer is then as it was.
pub fn encode<M: Contract>(message: &M, buffer: &mut Vec<u8>) -> Result<(), EncodeError> {
    encode_bounded(message, M::MAX_SIZE, buffer)
}

/// Encodes any value of at most `limit` bytes at the end of `buffer`.
///
/// # Errors
/// [`EncodeError`]; the buffer is then as it was.
pub fn encode_bounded<T: Serialize>(
    value: &T,
    limit: usize,
    buffer: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let start = buffer.len();
    let result = write(value, BufferWriter { end: start.saturating_add(limit), buffer });
    result.map(drop).map_err(|refusal| {
        buffer.truncate(start);
        encode_error(refusal, limit)
    })
}

/// Encodes a message to be sent. A large [`Blob`](crate::Blob) that ends it is not copied.
///
/// # Errors
/// [`EncodeError`].
pub fn encode_parcel<M: Contract>(message: &M) -> Result<GatherBuffer, EncodeError> {
    parcel_of(message, M::MAX_SIZE)
}

/// Encodes a reply to `M` to be sent, as [`encode_parcel`].
///
/// # Errors
/// [`EncodeError`].
pub fn encode_parcel_reply<M: Contract>(reply: &M::Reply) -> Result<GatherBuffer, EncodeError> {
    parcel_of(reply, M::MAX_SIZE)
}

pub(crate) fn parcel_of<T: Serialize>(
    value: &T,
    limit: usize,
) -> Result<GatherBuffer, EncodeError> {
    let writer = ParcelWriter { head: Vec::new(), last: None, left: limit };
    let ParcelWriter { head, last, .. } =
        write(value, writer).map_err(|refusal| encode_error(refusal, limit))?;
    Ok(GatherBuffer::apart(head.into(), last.unwrap_or_default()))
}

/// Encodes a value of this crate, which has an encoding whatever it holds.
pub(crate) fn encode_unbounded<T: Serialize>(value: &T) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode_bounded(value, usize::MAX, &mut bytes)
        .expect("a value of the core's own is neither nested nor without an encoding");
    bytes
}

/// Decodes a message of at most [`Contract::MAX_SIZE`] bytes.
///
/// # Errors
/// [`DecodeError`] if the bytes are not exactly one message.
pub fn decode<M: Contract>(bytes: &[u8]) -> Result<M, DecodeError> {
    decode_within::<M, MessageLimit<M>>(bytes)
}

/// As [`decode`], and every [`Blob`](crate::Blob) in the message is a part of these bytes.
///
/// # Errors
/// As [`decode`].
pub fn decode_shared<M: Contract>(bytes: &Bytes) -> Result<M, DecodeError> {
    sharing(bytes, || decode(bytes))
}

/// Decodes a reply to `M` of at most [`Contract::MAX_SIZE`] bytes.
///
/// # Errors
/// [`DecodeError`] if the bytes are not exactly one reply.
pub fn decode_reply<M: Contract>(bytes: &[u8]) -> Result<M::Reply, DecodeError> {
    // As for fields: what cannot be decoded within bounds is refused when this is compiled.
    let _: LayoutOf = M::Reply::layout;
    decode_within::<M::Reply, MessageLimit<M>>(bytes)
}

/// As [`decode_reply`], and every [`Blob`](crate::Blob) in the reply is a part of these bytes.
///
/// # Errors
/// As [`decode_reply`].
pub fn decode_shared_reply<M: Contract>(bytes: &Bytes) -> Result<M::Reply, DecodeError> {
    sharing(bytes, || decode_reply::<M>(bytes))
}

/// Decodes any value of at most `LIMIT` bytes.
///
/// # Errors
/// [`DecodeError`] if the bytes are not exactly one value.
pub fn decode_bounded<T: DeserializeOwned, const LIMIT: usize>(
    bytes: &[u8],
) -> Result<T, DecodeError> {
    decode_within::<T, NumberLimit<LIMIT>>(bytes)
}

/// The most bytes of a value with integers of fixed size: many times a packet to a device.
const FIXED_LIMIT: usize = 4 * 1024;

/// Encodes a small value with integers of fixed size.
pub(super) fn encode_fixed<T: Serialize>(value: &T) -> Result<Vec<u8>, EncodeError> {
    let (mut buffer, config) = (Vec::new(), config::standard().with_fixed_int_encoding());
    let writer = BufferWriter { end: FIXED_LIMIT, buffer: &mut buffer };
    write_by(value, writer, config).map_err(|refusal| encode_error(refusal, FIXED_LIMIT))?;
    Ok(buffer)
}

/// Decodes a small value with integers of fixed size.
pub(super) fn decode_fixed<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, DecodeError> {
    read(bytes, config::standard().with_fixed_int_encoding().with_limit::<FIXED_LIMIT>())
}

trait Limit {
    const BYTES: usize;

    /// How many bytes the codec may claim, in powers of four from 64 KiB on.
    ///
    /// The codec counts an integer by its full width, which is up to 16 times what it takes on the
    /// wire, and it wants its limit as a constant.
    const RUNG: u32 = {
        assert!(Self::BYTES <= SIZE_LIMIT, "max_size is above 16 MiB: send larger data in parts");
        let claimed = Self::BYTES * 16;
        let mut rung = 0;
        while (64 * 1024) << (2 * rung) < claimed {
            rung += 1;
        }
        rung
    };
}

struct MessageLimit<M>(M);

impl<M: Contract> Limit for MessageLimit<M> {
    const BYTES: usize = M::MAX_SIZE;
}

struct NumberLimit<const LIMIT: usize>;

impl<const LIMIT: usize> Limit for NumberLimit<LIMIT> {
    const BYTES: usize = LIMIT;
}

fn decode_within<T: DeserializeOwned, L: Limit>(bytes: &[u8]) -> Result<T, DecodeError> {
    if bytes.len() > L::BYTES {
        return Err(DecodeError::TooLarge { size: bytes.len(), limit: L::BYTES });
    }
    let standard = config::standard();
    // The match is over a constant: one arm is compiled for each type.
    match L::RUNG {
        0 => read(bytes, standard.with_limit::<{ 64 * 1024 }>()),
        1 => read(bytes, standard.with_limit::<{ 256 * 1024 }>()),
        2 => read(bytes, standard.with_limit::<{ 1024 * 1024 }>()),
        3 => read(bytes, standard.with_limit::<{ 4 * 1024 * 1024 }>()),
        4 => read(bytes, standard.with_limit::<{ 16 * 1024 * 1024 }>()),
        5 => read(bytes, standard.with_limit::<{ 64 * 1024 * 1024 }>()),
        _ => read(bytes, standard.with_limit::<{ 256 * 1024 * 1024 }>()),
    }
}

fn read<T: DeserializeOwned>(bytes: &[u8], config: impl Config) -> Result<T, DecodeError> {
    let (value, taken) = bincode::serde::borrow_decode_from_slice(bytes, config).map_err(
        |malformed| match malformed {
            Malformed::UnexpectedEnd { .. } | Malformed::LimitExceeded => DecodeError::Truncated,
            Malformed::OtherString(reason) => DecodeError::Malformed { reason },
            other => DecodeError::Malformed { reason: other.to_string() },
        },
    )?;
    match bytes.len() - taken {
        0 => Ok(value),
        count => Err(DecodeError::Trailing { count }),
    }
}

fn write<T: Serialize, W: Writer>(value: &T, writer: W) -> Result<W, Refusal> {
    write_by(value, writer, config::standard())
}

fn write_by<T: Serialize, W: Writer>(
    value: &T,
    writer: W,
    config: impl Config,
) -> Result<W, Refusal> {
    let mut encoder = EncoderImpl::new(writer, config);
    bincode::Encode::encode(&bincode::serde::BorrowCompat(value), &mut encoder)?;
    Ok(encoder.into_writer())
}

fn encode_error(refusal: Refusal, limit: usize) -> EncodeError {
    match refusal {
        Refusal::UnexpectedEnd => EncodeError::TooLarge { limit },
        Refusal::OtherString(reason) => EncodeError::Impossible { reason },
        other => EncodeError::Impossible { reason: other.to_string() },
    }
}

/// Writes into new memory, up to a length, all but a large blob that ends it.
struct ParcelWriter {
    head: Vec<u8>,
    /// What stands behind the head so far. It is copied when more follows.
    last: Option<Bytes>,
    left: usize,
}

impl Writer for ParcelWriter {
    #[inline]
    fn write(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        self.left = self.left.checked_sub(bytes.len()).ok_or(Refusal::UnexpectedEnd)?;
        if let Some(last) = self.last.take() {
            self.head.extend_from_slice(&last);
        }
        self.last = given(bytes);
        if self.last.is_none() {
            self.head.extend_from_slice(bytes);
        }
        Ok(())
    }
}

/// Writes at the end of a buffer, up to a length.
struct BufferWriter<'a> {
    buffer: &'a mut Vec<u8>,
    end: usize,
}

impl Writer for BufferWriter<'_> {
    #[inline]
    fn write(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        if bytes.len() > self.end - self.buffer.len() {
            return Err(Refusal::UnexpectedEnd);
        }
        self.buffer.extend_from_slice(bytes);
        Ok(())
    }
}
