//! How ends of each medium are opened, and what is put onto its wire that no transport would.

use super::{Medium, Opened, start};
use blastema_contract::transport::MediumAddress;
use blastema_doubles::{now, paused};
use blastema_ptys::{Adapters, Cable};
use blastema_transports::{
    FaultInjector, FaultInjectorConfig, FrameTransport, Memory, MemoryMedium, SerialConfig,
    SerialLine, SlcanBus, SlcanConfig, Tcp, TcpConfig, Udp, UdpConfig, Unix, UnixConfig,
};
use std::cell::Cell;
use std::io::Write;
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use tempfile::TempDir;

#[derive(Default)]
pub(crate) struct OverMemory(MemoryMedium, Cell<u32>);

impl Medium for OverMemory {
    const HELD: u64 = 256 + 1024;

    fn run(test: impl Future<Output = ()>) {
        paused(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let name = match at {
            Some(MediumAddress::Memory(name)) => name,
            _ => {
                self.1.set(self.1.get() + 1);
                format!("end {}", self.1.get()).into()
            }
        };
        Opened::of(FrameTransport::new(Memory::new(&self.0, &name)))
    }

    /// What is in memory is typed.
    fn garbage(&self, _: &MediumAddress) {}
}

pub(crate) fn ip(address: &MediumAddress) -> SocketAddr {
    match address {
        MediumAddress::Ip(address) => *address,
        other => panic!("{other} is no address of IP"),
    }
}

#[derive(Default)]
pub(crate) struct OverUdp;

impl Medium for OverUdp {
    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = UdpConfig::default();
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        Opened::of(Udp::new(config))
    }

    fn garbage(&self, to: &MediumAddress) {
        let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
        for length in [0, 1, 7, 1000, 65_507] {
            stranger.send_to(&vec![0xA5; length], ip(to)).unwrap();
        }
    }
}

/// Those who hear one group also speak to each other alone.
pub(crate) struct OverMulticast(SocketAddr);

impl Default for OverMulticast {
    fn default() -> Self {
        let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        OverMulticast(([239, 255, 77, 2], free).into())
    }
}

impl Medium for OverMulticast {
    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = UdpConfig::default();
        config.group = Some(self.0);
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        Opened::of(Udp::new(config))
    }

    fn garbage(&self, to: &MediumAddress) {
        let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
        for length in [0, 1, 7, 1000] {
            stranger.send_to(&vec![0xA5; length], ip(to)).unwrap();
            stranger.send_to(&vec![0xA5; length], self.0).unwrap();
        }
    }
}

#[derive(Default)]
pub(crate) struct OverTcp;

impl Medium for OverTcp {
    const CONNECTS: bool = true;

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let mut config = TcpConfig::default();
        if let Some(at) = at {
            config.bind = ip(&at);
        }
        Opened::of(Tcp::new(config))
    }

    fn garbage(&self, to: &MediumAddress) {
        for bytes in
            [&b""[..], b"B", b"GET / HTTP/1.1\r\n\r\n", &[0xFF; 4096], b"BLST\x01\0\0\x07\xFF"]
        {
            let mut stranger = TcpStream::connect(ip(to)).unwrap();
            // It may be thrown out before it has said everything.
            let _ = stranger.write_all(bytes);
        }
    }
}

pub(crate) struct OverUnix(TempDir, Cell<u32>);

impl Default for OverUnix {
    fn default() -> Self {
        OverUnix(TempDir::new().unwrap(), Cell::new(0))
    }
}

impl Medium for OverUnix {
    const CONNECTS: bool = true;

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let path = match at {
            Some(MediumAddress::Unix(path)) => path.to_path_buf(),
            _ => {
                self.1.set(self.1.get() + 1);
                self.0.path().join(self.1.get().to_string())
            }
        };
        Opened::of(Unix::new(UnixConfig::new(path)))
    }

    fn garbage(&self, to: &MediumAddress) {
        let MediumAddress::Unix(path) = to else { panic!("{to} is no path") };
        for bytes in
            [&b""[..], b"B", b"GET / HTTP/1.1\r\n\r\n", &[0xFF; 4096], b"BLST\x01\x01\0\x02/x\xFF"]
        {
            let mut stranger = UnixStream::connect(path).unwrap();
            // It may be thrown out before it has said everything.
            let _ = stranger.write_all(bytes);
        }
    }
}

/// A line has two ends; a peer that opens again opens the one that was opened last.
pub(crate) struct OverSerial(Cable, Cell<u32>);

impl Default for OverSerial {
    fn default() -> Self {
        OverSerial(Cable::new(), Cell::new(0))
    }
}

impl OverSerial {
    fn last(&self) -> PathBuf {
        if self.1.get() == 1 { self.0.left() } else { self.0.right() }
    }
}

impl Medium for OverSerial {
    // The cable does.
    const KEEPS: bool = true;

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        if at.is_none() {
            self.1.set(self.1.get() + 1);
        }
        let mut config = SerialConfig::new(self.last());
        (config.baud, config.mtu) = (Some(50_000_000), Some(65_535));
        Opened::of(FrameTransport::new(SerialLine::new(config, now)))
    }

    fn garbage(&self, _: &MediumAddress) {
        for bytes in [&b"\0"[..], b"Linux login: ", &[0xFF; 300], b"\0\x05abc"] {
            self.0.inject(&self.last(), bytes);
        }
    }
}

/// Each end has an adapter of its own, whose number is its address.
pub(crate) struct OverSlcan(Adapters, Cell<u8>);

impl Default for OverSlcan {
    fn default() -> Self {
        OverSlcan(Adapters::new(), Cell::new(0))
    }
}

impl Medium for OverSlcan {
    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let address = match at {
            Some(MediumAddress::Can(address)) => address,
            _ => {
                self.1.set(self.1.get() + 1);
                self.0.plug(self.1.get());
                self.1.get()
            }
        };
        let mut config = SlcanConfig::new(self.0.port(address));
        config.bitrate = 1_000_000;
        (config.node.address, config.node.mtu) = (address, 65_000);
        config.node.queue_frames = 256;
        Opened::of(FrameTransport::new(SlcanBus::new(config, blastema_doubles::now)))
    }

    fn garbage(&self, to: &MediumAddress) {
        let MediumAddress::Can(number) = to else { panic!("{to} is on no bus") };
        for bytes in [
            &b"\x07\x07Linux login: \r"[..],
            b"\x00\xff\xfe\r",
            b"T18DA",
            b"\rt1239\rT18DA",
            &[0xFF; 300],
            // CAN frames that mean nothing, of a node that is not there.
            b"\rT18DA0163821FFFFFFFFFFFFFF\r",
            b"T18DA026330FFFF\rT18DB FF6380500\r",
        ] {
            self.0.inject(*number, bytes);
        }
    }
}

/// Any medium behind the fault wrapper, which is told nothing.
#[derive(Default)]
pub(crate) struct Behind<M>(M);

impl<M: Medium> Medium for Behind<M> {
    const CONNECTS: bool = M::CONNECTS;
    // What the wrapper holds back comes on top.
    const HELD: u64 = M::HELD + 256 + 4096;
    const KEEPS: bool = M::KEEPS;

    fn run(test: impl Future<Output = ()>) {
        M::run(test);
    }

    fn open(&self, at: Option<MediumAddress>) -> Opened {
        let inner = self.0.open(at).transport;
        let (address, panic) =
            start(FaultInjector::new(inner, FaultInjectorConfig::new(7, blastema_doubles::now)));
        Opened { wrapper: Some(address.clone().recipient()), transport: address.into(), panic }
    }

    fn garbage(&self, to: &MediumAddress) {
        self.0.garbage(to);
    }
}
