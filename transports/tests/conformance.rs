//! One suite for every medium, plain and behind the fault wrapper. A new medium implements `Medium`
//! here and is held to all of it.
//!
//! Sockets are real, on loopback and ports that the system chose; every wait is for an event.

use actix::dev::ContextFut;
use actix::prelude::*;
use blastema_contract::transport::{
    Attach, Close, MediumAddress, ReadCounters, ReadInjectedFaults, Received, Transmit, Transport,
    TransportCounters, TransportReport,
};
use blastema_doubles::{PATIENCE, Probe, now, paused};
use blastema_ptys::{Adapters, Cable};
use blastema_transports::{
    Faulty, FaultyConfig, FrameTransport, Memory, MemoryConfig, MemoryMedium, SerialConfig,
    SerialLine, SlcanBus, SlcanConfig, Tcp, TcpConfig, Udp, UdpConfig, Unix, UnixConfig,
};
use bytes::Bytes;
use std::cell::Cell;
use std::future::Future;
use std::io::Write;
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{self, Poll};
use tempfile::TempDir;

/// How the suite opens ends of one medium.
trait Medium: Default + 'static {
    /// A peer that is gone is noticed by the medium itself.
    const CONNECTS: bool;
    /// What may wait for a receiver that hangs, in frames, apart from the kernel's buffers.
    const HELD: u64;
    /// What is sent while nobody is at the other end may arrive later.
    const KEEPS: bool = false;

    /// Runs a test on the clock that suits the medium.
    fn run(test: impl Future<Output = ()>);

    /// An end at this address, or anywhere.
    fn open(&self, at: Option<MediumAddress>) -> Opened;

    /// Puts onto the wire what no transport would.
    fn garbage(&self, to: &MediumAddress);
}

/// A transport, and how to throw its present life away.
struct Opened {
    transport: Transport,
    wrapper: Option<Recipient<ReadInjectedFaults>>,
    panic: Rc<Cell<bool>>,
}

/// An end with probes attached.
struct End {
    transport: Transport,
    wrapper: Option<Recipient<ReadInjectedFaults>>,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
    panic: Rc<Cell<bool>>,
}

impl End {
    fn new(Opened { transport, wrapper, panic }: Opened) -> Self {
        let (frames, reports) = attach(&transport);
        End { transport, wrapper, frames, reports, panic }
    }

    /// Waits until it is open; the answer is its address and its mtu.
    async fn opened(&self) -> (MediumAddress, usize) {
        let opened = |report: &TransportReport| matches!(report, TransportReport::Opened { .. });
        match self.reports.wait(opened).await {
            TransportReport::Opened { local, mtu } => (local, mtu),
            other => unreachable!("{other:?} was not waited for"),
        }
    }

    async fn closed(&self) -> String {
        let closed = |report: &TransportReport| matches!(report, TransportReport::Closed { .. });
        match self.reports.wait(closed).await {
            TransportReport::Closed { reason } => reason,
            other => unreachable!("{other:?} was not waited for"),
        }
    }

    fn send(&self, to: &MediumAddress, frame: impl Into<Bytes>) {
        self.transport.transmit.do_send(Transmit::new(to.clone(), frame.into().into()));
    }

    async fn counters(&self) -> TransportCounters {
        self.transport.counters.send(ReadCounters).await.expect("the transport lives")
    }

    /// How many frames were taken from the medium and not thrown away since.
    async fn taken(&self) -> u64 {
        let thrown = match &self.wrapper {
            Some(wrapper) => {
                wrapper.send(ReadInjectedFaults).await.expect("it lives").incoming.overflowed
            }
            None => 0,
        };
        self.counters().await.received - thrown
    }

    /// What was reported, but for what the medium is like.
    fn events(&self) -> Vec<TransportReport> {
        let mut reports = self.reports.drain();
        let is_event = |report: &TransportReport| {
            !matches!(report, TransportReport::Rate { .. } | TransportReport::Bus { .. })
        };
        reports.retain(is_event);
        reports
    }

    /// Waits until the counters are as wanted.
    async fn counted(&self, what: &str, wanted: impl Fn(&TransportCounters) -> bool) {
        let counted = async {
            while !wanted(&self.counters().await) {
                tokio::task::yield_now().await;
            }
        };
        let waited = tokio::time::timeout(PATIENCE, counted).await;
        assert!(waited.is_ok(), "{what}: {:?}", self.counters().await);
    }

    /// Sends until it arrives there, for a medium may lose frames while a peer comes back. The answer
    /// is whether anything else arrived before.
    async fn send_until_received(
        &self,
        to: &MediumAddress,
        frame: &'static str,
        receiver: &End,
    ) -> bool {
        let arrived = async {
            let mut other = false;
            loop {
                self.send(to, frame);
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

fn attach(transport: &Transport) -> (Probe<Received>, Probe<TransportReport>) {
    let (frames, reports) = (Probe::start(), Probe::start());
    transport.attach.do_send(Attach { frames: frames.recipient(), reports: reports.recipient() });
    (frames, reports)
}

/// Starts an actor as the guardian of the node does, which gives it its next life after a panic.
fn start<A: Actor<Context = Context<A>> + Supervised>(actor: A) -> (Addr<A>, Rc<Cell<bool>>) {
    struct Ward<A: Actor<Context = Context<A>>>(ContextFut<A, Context<A>>, Rc<Cell<bool>>);
    impl<A: Actor<Context = Context<A>> + Supervised> Future for Ward<A> {
        type Output = ();
        fn poll(mut self: Pin<&mut Self>, task: &mut task::Context<'_>) -> Poll<()> {
            if self.1.take() {
                self.0.restart();
            }
            Pin::new(&mut self.0).poll(task)
        }
    }
    let future = Context::new().into_future(actor);
    let (address, panic) = (future.address(), Rc::new(Cell::new(false)));
    actix_rt::spawn(Ward(future, panic.clone()));
    (address, panic)
}

#[derive(Default)]
struct OverMemory(MemoryMedium, Cell<u32>);

impl Medium for OverMemory {
    const CONNECTS: bool = false;
    const HELD: u64 = 256 + 1024;

    fn run(test: impl Future<Output = ()>) {
        paused(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let name = match at {
            Some(MediumAddress::Memory(name)) => name,
            _ => {
                self.1.set(self.1.get() + 1);
                format!("end {}", self.1.get()).into()
            }
        };
        let (address, panic) = start(Memory::new(MemoryConfig::new(&self.0, &name)));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    /// What is in memory is typed.
    fn garbage(&self, _: &MediumAddress) {}
}

fn ip(address: &MediumAddress) -> SocketAddr {
    match address {
        MediumAddress::Ip(address) => *address,
        other => panic!("{other} is no address of IP"),
    }
}

fn in_real_time(test: impl Future<Output = ()>) {
    actix_rt::System::new().block_on(test);
}

#[derive(Default)]
struct OverUdp;

impl Medium for OverUdp {
    const CONNECTS: bool = false;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = UdpConfig::default();
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        let (address, panic) = start(Udp::new(config));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
        for length in [0, 1, 7, 1000, 65_507] {
            stranger.send_to(&vec![0xA5; length], ip(to)).unwrap();
        }
    }
}

/// Those who hear one group also speak to each other alone.
struct OverMulticast(SocketAddr);

impl Default for OverMulticast {
    fn default() -> Self {
        let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        OverMulticast(([239, 255, 77, 2], free).into())
    }
}

impl Medium for OverMulticast {
    const CONNECTS: bool = false;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = UdpConfig::default();
        config.group = Some(self.0);
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        let (address, panic) = start(Udp::new(config));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
        for length in [0, 1, 7, 1000] {
            stranger.send_to(&vec![0xA5; length], ip(to)).unwrap();
            stranger.send_to(&vec![0xA5; length], self.0).unwrap();
        }
    }
}

#[derive(Default)]
struct OverTcp;

impl Medium for OverTcp {
    const CONNECTS: bool = true;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = TcpConfig::default();
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        let (address, panic) = start(Tcp::new(config));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        for bytes in
            [&b""[..], b"B", b"GET / HTTP/1.1\r\n\r\n", &[0xFF; 4096], b"BLST\x01\0\0\x07\xFF"]
        {
            let mut stranger = TcpStream::connect(ip(to)).unwrap();
            // It may be thrown out before it has said everything.
            let _ = stranger.write_all(bytes);
        }
    }
}

struct OverUnix(TempDir, Cell<u32>);

impl Default for OverUnix {
    fn default() -> Self {
        OverUnix(TempDir::new().unwrap(), Cell::new(0))
    }
}

impl Medium for OverUnix {
    const CONNECTS: bool = true;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let path = match at {
            Some(MediumAddress::Unix(path)) => path.to_path_buf(),
            _ => {
                self.1.set(self.1.get() + 1);
                self.0.path().join(self.1.get().to_string())
            }
        };
        let (address, panic) = start(Unix::new(UnixConfig::new(path)));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        let MediumAddress::Unix(path) = to else { panic!("{to} is no path") };
        for bytes in
            [&b""[..], b"B", b"GET / HTTP/1.1\r\n\r\n", &[0xFF; 4096], b"BLST\x01\x01\0\x02/x\xFF"]
        {
            let mut stranger = UnixStream::connect(path).unwrap();
            // It may be thrown out before it has said everything.
            let _ = stranger.write_all(bytes);
        }
    }
}

/// A line has two ends; whoever opens again opens the one that was opened last.
struct OverSerial(Cable, Cell<u32>);

impl Default for OverSerial {
    fn default() -> Self {
        OverSerial(Cable::new(), Cell::new(0))
    }
}

impl OverSerial {
    fn last(&self) -> PathBuf {
        if self.1.get() == 1 { self.0.left() } else { self.0.right() }
    }
}

impl Medium for OverSerial {
    const CONNECTS: bool = false;
    const HELD: u64 = 256;
    // The cable does.
    const KEEPS: bool = true;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        if at.is_none() {
            self.1.set(self.1.get() + 1);
        }
        let mut config = SerialConfig::new(self.last());
        (config.baud, config.mtu) = (50_000_000, Some(65_535));
        let (address, panic) = start(FrameTransport::new(SerialLine::new(config, now)));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, _: &MediumAddress) {
        for bytes in [&b"\0"[..], b"Linux login: ", &[0xFF; 300], b"\0\x05abc"] {
            self.0.inject(&self.last(), bytes);
        }
    }
}

/// Each end has an adapter of its own, whose number is its address.
struct OverSlcan(Adapters, Cell<u8>);

impl Default for OverSlcan {
    fn default() -> Self {
        OverSlcan(Adapters::new(), Cell::new(0))
    }
}

impl Medium for OverSlcan {
    const CONNECTS: bool = false;
    const HELD: u64 = 256;

    fn run(test: impl Future<Output = ()>) {
        in_real_time(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let address = match at {
            Some(MediumAddress::Can(address)) => address,
            _ => {
                self.1.set(self.1.get() + 1);
                self.0.plug(self.1.get());
                self.1.get()
            }
        };
        let mut config = SlcanConfig::new(self.0.port(address));
        config.bitrate = 1_000_000;
        (config.node.address, config.node.mtu) = (address, 65_000);
        config.node.queue_frames = 256;
        let (address, panic) =
            start(FrameTransport::new(SlcanBus::new(config, blastema_doubles::now)));
        Opened { transport: address.into(), wrapper: None, panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        let MediumAddress::Can(number) = to else { panic!("{to} is on no bus") };
        for bytes in [
            &b"\x07\x07Linux login: \r"[..],
            b"\x00\xff\xfe\r",
            b"T18DA",
            b"\rt1239\rT18DA",
            &[0xFF; 300],
            // CAN frames that mean nothing, of a node that is not there.
            b"\rT18DA0163821FFFFFFFFFFFFFF\r",
            b"T18DA026330FFFF\rT18DB FF6380500\r",
        ] {
            self.0.inject(*number, bytes);
        }
    }
}

/// Any medium behind the fault wrapper, which is told nothing.
#[derive(Default)]
struct Behind<M>(M);

impl<M: Medium> Medium for Behind<M> {
    const CONNECTS: bool = M::CONNECTS;
    // What the wrapper holds back comes on top.
    const HELD: u64 = M::HELD + 256 + 4096;
    const KEEPS: bool = M::KEEPS;

    fn run(test: impl Future<Output = ()>) {
        M::run(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let inner = self.0.open(at).transport;
        let (address, panic) =
            start(Faulty::new(inner, FaultyConfig::new(7, blastema_doubles::now)));
        Opened { wrapper: Some(address.clone().recipient()), transport: address.into(), panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        self.0.garbage(to);
    }
}

/// Never takes a message from its mailbox.
struct Hung;

impl Actor for Hung {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.wait(actix::fut::wrap_future(std::future::pending()));
    }
}

impl Handler<Received> for Hung {
    type Result = ();
    fn handle(&mut self, _: Received, _: &mut Context<Self>) {}
}

async fn frames_arrive_whole<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, _)) = (a.opened().await, b.opened().await);

    for length in [1, 100, 1_000, 10_000, 60_000] {
        let frame: Bytes = (0..length).map(|i| (i % 251) as u8).collect();
        a.send(&at_b, frame.clone());
        assert_eq!(b.frames.expect().await, Received { from: at_a.clone(), frame: frame.clone() });
        b.send(&at_a, frame.clone());
        assert_eq!(a.frames.expect().await, Received { from: at_b.clone(), frame });
    }
    let TransportCounters { sent, received, dropped, refused, .. } = a.counters().await;
    assert_eq!((sent, received, dropped, refused), (5, 5, 0, 0));
}

async fn the_empty_and_the_largest_frame_arrive<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((_, mtu), (at_b, _)) = (a.opened().await, b.opened().await);

    for length in [0, mtu, 0] {
        a.send(&at_b, vec![7; length]);
        assert_eq!(b.frames.expect().await.frame, vec![7; length]);
    }
}

async fn a_frame_that_is_too_large_is_refused_and_counted<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((_, mtu), (at_b, _)) = (a.opened().await, b.opened().await);

    a.send(&at_b, vec![7; mtu + 1]);
    a.send(&at_b, "small");

    assert_eq!(b.frames.expect().await.frame, "small");
    a.counted("one refused", |counters| (counters.refused, counters.sent) == (1, 1)).await;
}

async fn an_address_of_another_medium_is_refused_and_counted<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at_a, _) = a.opened().await;

    a.send(
        &match at_a {
            MediumAddress::Memory(_) => MediumAddress::Ip(([127, 0, 0, 1], 9).into()),
            _ => MediumAddress::Memory("nowhere".into()),
        },
        "lost",
    );

    a.counted("one refused", |counters| counters.refused == 1).await;
}

async fn many_frames_keep_their_order_and_none_is_doubled<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);

    // In bursts that every medium can hold.
    for burst in 0..20_u32 {
        for number in burst * 100..(burst + 1) * 100 {
            a.send(&at_b, number.to_be_bytes().to_vec());
        }
        for number in burst * 100..(burst + 1) * 100 {
            assert_eq!(b.frames.expect().await.frame, number.to_be_bytes()[..]);
        }
    }
    assert_eq!(b.frames.recorded(), 0);
}

async fn attaching_replaces_who_was_attached_and_tells_the_present_state<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, mtu)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "to the first");
    assert_eq!(b.frames.expect().await.frame, "to the first");

    let (frames, reports) = attach(&b.transport);
    let opened = TransportReport::Opened { local: at_b.clone(), mtu };
    assert_eq!(reports.expect().await, opened);
    a.send(&at_b, "to the second");

    assert_eq!(frames.expect().await.frame, "to the second");
    assert_eq!(b.frames.recorded(), 0);
}

async fn a_peer_that_is_gone_and_back_is_reached_again<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    b.transport.close.do_send(Close);
    b.closed().await;
    if M::CONNECTS {
        assert_eq!(a.reports.expect().await, TransportReport::PeerLost { peer: at_b.clone() });
    }
    (0..100).for_each(|_| a.send(&at_b, "into the void"));
    a.counters().await;

    let b = End::new(medium.open(Some(at_b.clone())));
    b.opened().await;
    let stale = a.send_until_received(&at_b, "after", &b).await;
    assert!(M::KEEPS || !stale, "what was sent into the void arrived");
    assert_eq!(a.events(), []);
}

async fn closing_releases_the_port<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at, _) = a.opened().await;

    a.transport.close.do_send(Close);
    a.closed().await;
    let b = End::new(medium.open(Some(at.clone())));

    assert_eq!(b.opened().await.0, at);
}

async fn a_port_that_is_taken_is_reported_and_opened_when_it_is_free<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at, _) = a.opened().await;

    let b = End::new(medium.open(Some(at.clone())));
    let reason = b.closed().await;
    assert!(reason.contains("or choose another"), "{reason}");
    let (_, reports) = attach(&b.transport);
    assert_eq!(reports.expect().await, TransportReport::Closed { reason });

    a.transport.close.do_send(Close);
    let opened = reports.expect().await;
    assert!(matches!(opened, TransportReport::Opened { local, .. } if local == at));
}

async fn garbage_on_the_wire_harms_nobody<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, _)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    for _ in 0..10 {
        medium.garbage(&at_b);
        a.send(&at_b, "after");
        let from_a = |received: &Received| received.from == at_a;
        assert_eq!(b.frames.wait(from_a).await.frame, "after");
    }

    let lost = |report: &TransportReport| !matches!(report, TransportReport::PeerLost { peer } if *peer != at_a);
    assert!(!b.events().iter().any(lost));
    assert_eq!(a.events(), []);
}

async fn a_flood_before_a_receiver_that_hangs_stays_bounded<M: Medium>() {
    const FLOOD: u64 = 20_000;
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);
    let reports = Probe::start();
    let hung = Attach { frames: Hung.start().recipient(), reports: reports.recipient() };
    b.transport.attach.do_send(hung);
    reports.expect().await;

    for _ in 0..FLOOD / 100 {
        (0..100).for_each(|_| a.send(&at_b, vec![7; 1000]));
        tokio::task::yield_now().await;
    }
    b.counted("it has taken what it may", |counters| counters.received >= 256).await;
    // All the while it takes orders: a hundred of them later it has not taken more.
    for _ in 0..100 {
        b.counters().await;
        tokio::task::yield_now().await;
    }
    let held = b.taken().await;
    assert!(held <= M::HELD, "{held} frames are held");

    // Somebody who does take frames gets what comes from now on.
    let (frames, _) = attach(&b.transport);
    let fresh = async {
        loop {
            a.send(&at_b, "fresh");
            b.counters().await;
            tokio::task::yield_now().await;
            if frames.drain().iter().any(|received| received.frame == "fresh") {
                break;
            }
        }
    };
    assert!(tokio::time::timeout(PATIENCE, fresh).await.is_ok(), "{:?}", b.counters().await);
}

async fn the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, mtu)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    b.panic.set(true);
    b.counters().await;

    assert_eq!(b.opened().await, (at_b.clone(), mtu));
    a.send_until_received(&at_b, "after", &b).await;
    b.send_until_received(&at_a, "back", &a).await;
    assert!(b.counters().await.received >= 2, "counters outlive the panic");
}

/// Instantiates the suite for one medium.
macro_rules! conformance {
    ($module:ident, $medium:ty: $($test:ident),+ $(,)?) => {
        mod $module {
            use super::*;
            $(
                #[test]
                fn $test() {
                    <$medium as Medium>::run(super::$test::<$medium>());
                }
            )+
        }
    };
    ($($module:ident: $medium:ty),+ $(,)?) => {
        $(conformance! {
            $module, $medium:
            frames_arrive_whole,
            the_empty_and_the_largest_frame_arrive,
            a_frame_that_is_too_large_is_refused_and_counted,
            an_address_of_another_medium_is_refused_and_counted,
            many_frames_keep_their_order_and_none_is_doubled,
            attaching_replaces_who_was_attached_and_tells_the_present_state,
            a_peer_that_is_gone_and_back_is_reached_again,
            closing_releases_the_port,
            a_port_that_is_taken_is_reported_and_opened_when_it_is_free,
            garbage_on_the_wire_harms_nobody,
            a_flood_before_a_receiver_that_hangs_stays_bounded,
            the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
        })+
    };
}

conformance! {
    memory: OverMemory,
    udp: OverUdp,
    multicast: OverMulticast,
    tcp: OverTcp,
    unix: OverUnix,
    serial: OverSerial,
    slcan: OverSlcan,
    memory_behind_the_wrapper: Behind<OverMemory>,
    udp_behind_the_wrapper: Behind<OverUdp>,
    tcp_behind_the_wrapper: Behind<OverTcp>,
    unix_behind_the_wrapper: Behind<OverUnix>,
    serial_behind_the_wrapper: Behind<OverSerial>,
    slcan_behind_the_wrapper: Behind<OverSlcan>,
}

/// CAN as the system has it; only the guest of `tests/guest` has any.
#[cfg(guest)]
mod socket_can {
    use super::*;
    use blastema_transports::{CanBus, CanConfig};
    use socketcan::{CanDataFrame, CanFdSocket, EmbeddedFrame, ExtendedId, Socket};
    use std::sync::atomic::{AtomicU8, Ordering};

    const INTERFACE: &str = "vcan0";
    /// All tests share the interface: no address is used twice.
    static NEXT: AtomicU8 = AtomicU8::new(1);

    #[derive(Default)]
    struct OverCan<const FD: bool>;

    impl<const FD: bool> Medium for OverCan<FD> {
        const CONNECTS: bool = false;
        const HELD: u64 = 256;

        fn run(test: impl Future<Output = ()>) {
            in_real_time(test);
        }

        fn open(&self, at: Option<MediumAddress>) -> Opened {
            let mut config = CanConfig::new(INTERFACE);
            (config.fd, config.bit_rate_switch) = (FD, FD);
            config.node.address = match at {
                Some(MediumAddress::Can(address)) => address,
                _ => NEXT.fetch_add(1, Ordering::Relaxed),
            };
            (config.node.mtu, config.node.queue_frames) = (65_000, 256);
            let (address, panic) =
                start(FrameTransport::new(CanBus::new(config, blastema_doubles::now)));
            Opened { transport: address.into(), wrapper: None, panic }
        }

        fn garbage(&self, to: &MediumAddress) {
            let MediumAddress::Can(number) = to else { panic!("{to} is on no bus") };
            let bus = CanFdSocket::open(INTERFACE).unwrap();
            let id = ExtendedId::new(0x18da_00fe | u32::from(*number) << 8).unwrap();
            for data in [&b""[..], b"\xff", b"\x21abc", b"\x30", b"\x10\x20abcdef", b"\x00"] {
                bus.write_frame(&CanDataFrame::new(id, data).unwrap()).unwrap();
            }
        }
    }

    // No port is taken: any number of programs can use one interface.
    conformance! {
        classic, OverCan<false>:
        frames_arrive_whole,
        the_empty_and_the_largest_frame_arrive,
        a_frame_that_is_too_large_is_refused_and_counted,
        an_address_of_another_medium_is_refused_and_counted,
        many_frames_keep_their_order_and_none_is_doubled,
        attaching_replaces_who_was_attached_and_tells_the_present_state,
        a_peer_that_is_gone_and_back_is_reached_again,
        closing_releases_the_port,
        garbage_on_the_wire_harms_nobody,
        a_flood_before_a_receiver_that_hangs_stays_bounded,
        the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
    }
    conformance! {
        fd, OverCan<true>:
        frames_arrive_whole,
        the_empty_and_the_largest_frame_arrive,
        a_frame_that_is_too_large_is_refused_and_counted,
        an_address_of_another_medium_is_refused_and_counted,
        many_frames_keep_their_order_and_none_is_doubled,
        attaching_replaces_who_was_attached_and_tells_the_present_state,
        a_peer_that_is_gone_and_back_is_reached_again,
        closing_releases_the_port,
        garbage_on_the_wire_harms_nobody,
        a_flood_before_a_receiver_that_hangs_stays_bounded,
        the_next_life_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
    }
}
