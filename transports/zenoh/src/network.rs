//! Frames through Zenoh: between sites, over routers, for many robots.
//!
//! ```text
//!   node base ──┐                        ┌── node arm
//!           router (site A) ── WAN ── router (site B)
//!
//!   base puts a frame for arm on       <namespace>/arm/base
//!   arm subscribes to                  <namespace>/arm/*
//! ```
//!
//! * Each robot has a namespace; robots that share routers do not meet.
//! * Zenoh runs on a thread of its own, with a runtime of its own: it panics on one that has a
//!   single thread, as an arbiter's has.
//! * Urgent frames have a queue, a task and a priority of their own, so that no usual one is
//!   before them in this process, nor in the routers. The usual ones wait for Zenoh, and not in it.
//! * Once open, Zenoh connects again by itself. What is sent meanwhile is lost, as on any medium.
//!
//! Zenoh does not say who sends: a session of the same namespace can put frames in any name. What
//! frames prove is the seal's business.

use crate::ends::{CHUNK, Ends, is_chunk, on_own_thread, unopened};
use blastema::medium::{
    Bytes, FrameLane, FrameMedium, MediumAddress, MediumEvent, OpenedMedium, SendResult,
};
use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tokio::sync::Notify;
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::Sample;
use zenoh::{Config, Session};

/// So many frames of each kind may be on their way to Zenoh: what is urgent waits behind no more.
const OUTGOING_MAX: usize = 8;
/// So many frames may wait to be read, and so many bytes.
const INCOMING_MAX: usize = 1024;
const INCOMING_BYTES_MAX: usize = 4 << 20;

/// So long an end waits until its router knows it; after that it is open all the same.
const SEEN_WITHIN: Duration = Duration::from_secs(1);

/// The largest frame, in bytes. Zenoh cuts up what is larger than its batches of 64 KiB.
const MTU: usize = 60_000;

/// A node's place in a Zenoh network, as a medium. Links name the neighbours' places.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::Network;
/// use blastema_zenoh::ZenohNetwork;
///
/// let zenoh = ZenohNetwork::new("ranger", "base").connect("tcp/10.0.0.1:7447");
/// let builder = Node::builder("base")
///     .keys("/etc/blastema/base.key")
///     .network(Network::own("sites", zenoh).peer("arm", "arm"));
/// ```
#[must_use = "a medium does nothing until it is given to a network"]
pub struct ZenohNetwork {
    place: Place,
    ends: Ends,
    end: Option<Arc<End>>,
}

/// Which robot, and which of its nodes.
#[derive(Clone, Debug)]
struct Place {
    namespace: String,
    name: String,
}

impl ZenohNetwork {
    /// The place `name` of the robot `namespace`: only places of one namespace meet. They are parts
    /// of keys of Zenoh, such as `base` of `ranger` or of `fleet/ranger`; no two nodes have the
    /// same.
    ///
    /// What is wrong with them is *link down*, with what to write.
    pub fn new(namespace: &str, name: &str) -> Self {
        let place = Place { namespace: namespace.to_owned(), name: name.to_owned() };
        ZenohNetwork { place, ends: Ends::default(), end: None }
    }

    /// Connects to a router, or another place, as Zenoh writes it: `tcp/10.0.0.1:7447`. Of several,
    /// one that listens nowhere uses the first that answers.
    pub fn connect(mut self, router: &str) -> Self {
        self.ends.connect.push(router.to_owned());
        self
    }

    /// Listens, for networks without a router: `tcp/0.0.0.0:7447`.
    pub fn listen(mut self, at: &str) -> Self {
        self.ends.listen.push(at.to_owned());
        self
    }

    /// A configuration of Zenoh in JSON5 or YAML, for all else: certificates, users, timeouts.
    pub fn file(mut self, path: impl Into<PathBuf>) -> Self {
        self.ends.file = Some(path.into());
        self
    }

    /// What is wrong with it, and what to write.
    fn objection(&self) -> Option<String> {
        let Place { namespace, name } = &self.place;
        if !namespace.split('/').all(is_chunk) || !is_chunk(name) {
            return Some(format!("{namespace}/{name} is no key of Zenoh: {CHUNK}"));
        }
        self.ends.objection()
    }

    fn end(&self) -> io::Result<&Arc<End>> {
        self.end.as_ref().ok_or_else(|| io::Error::from(io::ErrorKind::NotConnected))
    }
}

impl fmt::Debug for ZenohNetwork {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name())
    }
}

impl FrameMedium for ZenohNetwork {
    fn name(&self) -> String {
        format!("zenoh {}/{}", self.place.namespace, self.place.name)
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        if let Some(why) = self.objection() {
            return Err(io::Error::other(why));
        }
        let config = self.ends.to_zenoh().map_err(io::Error::other)?;
        let (end, own) = (Arc::new(End::default()), self.place.clone());
        let (ours, failed) = (end.clone(), end.clone());
        on_own_thread(move || run(config, own, ours), move |why| failed.fail(why))?;
        self.end = Some(end);
        let local = MediumAddress::Own(self.place.name.as_str().into());
        Ok(OpenedMedium { local, mtu: MTU })
    }

    fn poll_ready(&mut self, task: &mut Context<'_>) -> Poll<io::Result<()>> {
        let mut shared = self.end()?.lock();
        match &shared.failed {
            Some(why) => Poll::Ready(Err(io::Error::other(why.clone()))),
            None if shared.is_open => Poll::Ready(Ok(())),
            None => {
                shared.reader = Some(task.waker().clone());
                Poll::Pending
            }
        }
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        matches!(address, MediumAddress::Own(name) if is_chunk(name))
    }

    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        to: &MediumAddress,
        frame: &Bytes,
        lane: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let mut shared = self.end()?.lock();
        let MediumAddress::Own(name) = to else { return Poll::Ready(Ok(SendResult::Dropped)) };
        if let Some(why) = &shared.failed {
            return Poll::Ready(Err(io::Error::other(why.clone())));
        }
        let outgoing = match lane {
            FrameLane::Hello | FrameLane::Urgent => &mut shared.urgent,
            FrameLane::Usual => &mut shared.usual,
        };
        if outgoing.frames.len() >= OUTGOING_MAX {
            outgoing.sender = Some(task.waker().clone());
            return Poll::Pending;
        }
        outgoing.frames.push_back((name.clone(), frame.clone()));
        outgoing.more.notify_one();
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>> {
        let mut shared = self.end()?.lock();
        if let Some(why) = &shared.failed {
            return Poll::Ready(Err(io::Error::other(why.clone())));
        }
        if let Some((from, frame)) = shared.incoming.pop_front() {
            shared.incoming_bytes -= frame.len();
            let from = MediumAddress::Own(from);
            return Poll::Ready(Ok(MediumEvent::Frame { from, frame }));
        }
        if shared.refused > 0 {
            shared.refused -= 1;
            return Poll::Ready(Ok(MediumEvent::Refused));
        }
        match std::mem::take(&mut shared.lost) {
            0 => {
                shared.reader = Some(task.waker().clone());
                Poll::Pending
            }
            frames => Poll::Ready(Ok(MediumEvent::Lost { frames })),
        }
    }

    fn close(&mut self) {
        if let Some(end) = self.end.take() {
            end.lock().is_closed = true;
            end.closed.notify_one();
        }
    }
}

impl Drop for ZenohNetwork {
    fn drop(&mut self) {
        self.close();
    }
}

/// What the medium and the thread of Zenoh share.
#[derive(Default)]
struct End {
    shared: Mutex<Shared>,
    closed: Notify,
}

#[derive(Default)]
struct Shared {
    is_open: bool,
    is_closed: bool,
    failed: Option<String>,
    urgent: Outgoing,
    usual: Outgoing,
    incoming: VecDeque<(Arc<str>, Bytes)>,
    incoming_bytes: usize,
    /// Frames that there was no room for, and what was no frame.
    lost: u64,
    refused: u64,
    reader: Option<Waker>,
}

/// What is on its way to Zenoh.
#[derive(Default)]
struct Outgoing {
    frames: VecDeque<(Arc<str>, Bytes)>,
    more: Arc<Notify>,
    /// Waits for room.
    sender: Option<Waker>,
}

impl End {
    fn lock(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what the reader is to see.
    fn tell(&self, change: impl FnOnce(&mut Shared)) {
        let mut shared = self.lock();
        change(&mut shared);
        let reader = shared.reader.take();
        drop(shared);
        if let Some(reader) = reader {
            reader.wake();
        }
    }

    fn fail(&self, why: String) {
        self.tell(|shared| shared.failed = Some(why));
    }

    fn receive(&self, sample: &Sample) {
        let from = sample.key_expr().as_str().rsplit('/').next().filter(|from| is_chunk(from));
        let from = from.filter(|_| sample.payload().len() <= MTU);
        let Some(from) = from else { return self.tell(|shared| shared.refused += 1) };
        let frame = Bytes::from(sample.payload().to_bytes().into_owned());
        self.tell(|shared| {
            let bytes = shared.incoming_bytes + frame.len();
            if shared.incoming.len() >= INCOMING_MAX || bytes > INCOMING_BYTES_MAX {
                shared.lost += 1;
                return;
            }
            shared.incoming_bytes = bytes;
            shared.incoming.push_back((from.into(), frame));
        });
    }
}

/// What the thread of Zenoh does, until the end is closed.
async fn run(config: Config, place: Place, end: Arc<End>) {
    let Place { namespace, name } = &place;
    let closed = async {
        while !end.lock().is_closed {
            end.closed.notified().await;
        }
    };
    let opened = async {
        let session = zenoh::open(config).await?;
        let receiver = end.clone();
        // It lasts as long as the session.
        session
            .declare_subscriber(format!("{namespace}/{name}/*"))
            .callback(move |sample| receiver.receive(&sample))
            .background()
            .await?;
        // No end answers; but that comes back when the router has seen what we subscribe to.
        let seen = session.get(format!("{namespace}/{name}/-")).timeout(SEEN_WITHIN).await?;
        while seen.recv_async().await.is_ok() {}
        Ok::<Session, zenoh::Error>(session)
    };
    tokio::pin!(closed);
    let session = tokio::select! {
        opened = opened => opened,
        () = &mut closed => return,
    };
    let session = match session {
        Ok(session) => session,
        Err(error) => return end.fail(unopened(&error)),
    };
    end.tell(|shared| shared.is_open = true);
    tokio::select! {
        () = send(&end, &session, &place, Lane::URGENT) => {}
        () = send(&end, &session, &place, Lane::USUAL) => {}
        () = closed => {}
    }
    // What fails here is over all the same.
    let _ = session.close().await;
}

/// How the frames of one queue go.
#[derive(Clone, Copy)]
struct Lane {
    queue: fn(&mut Shared) -> &mut Outgoing,
    priority: Priority,
    congestion: CongestionControl,
    express: bool,
}

impl Lane {
    /// Late, they are of no use: they wait for nothing.
    const URGENT: Lane = Lane {
        queue: |shared| &mut shared.urgent,
        priority: Priority::RealTime,
        congestion: CongestionControl::Drop,
        express: true,
    };
    const USUAL: Lane = Lane {
        queue: |shared| &mut shared.usual,
        priority: Priority::Data,
        congestion: CongestionControl::Block,
        express: false,
    };
}

/// Hands the frames of one queue to Zenoh, for ever.
async fn send(end: &End, session: &Session, place: &Place, lane: Lane) {
    let more = (lane.queue)(&mut end.lock()).more.clone();
    loop {
        let next = {
            let mut shared = end.lock();
            let outgoing = (lane.queue)(&mut shared);
            let next = outgoing.frames.pop_front();
            if let Some(sender) = outgoing.sender.take_if(|_| next.is_some()) {
                sender.wake();
            }
            next
        };
        let Some((to, frame)) = next else {
            more.notified().await;
            continue;
        };
        let put = session
            .put(format!("{}/{to}/{}", place.namespace, place.name), ZBytes::from(frame))
            .priority(lane.priority)
            .congestion_control(lane.congestion)
            .express(lane.express);
        if put.await.is_err() {
            end.tell(|shared| shared.lost += 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_parts_of_keys_and_an_end_connects_somewhere() {
        let network = |namespace: &str, name: &str| ZenohNetwork::new(namespace, name);
        let alone = network("fleet/ranger", "base");
        assert!(alone.objection().is_some_and(|why| why.contains("add `.connect(")));
        let connected = alone.connect("tcp/127.0.0.1:7447");
        assert_eq!(connected.objection(), None);
        assert!(connected.ends.to_zenoh().is_ok());
        for (namespace, name) in
            [("", "base"), ("a//b", "base"), ("a", "b/c"), ("a", "*"), ("$", "b")]
        {
            let wrong = network(namespace, name).connect("tcp/127.0.0.1:7447");
            assert!(wrong.objection().is_some_and(|why| why.contains("letters")), "{wrong:?}");
        }
    }
}
