//! A host machine and a device under test, with a channel between them, in virtual time.

use crate::bench::{Bench, DEVICE_TYPE, JOURNAL, Journal, MEDIA, Medium, PORTS, RustSide};
use crate::c_side::CSide;
use crate::channel::Channel;
use blastema_lite::{
    CommandOutcome, DeviceCommand, FRAME_MAX, Host, HostConfig, HostEvent, HostLine, PACKET_MAX,
    Port, ResetCause, Status, Tries,
};
use std::time::Duration;

pub(crate) type TestHost = Host<Vec<Port>>;

pub(crate) struct Robot {
    pub(crate) bench: Box<dyn Bench>,
    pub(crate) medium: Medium,
    pub(crate) host: TestHost,
    line: HostLine,
    pub(crate) out: Channel,
    pub(crate) back: Channel,
    pub(crate) now: Duration,
    /// Events, with the payload of those that have one.
    pub(crate) events: Vec<(HostEvent, Vec<u8>)>,
    /// The newest values of in ports.
    pub(crate) values: Vec<Vec<u8>>,
    pub(crate) frames_sent: usize,
}

pub(crate) fn config(medium: Medium) -> HostConfig<Vec<Port>> {
    HostConfig {
        address: medium.address(),
        device_type: DEVICE_TYPE,
        ports: PORTS.to_vec(),
        session: 0x1233,
        interval: ms(10),
        tries: Tries::Fixed(3),
        deadman: ms(500),
        byte_time: Duration::ZERO,
        turnaround: ms(2),
    }
}

pub(crate) fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Each side on each medium, before the first packet.
pub(crate) fn all() -> impl Iterator<Item = Robot> {
    MEDIA.into_iter().flat_map(|medium| {
        let sides: [Box<dyn Bench>; 2] =
            [Box::new(RustSide::new(medium)), Box::new(CSide::new(medium))];
        sides.into_iter().map(move |bench| Robot::new(bench, medium, config(medium)))
    })
}

/// Each side on each medium, serving.
pub(crate) fn all_serving() -> impl Iterator<Item = Robot> {
    all().map(|mut robot| {
        robot.advance(1);
        assert!(robot.host.is_serving(), "{:?}", robot.events);
        robot.events.clear();
        robot
    })
}

impl Robot {
    pub(crate) fn new(
        bench: Box<dyn Bench>,
        medium: Medium,
        config: HostConfig<Vec<Port>>,
    ) -> Robot {
        let values = config.ports.iter().map(|port| vec![0; port.size().into()]).collect();
        Robot {
            bench,
            medium,
            host: Host::new(config, Duration::ZERO),
            line: HostLine::default(),
            out: Channel::perfect(),
            back: Channel::perfect(),
            now: Duration::ZERO,
            events: Vec::new(),
            values,
            frames_sent: 0,
        }
    }

    /// A new host in place of the old one, as after a restart of the proxy or its node.
    pub(crate) fn restart_host(&mut self, config: HostConfig<Vec<Port>>) {
        self.host = Host::new(config, self.now);
        self.line = HostLine::default();
        self.events.clear();
    }

    /// Lets time pass, millisecond by millisecond.
    pub(crate) fn advance(&mut self, duration_ms: u64) {
        self.pump();
        for _ in 0..duration_ms {
            self.now += ms(1);
            self.tick();
        }
    }

    /// Lets the device and the host act on what is due now.
    pub(crate) fn tick(&mut self) {
        let sent = self.bench.run(self.now, &[]);
        self.deliver(sent);
        self.host.handle_timeout(self.now);
        self.take_events();
        self.pump();
    }

    /// Sends what the host has to send, and delivers the answers, until it waits.
    pub(crate) fn pump(&mut self) {
        while let Some(frame) = self.poll_frame() {
            self.frames_sent += 1;
            for copy in self.out.carry(&frame) {
                let sent = self.bench.run(self.now, &copy);
                self.deliver(sent);
            }
        }
    }

    fn poll_frame(&mut self) -> Option<Vec<u8>> {
        let values = |port: usize, value: &mut [u8]| value.copy_from_slice(&self.values[port]);
        if self.medium == Medium::Datagram {
            let mut packet = [0; PACKET_MAX];
            return Some(self.host.poll_packet(self.now, values, &mut packet)?.to_vec());
        }
        let mut frame = [0; FRAME_MAX];
        let hosts = std::slice::from_mut(&mut self.host);
        let values = |_, port: usize, value: &mut [u8]| values(port, value);
        Some(self.line.poll_frame(hosts, self.now, values, &mut frame)?.to_vec())
    }

    /// Brings what the device has sent to the host: datagram by datagram, or frame by frame.
    fn deliver(&mut self, sent: Vec<Vec<u8>>) {
        let frames: Vec<Vec<u8>> = if self.medium == Medium::Datagram {
            sent
        } else {
            sent.concat().split_inclusive(|byte| *byte == 0).map(<[u8]>::to_vec).collect()
        };
        for frame in frames {
            for copy in self.back.carry(&frame) {
                if self.medium == Medium::Datagram {
                    self.host.handle_packet(&copy, self.now);
                    self.take_events();
                    continue;
                }
                let mut rest = &copy[..];
                while !rest.is_empty() {
                    let hosts = std::slice::from_mut(&mut self.host);
                    self.line.handle_bytes(hosts, &mut rest, self.now);
                    self.take_events();
                }
            }
        }
    }

    fn take_events(&mut self) {
        while let Some(event) = self.host.poll_event() {
            let has_payload = matches!(event, HostEvent::Data { .. } | HostEvent::Done(_));
            let payload = if has_payload { self.host.payload().to_vec() } else { Vec::new() };
            self.events.push((event, payload));
        }
    }

    /// Whether this has happened since the last call; forgets what happened before it.
    #[track_caller]
    pub(crate) fn expect(&mut self, event: HostEvent) -> Vec<u8> {
        let at = self.events.iter().position(|(found, _)| *found == event);
        let at = at.unwrap_or_else(|| panic!("no {event:?} in {:?}", self.events));
        self.events.drain(..=at).next_back().expect("the event itself").1
    }

    /// Boot count, cause, reset and dead-man of the first greeting.
    #[track_caller]
    pub(crate) fn greeted(&self) -> (u16, ResetCause, bool, bool) {
        let greeted = self.events.iter().find_map(|(event, _)| match event {
            HostEvent::Greeted(found) => {
                Some((found.boot, found.cause, found.reset, found.deadman))
            }
            _ => None,
        });
        greeted.expect("the device was greeted")
    }

    /// Carries a command out and returns its outcome and payload; other events are kept.
    #[track_caller]
    pub(crate) fn command(&mut self, command: DeviceCommand<'_>) -> (CommandOutcome, Vec<u8>) {
        self.host.handle_command(command).expect("the device serves and no command is outstanding");
        self.pump();
        // 4 * 3 tries of 2 ms, and pings between them.
        for _ in 0..100 {
            let done = |(event, _): &_| matches!(event, HostEvent::Done(_));
            if let Some(at) = self.events.iter().position(done) {
                let (HostEvent::Done(outcome), payload) = self.events.remove(at) else { continue };
                return (outcome, payload);
            }
            self.advance(1);
        }
        panic!("the command does not end: {:?}", self.events);
    }

    /// Carries a command out that must succeed; returns its payload.
    #[track_caller]
    pub(crate) fn well(&mut self, command: DeviceCommand<'_>) -> Vec<u8> {
        let (outcome, payload) = self.command(command);
        assert_eq!(outcome, CommandOutcome::Replied(Status::Well));
        payload
    }

    pub(crate) fn journal(&mut self) -> Journal {
        Journal::from_bytes(&self.well(DeviceCommand::Read(JOURNAL)))
    }
}
