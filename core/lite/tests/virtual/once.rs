//! Each command is carried out exactly once on a line that loses, repeats and corrupts.

use crate::bench::{Bench, MEDIA, Medium, NUMBER, RustSide};
use crate::c_side::{CSide, is_long};
use crate::channel::Channel;
use crate::robot::{Robot, config, ms};
use blastema_lite::{
    CommandOutcome, DeviceCommand, HostConfig, HostEvent, ResetCause, Status, Tries,
};

/// Carries out `commands` with 20 % of frames lost each way, 10 % repeated, and 10^-4 of bits
/// turned.
fn check(bench: Box<dyn Bench>, medium: Medium, commands: u32) {
    // As many tries as keep a false `Lost` out of a run of 10^6 commands at this loss.
    let config = HostConfig { tries: Tries::Fixed(40), ..config(medium) };
    let mut robot = Robot::new(bench, medium, config);
    robot.out = Channel::new(1, 0.2, 0.1, 1e-4);
    robot.back = Channel::new(2, 0.2, 0.1, 1e-4);
    if medium == Medium::Datagram {
        // Packets overtake each other, also copies of the same command.
        (robot.out.late, robot.back.late) = (0.1, 0.1);
    }
    robot.advance(1_000);
    assert!(robot.host.is_serving());
    robot.frames_sent = 0;
    for number in 1..=commands {
        let command = number.to_le_bytes();
        robot.host.handle_command(DeviceCommand::Call(NUMBER, &command)).expect("it serves");
        robot.events.clear();
        robot.pump();
        // A command that takes a second of virtual time is one that never ends.
        let limit = robot.now + ms(1_000);
        while robot.events.is_empty() {
            assert!(robot.now < limit, "command {number} does not end");
            robot.now = robot.now.max(robot.host.poll_timeout());
            robot.tick();
        }
        for (event, payload) in &robot.events {
            match event {
                HostEvent::Done(CommandOutcome::Replied(Status::Well)) => {
                    assert_eq!(payload[..4], command, "carried out so often");
                    assert_eq!(payload[4..], command, "its own reply");
                }
                other => panic!("command {number}: {other:?}"),
            }
        }
    }
    let frames = robot.frames_sent as f64 / f64::from(commands);
    (robot.out, robot.back) = (Channel::perfect(), Channel::perfect());
    robot.events.clear();
    let journal = robot.journal();
    assert_eq!((journal.executed, journal.twice, journal.wrong), (commands, 0, 0));
    println!("{medium:?}: {commands} commands, each once; {frames:.3} frames per command");
}

#[test]
fn each_command_is_carried_out_once_by_the_rust_side() {
    let commands = if is_long() { 1_000_000 } else { 10_000 };
    check(Box::new(RustSide::new(Medium::Serial)), Medium::Serial, commands);
    check(Box::new(RustSide::new(Medium::Multidrop)), Medium::Multidrop, commands / 10);
    check(Box::new(RustSide::new(Medium::Datagram)), Medium::Datagram, commands / 10);
}

#[test]
fn each_command_is_carried_out_once_by_the_c_side() {
    let commands = if is_long() { 1_000_000 } else { 10_000 };
    check(Box::new(CSide::new(Medium::Serial)), Medium::Serial, commands);
    check(Box::new(CSide::new(Medium::Multidrop)), Medium::Multidrop, commands / 10);
    check(Box::new(CSide::new(Medium::Datagram)), Medium::Datagram, commands / 10);
}

/// Resets the device now and then while a command is outstanding.
fn check_over_resets(bench: Box<dyn Bench>, medium: Medium, commands: u32) {
    let config = HostConfig { tries: Tries::Fixed(20), ..config(medium) };
    let mut robot = Robot::new(bench, medium, config);
    (robot.out, robot.back) = (Channel::new(3, 0.2, 0.1, 1e-4), Channel::new(4, 0.2, 0.1, 1e-4));
    let (mut well, mut unknown) = (0, 0);
    for number in 1..=commands {
        while !robot.host.is_serving() {
            assert!(robot.now < ms(1_000) * commands, "the device comes back");
            robot.advance(1);
        }
        let command = number.to_le_bytes();
        robot.host.handle_command(DeviceCommand::Call(NUMBER, &command)).expect("it serves");
        robot.events.clear();
        let resets = robot.out.random.chance(0.1);
        if resets && number % 2 == 0 {
            robot.bench.reset(robot.now, ResetCause::BrownOut);
        }
        robot.pump();
        if resets && number % 2 == 1 {
            robot.bench.reset(robot.now, ResetCause::BrownOut);
        }
        let outcome = loop {
            let done = robot.events.iter().find_map(|(event, _)| match event {
                HostEvent::Done(outcome) => Some(*outcome),
                _ => None,
            });
            if let Some(outcome) = done {
                break outcome;
            }
            assert!(robot.now < ms(1_000) * commands, "command {number} ends");
            robot.advance(1);
        };
        match outcome {
            CommandOutcome::Replied(Status::Well) => well += 1,
            CommandOutcome::Unknown => unknown += 1,
            other => panic!("command {number}: {other:?}"),
        }
    }
    (robot.out, robot.back) = (Channel::perfect(), Channel::perfect());
    robot.advance(2_000);
    robot.events.clear();
    let journal = robot.journal();
    assert_eq!(journal.twice, 0);
    assert!((well..=well + unknown).contains(&journal.executed), "{journal:?} {well} {unknown}");
    assert!(unknown > commands / 50, "resets hit commands: {unknown}");
}

#[test]
fn over_resets_no_command_is_carried_out_twice_and_each_that_may_have_been_is_unknown() {
    for medium in MEDIA {
        check_over_resets(Box::new(RustSide::new(medium)), medium, 500);
        check_over_resets(Box::new(CSide::new(medium)), medium, 500);
    }
}
