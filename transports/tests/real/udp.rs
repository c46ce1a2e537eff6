//! What only UDP does.

use crate::conformance::end::End;
use crate::conformance::media::ip;
use actix::Actor;
use blastema_contract::transport::{MediumAddress, TransportReport};
use blastema_transports::{Udp, UdpConfig};
use std::net::{SocketAddr, UdpSocket};

/// An end that is open, and where.
async fn open(config: UdpConfig) -> (End, SocketAddr) {
    let end = End::new(Udp::new(config).start());
    let at = ip(&end.opened().await.0);
    (end, at)
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_datagram_above_the_limit_is_refused_whole() {
    let mut config = UdpConfig::default();
    config.mtu = Some(100);
    let (end, local) = open(config).await;
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();

    for length in [101, 102, 65_507, 100] {
        peer.send_to(&vec![7; length], local).unwrap();
    }

    assert_eq!(end.frames.expect().await.frame, vec![7; 100]);
    let counters = end.counters().await;
    assert_eq!((counters.refused, counters.received), (3, 1));
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn peers_who_do_not_listen_or_cannot_be_reached_keep_nobody_from_the_others() {
    let (end, local) = open(UdpConfig::default()).await;
    // Bound and let go: no socket listens there. The other is of a family that the socket
    // cannot.
    let deaf = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let foreign: SocketAddr = "[::1]:7400".parse().unwrap();

    for to in [deaf, foreign, deaf, foreign, local] {
        end.send(to, "hello");
    }

    assert_eq!(end.frames.expect().await.from, MediumAddress::Ip(local));
    let counters = end.counters().await;
    assert_eq!((counters.sent, counters.dropped, counters.errors), (3, 2, 2));
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn the_limit_fits_the_medium_unless_told() {
    let check = async |bind: &str, expected: (usize, bool)| {
        let mut config = UdpConfig::default();
        config.bind = bind.parse().unwrap();
        match End::new(Udp::new(config).start()).reports.expect().await {
            TransportReport::Opened { mtu, is_probed, .. } => {
                assert_eq!((mtu, is_probed), expected);
            }
            other => panic!("{other:?}"),
        }
    };
    check("127.0.0.1:0", (65_507, false)).await;
    check("0.0.0.0:0", (1_472, true)).await;
}

/// A group that no other socket hears, at a port that the system chose.
fn group() -> SocketAddr {
    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    ([239, 255, 77, 1], free).into()
}

fn hearing(group: SocketAddr) -> UdpConfig {
    let mut config = UdpConfig::default();
    config.group = Some(group);
    config
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn one_frame_to_a_group_reaches_all_others_who_hear_it_and_they_can_answer() {
    let group = group();
    let (a, at_a) = open(hearing(group)).await;
    let (b, at_b) = open(hearing(group)).await;
    let (c, _) = open(hearing(group)).await;

    a.send(group, "who is there");
    b.expect(at_a, "who is there").await;
    c.expect(at_a, "who is there").await;

    b.send(at_a, "b is");
    // And not what it has said itself.
    a.expect(at_b, "b is").await;
    assert_eq!(c.frames.len(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn who_does_not_hear_the_group_is_left_alone() {
    let (ours, theirs) = (group(), group());
    let (a, at_a) = open(hearing(ours)).await;
    let (b, at_b) = open(hearing(theirs)).await;

    a.send(ours, "to no peer");
    a.send(at_b, "to b");

    b.expect(at_a, "to b").await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_interface_binds_a_socket_to_it_and_one_that_is_missing_is_named() {
    let on = |interface: &str| {
        let mut config = UdpConfig::default();
        config.interface = Some(interface.into());
        config
    };
    let (a, at_a) = open(on("lo")).await;
    let (b, at_b) = open(on("lo")).await;
    a.send(at_b, "hello");
    b.expect(at_a, "hello").await;

    let reason = End::new(Udp::new(on("firewire9")).start()).closed().await;
    assert!(reason.contains("on firewire9") && reason.contains("no such"), "{reason}");
}
