//! What a replica is asked, becomes, and wants done.

use crate::{DeliveryError, FaultKind, Instant, MessageId, NodeName};
use bytes::Bytes;

/// What a replica is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Role {
    /// It serves.
    Primary {
        /// Under this epoch.
        epoch: u64,
    },
    /// It stands by.
    Standby {
        /// For this node, where one is known to serve.
        primary: Option<NodeName>,
        /// It has everything that the primary has answered, as far as its kind keeps that.
        in_step: bool,
    },
}

/// What somebody asks of a service.
#[derive(Clone, Debug)]
pub struct ServiceRequest {
    /// Under which number it is answered.
    pub caller: u64,
    /// By what it is known, however often it comes.
    pub id: MessageId,
    /// All requests of the same sender below this number have got their answers.
    pub settled: u64,
    /// It is not begun after this.
    pub until: Option<Instant>,
    /// What is to be done.
    pub request: Bytes,
}

/// What came of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ServiceOutcome {
    /// It was served, or failed for good; the same request is never executed again.
    Served(Result<Bytes, DeliveryError>),
    /// It was not taken.
    Refused(DeliveryError),
    /// The service is on this node, if anywhere.
    Elsewhere(Option<NodeName>),
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReplicaOutput {
    /// Tell another replica.
    Send {
        /// Whom.
        to: NodeName,
        /// What.
        message: Bytes,
    },
    /// The role has changed, or whether this standby is in step.
    Became(Role),
    /// Let the component serve this, and say what came of it by
    /// [`Replica::handle_executed`](super::Replica::handle_executed), with its state afterwards
    /// where that is wanted.
    Execute {
        /// The request.
        request: Bytes,
        /// The state is wanted too.
        save: bool,
    },
    /// Ask the component for its state, for
    /// [`Replica::handle_saved`](super::Replica::handle_saved).
    Save,
    /// Give the component this state, and say so by
    /// [`Replica::handle_loaded`](super::Replica::handle_loaded).
    Load {
        /// The state.
        state: Bytes,
    },
    /// Something of the service is wrong, here. Said again, it stands as it is said last.
    Fault {
        /// What: a state that cannot be kept, one that nobody else keeps, or one that is lost.
        kind: FaultKind,
        /// The particulars, and what helps.
        detail: String,
    },
    /// A fault of this kind is over.
    Mended {
        /// Which.
        kind: FaultKind,
    },
    /// Another node was told something else of the service than this one. Who serves until that is
    /// mended is decided by who could still elect somebody by the other terms. Or it was told
    /// nothing, and should have been; or so many things were told that this one cannot tell them
    /// apart any more.
    Disputed {
        /// In what, and what is to be written.
        detail: String,
    },
    /// What was disputed is over. What is left of it, if there is any, follows.
    Agreed,
    /// Ask this node what it was told of the service, and say so by
    /// [`Replica::handle_terms`](super::Replica::handle_terms),
    /// [`Replica::handle_no_terms`](super::Replica::handle_no_terms) or
    /// [`Replica::handle_left`](super::Replica::handle_left).
    Compare {
        /// Which.
        with: NodeName,
    },
    /// Find out whether the services that this one depends on are served now, by asking whoever
    /// serves them, and say so by [`Replica::handle_ready`](super::Replica::handle_ready) once they
    /// are. A new inquiry takes the place of the last one.
    Inquire,
    /// Answer a caller.
    Answer {
        /// The number under which it asked.
        caller: u64,
        /// What.
        outcome: ServiceOutcome,
    },
}
