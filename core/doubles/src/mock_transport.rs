//! An actor in the place of a medium.

use crate::record::Record;
use actix::prelude::*;
use blastema_contract::transport::{
    Adopt, Attach, Close, ConnectionTrust, MediumAddress, ReadCounters, Received, Transmit,
    Transport, TransportCounters, TransportReport,
};
use bytes::Bytes;
use std::sync::Arc;

/// The largest frame of a mock: that of UDP on loopback, near enough.
const MTU: usize = 64 * 1024;

/// A medium that the test plays: it sees what is sent, and says what arrives and what happens.
///
/// # Examples
/// ```
/// use blastema_contract::transport::{MediumAddress, Transmit};
/// use blastema_doubles::{MockTransport, paused};
///
/// paused(async {
///     let medium = MockTransport::start("here");
///     let to = MediumAddress::Memory("there".into());
///     medium.transport().transmit.do_send(Transmit::new(to, "hello".into()));
///     assert_eq!(medium.expect_sent().await.frame, "hello".into());
/// });
/// ```
#[derive(Clone)]
pub struct MockTransport {
    name: Arc<str>,
    address: Addr<Medium>,
    sent: Record<Transmit>,
    adopted: Record<Adopt>,
}

impl MockTransport {
    /// A medium on the present arbiter, open at this name, with no node at its other end.
    pub fn start(name: &str) -> Self {
        let name: Arc<str> = name.into();
        let (sent, adopted) = (Record::default(), Record::default());
        let local = MediumAddress::Memory(name.clone());
        let medium = Medium {
            attach: None,
            state: TransportReport::Opened { local, mtu: MTU, is_probed: false },
            sent: sent.clone(),
            adopted: adopted.clone(),
            counters: TransportCounters::default(),
        };
        let address = medium.start();
        MockTransport { name, address, sent, adopted }
    }

    /// The transport, as a link knows it.
    pub fn transport(&self) -> Transport {
        self.address.clone().into()
    }

    /// The address at which it is open.
    pub fn local(&self) -> MediumAddress {
        MediumAddress::Memory(self.name.clone())
    }

    /// Lets a frame arrive at the attached receiver.
    pub fn receive(&self, from: MediumAddress, frame: impl Into<Bytes>) {
        self.address.do_send(Injection(Received { from, frame: frame.into() }));
    }

    /// Lets the medium report something. `Opened` and `Closed` are what it also tells anyone who
    /// attaches later, as every transport does.
    pub fn report(&self, report: TransportReport) {
        self.address.do_send(Report(report));
    }

    /// The next frame that was sent.
    ///
    /// # Panics
    /// When none comes within [`PATIENCE`](crate::PATIENCE).
    pub async fn expect_sent(&self) -> Transmit {
        self.sent.expect().await
    }

    /// Everything that was sent and not yet taken.
    pub fn sent(&self) -> Vec<Transmit> {
        self.sent.drain()
    }

    /// The next connection that the receiver has adopted.
    ///
    /// # Panics
    /// When none comes within [`PATIENCE`](crate::PATIENCE).
    pub async fn expect_adopted(&self) -> Adopt {
        self.adopted.expect().await
    }

    /// What connections are worth to the attached receiver.
    ///
    /// # Panics
    /// When none is attached.
    pub async fn connections(&self) -> ConnectionTrust {
        let trust = self.address.send(ReadTrust).await;
        trust.ok().flatten().expect("a receiver is attached")
    }
}

/// The mock's actor.
struct Medium {
    attach: Option<Attach>,
    state: TransportReport,
    sent: Record<Transmit>,
    adopted: Record<Adopt>,
    counters: TransportCounters,
}

#[derive(Message)]
#[rtype(result = "()")]
struct Injection(Received);

#[derive(Message)]
#[rtype(result = "()")]
struct Report(TransportReport);

#[derive(Message)]
#[rtype(result = "Option<ConnectionTrust>")]
struct ReadTrust;

impl Medium {
    fn deliver(&mut self, received: Received) {
        match &self.attach {
            Some(attach) => {
                self.counters.received += 1;
                attach.frames.do_send(received);
            }
            None => self.counters.dropped += 1,
        }
    }

    fn report(&self, report: TransportReport) {
        if let Some(attach) = &self.attach {
            attach.reports.do_send(report);
        }
    }
}

impl Actor for Medium {
    type Context = Context<Self>;
}

impl Handler<Transmit> for Medium {
    type Result = ();

    fn handle(&mut self, message: Transmit, _: &mut Context<Self>) {
        self.sent.push(message);
        match self.state {
            TransportReport::Opened { .. } => self.counters.sent += 1,
            _ => self.counters.dropped += 1,
        }
    }
}

impl Handler<Injection> for Medium {
    type Result = ();

    fn handle(&mut self, Injection(received): Injection, _: &mut Context<Self>) {
        self.deliver(received);
    }
}

impl Handler<Report> for Medium {
    type Result = ();

    fn handle(&mut self, Report(report): Report, _: &mut Context<Self>) {
        use TransportReport::{Closed, Ended, Opened};
        if matches!(report, Opened { .. } | Closed { .. } | Ended) {
            self.state = report.clone();
        }
        self.report(report);
    }
}

impl Handler<Attach> for Medium {
    type Result = ();

    fn handle(&mut self, attach: Attach, _: &mut Context<Self>) {
        self.attach = Some(attach);
        self.report(self.state.clone());
    }
}

impl Handler<Adopt> for Medium {
    type Result = ();

    fn handle(&mut self, message: Adopt, _: &mut Context<Self>) {
        self.adopted.push(message);
    }
}

impl Handler<ReadTrust> for Medium {
    type Result = Option<ConnectionTrust>;

    fn handle(&mut self, _: ReadTrust, _: &mut Context<Self>) -> Self::Result {
        self.attach.as_ref().map(|attach| attach.connections)
    }
}

impl Handler<Close> for Medium {
    type Result = ();

    fn handle(&mut self, _: Close, context: &mut Context<Self>) {
        self.report(TransportReport::Ended);
        context.stop();
    }
}

impl Handler<ReadCounters> for Medium {
    type Result = MessageResult<ReadCounters>;

    fn handle(&mut self, _: ReadCounters, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.counters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Probe, paused};

    fn attach(medium: &MockTransport) -> (Probe<Received>, Probe<TransportReport>) {
        let (frames, reports) = (Probe::start(), Probe::start());
        let attach = Attach::new(frames.recipient(), reports.recipient());
        medium.transport().attach.do_send(attach);
        (frames, reports)
    }

    #[test]
    fn a_mock_shows_what_is_sent_and_says_what_the_test_says() {
        paused(async {
            let medium = MockTransport::start("here");
            let there = MediumAddress::Memory("there".into());
            let (frames, reports) = attach(&medium);

            assert!(matches!(reports.expect().await, TransportReport::Opened { .. }));
            medium.receive(there.clone(), "in");
            assert_eq!(frames.expect().await, Received { from: there.clone(), frame: "in".into() });
            let out = Transmit::new(there.clone(), "out".into());
            medium.transport().transmit.do_send(out.clone());
            assert_eq!(medium.expect_sent().await, out);
            medium.report(TransportReport::PeerLost { peer: there.clone() });
            assert_eq!(reports.expect().await, TransportReport::PeerLost { peer: there });
        });
    }

    #[test]
    fn whoever_attaches_later_is_told_the_present_state() {
        paused(async {
            let medium = MockTransport::start("here");
            medium.report(TransportReport::Closed { reason: "unplugged".into() });

            let (_, reports) = attach(&medium);

            let closed = TransportReport::Closed { reason: "unplugged".into() };
            assert_eq!(reports.expect().await, closed);
        });
    }
}
