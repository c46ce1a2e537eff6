//! A bad cable between a link and any transport, for tests and demonstrations.

use crate::medium::{BUDGET, MediumActor, transport};
use crate::medium_timer::MediumTimer;
use crate::upstream::Upstream;
use actix::{AsyncContext, Context, Handler, MessageResult, ResponseFuture};
use blastema_contract::transport::{
    Adopt, Attach, Close, Cut, Impair, InjectedFaults, Partition, ReadCounters, ReadInjectedFaults,
    Received, Restore, Transmit, Transport, TransportCounters, TransportReport,
};
use blastema_core::medium::impairment::ImpairedDirection;
use blastema_core::{Instant, Machine};
use std::task;

/// What a [`FaultInjector`] begins with.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct FaultInjectorConfig {
    /// All that is left to chance follows from it.
    pub seed: u64,
    /// How many frames are held back in each direction at most; beyond, they are lost and counted.
    /// It bounds the product of delay and rate.
    pub limit: usize,
    /// The clock by which frames are held back.
    pub now: fn() -> Instant,
}

impl FaultInjectorConfig {
    /// The clock must be the one on which this arbiter's timers run.
    pub fn new(seed: u64, now: fn() -> Instant) -> Self {
        FaultInjectorConfig { seed, limit: 4096, now }
    }
}

/// Stands between a link and a transport, and does to frames what it is told: loss, delay,
/// duplication, reordering, corruption, a limited rate ([`Impair`]), a cut, noticed or silent
/// ([`Cut`]), a partition from some peers ([`Partition`]), and the restoring ([`Restore`]).
///
/// ```text
/// link ──Transmit──► FaultInjector ──Transmit──► transport
///      ◄─Received──         ◄─Received──
/// ```
///
/// At first it does nothing to them. Its counters are those of the transport.
pub struct FaultInjector {
    config: FaultInjectorConfig,
    inner: Transport,
    upstream: Upstream,
    outgoing: ImpairedDirection<Transmit>,
    incoming: ImpairedDirection<Received>,
    /// Where the transport stands, however the cable is.
    state: Option<TransportReport>,
    /// The cut is one that a medium notices.
    cut_is_reported: bool,
    timer: MediumTimer,
}

impl FaultInjector {
    /// A cable before `inner`; it attaches itself there when it is started.
    pub fn new(inner: Transport, config: FaultInjectorConfig) -> Self {
        // Two directions, two sequences: traffic one way does not change the other's fate.
        let (outgoing, incoming) = (config.seed, !config.seed);
        FaultInjector {
            inner,
            upstream: Upstream::default(),
            outgoing: ImpairedDirection::new(outgoing, config.limit),
            incoming: ImpairedDirection::new(incoming, config.limit),
            state: None,
            cut_is_reported: false,
            timer: MediumTimer::default(),
            config,
        }
    }

    /// Stands between the transport and the receiver, who says what connections are worth.
    fn attach_inner(&self, context: &mut Context<Self>) {
        let (frames, reports) = (context.address().recipient(), context.address().recipient());
        let connections = self.upstream.connections();
        self.inner.attach.do_send(Attach {
            frames,
            reports,
            connections,
            clock: Some(self.config.now),
        });
    }

    fn announce(&mut self) {
        if self.cut_is_reported {
            self.upstream.announce_closed("the cable is cut, on purpose: restore it".into());
        } else if let Some(state) = self.state.clone() {
            self.upstream.announce(state);
        }
    }
}

impl MediumActor for FaultInjector {
    fn upstream(&mut self) -> &mut Upstream {
        &mut self.upstream
    }

    fn open(&mut self, context: &mut Context<Self>) {
        self.attach_inner(context);
        self.announce();
    }

    fn attach(&mut self, message: Attach, context: &mut Context<Self>) {
        let before = self.upstream.connections();
        self.upstream.attach(message);
        if self.upstream.connections() != before {
            self.attach_inner(context);
        }
    }

    fn adopt(&mut self, message: Adopt) {
        self.inner.adopt.do_send(message);
    }

    fn counters(&mut self) -> ResponseFuture<TransportCounters> {
        let counters = self.inner.counters.send(ReadCounters);
        // A transport that is gone has counted nothing.
        Box::pin(async { counters.await.unwrap_or_default() })
    }

    fn transmit(&mut self, message: Transmit) {
        self.outgoing.handle_frame(message, (self.config.now)());
    }

    fn pump(&mut self, task: &mut task::Context<'_>) {
        loop {
            let now = (self.config.now)();
            self.outgoing.handle_timeout(now);
            self.incoming.handle_timeout(now);
            while let Some(message) = self.outgoing.poll_output() {
                self.inner.transmit.do_send(message);
            }
            for turn in 0.. {
                if self.upstream.poll_capacity(task).is_pending() {
                    break;
                }
                let Some(Received { from, frame }) = self.incoming.poll_output() else { break };
                self.upstream.deliver(from, frame);
                if turn == BUDGET {
                    task.waker().wake_by_ref();
                    break;
                }
            }
            let due = [self.outgoing.poll_timeout(), self.incoming.poll_timeout()];
            let Some(due) = due.into_iter().flatten().min() else { return };
            if self.timer.poll_at(due, now, task).is_pending() {
                return;
            }
        }
    }

    fn shut(&mut self) {
        self.timer = MediumTimer::default();
    }

    fn close(&mut self) {
        self.shut();
        self.inner.close.do_send(Close);
    }
}

transport!(FaultInjector);

impl Handler<Received> for FaultInjector {
    type Result = ();

    fn handle(&mut self, message: Received, _: &mut Context<Self>) {
        self.incoming.handle_frame(message, (self.config.now)());
    }
}

impl Handler<TransportReport> for FaultInjector {
    type Result = ();

    fn handle(&mut self, message: TransportReport, _: &mut Context<Self>) {
        match message {
            TransportReport::PeerLost { .. } | TransportReport::Clash { .. } => {
                self.upstream.report(message);
            }
            TransportReport::Rate { bytes_per_second } => {
                self.upstream.announce_rate(bytes_per_second);
            }
            TransportReport::Opened { .. }
            | TransportReport::Closed { .. }
            | TransportReport::Ended => {
                self.state = Some(message);
                self.announce();
            }
        }
    }
}

impl Handler<Impair> for FaultInjector {
    type Result = ();

    fn handle(&mut self, message: Impair, _: &mut Context<Self>) {
        let Impair { direction, impairment } = message;
        if direction.outgoing() {
            self.outgoing.impair(impairment);
        }
        if direction.incoming() {
            self.incoming.impair(impairment);
        }
    }
}

impl Handler<Cut> for FaultInjector {
    type Result = ();

    fn handle(&mut self, message: Cut, _: &mut Context<Self>) {
        let Cut { direction, reported } = message;
        if direction.outgoing() {
            self.outgoing.cut();
        }
        if direction.incoming() {
            self.incoming.cut();
        }
        self.cut_is_reported |= reported;
        self.announce();
    }
}

impl Handler<Partition> for FaultInjector {
    type Result = ();

    fn handle(&mut self, message: Partition, _: &mut Context<Self>) {
        let Partition { direction, peers } = message;
        if direction.outgoing() {
            self.outgoing.part_from(peers.clone());
        }
        if direction.incoming() {
            self.incoming.part_from(peers);
        }
    }
}

impl Handler<Restore> for FaultInjector {
    type Result = ();

    fn handle(&mut self, _: Restore, _: &mut Context<Self>) {
        self.outgoing.restore();
        self.incoming.restore();
        self.cut_is_reported = false;
        self.announce();
    }
}

impl Handler<ReadInjectedFaults> for FaultInjector {
    type Result = MessageResult<ReadInjectedFaults>;

    fn handle(&mut self, _: ReadInjectedFaults, _: &mut Context<Self>) -> Self::Result {
        let (outgoing, incoming) = (self.outgoing.injected(), self.incoming.injected());
        MessageResult(InjectedFaults { outgoing, incoming })
    }
}
