//! A medium and its settings, written as one string.
//!
//! ```text
//! udp://0.0.0.0:7400?interface=eth0&mtu=1400
//! └┬┘   └────┬─────┘ └──────────┬──────────┘
//! medium   where            settings
//! ```
//!
//! A pure parser: it opens nothing and looks nothing up. Deliberately not here: whether an
//! interface, a port or a file exists; that the transport finds out, and again after every loss.

mod can;
mod connections;
mod error;
mod host;
mod media;
mod reach;
mod settings;
mod udp;
mod validation;

pub use self::can::{CanConfig, CanNodeConfig, SLCAN_BIT_RATES, SLCAN_DATA_RATES, SlcanConfig};
pub use self::connections::{StreamLimits, TcpConfig, UnixConfig};
pub use self::error::EndpointError;
pub use self::host::NamedHost;
pub use self::udp::UdpConfig;

use self::error::Wrong;
use self::settings::{Settings, duration};
#[cfg(feature = "serial")]
use crate::serial::{Parity, Rs485, SerialConfig, StopBits};
use blastema_contract::transport::MediumAddress;
use blastema_core::net::routing::MTU_MIN;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;
#[cfg(feature = "serial")]
use std::time::Duration;

/// The largest frame that any setting allows, in bytes: each receiver must be able to hold it.
const MOST_BYTES: u64 = 1 << 24;
/// The smallest largest frame, in bytes: what routers tell each other must fit.
const LEAST_BYTES: u64 = MTU_MIN as u64;

/// A medium and its settings.
///
/// | text | medium | settings |
/// | --- | --- | --- |
/// | `udp://0.0.0.0:7400` | UDP at this address; port 0 takes a free one | `interface`, `mtu`, `receive_buffer`, `send_buffer`, `queue_frames` |
/// | `udp://239.255.0.1:7400` | UDP, hearing a multicast group | those, and `own` (the address that we send from), `hops` |
/// | `udp://10.0.1.1:7400?interface=firewire0` | IP over IEEE 1394, bound to its interface | as UDP |
/// | `tcp://10.0.0.1:7400` | TCP | `interface`, `mtu`, `peers`, `strangers`, `queue_bytes`, `connect_timeout`, `hello_timeout`, `user_timeout` |
/// | `unix:///run/x.sock` | a Unix-domain socket | `mode` (octal), `mtu`, `peers`, `strangers`, `queue_bytes`, `connect_timeout`, `hello_timeout`, `users` |
/// | `serial:///dev/ttyUSB0` | a serial line | `baud`, `parity`, `stop_bits`, `flow`, `rs485`, with it `rts`, `rts_before`, `rts_after`; `mtu`, `queue_time` |
/// | `can://can0` | a CAN interface | `fd`, `bit_rate_switch`, `bitrate`, `address`, `mtu`, `queue_frames`, `block_size`, `separation` |
/// | `slcan:///dev/ttyACM0` | a CAN adapter on a serial port | `bitrate`, `fd`, `bit_rate_switch`, `data_bitrate`, `baud`, `address`, `mtu`, `queue_frames`, `block_size`, `separation` |
/// | `memory://name` | between nodes of one process | |
///
/// Each takes `insecure` too, with or without `=true`: see [`Endpoint::parse`].
/// Times have a unit (`500ms`). A path has no question mark.
///
/// ```
/// use blastema_transports::Endpoint;
///
/// let error = "serial:///dev/ttyUSB0?buad=921600".parse::<Endpoint>().expect_err("misspelt");
/// assert_eq!(
///     error.to_string(),
///     "serial has no key `buad`: did you mean `baud`?\n  \
///        serial:///dev/ttyUSB0?buad=921600\n                        \
///                              ^^^^"
/// );
/// ```
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Endpoint {
    /// `udp://`: datagrams between sockets.
    Udp(UdpConfig),
    /// `tcp://`: one connection to each peer.
    Tcp(TcpConfig),
    /// `unix://`: Unix-domain sockets on one computer.
    Unix(UnixConfig),
    /// `serial://`: a serial line.
    #[cfg(feature = "serial")]
    Serial(SerialConfig),
    /// `can://`: a CAN interface of the kernel.
    Can(CanConfig),
    /// `slcan://`: a CAN adapter on a serial line.
    Slcan(SlcanConfig),
    /// `memory://`: the name of our end.
    Memory(String),
}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        Endpoint::parse(text).map(|(endpoint, _)| endpoint)
    }
}

impl Endpoint {
    /// Parses an endpoint, and returns whether its text has the setting `insecure`, which every
    /// medium takes: it belongs to the network, not to the transport.
    ///
    /// # Errors
    /// The text is no endpoint.
    pub fn parse(text: &str) -> Result<(Self, bool), EndpointError> {
        Endpoint::parse_at(text, None)
    }

    /// Parses an endpoint, with an address in place of the one that it names.
    fn parse_at(text: &str, address: Option<SocketAddr>) -> Result<(Self, bool), EndpointError> {
        read(text, address).map_err(|wrong| EndpointError::new(text, wrong))
    }

    /// The medium's name, as it stands before `://`.
    pub fn medium(&self) -> &'static str {
        self.shown().0
    }

    /// Reads a peer's address as this medium writes it: `10.0.0.2:7400`, a path, a number on the
    /// CAN bus, the name of an end in memory; nothing on a serial line, which leads to one
    /// peer only.
    ///
    /// # Errors
    /// The text is no address there.
    pub fn peer(&self, text: &str) -> Result<MediumAddress, EndpointError> {
        let parsed = match self {
            Endpoint::Udp(_) => ip(text).map(MediumAddress::Ip),
            Endpoint::Tcp(_) => ip(text).map(MediumAddress::Ip),
            Endpoint::Unix(_) => check_socket_path(text.len())
                .and_then(|()| path(text, "/run/b.sock"))
                .map(|path| MediumAddress::Unix(path.into())),
            #[cfg(feature = "serial")]
            Endpoint::Serial(_) if text.is_empty() => Ok(MediumAddress::Line),
            #[cfg(feature = "serial")]
            Endpoint::Serial(_) => {
                Err("a line leads to one peer only, which needs no address: leave it empty".into())
            }
            Endpoint::Can(_) | Endpoint::Slcan(_) => {
                let number = text.parse().map(MediumAddress::Can);
                number.map_err(|_| "write its number on the bus, 0 to 255".to_owned())
            }
            Endpoint::Memory(_) => Ok(MediumAddress::Memory(text.into())),
        };
        let objected = |peer| self.objection(&peer).map_or(Ok(peer), |why| Err(why.to_owned()));
        parsed.and_then(objected).map_err(|expected| {
            let medium = self.medium();
            let problem = format!("`{text}` is no peer on {medium}: {expected}");
            EndpointError::new(text, Wrong(text, problem))
        })
    }

    /// How many connections may be open there beside those of peers.
    pub fn strangers(&self) -> usize {
        match self {
            Endpoint::Tcp(config) => config.limits.strangers,
            Endpoint::Unix(config) => config.limits.strangers,
            _ => 0,
        }
    }

    /// Finds what is wrong with an address of our own.
    ///
    /// # Errors
    /// What is wrong, and what to write.
    pub fn check(&self) -> Result<(), String> {
        match self {
            Endpoint::Udp(config) => {
                config.group.map_or(Ok(()), validation::check_group)?;
                validation::check_own(config.bind)
            }
            Endpoint::Tcp(config) => validation::check_own(config.bind),
            Endpoint::Unix(config) => check_socket_path(config.path.as_os_str().len()),
            Endpoint::Memory(name) if name.is_empty() => {
                Err("our own end of the memory medium has no name: give it one".to_owned())
            }
            _ => Ok(()),
        }
    }

    /// Why no other node can be at this address of the medium.
    pub fn objection(&self, peer: &MediumAddress) -> Option<&'static str> {
        let is_own = match (self, peer) {
            (Endpoint::Udp(config), MediumAddress::Ip(peer)) => {
                if config.group != Some(*peer) && !validation::is_host_address(*peer) {
                    return Some(validation::NO_PEER);
                }
                validation::is_own(config.bind, *peer)
            }
            (Endpoint::Tcp(config), MediumAddress::Ip(peer)) => {
                if !validation::is_host_address(*peer) {
                    return Some(validation::NO_PEER);
                }
                validation::is_own(config.bind, *peer)
            }
            (Endpoint::Unix(config), MediumAddress::Unix(path)) => config.path == **path,
            (Endpoint::Can(CanConfig { node, .. }), MediumAddress::Can(peer))
            | (Endpoint::Slcan(SlcanConfig { node, .. }), MediumAddress::Can(peer)) => {
                *peer == node.address
            }
            (Endpoint::Memory(_), MediumAddress::Memory(peer)) if peer.is_empty() => {
                return Some("write the name of its end");
            }
            (Endpoint::Memory(own), MediumAddress::Memory(peer)) => own.as_str() == &**peer,
            #[cfg(feature = "serial")]
            (Endpoint::Serial(_), MediumAddress::Line) => false,
            _ => return Some("it is an address of another medium: write one of this medium's"),
        };
        is_own.then_some("it is our own address: write the neighbour's")
    }
}

/// The longest path of a Unix-domain socket on Linux, in bytes, without the closing zero.
const SOCKET_PATH: usize = 107;

/// Finds a path of a Unix-domain socket that is too long, by its length in bytes.
///
/// # Errors
/// What is wrong with it, and what to do.
pub fn check_socket_path(length: usize) -> Result<(), String> {
    match length <= SOCKET_PATH {
        true => Ok(()),
        false => Err(format!(
            "the path has {length} bytes, and a socket's has at most {SOCKET_PATH}: choose a \
             shorter one"
        )),
    }
}

/// Whether Linux could call an interface so (`IFNAMSIZ` is 16 with its closing zero).
pub fn is_interface(text: &str) -> bool {
    let wrong = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
    (1..=15).contains(&text.len()) && text != "." && text != ".." && !text.contains(wrong)
}

/// Reads an endpoint, of which `address` replaces the one that it names, and its setting
/// `insecure`.
fn read(text: &str, address: Option<SocketAddr>) -> Result<(Endpoint, bool), Wrong<'_>> {
    let Some((medium, rest)) = text.split_once("://") else {
        let problem = "an endpoint begins with its medium, as in udp://0.0.0.0:7400";
        return Err(Wrong(&text[..0], problem.to_owned()));
    };
    let split = rest.split_once('?');
    let (place, query) = split.map_or((rest, None), |(place, query)| (place, Some(query)));
    let medium = media::find(&media::MEDIA, medium).map_err(|why| Wrong(medium, why))?;
    let mut settings = Settings::new(query)?;
    let at_place = |why| Wrong(place, why);
    let own = || address.map_or_else(|| ip(place), Ok).map_err(at_place);
    let path = |example| path(place, example).map_err(at_place);
    let endpoint = match medium {
        "udp" => udp(own()?, &mut settings)?,
        "tcp" => tcp(own()?, &mut settings)?,
        "unix" => unix(path("unix:///run/robot.sock")?, &mut settings)?,
        #[cfg(feature = "serial")]
        "serial" => serial(path("serial:///dev/ttyUSB0")?, &mut settings)?,
        "can" => can(place, &mut settings)?,
        "slcan" => slcan(path("slcan:///dev/ttyACM0")?, &mut settings)?,
        _ => Endpoint::Memory(place.to_owned()),
    };
    let insecure = settings.flag("insecure")?;
    settings.finish(medium)?;
    endpoint.check().map_err(at_place)?;
    Ok((endpoint, insecure))
}

fn path(text: &str, example: &str) -> Result<PathBuf, String> {
    match text.starts_with('/') && !text.contains('\0') {
        true => Ok(text.into()),
        false => {
            Err(format!("a path begins with a slash, as in {example}, and holds no zero byte"))
        }
    }
}

/// An IP address with its port.
fn ip(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| match text.parse::<IpAddr>() {
        Ok(address) => format!("the port is missing: write {}", SocketAddr::new(address, 7400)),
        Err(_) => format!(
            "`{text}` is no address with a port of 0 to 65535: write one as in 10.0.0.1:7400, \
             [fd00::1]:7400 or robot.local:7400"
        ),
    })
}

fn interface<'a>(settings: &mut Settings<'a>) -> Result<Option<String>, Wrong<'a>> {
    let expected = "the name of an interface, as in eth0: 1 to 15 letters without slash";
    settings.take("interface", expected, |text| is_interface(text).then(|| text.to_owned()))
}

fn udp<'a>(address: SocketAddr, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    let mut config = UdpConfig { bind: address, ..UdpConfig::default() };
    if address.ip().is_multicast() {
        let any: IpAddr = match address {
            SocketAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
            SocketAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
        };
        let expected =
            format!("our own address with its port, as in {}", SocketAddr::new(any, 7401));
        let own = settings.take("own", expected, |text| {
            let own: SocketAddr = text.parse().ok()?;
            let is_right = own.is_ipv4() == address.is_ipv4() && validation::check_own(own).is_ok();
            is_right.then_some(own)
        })?;
        settings.number("hops", 1..=255, &mut config.hops)?;
        config.bind = own.unwrap_or(SocketAddr::new(any, 0));
        config.group = Some(address);
    }
    config.interface = interface(settings)?;
    config.mtu = settings.given("mtu", LEAST_BYTES..=65_507)?;
    settings.number("receive_buffer", 4_096..=1 << 30, &mut config.receive_buffer)?;
    settings.number("send_buffer", 4_096..=1 << 30, &mut config.send_buffer)?;
    settings.number("queue_frames", 1..=65_536, &mut config.queue_frames)?;
    Ok(Endpoint::Udp(config))
}

fn tcp<'a>(bind: SocketAddr, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    let interface = interface(settings)?;
    let mut config = TcpConfig { bind, interface, ..TcpConfig::default() };
    limits(settings, &mut config.limits)?;
    settings.span("user_timeout", &mut config.user_timeout)?;
    Ok(Endpoint::Tcp(config))
}

/// How much a medium of connections holds, and how long it waits for peers.
fn limits<'a>(settings: &mut Settings<'a>, limits: &mut StreamLimits) -> Result<(), Wrong<'a>> {
    settings.number("mtu", LEAST_BYTES..=MOST_BYTES, &mut limits.mtu)?;
    settings.number("peers", 1..=65_536, &mut limits.peers)?;
    settings.number("strangers", 1..=65_536, &mut limits.strangers)?;
    settings.number("queue_bytes", LEAST_BYTES..=1 << 30, &mut limits.queue_bytes)?;
    settings.span("connect_timeout", &mut limits.connect_timeout)?;
    settings.span("hello_timeout", &mut limits.hello_timeout)
}

fn unix<'a>(path: PathBuf, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    let mut config = UnixConfig::new(path);
    let mode = settings.take("mode", "permissions in octal, as in 660", |text| {
        u32::from_str_radix(text, 8).ok().filter(|mode| *mode <= 0o777)
    })?;
    config.mode = mode.unwrap_or(config.mode);
    let users = settings.take("users", "numbers of users, as in 1001,1002", |text| {
        text.split(',').map(|user| user.parse().ok()).collect()
    })?;
    config.users = users.unwrap_or_default();
    limits(settings, &mut config.limits)?;
    Ok(Endpoint::Unix(config))
}

#[cfg(feature = "serial")]
fn serial<'a>(path: PathBuf, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    let mut config = SerialConfig::new(path);
    config.baud = settings.given("baud", BAUD)?;
    let parities = [("none", Parity::None), ("odd", Parity::Odd), ("even", Parity::Even)];
    settings.choice("parity", &parities, &mut config.parity)?;
    settings.choice(
        "stop_bits",
        &[(1, StopBits::One), (2, StopBits::Two)],
        &mut config.stop_bits,
    )?;
    // XON and XOFF are not among them: their bytes stand in frames, too.
    let flows = [("none", false), ("hardware", true)];
    settings.choice("flow", &flows, &mut config.hardware_flow)?;
    config.rs485 = rs485(settings)?;
    if config.rs485.is_some() && config.hardware_flow {
        settings.contradiction("flow", "RTS turns the line with rs485=true: leave flow out")?;
    }
    config.mtu = settings.given("mtu", LEAST_BYTES..=65_535)?;
    settings.span("queue_time", &mut config.queue_time)?;
    Ok(Endpoint::Serial(config))
}

/// How the driver turns the line, if it does.
#[cfg(feature = "serial")]
fn rs485<'a>(settings: &mut Settings<'a>) -> Result<Option<Rs485>, Wrong<'a>> {
    let mut turns = false;
    settings.switch("rs485", &mut turns)?;
    if !turns {
        for key in ["rts", "rts_before", "rts_after"] {
            let why = "RTS is the driver's where it turns a line of RS-485: add rs485=true";
            settings.contradiction(key, why)?;
        }
        return Ok(None);
    }
    let mut how = Rs485::default();
    settings.choice("rts", &[("high", false), ("low", true)], &mut how.rts_low)?;
    for (key, target) in [("rts_before", &mut how.before), ("rts_after", &mut how.after)] {
        let span = settings.take(key, "whole milliseconds, from 0ms to 100ms", |text| {
            let most = Duration::from_millis(100);
            duration(text).filter(|span| *span <= most && Rs485::is_whole(*span))
        })?;
        *target = span.unwrap_or(*target);
    }
    Ok(Some(how))
}

/// What serial ports of today can, with room above, in bits a second.
const BAUD: std::ops::RangeInclusive<u64> = 50..=50_000_000;

const ONLY_FD: &str = "only CAN FD frames can switch the bit rate: add fd=true";

/// Whether frames are those of CAN FD, and switch the bit rate.
fn can_fd<'a>(
    settings: &mut Settings<'a>,
    fd: &mut bool,
    bit_rate_switch: &mut bool,
) -> Result<(), Wrong<'a>> {
    settings.switch("fd", fd)?;
    settings.switch("bit_rate_switch", bit_rate_switch)?;
    match *bit_rate_switch && !*fd {
        true => settings.contradiction("bit_rate_switch", ONLY_FD),
        false => Ok(()),
    }
}

fn can<'a>(place: &'a str, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    if !is_interface(place) {
        let problem = "the name of an interface is missing, as in can://can0";
        return Err(Wrong(place, problem.to_owned()));
    }
    let mut config = CanConfig::new(place);
    can_fd(settings, &mut config.fd, &mut config.bit_rate_switch)?;
    settings.number("bitrate", 10_000..=1_000_000, &mut config.bitrate)?;
    can_node(settings, &mut config.node)?;
    Ok(Endpoint::Can(config))
}

fn slcan<'a>(path: PathBuf, settings: &mut Settings<'a>) -> Result<Endpoint, Wrong<'a>> {
    let mut config = SlcanConfig::new(path);
    can_fd(settings, &mut config.fd, &mut config.bit_rate_switch)?;
    let rates = SLCAN_BIT_RATES.map(|rate| (rate, rate));
    settings.choice("bitrate", &rates, &mut config.bitrate)?;
    let rates = SLCAN_DATA_RATES.map(|rate| (rate, rate));
    settings.choice("data_bitrate", &rates, &mut config.data_bitrate)?;
    if !config.fd {
        settings.contradiction("data_bitrate", ONLY_FD)?;
    }
    settings.number("baud", BAUD, &mut config.baud)?;
    can_node(settings, &mut config.node)?;
    Ok(Endpoint::Slcan(config))
}

fn can_node<'a>(settings: &mut Settings<'a>, node: &mut CanNodeConfig) -> Result<(), Wrong<'a>> {
    settings.number("address", 0..=254, &mut node.address)?;
    settings.number("mtu", LEAST_BYTES..=MOST_BYTES, &mut node.mtu)?;
    settings.number("queue_frames", 1..=65_536, &mut node.queue_frames)?;
    settings.number("block_size", 0..=255, &mut node.block_size)?;
    // Those that ISO 15765-2 can say.
    let expected = "nothing (0ms), 100us to 900us in steps of 100us, or 1ms to 127ms";
    let separation = settings.take("separation", expected, |text| {
        duration(text).filter(|span| match span.as_micros() {
            0..1_000 => span.as_micros().is_multiple_of(100),
            1_000..=127_000 => span.as_micros().is_multiple_of(1_000),
            _ => false,
        })
    })?;
    node.separation = separation.unwrap_or(node.separation);
    Ok(())
}

#[cfg(test)]
mod tests;
