//! A device under test; and the one that is made of the Rust machine.

use blastema_lite::{
    CobsDecoder, Device, DeviceConfig, DeviceHook, FRAME_MAX, Firmware, PACKET_MAX, Port, PortSet,
    ResetCause, cobs,
};
use std::time::Duration;

/// What carries the packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Medium {
    Serial,
    Multidrop,
    Datagram,
}

pub(crate) const MEDIA: [Medium; 3] = [Medium::Serial, Medium::Multidrop, Medium::Datagram];

impl Medium {
    pub(crate) fn address(self) -> Option<u8> {
        (self == Medium::Multidrop).then_some(7)
    }
}

/// A device that lives in virtual time.
pub(crate) trait Bench {
    /// Gives the device these bytes at this time; returns what it sends: each datagram by itself,
    /// or the pieces of a stream.
    fn run(&mut self, now: Duration, bytes: &[u8]) -> Vec<Vec<u8>>;

    /// Switches the device off and on.
    fn reset(&mut self, now: Duration, cause: ResetCause);
}

pub(crate) const DEVICE_TYPE: u32 = 0x6f68_6365;
pub(crate) const DRIVE: usize = 0;
pub(crate) const DRIVEN: usize = 1;
pub(crate) const NUMBER: usize = 2;
pub(crate) const LIMIT: usize = 3;
pub(crate) const STEER: usize = 4;
pub(crate) const COUNT: usize = 5;
pub(crate) const FAILING: usize = 6;
pub(crate) const JOURNAL: usize = 7;

/// The contract of the firmware in `firmware.c`, and of the one below.
pub(crate) const PORTS: [Port; 8] = [
    Port::input(1, 0, 10, 0x1234_abcd),
    Port::output(1, 0, 10, 0x1234_abcd),
    Port::call(1, 0, 4, 8, 0x55aa_55aa),
    Port::variable(1, 0, 2, 3),
    Port::input(2, 0, 1, 4).with_deadline_ms(50),
    Port::output(2, 0, 1, 5),
    Port::call(2, 0, 0, 0, 6),
    Port::variable(2, 0, 13, 7),
];

/// What a device has carried out; a reset does not erase it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Journal {
    pub(crate) executed: u32,
    pub(crate) twice: u32,
    pub(crate) wrong: u32,
    pub(crate) aborted: u8,
}

impl Journal {
    pub(crate) fn from_bytes(bytes: &[u8]) -> Journal {
        let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        Journal { executed: number(0), twice: number(4), wrong: number(8), aborted: bytes[12] }
    }

    fn to_bytes(self) -> [u8; 13] {
        let mut bytes = [0; 13];
        bytes[..4].copy_from_slice(&self.executed.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.twice.to_le_bytes());
        bytes[8..12].copy_from_slice(&self.wrong.to_le_bytes());
        bytes[12] = self.aborted;
        bytes
    }
}

#[derive(Default)]
struct TestFirmware {
    cause: u8,
    drive: [u8; 10],
    driven: [u8; 10],
    limit: u16,
    steer: u8,
    count: u8,
    journal: Journal,
    last: u32,
}

impl Firmware for TestFirmware {
    fn hook(&mut self, object: u8, hook: DeviceHook, why: u8, published: &mut PortSet) -> u8 {
        match (object, hook) {
            (1, DeviceHook::Activated) => {
                (self.drive, self.driven) = Default::default();
                if self.limit == 666 { 9 } else { 0 }
            }
            (1, DeviceHook::Execute) => {
                if self.drive[..2] == 666u16.to_le_bytes() {
                    return 7;
                }
                if self.drive != self.driven {
                    self.driven = self.drive;
                    published.insert(DRIVEN);
                }
                0
            }
            (_, DeviceHook::Aborting) => {
                self.journal.aborted = why;
                0
            }
            (1, DeviceHook::Reset) if self.limit == 667 => 8,
            (2, DeviceHook::Initialize) if self.cause == ResetCause::FaultHandler as u8 => 5,
            (2, DeviceHook::Execute) => {
                self.count = self.count.wrapping_add(1);
                published.insert(COUNT);
                0
            }
            _ => 0,
        }
    }

    fn read(&mut self, port: usize, value: &mut [u8]) {
        match port {
            DRIVEN => value.copy_from_slice(&self.driven),
            LIMIT => value.copy_from_slice(&self.limit.to_le_bytes()),
            COUNT => value[0] = self.count,
            JOURNAL => value.copy_from_slice(&self.journal.to_bytes()),
            other => panic!("{other} is not read"),
        }
    }

    fn write(&mut self, port: usize, value: &[u8]) {
        match port {
            DRIVE => self.drive.copy_from_slice(value),
            LIMIT => self.limit = u16::from_le_bytes(value.try_into().unwrap()),
            STEER => self.steer = value[0],
            JOURNAL => self.journal = Journal::from_bytes(value),
            other => panic!("{other} is not written"),
        }
    }

    fn call(&mut self, port: usize, arguments: &[u8], result: &mut [u8]) -> bool {
        if port == FAILING {
            return false;
        }
        let argument = u32::from_le_bytes(arguments.try_into().unwrap());
        self.journal.executed += 1;
        if argument == self.last {
            self.journal.twice += 1;
        } else if argument != self.last + 1 {
            self.journal.wrong += 1;
        }
        self.last = argument;
        result[..4].copy_from_slice(&self.journal.executed.to_le_bytes());
        result[4..].copy_from_slice(arguments);
        true
    }

    fn text(&self, object: u8, code: u8) -> &str {
        if (object, code) == (1, 7) { "over travel" } else { "" }
    }
}

type TestDevice = Device<'static, 2, 8>;

/// The Rust machine.
pub(crate) struct RustSide {
    medium: Medium,
    device: TestDevice,
    firmware: TestFirmware,
    decoder: CobsDecoder,
    boot: u16,
    address: Option<u8>,
}

impl RustSide {
    pub(crate) fn new(medium: Medium) -> RustSide {
        RustSide::with_address(medium, medium.address())
    }

    pub(crate) fn with_address(medium: Medium, address: Option<u8>) -> RustSide {
        let mut firmware = TestFirmware::default();
        let device = started(address, 0, ResetCause::PowerOn, Duration::ZERO, &mut firmware);
        let decoder = CobsDecoder::default();
        let mut side = RustSide { medium, device, firmware, decoder, boot: 0, address };
        side.reset(Duration::ZERO, ResetCause::PowerOn);
        side
    }

    fn drain(&mut self, sent: &mut Vec<Vec<u8>>) {
        let (mut packet, mut frame) = ([0; PACKET_MAX], [0; FRAME_MAX]);
        while let Some(packet) = self.device.poll_packet(&mut self.firmware, &mut packet) {
            let is_datagram = self.medium == Medium::Datagram;
            let bytes = if is_datagram { packet } else { cobs::encode(packet, &mut frame) };
            sent.push(bytes.to_vec());
        }
    }
}

fn started(
    address: Option<u8>,
    boot: u16,
    cause: ResetCause,
    now: Duration,
    firmware: &mut TestFirmware,
) -> TestDevice {
    let deadman_max = Duration::from_secs(1);
    let ports = &PORTS;
    let config =
        DeviceConfig { device_type: DEVICE_TYPE, ports, address, boot, cause, deadman_max };
    Device::new(config, now, firmware)
}

impl Bench for RustSide {
    fn run(&mut self, now: Duration, bytes: &[u8]) -> Vec<Vec<u8>> {
        let mut sent = Vec::new();
        if self.medium == Medium::Datagram {
            self.device.handle_packet(bytes, now, &mut self.firmware);
            self.drain(&mut sent);
        } else {
            for &byte in bytes {
                if let Some(packet) = self.decoder.push(byte) {
                    self.device.handle_packet(packet, now, &mut self.firmware);
                    self.drain(&mut sent);
                }
            }
        }
        if self.device.restarts() {
            self.reset(now, ResetCause::Software);
        }
        self.device.handle_timeout(now, &mut self.firmware);
        self.drain(&mut sent);
        sent
    }

    fn reset(&mut self, now: Duration, cause: ResetCause) {
        self.boot += 1;
        self.firmware.cause = cause as u8;
        (self.firmware.limit, self.firmware.count) = (0, 0);
        self.decoder = CobsDecoder::default();
        self.device = started(self.address, self.boot, cause, now, &mut self.firmware);
    }
}
