//! How far the frames of an endpoint travel, and its text without settings.

use super::{CanConfig, Endpoint, SlcanConfig};
use crate::reach::Reach;
use std::fmt;
use std::net::IpAddr;

impl Endpoint {
    /// How far its frames travel. An IP socket stays in the computer only if its own address is a
    /// loopback address: an unspecified one (`0.0.0.0`, `::`) is reached over every interface. A
    /// multicast group of IPv6 is joined on an interface of the system's choice.
    pub fn reach(&self) -> Reach {
        match self {
            Endpoint::Udp(config) if config.group.is_some_and(|group| group.is_ipv6()) => {
                Reach::Network
            }
            Endpoint::Udp(config) => reach_of(config.bind.ip()),
            Endpoint::Tcp(config) => reach_of(config.bind.ip()),
            Endpoint::Unix(_) => Reach::CheckedUsers,
            #[cfg(feature = "serial")]
            Endpoint::Serial(_) => Reach::Network,
            Endpoint::Can(_) | Endpoint::Slcan(_) => Reach::Network,
            Endpoint::Memory(_) => Reach::Process,
        }
    }
}

fn reach_of(own: IpAddr) -> Reach {
    if own.to_canonical().is_loopback() { Reach::Computer } else { Reach::Network }
}

impl Endpoint {
    /// The medium and the place, as they stand before and behind `://`.
    pub(super) fn shown(&self) -> (&'static str, String) {
        match self {
            Endpoint::Udp(config) => ("udp", config.group.unwrap_or(config.bind).to_string()),
            Endpoint::Tcp(config) => ("tcp", config.bind.to_string()),
            Endpoint::Unix(config) => ("unix", config.path.display().to_string()),
            #[cfg(feature = "serial")]
            Endpoint::Serial(config) => ("serial", config.path.display().to_string()),
            Endpoint::Can(CanConfig { interface, .. }) => ("can", interface.clone()),
            Endpoint::Slcan(SlcanConfig { path, .. }) => ("slcan", path.display().to_string()),
            Endpoint::Memory(name) => ("memory", name.clone()),
        }
    }
}

/// The medium and the place, without settings: `udp://0.0.0.0:7400`.
impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (medium, place) = self.shown();
        write!(f, "{medium}://{place}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_leaves_the_computer_unless_its_own_address_or_its_medium_keeps_it_there() {
        let check = |text: &str, reach| {
            let endpoint: Endpoint = text.parse().unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(endpoint.reach(), reach, "{text}");
            assert_eq!(reach.leaves_computer(), reach == Reach::Network);
            assert_eq!(endpoint.to_string(), text.split('?').next().unwrap());
        };
        check("memory://left", Reach::Process);
        #[cfg(feature = "unix")]
        check("unix:///run/a.sock", Reach::CheckedUsers);
        #[cfg(feature = "serial")]
        check("serial:///dev/ttyUSB0?baud=9600", Reach::Network);
        check("can://can0", Reach::Network);
        check("slcan:///dev/ttyACM0", Reach::Network);
        let mut media = Vec::new();
        if cfg!(feature = "udp") {
            media.push("udp");
        }
        if cfg!(feature = "tcp") {
            media.push("tcp");
        }
        for medium in media {
            for (address, reach) in [
                ("127.0.0.1:7400", Reach::Computer),
                ("127.9.8.7:7400", Reach::Computer),
                ("[::1]:7400", Reach::Computer),
                ("[::ffff:127.0.0.1]:7400", Reach::Computer),
                ("0.0.0.0:7400", Reach::Network),
                ("[::]:7400", Reach::Network),
                ("10.0.0.1:7400", Reach::Network),
                ("[fd00::1]:7400", Reach::Network),
                ("[::ffff:10.0.0.1]:7400", Reach::Network),
                ("0.0.0.0:7400?interface=lo", Reach::Network),
            ] {
                check(&format!("{medium}://{address}"), reach);
            }
        }
        #[cfg(feature = "udp")]
        for (text, reach) in [
            ("udp://239.255.0.1:7400", Reach::Network),
            ("udp://239.255.0.1:7400?own=127.0.0.1:7401", Reach::Computer),
            ("udp://[ff15::1]:7400?own=[::1]:7401", Reach::Network),
        ] {
            check(text, reach);
        }
    }
}
