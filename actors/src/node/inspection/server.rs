//! What goes on at a window: who comes is shown the node, and a socket that is taken away is made
//! again.

use super::open;
use crate::node::{ComponentOrder, Node, OrderReply, OrderVerb, Shared};
use crate::platform;
use crate::platform::file_lock::HeldHere;
use crate::runtime::reports::FaultReports;
use blastema_core::Machine;
use blastema_core::snapshot_server::{ClientId, SnapshotId, SnapshotServer, SnapshotServerOutput};
use blastema_core::sorted::SortedMap;
use blastema_transports::unix::{AllowedUsers, PathListener, PeerRole};
use futures_util::StreamExt;
use futures_util::future::{AbortHandle, abortable};
use futures_util::stream::FuturesUnordered;
use std::future::{self, Future};
use std::path::Path;
use std::pin::Pin;
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::time::{MissedTickBehavior, interval, sleep, sleep_until, timeout};
use tracing::{info, warn};

/// How often it is looked whether the socket is still there. A look at the folder takes
/// microseconds.
const SOCKET_CHECK_INTERVAL: Duration = Duration::from_millis(500);
/// A client that orders sends its line at once; one that ends its side without a line is shown the
/// node at once, and any other after this.
const ORDER_TIMEOUT: Duration = Duration::from_millis(50);
/// The longest line of an order: names have at most 255 bytes.
const ORDER_BYTES: u64 = 1024;
/// After so long a machine that had no descriptor left may have one again.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(10);

pub(super) struct InspectionServer {
    path: Arc<Path>,
    users: AllowedUsers,
    /// Whether a client was refused. Only the first is logged: it may try again for ever.
    refused: bool,
    node: Weak<Shared>,
    reports: FaultReports,
    /// `None` while the socket cannot be made.
    listener: Option<PathListener>,
    /// Whether the last report was that it cannot; unknown at first, and after a restart.
    reported: Option<bool>,
    machine: SnapshotServer,
    /// Those who are not given their snapshot yet.
    waiting: SortedMap<ClientId, UnixStream>,
    /// Those who are given it: as many as the machine lets in.
    looking: SortedMap<ClientId, AbortHandle>,
    work: FuturesUnordered<Pin<Box<dyn Future<Output = Done>>>>,
    /// Dropped after the socket.
    _held: HeldHere,
}

enum Done {
    Taken { snapshot: SnapshotId, text: Arc<str> },
    Seen(ClientId),
    Closed,
}

impl InspectionServer {
    pub(super) fn new(
        (path, users): (Arc<Path>, AllowedUsers),
        node: Weak<Shared>,
        reports: FaultReports,
        listener: Option<PathListener>,
    ) -> Self {
        InspectionServer {
            _held: HeldHere::new(path.to_path_buf()),
            path,
            users,
            refused: false,
            node,
            reports,
            listener,
            reported: None,
            machine: SnapshotServer::default(),
            waiting: SortedMap::new(),
            looking: SortedMap::new(),
            work: FuturesUnordered::new(),
        }
    }

    /// Ends when the node is gone.
    pub(super) async fn run(mut self) {
        let mut looks = interval(SOCKET_CHECK_INTERVAL);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        while self.carry_out() {
            let due = self.machine.poll_timeout();
            tokio::select! {
                client = accept(self.listener.as_ref()), if self.machine.is_open() => {
                    self.admit(client);
                }
                Some(done) = self.work.next() => self.done(done),
                () = until(due) => self.machine.handle_timeout(platform::now()),
                _ = looks.tick() => self.look_after_the_socket(),
            }
        }
    }

    fn admit(&mut self, client: UnixStream) {
        if let Err(error) = self.users.check(&client, &self.path, PeerRole::Client) {
            if !std::mem::replace(&mut self.refused, true) {
                warn!("a client of the inspection socket is refused: {error}");
            }
            return;
        }
        let number = self.machine.handle_arrival(platform::now());
        self.waiting.insert(number, client);
    }

    /// Answers whether the node is still there.
    fn carry_out(&mut self) -> bool {
        while let Some(output) = self.machine.poll_output() {
            match output {
                SnapshotServerOutput::Take(snapshot) => {
                    let Some(node) = self.node.upgrade().map(Node) else { return false };
                    self.work.push(Box::pin(async move {
                        let text = (node.snapshot().await.to_json() + "\n").into();
                        Done::Taken { snapshot, text }
                    }));
                }
                SnapshotServerOutput::Close(client) => {
                    if let Some(looking) = self.looking.remove(&client) {
                        looking.abort();
                    }
                }
            }
        }
        true
    }

    fn done(&mut self, done: Done) {
        match done {
            Done::Taken { snapshot, text } => {
                for client in self.machine.handle_taken(snapshot, platform::now()) {
                    self.give(client, text.clone());
                }
            }
            Done::Seen(client) => {
                self.looking.remove(&client);
                self.machine.handle_gone(client, platform::now());
            }
            Done::Closed => {}
        }
    }

    fn give(&mut self, client: ClientId, text: Arc<str>) {
        let Some(mut stream) = self.waiting.remove(&client) else { return };
        let node = self.node.clone();
        let (seen, looking) = abortable(async move {
            let reply = match read_order(&mut stream).await {
                Some(order) => Some(carry_out(node, &order).await),
                None => None,
            };
            // A client may disconnect before it has read all.
            let _ = stream.write_all(reply.as_deref().unwrap_or(&text).as_bytes()).await;
            Done::Seen(client)
        });
        self.looking.insert(client, looking);
        self.work.push(Box::pin(async move { seen.await.unwrap_or(Done::Closed) }));
    }

    /// Creates the socket again if it was removed. A failure of that is a fault until it succeeds.
    fn look_after_the_socket(&mut self) {
        if self.listener.as_ref().is_some_and(PathListener::stands) {
            return;
        }
        // Its lock is given back first.
        self.listener = None;
        match open(&self.path) {
            Ok(listener) => {
                info!(path = %self.path.display(), "the inspection socket was removed, and is created again");
                self.listener = Some(listener);
                if self.reported.replace(false) != Some(false) {
                    self.reports.clear("inspection");
                }
            }
            Err(reason) if self.reported.replace(true) != Some(true) => {
                let detail = format!("the node is not shown any more: {reason}");
                self.reports.declare("inspection", detail);
            }
            Err(_) => {}
        }
    }
}

/// The line that a client has sent, unless it only looks.
async fn read_order(stream: &mut UnixStream) -> Option<Vec<u8>> {
    let mut line = Vec::new();
    let mut reader = BufReader::new(stream.take(ORDER_BYTES));
    timeout(ORDER_TIMEOUT, reader.read_until(b'\n', &mut line)).await.ok()?.ok()?;
    line.ends_with(b"\n").then_some(line)
}

/// Carries out an order, and returns the line of the reply.
async fn carry_out(node: Weak<Shared>, order: &[u8]) -> String {
    let order: Result<ComponentOrder, _> = serde_json::from_slice(order);
    let reply = match (order, node.upgrade().map(Node)) {
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

async fn accept(listener: Option<&PathListener>) -> UnixStream {
    let Some(listener) = listener else { return future::pending().await };
    loop {
        match listener.accept().await {
            Ok(client) => return client,
            Err(_) => sleep(ACCEPT_RETRY_DELAY).await,
        }
    }
}

async fn until(due: Option<blastema_core::Instant>) {
    match due {
        Some(due) => sleep_until(platform::timer_at(due)).await,
        None => future::pending().await,
    }
}
