use super::*;
use crate::message::{DESCRIBE, HELLO, LINK, LifecycleChange, PING, PING_PROBE, RESTART};
use core::iter;
use std::vec::Vec;

const PORTS: [Port; 3] =
    [Port::input(1, 0, 2, 10), Port::output(1, 0, 3, 11), Port::call(2, 0, 1, 4, 12)];

const CALL: DeviceCommand<'static> = DeviceCommand::Call(2, &[7]);

const INTERVAL: Duration = Duration::from_millis(10);
const TURNAROUND: Duration = Duration::from_millis(2);

/// A host whose device is played by the test.
struct Stage {
    host: Host<[Port; 3]>,
    now: Duration,
    /// The session of the last HELLO.
    session: u16,
    boot: u8,
    faults: u8,
}

/// What the host sends: sequence, object, message, first byte of data.
type Sent = (Option<u8>, u8, u8, Option<u8>);

impl Stage {
    fn new(tries: Tries) -> Stage {
        let config = HostConfig {
            address: None,
            device_type: 7,
            ports: PORTS,
            session: 0x00FE,
            interval: INTERVAL,
            tries,
            deadman: Duration::from_millis(500),
            byte_time: Duration::ZERO,
            turnaround: TURNAROUND,
        };
        let now = Duration::ZERO;
        Stage { host: Host::new(config, now), now, session: 0, boot: 1, faults: 0 }
    }

    fn serving() -> Stage {
        let mut stage = Stage::new(Tries::Fixed(3));
        stage.open(0);
        for (index, port) in PORTS.iter().enumerate() {
            assert_eq!(stage.sent(), Some((None, LINK, DESCRIBE, Some(index as u8))));
            stage.record(index as u8, *port);
        }
        stage.sent().expect("the end is asked for");
        stage.give(None, LINK, DESCRIBE, &[3, Status::End as u8]);
        assert!(matches!(stage.events()[..], [HostEvent::Serving]));
        stage
    }

    /// Answers the PING of a host that looks for its device, whose session is this, and HELLO.
    fn open(&mut self, present: u8) {
        let ping = self.sent();
        assert!(matches!(ping, Some((None, LINK, PING, Some(PING_PROBE..)))), "{ping:?}");
        self.pong_of(ping, 1, present);
        let hello = self.sent().expect("HELLO follows");
        assert_eq!((hello.1, hello.2), (LINK, HELLO));
        self.give(
            None,
            LINK,
            HELLO,
            &[low(self.session), self.boot, 0, 1, 7, 0, 0, 0, 24, 2, 1, 1],
        );
        assert!(matches!(self.events()[..], [HostEvent::Greeted(_), ..]));
    }

    fn sent(&mut self) -> Option<Sent> {
        let mut bytes = [0; PACKET_MAX];
        let packet = self.host.poll_packet(self.now, |_, value| value.fill(9), &mut bytes)?;
        let hello = DevicePacket::decode(packet, false, 0);
        if let Some(DevicePacket { message: HELLO, data: &[a, b, ..], .. }) = hello {
            self.session = u16::from_le_bytes([a, b]);
        }
        let packet = DevicePacket::decode(packet, false, self.session).expect("of the session");
        Some((packet.sequence, packet.object, packet.message, packet.data.first().copied()))
    }

    fn give(&mut self, sequence: Option<u8>, object: u8, message: u8, data: &[u8]) {
        let mut bytes = [0; PACKET_MAX];
        let packet =
            DevicePacket { address: None, from_device: true, sequence, object, message, data };
        self.host.handle_packet(packet.encode(self.session, &mut bytes), self.now);
    }

    fn record(&mut self, index: u8, port: Port) {
        let [f0, f1, f2, f3] = port.fingerprint().to_le_bytes();
        let record = [index, port.object(), port.id(), port.size(), f0, f1, f2, f3];
        self.give(None, LINK, DESCRIBE, &record);
    }

    fn pong_of(&mut self, ping: Option<Sent>, flags: u8, session: u8) {
        let Some((None, LINK, PING, Some(number))) = ping else { panic!("no PING: {ping:?}") };
        self.give(None, LINK, PING, &[number, self.boot, flags | self.faults << 4, session]);
    }

    fn pong(&mut self, ping: Option<Sent>) {
        self.pong_of(ping, 1, low(self.session));
    }

    /// Answers the next PING when it is due; returns its number.
    fn pong_after_pause(&mut self) -> u8 {
        self.now += INTERVAL;
        let ping = self.sent();
        self.pong(ping);
        ping.and_then(|ping| ping.3).expect("a PING was due")
    }

    /// Lets the time pass until the host acts.
    fn wait(&mut self) {
        self.now = self.now.max(self.host.poll_timeout());
        self.host.handle_timeout(self.now);
    }

    fn events(&mut self) -> Vec<HostEvent> {
        iter::from_fn(|| self.host.poll_event()).collect()
    }
}

#[test]
fn a_new_session_differs_from_the_devices_own_in_the_byte_that_a_pong_shows() {
    #[track_caller]
    fn check(present: u8, expected: u16) {
        let mut stage = Stage::new(Tries::Fixed(3));
        stage.open(present);
        assert_eq!(stage.session, expected);
    }
    check(0x00, 0x00FF);
    check(0xFF, 0x0100);
    let mut stage = Stage::new(Tries::Fixed(3));
    stage.host.session = 0xFFFF;
    stage.open(1);
    assert_eq!(stage.session, 2, "0 is no session");
}

#[test]
fn a_late_answer_to_describe_is_not_taken_for_the_next_record() {
    let mut stage = Stage::new(Tries::Fixed(3));
    stage.open(0);
    stage.sent();
    stage.record(0, PORTS[0]);
    stage.sent();
    stage.record(1, PORTS[1]);
    assert_eq!(stage.sent(), Some((None, LINK, DESCRIBE, Some(2))));

    stage.record(0, PORTS[0]);
    stage.give(None, LINK, DESCRIBE, &[3, Status::End as u8]);

    assert!(stage.host.is_waiting());
    stage.record(2, PORTS[2]);
    assert_eq!(stage.sent(), Some((None, LINK, DESCRIBE, Some(3))));
}

#[test]
fn a_late_answer_to_hello_opens_no_other_session() {
    let mut stage = Stage::serving();
    let before = low(stage.session);
    stage.host.handle_line_closed();
    stage.events();
    stage.now += INTERVAL;
    let ping = stage.sent();
    stage.pong_of(ping, 1, before);
    assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));

    stage.give(None, LINK, HELLO, &[before, 1, 0, 1, 7, 0, 0, 0, 24, 2, 1, 1]);

    assert_eq!(stage.events(), []);
    assert!(stage.host.is_waiting());
}

#[test]
fn a_chip_without_a_port_table_is_known_by_its_type() {
    let mut stage = Stage::new(Tries::Fixed(3));
    stage.open(0);
    stage.sent();
    stage.give(None, LINK, DESCRIBE, &[0, Status::End as u8]);
    assert_eq!(stage.events(), [HostEvent::Serving]);
}

#[test]
fn a_reply_counts_only_with_its_sequence_names_and_length() {
    let mut stage = Stage::serving();
    stage.host.handle_command(CALL).expect("it serves");
    assert_eq!(stage.sent(), Some((Some(1), 2, 0x80, Some(7))));
    let well = [0, 1, 2, 3, 4];
    stage.give(Some(0), 2, 0x80, &well);
    stage.give(Some(1), 1, 0x80, &well);
    stage.give(Some(1), 2, 0x81, &well);
    stage.give(None, 2, 0x80, &well);
    stage.give(Some(1), 2, 0x80, &well[..4]);
    stage.give(Some(1), 2, 0x80, &[4, 1]);
    stage.give(Some(1), 2, 0x80, &[99]);
    stage.give(Some(1), 2, 0x80, &[]);
    assert_eq!(stage.events(), []);

    stage.give(Some(1), 2, 0x80, &well);

    assert_eq!(stage.events(), [HostEvent::Done(CommandOutcome::Replied(Status::Well))]);
    assert_eq!(stage.host.payload(), &well[1..]);
    stage.give(Some(1), 2, 0x80, &well);
    assert_eq!(stage.events(), [], "a repeated reply");
}

#[test]
fn a_reply_that_comes_after_its_time_is_taken_all_the_same() {
    let mut stage = Stage::serving();
    stage.host.handle_command(CALL).expect("it serves");
    stage.sent();
    stage.wait();
    stage.give(Some(1), 2, 0x80, &[0; 5]);
    assert_eq!(stage.events(), [HostEvent::Done(CommandOutcome::Replied(Status::Well))]);
    stage.host.handle_command(CALL).expect("the next one");
    assert_eq!(stage.sent(), Some((Some(2), 2, 0x80, Some(7))));
}

#[test]
fn out_of_step_ends_the_command_as_unknown_and_opens_a_new_session() {
    let mut stage = Stage::serving();
    let before = stage.session;
    stage.host.handle_command(CALL).expect("it serves");
    stage.sent();
    stage.give(Some(1), 2, 0x80, &[Status::OutOfStep as u8]);
    let unknown = HostEvent::Done(CommandOutcome::Unknown);
    assert_eq!(stage.events(), [HostEvent::OutOfStep, unknown]);
    assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));
    assert_ne!(stage.session, before);
    stage.give(None, LINK, HELLO, &[low(stage.session), 1, 0, 1, 7, 0, 0, 0, 24, 2, 1, 1]);
    assert!(stage.host.is_serving(), "the contract was compared before");
    stage.host.handle_command(CALL).expect("it serves");
    assert_eq!(stage.sent().and_then(|sent| sent.0), Some(1), "sequences begin again");
}

#[test]
fn two_unanswered_commands_are_followed_by_a_ping() {
    let mut stage = Stage::serving();
    stage.pong_after_pause();
    stage.host.handle_command(CALL).expect("it serves");
    let mut messages = Vec::new();
    for _ in 0..6 {
        let sent = stage.sent().expect("something is asked");
        messages.push(sent.2);
        stage.wait();
    }
    assert_eq!(messages, [0x80, 0x80, PING, 0x80, 0x80, PING]);
}

#[test]
fn a_command_that_a_device_never_answers_although_it_answers_pings_is_abandoned() {
    let mut stage = Stage::serving();
    stage.host.handle_command(CALL).expect("it serves");
    let mut sent_in_vain = 0;
    while stage.host.is_serving() {
        match stage.sent() {
            ping @ Some((None, LINK, PING, _)) => stage.pong(ping),
            Some(_) => {
                sent_in_vain += 1;
                stage.wait();
            }
            None => stage.wait(),
        }
    }
    assert_eq!(sent_in_vain, 12, "four times the tries");
    assert_eq!(stage.events(), [HostEvent::Done(CommandOutcome::Unknown)]);
    assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));
}

#[test]
fn a_busy_line_is_pinged_every_ten_intervals() {
    let mut stage = Stage::serving();
    stage.pong_after_pause();
    let (mut pings, end) = (0, stage.now + INTERVAL * 100);
    while stage.now < end {
        stage.now += INTERVAL / 4;
        // A driver that always has a next command.
        let _ = stage.host.handle_command(CALL);
        match stage.sent() {
            ping @ Some((None, LINK, PING, _)) => {
                pings += 1;
                stage.pong(ping);
            }
            Some((sequence, object, message, _)) => {
                stage.give(sequence, object, message, &[0; 5]);
            }
            None => panic!("the line is free"),
        }
        stage.events();
    }
    assert!((9..=10).contains(&pings), "{pings}");
}

#[test]
fn a_pong_with_another_number_is_no_answer() {
    let mut stage = Stage::serving();
    stage.wait();
    let Some((None, LINK, PING, Some(number))) = stage.sent() else { panic!("a PING is due") };
    let stale = number.wrapping_sub(1);
    stage.pong(Some((None, LINK, PING, Some(stale))));
    assert!(stage.host.is_waiting());
    stage.pong(Some((None, LINK, PING, Some(number))));
    assert!(!stage.host.is_waiting());
}

#[test]
fn only_pings_of_a_host_that_serves_the_device_restart_its_dead_man() {
    let mut stage = Stage::serving();
    let number = stage.pong_after_pause();
    assert!(number < PING_PROBE);
    stage.now += INTERVAL;
    while !stage.host.is_lost() {
        stage.sent();
        stage.wait();
    }
    stage.wait();
    let Some((None, LINK, PING, Some(number))) = stage.sent() else { panic!("a PING is due") };
    assert!(number >= PING_PROBE);
}

#[test]
fn a_value_from_before_an_interruption_is_not_sent_after_it() {
    let mut stage = Stage::serving();
    stage.host.handle_publish(0).expect("it serves");
    stage.host.handle_line_closed();
    stage.events();
    stage.now += INTERVAL;
    stage.open(low(stage.session));
    assert!(stage.host.is_serving());
    assert_eq!(stage.sent(), None);
}

#[test]
fn the_newest_value_is_sent_while_a_request_waits() {
    let mut stage = Stage::serving();
    stage.host.handle_command(CALL).expect("it serves");
    stage.sent();
    stage.host.handle_publish(0).expect("it serves");
    stage.host.handle_publish(0).expect("it serves");
    assert_eq!(stage.sent(), Some((None, 1, 0x40, Some(9))));
    assert_eq!(stage.sent(), None);
}

#[test]
fn values_and_states_that_do_not_fit_are_dropped() {
    let mut stage = Stage::serving();
    stage.give(None, 1, 0x60, &[1, 2]);
    stage.give(None, 1, 0x61, &[1, 2, 3]);
    stage.give(None, 1, 0x40, &[1, 2]);
    stage.give(None, 1, message::STATE, &[9, 1]);
    stage.give(None, 0, message::STATE, &[3, 1]);
    stage.give(None, 1, message::STATE, &[3]);
    assert_eq!(stage.events(), []);

    stage.give(None, 1, 0x60, &[1, 2, 3]);

    assert_eq!(stage.events(), [HostEvent::Data { port: 1 }]);
    assert_eq!(stage.host.payload(), [1, 2, 3]);
}

#[test]
fn a_fault_that_was_reported_costs_no_new_session_and_one_that_was_lost_does() {
    let mut stage = Stage::serving();
    stage.faults = 1;
    stage.give(None, 1, message::STATE, &[3, 9]);
    let state = DeviceState::Error;
    assert_eq!(stage.events(), [HostEvent::State { object: 1, state, code: 9 }]);
    stage.pong_after_pause();
    assert!(stage.host.is_serving());

    stage.faults = 2;
    stage.pong_after_pause();

    assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));
}

#[test]
fn a_restart_is_ordered_once_until_a_pong_shows_that_it_was_lost() {
    let mut stage = Stage::serving();
    stage
        .host
        .handle_command(DeviceCommand::Change(1, LifecycleChange::Activate))
        .expect("serving");
    stage.sent();
    stage.give(Some(1), 1, 0x10, &[0, 2]);
    stage.events();
    stage.host.handle_restart();
    assert_eq!(stage.sent(), Some((None, LINK, RESTART, Some(7))));
    stage.wait();
    let ping = loop {
        match stage.sent() {
            Some(ping) => break Some(ping),
            None => stage.wait(),
        }
    };
    stage.pong(ping);
    assert_eq!(stage.sent(), Some((None, LINK, RESTART, Some(7))));
    stage.wait();

    stage.wait();
    let ping = stage.sent();
    stage.boot = 2;
    stage.pong_of(ping, 0, 0);

    assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));
}

#[test]
fn a_refused_device_gets_no_data_through_and_is_stopped_by_its_dead_man() {
    let mut stage = Stage::new(Tries::Fixed(3));
    stage.open(0);
    stage.sent();
    stage.record(0, Port::output(1, 0, 3, 99));
    assert!(matches!(stage.events()[..], [HostEvent::Refused(Mismatch::Port(1, _))]));

    stage.give(None, 1, 0x60, &[1, 2, 3]);
    stage.now += INTERVAL;
    let ping = stage.sent();
    stage.pong_of(ping, 1 | message::FLAG_WAITING, low(stage.session));
    stage.now += INTERVAL;

    assert_eq!(stage.events(), []);
    let next = stage.sent();
    assert!(matches!(next, Some((None, LINK, PING, Some(PING_PROBE..)))), "{next:?}");
}

#[test]
fn a_device_that_answers_pings_alone_is_lost_once() {
    let mut stage = Stage::new(Tries::Fixed(3));
    let mut lost = 0;
    for _ in 0..200 {
        match stage.sent() {
            ping @ Some((None, LINK, PING, _)) => stage.pong_of(ping, 0, 0),
            _ => stage.wait(),
        }
        lost += stage.events().iter().filter(|event| **event == HostEvent::Lost).count();
    }
    assert_eq!((lost, stage.host.is_lost()), (1, true));
}

#[test]
fn an_order_to_restart_outlives_a_new_session_but_no_reset() {
    for reset in [false, true] {
        let mut stage = Stage::serving();
        stage.now += INTERVAL;
        let ping = stage.sent();
        stage.host.handle_restart();
        stage.faults = 1;
        stage.boot += u8::from(reset);
        stage.pong(ping);
        assert_eq!(stage.sent().map(|sent| sent.2), Some(HELLO));

        let hello = [low(stage.session), stage.boot, 0, 1, 7, 0, 0, 0, 24, 2, 1, 1];
        stage.give(None, LINK, HELLO, &hello);

        let expected = if reset { DESCRIBE } else { RESTART };
        assert_eq!(stage.sent().map(|sent| sent.2), Some(expected));
        assert_eq!(stage.host.restart == RestartOrder::None, reset);
    }
}

#[test]
fn a_device_with_more_objects_than_have_ports_gets_the_time_to_list_them() {
    let mut stage = Stage::new(Tries::Fixed(3));
    stage.host.config.byte_time = Duration::from_millis(1);
    let mut longest = Duration::ZERO;
    for _ in 0..20 {
        match stage.sent() {
            ping @ Some((None, LINK, PING, _)) => stage.pong_of(ping, 0, 0),
            Some(_) => longest = longest.max(stage.host.poll_timeout() - stage.now),
            None => stage.wait(),
        }
        stage.events();
    }
    let reply = 10 + OBJECTS_MAX;
    assert_eq!(longest, stage.host.config.exchange_time(4, reply));
}
