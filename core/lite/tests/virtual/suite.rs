//! What every device side must do, on every medium.

use crate::bench::{
    COUNT, DEVICE_TYPE, DRIVE, DRIVEN, FAILING, LIMIT, Medium, NUMBER, PORTS, RustSide, STEER,
};
use crate::c_side::CSide;
use crate::channel::Random;
use crate::robot::{Robot, all, all_serving, config, ms};
use blastema_lite::{
    CommandError, CommandOutcome, DeviceCommand, DeviceIdentity, DeviceState, HostConfig,
    HostEvent, LifecycleChange, Mismatch, Port, ResetCause, Status, message,
};

const ACTIVATE: DeviceCommand<'static> = DeviceCommand::Change(1, LifecycleChange::Activate);
const DEACTIVATE: DeviceCommand<'static> = DeviceCommand::Change(1, LifecycleChange::Deactivate);
const RESET: DeviceCommand<'static> = DeviceCommand::Change(1, LifecycleChange::Reset);
const FINALIZE: DeviceCommand<'static> = DeviceCommand::Change(1, LifecycleChange::Finalize);

fn replied(status: Status) -> CommandOutcome {
    CommandOutcome::Replied(status)
}

/// A value of the drive: a force, and a level that needs all bits of a double.
fn drive(force: i16) -> Vec<u8> {
    [&force.to_le_bytes()[..], &std::f64::consts::PI.to_le_bytes()].concat()
}

fn error(object: u8, code: u8) -> HostEvent {
    HostEvent::State { object, state: DeviceState::Error, code }
}

#[test]
fn a_device_is_found_greeted_and_described() {
    for mut robot in all() {
        robot.advance(1);

        let (HostEvent::Greeted(identity), _) = robot.events[0] else { panic!("greeted first") };
        let expected = DeviceIdentity {
            boot: 1,
            cause: ResetCause::PowerOn,
            device_type: DEVICE_TYPE,
            data_max: identity.data_max,
            objects: 2,
            reset: false,
            deadman: false,
        };
        assert_eq!(identity, expected);
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Inactive));
        assert_eq!(robot.host.state(2), Some(DeviceState::Inactive));
        assert_eq!(robot.host.state(3), None);
        // PING, HELLO, a DESCRIBE for each port and for the end.
        assert_eq!(robot.frames_sent, 2 + PORTS.len() + 1);
    }
}

#[test]
fn the_life_cycle_follows_the_orders_and_refuses_wrong_ones() {
    for mut robot in all_serving() {
        let mut check = |command, status, state| {
            let (outcome, payload) = robot.command(command);
            assert_eq!((outcome, &payload[..]), (replied(status), &[state as u8][..]));
            assert_eq!(robot.host.state(1), Some(state));
        };
        check(DEACTIVATE, Status::WrongState, DeviceState::Inactive);
        check(ACTIVATE, Status::Well, DeviceState::Active);
        check(ACTIVATE, Status::WrongState, DeviceState::Active);
        check(FINALIZE, Status::WrongState, DeviceState::Active);
        check(DEACTIVATE, Status::Well, DeviceState::Inactive);
        check(RESET, Status::WrongState, DeviceState::Inactive);
        check(FINALIZE, Status::Well, DeviceState::Finalized);
        check(ACTIVATE, Status::WrongState, DeviceState::Finalized);
        let no_such = DeviceCommand::Change(9, LifecycleChange::Activate);
        assert_eq!(robot.command(no_such), (replied(Status::NoSuch), vec![]));
    }
}

#[test]
fn a_value_goes_through_the_device_unaltered_also_a_double() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        for force in 1..=5 {
            robot.values[DRIVE] = drive(force);
            robot.host.handle_publish(DRIVE).expect("it serves");
            robot.advance(25);
            assert_eq!(robot.expect(HostEvent::Data { port: DRIVEN }), drive(force));
        }
    }
}

#[test]
fn values_and_variables_are_written_and_read_as_commands() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        assert_eq!(robot.well(DeviceCommand::Write(DRIVE, &drive(3))), []);
        robot.advance(11);
        assert_eq!(robot.well(DeviceCommand::Read(DRIVEN)), drive(3));
        assert_eq!(robot.well(DeviceCommand::Read(LIMIT)), [0, 0]);
        assert_eq!(robot.well(DeviceCommand::Write(LIMIT, &[0x34, 0x12])), []);
        assert_eq!(robot.well(DeviceCommand::Read(LIMIT)), [0x34, 0x12]);
    }
}

#[test]
fn operations_answer_with_results_of_another_size_and_may_fail() {
    for mut robot in all_serving() {
        assert_eq!(
            robot.well(DeviceCommand::Call(NUMBER, &[1, 0, 0, 0])),
            [1, 0, 0, 0, 1, 0, 0, 0]
        );
        assert_eq!(
            robot.well(DeviceCommand::Call(NUMBER, &[2, 0, 0, 0])),
            [2, 0, 0, 0, 2, 0, 0, 0]
        );
        let failed = robot.command(DeviceCommand::Call(FAILING, &[]));
        assert_eq!(failed, (replied(Status::HookFailed), vec![]));
    }
}

#[test]
fn commands_that_do_not_fit_their_port_are_not_accepted() {
    for mut robot in all_serving() {
        let mut check = |command, error| assert_eq!(robot.host.handle_command(command), Err(error));
        check(DeviceCommand::Write(DRIVE, &[1]), CommandError::WrongLength);
        check(DeviceCommand::Write(DRIVEN, &[0; 10]), CommandError::NoSuchPort);
        check(DeviceCommand::Read(NUMBER), CommandError::NoSuchPort);
        check(DeviceCommand::Call(99, &[]), CommandError::NoSuchPort);
        assert_eq!(robot.host.handle_publish(DRIVEN), Err(CommandError::NoSuchPort));
        robot.host.handle_command(ACTIVATE).expect("it fits");
        assert_eq!(robot.host.handle_command(ACTIVATE), Err(CommandError::Busy));
    }
}

#[test]
fn a_fault_of_the_firmware_is_reported_with_its_code_and_text() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.well(DeviceCommand::Write(DRIVE, &drive(666)));
        robot.advance(60);
        // A reported fault costs no new session, also where it waits for a POLL.
        assert_eq!(robot.events, [(error(1, 7), vec![])]);
        assert_eq!(robot.well(DeviceCommand::Text(1, 7)), b"over travel");
        assert_eq!(robot.well(DeviceCommand::Text(1, 8)), b"");
        assert_eq!(robot.journal().aborted, 7);
        robot.well(RESET);
        robot.well(ACTIVATE);
        assert_eq!(robot.host.state(1), Some(DeviceState::Active));
    }
}

#[test]
fn hooks_that_fail_lead_to_error() {
    for mut robot in all_serving() {
        robot.well(DeviceCommand::Write(LIMIT, &666u16.to_le_bytes()));
        let failed = (replied(Status::HookFailed), vec![DeviceState::Error as u8]);
        assert_eq!(robot.command(ACTIVATE), failed);
        robot.advance(25);
        robot.expect(error(1, 9));
        robot.well(DeviceCommand::Write(LIMIT, &667u16.to_le_bytes()));
        assert_eq!(robot.command(RESET), failed);
        robot.advance(25);
        robot.expect(error(1, 8));
    }
}

#[test]
fn a_failed_initialization_finalizes_the_object_alone() {
    for mut robot in all_serving() {
        robot.bench.reset(robot.now, ResetCause::FaultHandler);
        robot.advance(30);
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Inactive));
        assert_eq!(robot.host.state(2), Some(DeviceState::Finalized));
    }
}

#[test]
fn the_context_stops_starts_and_changes_its_period() {
    for mut robot in all_serving() {
        // The in port of object 2 has a deadline, so it is written all the time.
        let executions = |robot: &mut Robot, duration_ms: u64| {
            let before = robot.well(DeviceCommand::Read(COUNT))[0];
            for _ in 0..duration_ms / 20 {
                robot.host.handle_publish(STEER).expect("it serves");
                robot.advance(20);
            }
            robot.well(DeviceCommand::Read(COUNT))[0] - before
        };
        robot.well(DeviceCommand::Change(2, LifecycleChange::Activate));
        assert_eq!(executions(&mut robot, 200), 20);
        robot.well(DeviceCommand::Rate(2, 40));
        assert_eq!(executions(&mut robot, 400), 10);
        robot.well(DeviceCommand::Stop(2));
        assert_eq!(executions(&mut robot, 200), 0);
        robot.well(DeviceCommand::Start(2));
        assert_eq!(executions(&mut robot, 400), 10);
    }
}

#[test]
fn the_longest_period_is_kept_by_a_chip_whose_clock_wraps_in_it() {
    for mut robot in all_serving().take(2) {
        robot.well(DeviceCommand::Change(2, LifecycleChange::Activate));
        // It is limited to 60 s.
        robot.well(DeviceCommand::Rate(2, u16::MAX));
        let before = robot.well(DeviceCommand::Read(COUNT))[0];
        let end = robot.now + ms(61_000);
        while robot.now < end {
            robot.host.handle_publish(STEER).expect("it serves");
            robot.now += ms(7);
            robot.tick();
        }
        assert_eq!(robot.well(DeviceCommand::Read(COUNT))[0] - before, 1);
    }
}

#[test]
fn an_input_that_is_too_old_is_a_fault_of_its_object_alone() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.advance(200);
        robot.well(DeviceCommand::Change(2, LifecycleChange::Activate));
        for _ in 0..5 {
            robot.host.handle_publish(STEER).expect("it serves");
            robot.advance(40);
        }
        assert_eq!(robot.host.state(2), Some(DeviceState::Active));

        robot.advance(40);

        robot.expect(error(2, message::CODE_INPUT_TOO_OLD));
        assert_eq!(robot.host.state(1), Some(DeviceState::Active));
    }
}

#[test]
fn a_silent_host_makes_the_device_safe_and_learns_of_it() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        // A lost device of a multi-drop line is asked in every tenth round, so after up to 100 ms.
        robot.out.loss = 1.0;
        robot.advance(380);
        robot.out.loss = 0.0;
        robot.advance(110);
        assert_eq!(robot.greeted(), (1, ResetCause::PowerOn, false, false));
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Active));

        robot.out.loss = 1.0;
        robot.advance(520);
        robot.out.loss = 0.0;
        robot.advance(110);

        assert_eq!(robot.greeted(), (1, ResetCause::PowerOn, false, true));
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Error));
        assert_eq!(robot.journal().aborted, message::CODE_DEADMAN);
    }
}

#[test]
fn a_device_whose_answers_do_not_arrive_becomes_safe_although_it_is_asked() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.back.loss = 1.0;
        robot.advance(560);
        robot.back.loss = 0.0;
        robot.advance(110);

        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Error));
        assert_eq!(robot.journal().aborted, message::CODE_DEADMAN);
    }
}

#[test]
fn silence_is_noticed_within_the_bound_and_ends_the_command() {
    for mut robot in all_serving() {
        robot.out.loss = 1.0;
        robot.host.handle_command(ACTIVATE).expect("it serves");
        let start = robot.now;
        for _ in 0..1_000 {
            if !robot.host.is_lost() {
                robot.advance(1);
            }
        }

        // (n + 1) * max(interval, reply time)
        assert!(robot.now - start <= ms(40), "{:?}", robot.now - start);
        robot.expect(HostEvent::Lost);
        robot.expect(HostEvent::Done(CommandOutcome::Unknown));
        assert_eq!(robot.host.handle_command(ACTIVATE), Err(CommandError::NotServing));
        assert_eq!(robot.host.handle_publish(DRIVE), Err(CommandError::NotServing));
        robot.advance(500);
        assert!(robot.events.is_empty(), "lost is reported once: {:?}", robot.events);
    }
}

#[test]
fn more_values_than_the_line_carries_do_not_delay_the_detection_of_silence() {
    // A line that is faster than its byte time says, or a driver that buffers without a bound.
    let config = HostConfig { byte_time: ms(1), ..config(Medium::Serial) };
    let mut robot = Robot::new(Box::new(RustSide::new(Medium::Serial)), Medium::Serial, config);
    robot.advance(1);
    let publish = |robot: &mut Robot| {
        let _ = robot.host.handle_publish(DRIVE);
        robot.advance(1);
    };
    (0..1_000).for_each(|_| publish(&mut robot));
    assert!(robot.host.is_serving());

    robot.out.loss = 1.0;
    (0..300).for_each(|_| publish(&mut robot));

    robot.expect(HostEvent::Lost);
}

#[test]
fn a_closed_line_is_noticed_at_once_and_a_command_that_was_not_sent_is_known_as_such() {
    for mut robot in all_serving() {
        robot.host.handle_command(ACTIVATE).expect("it serves");
        robot.host.handle_line_closed();
        robot.advance(20);
        robot.expect(HostEvent::Lost);
        robot.expect(HostEvent::Done(CommandOutcome::NotSent));
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Inactive));
    }
}

#[test]
fn a_host_that_restarts_is_in_step_at_once_and_the_device_is_neither_reset_nor_does_anything_twice()
{
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        for number in 1..=11u32 {
            robot.well(DeviceCommand::Call(NUMBER, &number.to_le_bytes()));
        }
        // The new host may begin with any session, also with the present one or its successor.
        let mut number = 11u32;
        for session in [0x1233, 0x1234, 0x1234, 0, 0xFFFF, 0x77] {
            let frames = robot.frames_sent;
            robot.restart_host(HostConfig { session, ..config(robot.medium) });

            robot.advance(1);

            assert_eq!(robot.greeted(), (1, ResetCause::PowerOn, false, false));
            robot.expect(HostEvent::Serving);
            assert_eq!(robot.frames_sent - frames, 2 + PORTS.len() + 1);
            assert_eq!(robot.host.state(1), Some(DeviceState::Active));
            number += 1;
            robot.well(DeviceCommand::Call(NUMBER, &number.to_le_bytes()));
            let journal = robot.journal();
            assert_eq!((journal.executed, journal.twice, journal.wrong), (number, 0, 0));
        }
    }
}

#[test]
fn after_a_reset_the_outstanding_command_is_unknown_and_never_repeated() {
    for mut robot in all_serving() {
        robot.well(DeviceCommand::Call(NUMBER, &1u32.to_le_bytes()));
        // The device carries it out, its reply is lost, and it is reset.
        robot.back.loss = 1.0;
        robot
            .host
            .handle_command(DeviceCommand::Call(NUMBER, &2u32.to_le_bytes()))
            .expect("it serves");
        robot.pump();
        robot.bench.reset(robot.now, ResetCause::Watchdog);
        robot.back.loss = 0.0;

        robot.advance(20);

        robot.expect(HostEvent::Done(CommandOutcome::Unknown));
        assert_eq!(robot.greeted(), (2, ResetCause::Watchdog, true, false));
        robot.expect(HostEvent::Serving);
        let journal = robot.journal();
        assert_eq!((journal.executed, journal.twice, journal.wrong), (2, 0, 0));
    }
}

#[test]
fn an_idle_device_that_was_reset_is_a_new_incarnation() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.bench.reset(robot.now, ResetCause::BrownOut);
        robot.advance(20);
        assert_eq!(robot.greeted(), (2, ResetCause::BrownOut, true, false));
        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Inactive));
    }
}

#[test]
fn the_order_to_restart_resets_the_chip_once_also_when_it_or_its_reply_is_lost() {
    for (out, back) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)] {
        for mut robot in all_serving() {
            robot.host.handle_restart();
            (robot.out.loss, robot.back.loss) = (out, back);
            robot.pump();
            (robot.out.loss, robot.back.loss) = (0.0, 0.0);
            robot.advance(40);
            assert_eq!(robot.greeted(), (2, ResetCause::Software, true, false));
            robot.expect(HostEvent::Serving);
        }
    }
}

#[test]
fn a_wrong_type_or_contract_is_refused_and_gets_no_data() {
    type Change = fn(&mut Vec<Port>) -> u32;
    let cases: [(Change, Mismatch); 4] = [
        (|_| 5, Mismatch::Type(DEVICE_TYPE)),
        (
            |ports| {
                ports[1] = Port::output(1, 0, 10, 0xdead_beef);
                DEVICE_TYPE
            },
            Mismatch::Port(1, PORTS[1]),
        ),
        (
            |ports| {
                ports[0] = Port::input(1, 0, 6, 0x1234_abcd);
                DEVICE_TYPE
            },
            Mismatch::Port(0, PORTS[0]),
        ),
        (
            |ports| {
                ports.push(Port::input(1, 9, 6, 0));
                DEVICE_TYPE
            },
            Mismatch::Missing(8),
        ),
    ];
    for (change, mismatch) in cases {
        for mut robot in all() {
            let mut config = config(robot.medium);
            config.device_type = change(&mut config.ports);
            robot = Robot::new(robot.bench, robot.medium, config);
            robot.advance(100);
            robot.expect(HostEvent::Refused(mismatch));
            assert!(robot.events.is_empty(), "refused once: {:?}", robot.events);
            assert_eq!(robot.host.handle_command(ACTIVATE), Err(CommandError::NotServing));
        }
    }
}

#[test]
fn a_refused_device_that_is_active_is_stopped_by_its_dead_man() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.restart_host(HostConfig { device_type: 5, ..config(robot.medium) });
        robot.advance(600);
        robot.expect(HostEvent::Refused(Mismatch::Type(DEVICE_TYPE)));

        robot.restart_host(config(robot.medium));
        robot.advance(1);

        robot.expect(HostEvent::Serving);
        assert_eq!(robot.host.state(1), Some(DeviceState::Error));
    }
}

#[test]
fn a_lost_state_event_is_found_by_the_fault_count() {
    for mut robot in all_serving() {
        robot.well(ACTIVATE);
        robot.well(DeviceCommand::Write(DRIVE, &drive(666)));
        robot.back.loss = 1.0;
        robot.advance(12);
        robot.back.loss = 0.0;
        robot.events.clear();

        robot.advance(30);

        assert!(!robot.host.is_lost());
        assert_eq!(robot.host.state(1), Some(DeviceState::Error));
    }
}

#[test]
fn garbage_moves_nothing_and_the_next_packet_is_found() {
    let rounds = if crate::c_side::is_long() { 20_000 } else { 200 };
    for mut robot in all_serving() {
        let mut random = Random(7);
        for round in 0..rounds {
            let mut bytes = vec![0; (random.next() % 80) as usize];
            bytes.iter_mut().for_each(|byte| *byte = (random.next() >> 40) as u8);
            if round % 2 == 0 {
                // What looks like packets: right variant, classes and messages.
                let kinds = [0x40, 0x48, 0x50, 0x58, 0x59];
                let shape = [kinds[(random.next() % 5) as usize], (random.next() % 3) as u8];
                bytes.splice(..bytes.len().min(2), shape);
            }
            let now = robot.now;
            let sent = robot.bench.run(now, &bytes);
            assert!(sent.is_empty(), "garbage was answered: {bytes:x?} {sent:x?}");
        }
        // The end of a frame, so that the next one begins.
        robot.bench.run(robot.now, &[0]);
        robot.advance(1);
        assert_eq!(robot.well(DeviceCommand::Read(LIMIT)), [0, 0]);
        let journal = robot.journal();
        assert_eq!((journal.executed, journal.aborted), (0, 0));
    }
}

#[test]
fn a_tool_chain_whose_double_has_four_bytes_keeps_the_contract_or_is_refused() {
    // The library's own type keeps all 8 bytes.
    let short = ["-U__SIZEOF_DOUBLE__", "-D__SIZEOF_DOUBLE__=4"];
    let bench = Box::new(CSide::with_flags(Medium::Serial, &short));
    let mut robot = Robot::new(bench, Medium::Serial, config(Medium::Serial));
    robot.advance(1);
    robot.well(ACTIVATE);
    robot.well(DeviceCommand::Write(DRIVE, &drive(3)));
    robot.advance(11);
    assert_eq!(robot.well(DeviceCommand::Read(DRIVEN)), drive(3));

    // A plain `double` of 4 bytes makes another struct, which the host notices.
    let bench = Box::new(CSide::with_flags(Medium::Serial, &["-DNAIVE_DOUBLE"]));
    let mut robot = Robot::new(bench, Medium::Serial, config(Medium::Serial));
    robot.advance(1);
    let found = Port::input(1, 0, 6, 0x1234_abcd);
    robot.expect(HostEvent::Refused(Mismatch::Port(DRIVE, found)));
}
