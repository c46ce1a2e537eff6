//! What takes a topic out, to a key of Zenoh.

use crate::client::{PutError, ZenohClient};
use blastema::prelude::*;
use std::marker::PhantomData;
use std::sync::Arc;

/// Writes the events of one topic to one key. An event that is not written is a dead letter.
pub(crate) struct ZenohOutlet<E> {
    client: Arc<ZenohClient>,
    /// Which of the client's keys.
    key: usize,
    /// It is known that some events are no JSON.
    complained: bool,
    events: PhantomData<fn(E)>,
}

impl<E: Event> ZenohOutlet<E> {
    pub(crate) fn new(client: Arc<ZenohClient>, key: usize) -> Self {
        ZenohOutlet { client, key, complained: false, events: PhantomData }
    }
}

impl<E: Event> Component for ZenohOutlet<E> {}

impl<E: Event> Handle<E> for ZenohOutlet<E> {
    async fn handle(&mut self, event: E, cx: &mut Context<Self>) {
        let text = match serde_json::to_vec(&event) {
            Ok(text) => text,
            Err(error) => {
                let reason = format!("it cannot be written as JSON: {error}");
                if !std::mem::replace(&mut self.complained, true) {
                    cx.declare_fault(FaultKind::CheckFailed, format!("{}: {reason}", E::NAME));
                }
                let why = DeliveryError::Undecodable { reason };
                return cx.count_undelivered::<E>(&why, 1);
            }
        };
        match self.client.put(self.key, text.into()) {
            Ok(0) => {}
            Ok(lost) => cx.count_undelivered::<E>(&DeliveryError::Full, lost),
            // The client puts it when it is connected.
            Err(PutError::NotConnected) if E::LATCHED => {}
            Err(PutError::NotConnected) => {
                let why = DeliveryError::Unreachable { node: "zenoh".into() };
                cx.count_undelivered::<E>(&why, 1);
            }
        }
    }
}
