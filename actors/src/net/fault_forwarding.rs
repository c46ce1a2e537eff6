//! Faults on their way to another node's recoverer.

use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::registry::Registry;
use crate::registry::access::MessageOrigin;
use actix::dev::{MessageResponse, OneshotSender};
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::recoverer::Recover;
use blastema_core::contract::codec;
use blastema_core::contract::codec::DecodeError;
use blastema_core::net::NodeId;
use blastema_core::{DeliveryError, Fault, FaultLocation, Instant, NodeName};
use blastema_macros::Request;
use std::time::Duration;
use tracing::warn;

/// The most bytes of one fault: its detail may hold a panic's text.
const FAULT_MAX: usize = 16 * 1024;

/// As long as the notifier tells a recoverer of one fault: a slow way confirms late.
const CONFIRMED_WITHIN: Duration = Duration::from_secs(5);

/// Asks a node to take a fault.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/recover", version = 2, reply = ())]
struct ForwardFault {
    /// An encoded [`Fault`].
    fault: Vec<u8>,
    /// How long ago it was found: instants are no good on another clock.
    age_us: u64,
}

fn encode(fault: Fault, now: Instant) -> ForwardFault {
    let age_us = u64::try_from((now - fault.found_at).as_micros()).unwrap_or(u64::MAX);
    // Four bytes a letter at most, and room for the rest.
    let detail = fault.detail.chars().take(FAULT_MAX / 8).collect();
    let mut bytes = Vec::new();
    codec::encode_bounded(&Fault { detail, ..fault }, FAULT_MAX, &mut bytes)
        .expect("names and a shortened text fit into the limit");
    ForwardFault { fault: bytes, age_us }
}

fn decode(
    ForwardFault { fault, age_us }: &ForwardFault,
    now: Instant,
) -> Result<Fault, DecodeError> {
    let fault = codec::decode_bounded::<Fault, FAULT_MAX>(fault)?;
    let age = Duration::from_micros(*age_us);
    let found_at = Instant::ORIGIN + (now - Instant::ORIGIN).saturating_sub(age);
    Ok(Fault { found_at, ..fault })
}

/// Where a node takes the faults of others. It is no object that others can see.
const OBJECT: &str = "net/recoverer";

/// Takes other nodes' faults for the recoverer of this one. The peer protocol checks the right when
/// the contract is bound.
pub(super) fn serve(registry: &Registry, recoverer: Recipient<Recover>) {
    let take = move |fault: ForwardFault, from: MessageOrigin, answer: Responder<ForwardFault>| {
        let fault = match decode(&fault, platform::now()) {
            Ok(fault) => fault,
            Err(error) => return warn!(?from, %error, "a fault that cannot be read"),
        };
        // A node's reports of its own objects and links count. Its reports of other nodes, or of
        // this one, do not: each node judges those by its own links.
        let theirs = match &fault.location {
            FaultLocation::Object(address) => Some(&address.node),
            FaultLocation::Link { node, .. } => Some(node),
            FaultLocation::Node(_) => None,
        };
        if from.peer.is_none() || theirs.map(NodeId::of) != from.peer {
            return answer.give(());
        }
        let taken = recoverer.send(Recover { fault });
        actix_rt::spawn(async move {
            if taken.await.is_ok() {
                answer.give(());
            }
        });
    };
    registry.serve_hidden::<ForwardFault>(OBJECT, take);
}

/// Stands in for the recoverer of one other node.
pub(super) struct RemoteRecoverer {
    address: String,
    registry: Registry,
}

impl RemoteRecoverer {
    pub(super) fn new(peer: &NodeName, registry: &Registry) -> Self {
        RemoteRecoverer { address: format!("{peer}:{OBJECT}"), registry: registry.clone() }
    }
}

impl Actor for RemoteRecoverer {
    type Context = Context<Self>;
}

impl Supervised for RemoteRecoverer {}

impl Handler<Recover> for RemoteRecoverer {
    type Result = ForwardedAnswer;

    fn handle(&mut self, message: Recover, _: &mut Context<Self>) -> ForwardedAnswer {
        let fault = encode(message.fault, platform::now());
        ForwardedAnswer(self.registry.sender(&self.address), fault)
    }
}

/// Asks the other node. Without its reply the answer is dropped, so that the notifier tries again.
pub(super) struct ForwardedAnswer(Result<Sender<ForwardFault>, DeliveryError>, ForwardFault);

impl MessageResponse<RemoteRecoverer, Recover> for ForwardedAnswer {
    fn handle(self, _: &mut Context<RemoteRecoverer>, answer: Option<OneshotSender<Confirmed>>) {
        let (ForwardedAnswer(Ok(sender), fault), Some(answer)) = (self, answer) else { return };
        actix_rt::spawn(async move {
            let taken = sender.ask_within(fault, CONFIRMED_WITHIN).await;
            let taken = taken.map_err(|error| error.kind);
            // A node that may not hand faults over does not try again.
            if matches!(taken, Ok(()) | Err(DeliveryError::Forbidden { .. })) {
                // The caller may have stopped waiting.
                let _ = answer.send(Confirmed);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::{FaultId, FaultKind, Incarnation, Severity};

    #[test]
    fn a_fault_keeps_its_age_on_another_nodes_clock() {
        let fault = Fault {
            id: FaultId(7),
            kind: FaultKind::Custom("grip".into()),
            severity: Severity::Error,
            location: FaultLocation::Node(NodeName::new("module2").unwrap()),
            incarnation: Incarnation(3),
            detail: "ä".repeat(100_000),
            found_at: Instant::from_millis(900),
            symptom_of: None,
            count: 2,
        };

        let bytes = encode(fault.clone(), Instant::from_millis(1000));
        let there = decode(&bytes, Instant::from_millis(5_000_000)).unwrap();

        assert_eq!(there.found_at, Instant::from_millis(4_999_900));
        assert_eq!((there.kind, there.location, there.count), (fault.kind, fault.location, 2));
        assert_eq!(there.detail.chars().count(), FAULT_MAX / 8);
    }
}
