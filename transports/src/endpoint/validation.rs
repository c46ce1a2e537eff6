//! What can be no address of our own, or of a neighbour.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

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
