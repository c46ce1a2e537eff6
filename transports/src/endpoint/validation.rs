//! What can be no address of our own, or of a neighbour, and other settings that make no sense
//! wherever they come from.

use super::{LEAST_BYTES, is_interface};
#[cfg(feature = "tcp")]
use crate::tcp::TcpConfig;
#[cfg(feature = "udp")]
use crate::udp::UdpConfig;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
#[cfg(feature = "tcp")]
use std::time::Duration;

/// Whether it is the broadcast address of every network (RFC 919). Only the interface knows the
/// broadcast address of one network, such as 10.0.0.255.
pub(super) fn is_broadcast(ip: IpAddr) -> bool {
    ip == IpAddr::V4(Ipv4Addr::BROADCAST)
}

/// Whether a group is one of the network's own protocols: 224.0.0.0/24 is (RFC 5771, section 4),
/// and of IPv6 all that are assigned for good (RFC 4291, section 2.7: without the flag T).
#[cfg(feature = "udp")]
pub(super) fn is_reserved(group: IpAddr) -> bool {
    match group {
        IpAddr::V4(group) => group.octets()[..3] == [224, 0, 0],
        IpAddr::V6(group) => group.is_multicast() && group.octets()[1] & 0x10 == 0,
    }
}

/// Why no peer can be at this address.
pub(super) fn no_peer(peer: SocketAddr) -> Option<&'static str> {
    if peer.port() == 0 {
        Some("no peer is at port 0: write the port that it listens at")
    } else if peer.ip().is_unspecified() {
        Some("it is every address of the computer that writes it: write one of the neighbour's")
    } else if is_broadcast(peer.ip()) {
        Some("it is the address of all: write the neighbour's")
    } else if peer.ip().is_multicast() {
        Some(
            "it is a group's address, and no neighbour's own: only a network that hears the group sends there",
        )
    } else {
        None
    }
}

/// Whether a socket that is bound so hears what is sent there, as far as that can be known here.
pub(super) fn is_own(bind: SocketAddr, peer: SocketAddr) -> bool {
    let is_here = bind.ip() == peer.ip() || bind.ip().is_unspecified() && peer.ip().is_loopback();
    // Port 0 is a free one that is not known yet.
    is_here && bind.port() == peer.port() && bind.port() != 0
}

/// Only a group, or all of a network, has such an address.
fn check_own(own: SocketAddr) -> Result<(), String> {
    let whose = if own.ip().is_multicast() {
        "a group's"
    } else if is_broadcast(own.ip()) {
        "the address of all on a network"
    } else {
        return Ok(());
    };
    Err(format!(
        "{own} is {whose}, and no computer's own address: write 0.0.0.0 or one of this computer's; a \
         group is heard by an endpoint such as udp://239.255.0.1:7400"
    ))
}

fn check_interface(interface: Option<&str>) -> Result<(), String> {
    match interface.filter(|name| !is_interface(name)) {
        None => Ok(()),
        Some(name) => Err(format!("{name:?} is no name of an interface: write one as in eth0")),
    }
}

fn check_frame(mtu: usize) -> Result<(), String> {
    if mtu as u64 >= LEAST_BYTES {
        return Ok(());
    }
    Err(format!(
        "an mtu of {mtu} holds no announcement of a router: give it {LEAST_BYTES} bytes at least"
    ))
}

/// Of these, none may be zero: nothing would ever get through.
fn check_bounds<const N: usize>(bounds: [(&str, usize); N]) -> Result<(), String> {
    match bounds.into_iter().find(|(_, bound)| *bound == 0) {
        None => Ok(()),
        Some((name, _)) => Err(format!("{name} is 0, so that nothing gets through: 1 at least")),
    }
}

#[cfg(feature = "udp")]
pub(super) fn check_udp(config: &UdpConfig) -> Result<(), String> {
    check_own(config.bind)?;
    check_interface(config.interface.as_deref())?;
    check_frame(config.mtu.unwrap_or(LEAST_BYTES as usize))?;
    check_bounds([
        ("receive_buffer", config.receive_buffer),
        ("send_buffer", config.send_buffer),
        ("queue_frames", config.queue_frames),
    ])?;
    let Some(group) = config.group else { return Ok(()) };
    if !group.ip().is_multicast() || is_reserved(group.ip()) || group.port() == 0 {
        return Err(format!(
            "{group} is no group for one's own use with a port: write one as in 239.255.0.1:7400"
        ));
    }
    match config.hops {
        0 => Err("hops is 0, so that nothing leaves this computer: 1 at least".into()),
        _ => Ok(()),
    }
}

#[cfg(feature = "tcp")]
pub(super) fn check_tcp(config: &TcpConfig) -> Result<(), String> {
    check_own(config.bind)?;
    check_interface(config.interface.as_deref())?;
    check_frame(config.mtu)?;
    check_bounds([
        ("peers", config.peers),
        ("strangers", config.strangers),
        ("queue_bytes", config.queue_bytes),
    ])?;
    let spans = [
        ("connect_timeout", config.connect_timeout, "every connection fails"),
        ("hello_timeout", config.hello_timeout, "every connection fails"),
        ("user_timeout", config.user_timeout, "the system takes its own, a quarter of an hour"),
    ];
    match spans.into_iter().find(|(_, span, _)| *span < Duration::from_millis(1)) {
        None => Ok(()),
        Some((name, span, then)) => {
            Err(format!("{name} is {span:?}, and {then}: give it 1 ms at least"))
        }
    }
}
