//! What streams do for a receiver that proves whose their connections are.

use crate::conformance::end::End;
use crate::conformance::media::ip;
use actix::Actor;
use blastema_contract::transport::{
    Adopt, Close, ConnectionTrust, MediumAddress, Received, Transport, TransportCounters,
    TransportReport,
};
use blastema_doubles::PATIENCE;
use blastema_transports::tcp::framing::{
    PREAMBLE, encode_header, encode_path_preamble, encode_preamble,
};
use blastema_transports::{Tcp, TcpConfig, Unix, UnixConfig};
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::ops::Deref;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UnixStream};

/// An end that is open.
struct Node {
    end: End,
    local: MediumAddress,
}

impl Deref for Node {
    type Target = End;

    fn deref(&self) -> &End {
        &self.end
    }
}

impl Node {
    async fn open(config: TcpConfig) -> Self {
        Node::attach(Tcp::new(config).start().into(), ConnectionTrust::Proven).await
    }

    async fn attach(transport: Transport, connections: ConnectionTrust) -> Self {
        let end = End::trusting(transport, connections);
        let (local, _) = end.opened().await;
        Node { end, local }
    }

    fn port(&self) -> SocketAddr {
        ip(&self.local)
    }

    fn send(&self, to: &MediumAddress, frame: &[u8]) {
        self.end.send(to.clone(), frame.to_vec());
    }

    fn adopt(&self, connection: &MediumAddress, peer: &MediumAddress) {
        let (connection, peer) = (connection.clone(), peer.clone());
        self.transport.adopt.do_send(Adopt { connection, peer });
    }

    /// The next frame.
    async fn next(&self) -> (MediumAddress, Vec<u8>) {
        let Received { from, frame } = self.frames.expect().await;
        (from, frame.to_vec())
    }

    /// Receives the first frame of a connection, which is not proven yet, and adopts it.
    async fn prove(&self, peer: &MediumAddress) -> MediumAddress {
        let (connection, _) = self.next().await;
        assert!(matches!(connection, MediumAddress::Connection { .. }), "{connection}");
        self.adopt(&connection, peer);
        connection
    }
}

fn at_port(port: u16) -> MediumAddress {
    SocketAddr::from(([127, 0, 0, 1], port)).into()
}

fn framed(frame: &[u8]) -> Vec<u8> {
    [&encode_header(frame.len())[..], frame].concat()
}

/// A connection made by hand, which claims to be of the node that listens on `port`.
async fn claiming(to: SocketAddr, port: u16) -> TcpStream {
    let mut stream = TcpStream::connect(to).await.unwrap();
    stream.write_all(&encode_preamble(port)).await.unwrap();
    let mut preamble = [0; PREAMBLE];
    stream.read_exact(&mut preamble).await.unwrap();
    stream
}

async fn frame_on(stream: &mut (impl AsyncReadExt + Unpin)) -> Vec<u8> {
    let read = async {
        let mut header = [0; 4];
        stream.read_exact(&mut header).await.unwrap();
        let mut frame = vec![0; u32::from_be_bytes(header) as usize];
        stream.read_exact(&mut frame).await.unwrap();
        frame
    };
    tokio::time::timeout(PATIENCE, read).await.expect("a frame arrives")
}

/// Waits until the other side has closed.
async fn closed(mut stream: impl AsyncReadExt + Unpin) {
    let mut rest = Vec::new();
    // An end and a reset are the same here.
    let read = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut rest)).await;
    assert!(read.is_ok(), "the connection is still open");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_connection_is_no_peers_until_the_receiver_knows_whose_it_is() {
    let node = Node::open(TcpConfig::default()).await;
    let mut stream = claiming(node.port(), 7400).await;

    stream.write_all(&framed(b"who am I?")).await.unwrap();
    let (connection, frame) = node.next().await;
    assert_eq!(frame, b"who am I?");
    assert_eq!(connection.to_string(), "connection 0 of 127.0.0.1:7400");
    node.send(&connection, b"prove it");
    assert_eq!(frame_on(&mut stream).await, b"prove it");

    // The receiver knows the peer by another address than the connection claims.
    node.adopt(&connection, &at_port(7500));
    stream.write_all(&framed(b"proven")).await.unwrap();
    assert_eq!(node.next().await, (at_port(7500), b"proven".to_vec()));
    for to in [at_port(7500), connection] {
        node.send(&to, b"welcome");
        assert_eq!(frame_on(&mut stream).await, b"welcome");
    }

    drop(stream);
    let lost = TransportReport::PeerLost { peer: at_port(7500) };
    assert_eq!(node.reports.expect().await, lost);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn neither_garbage_nor_8_bytes_that_claim_its_address_disturb_a_peers_connection() {
    let node = Node::open(TcpConfig::default()).await;
    let mut live = claiming(node.port(), 7400).await;
    live.write_all(&framed(b"init")).await.unwrap();
    node.prove(&at_port(7400)).await;

    let mut foreign = TcpStream::connect(node.port()).await.unwrap();
    foreign.write_all(b"GET / HTTP/1.1\r\n\r\n").await.unwrap();
    closed(foreign).await;
    let _claimed = claiming(node.port(), 7400).await;

    live.write_all(&framed(b"alive")).await.unwrap();
    assert_eq!(node.next().await, (at_port(7400), b"alive".to_vec()));
    node.send(&at_port(7400), b"well");
    assert_eq!(frame_on(&mut live).await, b"well");
    assert!(node.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_2000_connections_with_garbage_do_costs_a_peer_no_frame() {
    let node = Node::open(TcpConfig::default()).await;
    let mut live = claiming(node.port(), 7400).await;
    live.write_all(&framed(b"init")).await.unwrap();
    node.prove(&at_port(7400)).await;
    let claim = |rest: &[u8]| [&encode_preamble(7400)[..], rest].concat();
    let garbage = [
        Vec::new(),
        b"SSH-2.0-".to_vec(),
        claim(b""),
        claim(&[0xff; 40]),
        claim(&framed(&[7; 100]).repeat(20)),
        claim(&framed(&[7; 1000])),
    ];

    let mut open = VecDeque::new();
    for (number, garbage) in garbage.iter().cycle().take(2000).enumerate() {
        let mut stream = TcpStream::connect(node.port()).await.unwrap();
        // The node may have closed it already, to make room for others.
        let _ = stream.write_all(garbage).await;
        open.push_back(stream);
        if open.len() > 100 {
            open.pop_front();
        }
        let number = u32::try_from(number).unwrap().to_be_bytes();
        live.write_all(&framed(&number)).await.unwrap();
        node.send(&at_port(7400), &number);
        assert_eq!(frame_on(&mut live).await, number);
    }

    let mut arrived = 0_u32;
    while arrived < 2000 {
        let (from, frame) = node.next().await;
        if from == at_port(7400) {
            assert_eq!(frame, arrived.to_be_bytes());
            arrived += 1;
        }
    }
    assert!(node.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_connection_that_sends_more_than_a_handshake_is_closed() {
    let node = Node::open(TcpConfig::default()).await;
    let mut stream = claiming(node.port(), 7400).await;

    stream.write_all(&framed(&[7; 128]).repeat(17)).await.unwrap();

    closed(stream).await;
    let frames = node.frames.drain();
    assert!(frames.iter().all(|received| received.frame == [7; 128][..]));
    assert_eq!(frames.len(), 16);
    assert_eq!(node.counters().await.refused, 1);
    assert!(node.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_connection_that_sends_too_large_a_frame_or_proves_nothing_is_closed() {
    let mut config = TcpConfig::default();
    config.limits.hello_timeout = Duration::from_millis(10);
    let node = Node::open(config).await;

    let mut large = claiming(node.port(), 7400).await;
    large.write_all(&framed(&[7; 129])).await.unwrap();
    closed(large).await;
    closed(claiming(node.port(), 7400).await).await;
    assert_eq!(node.counters().await.refused, 2);

    // What no peer may send is refused at once.
    let mut config = TcpConfig::default();
    config.limits.hello_timeout = 10 * PATIENCE;
    let patient = Node::open(config).await;
    let mut huge = claiming(patient.port(), 7400).await;
    huge.write_all(&encode_header(64 * 1024 + 1)).await.unwrap();
    closed(huge).await;
    assert_eq!(patient.counters().await.refused, 1);

    for node in [node, patient] {
        assert!(node.frames.drain().is_empty() && node.reports.drain().is_empty());
    }
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn unproven_connections_share_their_places_with_those_that_say_nothing() {
    let mut config = TcpConfig::default();
    (config.limits.strangers, config.limits.peers) = (2, 1);
    config.limits.hello_timeout = 10 * PATIENCE;
    let node = Node::open(config).await;

    let oldest = claiming(node.port(), 7401).await;
    let mut second = claiming(node.port(), 7402).await;
    let silent = TcpStream::connect(node.port()).await.unwrap();
    closed(oldest).await;
    assert_eq!(node.counters().await.refused, 1);

    // A peer has a place of its own.
    second.write_all(&framed(b"init")).await.unwrap();
    node.prove(&at_port(7402)).await;
    let mut third = claiming(node.port(), 7403).await;
    third.write_all(&framed(b"init")).await.unwrap();
    let (connection, _) = node.next().await;
    assert_eq!(node.counters().await.refused, 1, "there was room");

    // Of which there are so many as configured.
    node.adopt(&connection, &at_port(7403));
    closed(third).await;
    let lost = TransportReport::PeerLost { peer: at_port(7403) };
    assert_eq!(node.reports.expect().await, lost);
    second.write_all(&framed(b"alive")).await.unwrap();
    assert_eq!(node.next().await, (at_port(7402), b"alive".to_vec()));
    drop(silent);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_adopted_connection_replaces_a_dialled_one_and_keeps_what_has_arrived() {
    let node = Node::open(TcpConfig::default()).await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let peer = listener.local_addr().unwrap();
    node.send(&peer.into(), b"dialled");
    let (mut dialled, _) = listener.accept().await.unwrap();
    dialled.read_exact(&mut [0; PREAMBLE]).await.unwrap();
    dialled.write_all(&encode_preamble(peer.port())).await.unwrap();
    assert_eq!(frame_on(&mut dialled).await, b"dialled");

    let mut made = claiming(node.port(), peer.port()).await;
    // A peer knows before we do that it has proven itself, and waits no longer.
    let large = vec![9; 10_000];
    let words = [framed(b"init"), framed(&large), framed(b"last")].concat();
    made.write_all(&words).await.unwrap();
    node.prove(&peer.into()).await;

    assert_eq!(node.next().await, (peer.into(), large));
    assert_eq!(node.next().await, (peer.into(), b"last".to_vec()));
    closed(dialled).await;
    node.send(&peer.into(), b"adopted");
    assert_eq!(frame_on(&mut made).await, b"adopted");
    assert!(node.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_waits_for_a_dial_goes_out_on_the_connection_that_is_adopted_meanwhile() {
    let mut config = TcpConfig::default();
    config.limits.connect_timeout = 10 * PATIENCE;
    let node = Node::open(config).await;
    // Accepts no connection, so that the dial does not complete its handshake.
    let deaf = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let peer = deaf.local_addr().unwrap();
    node.send(&peer.into(), b"waits");

    let mut stream = claiming(node.port(), peer.port()).await;
    stream.write_all(&framed(b"init")).await.unwrap();
    let (connection, _) = node.next().await;
    node.send(&connection, b"answer");
    node.adopt(&connection, &peer.into());

    assert_eq!(frame_on(&mut stream).await, b"answer");
    assert_eq!(frame_on(&mut stream).await, b"waits");
    assert_eq!(node.counters().await.dropped, 0);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn two_nodes_that_dial_each_other_at_once_keep_the_connection_that_is_adopted() {
    for round in 0..50 {
        let mut nodes =
            [Node::open(TcpConfig::default()).await, Node::open(TcpConfig::default()).await];
        // Whichever address is the smaller one.
        if round % 2 == 0 {
            nodes.reverse();
        }
        let [a, b] = &nodes;

        a.send(&b.local, b"from a");
        b.send(&a.local, b"from b");
        let (of_b, frame) = a.next().await;
        assert_eq!(frame, b"from b");
        assert!(matches!(&of_b, MediumAddress::Connection { claimed, .. } if **claimed == b.local));
        b.prove(&a.local).await;

        b.send(&a.local, b"again from b");
        assert_eq!(a.next().await, (b.local.clone(), b"again from b".to_vec()));
        a.send(&b.local, b"again from a");
        assert_eq!(b.next().await, (a.local.clone(), b"again from a".to_vec()));
        // The one that b has made is gone, which disturbs nothing.
        a.counted(|counters| counters.errors == 1).await;
        a.adopt(&of_b, &b.local);
        a.send(&b.local, b"still");
        assert_eq!(b.next().await, (a.local.clone(), b"still".to_vec()));

        for node in nodes {
            assert!(node.reports.drain().is_empty(), "no connection of a peer was lost");
            let TransportCounters { dropped, refused, .. } = node.counters().await;
            assert_eq!((dropped, refused), (0, 0));
            node.transport.close.send(Close).await.unwrap();
        }
    }
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_connection_that_is_gone_is_not_adopted_and_takes_no_frames() {
    let node = Node::open(TcpConfig::default()).await;
    let mut live = claiming(node.port(), 7400).await;
    live.write_all(&framed(b"init")).await.unwrap();
    node.prove(&at_port(7400)).await;
    let mut gone = claiming(node.port(), 7400).await;
    gone.write_all(&framed(b"init")).await.unwrap();
    let (connection, _) = node.next().await;

    drop(gone);
    node.counted(|counters| counters.errors == 1).await;
    node.adopt(&connection, &at_port(7400));
    node.send(&connection, b"too late");
    node.adopt(&at_port(7400), &at_port(7400));

    node.counted(|counters| counters.dropped == 1).await;
    live.write_all(&framed(b"alive")).await.unwrap();
    assert_eq!(node.next().await, (at_port(7400), b"alive".to_vec()));
    assert!(node.reports.drain().is_empty());
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn connections_that_were_believed_end_when_a_receiver_wants_proof() {
    let transport: Transport = Tcp::new(TcpConfig::default()).start().into();
    let node = Node::attach(transport.clone(), ConnectionTrust::Claimed).await;
    let mut believed = claiming(node.port(), 7400).await;
    believed.write_all(&framed(b"hello")).await.unwrap();
    assert_eq!(node.next().await.0, at_port(7400));

    let node = Node::attach(transport, ConnectionTrust::Proven).await;

    closed(believed).await;
    let mut stream = claiming(node.port(), 7400).await;
    stream.write_all(&framed(b"init")).await.unwrap();
    node.prove(&at_port(7400)).await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn over_paths_a_connection_is_no_peers_too_until_it_is_adopted() {
    let folder = tempfile::TempDir::new().unwrap();
    let ours = folder.path().join("ours");
    let peer = MediumAddress::Unix(folder.path().join("peer").into());
    let unix = Unix::new(UnixConfig::new(&ours)).start();
    let node = Node::attach(unix.into(), ConnectionTrust::Proven).await;
    let preamble = encode_path_preamble(peer.to_string().as_bytes());
    let claiming = async || {
        let mut stream = UnixStream::connect(&ours).await.unwrap();
        stream.write_all(&preamble).await.unwrap();
        let mut answer = vec![0; encode_path_preamble(ours.to_str().unwrap().as_bytes()).len()];
        stream.read_exact(&mut answer).await.unwrap();
        stream
    };

    let mut live = claiming().await;
    live.write_all(&framed(b"init")).await.unwrap();
    let connection = node.prove(&peer).await;
    assert_eq!(connection.to_string(), format!("connection 0 of {peer}"));
    let _claimed = claiming().await;

    live.write_all(&framed(b"alive")).await.unwrap();
    assert_eq!(node.next().await, (peer.clone(), b"alive".to_vec()));
    node.send(&peer, b"well");
    assert_eq!(frame_on(&mut live).await, b"well");
    assert!(node.reports.drain().is_empty());
}
