//! Messages and replies as bytes, and why one cannot be.

use blastema_core::contract::codec;
use blastema_core::{Contract, DeliveryError, GatherBuffer, PreviousVersion};

pub(crate) fn encoded_reply<M: Contract>(
    reply: M::Reply,
    former: Option<&PreviousVersion<M>>,
) -> Result<GatherBuffer, DeliveryError> {
    let encoded = match former {
        None => codec::encode_parcel_reply::<M>(reply),
        Some(former) => former.answer(reply),
    };
    encoded.map_err(|error| match encoding(error, M::MAX_SIZE) {
        DeliveryError::TooLarge { limit } => DeliveryError::ReplyTooLarge { limit },
        other => DeliveryError::ReplyUnsent { reason: other.to_string() },
    })
}

/// What was read of a message. Bytes that are no such message are the sender's mistake; a panic is
/// the receiver's own, whose checks have failed.
pub(crate) fn read_result<M>(
    read: Result<Result<M, codec::DecodeError>, String>,
) -> Result<M, DeliveryError> {
    read.map_err(|reason| DeliveryError::CheckFailed { reason })?
        .map_err(|error| DeliveryError::Undecodable { reason: error.to_string() })
}

pub(super) fn encoding(error: codec::EncodeError, limit: usize) -> DeliveryError {
    match error {
        codec::EncodeError::TooLarge { .. } => DeliveryError::TooLarge { limit },
        other => DeliveryError::Undecodable { reason: other.to_string() },
    }
}
