//! A link on a slow line that is always full.

use actix::Actor;
use blastema_contract::transport::{
    Attach, Lane, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::net::frame::{Frame, is_urgent};
use blastema_core::net::link::{LinkConfig, LinkOutput, LinkState};
use blastema_core::net::packet::{Packet, Payload};
use blastema_core::net::{Bundle, BundleOutput, Class, Link, LinkNumber, NodeId};
use blastema_core::{Incarnation, Machine, NodeName};
use blastema_doubles::{Probe, advance, now, paused};
use blastema_transports::frame_medium::{Arrival, Opening, QueueLimits, Sending};
use blastema_transports::{FrameMedium, FrameTransport};
use bytes::Bytes;
use std::cell::RefCell;
use std::collections::VecDeque;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker, ready};
use std::time::Duration;
use tokio::time::Sleep;

/// What 9,600 bits a second carry, one way.
const BYTES_PER_SECOND: u64 = 960;
const MTU: usize = 640;
const LINK: LinkNumber = LinkNumber(0);

/// What is on its way to one end, and who waits for it there.
type Wire = Arc<Mutex<(VecDeque<Bytes>, Option<Waker>)>>;

/// One end of a line of 9,600 bits a second.
struct SlowLine {
    out: Wire,
    back: Wire,
    /// The frame that goes out.
    busy: Option<Pin<Box<Sleep>>>,
}

impl FrameMedium for SlowLine {
    fn name(&self) -> String {
        "a slow line".into()
    }

    fn queue(&self) -> QueueLimits {
        QueueLimits { frames: 100, bytes: 2 * MTU }
    }

    fn bytes_per_second(&self) -> Option<u64> {
        Some(2 * BYTES_PER_SECOND)
    }

    fn open(&mut self) -> io::Result<Opening> {
        Ok(Opening { local: MediumAddress::Line, mtu: MTU })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        *address == MediumAddress::Line
    }

    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        _: &MediumAddress,
        frame: &Bytes,
    ) -> Poll<io::Result<Sending>> {
        let span = Duration::from_micros(frame.len() as u64 * 1_000_000 / BYTES_PER_SECOND);
        let busy = self.busy.get_or_insert_with(|| Box::pin(tokio::time::sleep(span)));
        ready!(busy.as_mut().poll(task));
        self.busy = None;
        let mut wire = self.out.lock().unwrap();
        wire.0.push_back(frame.clone());
        wire.1.take().into_iter().for_each(Waker::wake);
        Poll::Ready(Ok(Sending::Sent))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<Arrival>> {
        let mut wire = self.back.lock().unwrap();
        match wire.0.pop_front() {
            Some(frame) => Poll::Ready(Ok(Arrival::Frame { from: MediumAddress::Line, frame })),
            None => {
                wire.1 = Some(task.waker().clone());
                Poll::Pending
            }
        }
    }

    fn close(&mut self) {
        self.busy = None;
    }
}

struct End {
    bundle: RefCell<Bundle>,
    transport: Transport,
    frames: Probe<Received>,
    _reports: Probe<TransportReport>,
    states: RefCell<Vec<LinkState>>,
}

impl End {
    fn new(name: &str, [out, back]: [Wire; 2]) -> Self {
        let medium = SlowLine { out, back, busy: None };
        let transport = Transport::from(FrameTransport::new(medium).start());
        let (frames, reports) = (Probe::start(), Probe::start());
        let (to_frames, to_reports) = (frames.recipient(), reports.recipient());
        transport.attach.do_send(Attach { frames: to_frames, reports: to_reports });
        let mut bundle = Bundle::default();
        let config = LinkConfig::new(NodeName::new(name).unwrap(), Incarnation(1));
        bundle.insert(LINK, Link::new(config, now()));
        bundle.handle_mtu(MTU);
        bundle.handle_rate(2 * BYTES_PER_SECOND);
        let bundle = RefCell::new(bundle);
        End { bundle, transport, frames, _reports: reports, states: RefCell::default() }
    }

    fn send(&self, frame: Bytes) {
        let lane = if is_urgent(&frame) { Lane::Urgent } else { Lane::Usual };
        self.transport.transmit.do_send(Transmit { to: MediumAddress::Line, frame, lane });
    }

    fn carry_on(&self) {
        let mut bundle = self.bundle.borrow_mut();
        for Received { frame, .. } in self.frames.drain() {
            bundle.get_mut(LINK).unwrap().handle_frame(frame, now());
        }
        if bundle.poll_timeout().is_some_and(|due| due <= now()) {
            bundle.handle_timeout(now());
        }
        while let Some(output) = bundle.poll_output() {
            match output {
                BundleOutput::Of(_, LinkOutput::Transmit(frame)) => self.send(frame),
                BundleOutput::Of(_, LinkOutput::Changed { state, .. }) => {
                    self.states.borrow_mut().push(state);
                }
                _ => {}
            }
        }
    }
}

/// Twenty-five seconds during which both nodes say more than there is room for, in frames of this size.
fn flood(size: usize) {
    paused(async {
        let (there, back) = (Wire::default(), Wire::default());
        let left = End::new("left", [there.clone(), back.clone()]);
        let right = End::new("right", [back, there]);
        let bulk = Packet {
            class: Class::Data,
            hops: 1,
            destination: NodeId(1),
            source: NodeId(2),
            payload: Payload::Segment(vec![7; size - 11].into()),
        };
        let bulk = Frame::Data(bulk.encode()).encode();
        assert_eq!(bulk.len(), size);
        (0..2 * MTU / size)
            .for_each(|_| [&left, &right].into_iter().for_each(|end| end.send(bulk.clone())));

        for _ in 0..2_500 {
            for end in [&left, &right] {
                end.send(bulk.clone());
                end.carry_on();
            }
            advance(Duration::from_millis(10)).await;
        }

        for end in [&left, &right] {
            assert_eq!(*end.states.borrow(), [LinkState::Up], "up once, and never suspect");
            let bundle = end.bundle.borrow();
            let link = bundle.get(LINK).unwrap();
            assert_eq!(link.quality().loss_permille, 0);
            assert!(link.hello_interval() < Duration::from_millis(750));
        }
    });
}

#[test]
fn a_link_stays_up_while_its_line_is_full_of_large_frames() {
    flood(MTU);
}

#[test]
fn a_link_stays_up_while_its_line_is_full_of_small_frames() {
    flood(40);
}
