//! What opens a bridge's client of Zenoh, and says how it is connected.

use crate::component::cell::ComponentCell;
use crate::component::context::Context;
use crate::component::{Component, Failure};
use blastema_core::FaultKind;
use blastema_transports::{ZenohClient, ZenohOpened, ZenohState};
use std::sync::Arc;
use tokio::sync::watch;

/// Opens the client in each incarnation, and closes it at the end of one.
///
/// No router is *unavailable*, at the start and later: Zenoh connects again by itself, and the
/// topics of the robot go on meanwhile.
pub(crate) struct ZenohConnection {
    client: Arc<ZenohClient>,
    opened: Option<ZenohOpened>,
}

impl ZenohConnection {
    pub(crate) fn new(client: Arc<ZenohClient>) -> Self {
        ZenohConnection { client, opened: None }
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
        let cell = cx.cell.clone();
        cx.spawn(follow(self.client.state(), cell, self.client.places()));
        Ok(())
    }

    async fn on_finalize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.opened = None;
        Ok(())
    }
}

/// Reports each change.
async fn follow(
    mut state: watch::Receiver<ZenohState>,
    cell: Arc<ComponentCell<ZenohConnection>>,
    places: String,
) {
    let mut is_lost = false;
    loop {
        let now = state.borrow_and_update().clone();
        match now {
            ZenohState::Lost if !is_lost => {
                let detail = format!(
                    "Zenoh at {places}: the connection is lost: is the router running, and \
                     reachable? It is connected again when it is"
                );
                cell.record.declare(FaultKind::Unavailable, detail);
                is_lost = true;
            }
            ZenohState::Connected if is_lost => {
                cell.record.clear(FaultKind::Unavailable);
                is_lost = false;
            }
            _ => {}
        }
        if state.changed().await.is_err() {
            return;
        }
    }
}
