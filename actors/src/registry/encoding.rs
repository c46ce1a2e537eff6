//! Messages and replies as bytes, and why one cannot be.

use crate::messaging::reply::Responder;
use blastema_core::contract::codec;
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, GatherBuffer, PeerIdentity, PreviousVersion,
};
use blastema_macros::Structure;

pub(crate) fn encoded_reply<M: Contract>(
    reply: M::Reply,
    former: Option<&PreviousVersion<M>>,
) -> Result<GatherBuffer, DeliveryError> {
    let encoded = match former {
        None => codec::encode_parcel_reply::<M>(&reply),
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
    Ok(read.map_err(|reason| DeliveryError::CheckFailed { reason })??)
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

/// The contract of the other party is another one: this, in full.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct OtherContract {
    identity: Vec<u8>,
}

impl OtherContract {
    /// How the contract `M` differs from this one, by which another party has refused.
    pub(crate) fn difference<M: Contract>(&self, party: &str) -> DeliveryError {
        let difference = match PeerIdentity::decode(&self.identity) {
            Ok(theirs) => ContractIdentity::of::<M>().check(&theirs).err(),
            Err(error) => return error.into(),
        };
        let difference = difference.map_or(format!("the {party} says so"), |it| it.to_string());
        DeliveryError::ContractDiffers { difference }
    }

    /// The name of the contract.
    pub(crate) fn name(&self) -> String {
        PeerIdentity::decode(&self.identity).map(|known| known.name).unwrap_or_default()
    }
}

/// Why the node refuses a request that names the contract which it is about.
pub(crate) enum RequestRefusal {
    Differs(OtherContract),
    Why(DeliveryError),
}

impl From<DeliveryError> for RequestRefusal {
    fn from(why: DeliveryError) -> Self {
        RequestRefusal::Why(why)
    }
}

impl RequestRefusal {
    /// Compares the contract that a request names with the one that there is.
    pub(crate) fn check(known: &ContractIdentity, theirs: &PeerIdentity) -> Result<(), Self> {
        let differs = |_| OtherContract { identity: known.full().encode() };
        known.check(theirs).map_err(differs).map_err(RequestRefusal::Differs)
    }
}

/// The identity of a contract that a request names.
pub(crate) fn named_contract(identity: &[u8]) -> Result<PeerIdentity, DeliveryError> {
    Ok(PeerIdentity::decode(identity)?)
}

impl<T, M: Contract<Reply = Result<T, OtherContract>>> Responder<M> {
    /// Replies, or refuses.
    pub(crate) fn settle(self, result: Result<T, RequestRefusal>) {
        match result {
            Ok(reply) => self.give(Ok(reply)),
            Err(RequestRefusal::Differs(other)) => self.give(Err(other)),
            Err(RequestRefusal::Why(why)) => self.refuse(why, None),
        }
    }
}
