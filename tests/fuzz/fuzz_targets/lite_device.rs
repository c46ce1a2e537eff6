//! For all packets at all times, a device does not panic, answers each packet with one packet and
//! its events at most, and its next timeout is in the future.

#![no_main]

use blastema_lite::{
    Device, DeviceConfig, DeviceHook, DevicePacket, Firmware, PACKET_MAX, Port, PortSet, ResetCause,
};
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

const PORTS: [Port; 4] = [
    Port::input(1, 0, 2, 1).with_deadline_ms(30),
    Port::output(2, 0, 3, 2),
    Port::call(1, 0, 1, 4, 3),
    Port::variable(2, 0, 1, 4),
];

struct Chip(u8);

impl Firmware for Chip {
    fn hook(&mut self, _: u8, hook: DeviceHook, _: u8, published: &mut PortSet) -> u8 {
        published.insert(self.0.into());
        if hook == DeviceHook::Activated { self.0 & 1 } else { 0 }
    }

    fn read(&mut self, port: usize, value: &mut [u8]) {
        assert_eq!(value.len(), PORTS[port].size().into());
    }

    fn write(&mut self, port: usize, value: &[u8]) {
        assert_eq!(value.len(), PORTS[port].size().into());
        self.0 = value[0];
    }

    fn call(&mut self, port: usize, arguments: &[u8], result: &mut [u8]) -> bool {
        assert_eq!(arguments.len(), PORTS[port].size().into());
        assert_eq!(result.len(), PORTS[port].reply().into());
        arguments[0] > 9
    }

    fn text(&self, _: u8, _: u8) -> &str {
        "a text that is longer than the thirty-two bytes which are sent"
    }
}

type Script = (Option<u8>, Vec<(u16, Option<(Option<u8>, u8, u8)>, Vec<u8>)>);

fuzz_target!(|script: Script| {
    let (address, script) = script;
    let mut now = Duration::ZERO;
    let deadman_max = Duration::from_millis(500);
    let (device_type, boot, cause) = (1, 1, ResetCause::Unknown);
    let config = DeviceConfig { device_type, ports: &PORTS, address, boot, cause, deadman_max };
    let mut chip = Chip(1);
    let mut device = Device::<2, 4>::new(config, now, &mut chip);
    for (wait_ms, fields, data) in script {
        now += Duration::from_millis(wait_ms.into());
        device.handle_timeout(now, &mut chip);
        let mut bytes = [0; PACKET_MAX];
        let bytes = match fields {
            // With the right checksum, and with the session of which all are.
            Some((sequence, object, message)) if data.len() <= 240 => {
                let from_device = false;
                let data = &data[..];
                let fields = DevicePacket { address, from_device, sequence, object, message, data };
                fields.encode(0x0101, &mut bytes)
            }
            _ => &data,
        };
        device.handle_packet(bytes, now, &mut chip);
        let mut room = [0; PACKET_MAX];
        // The states of two objects, one out port, one answer.
        let sent =
            (0..9).take_while(|_| device.poll_packet(&mut chip, &mut room).is_some()).count();
        assert!(sent <= 4, "{sent} packets");
        device.handle_timeout(now, &mut chip);
        assert!(device.poll_timeout().is_none_or(|due| due > now));
    }
});
