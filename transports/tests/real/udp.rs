//! What only UDP does.

use actix::prelude::*;
use blastema_contract::transport::{
    Attach, MediumAddress, ReadCounters, Received, Transmit, TransportReport,
};
use blastema_doubles::Probe;
use blastema_transports::{Udp, UdpConfig};
use std::net::{SocketAddr, UdpSocket};

async fn open(config: UdpConfig) -> (Addr<Udp>, SocketAddr, Probe<Received>) {
    let transport = Udp::new(config).start();
    let (frames, reports) = (Probe::start(), Probe::start());
    let attach = Attach::new(frames.recipient(), reports.recipient());
    transport.do_send(attach);
    match reports.expect().await {
        TransportReport::Opened { local: MediumAddress::Ip(local), .. } => {
            (transport, local, frames)
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_datagram_above_the_limit_is_refused_whole() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let mut config = UdpConfig::default();
        config.mtu = Some(100);
        let (transport, local, frames) = open(config).await;
        let peer = UdpSocket::bind("127.0.0.1:0").unwrap();

        for length in [101, 102, 65_507, 100] {
            peer.send_to(&vec![7; length], local).unwrap();
        }

        assert_eq!(frames.expect().await.frame, vec![7; 100]);
        let counters = transport.send(ReadCounters).await.unwrap();
        assert_eq!((counters.refused, counters.received), (3, 1));
    });
}

#[test]
fn peers_who_do_not_listen_or_cannot_be_reached_keep_nobody_from_the_others() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let (transport, local, frames) = open(UdpConfig::default()).await;
        // Bound and let go: no socket listens there. The other is of a family that the socket
        // cannot.
        let deaf = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let foreign: SocketAddr = "[::1]:7400".parse().unwrap();

        for to in [deaf, foreign, deaf, foreign, local] {
            transport.do_send(Transmit::new(MediumAddress::Ip(to), "hello".into()));
        }

        assert_eq!(frames.expect().await.from, MediumAddress::Ip(local));
        let counters = transport.send(ReadCounters).await.unwrap();
        assert_eq!((counters.sent, counters.dropped, counters.errors), (3, 2, 2));
    });
}

#[test]
fn the_limit_fits_the_medium_unless_told() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let check = async |bind: &str, expected: (usize, bool)| {
            let mut config = UdpConfig::default();
            config.bind = bind.parse().unwrap();
            let transport = Udp::new(config).start();
            let (frames, reports) = (Probe::start(), Probe::start());
            let attach = Attach::new(frames.recipient(), reports.recipient());
            transport.do_send(attach);
            match reports.expect().await {
                TransportReport::Opened { mtu, is_probed, .. } => {
                    assert_eq!((mtu, is_probed), expected);
                }
                other => panic!("{other:?}"),
            }
        };
        check("127.0.0.1:0", (65_507, false)).await;
        check("0.0.0.0:0", (1_472, true)).await;
    });
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

#[test]
fn one_frame_to_a_group_reaches_all_others_who_hear_it_and_they_can_answer() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let group = group();
        let (a, at_a, to_a) = open(hearing(group)).await;
        let (b, _, to_b) = open(hearing(group)).await;
        let (_c, _, to_c) = open(hearing(group)).await;

        a.do_send(Transmit::new(MediumAddress::Ip(group), "who is there".into()));
        let heard = to_b.expect().await;
        assert_eq!((heard.from, &heard.frame[..]), (MediumAddress::Ip(at_a), &b"who is there"[..]));
        assert_eq!(to_c.expect().await.from, MediumAddress::Ip(at_a));

        b.do_send(Transmit::new(MediumAddress::Ip(at_a), "b is".into()));
        assert_eq!(to_a.expect().await.frame, "b is", "and not what a has said itself");
        assert_eq!(to_c.recorded(), 0);
    });
}

#[test]
fn who_does_not_hear_the_group_is_left_alone() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let (ours, theirs) = (group(), group());
        let (a, _, _to_a) = open(hearing(ours)).await;
        let (_b, at_b, to_b) = open(hearing(theirs)).await;

        a.do_send(Transmit::new(MediumAddress::Ip(ours), "to no peer".into()));
        a.do_send(Transmit::new(MediumAddress::Ip(at_b), "to b".into()));

        assert_eq!(to_b.expect().await.frame, "to b");
    });
}

#[test]
fn an_interface_binds_a_socket_to_it_and_one_that_is_missing_is_named() {
    let _turn = blastema_doubles::turn();
    actix_rt::System::new().block_on(async {
        let on = |interface: &str| {
            let mut config = UdpConfig::default();
            config.interface = Some(interface.into());
            config
        };
        let (a, _, _to_a) = open(on("lo")).await;
        let (_b, at_b, to_b) = open(on("lo")).await;
        a.do_send(Transmit::new(MediumAddress::Ip(at_b), "hello".into()));
        assert_eq!(to_b.expect().await.frame, "hello");

        let (frames, reports) = (Probe::<Received>::start(), Probe::start());
        let attach = Attach::new(frames.recipient(), reports.recipient());
        Udp::new(on("firewire9")).start().do_send(attach);
        match reports.expect().await {
            TransportReport::Closed { reason } => {
                assert!(reason.contains("on firewire9") && reason.contains("no such"), "{reason}");
            }
            other => panic!("{other:?}"),
        }
    });
}
