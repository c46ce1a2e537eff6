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
mod error;
mod host;
mod media;
mod reach;
mod settings;
#[cfg(any(feature = "udp", feature = "tcp"))]
mod validation;

pub use self::can::{CanConfig, CanNodeConfig, SLCAN_BIT_RATES, SLCAN_DATA_RATES, SlcanConfig};
pub use self::error::EndpointError;
pub use self::host::NamedHost;
pub use self::settings::is_interface;

use self::settings::Settings;
#[cfg(feature = "serial")]
use crate::serial::{DirectionControl, Parity, Rs485, SerialConfig, StopBits};
#[cfg(feature = "tcp")]
use crate::tcp::TcpConfig;
#[cfg(feature = "udp")]
use crate::udp::UdpConfig;
#[cfg(feature = "unix")]
use crate::unix::UnixConfig;
use blastema_contract::transport::MediumAddress;
use blastema_core::net::routing::MTU_MIN;
#[cfg(feature = "udp")]
use std::net::Ipv4Addr;
#[cfg(any(feature = "udp", feature = "tcp"))]
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::ops::Range;
#[cfg(any(feature = "tcp", feature = "unix", feature = "serial"))]
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

/// The largest frame that any setting allows, in bytes: each receiver must be able to hold it.
const MOST_BYTES: u64 = 1 << 24;
/// The smallest largest frame, in bytes: what routers tell each other must fit.
const LEAST_BYTES: u64 = MTU_MIN as u64;
/// The shortest and the longest time that a setting may name.
#[cfg(any(feature = "tcp", feature = "unix", feature = "serial"))]
const TIMEOUT: RangeInclusive<Duration> = Duration::from_millis(1)..=Duration::from_secs(3600);

/// A medium and its settings.
///
/// | text | medium | settings |
/// | --- | --- | --- |
/// | `udp://0.0.0.0:7400` | UDP at this address; port 0 takes a free one | `interface`, `mtu`, `receive_buffer`, `send_buffer`, `queue_frames` |
/// | `udp://239.255.0.1:7400` | UDP, hearing a multicast group | those, and `own` (the address that we send from), `hops` |
/// | `udp://10.0.1.1:7400?interface=firewire0` | IP over IEEE 1394, bound to its interface | as UDP |
/// | `tcp://10.0.0.1:7400` | TCP | `interface`, `mtu`, `peers`, `strangers`, `queue_bytes`, `connect_timeout`, `hello_timeout`, `user_timeout` |
/// | `unix:///run/x.sock` | a Unix-domain socket | `mode` (octal), `mtu`, `peers`, `strangers`, `queue_bytes`, `connect_timeout`, `hello_timeout`, `users` |
/// | `serial:///dev/ttyUSB0` | a serial line | `baud`, `parity`, `stop_bits`, `flow`, `rs485`, `rts`, `rts_before`, `rts_after`, `mtu`, `queue_time` |
/// | `can://can0` | a CAN interface | `fd`, `bit_rate_switch`, `bitrate`, `address`, `mtu`, `queue_frames`, `block_size`, `separation` |
/// | `slcan:///dev/ttyACM0` | a CAN adapter on a serial port | `bitrate`, `fd`, `bit_rate_switch`, `data_bitrate`, `baud`, `address`, `mtu`, `queue_frames`, `block_size`, `separation` |
/// | `memory://name` | between nodes of one process | |
///
/// Each takes `insecure` too, with or without `=true`: see [`Endpoint::parse`].
/// Times have a unit (`500ms`). In a path, `%3F` is a question mark, and `%25` a percent sign.
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
    #[cfg(feature = "udp")]
    Udp(UdpConfig),
    /// `tcp://`: one connection to each peer.
    #[cfg(feature = "tcp")]
    Tcp(TcpConfig),
    /// `unix://`: Unix-domain sockets on one computer.
    #[cfg(feature = "unix")]
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
        let Some((medium, rest)) = text.split_once("://") else {
            let problem = "an endpoint begins with its medium, as in udp://0.0.0.0:7400";
            return Err(EndpointError::new(text, 0..0, problem));
        };
        let split = rest.split_once('?');
        let (place, query) = split.map_or((rest, None), |(place, query)| (place, Some(query)));
        let medium = media::find(&media::MEDIA, medium)
            .map_err(|problem| EndpointError::new(text, 0..medium.len(), problem))?;
        let at = medium.len() + 3..medium.len() + 3 + place.len();
        let parts = Parts { text, place, at };
        let mut settings = Settings::new(text, medium, query)?;
        let endpoint = match medium {
            #[cfg(feature = "udp")]
            "udp" => udp(&parts, &mut settings),
            #[cfg(feature = "tcp")]
            "tcp" => tcp(&parts, &mut settings),
            #[cfg(feature = "unix")]
            "unix" => unix(&parts, &mut settings),
            #[cfg(feature = "serial")]
            "serial" => serial(&parts, &mut settings),
            "can" => can(&parts, &mut settings),
            "slcan" => slcan(&parts, &mut settings),
            _ => memory(&parts),
        }?;
        let insecure = settings.flag("insecure")?;
        settings.finish()?;
        Ok((endpoint, insecure))
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
        let error = |problem| EndpointError::new(text, 0..text.len(), problem);
        let parsed = match self {
            #[cfg(feature = "udp")]
            Endpoint::Udp(_) => Ok(MediumAddress::Ip(ip(text, 0..text.len(), text)?)),
            #[cfg(feature = "tcp")]
            Endpoint::Tcp(_) => Ok(MediumAddress::Ip(ip(text, 0..text.len(), text)?)),
            #[cfg(feature = "unix")]
            Endpoint::Unix(_) => {
                check_socket_path(text.len()).map_err(error)?;
                let path = text.starts_with('/').then(|| PathBuf::from(text).into());
                path.map(MediumAddress::Unix)
                    .ok_or("write the path of its socket, as in /run/b.sock")
            }
            #[cfg(feature = "serial")]
            Endpoint::Serial(_) => match text {
                "" => Ok(MediumAddress::Line),
                _ => Err("a line leads to one peer only, which needs no address: leave it empty"),
            },
            Endpoint::Can(_) | Endpoint::Slcan(_) => {
                let number = match text.strip_prefix("0x") {
                    Some(digits) => u8::from_str_radix(digits, 16),
                    None => text.parse(),
                };
                number.map(MediumAddress::Can).map_err(|_| "write its number on the bus, 0 to 255")
            }
            Endpoint::Memory(_) => Ok(MediumAddress::Memory(text.into())),
        };
        let checked = parsed.and_then(|peer| self.objection(&peer).map_or(Ok(peer), Err));
        let medium = self.medium();
        checked.map_err(|expected| error(format!("`{text}` is no peer on {medium}: {expected}")))
    }

    /// How many connections may be open there beside those of peers.
    pub fn strangers(&self) -> usize {
        match self {
            #[cfg(feature = "tcp")]
            Endpoint::Tcp(config) => config.strangers,
            #[cfg(feature = "unix")]
            Endpoint::Unix(config) => config.strangers,
            _ => 0,
        }
    }

    /// Why no other node can be at this address of the medium.
    fn objection(&self, peer: &MediumAddress) -> Option<&'static str> {
        const OURSELVES: &str = "it is our own address: write the neighbour's";
        match (self, peer) {
            #[cfg(feature = "udp")]
            (Endpoint::Udp(config), MediumAddress::Ip(peer)) => {
                let is_group = config.group == Some(*peer);
                let refused = validation::no_peer(*peer).filter(|_| !is_group);
                refused.or(validation::is_own(config.bind, *peer).then_some(OURSELVES))
            }
            #[cfg(feature = "tcp")]
            (Endpoint::Tcp(config), MediumAddress::Ip(peer)) => validation::no_peer(*peer)
                .or(validation::is_own(config.bind, *peer).then_some(OURSELVES)),
            #[cfg(feature = "unix")]
            (Endpoint::Unix(config), MediumAddress::Unix(path)) => {
                (config.path == **path).then_some(OURSELVES)
            }
            (Endpoint::Can(CanConfig { node, .. }), MediumAddress::Can(peer))
            | (Endpoint::Slcan(SlcanConfig { node, .. }), MediumAddress::Can(peer)) => {
                (*peer == node.address).then_some("it is our own number: write the neighbour's")
            }
            (Endpoint::Memory(_), MediumAddress::Memory(peer)) if peer.is_empty() => {
                Some("write the name of its end")
            }
            (Endpoint::Memory(own), MediumAddress::Memory(peer)) => {
                (own.as_str() == &**peer).then_some(OURSELVES)
            }
            // `peer` reads an address of this medium: what is left may be anywhere on it.
            _ => None,
        }
    }
}

/// The longest path of a Unix-domain socket on Linux, in bytes, without the closing zero.
#[cfg(feature = "unix")]
const SOCKET_PATH: usize = 107;

/// Finds a path of a Unix-domain socket that is too long, by its length in bytes.
///
/// # Errors
/// What is wrong with it, and what to do.
#[cfg(feature = "unix")]
pub fn check_socket_path(length: usize) -> Result<(), String> {
    match length <= SOCKET_PATH {
        true => Ok(()),
        false => Err(format!(
            "the path has {length} bytes, and a socket's has at most {SOCKET_PATH}: choose a \
             shorter one"
        )),
    }
}

/// An endpoint string behind its medium.
struct Parts<'a> {
    text: &'a str,
    place: &'a str,
    /// Where `place` stands in `text`.
    at: Range<usize>,
}

impl Parts<'_> {
    fn error(&self, problem: impl Into<Box<str>>) -> EndpointError {
        EndpointError::new(self.text, self.at.clone(), problem)
    }

    #[cfg(any(feature = "udp", feature = "tcp"))]
    fn no_broadcast(&self, address: SocketAddr) -> Result<(), EndpointError> {
        if validation::is_broadcast(address.ip()) {
            return Err(self.error(format!(
                "`{}` is the address of all on a network, and no computer's own: write 0.0.0.0 or \
                 one of this computer's",
                address.ip()
            )));
        }
        Ok(())
    }

    fn path(&self, example: &'static str) -> Result<PathBuf, EndpointError> {
        if !self.place.starts_with('/') {
            return Err(self.error(format!("a path begins with a slash, as in {example}")));
        }
        let mut bytes = Vec::with_capacity(self.place.len());
        let mut rest = self.place.bytes().enumerate();
        while let Some((place, byte)) = rest.next() {
            if byte != b'%' {
                bytes.push(byte);
                continue;
            }
            let mut digit = || rest.next().and_then(|(_, byte)| char::from(byte).to_digit(16));
            let (Some(high), Some(low)) = (digit(), digit()) else {
                let start = self.at.start + place;
                let problem = "after % there are two hexadecimal digits, as in %20 for a space";
                return Err(EndpointError::new(self.text, start..start + 1, problem));
            };
            bytes.push((high * 16 + low) as u8);
        }
        // Escapes can spell what is no UTF-8, and a zero, which no path holds.
        match String::from_utf8(bytes) {
            Ok(path) if !path.contains('\0') => Ok(path.into()),
            Ok(_) => Err(self.error("no path holds a zero byte: leave %00 out")),
            Err(_) => {
                Err(self.error("what the escapes spell is no UTF-8: write the letters themselves"))
            }
        }
    }
}

/// An IP address with its port, at `at` in `text`.
#[cfg(any(feature = "udp", feature = "tcp"))]
fn ip(text: &str, at: Range<usize>, found: &str) -> Result<SocketAddr, EndpointError> {
    if let Ok(address) = found.parse() {
        return Ok(address);
    }
    let whole = |problem| Err(EndpointError::new(text, at.clone(), problem));
    let no_ip = |found: &str| {
        format!(
            "`{found}` is no IP address: write it in numbers, as in 10.0.0.1:7400 or [fd00::1]:7400"
        )
    };
    let bare = found.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(found);
    if let Ok(address) = bare.parse::<IpAddr>() {
        let example = SocketAddr::new(address, 7400);
        // Where the last group could be a port, both are shown: only the writer knows.
        if let Some((host, port)) = bare.rsplit_once(':')
            && bare.len() == found.len()
            && let (Ok(host), Ok(port)) = (host.parse::<Ipv6Addr>(), port.parse::<u16>())
        {
            let meant = SocketAddr::new(host.into(), port);
            return whole(format!(
                "an IPv6 address stands in brackets: write {meant}, or {example}"
            ));
        }
        return whole(no_port(example));
    }
    let Some((host, port)) = found.rsplit_once(':') else {
        return whole(match host::is_host(found) {
            true => no_port(format_args!("{found}:7400")),
            false => no_ip(found),
        });
    };
    let inner = host.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(host);
    let end = at.start + host.len();
    if inner.parse::<IpAddr>().is_err() && (port.parse::<u16>().is_ok() || !host::is_host(host)) {
        return Err(EndpointError::new(text, at.start..end, no_ip(host)));
    }
    let problem = format!("`{port}` is no port: ports are 0 (any) to 65535");
    Err(EndpointError::new(text, end + 1..at.end, problem))
}

/// An IP address stands there without a port.
#[cfg(any(feature = "udp", feature = "tcp"))]
fn no_port(example: impl std::fmt::Display) -> String {
    format!("the port is missing: write {example}")
}

#[cfg(feature = "udp")]
fn udp(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    let address = ip(parts.text, parts.at.clone(), parts.place)?;
    parts.no_broadcast(address)?;
    let mut config = UdpConfig { bind: address, ..UdpConfig::default() };
    if address.ip().is_multicast() {
        if address.port() == 0 {
            return Err(parts.error(no_port(SocketAddr::new(address.ip(), 7400))));
        }
        if validation::is_reserved(address.ip()) {
            return Err(parts.error(format!(
                "`{}` is a group of the network's own protocols: write one for your own use, as in \
                 239.255.0.1 or ff15::1",
                address.ip()
            )));
        }
        let any: IpAddr = match address {
            SocketAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
            SocketAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
        };
        let expected =
            format!("our own address with its port, as in {}", SocketAddr::new(any, 7401));
        let own = settings.take("own", expected, |text| {
            let own: SocketAddr = text.parse().ok()?;
            let everybodys = own.ip().is_multicast() || validation::is_broadcast(own.ip());
            (own.is_ipv4() == address.is_ipv4() && !everybodys).then_some(own)
        })?;
        settings.number("hops", 1..=255, &mut config.hops)?;
        config.bind = own.unwrap_or(SocketAddr::new(any, 0));
        config.group = Some(address);
    }
    config.interface = settings.interface()?;
    config.mtu = largest_frame(settings, 65_507)?;
    settings.number("receive_buffer", 4_096..=1 << 30, &mut config.receive_buffer)?;
    settings.number("send_buffer", 4_096..=1 << 30, &mut config.send_buffer)?;
    settings.number("queue_frames", 1..=65_536, &mut config.queue_frames)?;
    Ok(Endpoint::Udp(config))
}

#[cfg(feature = "tcp")]
fn tcp(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    let bind = ip(parts.text, parts.at.clone(), parts.place)?;
    parts.no_broadcast(bind)?;
    if bind.ip().is_multicast() {
        return Err(parts.error("a group is heard by UDP only: write udp:// before it"));
    }
    let mut config = TcpConfig { bind, interface: settings.interface()?, ..TcpConfig::default() };
    let TcpConfig { mtu, peers, strangers, queue_bytes, .. } = &mut config;
    connections(settings, [mtu, peers, strangers, queue_bytes])?;
    settings.span("connect_timeout", TIMEOUT, &mut config.connect_timeout)?;
    settings.span("hello_timeout", TIMEOUT, &mut config.hello_timeout)?;
    settings.span("user_timeout", TIMEOUT, &mut config.user_timeout)?;
    Ok(Endpoint::Tcp(config))
}

/// How much a medium of connections holds: `mtu`, `peers`, `strangers` and `queue_bytes`.
#[cfg(any(feature = "tcp", feature = "unix"))]
fn connections(
    settings: &mut Settings<'_>,
    [mtu, peers, strangers, queue_bytes]: [&mut usize; 4],
) -> Result<(), EndpointError> {
    settings.number("mtu", LEAST_BYTES..=MOST_BYTES, mtu)?;
    settings.number("peers", 1..=65_536, peers)?;
    settings.number("strangers", 1..=65_536, strangers)?;
    settings.number("queue_bytes", LEAST_BYTES..=1 << 30, queue_bytes)
}

#[cfg(feature = "unix")]
fn unix(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    let path = parts.path("unix:///run/robot.sock")?;
    check_socket_path(path.as_os_str().len()).map_err(|problem| parts.error(problem))?;
    let mut config = UnixConfig::new(path);
    let mode = settings.take("mode", "permissions in octal, as in 660", |text| {
        u32::from_str_radix(text, 8).ok().filter(|mode| *mode <= 0o777)
    })?;
    config.mode = mode.unwrap_or(config.mode);
    let users = settings.take("users", "numbers of users, as in 1001,1002", |text| {
        text.split(',').map(|user| user.parse().ok()).collect()
    })?;
    config.users = users.unwrap_or_default();
    let UnixConfig { mtu, peers, strangers, queue_bytes, .. } = &mut config;
    connections(settings, [mtu, peers, strangers, queue_bytes])?;
    settings.span("connect_timeout", TIMEOUT, &mut config.connect_timeout)?;
    settings.span("hello_timeout", TIMEOUT, &mut config.hello_timeout)?;
    Ok(Endpoint::Unix(config))
}

#[cfg(feature = "serial")]
fn serial(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    let mut config = SerialConfig::new(parts.path("serial:///dev/ttyUSB0")?);
    settings.number("baud", BAUD, &mut config.baud)?;
    let parities = [("none", Parity::None), ("odd", Parity::Odd), ("even", Parity::Even)];
    settings.choice("parity", &parities, &mut config.parity)?;
    let stops = [("1", StopBits::One), ("2", StopBits::Two)];
    settings.choice("stop_bits", &stops, &mut config.stop_bits)?;
    // XON and XOFF are not among them: their bytes stand in frames, too.
    let flows = [("none", false), ("hardware", true)];
    settings.choice("flow", &flows, &mut config.hardware_flow)?;
    config.rs485 = rs485(settings)?;
    if config.hardware_flow && matches!(config.rs485, DirectionControl::Driver(_)) {
        return Err(
            settings.contradiction("flow", "RTS turns the line with rs485=true: leave flow out")
        );
    }
    config.mtu = largest_frame(settings, 65_535)?;
    settings.span("queue_time", TIMEOUT, &mut config.queue_time)?;
    Ok(Endpoint::Serial(config))
}

/// Whether and how the driver turns the line.
#[cfg(feature = "serial")]
fn rs485(settings: &mut Settings<'_>) -> Result<DirectionControl, EndpointError> {
    let mut how = Rs485::default();
    let turns: Option<bool> = settings.take("rs485", "true or false", |text| text.parse().ok())?;
    settings.choice("rts", &[("high", false), ("low", true)], &mut how.rts_low)?;
    let times = Duration::ZERO..=Duration::from_millis(100);
    settings.span("rts_before", times.clone(), &mut how.before)?;
    settings.span("rts_after", times, &mut how.after)?;
    let given = ["rts", "rts_before", "rts_after"].into_iter().find(|key| settings.has(key));
    if let Some(key) = given.filter(|_| turns != Some(true)) {
        let why = "RTS is the driver's where it turns a line of RS-485: add rs485=true";
        return Err(settings.contradiction(key, why));
    }
    for (key, span) in [("rts_before", how.before), ("rts_after", how.after)] {
        if !Rs485::is_whole(span) {
            return Err(settings.contradiction(key, Rs485::WHOLE));
        }
    }
    Ok(match turns {
        None => DirectionControl::Unchanged,
        Some(false) => DirectionControl::Off,
        Some(true) => DirectionControl::Driver(how),
    })
}

/// What serial ports of today can, with room above, in bits a second.
const BAUD: std::ops::RangeInclusive<u64> = 50..=50_000_000;

const ONLY_FD: &str = "only CAN FD frames can switch the bit rate: add fd=true";

/// Whether frames are those of CAN FD, and switch the bit rate.
fn can_fd(
    settings: &mut Settings<'_>,
    fd: &mut bool,
    bit_rate_switch: &mut bool,
) -> Result<(), EndpointError> {
    settings.switch("fd", fd)?;
    settings.switch("bit_rate_switch", bit_rate_switch)?;
    match *bit_rate_switch && !*fd {
        true => Err(settings.contradiction("bit_rate_switch", ONLY_FD)),
        false => Ok(()),
    }
}

fn can(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    if !is_interface(parts.place) {
        return Err(parts.error("the name of an interface is missing, as in can://can0"));
    }
    let mut config = CanConfig::new(parts.place);
    can_fd(settings, &mut config.fd, &mut config.bit_rate_switch)?;
    settings.number("bitrate", 10_000..=1_000_000, &mut config.bitrate)?;
    can_node(settings, &mut config.node)?;
    Ok(Endpoint::Can(config))
}

fn slcan(parts: &Parts<'_>, settings: &mut Settings<'_>) -> Result<Endpoint, EndpointError> {
    let mut config = SlcanConfig::new(parts.path("slcan:///dev/ttyACM0")?);
    let rate = settings.one_of("bitrate", &SLCAN_BIT_RATES)?;
    config.bitrate = rate.unwrap_or(config.bitrate);
    can_fd(settings, &mut config.fd, &mut config.bit_rate_switch)?;
    if let Some(rate) = settings.one_of("data_bitrate", &SLCAN_DATA_RATES)? {
        if !config.fd {
            return Err(settings.contradiction("data_bitrate", ONLY_FD));
        }
        config.data_bitrate = rate;
    }
    settings.number("baud", BAUD, &mut config.baud)?;
    can_node(settings, &mut config.node)?;
    Ok(Endpoint::Slcan(config))
}

fn can_node(settings: &mut Settings<'_>, node: &mut CanNodeConfig) -> Result<(), EndpointError> {
    settings.number("address", 0..=254, &mut node.address)?;
    settings.number("mtu", LEAST_BYTES..=MOST_BYTES, &mut node.mtu)?;
    settings.number("queue_frames", 1..=65_536, &mut node.queue_frames)?;
    settings.number("block_size", 0..=255, &mut node.block_size)?;
    // Those that ISO 15765-2 can say: nothing, 100 to 900 µs in steps of 100, 1 to 127 ms.
    let expected = "nothing (0ms), 100us to 900us in steps of 100us, or 1ms to 127ms";
    let mut separation = node.separation;
    let range = Duration::ZERO..=Duration::from_millis(127);
    settings.span("separation", range, &mut separation)?;
    let micros = separation.as_micros();
    let step = if micros < 1_000 { 100 } else { 1_000 };
    if !micros.is_multiple_of(step) {
        return Err(settings.contradiction("separation", expected));
    }
    node.separation = separation;
    Ok(())
}

fn memory(parts: &Parts<'_>) -> Result<Endpoint, EndpointError> {
    if parts.place.is_empty() {
        return Err(parts.error("the name of our end is missing, as in memory://left"));
    }
    Ok(Endpoint::Memory(parts.place.to_owned()))
}

#[cfg(any(feature = "udp", feature = "serial"))]
fn largest_frame(settings: &mut Settings<'_>, most: u64) -> Result<Option<usize>, EndpointError> {
    let mut mtu = 0;
    settings.number("mtu", LEAST_BYTES..=most, &mut mtu)?;
    Ok((mtu > 0).then_some(mtu))
}

#[cfg(test)]
mod tests;
