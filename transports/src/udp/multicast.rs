//! Hearing a multicast group: one datagram reaches all who do.
//!
//! A transport that hears a group has two sockets. One is bound to the group and only hears; it
//! shares its address with every other transport of this machine that hears the same. The other is
//! the transport's own: everything is sent from it, so that each of them is known by an address of
//! its own, and can be answered there.

use crate::bound_address::confine;
use crate::udp::UdpConfig;
use socket2::{Domain, Protocol, SockRef, Socket, Type};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use tokio::net::UdpSocket;

/// The address at which our own socket opens. It must be a definite one: by it we know what we have
/// sent ourselves, which the group brings back to us.
pub(crate) fn own_address(
    wanted: SocketAddr,
    group: SocketAddr,
    interface: Option<&str>,
) -> io::Result<SocketAddr> {
    if !wanted.ip().is_unspecified() {
        return Ok(wanted);
    }
    // Nothing is sent: the system says from which address it would be.
    let probe = Socket::new(Domain::for_address(group), Type::DGRAM, Some(Protocol::UDP))?;
    confine(&probe, interface)?;
    probe.connect(&group.into())?;
    let local = probe.local_addr()?.as_socket();
    let ip = local.map_or(wanted.ip(), |local| local.ip());
    Ok(SocketAddr::new(ip, wanted.port()))
}

/// Makes our own socket send to the group over the right interface, and to those of this machine,
/// too.
pub(crate) fn speak(own: &UdpSocket, config: &UdpConfig) -> io::Result<()> {
    let (local, socket) = (own.local_addr()?, SockRef::from(own));
    match local.ip() {
        IpAddr::V4(ip) => {
            socket.set_multicast_if_v4(&ip)?;
            socket.set_multicast_ttl_v4(config.hops)?;
            socket.set_multicast_loop_v4(true)
        }
        IpAddr::V6(_) => {
            socket.set_multicast_if_v6(index(config.interface.as_deref())?)?;
            socket.set_multicast_hops_v6(config.hops)?;
            socket.set_multicast_loop_v6(true)
        }
    }
}

/// A socket that hears the group where `own` is.
pub(crate) fn listen(group: SocketAddr, own: IpAddr, config: &UdpConfig) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::for_address(group), Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    // Others of this machine hear the same group at the same port.
    socket.set_reuse_address(true)?;
    socket.set_recv_buffer_size(config.receive_buffer)?;
    confine(&socket, config.interface.as_deref())?;
    if group.is_ipv6() {
        socket.set_only_v6(true)?;
    }
    socket.bind(&group.into())?;
    match (group.ip(), own) {
        (IpAddr::V4(group), own) => {
            let own = match own {
                IpAddr::V4(own) => own,
                IpAddr::V6(_) => Ipv4Addr::UNSPECIFIED,
            };
            // The system's default also gives this socket what arrives on other interfaces, where
            // another process has joined the group there.
            #[cfg(target_os = "linux")]
            socket.set_multicast_all_v4(false)?;
            socket.join_multicast_v4(&group, &own)?;
        }
        (IpAddr::V6(group), _) => {
            socket.join_multicast_v6(&group, index(config.interface.as_deref())?)?;
        }
    }
    UdpSocket::from_std(socket.into())
}

/// The system's number of an interface; 0 leaves the choice to its routes.
fn index(interface: Option<&str>) -> io::Result<u32> {
    let Some(interface) = interface else { return Ok(0) };
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    Ok(rustix::net::netdevice::name_to_index(&socket, interface)?)
}
