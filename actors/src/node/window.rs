//! The window: a socket in the file system at which other processes of the machine see the node.
//!
//! Whoever connects is given one [`Picture`](super::Picture) as JSON, and the end. Nothing is read, so that
//! nothing can be asked or done there. It stays open at safe rest, and closes with the node.

use super::{Node, NodeState, Shared};
use actix::ArbiterHandle;
use blastema_transports::unix::{PathListener, explain};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::sync::oneshot;
use tracing::debug;

/// Its owner's processes may look, nobody else's.
const MODE: u32 = 0o600;
/// One is served after the other, each for so long at most.
const PATIENCE: Duration = Duration::from_secs(5);

/// Shows the node at this path, on this arbiter or here, until it has stopped.
///
/// # Errors
/// Why nobody can listen there, and what to do.
pub(super) async fn open(
    path: PathBuf,
    node: &Node,
    arbiter: Option<&ArbiterHandle>,
) -> Result<(), String> {
    let (node, mut state) = (Arc::downgrade(&node.0), node.0.state.clone());
    let (told, opened) = oneshot::channel();
    let open = move || {
        let path: Arc<Path> = path.into();
        let listener = PathListener::open(&path, MODE).map_err(|error| explain(&path, &error));
        // The node that waits for it is being started.
        let _ = told.send(listener.map(|listener| {
            actix_rt::spawn(async move {
                tokio::select! {
                    () = serve(&listener, &node) => {}
                    // Also where nobody is left who could say so.
                    _ = state.wait_for(|state| *state == NodeState::Stopped) => {}
                }
            });
        }));
    };
    // A listener belongs to the thread on which it was opened.
    match arbiter {
        Some(arbiter) => drop(arbiter.spawn_fn(open)),
        None => open(),
    }
    opened.await.unwrap_or_else(|_| Err("the fault chain has ended".to_owned()))
}

async fn serve(listener: &PathListener, node: &Weak<Shared>) {
    // A machine that has no descriptor left has some again later.
    let mut pause = tokio::time::interval(Duration::from_millis(10));
    loop {
        pause.tick().await;
        let Ok(viewer) = listener.accept().await else { continue };
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
