//! Several devices on one line: the host gives the turns, in virtual time with real baud rates.

use crate::bench::{Bench, DRIVE, LIMIT, Medium, RustSide};
use crate::c_side::CSide;
use crate::robot::{TestHost, config, ms};
use blastema_lite::{
    DeviceCommand, FRAME_MAX, Host, HostConfig, HostEvent, HostLine, LifecycleChange,
};
use std::time::Duration;

const BYTE_TIME: Duration = Duration::from_nanos(86_806);

struct Bus {
    benches: Vec<Box<dyn Bench>>,
    /// Devices that are switched off.
    dead: Vec<usize>,
    hosts: Vec<TestHost>,
    line: HostLine,
    now: Duration,
    events: Vec<(usize, HostEvent)>,
    /// When each device got a frame of its own.
    turns: Vec<(usize, Duration)>,
}

impl Bus {
    fn new(addresses: impl Iterator<Item = u8> + Clone, interval: Duration) -> Bus {
        let host = |address| {
            let session = u16::from(address) * 1000;
            let turnaround = ms(2);
            let config = HostConfig {
                address: Some(address),
                session,
                interval,
                byte_time: BYTE_TIME,
                turnaround,
                ..config(Medium::Multidrop)
            };
            Host::new(config, Duration::ZERO)
        };
        let bench = |address: u8| -> Box<dyn Bench> {
            // The C side is compiled with this address.
            if Some(address) == Medium::Multidrop.address() {
                return Box::new(CSide::new(Medium::Multidrop));
            }
            Box::new(RustSide::with_address(Medium::Multidrop, Some(address)))
        };
        Bus {
            benches: addresses.clone().map(bench).collect(),
            dead: Vec::new(),
            hosts: addresses.map(host).collect(),
            line: HostLine::default(),
            now: Duration::ZERO,
            events: Vec::new(),
            turns: Vec::new(),
        }
    }

    /// Carries frames for so long.
    fn run(&mut self, duration: Duration) {
        let end = self.now + duration;
        while self.now < end {
            let mut frame = [0; FRAME_MAX];
            let Bus { hosts, line, now, .. } = self;
            let Some(frame) = line.poll_frame(hosts, *now, |_, _, value| value.fill(1), &mut frame)
            else {
                self.now = line.poll_timeout(hosts).expect("there are hosts").max(*now);
                self.line.handle_timeout(&mut self.hosts, self.now);
                self.take_events();
                continue;
            };
            let frame = frame.to_vec();
            // COBS leaves an address, which is never 0, where it is.
            let addressed = |host: &TestHost| host.config().address == Some(frame[1]);
            let at = self.hosts.iter().position(addressed).expect("a device of the line");
            self.turns.push((at, self.now));
            self.now += BYTE_TIME * frame.len() as u32;
            let alive = (0..self.benches.len()).filter(|at| !self.dead.contains(at));
            let sent: Vec<Vec<u8>> =
                alive.flat_map(|at| self.benches[at].run(self.now, &frame)).collect();
            let sent = sent.concat();
            self.now += BYTE_TIME * sent.len() as u32;
            self.receive(&sent);
        }
    }

    fn receive(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            self.line.handle_bytes(&mut self.hosts, &mut bytes, self.now);
            self.take_events();
        }
    }

    fn take_events(&mut self) {
        while let Some(event) = self.line.poll_event(&mut self.hosts) {
            self.events.push(event);
        }
    }

    fn command(&mut self, at: usize, command: DeviceCommand<'_>) {
        self.hosts[at].handle_command(command).expect("it serves");
    }

    /// The longest time between two turns of a device.
    fn longest_gap(&self, device: usize) -> Duration {
        let turns: Vec<Duration> =
            self.turns.iter().filter(|(at, _)| *at == device).map(|(_, when)| *when).collect();
        turns.windows(2).map(|pair| pair[1] - pair[0]).max().expect("several turns")
    }
}

#[test]
fn thirty_two_devices_of_both_sides_serve_on_one_line() {
    let mut bus = Bus::new(1..=32, ms(200));
    bus.run(ms(3_000));
    assert!(bus.hosts.iter().all(Host::is_serving));

    bus.turns.clear();
    bus.events.clear();
    bus.run(ms(2_000));

    assert_eq!(bus.events, []);
    assert!(bus.hosts.iter().all(|host| host.out_of_turn() == 0));
    for device in 0..32 {
        // The others' slots may delay a ping by one round at most.
        assert!(bus.longest_gap(device) <= ms(200 + 117), "{:?}", bus.longest_gap(device));
    }
}

#[test]
fn a_dead_device_costs_the_others_no_more_than_its_slot_and_is_asked_less_often() {
    let mut bus = Bus::new(5..=8, ms(20));
    bus.run(ms(500));
    assert!(bus.hosts.iter().all(Host::is_serving));
    bus.dead.push(1);
    bus.turns.clear();

    bus.run(ms(2_000));

    assert_eq!(bus.events.last(), Some(&(1, HostEvent::Lost)));
    let slot = bus.hosts[0].config().slot();
    for device in [0, 2, 3] {
        assert!(bus.hosts[device].is_serving());
        assert!(bus.longest_gap(device) <= ms(20) + slot * 4, "{:?}", bus.longest_gap(device));
    }
    let asked = bus.turns.iter().filter(|(at, _)| *at == 1).count();
    assert!((10..=15).contains(&asked), "three times, then every 200 ms: {asked}");

    bus.dead.clear();
    bus.run(ms(500));
    assert!(bus.hosts[1].is_serving());
}

#[test]
fn commands_to_one_device_leave_the_others_their_turns() {
    let mut bus = Bus::new(5..=8, ms(20));
    bus.run(ms(500));
    bus.turns.clear();
    let mut done = 0;
    for _ in 0..100 {
        bus.events.clear();
        bus.command(0, DeviceCommand::Read(LIMIT));
        bus.run(ms(20));
        done += bus.events.iter().filter(|(at, _)| *at == 0).count();
    }
    assert_eq!(done, 100);
    for device in 1..4 {
        assert!(bus.longest_gap(device) <= ms(40), "{:?}", bus.longest_gap(device));
    }
}

#[test]
fn values_of_a_device_are_fetched_in_its_turn() {
    let mut bus = Bus::new(6..=7, ms(20));
    bus.run(ms(500));
    for at in 0..2 {
        bus.command(at, DeviceCommand::Change(1, LifecycleChange::Activate));
        bus.run(ms(30));
        bus.hosts[at].handle_publish(DRIVE).expect("it serves");
        bus.events.clear();

        bus.run(ms(60));

        let data = |(from, event): &(usize, HostEvent)| {
            *from == at && matches!(event, HostEvent::Data { .. })
        };
        assert_eq!(bus.events.iter().filter(|event| data(event)).count(), 1, "{:?}", bus.events);
    }
}

#[test]
fn packets_outside_of_a_turn_are_counted_and_dropped() {
    let mut bus = Bus::new(6..=7, ms(20));
    bus.run(ms(500));
    // A second PONG of the device whose turn has ended.
    let mut frame = [0; FRAME_MAX];
    let ping = blastema_lite::DevicePacket {
        address: Some(7),
        from_device: true,
        sequence: None,
        object: 0,
        message: 0,
        data: &[1, 1, 0, 0],
    };
    let mut bytes = [0; blastema_lite::PACKET_MAX];
    let frame = blastema_lite::cobs::encode(ping.encode(0, &mut bytes), &mut frame).to_vec();
    bus.receive(&frame);
    assert_eq!([bus.hosts[0].out_of_turn(), bus.hosts[1].out_of_turn()], [0, 1]);
    assert!(bus.hosts[1].is_serving());
}

#[test]
fn a_request_behind_values_waits_for_its_answer_longer_by_the_values() {
    let mut bus = Bus::new(6..=7, ms(20));
    bus.run(ms(500));
    bus.now += ms(20);
    bus.hosts.iter_mut().for_each(|host| host.handle_publish(DRIVE).expect("it serves"));
    let Bus { hosts, line, now, .. } = &mut bus;
    let mut poll = || {
        let mut frame = [0; FRAME_MAX];
        line.poll_frame(hosts, *now, |_, _, _| (), &mut frame).map(<[u8]>::len)
    };

    // The driver gives all frames to the line at once.
    let (mut before, mut last) = (0, poll().expect("a value"));
    while let Some(length) = poll() {
        before += std::mem::replace(&mut last, length);
    }

    assert!(before > 20, "two values, then a PING: {before}");
    let due = *now + BYTE_TIME * before as u32 + hosts[0].config().slot();
    assert!(line.poll_timeout(hosts) >= Some(due));
}
