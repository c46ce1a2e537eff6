//! Frames between actors of one process: for tests, and for nodes that share a process.

use crate::medium::{MediumActor, PollBudget, transport};
use crate::reopen_backoff::ReopenBackoff;
use crate::upstream::Upstream;
use actix::Context;
use blastema_contract::transport::{MediumAddress, Transmit, TransportReport};
use bytes::Bytes;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::task::{self, Waker};

/// What several [`Memory`] transports share: who is where.
///
/// Ends on different media never meet, so that tests do not disturb each other.
#[derive(Clone, Default)]
pub struct MemoryMedium(Arc<Mutex<BTreeMap<Arc<str>, Arc<Inbox>>>>);

/// The largest frame, in bytes.
const MTU: usize = 64 * 1024;
/// So many frames wait for an end; beyond, they are dropped.
const QUEUE_FRAMES: usize = 1024;
/// So many bytes wait for an end; beyond, frames are dropped.
const QUEUE_BYTES: usize = 4 << 20;

/// An end of a [`MemoryMedium`] as a transport. It opens no sockets and reads no clock, and so
/// works under a paused one.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub struct Memory {
    medium: MemoryMedium,
    name: Arc<str>,
    upstream: Upstream,
    reopening: ReopenBackoff,
    inbox: Option<Arc<Inbox>>,
}

impl Memory {
    /// The end of this name, as a transport that opens when it is started.
    ///
    /// ```
    /// use blastema_transports::{Memory, MemoryMedium};
    /// let medium = MemoryMedium::default();
    /// let transport = Memory::new(&medium, "left");
    /// # let _ = transport;
    /// ```
    pub fn new(medium: &MemoryMedium, name: &str) -> Self {
        Memory {
            medium: medium.clone(),
            name: name.into(),
            upstream: Upstream::default(),
            reopening: ReopenBackoff::default(),
            inbox: None,
        }
    }

    fn try_open(&mut self) {
        let Memory { medium, name, .. } = self;
        let inbox = Arc::<Inbox>::default();
        if medium.enter(name, &inbox) {
            self.inbox = Some(inbox);
            self.reopening.reset();
            let local = MediumAddress::Memory(name.clone());
            let (mtu, is_probed) = (MTU, false);
            self.upstream.announce(TransportReport::Opened { local, mtu, is_probed });
        } else {
            self.reopening.failed();
            self.upstream.announce_closed(format!(
                "the memory end {name} is already open: close the other, or choose another name; \
                 trying again"
            ));
        }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        self.shut();
    }
}

/// Where the ends of endpoint strings meet.
static OF_THIS_PROCESS: LazyLock<MemoryMedium> = LazyLock::new(MemoryMedium::default);

impl MemoryMedium {
    /// The medium that `memory://` means: the same for all of this process.
    #[doc(hidden)]
    pub fn of_this_process() -> Self {
        OF_THIS_PROCESS.clone()
    }

    fn ends(&self) -> MutexGuard<'_, BTreeMap<Arc<str>, Arc<Inbox>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn enter(&self, name: &Arc<str>, inbox: &Arc<Inbox>) -> bool {
        let mut ends = self.ends();
        if ends.contains_key(name) {
            return false;
        }
        ends.insert(name.clone(), inbox.clone());
        true
    }

    fn leave(&self, name: &Arc<str>, inbox: &Arc<Inbox>) {
        let mut ends = self.ends();
        if ends.get(name).is_some_and(|present| Arc::ptr_eq(present, inbox)) {
            ends.remove(name);
        }
    }

    fn end(&self, name: &str) -> Option<Arc<Inbox>> {
        self.ends().get(name).cloned()
    }
}

/// What has arrived at an end and was not read yet.
#[derive(Default)]
struct Inbox(Mutex<Waiting>);

#[derive(Default)]
struct Waiting {
    frames: VecDeque<(Arc<str>, Bytes)>,
    bytes: usize,
    reader: Option<Waker>,
}

impl Inbox {
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a frame in, if there is room.
    fn push(&self, from: Arc<str>, frame: Bytes) -> bool {
        let mut waiting = self.waiting();
        if waiting.frames.len() >= QUEUE_FRAMES || waiting.bytes + frame.len() > QUEUE_BYTES {
            return false;
        }
        waiting.bytes += frame.len();
        waiting.frames.push_back((from, frame));
        let reader = waiting.reader.take();
        drop(waiting);
        if let Some(reader) = reader {
            reader.wake();
        }
        true
    }

    /// The oldest frame; if there is none, the task is woken when one arrives.
    fn pop(&self, task: &mut task::Context<'_>) -> Option<(Arc<str>, Bytes)> {
        let mut waiting = self.waiting();
        let popped = waiting.frames.pop_front();
        match &popped {
            Some((_, frame)) => waiting.bytes -= frame.len(),
            None => waiting.reader = Some(task.waker().clone()),
        }
        popped
    }
}

impl MediumActor for Memory {
    fn upstream(&mut self) -> &mut Upstream {
        &mut self.upstream
    }

    fn open(&mut self, _: &mut Context<Self>) {
        self.reopening.reset();
        self.try_open();
    }

    fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame, .. } = message;
        let counters = &mut self.upstream.counters;
        let MediumAddress::Memory(to) = to else {
            counters.refused += 1;
            return;
        };
        if frame.len() > MTU {
            counters.refused += 1;
            return;
        }
        let end = self.medium.end(&to).filter(|_| self.inbox.is_some());
        if end.is_some_and(|end| end.push(self.name.clone(), frame.into_bytes())) {
            counters.sent += 1;
        } else {
            counters.dropped += 1;
        }
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
        while self.inbox.is_none() {
            if self.reopening.poll_due(task).is_pending() {
                return;
            }
            self.try_open();
        }
        let Some(inbox) = self.inbox.clone() else { return };
        let mut budget = PollBudget::default();
        while budget.next() {
            if self.upstream.poll_capacity(task).is_pending() {
                return;
            }
            let Some((from, frame)) = inbox.pop(task) else { return };
            budget.spend(frame.len());
            self.upstream.deliver(MediumAddress::Memory(from), frame);
        }
        task.waker().wake_by_ref();
    }

    fn shut(&mut self) {
        if let Some(inbox) = self.inbox.take() {
            self.medium.leave(&self.name, &inbox);
        }
    }
}

transport!(Memory);
