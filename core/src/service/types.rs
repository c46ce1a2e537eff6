//! The inputs, roles and outputs of a replica.

use super::message::MESSAGE_MAX;
use crate::contract::codec::{self, DecodeError};
use crate::{DeliveryError, FaultKind, Instant, MessageId, NodeName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// A replica's role in its service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Role {
    /// The replica serves.
    Primary {
        /// The epoch in which it serves.
        epoch: u64,
    },
    /// The replica stands by.
    Standby {
        /// The node of the primary, if one is known.
        primary: Option<NodeName>,
        /// The replica has everything that the primary has answered, as far as its kind of standby
        /// keeps that.
        in_step: bool,
    },
}

impl Default for Role {
    /// A replica at its start.
    fn default() -> Self {
        Role::Standby { primary: None, in_step: false }
    }
}

/// A caller's request to a service.
#[derive(Clone, Debug)]
pub struct ServiceRequest {
    /// The number under which the caller is answered.
    pub caller: u64,
    /// The request's identity, the same however often it is sent.
    pub id: MessageId,
    /// The sender has received the replies to all its requests below this number.
    pub settled: u64,
    /// The request's deadline: the replica does not begin it later.
    pub until: Option<Instant>,
    /// The encoded request.
    pub request: Bytes,
}

/// The result of a request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ServiceOutcome {
    /// It was served, or failed for good; the same request is never executed again.
    Served(Result<Vec<u8>, DeliveryError>),
    /// It was not accepted.
    Refused(DeliveryError),
    /// This replica is not the primary: this node is, if one is known.
    Elsewhere(Option<NodeName>),
}

impl ServiceOutcome {
    /// Returns the bytes by which a caller on another node is answered.
    pub fn encode(&self) -> Vec<u8> {
        codec::encode_unbounded(self)
    }

    /// Reads what [`encode`](Self::encode) wrote.
    ///
    /// # Errors
    /// The bytes are no result of a request.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        codec::decode_bounded::<Self, MESSAGE_MAX>(bytes)
    }
}

/// An action that a replica requires of its actor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReplicaOutput {
    /// Send a message to another replica.
    Send {
        /// The node of the receiver.
        to: NodeName,
        /// The encoded message.
        message: Bytes,
    },
    /// The role has changed, or whether this standby is in step.
    RoleChanged(Role),
    /// Let the component serve a request. Report its reply, and its state if `save` is set, by
    /// [`Replica::handle_executed`](super::Replica::handle_executed).
    Execute {
        /// The encoded request.
        request: Bytes,
        /// The state after the request is required as well.
        save: bool,
    },
    /// Ask the component for its state, for
    /// [`Replica::handle_saved`](super::Replica::handle_saved).
    Save,
    /// Give the component a state, and report that by
    /// [`Replica::handle_loaded`](super::Replica::handle_loaded).
    Load {
        /// The component's encoded state.
        state: Bytes,
    },
    /// Declare a fault of the service on this node. A later output of the same kind replaces its
    /// detail.
    Fault {
        /// The kind: a state that cannot be kept, is on this node alone or is lost, a service
        /// without a primary, or a mismatch of configurations, until which no further replica
        /// begins to serve.
        kind: FaultKind,
        /// The particulars, and how to clear the fault.
        detail: String,
    },
    /// Clear the fault of this kind.
    FaultCleared {
        /// The kind of the fault.
        kind: FaultKind,
    },
    /// Ask a node for its configuration of the service, and report the answer by
    /// [`Replica::handle_configuration`](super::Replica::handle_configuration),
    /// [`Replica::handle_no_service`](super::Replica::handle_no_service) or
    /// [`Replica::handle_left`](super::Replica::handle_left); without one it is asked again.
    Compare {
        /// The node to ask.
        with: NodeName,
    },
    /// Ask the primaries of the services that this one depends on whether they serve. Once all do,
    /// report that by [`Replica::handle_ready`](super::Replica::handle_ready). A new check replaces
    /// the one before.
    CheckDependencies,
    /// Answer a caller.
    Answer {
        /// The number under which the caller asked.
        caller: u64,
        /// The result of its request.
        outcome: ServiceOutcome,
    },
}
