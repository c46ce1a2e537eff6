//! The protocol between a node and a microcontroller on a serial line, an RS-485 bus or a radio.
//!
//! A device is a chip with 2 KiB of memory and no code for recovery. It answers; the node's proxy
//! does the rest: finds it, opens a session, compares the contract, keeps its life cycle, notices
//! its resets and its silence. After RTComponent-Lite 0.4.0 (Suzuki et al., RSJ 2007).
//!
//! ```text
//!         node                                             chip
//!  proxy ─ Host ─ HostLine ══ frames of COBS ══ CobsDecoder ─ Device ─ Firmware
//!             └────────────── datagrams ──────────────────────┘
//! ```
//!
//! * [`packet`](DevicePacket): header, object, message, data, checksum over session and packet.
//! * [`Host`]: the host's side of one device; [`HostLine`]: the turns on a serial line.
//! * [`Device`]: the device's side. `c/` has it in C99 for chips: `blastema_lite.h` begins with a
//!   whole firmware, in which the library takes 2.6 KiB of flash and 86 bytes of RAM on an
//!   ATmega328P (gcc 5.4, `-Os`).
//!
//! Both are machines without IO: they are given packets and the time, and are polled for what to
//! send. The crate needs neither `std` nor an allocator, and no other crate. Keys are not part of
//! it: a station on the line can forge every packet.
//!
//! # Examples
//!
//! ```
//! use blastema_lite::{
//!     Device, DeviceConfig, DeviceHook, Firmware, Host, HostConfig, HostEvent, PACKET_MAX, Port,
//!     PortSet, ResetCause, Tries,
//! };
//! use core::time::Duration;
//!
//! struct Gripper {
//!     force: u8,
//! }
//!
//! impl Firmware for Gripper {
//!     fn hook(&mut self, _: u8, hook: DeviceHook, _: u8, _: &mut PortSet) -> u8 {
//!         if hook == DeviceHook::Aborting {
//!             self.force = 0;
//!         }
//!         0
//!     }
//!     fn read(&mut self, _: usize, _: &mut [u8]) {}
//!     fn write(&mut self, _: usize, value: &[u8]) {
//!         self.force = value[0];
//!     }
//!     fn call(&mut self, _: usize, _: &[u8], _: &mut [u8]) -> bool {
//!         false
//!     }
//! }
//!
//! const PORTS: [Port; 1] = [Port::input(1, 0, 1, 0x1234_abcd)];
//! let now = Duration::ZERO;
//! let mut firmware = Gripper { force: 0 };
//! let config = DeviceConfig {
//!     device_type: 7,
//!     ports: &PORTS,
//!     address: None,
//!     boot: 1,
//!     cause: ResetCause::PowerOn,
//!     deadman_max: Duration::from_secs(1),
//! };
//! let mut device = Device::<1, 1>::new(config, now, &mut firmware);
//! let config = HostConfig {
//!     address: None,
//!     device_type: 7,
//!     ports: PORTS,
//!     session: 0x1234,
//!     interval: Duration::from_millis(100),
//!     tries: Tries::Auto,
//!     deadman: Duration::from_millis(500),
//!     byte_time: Duration::ZERO,
//!     turnaround: Duration::from_millis(10),
//! };
//! let mut host = Host::new(config, now);
//! let (mut out, mut back) = ([0; PACKET_MAX], [0; PACKET_MAX]);
//! while !host.is_serving() {
//!     let packet = host.poll_packet(now, |_, _| (), &mut out).expect("it asks until it serves");
//!     device.handle_packet(packet, now, &mut firmware);
//!     while let Some(packet) = device.poll_packet(&mut firmware, &mut back) {
//!         host.handle_packet(packet, now);
//!     }
//!     while let Some(event) = host.poll_event() {
//!         assert!(matches!(event, HostEvent::Greeted(_) | HostEvent::Serving));
//!     }
//! }
//!
//! host.handle_publish(0).expect("it serves");
//! let packet = host.poll_packet(now, |_, value| value[0] = 9, &mut out).expect("a value");
//! device.handle_packet(packet, now, &mut firmware);
//! assert_eq!(firmware.force, 9);
//! ```

#![no_std]

#[cfg(test)]
extern crate std;

pub mod cobs;
mod device;
mod firmware;
mod host;
mod line;
pub mod message;
mod packet;
mod port;

pub use cobs::{CobsDecoder, FRAME_MAX};
pub use device::{Device, DeviceConfig};
pub use firmware::{DeviceHook, Firmware};
pub use host::{
    CommandError, CommandOutcome, DeviceCommand, DeviceIdentity, Host, HostConfig, HostEvent,
    Mismatch, Tries,
};
pub use line::HostLine;
pub use message::{DeviceState, LifecycleChange, ResetCause, Status};
pub use packet::{DATA_MAX, DevicePacket, OBJECTS_MAX, PACKET_MAX};
pub use port::{PORTS_MAX, Port, PortKind, PortSet};
