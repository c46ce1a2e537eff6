//! What the endpoint strings of CAN say: a node of a bus, reached by SocketCAN or by a serial
//! adapter.

use std::path::PathBuf;
use std::time::Duration;

/// Which node of a CAN bus we are, and how frames are cut up for it (ISO 15765-2).
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct CanNodeConfig {
    /// Our number on the bus, 0 to 254. No two nodes may have the same; peers are given by theirs.
    /// What is sent to 255 goes to all.
    pub address: u8,
    /// The largest frame, in bytes. A larger one keeps others waiting longer.
    pub mtu: usize,
    /// How many frames wait for the bus; beyond, they are dropped.
    pub queue_frames: usize,
    /// After so many parts we want to be asked whether to go on; 0 is never. Smaller protects a
    /// slow receiver, and costs time.
    pub block_size: u8,
    /// How long a peer is to pause between two parts for us: none, 100 to 900 µs, or 1 to 127 ms.
    pub separation: Duration,
}

impl Default for CanNodeConfig {
    fn default() -> Self {
        CanNodeConfig {
            address: 0,
            // 148 classic frames: 40 ms of a bus of 500 kbit/s, less than between two hellos.
            mtu: 1_024,
            queue_frames: 64,
            block_size: 0,
            separation: Duration::ZERO,
        }
    }
}

/// A CAN interface of the system (SocketCAN), as in `can://can0?fd=true&address=3`.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct CanConfig {
    /// The interface, such as `can0`.
    pub interface: String,
    /// CAN FD frames of up to 64 bytes, instead of classic ones of up to 8. All nodes of the bus
    /// must be able to.
    pub fd: bool,
    /// The payload of CAN FD frames goes at the bus's higher bit rate.
    pub bit_rate_switch: bool,
    /// The bus's bit rate, in bits a second. It sets nothing: it is what hellos are paced by, for
    /// an interface of the system does not say how fast it is.
    pub bitrate: u32,
    /// This node's address and limits on the bus.
    pub node: CanNodeConfig,
}

impl CanConfig {
    /// Classic CAN on this interface.
    pub fn new(interface: &str) -> Self {
        CanConfig {
            interface: interface.to_owned(),
            fd: false,
            bit_rate_switch: false,
            bitrate: 500_000,
            node: CanNodeConfig::default(),
        }
    }
}

pub use blastema_core::medium::can::slcan::BIT_RATES_HZ as SLCAN_BIT_RATES;

/// The bit rates for the payload of CAN FD frames that adapters have a command for, in bits a
/// second.
pub const SLCAN_DATA_RATES: [u32; 2] = [2_000_000, 5_000_000];

/// A CAN adapter on a serial port (SLCAN), as in `slcan:///dev/ttyACM0?bitrate=500000&address=3`.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct SlcanConfig {
    /// The serial port; best a stable path such as `/dev/serial/by-id/…`.
    pub path: PathBuf,
    /// The bus's bit rate, one of [`SLCAN_BIT_RATES`].
    pub bitrate: u32,
    /// CAN FD frames of up to 64 bytes, for adapters that know them (the CANable's extension of the
    /// protocol). All nodes of the bus must be able to.
    pub fd: bool,
    /// The payload of CAN FD frames goes at `data_bitrate`.
    pub bit_rate_switch: bool,
    /// The bus's bit rate for the payload of CAN FD frames, one of [`SLCAN_DATA_RATES`]. Adapters
    /// want to know it also where it is not used.
    pub data_bitrate: u32,
    /// The serial line's speed, in bits a second. Adapters on USB do not mind it.
    pub baud: u32,
    /// This node's address and limits on the bus.
    pub node: CanNodeConfig,
}

impl SlcanConfig {
    /// The adapter at this port, on a bus of 500 kbit/s.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        SlcanConfig {
            path: path.into(),
            bitrate: 500_000,
            fd: false,
            bit_rate_switch: false,
            data_bitrate: 2_000_000,
            baud: 115_200,
            node: CanNodeConfig::default(),
        }
    }
}
