//! Connections that carry frames with their length before them, a stream for each peer, over
//! whatever makes streams: TCP, Unix-domain sockets.
//!
//! A transport listens and connects in one. A peer is known by the address at which *it* listens,
//! whichever of the two made the connection: the one that connects says so first ([`framing`]). The
//! first frame to a peer makes the connection; frames wait for it, within bounds, and are dropped
//! in the pause after it failed or broke.
//!
//! * **One connection per peer.** When two nodes dial each other at the same time, the call of the
//!   smaller address counts. A peer that dials while we believe to be connected has lost the
//!   connection, or was restarted: the new one replaces the old.
//! * **Strangers**, who have connected and said nothing yet, have places of their own, of which the
//!   oldest is given up when all are taken. So silent connections keep no peer out.

mod outgoing;
mod peer;

pub mod framing;

use self::peer::{ConnectionState, DisconnectReason, StreamPeer};
use crate::reopen_backoff::ReopenBackoff;
use crate::upstream::Upstream;
use blastema_contract::transport::{MediumAddress, Transmit, TransportReport};
use bytes::BytesMut;
use bytes::buf::Limit;
use std::collections::{BTreeSet, VecDeque};
use std::fmt::Debug;
use std::future::Future;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{self, Poll};
use std::time::Duration;
use tokio::time::Sleep;

/// So many connections the kernel holds until we take them.
pub(crate) const BACKLOG: i32 = 128;
/// So many connections are taken in one turn.
const ACCEPTS: usize = 16;
/// So many different reasons why a peer is not permitted are logged, each once: a process that is
/// refused may try again for ever.
const DENIALS_LOGGED: usize = 64;
/// How long no connection is taken after one could not be, for want of file descriptors mostly.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// A handshake under way.
pub(crate) type HandshakeFuture<T> = Pin<Box<dyn Future<Output = io::Result<T>>>>;

/// A connection, as tokio's streams are.
pub(crate) trait ByteStream: 'static {
    /// Reads so many bytes at most.
    fn try_read_buf(&self, buffer: &mut Limit<&mut BytesMut>) -> io::Result<usize>;
    fn try_write_vectored(&self, slices: &[IoSlice<'_>]) -> io::Result<usize>;
    fn poll_read_ready(&self, task: &mut task::Context<'_>) -> Poll<io::Result<()>>;
    fn poll_write_ready(&self, task: &mut task::Context<'_>) -> Poll<io::Result<()>>;
}

macro_rules! byte_stream {
    ($stream:ty) => {
        impl crate::stream::ByteStream for $stream {
            fn try_read_buf(
                &self,
                buffer: &mut bytes::buf::Limit<&mut bytes::BytesMut>,
            ) -> std::io::Result<usize> {
                <$stream>::try_read_buf(self, buffer)
            }

            fn try_write_vectored(
                &self,
                slices: &[std::io::IoSlice<'_>],
            ) -> std::io::Result<usize> {
                <$stream>::try_write_vectored(self, slices)
            }

            fn poll_read_ready(
                &self,
                task: &mut std::task::Context<'_>,
            ) -> std::task::Poll<std::io::Result<()>> {
                <$stream>::poll_read_ready(self, task)
            }

            fn poll_write_ready(
                &self,
                task: &mut std::task::Context<'_>,
            ) -> std::task::Poll<std::io::Result<()>> {
                <$stream>::poll_write_ready(self, task)
            }
        }
    };
}

pub(crate) use byte_stream;

/// What makes streams.
pub(crate) trait StreamFamily: 'static {
    /// A connection.
    type Stream: ByteStream;
    /// Takes connections.
    type Listener;
    /// Where a peer listens.
    type Address: Clone + Debug + Ord + Into<MediumAddress>;
    /// What is known of where a connection comes from.
    type Origin: Debug;

    /// How much is held.
    fn bounds(&self) -> StreamLimits;

    /// Opens our own address; an error says what the user may do.
    fn listen(&mut self) -> Result<(Self::Listener, Self::Address), String>;

    /// Takes the next connection.
    fn poll_accept(
        listener: &Self::Listener,
        task: &mut task::Context<'_>,
    ) -> Poll<io::Result<(Self::Stream, Self::Origin)>>;

    /// Connects to a listening peer, and is done when that has kept the connection.
    fn dial(&self, local: &Self::Address, peer: &Self::Address) -> HandshakeFuture<Self::Stream>;

    /// Learns where a node that has connected listens.
    fn greet(
        &self,
        stream: Self::Stream,
        origin: &Self::Origin,
    ) -> HandshakeFuture<(Self::Stream, Self::Address)>;

    /// Says where we listen, which keeps the connection.
    fn introduce(stream: &Self::Stream, local: &Self::Address) -> io::Result<()>;

    /// Ourselves, as the peer at the other end knows us.
    fn ourselves(stream: &Self::Stream, local: &Self::Address) -> io::Result<Self::Address>;

    /// The address as this family has it.
    fn address(address: MediumAddress) -> Option<Self::Address>;

    /// A number that differs between peers, so that they do not come back as one.
    fn seed(address: &Self::Address) -> u64;
}

/// How much a transport holds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StreamLimits {
    pub(crate) mtu: usize,
    pub(crate) peers: usize,
    pub(crate) strangers: usize,
    pub(crate) queue_bytes: usize,
}

/// All connections of one transport.
pub(crate) struct Streams<F: StreamFamily> {
    family: F,
    bounds: StreamLimits,
    pub(crate) outlet: Upstream,
    reopening: ReopenBackoff,
    listener: Option<Listener<F>>,
    strangers: VecDeque<Stranger<F>>,
    peers: Vec<StreamPeer<F>>,
    /// Whose turn to read is first: the one before whom the outlet was full.
    first: usize,
    denials: BTreeSet<String>,
}

struct Listener<F: StreamFamily> {
    socket: F::Listener,
    local: F::Address,
    pause: Option<Pin<Box<Sleep>>>,
}

/// A peer that has connected, and is to say where it listens.
struct Stranger<F: StreamFamily> {
    origin: F::Origin,
    greeting: HandshakeFuture<(F::Stream, F::Address)>,
}

impl<F: StreamFamily> Streams<F> {
    pub(crate) fn new(family: F) -> Self {
        Streams {
            bounds: family.bounds(),
            family,
            outlet: Upstream::default(),
            reopening: ReopenBackoff::default(),
            listener: None,
            strangers: VecDeque::new(),
            peers: Vec::new(),
            first: 0,
            denials: BTreeSet::new(),
        }
    }

    fn try_open(&mut self) {
        match self.family.listen() {
            Ok((socket, local)) => {
                self.reopening.reset();
                self.listener = Some(Listener { socket, local: local.clone(), pause: None });
                let (local, mtu) = (local.into(), self.bounds.mtu);
                self.outlet.announce(TransportReport::Opened { local, mtu });
            }
            Err(reason) => {
                self.reopening.failed();
                self.outlet.announce_closed(reason);
            }
        }
    }

    /// Takes new connections; each is a stranger at first.
    fn accept(&mut self, task: &mut task::Context<'_>) {
        let Some(Listener { socket, pause, .. }) = &mut self.listener else { return };
        if let Some(sleep) = pause {
            if sleep.as_mut().poll(task).is_pending() {
                return;
            }
            *pause = None;
        }
        for _ in 0..ACCEPTS {
            match F::poll_accept(socket, task) {
                Poll::Ready(Ok((stream, origin))) => {
                    if self.strangers.len() >= self.bounds.strangers {
                        self.strangers.pop_front();
                        self.outlet.counters.refused += 1;
                    }
                    let greeting = self.family.greet(stream, &origin);
                    self.strangers.push_back(Stranger { origin, greeting });
                }
                Poll::Ready(Err(error)) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Poll::Ready(Err(_)) => {
                    self.outlet.counters.errors += 1;
                    *pause = Some(Box::pin(tokio::time::sleep(ACCEPT_PAUSE)));
                    break;
                }
                Poll::Pending => return,
            }
        }
        task.waker().wake_by_ref();
    }

    /// Hears what strangers say, and gives them a peer's place.
    fn meet(&mut self, task: &mut task::Context<'_>) {
        let mut met = Vec::new();
        let (counters, denials) = (&mut self.outlet.counters, &mut self.denials);
        self.strangers.retain_mut(|stranger| match stranger.greeting.as_mut().poll(task) {
            Poll::Ready(Ok((stream, address))) => {
                met.push((address, stream));
                false
            }
            Poll::Ready(Err(error)) => {
                tracing::debug!(%error, from = ?stranger.origin, "a connection came to nothing");
                log_denial(denials, &error);
                match error.kind() {
                    // Who hangs up has thought better of it: he was called meanwhile, perhaps.
                    io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => {
                        counters.errors += 1;
                    }
                    _ => counters.refused += 1,
                }
                false
            }
            Poll::Pending => true,
        });
        for (address, stream) in met {
            if !self.admit(address, stream) {
                self.outlet.counters.refused += 1;
            }
        }
    }

    /// Says whether the connection is a good one, whether or not it is needed.
    fn admit(&mut self, address: F::Address, stream: F::Stream) -> bool {
        let Some(listener) = &self.listener else { return false };
        let Ok(local) = F::ourselves(&stream, &listener.local) else { return false };
        if address == local {
            return false;
        }
        let Some(index) = self.place(&address) else { return false };
        let peer = &mut self.peers[index];
        if matches!(peer.state, ConnectionState::Dialing(_)) && local < address {
            // Both dial at once; our call counts, and the peer's transport thinks so too.
            return true;
        }
        if F::introduce(&stream, &local).is_err() {
            return false;
        }
        if peer.is_connected() {
            self.outlet.report(TransportReport::PeerLost { peer: address.into() });
        }
        peer.adopt(stream);
        true
    }

    /// The peer's place among the peers; there may be none left.
    fn place(&mut self, address: &F::Address) -> Option<usize> {
        if let Some(index) = self.peers.iter().position(|peer| peer.address == *address) {
            return Some(index);
        }
        if self.peers.len() < self.bounds.peers {
            self.peers.push(StreamPeer::new(address.clone()));
            return Some(self.peers.len() - 1);
        }
        let index = self.peers.iter().position(StreamPeer::is_dispensable)?;
        self.peers[index] = StreamPeer::new(address.clone());
        Some(index)
    }

    /// Ends what broke, and looks after what has come about.
    fn carry_on(&mut self, task: &mut task::Context<'_>) {
        for index in 0..self.peers.len() {
            let peer = &mut self.peers[index];
            if let Err(error) = peer.poll_progress(task) {
                tracing::debug!(%error, peer = ?peer.address, "a peer cannot be reached");
                log_denial(&mut self.denials, &error);
                self.outlet.counters.errors += 1;
                self.outlet.counters.dropped += peer.rest();
                task.waker().wake_by_ref();
            } else if let Err(broken) = peer.write(task, &mut self.outlet) {
                self.lose(index, broken, task);
            }
        }
    }

    fn read(&mut self, task: &mut task::Context<'_>) {
        for offset in 0..self.peers.len() {
            let index = (self.first + offset) % self.peers.len();
            match self.peers[index].read(task, self.bounds.mtu, &mut self.outlet) {
                Ok(false) => {}
                Ok(true) => {
                    self.first = index;
                    return;
                }
                Err(broken) => self.lose(index, broken, task),
            }
        }
    }

    fn lose(&mut self, index: usize, broken: DisconnectReason, task: &mut task::Context<'_>) {
        let peer = &mut self.peers[index];
        match broken {
            DisconnectReason::Lost => self.outlet.counters.errors += 1,
            DisconnectReason::Refused => self.outlet.counters.refused += 1,
        }
        self.outlet.counters.dropped += peer.rest();
        self.outlet.report(TransportReport::PeerLost { peer: peer.address.clone().into() });
        // The pause that has begun was not polled yet.
        task.waker().wake_by_ref();
    }

    pub(crate) fn open(&mut self) {
        self.reopening.reset();
        self.try_open();
    }

    pub(crate) fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame, lane } = message;
        let Some(to) = F::address(to) else {
            self.outlet.counters.refused += 1;
            return;
        };
        if frame.len() > self.bounds.mtu {
            self.outlet.counters.refused += 1;
            return;
        }
        let local = self.listener.as_ref().map(|listener| listener.local.clone());
        let (Some(local), Some(index)) = (local.filter(|local| *local != to), self.place(&to))
        else {
            self.outlet.counters.dropped += 1;
            return;
        };
        let peer = &mut self.peers[index];
        if matches!(peer.state, ConnectionState::Absent) {
            peer.state = ConnectionState::Dialing(self.family.dial(&local, &to));
        }
        let resting = matches!(peer.state, ConnectionState::Backoff(_));
        if resting || !peer.outgoing.push(lane, frame, self.bounds.queue_bytes) {
            self.outlet.counters.dropped += 1;
        }
    }

    pub(crate) fn pump(&mut self, task: &mut task::Context<'_>) {
        while self.listener.is_none() {
            if self.reopening.poll_due(task).is_pending() {
                return;
            }
            self.try_open();
        }
        self.accept(task);
        self.meet(task);
        self.carry_on(task);
        self.read(task);
    }

    pub(crate) fn shut(&mut self) {
        self.listener = None;
        self.strangers.clear();
        for mut peer in self.peers.drain(..) {
            self.outlet.counters.dropped += peer.outgoing.clear();
        }
        self.first = 0;
    }
}

/// A peer is not permitted, or this process is not: a user must act.
fn log_denial(denials: &mut BTreeSet<String>, error: &io::Error) {
    if error.kind() == io::ErrorKind::PermissionDenied && denials.len() < DENIALS_LOGGED {
        let text = error.to_string();
        if !denials.contains(&text) {
            tracing::warn!("{text}");
            denials.insert(text);
        }
    }
}
