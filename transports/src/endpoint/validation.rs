//! What can be no address of our own, or of a neighbour.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

/// Whether it is a group's, or the broadcast address of every network (RFC 919). Only the interface
/// knows the broadcast address of one network, such as 10.0.0.255.
fn is_of_many(ip: IpAddr) -> bool {
    ip.is_multicast() || ip == IpAddr::V4(Ipv4Addr::BROADCAST)
}

/// A group has a port, and is none of the network's own protocols: 224.0.0.0/24 is (RFC 5771,
/// section 4), and of IPv6 all that are assigned for good (RFC 4291, section 2.7: without the flag
/// T).
pub(super) fn check_group(group: SocketAddr) -> Result<(), String> {
    let is_reserved = match group.ip() {
        IpAddr::V4(group) => group.octets()[..3] == [224, 0, 0],
        IpAddr::V6(group) => group.octets()[1] & 0x10 == 0,
    };
    match is_reserved || group.port() == 0 {
        false => Ok(()),
        true => Err(format!(
            "`{group}` is a group of the network's own protocols, or has no port: write one for \
             your own use, as in 239.255.0.1:7400 or [ff15::1]:7400"
        )),
    }
}

/// What is wrong with an address that is no host's.
pub(super) const NO_PEER: &str = "it is no address of one neighbour: write the neighbour's, with \
                                  the port that it listens at";

/// Whether one host can be there.
pub(super) fn is_host_address(peer: SocketAddr) -> bool {
    peer.port() != 0 && !peer.ip().is_unspecified() && !is_of_many(peer.ip())
}

/// Whether a socket that is bound so hears what is sent there, as far as that can be known here.
pub(super) fn is_own(bind: SocketAddr, peer: SocketAddr) -> bool {
    let is_here = bind.ip() == peer.ip() || bind.ip().is_unspecified() && peer.ip().is_loopback();
    // Port 0 is a free one that is not known yet.
    is_here && bind.port() == peer.port() && bind.port() != 0
}

/// Only a group, or all of a network, has such an address.
pub(super) fn check_own(own: SocketAddr) -> Result<(), String> {
    match is_of_many(own.ip()) {
        false => Ok(()),
        true => Err(format!(
            "{own} is the address of many, and no computer's own address: write 0.0.0.0 or one of \
             this computer's; a group is heard by an endpoint such as udp://239.255.0.1:7400"
        )),
    }
}
