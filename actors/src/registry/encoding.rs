//! Messages and replies as bytes, and why one cannot be.

use blastema_core::contract::codec;
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, GatherBuffer, PeerIdentity, PreviousVersion,
};

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

/// A message that stands in another one.
pub(crate) fn encoded<M: Contract>(message: &M) -> Result<Vec<u8>, DeliveryError> {
    let mut bytes = Vec::new();
    codec::encode(message, &mut bytes).map_err(|error| encoding(error, M::MAX_SIZE))?;
    Ok(bytes)
}

/// How the contract `M` differs from the one of this identity, by which another party has refused.
pub(crate) fn differs<M: Contract>(theirs: &[u8], party: &str) -> DeliveryError {
    let difference = match PeerIdentity::decode(theirs) {
        Ok(theirs) => ContractIdentity::of::<M>().check(&theirs).err(),
        Err(error) => return DeliveryError::Undecodable { reason: error.to_string() },
    };
    let difference = difference.map_or(format!("the {party} says so"), |it| it.to_string());
    DeliveryError::ContractDiffers { difference }
}
