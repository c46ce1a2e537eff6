//! An attacker that reaches a port may send anything to it. Real sockets on loopback; assertions
//! are about counters, never about a clock.

use crate::conformance::end::End;
use crate::conformance::media::ip;
use actix::Actor;
use blastema_contract::transport::TransportCounters;
use blastema_transports::tcp::framing::{encode_header, encode_preamble};
use blastema_transports::{Tcp, TcpConfig, Udp, UdpConfig};
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

async fn tcp() -> (End, SocketAddr) {
    let end = End::new(Tcp::new(TcpConfig::default()).start());
    let at = ip(&end.opened().await.0);
    (end, at)
}

/// A transport under attack and a peer of good will, which have spoken.
async fn target_and_friend() -> [(End, SocketAddr); 2] {
    let (target, friend) = (tcp().await, tcp().await);
    friend.0.reaches(&target.0, target.1, "before").await;
    [target, friend]
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

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_flood_of_garbage_datagrams_keeps_no_friend_out() {
    let mut config = UdpConfig::default();
    config.mtu = Some(1000);
    let [target, friend] =
        [config.clone(), config].map(|config| End::new(Udp::new(config).start()));
    let (at, _) = (ip(&target.opened().await.0), friend.opened().await);
    let flood = Flood::at(at);

    target.counted(|counters| counters.received > 10_000).await;
    for number in 0..20_u8 {
        friend.reaches(&target, at, vec![number]).await;
    }
    drop(flood);

    let TransportCounters { received, refused, .. } = target.counters().await;
    assert!(received > 10_000 && refused > 1000, "{received} received, {refused} refused");
    assert!(target.reports.drain().is_empty(), "it was open all the while");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_thousand_connections_that_say_nothing_keep_no_friend_out() {
    let [(target, at), (friend, at_friend)] = target_and_friend().await;
    let (late, _) = tcp().await;

    let mut silent = Vec::new();
    for _ in 0..1000 {
        silent.push(TcpStream::connect(at).await.expect("loopback takes it"));
    }

    // As many as have a place as strangers are still there, and no more.
    let places = TcpConfig::default().limits.strangers as u64;
    target.counted(|counters| counters.refused >= 1000 - places).await;
    friend.reaches(&target, at, "meanwhile").await;
    late.reaches(&target, at, "who comes late").await;
    target.reaches(&friend, at_friend, "the other way").await;
    assert!(friend.reports.drain().is_empty(), "the friend's connection was never lost");
    drop(silent);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_thousand_strangers_who_claim_to_be_peers_are_bounded_and_keep_no_friend_out() {
    let [(target, at), (friend, at_friend)] = target_and_friend().await;

    let mut claimants = Vec::new();
    for port in 1..=1000_u16 {
        let mut claimant = TcpStream::connect(at).await.expect("loopback takes it");
        claimant.write_all(&encode_preamble(port)).await.expect("a fresh buffer is empty");
        claimants.push(claimant);
    }

    // The friend has one of the places.
    let places = TcpConfig::default().limits.peers as u64 - 1;
    target.counted(|counters| counters.refused + counters.errors >= 1000 - places).await;
    friend.reaches(&target, at, "meanwhile").await;
    target.reaches(&friend, at_friend, "the other way").await;
    assert!(friend.reports.drain().is_empty(), "the friend's connection was never lost");
    drop(claimants);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn peers_who_never_finish_a_frame_are_no_burden_to_the_others() {
    let [(target, at), (friend, _)] = target_and_friend().await;

    let mut halting = Vec::new();
    for port in 1..=50_u16 {
        let mut peer = TcpStream::connect(at).await.expect("loopback takes it");
        peer.write_all(&encode_preamble(port)).await.expect("a fresh buffer is empty");
        peer.write_all(&encode_header(64 * 1024)).await.expect("a fresh buffer is empty");
        peer.write_all(&[7; 60 * 1024]).await.expect("the target reads what it may");
        halting.push(peer);
    }

    for number in 0..20_u8 {
        friend.reaches(&target, at, vec![number]).await;
    }
    let TransportCounters { refused, errors, .. } = target.counters().await;
    assert_eq!((refused, errors), (0, 0));
    drop(halting);
}
