//! Faults on their way to another node's recoverer.

use super::gateway::ForwardFault;
use crate::platform;
use actix::dev::{MessageResponse, OneshotSender};
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::recoverer::Recover;
use blastema_core::contract::codec;
use blastema_core::contract::codec::DecodeError;
use blastema_core::net::NodeId;
use blastema_core::{Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant, Severity};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::time::Duration;
use tokio::sync::oneshot;

/// The most bytes of one fault: its detail may hold a panic's text.
const FAULT_MAX: usize = 16 * 1024;

/// A fault as it travels. Instants are no good elsewhere: its age is.
#[derive(Serialize, Deserialize)]
struct Travelling {
    id: FaultId,
    kind: FaultKind,
    severity: Severity,
    location: FaultLocation,
    incarnation: Incarnation,
    detail: String,
    age_us: u64,
    symptom_of: Option<FaultId>,
    count: u32,
}

pub(super) fn encode(fault: Fault, now: Instant) -> Bytes {
    let Fault { id, kind, severity, location, incarnation, detail, found_at, symptom_of, count } =
        fault;
    let age_us = u64::try_from((now - found_at).as_micros()).unwrap_or(u64::MAX);
    // Four bytes a message at most, and room for the rest.
    let detail: String = detail.chars().take(FAULT_MAX / 8).collect();
    let travelling =
        Travelling { id, kind, severity, location, incarnation, detail, age_us, symptom_of, count };
    let mut bytes = Vec::new();
    codec::encode_bounded(&travelling, FAULT_MAX, &mut bytes)
        .expect("names and a shortened text fit into the limit");
    bytes.into()
}

pub(super) fn decode(bytes: &[u8], now: Instant) -> Result<Fault, DecodeError> {
    let Travelling { id, kind, severity, location, incarnation, detail, age_us, symptom_of, count } =
        codec::decode_bounded::<Travelling, FAULT_MAX>(bytes)?;
    let age = Duration::from_micros(age_us);
    let found_at = Instant::ORIGIN + (now - Instant::ORIGIN).saturating_sub(age);
    Ok(Fault { id, kind, severity, location, incarnation, detail, found_at, symptom_of, count })
}

/// Stands in for the recoverer of one other node.
pub(super) struct RemoteRecoverer {
    peer: NodeId,
    gateway: Recipient<ForwardFault>,
}

impl RemoteRecoverer {
    pub(super) fn new(peer: NodeId, gateway: Recipient<ForwardFault>) -> Self {
        RemoteRecoverer { peer, gateway }
    }
}

impl Actor for RemoteRecoverer {
    type Context = Context<Self>;
}

impl Supervised for RemoteRecoverer {}

impl Handler<Recover> for RemoteRecoverer {
    type Result = DeferredAnswer;

    fn handle(&mut self, message: Recover, _: &mut Context<Self>) -> DeferredAnswer {
        let payload = encode(message.fault, platform::now());
        let (confirm, confirmed) = oneshot::channel();
        self.gateway.do_send(ForwardFault { peer: self.peer, payload, confirm });
        DeferredAnswer(confirmed)
    }
}

/// An answer that comes later. If it does not come, the asker's request fails instead of waiting.
pub(super) struct DeferredAnswer(oneshot::Receiver<Confirmed>);

impl MessageResponse<RemoteRecoverer, Recover> for DeferredAnswer {
    fn handle(self, _: &mut Context<RemoteRecoverer>, answer: Option<OneshotSender<Confirmed>>) {
        actix_rt::spawn(async move {
            if let (Ok(confirmed), Some(answer)) = (self.0.await, answer) {
                // The caller may have stopped waiting.
                let _ = answer.send(confirmed);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::NodeName;

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
