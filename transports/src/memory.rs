//! Frames between actors of one process: for tests, and for nodes that share a process.

use crate::frame_medium::{FrameMedium, MediumEvent, OpenedMedium, QueueLimits, SendResult};
use crate::reach::Reach;
use blastema_contract::transport::MediumAddress;
use blastema_core::medium::lane::FrameLane;
use bytes::Bytes;
use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

/// What several [`Memory`] ends share: who is where.
///
/// Ends on different media never meet, so that tests do not disturb each other.
#[derive(Clone, Default)]
pub struct MemoryMedium(Arc<Mutex<BTreeMap<Arc<str>, Arc<Inbox>>>>);

/// The largest frame, in bytes.
const MTU: usize = 64 * 1024;
/// So much waits for an end; beyond, frames are dropped.
const LIMITS: QueueLimits = QueueLimits { frames: 1024, bytes: 4 << 20 };

/// An end of a [`MemoryMedium`] as a medium. It opens no sockets and reads no clock, and so works
/// under a paused one.
pub struct Memory {
    medium: MemoryMedium,
    name: Arc<str>,
    inbox: Option<Arc<Inbox>>,
}

impl Memory {
    /// The end of this name.
    ///
    /// ```
    /// use blastema_transports::{FrameTransport, Memory, MemoryMedium};
    /// let medium = MemoryMedium::default();
    /// let transport = FrameTransport::new(Memory::new(&medium, "left"));
    /// # let _ = transport;
    /// ```
    pub fn new(medium: &MemoryMedium, name: &str) -> Self {
        Memory { medium: medium.clone(), name: name.into(), inbox: None }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        self.close();
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
        if waiting.frames.len() >= LIMITS.frames || waiting.bytes + frame.len() > LIMITS.bytes {
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
    fn pop(&self, task: &mut Context<'_>) -> Option<(Arc<str>, Bytes)> {
        let mut waiting = self.waiting();
        let popped = waiting.frames.pop_front();
        match &popped {
            Some((_, frame)) => waiting.bytes -= frame.len(),
            None => waiting.reader = Some(task.waker().clone()),
        }
        popped
    }
}

impl FrameMedium for Memory {
    fn name(&self) -> String {
        format!("memory {}", self.name)
    }

    fn reach(&self) -> Reach {
        Reach::Process
    }

    fn queue(&self) -> QueueLimits {
        LIMITS
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        let inbox = Arc::<Inbox>::default();
        if !self.medium.enter(&self.name, &inbox) {
            let text = "it is open already: close the other end, or choose another name";
            return Err(io::Error::other(text));
        }
        self.inbox = Some(inbox);
        Ok(OpenedMedium { local: MediumAddress::Memory(self.name.clone()), mtu: MTU })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        matches!(address, MediumAddress::Memory(_))
    }

    fn poll_send(
        &mut self,
        _: &mut Context<'_>,
        to: &MediumAddress,
        frame: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let end = match to {
            MediumAddress::Memory(to) => self.medium.end(to),
            _ => None,
        };
        let is_taken = end.is_some_and(|end| end.push(self.name.clone(), frame.clone()));
        Poll::Ready(Ok(if is_taken { SendResult::Sent } else { SendResult::Dropped }))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>> {
        let Some((from, frame)) = self.inbox.as_ref().and_then(|inbox| inbox.pop(task)) else {
            return Poll::Pending;
        };
        Poll::Ready(Ok(MediumEvent::Frame { from: MediumAddress::Memory(from), frame }))
    }

    fn close(&mut self) {
        if let Some(inbox) = self.inbox.take() {
            self.medium.leave(&self.name, &inbox);
        }
    }
}
