//! A transport with probes in the places of its users.

use blastema_contract::transport::{
    Attach, ConnectionTrust, MediumAddress, ReadCounters, Received, Transmit, Transport,
    TransportCounters, TransportReport,
};
use blastema_doubles::{PATIENCE, Probe, now};
use bytes::Bytes;

pub(crate) struct End {
    pub(crate) transport: Transport,
    pub(crate) frames: Probe<Received>,
    pub(crate) reports: Probe<TransportReport>,
}

impl End {
    pub(crate) fn new(transport: impl Into<Transport>) -> Self {
        End::trusting(transport, ConnectionTrust::Claimed)
    }

    pub(crate) fn trusting(transport: impl Into<Transport>, trust: ConnectionTrust) -> Self {
        let transport = transport.into();
        let (frames, reports) = attach(&transport, trust);
        End { transport, frames, reports }
    }

    /// Waits until it is open; the answer is its address and its mtu.
    pub(crate) async fn opened(&self) -> (MediumAddress, usize) {
        let opened = |report: &TransportReport| matches!(report, TransportReport::Opened { .. });
        match self.reports.wait(opened).await {
            TransportReport::Opened { local, mtu, .. } => (local, mtu),
            other => unreachable!("{other:?} was not waited for"),
        }
    }

    pub(crate) async fn closed(&self) -> String {
        let closed = |report: &TransportReport| matches!(report, TransportReport::Closed { .. });
        match self.reports.wait(closed).await {
            TransportReport::Closed { reason } => reason,
            other => unreachable!("{other:?} was not waited for"),
        }
    }

    pub(crate) fn send(&self, to: impl Into<MediumAddress>, frame: impl Into<Bytes>) {
        self.transport.transmit.do_send(Transmit::new(to.into(), frame.into().into()));
    }

    /// The next frame that arrives is this one.
    pub(crate) async fn expect(&self, from: impl Into<MediumAddress>, frame: impl Into<Bytes>) {
        let (from, frame) = (from.into(), frame.into());
        assert_eq!(self.frames.expect().await, Received { from, frame });
    }

    pub(crate) async fn counters(&self) -> TransportCounters {
        self.transport.counters.send(ReadCounters).await.expect("the transport lives")
    }

    /// Waits until the counters are as wanted.
    pub(crate) async fn counted(&self, wanted: impl Fn(&TransportCounters) -> bool) {
        let counted = async {
            while !wanted(&self.counters().await) {
                tokio::task::yield_now().await;
            }
        };
        let waited = tokio::time::timeout(PATIENCE, counted).await;
        assert!(waited.is_ok(), "{:?}", self.counters().await);
    }

    /// Sends until it arrives there, for a medium may lose frames while a peer comes back, or while
    /// a buffer is full. The answer is whether anything else arrived before.
    pub(crate) async fn reaches(
        &self,
        receiver: &End,
        to: impl Into<MediumAddress>,
        frame: impl Into<Bytes>,
    ) -> bool {
        let (to, frame) = (to.into(), frame.into());
        let arrived = async {
            let mut other = false;
            loop {
                self.send(to.clone(), frame.clone());
                self.counters().await;
                tokio::task::yield_now().await;
                for received in receiver.frames.drain() {
                    if received.frame == frame {
                        return other;
                    }
                    other = true;
                }
            }
        };
        match tokio::time::timeout(PATIENCE, arrived).await {
            Ok(other) => other,
            Err(_) => panic!("{:?} {:?}", self.counters().await, receiver.counters().await),
        }
    }
}

/// Puts new probes in the places of the users.
pub(crate) fn attach(
    transport: &Transport,
    connections: ConnectionTrust,
) -> (Probe<Received>, Probe<TransportReport>) {
    let (frames, reports) = (Probe::start(), Probe::start());
    transport.attach.do_send(Attach {
        frames: frames.recipient(),
        reports: reports.recipient(),
        connections,
        clock: Some(now),
    });
    (frames, reports)
}

pub(crate) fn in_real_time(test: impl Future<Output = ()>) {
    actix_rt::System::new().block_on(test);
}
