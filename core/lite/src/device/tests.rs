use super::*;
use crate::message::{HELLO, LINK, PING, POLL, RESTART};
use std::vec;
use std::vec::Vec;

#[derive(Default)]
struct Counter {
    calls: u32,
    written: u8,
    aborted: u8,
    fails: bool,
}

const PORTS: [Port; 4] = [
    Port::input(1, 0, 1, 1),
    Port::output(1, 0, 1, 2),
    Port::call(1, 0, 1, 4, 3),
    Port::variable(1, 0, 1, 4),
];

impl Firmware for Counter {
    fn hook(&mut self, _: u8, hook: DeviceHook, why: u8, published: &mut PortSet) -> u8 {
        match hook {
            DeviceHook::Aborting => self.aborted = why,
            DeviceHook::Execute => published.insert(1),
            DeviceHook::Activated if self.fails => return 3,
            _ => {}
        }
        0
    }

    fn read(&mut self, _: usize, value: &mut [u8]) {
        value[0] = self.written;
    }

    fn write(&mut self, _: usize, value: &[u8]) {
        self.written = value[0];
    }

    fn call(&mut self, _: usize, _: &[u8], result: &mut [u8]) -> bool {
        self.calls += 1;
        result.copy_from_slice(&self.calls.to_le_bytes());
        true
    }
}

/// A packet as fields: sequence, object, message, data.
type Fields = (Option<u8>, u8, u8, Vec<u8>);

struct Chip {
    device: Device<'static, 1, 4>,
    firmware: Counter,
    address: Option<u8>,
    session: u16,
}

impl Chip {
    fn new(address: Option<u8>) -> Chip {
        let config = DeviceConfig {
            device_type: 0x0403_0201,
            ports: &PORTS,
            address,
            boot: 0x0105,
            cause: ResetCause::Watchdog,
            deadman_max: Duration::from_millis(500),
        };
        let mut firmware = Counter::default();
        let device = Device::new(config, Duration::ZERO, &mut firmware);
        Chip { device, firmware, address, session: 0x1234 }
    }

    fn in_session(address: Option<u8>) -> Chip {
        let mut chip = Chip::new(address);
        chip.ask(None, LINK, HELLO, &[0x34, 0x12, 0, 0]).expect("HELLO is answered");
        chip
    }

    fn give(&mut self, to: Option<u8>, sequence: Option<u8>, object: u8, message: u8, data: &[u8]) {
        let mut bytes = [0; PACKET_MAX];
        let packet =
            DevicePacket { address: to, from_device: false, sequence, object, message, data };
        let bytes = packet.encode(self.session, &mut bytes);
        self.device.handle_packet(bytes, Duration::ZERO, &mut self.firmware);
    }

    fn poll(&mut self) -> Option<Fields> {
        let mut bytes = [0; PACKET_MAX];
        let bytes = self.device.poll_packet(&mut self.firmware, &mut bytes)?;
        let packet = DevicePacket::decode(bytes, self.address.is_some(), self.session);
        let packet = packet.expect("a packet of this session");
        assert!(packet.from_device && packet.address == self.address);
        Some((packet.sequence, packet.object, packet.message, packet.data.to_vec()))
    }

    /// What the device answers; it must answer with one packet at most.
    fn ask(
        &mut self,
        sequence: Option<u8>,
        object: u8,
        message: u8,
        data: &[u8],
    ) -> Option<Vec<u8>> {
        self.give(self.address, sequence, object, message, data);
        let answer = self.poll();
        assert_eq!(self.poll(), None);
        answer.map(|(.., data)| data)
    }

    fn call(&mut self, sequence: u8) -> Option<Vec<u8>> {
        self.ask(Some(sequence), 1, 0x80, &[0])
    }
}

#[test]
fn without_a_session_only_the_link_is_served() {
    let mut chip = Chip::new(None);
    assert_eq!(chip.call(1), None);
    chip.session = 0;
    assert_eq!(chip.call(1), None);
    assert_eq!(chip.ask(None, LINK, PING, &[9]), Some(vec![9, 5, 0, 0]));
    assert_eq!(chip.ask(None, LINK, HELLO, &[0, 0, 0, 0]), None, "0 is no session");
    assert_eq!(chip.firmware.calls, 0);
}

#[test]
fn a_repeated_command_is_answered_from_memory_and_older_copies_are_out_of_step() {
    let mut chip = Chip::in_session(None);
    let mut sequence = 0;
    for calls in 1..=20 {
        sequence = (sequence + 1) % 8;
        for _ in 0..3 {
            assert_eq!(chip.call(sequence), Some(vec![0, calls, 0, 0, 0]));
        }
        // Copies of up to six commands before this one were delayed.
        for age in 1..=6 {
            let old = (sequence + 8 - age) % 8;
            assert_eq!(chip.call(old), Some(vec![Status::OutOfStep as u8]));
        }
        assert_eq!(chip.firmware.calls, calls.into());
    }
}

#[test]
fn the_same_hello_resets_nothing_and_another_one_forgets_the_last_command() {
    let mut chip = Chip::in_session(None);
    chip.call(1);
    chip.ask(None, LINK, HELLO, &[0x34, 0x12, 0, 0]).expect("an answer");
    assert_eq!(chip.call(1), Some(vec![0, 1, 0, 0, 0]), "from memory");

    chip.session = 0x1235;
    chip.ask(None, LINK, HELLO, &[0x35, 0x12, 0, 0]).expect("an answer");

    assert_eq!(chip.call(0), Some(vec![Status::OutOfStep as u8]));
    assert_eq!(chip.call(1), Some(vec![0, 2, 0, 0, 0]));
    chip.session = 0x1234;
    assert_eq!(chip.call(2), None, "the old session is over");
}

#[test]
fn hello_tells_the_boot_count_the_cause_the_type_and_the_states() {
    let mut chip = Chip::in_session(None);
    let expected = vec![1, 5, 1, 4, 1, 2, 3, 4, 240, 1, 1];
    assert_eq!(chip.ask(None, LINK, HELLO, &[1, 0, 0, 0]), Some(expected));
    chip.session = 1;
    assert_eq!(chip.ask(None, LINK, PING, &[7]), Some(vec![7, 5, 1, 1]));
}

#[test]
fn data_of_a_wrong_length_are_dropped_and_unknown_messages_answered() {
    let mut chip = Chip::in_session(None);
    for (object, message, data) in [
        (1, 0x80, &[][..]),
        (1, 0x80, &[1, 2]),
        (1, 0x40, &[1, 2]),
        (1, 0x10, &[1]),
        (1, 0x60, &[1]),
        (1, 0xE0, &[1]),
        (1, 0xC0, &[]),
        (1, 0x16, &[1]),
    ] {
        assert_eq!(chip.ask(Some(1), object, message, data), None, "{message:x}");
    }
    for (sequence, object, message) in [(1, 1, 0x81), (2, 2, 0x10), (3, 1, 0x20), (4, 1, 0x22)] {
        let answer = chip.ask(Some(sequence), object, message, &[]);
        assert_eq!(answer, Some(vec![Status::NoSuch as u8]), "{object} {message:x}");
    }
    assert_eq!(chip.ask(None, LINK, PING, &[1, 2]), None);
    assert_eq!(chip.ask(None, LINK, POLL, &[1]), None, "the line is its own");
    assert_eq!(chip.ask(Some(5), LINK, PING, &[1]), None);
    assert_eq!(chip.firmware.calls, 0);
}

#[test]
fn a_plain_write_is_taken_and_not_answered_and_other_plain_messages_do_nothing() {
    let mut chip = Chip::in_session(None);
    assert_eq!(chip.ask(None, 1, 0x40, &[7]), None);
    assert_eq!(chip.firmware.written, 7);
    assert_eq!(chip.ask(None, 1, 0xC0, &[8]), None);
    assert_eq!(chip.ask(None, 1, 0x80, &[8]), None);
    assert_eq!(chip.ask(None, 1, 0x10, &[]), None);
    assert_eq!((chip.firmware.written, chip.firmware.calls), (7, 0));
    assert_eq!(chip.device.state(1), DeviceState::Inactive);
}

#[test]
fn a_restart_needs_the_right_type() {
    let mut chip = Chip::new(None);
    let refused = chip.ask(None, LINK, RESTART, &[4, 3, 2, 1]);
    assert_eq!(refused, Some(vec![4, Status::NoSuch as u8]));
    assert!(!chip.device.restarts());
    assert_eq!(chip.ask(None, LINK, RESTART, &[1, 2, 3, 4]), Some(vec![1, 0]));
    assert!(chip.device.restarts());
}

#[test]
fn on_a_shared_line_events_wait_for_a_poll() {
    let mut chip = Chip::in_session(Some(7));
    chip.firmware.fails = true;
    let failed = chip.ask(Some(1), 1, 0x10, &[]);
    assert_eq!(failed, Some(vec![Status::HookFailed as u8, DeviceState::Error as u8]));
    chip.device.publish(1);

    let waiting = message::FLAG_SESSION | message::FLAG_WAITING | 1 << 4;
    assert_eq!(chip.ask(None, LINK, PING, &[9]), Some(vec![9, 5, waiting, 0x34]));
    chip.give(Some(7), None, LINK, POLL, &[1]);
    let state = vec![DeviceState::Error as u8, 3];
    assert_eq!(chip.poll(), Some((None, 1, message::STATE, state)));
    assert_eq!(chip.poll(), Some((None, LINK, PING, vec![1, 5, waiting, 0x34])));
    assert_eq!(chip.poll(), None);

    chip.give(Some(7), None, LINK, POLL, &[9]);
    assert_eq!(chip.poll(), Some((None, 1, 0x60, vec![0])));
    let rest = waiting & !message::FLAG_WAITING;
    assert_eq!(chip.poll(), Some((None, LINK, PING, vec![9, 5, rest, 0x34])));
}

#[test]
fn packets_to_others_are_ignored_and_packets_to_all_are_not_answered() {
    let mut chip = Chip::in_session(Some(7));
    chip.give(Some(8), None, 1, 0x40, &[5]);
    chip.give(Some(8), None, LINK, PING, &[5]);
    chip.give(Some(0), Some(1), 1, 0x80, &[5]);
    assert_eq!((chip.poll(), chip.firmware.written, chip.firmware.calls), (None, 0, 0));

    chip.give(Some(0), None, 1, 0x40, &[5]);
    chip.give(Some(0), None, LINK, PING, &[5]);

    assert_eq!((chip.poll(), chip.firmware.written), (None, 5));
}

#[test]
fn the_dead_man_expires_at_the_hosts_limit_or_at_the_devices_own() {
    #[track_caller]
    fn check(asked: [u8; 2], expires_ms: u64) {
        let mut chip = Chip::in_session(None);
        chip.ask(None, LINK, HELLO, &[0x34, 0x12, asked[0], asked[1]]).expect("an answer");
        chip.ask(Some(1), 1, 0x10, &[]).expect("an answer");
        let ms = Duration::from_millis;
        chip.device.handle_timeout(ms(expires_ms - 1), &mut chip.firmware);
        assert_eq!(chip.device.state(1), DeviceState::Active);

        chip.device.handle_timeout(ms(expires_ms), &mut chip.firmware);

        assert_eq!(chip.device.state(1), DeviceState::Error);
        assert_eq!(chip.firmware.aborted, message::CODE_DEADMAN);
    }
    check([200, 0], 200);
    check([0, 0], 500);
    check([0xFF, 0xFF], 500);
}

#[test]
fn the_device_sleeps_when_nothing_is_active() {
    let mut chip = Chip::in_session(None);
    assert_eq!(chip.device.poll_timeout(), None);
    chip.ask(Some(1), 1, 0x10, &[]).expect("an answer");
    assert_eq!(chip.device.poll_timeout(), Some(Duration::from_millis(10)));
    chip.ask(Some(2), 1, 0x15, &[]).expect("an answer");
    assert_eq!(chip.device.poll_timeout(), Some(Duration::from_millis(500)), "the dead-man");
}
