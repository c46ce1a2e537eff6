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
    let attach = Attach { frames: frames.recipient(), reports: reports.recipient() };
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
    actix_rt::System::new().block_on(async {
        let (transport, local, frames) = open(UdpConfig::default()).await;
        // Bound and let go: nobody listens there. The other is of a family that the socket cannot.
        let deaf = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let foreign: SocketAddr = "[::1]:7400".parse().unwrap();

        for to in [deaf, foreign, deaf, foreign, local] {
            transport.do_send(Transmit { to: MediumAddress::Ip(to), frame: "hello".into() });
        }

        assert_eq!(frames.expect().await.from, MediumAddress::Ip(local));
        let counters = transport.send(ReadCounters).await.unwrap();
        assert_eq!((counters.sent, counters.dropped, counters.errors), (3, 2, 2));
    });
}

#[test]
fn the_limit_fits_the_medium_unless_told() {
    actix_rt::System::new().block_on(async {
        let check = async |bind: &str, mtu| {
            let mut config = UdpConfig::default();
            config.bind = bind.parse().unwrap();
            let transport = Udp::new(config).start();
            let (frames, reports) = (Probe::start(), Probe::start());
            let attach = Attach { frames: frames.recipient(), reports: reports.recipient() };
            transport.do_send(attach);
            match reports.expect().await {
                TransportReport::Opened { mtu: reported, .. } => assert_eq!(reported, mtu),
                other => panic!("{other:?}"),
            }
        };
        check("127.0.0.1:0", 65_507).await;
        check("0.0.0.0:0", 1_472).await;
    });
}
