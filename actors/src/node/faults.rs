//! The history of faults, as it happens.

use super::{Step, Subscriptions};
use actix::prelude::*;
use blastema_contract::detector::{FaultEvent, Subscribe};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use tokio::sync::mpsc;

/// Steps that a slow reader may be behind: a storm of a few seconds at the notifier's own limit.
const BACKLOG: usize = 1024;

/// Every step in the history of every fault of a node, in order. From [`Node::fault_events`].
///
/// [`Node::fault_events`]: crate::Node::fault_events
#[derive(Debug)]
pub struct FaultEvents {
    events: mpsc::Receiver<Step>,
    missed: Arc<AtomicU64>,
    // Its end closes the listener's mailbox, so that the detector forgets it.
    _listener: Addr<Listener>,
}

#[derive(Debug)]
struct Listener {
    events: mpsc::Sender<Step>,
    missed: Arc<AtomicU64>,
}

impl Actor for Listener {
    type Context = Context<Self>;
}

impl Handler<FaultEvent> for Listener {
    type Result = ();

    fn handle(&mut self, event: FaultEvent, _: &mut Context<Self>) {
        if self.events.try_send(event).is_err() {
            self.missed.fetch_add(1, Relaxed);
        }
    }
}

impl FaultEvents {
    pub(super) fn subscribe(detector: &Subscriptions) -> Self {
        let (sender, events) = mpsc::channel(BACKLOG);
        let missed = Arc::new(AtomicU64::new(0));
        let listener = Listener { events: sender, missed: missed.clone() }.start();
        detector.do_send(Subscribe(listener.clone().recipient()));
        FaultEvents { events, missed, _listener: listener }
    }

    /// The next step; `None` once the node has ended.
    pub async fn next(&mut self) -> Option<FaultEvent> {
        self.events.recv().await
    }

    /// How many steps were dropped because they were not fetched in time.
    pub fn missed(&self) -> u64 {
        self.missed.load(Relaxed)
    }
}
