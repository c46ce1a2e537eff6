//! The history of faults, as it happens.

use super::NodeState;
use crate::fault_chain::detection::DetectionActor;
use actix::prelude::*;
use blastema_contract::detector::{FaultEvent, Subscribe};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use tokio::sync::{mpsc, watch};

/// Steps that a slow reader may be behind: a storm of a few seconds at the notifier's own limit.
const BACKLOG: usize = 1024;

/// Every step in the history of every fault of a node, in order. From
/// [`NodeBuilder::fault_events`], with the faults of the start, or from [`Node::fault_events`],
/// from then on.
///
/// [`NodeBuilder::fault_events`]: crate::NodeBuilder::fault_events
/// [`Node::fault_events`]: crate::Node::fault_events
#[derive(Debug)]
pub struct FaultEvents {
    events: mpsc::Receiver<FaultEvent>,
    missed: Arc<AtomicU64>,
    state: watch::Receiver<NodeState>,
}

/// Lives as long as the detector knows it and the reader exists.
#[derive(Debug)]
pub(super) struct FaultListener {
    events: mpsc::Sender<FaultEvent>,
    missed: Arc<AtomicU64>,
}

impl FaultListener {
    pub(super) fn listen(self, detector: &Addr<DetectionActor>) {
        detector.do_send(Subscribe(self.start().recipient()));
    }
}

impl Actor for FaultListener {
    type Context = Context<Self>;
}

impl Handler<FaultEvent> for FaultListener {
    type Result = ();

    fn handle(&mut self, event: FaultEvent, context: &mut Context<Self>) {
        match self.events.try_send(event) {
            Ok(()) => {}
            Err(mpsc::error::TrySendError::Full(_)) => {
                self.missed.fetch_add(1, Relaxed);
            }
            // The mailbox closes with it, so that the detector forgets it.
            Err(mpsc::error::TrySendError::Closed(_)) => context.stop(),
        }
    }
}

impl FaultEvents {
    /// Events of a node in this state, and who is to hear them.
    pub(super) fn open(state: watch::Receiver<NodeState>) -> (Self, FaultListener) {
        let (sender, events) = mpsc::channel(BACKLOG);
        let missed = Arc::new(AtomicU64::new(0));
        let listener = FaultListener { events: sender, missed: missed.clone() };
        (FaultEvents { events, missed, state }, listener)
    }

    pub(super) fn subscribe(
        detector: &Addr<DetectionActor>,
        state: watch::Receiver<NodeState>,
    ) -> Self {
        let (events, listener) = FaultEvents::open(state);
        listener.listen(detector);
        events
    }

    /// Returns the next step; `None` once the node was shut down and all earlier steps have been
    /// fetched.
    pub async fn next(&mut self) -> Option<FaultEvent> {
        let FaultEvents { events, state, .. } = self;
        tokio::select! {
            biased;
            event = events.recv() => event,
            // Also if the sender of the state was dropped.
            _ = state.wait_for(|state| *state == NodeState::Stopped) => events.try_recv().ok(),
        }
    }

    /// How many steps were dropped because they were not fetched in time.
    pub fn missed(&self) -> u64 {
        self.missed.load(Relaxed)
    }
}
