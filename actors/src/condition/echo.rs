//! Round trips to other nodes: each node answers the echo requests of the others.
//!
//! A session measures a round trip only while it sends; a robot that only listens would know none.

use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform::{self, lock};
use crate::registry::Registry;
use crate::registry::access::MessageOrigin;
use blastema_core::connection::RoundTripEstimator;
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, NodeName};
use blastema_macros::Request;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Under which name nodes ask each other. It is no object that others can see.
const OBJECT: &str = "net/echo";
/// How often a node is asked. More often finds a slow path sooner, and loads it.
const ECHO_INTERVAL: Duration = Duration::from_millis(500);
/// Ten round trips by satellite.
const ECHO_TIMEOUT: Duration = Duration::from_secs(10);

/// Asks for an answer, and for nothing else.
#[derive(Clone, Copy, Debug, Request)]
#[contract(crate = "crate", name = "blastema/echo", version = 1, reply = ())]
struct RoundTripEcho;

/// Answers other nodes.
pub(super) fn serve(registry: &Registry) {
    let serve = |_, _: MessageOrigin, responder: Responder<RoundTripEcho>| responder.give(());
    registry.serve_hidden(OBJECT, serve);
}

/// The round trips to the nodes whose latency a condition limits: as many as conditions name.
#[derive(Default)]
pub(super) struct RoundTrips(SortedMap<NodeName, EchoedNode>);

/// One node that is asked.
#[derive(Default)]
struct EchoedNode {
    sender: Option<Sender<RoundTripEcho>>,
    trips: Arc<Mutex<RoundTripEstimator>>,
    next_at: Instant,
}

impl RoundTrips {
    /// What is known of the round trips to this node, which is asked again when it is time.
    pub(super) fn to(
        &mut self,
        node: &NodeName,
        registry: &Registry,
        now: Instant,
    ) -> RoundTripEstimator {
        let echoed = match self.0.get_mut(node) {
            Some(echoed) => echoed,
            None => self.0.entry(node.clone()).or_default(),
        };
        if now >= echoed.next_at {
            echoed.next_at = now + ECHO_INTERVAL;
            echoed.ask(node, registry, now);
        }
        *lock(&echoed.trips)
    }
}

impl EchoedNode {
    /// Asks the node, unless it still owes an answer.
    fn ask(&mut self, node: &NodeName, registry: &Registry, now: Instant) {
        if Arc::strong_count(&self.trips) > 1 {
            return;
        }
        if self.sender.is_none() {
            self.sender = registry.sender(&format!("{node}:{OBJECT}")).ok();
        }
        let Some(sender) = self.sender.clone() else { return };
        lock(&self.trips).handle_asked(now);
        let trips = self.trips.clone();
        actix_rt::spawn(async move {
            match sender.ask_within(RoundTripEcho, ECHO_TIMEOUT).await {
                Ok(()) => lock(&trips).handle_answer(platform::now()),
                Err(_) => lock(&trips).handle_failed(),
            }
        });
    }
}
