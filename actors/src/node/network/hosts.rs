//! Names of hosts in the endpoints of networks, and in the addresses of neighbours.
//!
//! A node looks them up once, when it starts. Where a description is only checked, perhaps on
//! another computer, each name has an address of the range for benchmarks (RFC 2544, RFC 5180).

use super::{Medium, Network};
use crate::node::error::StartError;
use blastema_core::sorted::SortedMap;
use blastema_transports::endpoint::NamedHost;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};

/// Where addresses of names come from.
pub(in crate::node) enum Hosts {
    /// The system looks them up.
    LookedUp,
    /// They are those of this list, in which each name is numbered.
    Numbered(SortedMap<String, u16>),
}

impl Hosts {
    /// The addresses of the host, one of each family at most, with this port.
    fn addresses(&mut self, named: NamedHost<'_>) -> io::Result<Vec<SocketAddr>> {
        let name = named.name();
        let Hosts::Numbered(known) = self else {
            return name.to_socket_addrs().map(Iterator::collect);
        };
        let (host, port) = name.rsplit_once(':').unwrap_or((name, ""));
        let port = port.parse().unwrap_or_default();
        if host == "localhost" {
            return Ok(vec![
                (Ipv4Addr::LOCALHOST, port).into(),
                (Ipv6Addr::LOCALHOST, port).into(),
            ]);
        }
        let next = known.len() as u16 + 1;
        let number = *known.entry(host.to_owned()).or_insert(next);
        let [high, low] = number.to_be_bytes();
        let v6 = Ipv6Addr::new(0x2001, 2, 0, 0, 0, 0, 0, number);
        Ok(vec![(Ipv4Addr::new(198, 18, high, low), port).into(), (v6, port).into()])
    }

    /// Puts addresses in place of the names of this network.
    pub(in crate::node) fn resolve(&mut self, network: &mut Network) -> Result<(), StartError> {
        let failed = |name: &str, network: &str, why: String| {
            StartError::Network(format!(
                "network {network}: {name} cannot be looked up: {why}: add the host to /etc/hosts, \
                 look whether its name server is reachable, or write its address in numbers"
            ))
        };
        if let Some(named) = NamedHost::find(&network.endpoint) {
            let addresses = self.addresses(named);
            let addresses = addresses
                .map_err(|error| failed(named.name(), &network.name, error.to_string()))?;
            // A text that is wrong elsewhere is refused by the check.
            if let Some(Ok((endpoint, _))) = addresses.first().map(|first| named.parse(*first)) {
                network.medium = Medium::At(endpoint);
            }
        }
        let Some((_, own)) = network.medium.socket() else { return Ok(()) };
        for link in &mut network.links {
            let Some(named) = NamedHost::find(&link.address) else { continue };
            let fitting = self.addresses(named).and_then(|all| {
                let fits = |address: &SocketAddr| address.is_ipv4() == own.is_ipv4();
                all.into_iter().find(fits).ok_or_else(|| {
                    let family = if own.is_ipv4() { "IPv4" } else { "IPv6" };
                    io::Error::other(format!("it has no address of {family}, as the endpoint has"))
                })
            });
            let address =
                fitting.map_err(|error| failed(named.name(), &network.name, error.to_string()))?;
            link.address = address.to_string();
        }
        Ok(())
    }
}
