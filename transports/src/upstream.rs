//! Where a transport's frames and reports go.

use actix::dev::RecipientRequest;
use blastema_contract::transport::{
    Attach, MediumAddress, Received, TransportCounters, TransportReport,
};
use blastema_core::Instant;
use bytes::Bytes;
use std::collections::VecDeque;
use std::pin::Pin;
use std::task::{self, Poll};

/// Of so many frames the last asks for a confirmation: it costs as much as a frame, so that a
/// smaller number would be felt.
const BATCH: usize = 64;
/// So many batches may be unconfirmed. Fewer would make reader and receiver wait for each other;
/// more only lengthens the queue before a receiver that is too slow.
const BATCHES: usize = 4;

/// Hands frames and reports to the attached receiver, and counts.
///
/// actix mailboxes have no bound. So the last frame of each batch is sent as a request, and no more
/// than `BATCHES` of them are left unanswered: a receiver that is slow or hangs is not buried.
#[derive(Default)]
pub(crate) struct Upstream {
    pub(crate) counters: TransportCounters,
    attach: Option<Attach>,
    state: Option<TransportReport>,
    /// How much the medium carries, where that is little.
    rate: Option<u64>,
    unconfirmed: VecDeque<Pin<Box<RecipientRequest<Received>>>>,
    in_batch: usize,
}

impl Upstream {
    /// Attaches another receiver, and reports the state of the medium to it.
    pub(crate) fn attach(&mut self, attach: Attach) {
        self.attach = Some(attach);
        self.unconfirmed.clear();
        self.in_batch = 0;
        self.report_state();
    }

    /// What connections are worth to the attached receiver.
    #[cfg(any(feature = "fault", feature = "tcp", feature = "unix"))]
    pub(crate) fn connections(&self) -> blastema_contract::transport::ConnectionTrust {
        self.attach.as_ref().map(|attach| attach.connections).unwrap_or_default()
    }

    /// The medium carries so much; it is reported now, and after each opening.
    pub(crate) fn announce_rate(&mut self, bytes_per_second: u64) {
        if self.rate.replace(bytes_per_second) != Some(bytes_per_second) {
            self.report(TransportReport::Rate { bytes_per_second });
        }
    }

    /// What time it is, if the attached receiver has a clock.
    pub(crate) fn now(&self) -> Option<Instant> {
        self.attach.as_ref()?.clock.map(|clock| clock())
    }

    fn report_state(&self) {
        let Some(state) = self.state.clone() else { return };
        let open = matches!(state, TransportReport::Opened { .. });
        self.report(state);
        if let Some(bytes_per_second) = self.rate.filter(|_| open) {
            self.report(TransportReport::Rate { bytes_per_second });
        }
    }

    /// After a panic: the receiver stays attached, and is told the state of the medium again.
    pub(crate) fn begin_next_incarnation(&mut self) {
        self.state = None;
        self.unconfirmed.clear();
        self.in_batch = 0;
    }

    /// Reports that the medium is closed, now and to a receiver that attaches later.
    pub(crate) fn announce_closed(&mut self, reason: String) {
        self.announce(TransportReport::Closed { reason });
    }

    /// Reports the state of the medium, now and to a receiver that attaches later, unless it was
    /// reported last.
    pub(crate) fn announce(&mut self, state: TransportReport) {
        if self.state.as_ref() != Some(&state) {
            tracing::debug!(?state, "a transport reports");
            self.state = Some(state);
            self.report_state();
        }
    }

    /// Reports something that passes.
    pub(crate) fn report(&self, report: TransportReport) {
        if let Some(attach) = &self.attach {
            attach.reports.do_send(report);
        }
    }

    /// Whether another frame may be handed on; if not, the task is woken when it may.
    pub(crate) fn poll_capacity(&mut self, task: &mut task::Context<'_>) -> Poll<()> {
        while self.unconfirmed.len() >= BATCHES {
            let oldest = self.unconfirmed.front_mut().expect("a full queue has a front");
            // An error means that the receiver is gone or died over it: nothing to wait for either.
            let (Ok(()) | Err(_)) = std::task::ready!(oldest.as_mut().poll(task));
            self.unconfirmed.pop_front();
        }
        Poll::Ready(())
    }

    /// Hands one frame on.
    pub(crate) fn deliver(&mut self, from: MediumAddress, frame: Bytes) {
        let attached = self.attach.as_ref().filter(|attach| attach.frames.connected());
        let Some(attach) = attached else {
            self.counters.dropped += 1;
            return;
        };
        self.counters.received += 1;
        self.in_batch += 1;
        let received = Received { from, frame };
        if self.in_batch < BATCH {
            attach.frames.do_send(received);
        } else {
            self.in_batch = 0;
            // A sender that was used before may be parked by actix, and would hold the frame back.
            // Its clone never is.
            self.unconfirmed.push_back(Box::pin(attach.frames.clone().send(received)));
        }
    }
}
