//! The body around any [`FrameMedium`].

use crate::frame_medium::{FrameMedium, MediumEvent, OpenedMedium, SendResult};
use crate::medium::{BUDGET, MediumActor, PollBudget, transport};
use crate::reopen_backoff::ReopenBackoff;
use crate::transmit_queues::TransmitQueues;
use crate::upstream::Upstream;
use actix::Context;
use blastema_contract::transport::{MediumAddress, Transmit, TransmitBacklog, TransportReport};
use blastema_core::medium::lane::FrameLane;
use bytes::Bytes;
use std::io;
use std::task::{self, Poll};

/// A [`FrameMedium`] as a transport.
///
/// It lives until it is sent [`Close`](blastema_contract::transport::Close).
pub struct FrameTransport {
    medium: Box<dyn FrameMedium>,
    upstream: Upstream,
    reopening: ReopenBackoff,
    opening: Option<OpenedMedium>,
    open: Option<OpenedMedium>,
    queue: TransmitQueues<(MediumAddress, Bytes)>,
    /// The frame that the medium has begun with.
    going: Option<Going>,
}

struct Going {
    lane: FrameLane,
    to: MediumAddress,
    frame: Bytes,
}

impl FrameTransport {
    /// A transport that opens when it is started.
    pub fn new(medium: impl FrameMedium) -> Self {
        FrameTransport {
            medium: Box::new(medium),
            upstream: Upstream::default(),
            reopening: ReopenBackoff::default(),
            opening: None,
            open: None,
            queue: TransmitQueues::default(),
            going: None,
        }
    }

    fn try_open(&mut self) {
        match self.medium.open() {
            Ok(opening) => self.opening = Some(opening),
            Err(error) => self.lose("cannot be opened", &error),
        }
    }

    /// Opens it, with a pause after each failure; ready when it is open.
    fn poll_open(&mut self, task: &mut task::Context<'_>) -> Poll<()> {
        while self.open.is_none() {
            let Some(OpenedMedium { local, mtu }) = self.opening.clone() else {
                task::ready!(self.reopening.poll_due(task));
                self.try_open();
                continue;
            };
            match task::ready!(self.medium.poll_ready(task)) {
                Ok(()) => {
                    self.reopening.reset();
                    self.open = self.opening.take();
                    let is_probed = false;
                    self.upstream.announce(TransportReport::Opened { local, mtu, is_probed });
                    if let Some(rate) = self.medium.bytes_per_second() {
                        self.upstream.announce_rate(rate);
                    }
                }
                Err(error) => self.lose("cannot be opened", &error),
            }
        }
        Poll::Ready(())
    }

    fn lose(&mut self, what: &str, error: &io::Error) {
        let name = self.medium.name();
        self.shut();
        self.reopening.failed();
        self.upstream.announce_closed(format!("{name} {what} ({error}); trying again"));
    }

    /// Says whether the medium is still there.
    fn write(&mut self, task: &mut task::Context<'_>) -> bool {
        for _ in 0..BUDGET {
            if self.going.is_none() {
                // Chosen as late as can be: what is urgent may come while the medium is busy.
                if self.queue.is_empty() || self.medium.poll_capacity(task).is_pending() {
                    return true;
                }
                let next = self.queue.pop();
                self.going = next.map(|(lane, (to, frame))| Going { lane, to, frame });
            }
            let Some(Going { lane, to, frame }) = &self.going else { return true };
            match self.medium.poll_send(task, to, frame, *lane) {
                Poll::Pending => return true,
                Poll::Ready(Ok(sending)) => {
                    match sending {
                        SendResult::Sent => self.upstream.counters.sent += 1,
                        SendResult::Dropped => self.upstream.counters.dropped += 1,
                    }
                    self.going = None;
                }
                Poll::Ready(Err(error)) => {
                    self.upstream.counters.errors += 1;
                    self.lose("is lost", &error);
                    return false;
                }
            }
        }
        task.waker().wake_by_ref();
        true
    }

    /// Says whether the medium is still there.
    fn read(&mut self, task: &mut task::Context<'_>) -> bool {
        let mut budget = PollBudget::default();
        while budget.next() {
            if self.upstream.poll_capacity(task).is_pending() {
                return true;
            }
            match self.medium.poll_receive(task) {
                Poll::Pending => return true,
                Poll::Ready(Ok(MediumEvent::Frame { from, frame })) => {
                    budget.spend(frame.len());
                    self.upstream.deliver(from, frame);
                }
                Poll::Ready(Ok(MediumEvent::Refused)) => self.upstream.counters.refused += 1,
                Poll::Ready(Ok(MediumEvent::Lost { frames })) => {
                    self.upstream.counters.dropped += frames;
                    self.upstream.counters.errors += 1;
                }
                Poll::Ready(Ok(MediumEvent::Clash { text })) => {
                    let reason = format!("{}: {text}", self.medium.name());
                    self.upstream.report(TransportReport::Clash { reason });
                }
                Poll::Ready(Ok(MediumEvent::PeerLost { peer })) => {
                    self.upstream.report(TransportReport::PeerLost { peer });
                }
                Poll::Ready(Err(error)) => {
                    self.upstream.counters.errors += 1;
                    self.lose("is lost", &error);
                    return false;
                }
            }
        }
        task.waker().wake_by_ref();
        true
    }
}

impl MediumActor for FrameTransport {
    fn upstream(&mut self) -> &mut Upstream {
        &mut self.upstream
    }

    fn open(&mut self, _: &mut Context<Self>) {
        self.reopening.reset();
        self.try_open();
    }

    fn transmit(&mut self, message: Transmit) {
        let Transmit { to, frame, lane } = message;
        if !self.medium.knows(&to) {
            self.upstream.counters.refused += 1;
            return;
        }
        let Some(OpenedMedium { mtu, .. }) = self.open else {
            self.upstream.counters.dropped += 1;
            return;
        };
        let (limits, bytes) = (self.medium.queue(), frame.len());
        if bytes > mtu {
            self.upstream.counters.refused += 1;
        } else if !self.queue.push(
            lane,
            (to, frame.into_bytes()),
            self.upstream.now(),
            bytes,
            limits,
        ) {
            self.upstream.counters.dropped += 1;
        }
    }

    fn backlog(&self) -> TransmitBacklog {
        self.queue.backlog(self.going.is_some(), self.upstream.now())
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
        loop {
            if self.poll_open(task).is_pending() {
                return;
            }
            // A medium that was lost has begun a pause, which must be polled before this is left.
            if self.write(task) && self.read(task) {
                return;
            }
        }
    }

    fn shut(&mut self) {
        (self.opening, self.open) = (None, None);
        self.medium.close();
        self.upstream.counters.dropped += self.queue.clear();
        self.upstream.counters.dropped += u64::from(self.going.take().is_some());
    }
}

transport!(FrameTransport);
