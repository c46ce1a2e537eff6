//! What a message between two objects must be, and how two parties find out that they mean the
//! same.

pub mod blob;
pub mod codec;
pub mod field;
pub mod gather_buffer;
pub mod layout;
pub mod packed;
pub mod previous_version;

use crate::sorted::SortedMap;
use crate::{Delivery, LayoutDescription, ObjectName, PreviousVersion, TrafficClass, hash};
use codec::DecodeError;
use layout::difference::{ContractPart, Difference, compare};
use layout::{Described, Layout, LayoutOf};
use serde::{Deserialize, Deserializer, Serialize};
use std::any::TypeId;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// The most bytes that an encoded [`PeerIdentity`] may take. One of a rich message takes 2 KiB.
pub(crate) const PEER_LIMIT: usize = 16 * 1024;

/// A type of message: an event, or a request with its reply.
///
/// Derive it with `#[derive(Event)]` or `#[derive(Request)]`; do not implement it by hand.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no contract",
    label = "can be neither sent nor handled",
    note = "write `#[derive(Event)]` or `#[derive(Request)]` above the type"
)]
pub trait Contract: Described + Send + 'static {
    /// What the receiver answers; `()` for an event.
    type Reply: Described + Send + 'static;

    /// The name by which both parties know the contract.
    const NAME: &'static str;
    /// Raised when the contract's meaning changes.
    const VERSION: u16 = 1;
    /// The most bytes that one encoded message, or its encoded reply, may take; at most 16 MiB.
    const MAX_SIZE: usize = 64 * 1024;
    /// An event older than this is not delivered but counted.
    const MAX_AGE: Option<Duration> = None;
    /// How messages travel between nodes.
    const DELIVERY: Delivery = Delivery::Reliable;
    /// Its messages are large, and may wait for others on their way to other nodes. They are kept
    /// in order among themselves, not with others.
    const BULK: bool = false;
    /// A request that may take effect twice without harm: it is sent again, within its deadline,
    /// where it is not known whether it took effect.
    const IDEMPOTENT: bool = false;

    /// The last event on a topic is kept, and given to each listener that joins.
    const LATCHED: bool = false;

    /// An event for which another node that listens has no capacity is refused to its publisher, and
    /// goes to no listener. Otherwise that node gets it not, and it is counted.
    const REFUSE_WHEN_FULL: bool = false;

    /// The earlier versions that a receiver still understands, the latest first.
    fn previous_versions() -> Vec<PreviousVersion<Self>>
    where
        Self: Sized,
    {
        Vec::new()
    }
}

/// A contract without an answer, which may have many listeners.
///
/// # Examples
/// ```
/// # mod facade { pub(crate) use blastema_core::{self as core, serde}; }
/// # use blastema_macros::Event;
/// /// One sweep of the laser.
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "laser/scan", version = 1, max_age = "100ms")]
/// # #[contract(crate = "crate::facade")]
/// struct Scan {
///     #[contract(unit = "m", frame = "laser")]
///     ranges: Vec<f32>,
/// }
/// # fn main() {}
/// ```
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no event",
    label = "cannot be published or listened to",
    note = "write `#[derive(Clone, Event)]` above the type"
)]
pub trait Event: Contract<Reply = ()> + Clone + Sync {}

/// A contract with an answer.
///
/// # Examples
/// ```
/// # mod facade { pub(crate) use blastema_core::{self as core, serde}; }
/// # use blastema_macros::Request;
/// /// How far is the nearest obstacle?
/// #[derive(Debug, Request)]
/// #[contract(reply = f32)]
/// # #[contract(crate = "crate::facade")]
/// struct Nearest {
///     #[contract(unit = "rad")]
///     within: f32,
/// }
/// # fn main() {}
/// ```
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no request",
    label = "cannot be asked",
    note = "write `#[derive(Request)]` and `#[contract(reply = ..)]` above the type"
)]
pub trait Request: Contract {}

/// A value that an object owns, and that any node may read, write and watch.
///
/// # Examples
/// ```
/// # mod facade { pub(crate) use blastema_core::{self as core, serde}; }
/// # use blastema_macros::Variable;
/// /// How fast the arm may move.
/// #[derive(Clone, Debug, Variable)]
/// #[contract(name = "arm/speed-limit")]
/// # #[contract(crate = "crate::facade")]
/// struct SpeedLimit {
///     #[contract(unit = "rad/s")]
///     value: f32,
/// }
/// # fn main() {}
/// ```
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no variable",
    label = "can be neither owned nor written",
    note = "write `#[derive(Clone, Variable)]` above the type"
)]
pub trait Variable: Contract<Reply = ()> + Clone + Sync {}

/// What two parties compare when they bind.
#[derive(Clone, Debug)]
pub struct ContractIdentity {
    /// The contract's name.
    pub name: &'static str,
    /// The contract's version.
    pub version: u16,
    /// How its messages travel.
    pub delivery: Delivery,
    /// They are large, and may wait for others on their way. Each node goes by its own declaration:
    /// this is not compared.
    pub bulk: bool,
    /// The asker may send it again. This does not concern the other party, and is not compared.
    pub idempotent: bool,
    /// The hash of its structure and of its reply's: FNV-1a, 64 bits, over their descriptions. It
    /// guards against accidents, not against intent.
    pub fingerprint: u64,
    /// The message's structure.
    pub message: LayoutOf,
    /// The reply's structure.
    pub reply: LayoutOf,
}

/// A [`ContractIdentity`] as it comes from another node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerIdentity {
    /// The contract's name.
    #[serde(deserialize_with = "contract_name")]
    pub name: String,
    /// The contract's version.
    pub version: u16,
    /// How its messages travel: who counts on every message is not served by who sends the newest.
    pub delivery: Delivery,
    /// Its messages, and the replies to them, may wait for others on their way.
    pub bulk: bool,
    /// The hash of its structure and of its reply's.
    pub fingerprint: u64,
    /// The structures of message and reply, to say what differs. Left out where only the verdict is
    /// wanted, and where they are too large.
    pub structure: Option<PeerStructure>,
}

/// The structures of a peer's contract.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerStructure {
    /// The structure of the message.
    pub message: LayoutDescription,
    /// The structure of the reply.
    pub reply: LayoutDescription,
}

impl ContractIdentity {
    /// The identity of a contract. The structure is hashed once in a process and remembered.
    pub fn of<M: Contract>() -> Self {
        ContractIdentity {
            name: M::NAME,
            version: M::VERSION,
            delivery: M::DELIVERY,
            bulk: M::BULK,
            idempotent: M::IDEMPOTENT,
            fingerprint: remembered_fingerprint(TypeId::of::<M>(), M::layout, M::Reply::layout),
            message: M::layout,
            reply: M::Reply::layout,
        }
    }

    /// The traffic class of messages to an object, and of the replies to them.
    pub fn message_class(&self) -> TrafficClass {
        TrafficClass::of_message(self.name, self.delivery, self.bulk)
    }

    /// What the peer needs to decide: name, version, delivery and fingerprint.
    pub fn brief(&self) -> PeerIdentity {
        PeerIdentity {
            name: self.name.into(),
            version: self.version,
            delivery: self.delivery,
            bulk: self.bulk,
            fingerprint: self.fingerprint,
            structure: None,
        }
    }

    /// What the peer needs to say what differs: the brief and the structures, which are left out if
    /// they exceed what a receiver takes.
    pub fn full(&self) -> PeerIdentity {
        let structure = PeerStructure::of((self.message)(), (self.reply)());
        let whole = PeerIdentity { structure: Some(structure), ..self.brief() };
        if whole.is_sendable() { whole } else { self.brief() }
    }

    /// Lets the two parties bind only if they mean the same.
    ///
    /// # Errors
    /// [`Difference`] says field by field what differs, as far as the peer sent its structure.
    pub fn check(&self, peer: &PeerIdentity) -> Result<(), Difference> {
        // The structure is needed only to show what differs.
        let differs = self.fingerprint != peer.fingerprint;
        let structure = differs.then(|| PeerStructure::of((self.message)(), (self.reply)()));
        PeerIdentity { structure, ..self.brief() }.check(peer)
    }
}

impl PeerIdentity {
    /// Lets the two parties bind only if they mean the same.
    ///
    /// # Errors
    /// [`Difference`] says field by field what differs, as far as both structures are known.
    pub fn check(&self, peer: &PeerIdentity) -> Result<(), Difference> {
        let mut lines = Vec::new();
        if self.name != peer.name {
            lines.push(format!("name `{}` here, `{}` there", self.name, peer.name));
        }
        if self.version != peer.version {
            lines.push(format!("version {} here, {} there", self.version, peer.version));
        }
        if self.delivery != peer.delivery {
            lines.push(format!("delivery {} here, {} there", self.delivery, peer.delivery));
        }
        if self.fingerprint != peer.fingerprint {
            lines.extend(self.structural_lines(peer));
        }
        if lines.is_empty() {
            return Ok(());
        }
        Err(Difference { contract: self.name.clone(), lines })
    }

    fn structural_lines(&self, peer: &PeerIdentity) -> Vec<String> {
        let mut lines = Vec::new();
        if let (Some(here), Some(there)) = (&self.structure, &peer.structure) {
            lines.extend(compare(ContractPart::Message, &here.message, &there.message));
            lines.extend(compare(ContractPart::Reply, &here.reply, &there.reply));
        }
        if lines.is_empty() {
            lines.push(format!(
                "structure {:016x} here, {:016x} there",
                self.fingerprint, peer.fingerprint
            ));
        }
        lines
    }

    /// The bytes that travel.
    pub fn encode(&self) -> Vec<u8> {
        codec::encode_unbounded(self)
    }

    /// Reads what [`encode`](Self::encode) wrote.
    ///
    /// # Errors
    /// [`DecodeError`] if the bytes are no identity, or one that exceeds what is taken.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        codec::decode_bounded::<Self, PEER_LIMIT>(bytes)
    }

    fn is_sendable(&self) -> bool {
        let Some(PeerStructure { message, reply }) = &self.structure else { return true };
        let sound = message.check().is_ok() && reply.check().is_ok();
        sound && self.encode().len() <= PEER_LIMIT
    }
}

impl PeerStructure {
    fn of(message: &Layout, reply: &Layout) -> Self {
        PeerStructure {
            message: LayoutDescription::of_message(message),
            reply: LayoutDescription::of(reply),
        }
    }
}

/// Reads a contract's name, which obeys the rules for names of objects: it is shown to a person.
fn contract_name<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    ObjectName::deserialize(from).map(String::from)
}

/// The hash of the structure of a message and of its reply.
///
/// It is taken over the bytes of both descriptions, which golden tests hold still: it is the same
/// in every build and on every platform.
pub fn fingerprint(message: LayoutOf, reply: LayoutOf) -> u64 {
    fingerprint_of(message(), reply())
}

fn fingerprint_of(message: &Layout, reply: &Layout) -> u64 {
    hash::of(codec::encode_unbounded(&PeerStructure::of(message, reply)))
}

/// The fingerprint of the contract `id`, computed when first asked for.
///
/// The table is bounded by the number of contracts that the program is compiled with.
fn remembered_fingerprint(id: TypeId, message: LayoutOf, reply: LayoutOf) -> u64 {
    static KNOWN: Mutex<SortedMap<TypeId, u64>> = Mutex::new(SortedMap::new());

    // A panic while the lock was held leaves at worst an entry out; the table stays true.
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    *known.entry(id).or_insert_with(|| fingerprint(message, reply))
}
