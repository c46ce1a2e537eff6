//! The window: a socket in the file system at which other processes of the machine see the node.
//!
//! Whoever connects is given one [`Picture`](super::Picture) as JSON, and the end. Nothing is read, so that
//! nothing can be asked or done there. It stays open at safe rest, and closes with the node.

use super::{Node, NodeState, Shared};
use crate::guardian::answers_the_monitor;
use actix::prelude::*;
use blastema_transports::unix::{PathListener, explain};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::sync::watch;
use tracing::{debug, warn};

/// Its owner's processes may look, nobody else's.
const MODE: u32 = 0o600;
/// One is served after the other, each for so long at most.
const PATIENCE: Duration = Duration::from_secs(5);
/// After so long a machine that had no descriptor left may have one again.
const PAUSE: Duration = Duration::from_millis(10);

/// Shows the node, once there is one.
pub(super) struct Window {
    path: Arc<Path>,
    node: Weak<Shared>,
    state: watch::Receiver<NodeState>,
}

/// The node can be seen from now on. Answers why nobody can listen there, and what to do.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub(super) struct Show(Weak<Shared>);

impl Show {
    pub(super) fn node(node: &Node) -> Self {
        Show(Arc::downgrade(&node.0))
    }
}

impl Window {
    pub(super) fn new(path: PathBuf, state: watch::Receiver<NodeState>) -> Self {
        Window { path: path.into(), node: Weak::new(), state }
    }

    fn open(&self, context: &mut Context<Self>) -> Result<(), String> {
        let listener = PathListener::open(&self.path, MODE);
        let listener = listener.map_err(|error| explain(&self.path, &error))?;
        let (node, mut state) = (self.node.clone(), self.state.clone());
        let showing = async move {
            tokio::select! {
                () = serve(&listener, &node) => {}
                // Also where nobody is left who could say so.
                _ = state.wait_for(|state| *state == NodeState::Stopped) => {}
            }
        };
        context.spawn(showing.into_actor(self));
        Ok(())
    }
}

async fn serve(listener: &PathListener, node: &Weak<Shared>) {
    loop {
        let Ok(viewer) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        let Some(node) = node.upgrade().map(Node) else { return };
        if tokio::time::timeout(PATIENCE, show_to(viewer, &node)).await.is_err() {
            debug!("somebody looked at the node and did not read");
        }
    }
}

async fn show_to(mut viewer: UnixStream, node: &Node) {
    let picture = node.picture().await.to_json() + "\n";
    // Whoever goes away while it reads has seen enough.
    let _ = viewer.write_all(picture.as_bytes()).await;
}

answers_the_monitor!(Window);

impl Actor for Window {
    type Context = Context<Self>;
}

impl Supervised for Window {
    /// What showed the node went with the panic, and the socket with it.
    fn restarting(&mut self, context: &mut Context<Self>) {
        if let Err(reason) = self.open(context) {
            warn!("the node is not shown any more: {reason}");
        }
    }
}

impl Handler<Show> for Window {
    type Result = Result<(), String>;

    fn handle(&mut self, Show(node): Show, context: &mut Context<Self>) -> Self::Result {
        self.node = node;
        self.open(context)
    }
}
