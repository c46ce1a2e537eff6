//! Earlier versions of a contract that a receiver still understands.
//!
//! ```text
//!  sender: v1 ───── v1 bytes ─────► receiver: v3 = From<v2>, v2 = From<v1>
//!          ◄── v1's reply, From<v3's> ──
//! ```
//!
//! The receiver converts, for it is the newer: an old program knows nothing of what comes after it.
//! What is declared is a chain, each version naming the one before; all of it is understood.

use crate::contract::codec;
use crate::contract::codec::{DecodeError, EncodeError};
use crate::{Contract, ContractIdentity, GatherBuffer};
use bytes::Bytes;
use std::fmt;

type Read<M> = Box<dyn Fn(&Bytes) -> Result<M, DecodeError> + Send + Sync>;
type Answer<M> =
    Box<dyn Fn(<M as Contract>::Reply) -> Result<GatherBuffer, EncodeError> + Send + Sync>;

/// An earlier version of the contract `M`, and how it is read and answered.
pub struct PreviousVersion<M: Contract> {
    identity: ContractIdentity,
    read: Read<M>,
    answer: Answer<M>,
}

impl<M: Contract> fmt::Debug for PreviousVersion<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} v{} for v{}", self.identity.name, self.identity.version, M::VERSION)
    }
}

impl<M: Contract> PreviousVersion<M> {
    /// The version before, and all before that.
    pub fn chain<P>() -> Vec<PreviousVersion<M>>
    where
        P: Contract,
        M: From<P>,
        P::Reply: From<M::Reply>,
    {
        const {
            assert!(P::VERSION < M::VERSION, "the version that `from` names is not an earlier one");
            assert!(is_same(P::NAME, M::NAME), "the version that `from` names has another name");
        }
        let before = PreviousVersion::<M> {
            identity: ContractIdentity::of::<P>(),
            read: Box::new(|bytes| codec::decode_shared::<P>(bytes).map(M::from)),
            answer: Box::new(|reply| codec::encode_parcel_reply::<P>(&P::Reply::from(reply))),
        };
        let earlier =
            P::previous_versions().into_iter().map(|PreviousVersion { identity, read, answer }| {
                PreviousVersion::<M> {
                    identity,
                    read: Box::new(move |bytes| read(bytes).map(M::from)),
                    answer: Box::new(move |reply| answer(P::Reply::from(reply))),
                }
            });
        std::iter::once(before).chain(earlier).collect()
    }

    /// What a peer must hold to be understood by it.
    pub fn identity(&self) -> &ContractIdentity {
        &self.identity
    }

    /// Reads a message of that version.
    ///
    /// # Errors
    /// [`DecodeError`] if the bytes are not exactly one such message.
    pub fn read(&self, bytes: &Bytes) -> Result<M, DecodeError> {
        (self.read)(bytes)
    }

    /// Encodes a reply as that version has it, to be sent.
    ///
    /// # Errors
    /// [`EncodeError`].
    pub fn answer(&self, reply: M::Reply) -> Result<GatherBuffer, EncodeError> {
        (self.answer)(reply)
    }
}

const fn is_same(one: &str, other: &str) -> bool {
    let (one, other) = (one.as_bytes(), other.as_bytes());
    let mut at = 0;
    while at < one.len() && at < other.len() {
        if one[at] != other[at] {
            return false;
        }
        at += 1;
    }
    one.len() == other.len()
}
