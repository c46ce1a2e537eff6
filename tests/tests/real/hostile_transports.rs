//! An attacker that reaches a port may send anything to it. Real sockets on loopback; assertions
//! are about counters, never about a clock.

use actix::prelude::*;
use blastema_contract::transport::{
    Attach, MediumAddress, ReadCounters, Received, Transmit, Transport, TransportCounters,
    TransportReport,
};
use blastema_doubles::{PATIENCE, Probe};
use blastema_transports::tcp::framing::{PREAMBLE, encode_header, encode_preamble};
use blastema_transports::{Tcp, TcpConfig, Udp, UdpConfig};
use bytes::Bytes;
use std::future::Future;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// A transport under attack, or a peer of good will.
struct End {
    transport: Transport,
    local: SocketAddr,
    frames: Probe<Received>,
    reports: Probe<TransportReport>,
}

impl End {
    async fn open(transport: Transport) -> Self {
        let (frames, reports) = (Probe::start(), Probe::start());
        let attach = Attach::new(frames.recipient(), reports.recipient());
        transport.attach.do_send(attach);
        match reports.expect().await {
            TransportReport::Opened { local: MediumAddress::Ip(local), .. } => {
                End { transport, local, frames, reports }
            }
            other => panic!("{other:?}"),
        }
    }

    async fn udp(config: UdpConfig) -> Self {
        End::open(Udp::new(config).start().into()).await
    }

    async fn tcp() -> Self {
        End::open(Tcp::new(TcpConfig::default()).start().into()).await
    }

    fn send(&self, to: &End, frame: impl Into<Bytes>) {
        let to = MediumAddress::Ip(to.local);
        self.transport.transmit.do_send(Transmit::new(to, frame.into().into()));
    }

    async fn counters(&self) -> TransportCounters {
        self.transport.counters.send(ReadCounters).await.expect("it lives through everything")
    }

    async fn counted(&self, wanted: impl Fn(&TransportCounters) -> bool) {
        let counted = async {
            while !wanted(&self.counters().await) {
                tokio::task::yield_now().await;
            }
        };
        let waited = tokio::time::timeout(PATIENCE, counted).await;
        assert!(waited.is_ok(), "{:?}", self.counters().await);
    }

    /// Asks over and over until the other has heard, for what comes while a buffer is full is lost.
    async fn reaches(&self, to: &End, word: Bytes) {
        let from = MediumAddress::Ip(self.local);
        let heard = async {
            loop {
                self.send(to, word.clone());
                self.counters().await;
                tokio::task::yield_now().await;
                // What the attacker sends is thrown away here, as a link does.
                let mut arrived = to.frames.drain().into_iter();
                if arrived.any(|received| received.from == from && received.frame == word) {
                    break;
                }
            }
        };
        let waited = tokio::time::timeout(PATIENCE, heard).await;
        assert!(waited.is_ok(), "{:?} {:?}", self.counters().await, to.counters().await);
    }
}

fn run(test: impl Future<Output = ()>) {
    actix_rt::System::new().block_on(test);
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

/// Sends garbage from a thread of its own, as fast as it can, until it is dropped.
struct Flood {
    stop: Arc<AtomicBool>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Flood {
    fn at(target: SocketAddr) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = thread::spawn(move || {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("loopback has a free port");
            let garbage = [0xA5; 2000];
            for length in (0..garbage.len()).cycle() {
                if stopped.load(Ordering::Relaxed) {
                    break;
                }
                // A send that fails for want of buffers is part of a flood.
                let _ = socket.send_to(&garbage[..length], target);
            }
        });
        Flood { stop, thread: Some(thread) }
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().map(thread::JoinHandle::join);
        assert!(matches!(ended, Some(Ok(()))));
    }
}

#[test]
fn a_flood_of_garbage_datagrams_keeps_no_friend_out() {
    let _turn = blastema_doubles::turn();
    run(async {
        let mut config = UdpConfig::default();
        config.mtu = Some(1000);
        let (target, friend) = (End::udp(config.clone()).await, End::udp(config).await);
        let flood = Flood::at(target.local);

        target.counted(|counters| counters.received > 10_000).await;
        for number in 0..20_u8 {
            friend.reaches(&target, vec![number].into()).await;
        }
        drop(flood);

        let TransportCounters { received, refused, .. } = target.counters().await;
        assert!(received > 10_000 && refused > 1000, "{received} received, {refused} refused");
        assert!(target.reports.drain().is_empty(), "it was open all the while");
    });
}

#[test]
fn a_flood_before_a_receiver_that_hangs_fills_the_kernels_buffer_and_not_ours() {
    let _turn = blastema_doubles::turn();
    run(async {
        let target = End::udp(UdpConfig::default()).await;
        let reports = Probe::start();
        let hung = Attach::new(Hung.start().recipient(), reports.recipient());
        target.transport.attach.do_send(hung);
        reports.expect().await;
        let flood = Flood::at(target.local);

        target.counted(|counters| counters.received >= 256).await;
        for _ in 0..1000 {
            target.counters().await;
            tokio::task::yield_now().await;
        }

        drop(flood);
        assert_eq!(target.counters().await.received, 256);
    });
}

#[test]
fn a_thousand_connections_that_say_nothing_keep_no_friend_out() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (target, friend) = (End::tcp().await, End::tcp().await);
        friend.reaches(&target, "before".into()).await;
        let late = End::tcp().await;

        let mut silent = Vec::new();
        for _ in 0..1000 {
            silent.push(TcpStream::connect(target.local).await.expect("loopback takes it"));
        }

        // As many as have a place as strangers are still there, and no more.
        let places = TcpConfig::default().strangers as u64;
        target.counted(|counters| counters.refused >= 1000 - places).await;
        friend.reaches(&target, "meanwhile".into()).await;
        late.reaches(&target, "who comes late".into()).await;
        target.reaches(&friend, "the other way".into()).await;
        assert!(friend.reports.drain().is_empty(), "the friend's connection was never lost");
        drop(silent);
    });
}

#[test]
fn a_thousand_strangers_who_claim_to_be_peers_are_bounded_and_keep_no_friend_out() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (target, friend) = (End::tcp().await, End::tcp().await);
        friend.reaches(&target, "before".into()).await;

        let mut claimants = Vec::new();
        for port in 1..=1000_u16 {
            let mut claimant = TcpStream::connect(target.local).await.expect("loopback takes it");
            claimant.write_all(&encode_preamble(port)).await.expect("a fresh buffer is empty");
            claimants.push(claimant);
        }

        // The friend has one of the places.
        let places = TcpConfig::default().peers as u64 - 1;
        target.counted(|counters| counters.refused + counters.errors >= 1000 - places).await;
        friend.reaches(&target, "meanwhile".into()).await;
        target.reaches(&friend, "the other way".into()).await;
        assert!(friend.reports.drain().is_empty(), "the friend's connection was never lost");
        drop(claimants);
    });
}

#[test]
fn lengths_beyond_the_limit_are_refused_before_anything_is_kept_for_them() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (target, friend) = (End::tcp().await, End::tcp().await);
        friend.reaches(&target, "before".into()).await;

        for length in [u32::MAX, 1 << 31, 64 * 1024 + 1].into_iter().cycle().take(300) {
            let mut liar = TcpStream::connect(target.local).await.expect("loopback takes it");
            liar.write_all(&encode_preamble(7)).await.expect("a fresh buffer is empty");
            let mut kept = [0; PREAMBLE];
            liar.read_exact(&mut kept).await.expect("a place is free");
            liar.write_all(&length.to_be_bytes()).await.expect("a fresh buffer is empty");
            // It ends without a byte of answer, whether orderly or by a reset.
            let mut rest = Vec::new();
            let _ = liar.read_to_end(&mut rest).await;
            assert!(rest.is_empty());
        }

        target.counted(|counters| counters.refused == 300).await;
        friend.reaches(&target, "after".into()).await;
        assert!(friend.reports.drain().is_empty(), "the friend's connection was never lost");
    });
}

#[test]
fn peers_who_never_finish_a_frame_are_no_burden_to_the_others() {
    let _turn = blastema_doubles::turn();
    run(async {
        let (target, friend) = (End::tcp().await, End::tcp().await);
        friend.reaches(&target, "before".into()).await;

        let mut halting = Vec::new();
        for port in 1..=50_u16 {
            let mut peer = TcpStream::connect(target.local).await.expect("loopback takes it");
            peer.write_all(&encode_preamble(port)).await.expect("a fresh buffer is empty");
            peer.write_all(&encode_header(64 * 1024)).await.expect("a fresh buffer is empty");
            peer.write_all(&[7; 60 * 1024]).await.expect("the target reads what it may");
            halting.push(peer);
        }

        for number in 0..20_u8 {
            friend.reaches(&target, vec![number].into()).await;
        }
        let TransportCounters { refused, errors, .. } = target.counters().await;
        assert_eq!((refused, errors), (0, 0));
        drop(halting);
    });
}
