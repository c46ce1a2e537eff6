//! What is done for any medium of whole frames, in virtual time.

use actix::prelude::*;
use blastema_contract::transport::{
    Attach, MediumAddress, ReadCounters, Received, Transmit, TransportCounters, TransportReport,
};
use blastema_core::medium::lane::FrameLane;
use blastema_doubles::{Probe, advance};
use blastema_transports::FrameTransport;
use blastema_transports::frame_medium::{
    FrameMedium, MediumEvent, OpenedMedium, QueueLimits, SendResult,
};
use bytes::Bytes;
use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Context as Task, Poll, Waker};
use std::time::Duration;

const MS: fn(u64) -> Duration = Duration::from_millis;

/// What the test plays, and what the medium was told.
#[derive(Default)]
struct Play {
    /// So many attempts to open it fail.
    absent: u32,
    opened: u32,
    closed: u32,
    /// It takes no frame at present.
    stuck: bool,
    /// The next frame breaks it.
    breaks: bool,
    sent: Vec<Bytes>,
    arrivals: VecDeque<MediumEvent>,
    wakers: Vec<Waker>,
}

#[derive(Clone, Default)]
struct Puppet(Arc<Mutex<Play>>);

impl Puppet {
    fn play(&self) -> MutexGuard<'_, Play> {
        self.0.lock().unwrap()
    }

    fn wake(&self) {
        let wakers = std::mem::take(&mut self.play().wakers);
        wakers.into_iter().for_each(Waker::wake);
    }
}

impl FrameMedium for Puppet {
    fn name(&self) -> String {
        "puppet".into()
    }

    fn queue(&self) -> QueueLimits {
        QueueLimits { frames: 3, bytes: 100 }
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        let mut play = self.play();
        if play.absent > 0 {
            play.absent -= 1;
            return Err(io::Error::other("pull the strings"));
        }
        play.opened += 1;
        Ok(OpenedMedium { local: MediumAddress::Line, mtu: 60 })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        *address == MediumAddress::Line
    }

    fn poll_send(
        &mut self,
        task: &mut Task<'_>,
        _: &MediumAddress,
        frame: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let mut play = self.play();
        if std::mem::take(&mut play.breaks) {
            return Poll::Ready(Err(io::Error::other("a string tore")));
        }
        if play.stuck {
            play.wakers.push(task.waker().clone());
            return Poll::Pending;
        }
        play.sent.push(frame.clone());
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut Task<'_>) -> Poll<io::Result<MediumEvent>> {
        let mut play = self.play();
        match play.arrivals.pop_front() {
            Some(arrival) => Poll::Ready(Ok(arrival)),
            None => {
                play.wakers.push(task.waker().clone());
                Poll::Pending
            }
        }
    }

    fn close(&mut self) {
        self.play().closed += 1;
    }
}

struct Bench {
    puppet: Puppet,
    transport: Addr<FrameTransport>,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
}

impl Bench {
    fn new(puppet: Puppet) -> Self {
        let transport = FrameTransport::new(puppet.clone()).start();
        let (frames, reports) = (Probe::start(), Probe::start());
        let attach = Attach::new(frames.recipient(), reports.recipient());
        transport.do_send(attach);
        Bench { puppet, transport, frames, reports }
    }

    fn send(&self, frame: &'static [u8]) {
        let frame = Bytes::from_static(frame);
        self.transport.do_send(Transmit::new(MediumAddress::Line, frame.into()));
    }

    async fn counters(&self) -> TransportCounters {
        self.transport.send(ReadCounters).await.unwrap()
    }

    async fn closed(&self) -> String {
        match self.reports.expect().await {
            TransportReport::Closed { reason } => reason,
            other => panic!("{other:?}"),
        }
    }

    async fn opened(&self) {
        let report = self.reports.expect().await;
        assert!(matches!(report, TransportReport::Opened { .. }), "{report:?}");
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_medium_that_does_not_open_is_tried_again_with_back_off_and_reported_once() {
    let puppet = Puppet::default();
    puppet.play().absent = 3;
    let bench = Bench::new(puppet);

    let reason = bench.closed().await;
    assert_eq!(reason, "puppet cannot be opened (pull the strings); trying again");
    // 20, 40 and 80 ms after each other.
    advance(MS(139)).await;
    assert_eq!(bench.puppet.play().opened, 0);
    assert!(bench.reports.drain().is_empty());
    advance(MS(1)).await;
    bench.opened().await;
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_medium_that_breaks_is_closed_and_opened_again_without_what_waited() {
    let bench = Bench::new(Puppet::default());
    bench.opened().await;
    bench.puppet.play().breaks = true;

    bench.send(b"one");
    bench.send(b"two");
    assert_eq!(bench.closed().await, "puppet is lost (a string tore); trying again");
    advance(MS(20)).await;
    bench.opened().await;
    bench.send(b"three");
    advance(MS(0)).await;
    let TransportCounters { sent, dropped, errors, .. } = bench.counters().await;

    assert_eq!((sent, dropped, errors), (1, 2, 1));
    assert_eq!(bench.puppet.play().sent, ["three"]);
    let play = bench.puppet.play();
    assert_eq!((play.opened, play.closed), (2, 1));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_waits_for_a_medium_is_bounded_in_frames_and_bytes_and_goes_out_in_order() {
    let bench = Bench::new(Puppet::default());
    bench.opened().await;
    bench.puppet.play().stuck = true;

    ["a", "b", "c", "d", "e"].iter().for_each(|frame| bench.send(frame.as_bytes()));
    assert_eq!(bench.counters().await.dropped, 2);
    bench.puppet.play().stuck = false;
    bench.puppet.wake();
    advance(MS(0)).await;
    assert_eq!(bench.puppet.play().sent, ["a", "b", "c"]);

    bench.puppet.play().stuck = true;
    bench.send(&[7; 60]);
    bench.send(&[8; 41]);
    bench.send(&[9; 40]);
    bench.send(&[0; 61]);
    let TransportCounters { dropped, refused, .. } = bench.counters().await;
    assert_eq!(
        (dropped, refused),
        (3, 1),
        "101 bytes are too many, and 61 no frame of this medium"
    );
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_arrives_is_handed_on_and_what_is_no_frame_is_counted() {
    let bench = Bench::new(Puppet::default());
    bench.opened().await;
    let from = MediumAddress::Line;

    bench.puppet.play().arrivals = [
        MediumEvent::Refused,
        MediumEvent::Frame { from: from.clone(), frame: "hello".into() },
        MediumEvent::PeerLost { peer: from.clone() },
        MediumEvent::Refused,
    ]
    .into();
    bench.puppet.wake();

    assert_eq!(bench.frames.expect().await, Received { from: from.clone(), frame: "hello".into() });
    assert_eq!(bench.reports.expect().await, TransportReport::PeerLost { peer: from });
    let TransportCounters { received, refused, .. } = bench.counters().await;
    assert_eq!((received, refused), (1, 2));
}
