//! Links and sessions on slow lines that are always full.

use actix::Actor;
use blastema_contract::transport::{
    Attach, MediumAddress, Received, Transmit, Transport, TransportReport,
};
use blastema_core::medium::lane::FrameLane;
use blastema_core::net::link::{LinkConfig, LinkOutput, LinkState};
use blastema_core::net::session::ordering_key::OrderingKey;
use blastema_core::net::session::{Session, SessionConfig, SessionOutput};
use blastema_core::net::wire::frame::{FRAME_HEADER, Frame, is_hello, is_urgent};
use blastema_core::net::wire::packet::{PACKET_HEADER, Packet, Payload};
use blastema_core::net::{Link, LinkId, LinkSet, LinkSetOutput, NodeId, PacketPriority};
use blastema_core::{GatherBuffer, Incarnation, Machine, NodeName, TrafficClass};
use blastema_doubles::{Probe, advance, now, paused};
use blastema_transports::frame_medium::{MediumEvent, OpenedMedium, QueueLimits, SendResult};
use blastema_transports::serial::framing::encoded_length;
use blastema_transports::{FrameMedium, FrameTransport, SerialConfig, SerialLine};
use bytes::Bytes;
use std::cell::RefCell;
use std::collections::VecDeque;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker, ready};
use std::time::Duration;
use tokio::time::Sleep;

const LINK: LinkId = LinkId(0);

/// What is on its way to one end, and who waits for it there.
type Wire = Arc<Mutex<(VecDeque<Bytes>, Option<Waker>)>>;

/// One end of a serial line, which takes its time.
struct SlowLine {
    config: SerialConfig,
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
        SerialLine::new(self.config.clone(), now).queue()
    }

    fn bytes_per_second(&self) -> Option<u64> {
        SerialLine::new(self.config.clone(), now).bytes_per_second()
    }

    fn open(&mut self) -> io::Result<OpenedMedium> {
        Ok(OpenedMedium { local: MediumAddress::Line, mtu: self.config.mtu() })
    }

    fn knows(&self, address: &MediumAddress) -> bool {
        *address == MediumAddress::Line
    }

    fn poll_send(
        &mut self,
        task: &mut Context<'_>,
        _: &MediumAddress,
        frame: &Bytes,
        _: FrameLane,
    ) -> Poll<io::Result<SendResult>> {
        let span = self.config.time_of(encoded_length(frame.len()));
        let busy = self.busy.get_or_insert_with(|| Box::pin(tokio::time::sleep(span)));
        ready!(busy.as_mut().poll(task));
        self.busy = None;
        let mut wire = self.out.lock().unwrap();
        wire.0.push_back(frame.clone());
        wire.1.take().into_iter().for_each(Waker::wake);
        Poll::Ready(Ok(SendResult::Sent))
    }

    fn poll_receive(&mut self, task: &mut Context<'_>) -> Poll<io::Result<MediumEvent>> {
        let mut wire = self.back.lock().unwrap();
        match wire.0.pop_front() {
            Some(frame) => Poll::Ready(Ok(MediumEvent::Frame { from: MediumAddress::Line, frame })),
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
    links: RefCell<LinkSet>,
    session: RefCell<Session>,
    transport: Transport,
    frames: Probe<Received>,
    _reports: Probe<TransportReport>,
    states: RefCell<Vec<LinkState>>,
    /// What the session has delivered.
    came: RefCell<Vec<Bytes>>,
    mtu: usize,
}

impl End {
    fn new([name, other]: [&str; 2], baud: u32, [out, back]: [Wire; 2]) -> Self {
        let mut line = SerialConfig::new("/dev/null");
        line.baud = Some(baud);
        let mtu = line.mtu();
        let medium = SlowLine { config: line, out, back, busy: None };
        let rate = medium.bytes_per_second().unwrap();
        let transport = Transport::from(FrameTransport::new(medium).start());
        let (frames, reports) = (Probe::start(), Probe::start());
        let (to_frames, to_reports) = (frames.recipient(), reports.recipient());
        transport.attach.do_send(Attach::new(to_frames, to_reports));
        let mut links = LinkSet::default();
        let [name, other] = [name, other].map(|name| NodeName::new(name).unwrap());
        let config = LinkConfig::new(name.clone(), Incarnation(1));
        links.insert(LINK, Link::new(config, now()));
        links.handle_mtu(mtu, false);
        links.handle_rate(rate);
        let session = Session::new(SessionConfig::new(name, Incarnation(1), other), now());
        End {
            links: RefCell::new(links),
            session: RefCell::new(session),
            transport,
            frames,
            _reports: reports,
            states: RefCell::default(),
            came: RefCell::default(),
            mtu,
        }
    }

    fn send(&self, frame: GatherBuffer) {
        let lane = match &frame {
            frame if is_hello(frame) => FrameLane::Hello,
            frame if is_urgent(frame) => FrameLane::Urgent,
            _ => FrameLane::Usual,
        };
        self.transport.transmit.do_send(Transmit { to: MediumAddress::Line, frame, lane });
    }

    fn say(&self, stream: TrafficClass, message: Bytes) {
        let key = OrderingKey::default();
        self.session.borrow_mut().handle_send_along(stream, key, message, None, now()).unwrap();
        self.carry_on();
    }

    /// Whether this has come; it is taken out.
    fn takes(&self, message: &[u8]) -> bool {
        let mut came = self.came.borrow_mut();
        let at = came.iter().position(|came| came == message);
        at.map(|at| came.remove(at)).is_some()
    }

    fn carry_on(&self) {
        let (mut links, mut session) = (self.links.borrow_mut(), self.session.borrow_mut());
        for Received { frame, .. } in self.frames.drain() {
            links.get_mut(LINK).unwrap().handle_frame(frame, now());
        }
        if links.poll_timeout().is_some_and(|due| due <= now()) {
            links.handle_timeout(now());
        }
        if session.poll_timeout().is_some_and(|due| due <= now()) {
            session.handle_timeout(now());
        }
        loop {
            if let Some(output) = links.poll_output() {
                match output {
                    LinkSetOutput::Of(_, LinkOutput::Transmit(frame)) => self.send(frame),
                    LinkSetOutput::Of(_, LinkOutput::Changed { state, .. }) => {
                        self.states.borrow_mut().push(state);
                        session.handle_incarnation(Incarnation(1), now());
                        session.handle_path(self.mtu - FRAME_HEADER - PACKET_HEADER, now());
                    }
                    LinkSetOutput::Of(_, LinkOutput::Packet(bytes)) => {
                        if let Ok(Packet { payload: Payload::Segment(segment), .. }) =
                            Packet::decode(bytes)
                        {
                            session.handle_segment(segment.into_bytes(), now());
                        }
                    }
                    _ => {}
                }
                continue;
            }
            match session.poll_output() {
                Some(SessionOutput::Transmit { class, segment, .. }) => {
                    let packet = packet(class, segment).parcel();
                    links.get_mut(LINK).unwrap().handle_packet(packet);
                }
                Some(SessionOutput::Message { message, .. }) => {
                    self.came.borrow_mut().push(message);
                }
                Some(SessionOutput::Ended { why, .. }) => panic!("the session ended: {why}"),
                Some(_) => {}
                None => return,
            }
        }
    }
}

fn packet(class: PacketPriority, segment: GatherBuffer) -> Packet {
    let payload = Payload::Segment(segment);
    Packet { class, hops: 1, destination: NodeId(1), source: NodeId(2), passed: vec![], payload }
}

/// Both ends of a line of so many bits a second.
fn ends(baud: u32) -> [End; 2] {
    let (there, back) = (Wire::default(), Wire::default());
    let left = End::new(["left", "right"], baud, [there.clone(), back.clone()]);
    [left, End::new(["right", "left"], baud, [back, there])]
}

/// Twenty-five seconds during which both nodes say more than there is room for, in frames of this
/// size, beside control that is not answered.
fn flood(size: usize) {
    paused(async {
        let ends = ends(9_600);
        let bulk =
            |class| Frame::Data(packet(class, vec![7; size - 11].into()).encode().into()).encode();
        assert_eq!(bulk(PacketPriority::Data).len(), size);

        for _ in 0..2_500 {
            for end in &ends {
                end.send(bulk(PacketPriority::Data).into());
                end.send(bulk(PacketPriority::Control).into());
                end.carry_on();
            }
            advance(Duration::from_millis(10)).await;
        }

        for end in &ends {
            assert_eq!(*end.states.borrow(), [LinkState::Up], "up once, and never suspect");
            let links = end.links.borrow();
            let link = links.get(LINK).unwrap();
            assert_eq!(link.quality().loss_permille, 0);
            assert!(link.hello_interval() < Duration::from_millis(600));
        }
    });
}

#[test]
fn a_link_stays_up_while_its_line_is_full_of_large_frames() {
    flood(96);
}

#[test]
fn a_link_stays_up_while_its_line_is_full_of_small_frames() {
    flood(40);
}

/// Both nodes say 30,000 bytes at once, and beside it every half second something small that goes
/// every way, which comes within `bound` each time.
fn bulk_both_ways(baud: u32, bound: Duration) {
    paused(async {
        let step = Duration::from_millis(10) * 9_600 / baud;
        let ends = ends(baud);
        while ends.iter().any(|end| end.session.borrow().peer().is_none()) {
            ends.iter().for_each(End::carry_on);
            advance(step).await;
        }
        let wire = SerialConfig::new("/dev/null").time_of(30_000) * 115_200 / baud;
        let began = now();
        ends.iter().for_each(|end| end.say(TrafficClass::Request, vec![7; 30_000].into()));

        let (mut longest, mut asked) = (Duration::ZERO, began);
        let mut waits = false;
        while ends.iter().any(|end| !end.came.borrow().iter().any(|came| came.len() == 30_000)) {
            if !waits && now() - asked >= Duration::from_millis(500) {
                (waits, asked) = (true, now());
                ends[0].say(TrafficClass::Redundant, Bytes::from_static(b"stop"));
            }
            ends.iter().for_each(End::carry_on);
            if ends[1].takes(b"stop") {
                waits = false;
                longest = longest.max(now() - asked);
            }
            let fair = (now() - began) * 2 < wire * 5;
            assert!(fair, "two fifths of the line are the bulk's at least");
            advance(step).await;
        }

        assert!(longest < bound, "{longest:?}");
        for end in &ends {
            assert_eq!(*end.states.borrow(), [LinkState::Up], "up once, and never suspect");
            assert_eq!(end.session.borrow().counters().retransmitted, 0);
        }
    });
}

#[test]
fn bulk_both_ways_takes_no_line_of_9600_baud_down_and_keeps_no_stop_for_long() {
    bulk_both_ways(9_600, Duration::from_millis(400));
}

#[test]
fn bulk_both_ways_takes_no_line_of_38400_baud_down_and_keeps_no_stop_for_long() {
    if !blastema_doubles::long() {
        return;
    }
    bulk_both_ways(38_400, Duration::from_millis(200));
}

#[test]
fn bulk_both_ways_takes_no_line_of_115200_baud_down_and_keeps_no_stop_for_long() {
    if !blastema_doubles::long() {
        return;
    }
    bulk_both_ways(115_200, Duration::from_millis(200));
}
