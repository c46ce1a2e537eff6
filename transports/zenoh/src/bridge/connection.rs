//! What opens a bridge's client of Zenoh, and says how it is connected.

use crate::client::{ZenohClient, ZenohOpened, ZenohState};
use blastema::prelude::*;
use std::sync::Arc;
use std::time::Duration;

/// How often it looks how the client is connected.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Opens the client in each incarnation, and closes it at the end of one.
///
/// No router is *unavailable*, at the start and later: Zenoh connects again by itself, and the
/// topics of the robot go on meanwhile.
pub(crate) struct ZenohConnection {
    client: Arc<ZenohClient>,
    opened: Option<ZenohOpened>,
    is_lost: bool,
}

impl ZenohConnection {
    pub(crate) fn new(client: Arc<ZenohClient>) -> Self {
        ZenohConnection { client, opened: None, is_lost: false }
    }

    /// Reports each change.
    fn look(&mut self, cx: &mut Context<Self>) {
        match self.client.present_state() {
            ZenohState::Lost if !self.is_lost => {
                let places = self.client.places();
                let detail = format!(
                    "Zenoh at {places}: the connection is lost: is the router running, and \
                     reachable? It is connected again when it is"
                );
                cx.declare_fault(FaultKind::Unavailable, detail);
                self.is_lost = true;
            }
            ZenohState::Connected if self.is_lost => {
                cx.clear_fault(FaultKind::Unavailable);
                self.is_lost = false;
            }
            _ => {}
        }
    }
}

impl Component for ZenohConnection {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        let mut state = self.client.state();
        self.opened = Some(self.client.open()?);
        let is_done = |state: &ZenohState| *state != ZenohState::Opening;
        // It lives as long as the client, which is ours.
        let state = state.wait_for(is_done).await.map(|state| state.clone());
        match state {
            Ok(ZenohState::Failed(why)) => {
                let places = self.client.places();
                Err(Failure::unavailable(format!("Zenoh at {places}: {why}")))
            }
            _ => Ok(()),
        }
    }

    async fn on_startup(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.every(LOOK_EVERY, Self::look);
        Ok(())
    }

    async fn on_finalize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.opened = None;
        Ok(())
    }
}
