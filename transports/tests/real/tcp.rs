//! What only TCP does.

use crate::conformance::end::End;
use crate::conformance::media::ip;
use actix::Actor;
use blastema_contract::transport::{
    Close, MediumAddress, Transmit, TransmitBacklog, TransportCounters, TransportReport,
};
use blastema_doubles::PATIENCE;
use blastema_transports::tcp::framing::{PREAMBLE, encode_header, encode_preamble};
use blastema_transports::{Tcp, TcpConfig};
use std::net::SocketAddr;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// An end that is open, and where.
async fn open(config: TcpConfig) -> (End, SocketAddr) {
    let end = End::new(Tcp::new(config).start());
    let at = ip(&end.opened().await.0);
    (end, at)
}

/// A peer made by hand: it has introduced itself as listening on `port`, and was kept.
async fn handmade(to: SocketAddr, port: u16) -> TcpStream {
    let mut stream = TcpStream::connect(to).await.unwrap();
    stream.write_all(&encode_preamble(port)).await.unwrap();
    let mut preamble = [0; PREAMBLE];
    stream.read_exact(&mut preamble).await.unwrap();
    assert_eq!(preamble, encode_preamble(to.port()));
    stream
}

/// Waits until the other side has closed.
async fn thrown_out(mut stream: TcpStream) {
    let closed = async {
        let mut rest = Vec::new();
        // An end and a reset are the same here.
        let _ = stream.read_to_end(&mut rest).await;
    };
    assert!(tokio::time::timeout(PATIENCE, closed).await.is_ok());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_peer_is_known_by_where_it_listens_and_answered_on_its_own_connection() {
    let (node, at) = open(TcpConfig::default()).await;
    let mut peer = handmade(at, 7400).await;
    let known: SocketAddr = "127.0.0.1:7400".parse().unwrap();

    peer.write_all(b"\0\0\0\x05hello").await.unwrap();
    assert_eq!(node.frames.expect().await.from, MediumAddress::Ip(known));
    node.send(known, "there");

    let mut answer = [0; 9];
    peer.read_exact(&mut answer).await.unwrap();
    assert_eq!(&answer, b"\0\0\0\x05there");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn two_who_dial_each_other_at_once_end_up_with_one_connection() {
    for _ in 0..50 {
        let (a, at_a) = open(TcpConfig::default()).await;
        let (b, at_b) = open(TcpConfig::default()).await;

        a.send(at_b, "from a");
        b.send(at_a, "from b");
        assert_eq!(a.frames.expect().await.frame, "from b");
        assert_eq!(b.frames.expect().await.frame, "from a");
        a.send(at_b, "again from a");
        b.send(at_a, "again from b");
        assert_eq!(a.frames.expect().await.frame, "again from b");
        assert_eq!(b.frames.expect().await.frame, "again from a");

        for node in [a, b] {
            assert!(node.reports.drain().is_empty(), "no connection was lost");
            let TransportCounters { sent, dropped, refused, .. } = node.counters().await;
            assert_eq!((sent, dropped, refused), (2, 0, 0));
            node.transport.close.send(Close).await.unwrap();
        }
    }
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_waits_for_a_peer_that_does_not_answer_is_counted_with_the_age_of_the_oldest() {
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (node, _) = open(TcpConfig::default()).await;
    assert_eq!(node.counters().await.backlog, TransmitBacklog::default());

    for frame in ["a", "b", "c"] {
        node.send(silent.local_addr().unwrap(), frame);
    }

    // It has taken the connection, and does not say who it is: the frames wait for that.
    let first = node.counters().await.backlog;
    assert_eq!(first.frames, 3, "{first:?}");
    node.counted(|counted| counted.backlog.oldest > first.oldest).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_stranger_who_says_nothing_is_thrown_out_and_counted() {
    let mut config = TcpConfig::default();
    config.limits.hello_timeout = Duration::from_millis(10);
    let (node, at) = open(config).await;

    let silent = TcpStream::connect(at).await.unwrap();
    let mut halting = TcpStream::connect(at).await.unwrap();
    halting.write_all(&encode_preamble(7400)[..PREAMBLE - 1]).await.unwrap();

    thrown_out(silent).await;
    thrown_out(halting).await;
    node.counted(|counters| counters.refused == 2).await;
    assert!(node.reports.drain().is_empty(), "who never was a peer is not lost");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_peer_that_announces_too_much_is_thrown_out_counted_and_reported() {
    let (node, at) = open(TcpConfig::default()).await;
    let mut peer = handmade(at, 7400).await;

    peer.write_all(b"\0\0\0\x02ok").await.unwrap();
    assert_eq!(node.frames.expect().await.frame, "ok");
    peer.write_all(&encode_header(64 * 1024 + 1)).await.unwrap();

    let known = MediumAddress::Ip("127.0.0.1:7400".parse().unwrap());
    assert_eq!(node.reports.expect().await, TransportReport::PeerLost { peer: known });
    thrown_out(peer).await;
    node.counted(|counters| counters.refused == 1).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn there_are_never_more_peers_than_configured() {
    let mut config = TcpConfig::default();
    config.limits.peers = 2;
    let (node, at) = open(config).await;
    let mut first = handmade(at, 7401).await;
    let second = handmade(at, 7402).await;

    let mut third = TcpStream::connect(at).await.unwrap();
    third.write_all(&encode_preamble(7403)).await.unwrap();
    thrown_out(third).await;
    node.counted(|counters| counters.refused == 1).await;
    first.write_all(b"\0\0\0\x02ok").await.unwrap();
    assert_eq!(node.frames.expect().await.frame, "ok");

    // A place that becomes free is given away.
    drop(second);
    assert!(matches!(node.reports.expect().await, TransportReport::PeerLost { .. }));
    handmade(at, 7403).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_peer_that_comes_anew_replaces_its_old_connection() {
    let (node, at) = open(TcpConfig::default()).await;
    let old = handmade(at, 7400).await;

    let mut new = handmade(at, 7400).await;

    assert!(matches!(node.reports.expect().await, TransportReport::PeerLost { .. }));
    thrown_out(old).await;
    new.write_all(b"\0\0\0\x02ok").await.unwrap();
    assert_eq!(node.frames.expect().await.frame, "ok");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn frames_to_one_who_listens_and_says_nothing_are_dropped_and_counted() {
    let mut config = TcpConfig::default();
    config.limits.connect_timeout = Duration::from_millis(20);
    let (node, _) = open(config).await;
    let deaf = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let deaf = (deaf.local_addr().unwrap(), deaf);

    (0..10).for_each(|_| node.send(deaf.0, "hello"));

    node.counted(|counters| (counters.dropped, counters.errors) == (10, 1)).await;
    node.send(deaf.0, "hello");
    node.counted(|counters| (counters.dropped, counters.errors) == (11, 1)).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_waits_for_a_peer_that_does_not_read_is_bounded() {
    let mut config = TcpConfig::default();
    config.limits.queue_bytes = 64 * 1024;
    let (node, at) = open(config).await;
    let _peer = handmade(at, 7400).await;
    let known = MediumAddress::Ip("127.0.0.1:7400".parse().unwrap());

    for _ in 0..1000 {
        let frame = vec![7; 32 * 1024].into();
        node.transport.transmit.send(Transmit::new(known.clone(), frame)).await.unwrap();
    }

    let TransportCounters { sent, dropped, .. } = node.counters().await;
    // Two frames wait here; what was sent fills the kernel's buffers, some megabytes at most.
    assert!(sent + dropped >= 998 && dropped > 500, "{sent} sent, {dropped} dropped");
}
