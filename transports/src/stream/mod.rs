//! Connections that carry frames with their length before them, a stream for each peer, over
//! whatever makes streams: TCP, Unix-domain sockets.
//!
//! A transport listens and connects in one. A peer is known by the address at which *it* listens,
//! whichever of the two made the connection: the one that connects says so first ([`framing`]). The
//! first frame to a peer makes the connection; frames wait for it, within bounds, and are dropped
//! in the pause after it failed or broke.
//!
//! * **One connection per peer**, which depends on what connections are worth to the receiver
//!   ([`ConnectionTrust`]):
//!   * *Claimed.* When two nodes dial each other at the same time, the call of the smaller address
//!     counts. A peer that dials while we believe to be connected has lost the connection, or was
//!     restarted: the new one replaces the old. So any process that reaches the address can take a
//!     peer's place: 8 bytes suffice.
//!   * *Proven.* A connection that another node makes is unproven, whatever it claims, and replaces
//!     nothing until the receiver adopts it. Its frames come from the connection, not from a peer;
//!     16 of them, of 128 bytes at most, are read before it is adopted. When two nodes dial each
//!     other at the same time, both connections stand until the receivers adopt one; both must
//!     adopt the same.
//! * **Strangers**, who have connected and are no peers yet, have places of their own, of which the
//!   oldest is given up when all are taken, and each of which is lost after the hello timeout. So
//!   silent connections keep no peer out. Peers are read first, strangers with a small budget for
//!   all of them.

mod connection;
mod outgoing;
mod peer;
mod stranger;

pub mod framing;

use self::connection::{DisconnectReason, ReadEnd};
use self::peer::{ConnectionState, StreamPeer};
use self::stranger::{Greeting, Stranger, UnprovenConnection};
use crate::descriptors::DescriptorWarning;
use crate::endpoint::StreamLimits;
use crate::medium::{MediumActor, PollBudget, transport};
use crate::medium_timer::MediumTimer;
use crate::reopen_backoff::ReopenBackoff;
use crate::upstream::Upstream;
use actix::Context;
use blastema_contract::transport::{
    Adopt, Attach, ConnectionTrust, MediumAddress, Transmit, TransmitBacklog, TransportReport,
};
use blastema_core::GatherBuffer;
use blastema_core::medium::lane::FrameLane;
use std::collections::{BTreeSet, VecDeque};
use std::fmt::Debug;
use std::hash::Hash;
use std::io;
use std::pin::Pin;
use std::task::{self, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite};

/// So many connections the kernel holds until we take them.
pub(crate) const BACKLOG: i32 = 128;
/// So many connections are taken in one turn.
const ACCEPTS: usize = 16;
/// So many frames, or parts of them, are read in one turn from all unproven connections together: a
/// quarter of what one peer may send.
const UNPROVEN_READS: usize = 16;
/// So many different reasons why a peer is not permitted are logged, each once: a process that is
/// refused may try again for ever.
const DENIALS_LOGGED: usize = 64;
/// How long no connection is taken after one could not be, for want of file descriptors mostly.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// A handshake under way.
pub(crate) type HandshakeFuture<T> = Pin<Box<dyn Future<Output = io::Result<T>>>>;

/// What makes streams.
pub trait StreamFamily: 'static {
    /// A connection.
    type Stream: AsyncRead + AsyncWrite + Unpin + 'static;
    /// What takes connections.
    type Listener;
    /// Where a peer listens.
    type Address: Clone + Debug + Hash + Ord + Into<MediumAddress>;
    /// What is known of where a connection comes from.
    type Origin: Debug;

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
}

/// All connections of one transport.
pub struct Streams<F: StreamFamily> {
    family: F,
    limits: StreamLimits,
    upstream: Upstream,
    reopening: ReopenBackoff,
    listener: Option<Listener<F>>,
    /// The oldest first.
    strangers: VecDeque<Stranger<F>>,
    /// How many connections were unproven so far.
    numbered: u32,
    peers: Vec<StreamPeer<F>>,
    /// Whose turn to read is first: the peer before whom the upstream was full, or behind the last
    /// peer the strangers.
    first: usize,
    denials: BTreeSet<String>,
    descriptors: DescriptorWarning,
}

struct Listener<F: StreamFamily> {
    socket: F::Listener,
    local: F::Address,
    pause: MediumTimer,
}

impl<F: StreamFamily> Streams<F> {
    pub(crate) fn over(family: F, limits: StreamLimits) -> Self {
        Streams {
            limits,
            family,
            upstream: Upstream::default(),
            reopening: ReopenBackoff::default(),
            listener: None,
            strangers: VecDeque::new(),
            numbered: 0,
            peers: Vec::new(),
            first: 0,
            denials: BTreeSet::new(),
            descriptors: DescriptorWarning::default(),
        }
    }

    fn try_open(&mut self) {
        match self.family.listen() {
            Ok((socket, local)) => {
                self.reopening.reset();
                let pause = MediumTimer::default();
                self.listener = Some(Listener { socket, local: local.clone(), pause });
                let (local, mtu, is_probed) = (local.into(), self.limits.mtu, false);
                self.upstream.announce(TransportReport::Opened { local, mtu, is_probed });
            }
            Err(reason) => {
                self.reopening.failed();
                self.upstream.announce_closed(reason);
            }
        }
    }

    /// Takes new connections; each is a stranger at first.
    fn accept(&mut self, task: &mut task::Context<'_>) {
        let Some(Listener { socket, local, pause }) = &mut self.listener else { return };
        if pause.poll(task).is_pending() {
            return;
        }
        for _ in 0..ACCEPTS {
            match F::poll_accept(socket, task) {
                Poll::Ready(Ok((stream, origin))) => {
                    let said = self.family.greet(stream, &origin);
                    if self.strangers.len() >= self.limits.strangers {
                        let oldest = self.strangers.pop_front();
                        self.upstream.counters.dropped += oldest.map_or(0, Stranger::abandon);
                        self.upstream.counters.refused += 1;
                    }
                    self.strangers.push_back(Stranger::Greeting(Greeting { origin, said }));
                }
                Poll::Ready(Err(error)) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Poll::Ready(Err(error)) => {
                    self.upstream.counters.errors += 1;
                    let local: MediumAddress = local.clone().into();
                    let what = format_args!("no connection to {local} can be accepted");
                    self.descriptors.warn(what, &error, task);
                    *pause = MediumTimer::after(ACCEPT_PAUSE);
                    break;
                }
                Poll::Pending => return,
            }
        }
        task.waker().wake_by_ref();
    }

    /// Hears where strangers listen, and ends what takes them too long.
    fn meet(&mut self, task: &mut task::Context<'_>) {
        for _ in 0..self.strangers.len() {
            let Some(stranger) = self.strangers.pop_front() else { return };
            let met = match stranger {
                Stranger::Greeting(greeting) => self.greet(greeting, task),
                unproven @ Stranger::Unproven(_) => Some(unproven),
            };
            match met {
                Some(Stranger::Unproven(mut unproven)) => {
                    match unproven.poll(task, &mut self.upstream) {
                        Ok(()) => self.strangers.push_back(Stranger::Unproven(unproven)),
                        Err(reason) => self.give_up(unproven, reason),
                    }
                }
                greeting => self.strangers.extend(greeting),
            }
        }
    }

    /// Hears where a stranger listens; the answer is what it is then, if no peer.
    fn greet(
        &mut self,
        mut greeting: Greeting<F>,
        task: &mut task::Context<'_>,
    ) -> Option<Stranger<F>> {
        let Poll::Ready(said) = greeting.said.as_mut().poll(task) else {
            return Some(Stranger::Greeting(greeting));
        };
        match said {
            Ok((stream, address)) => {
                let admitted = match self.upstream.connections() {
                    ConnectionTrust::Claimed => self.admit(address, stream).map(|()| None),
                    ConnectionTrust::Proven => self.admit_unproven(address, stream).map(Some),
                };
                self.upstream.counters.refused += u64::from(admitted.is_none());
                admitted.flatten()
            }
            Err(error) => {
                tracing::debug!(%error, from = ?greeting.origin, "a connection came to nothing");
                log_denial(&mut self.denials, &error);
                match error.kind() {
                    // The peer has closed it: our own connection to the peer may have come first.
                    io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => {
                        self.upstream.counters.errors += 1;
                    }
                    _ => self.upstream.counters.refused += 1,
                }
                None
            }
        }
    }

    /// Keeps a connection that has yet to prove whose it is. It takes no peer's place.
    fn admit_unproven(&mut self, claimed: F::Address, stream: F::Stream) -> Option<Stranger<F>> {
        let local = F::ourselves(&stream, &self.listener.as_ref()?.local).ok()?;
        if claimed == local || F::introduce(&stream, &local).is_err() {
            return None;
        }
        let number = self.numbered;
        self.numbered = number.wrapping_add(1);
        let timeout = self.limits.hello_timeout;
        let unproven = UnprovenConnection::new(number, claimed.into(), stream, timeout);
        Some(Stranger::Unproven(unproven))
    }

    /// An unproven connection is no more. It was no peer's, and is not reported as one.
    fn give_up(&mut self, mut unproven: UnprovenConnection<F::Stream>, reason: DisconnectReason) {
        self.count(reason);
        self.upstream.counters.dropped += unproven.clear();
    }

    fn count(&mut self, reason: DisconnectReason) {
        match reason {
            DisconnectReason::Lost => self.upstream.counters.errors += 1,
            DisconnectReason::Refused => self.upstream.counters.refused += 1,
        }
    }

    /// Believes whose a connection is. Nothing when it is not a good one, whether or not it is
    /// needed.
    fn admit(&mut self, address: F::Address, stream: F::Stream) -> Option<()> {
        let local = F::ourselves(&stream, &self.listener.as_ref()?.local).ok()?;
        if address == local {
            return None;
        }
        let index = self.place(&address)?;
        let peer = &mut self.peers[index];
        if matches!(peer.state, ConnectionState::Dialing(_)) && local < address {
            // Both dial at once; our call counts, and the peer's transport thinks so too.
            return Some(());
        }
        F::introduce(&stream, &local).ok()?;
        if peer.is_connected() {
            self.upstream.report(TransportReport::PeerLost { peer: address.into() });
        }
        peer.connect(stream);
        Some(())
    }

    /// The peer's place among the peers; there may be none left.
    fn place(&mut self, address: &F::Address) -> Option<usize> {
        if let Some(index) = self.peers.iter().position(|peer| peer.address == *address) {
            return Some(index);
        }
        if self.peers.len() < self.limits.peers {
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
                let address: MediumAddress = peer.address.clone().into();
                let what = format_args!("no connection to {address} can be made");
                self.descriptors.warn(what, &error, task);
                self.upstream.counters.errors += 1;
                self.upstream.counters.dropped += peer.rest();
                task.waker().wake_by_ref();
            } else if let Err(reason) = peer.write(task, &mut self.upstream) {
                self.lose(index, reason, task);
            }
        }
    }

    fn read(&mut self, task: &mut task::Context<'_>) {
        let turns = self.peers.len() + 1;
        for offset in 0..turns {
            let index = (self.first + offset) % turns;
            let end = match self.peers.get_mut(index) {
                None => self.read_strangers(task),
                Some(peer) => {
                    peer.read(task, self.limits.mtu, &mut self.upstream).unwrap_or_else(|reason| {
                        self.lose(index, reason, task);
                        ReadEnd::Done
                    })
                }
            };
            match end {
                ReadEnd::Done => {}
                ReadEnd::Budget => task.waker().wake_by_ref(),
                ReadEnd::Full => {
                    self.first = index;
                    return;
                }
            }
        }
    }

    /// Reads from the oldest first: who comes later keeps no older one from being heard.
    fn read_strangers(&mut self, task: &mut task::Context<'_>) -> ReadEnd {
        let mut budget = PollBudget::of_frames(UNPROVEN_READS);
        let mut index = 0;
        while let Some(stranger) = self.strangers.get_mut(index) {
            index += 1;
            let Stranger::Unproven(unproven) = stranger else { continue };
            match unproven.read(task, self.limits.mtu, &mut budget, &mut self.upstream) {
                Ok(ReadEnd::Done) => {}
                Ok(end) => return end,
                Err(reason) => {
                    index -= 1;
                    if let Some(Stranger::Unproven(unproven)) = self.strangers.remove(index) {
                        self.give_up(unproven, reason);
                    }
                }
            }
        }
        ReadEnd::Done
    }

    fn lose(&mut self, index: usize, reason: DisconnectReason, task: &mut task::Context<'_>) {
        self.count(reason);
        let peer = &mut self.peers[index];
        self.upstream.counters.dropped += peer.rest();
        self.upstream.report(TransportReport::PeerLost { peer: peer.address.clone().into() });
        // The pause that has begun was not polled yet.
        task.waker().wake_by_ref();
    }

    /// Says whether the connection, adopted since or not, takes the frame.
    fn transmit_on(&mut self, number: u32, lane: FrameLane, frame: GatherBuffer) -> bool {
        if let Some(unproven) = self.strangers.iter_mut().find_map(|one| one.numbered(number)) {
            return unproven.push((lane, frame, self.upstream.now()));
        }
        let adopted = self.peers.iter_mut().find(|peer| peer.has_adopted(number));
        adopted.is_some_and(|peer| {
            peer.outgoing.push((lane, frame, self.upstream.now()), self.limits.queue_bytes)
        })
    }

    fn disconnect(&mut self) {
        let strangers = self.strangers.drain(..).map(Stranger::abandon);
        let peers = self.peers.drain(..).map(|mut peer| peer.outgoing.clear());
        self.upstream.counters.dropped += strangers.chain(peers).sum::<u64>();
        self.first = 0;
    }
}

impl<F: StreamFamily> MediumActor for Streams<F> {
    fn upstream(&mut self) -> &mut Upstream {
        &mut self.upstream
    }

    fn open(&mut self, _: &mut Context<Self>) {
        self.reopening.reset();
        self.try_open();
    }

    fn attach(&mut self, message: Attach, _: &mut Context<Self>) {
        let before = self.upstream.connections();
        self.upstream.attach(message);
        if self.upstream.connections() != before {
            self.disconnect();
        }
    }

    fn adopt(&mut self, message: Adopt) {
        let Adopt { connection: MediumAddress::Connection { number, .. }, peer } = message else {
            return;
        };
        let Some(address) = F::address(peer.clone()) else { return };
        let mut strangers = self.strangers.iter_mut();
        let Some(index) = strangers.position(|other| other.numbered(number).is_some()) else {
            return;
        };
        let Some(Stranger::Unproven(unproven)) = self.strangers.remove(index) else { return };
        if let Some(index) = self.place(&address) {
            let (connection, waiting) = unproven.into_parts();
            self.peers[index].adopt(connection, waiting);
        } else {
            self.give_up(unproven, DisconnectReason::Refused);
            self.upstream.report(TransportReport::PeerLost { peer });
        }
    }

    fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame, lane } = message;
        if frame.len() > self.limits.mtu {
            self.upstream.counters.refused += 1;
            return;
        }
        if let MediumAddress::Connection { number, .. } = to {
            let taken = self.transmit_on(number, lane, frame);
            self.upstream.counters.dropped += u64::from(!taken);
            return;
        }
        let Some(to) = F::address(to) else {
            self.upstream.counters.refused += 1;
            return;
        };
        let local = self.listener.as_ref().map(|listener| listener.local.clone());
        let (Some(local), Some(index)) = (local.filter(|local| *local != to), self.place(&to))
        else {
            self.upstream.counters.dropped += 1;
            return;
        };
        let peer = &mut self.peers[index];
        if matches!(peer.state, ConnectionState::Absent) {
            peer.state = ConnectionState::Dialing(self.family.dial(&local, &to));
        }
        let resting = matches!(peer.state, ConnectionState::Backoff(_));
        let waiting = (lane, frame, self.upstream.now());
        if resting || !peer.outgoing.push(waiting, self.limits.queue_bytes) {
            self.upstream.counters.dropped += 1;
        }
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
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

    fn backlog(&self) -> TransmitBacklog {
        let now = self.upstream.now();
        let peers = self.peers.iter().map(|peer| peer.outgoing.backlog(now));
        peers.fold(TransmitBacklog::default(), TransmitBacklog::and)
    }

    fn shut(&mut self) {
        self.listener = None;
        self.disconnect();
    }
}

// It is never pinned: its futures are boxed.
impl<F: StreamFamily> Unpin for Streams<F> {}

transport!(Streams<F>, <F: StreamFamily>);

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
