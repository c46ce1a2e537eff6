//! The inspection socket: a Unix socket at which other processes of the machine see the node.
//!
//! A client that connects gets one [snapshot](super::Node::snapshot), and the end of
//! the stream. One that sends a line at once, a [`ComponentOrder`] as JSON, gets the [`OrderReply`]
//! instead. The socket stays open in the safe state, and closes with the node.

use super::{ComponentOrder, Node, NodeState, OrderReply, OrderVerb, Shared};
use crate::platform::file_lock::HeldHere;
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_transports::unix::{AllowedUsers, PathListener, PeerRole, explain};
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use tracing::{info, warn};

/// Processes of the owner may connect, and no others.
const MODE: u32 = 0o600;
/// From a failed attempt to make the socket again to the next.
const RETRY: Duration = Duration::from_secs(5);
/// Root may connect as well. It can read the node's memory and its files in any case.
const ROOT: u32 = 0;
/// Clients that are served at once; further ones wait in the listen backlog, in order. A snapshot
/// of ten thousand components has five megabytes, and lives as long as its client reads it.
const CLIENTS_MAX: usize = 8;
/// A client that reads a large snapshot has read it by then, also on a busy machine.
const READ_TIMEOUT: Duration = Duration::from_secs(1);
/// A client that orders sends its line at once; one that ends its side without a line is shown the
/// node at once, and any other after this.
const ORDER_TIMEOUT: Duration = Duration::from_millis(50);
/// The longest line of an order: names have at most 255 bytes.
const ORDER_BYTES: u64 = 1024;
/// After so long a machine that had no descriptor left may have one again.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(10);

/// Shows the node, once there is one.
pub(super) struct InspectionActor {
    path: Arc<Path>,
    node: Weak<Shared>,
    state: watch::Receiver<NodeState>,
    reports: FaultReports,
}

/// Opens the socket. Returns why that is not possible, and what to do.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub(super) struct StartInspection(Weak<Shared>);

impl StartInspection {
    pub(super) fn node(node: &Node) -> Self {
        StartInspection(Arc::downgrade(&node.0))
    }
}

impl InspectionActor {
    pub(super) fn new(
        path: PathBuf,
        state: watch::Receiver<NodeState>,
        reports: FaultReports,
    ) -> Self {
        InspectionActor { path: path.into(), node: Weak::new(), state, reports }
    }

    /// Makes the socket, and serves it until the node has stopped.
    ///
    /// # Errors
    /// Why that is not possible, and what helps.
    fn show(&self, context: &mut Context<Self>) -> Result<(), String> {
        let listener = PathListener::open(&self.path, MODE);
        let socket = InspectionSocket {
            listener: listener.map_err(|error| explain(&self.path, &error))?,
            path: self.path.clone(),
            refused: false,
            _held: HeldHere::new(self.path.to_path_buf()),
        };
        let (node, mut state) = (self.node.clone(), self.state.clone());
        let until_the_end = async move {
            tokio::select! {
                () = socket.serve(&node) => {}
                // Also if the sender of the state was dropped.
                _ = state.wait_for(|state| *state == NodeState::Stopped) => {}
            }
        };
        context.spawn(until_the_end.into_actor(self));
        Ok(())
    }
}

impl InspectionActor {
    /// Makes the socket after a panic; what hinders that is a fault until it is over.
    fn show_again(&mut self, context: &mut Context<Self>) {
        match self.show(context) {
            Ok(()) => self.reports.clear("inspection"),
            Err(reason) => {
                let detail = format!("the node is not shown any more: {reason}");
                self.reports.declare("inspection", detail);
                context.run_later(RETRY, |actor, context| actor.show_again(context));
            }
        }
    }
}

answers_the_monitor!(InspectionActor);

impl Actor for InspectionActor {
    type Context = Context<Self>;
}

impl Supervised for InspectionActor {
    /// What showed the node went with the panic, and the socket with it: it is made again.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.show_again(context);
    }
}

impl Handler<StartInspection> for InspectionActor {
    type Result = Result<(), String>;

    fn handle(
        &mut self,
        StartInspection(node): StartInspection,
        context: &mut Context<Self>,
    ) -> Self::Result {
        self.node = node;
        self.show(context)
    }
}

/// The socket while it is served.
struct InspectionSocket {
    listener: PathListener,
    path: Arc<Path>,
    /// Whether a client was refused. Only the first is logged: it may try again for ever.
    refused: bool,
    /// Dropped after the socket.
    _held: HeldHere,
}

impl InspectionSocket {
    async fn serve(mut self, node: &Weak<Shared>) {
        let mut clients = FuturesUnordered::new();
        loop {
            tokio::select! {
                client = self.listener.accept(), if clients.len() < CLIENTS_MAX => match client {
                    Ok(client) if self.is_allowed(&client) => clients.push(answer(client, node)),
                    Ok(_) => {}
                    Err(_) => sleep(ACCEPT_RETRY_DELAY).await,
                },
                Some(()) = clients.next() => {}
            }
        }
    }

    fn is_allowed(&mut self, client: &UnixStream) -> bool {
        let allowed = AllowedUsers::new(&[ROOT]).check(client, &self.path, PeerRole::Client);
        if let Err(error) = &allowed
            && !std::mem::replace(&mut self.refused, true)
        {
            warn!("a client of the inspection socket is refused: {error}");
        }
        allowed.is_ok()
    }
}

/// Gives a client the snapshot, or carries out its order.
async fn answer(mut client: UnixStream, node: &Weak<Shared>) {
    let order = read_order(&mut client).await;
    let text = match (order, node.upgrade().map(Node)) {
        (Some(order), node) => carry_out(node, &order).await,
        (None, Some(node)) => node.snapshot().await + "\n",
        (None, None) => return,
    };
    // A client may disconnect before it has read all.
    let _ = timeout(READ_TIMEOUT, client.write_all(text.as_bytes())).await;
}

/// The line that a client has sent, unless it only looks.
async fn read_order(stream: &mut UnixStream) -> Option<Vec<u8>> {
    let mut line = Vec::new();
    let mut reader = BufReader::new(stream.take(ORDER_BYTES));
    timeout(ORDER_TIMEOUT, reader.read_until(b'\n', &mut line)).await.ok()?.ok()?;
    line.ends_with(b"\n").then_some(line)
}

/// Carries out an order, and returns the line of the reply.
async fn carry_out(node: Option<Node>, order: &[u8]) -> String {
    let order: Result<ComponentOrder, _> = serde_json::from_slice(order);
    let reply = match (order, node) {
        (Ok(order), Some(node)) => {
            if order.verb != OrderVerb::List {
                info!(target: "blastema::audit", name = ?order.name, "a local user orders: {:?}", order.verb);
            }
            node.order(&order).await
        }
        (Ok(_), None) => OrderReply::refused("the node was shut down"),
        (Err(error), _) => OrderReply::refused(&format!("this is no order: {error}")),
    };
    serde_json::to_string(&reply).unwrap_or_default() + "\n"
}
