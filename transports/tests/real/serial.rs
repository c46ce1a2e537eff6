//! What only serial lines do, on real ptys.

use crate::conformance::end::{End, attach};
use actix::Actor;
use blastema_contract::transport::MediumAddress::Line;
use blastema_contract::transport::{
    Close, ConnectionTrust, Transmit, TransmitBacklog, TransportCounters, TransportReport,
};
use blastema_core::medium::lane::FrameLane;
use blastema_doubles::{advance, now, paused};
use blastema_ptys::Cable;
use blastema_transports::serial::framing::encode;
use blastema_transports::{FrameTransport, Rs485, SerialConfig, SerialLine};
use std::path::PathBuf;
use std::time::Duration;

fn with(config: SerialConfig) -> End {
    End::new(FrameTransport::new(SerialLine::new(config, now)).start())
}

fn at(path: PathBuf, baud: u32) -> End {
    let mut config = SerialConfig::new(path);
    config.baud = Some(baud);
    with(config)
}

async fn open(path: PathBuf, baud: u32) -> End {
    let end = at(path, baud);
    end.opened().await;
    end
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn an_unplugged_port_is_closed_at_once_and_opened_when_it_is_plugged_in_again() {
    let cable = Cable::new();
    let left = open(cable.left(), 1_000_000).await;
    let right = open(cable.right(), 1_000_000).await;

    for round in 0..3_u8 {
        left.send(Line, vec![round]);
        assert_eq!(right.frames.expect().await.frame, vec![round]);

        cable.unplug();
        for node in [&left, &right] {
            let reason = node.closed().await;
            assert!(reason.contains("plug it in again"), "{reason}");
        }
        left.send(Line, "into the void");

        cable.plug();
        left.opened().await;
        right.opened().await;
        assert_eq!(right.frames.len(), 0);
    }
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_port_that_is_not_there_yet_is_named_and_opened_when_it_is() {
    let cable = Cable::new();
    cable.unplug();
    let left = at(cable.left(), 115_200);

    let reason = left.closed().await;
    assert!(reason.contains("left cannot be opened"), "{reason}");
    assert!(reason.contains("there is no such port: plug the device in"), "{reason}");

    cable.plug();
    left.opened().await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn what_is_no_terminal_is_no_port() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let node = at(file.path().into(), 115_200);

    let reason = node.closed().await;
    assert!(reason.contains("check that it is a serial port"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_driver_that_cannot_turn_the_line_is_named_with_what_helps() {
    let cable = Cable::new();
    let mut config = SerialConfig::new(cable.left());
    config.rs485 = Some(Rs485::default());

    let reason = with(config).closed().await;

    assert!(reason.contains("left cannot be opened"), "{reason}");
    assert!(reason.contains("does not turn the line of RS-485"), "{reason}");
    assert!(reason.contains("use an adapter that turns by itself"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_driver_is_told_no_part_of_a_millisecond() {
    let cable = Cable::new();
    let mut how = Rs485::default();
    how.before = Duration::from_micros(1_500);
    let mut config = SerialConfig::new(cable.left());
    config.rs485 = Some(how);
    let reason = with(config).closed().await;
    assert!(reason.contains("in whole milliseconds"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn garbage_on_the_line_is_counted_and_takes_no_frame_along() {
    let cable = Cable::new();
    let left = open(cable.left(), 1_000_000).await;
    let right = open(cable.right(), 1_000_000).await;
    let mut torn = Vec::new();
    encode(b"a frame that is cut off", &mut torn);

    for (number, garbage) in
        [&b"\x7f\x00"[..], &[0xFF; 500], b"\r\nLinux login: ", &torn[..9], &[0; 50]]
            .into_iter()
            .cycle()
            .take(50)
            .enumerate()
    {
        cable.inject(&cable.right(), garbage);
        left.send(Line, vec![number as u8]);
        assert_eq!(right.frames.expect().await.frame, vec![number as u8]);
    }
    let TransportCounters { received, refused, .. } = right.counters().await;
    assert_eq!((received, refused), (50, 40), "empty frames between zeros are no noise");
    let lost = |report: &TransportReport| matches!(report, TransportReport::Closed { .. });
    assert!(!right.reports.drain().iter().any(lost));
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_wrong_speed_is_noise_and_nothing_else_until_it_is_put_right() {
    let cable = Cable::new();
    let left = open(cable.left(), 115_200).await;
    let wrong = open(cable.right(), 57_600).await;

    for number in 1..=40 {
        // Wherever the relay cuts what it reads, some of these turn into the end of a frame.
        left.send(Line, vec![0x55; 100]);
        left.counted(|counters| counters.sent == number).await;
    }
    wrong.counted(|counters| counters.refused > 0).await;
    assert_eq!(wrong.counters().await.received, 0);

    wrong.transport.close.send(Close).await.unwrap();
    let right = open(cable.right(), 115_200).await;
    left.send(Line, "understood");
    assert_eq!(right.frames.wait(|_| true).await.frame, "understood");
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_slow_line_says_how_much_it_carries_to_whoever_attaches() {
    let cable = Cable::new();
    let slow = open(cable.left(), 9_600).await;
    let expected = TransportReport::Rate { bytes_per_second: 1_920 };
    assert_eq!(slow.reports.expect().await, expected);

    let (_frames, reports) = attach(&slow.transport, ConnectionTrust::Claimed);
    assert!(matches!(reports.expect().await, TransportReport::Opened { .. }));
    assert_eq!(reports.expect().await, expected);

    let fast = open(cable.right(), 50_000_000).await;
    fast.counters().await;
    assert_eq!(fast.reports.len(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_port_serves_one_program_at_a_time() {
    let cable = Cable::new();
    let first = open(cable.left(), 115_200).await;

    let second = at(cable.left(), 115_200);
    let reason = second.closed().await;
    assert!(reason.contains("another program uses this port"), "{reason}");

    first.transport.close.send(Close).await.unwrap();
    second.opened().await;
}

#[blastema_macros::test(crate = "blastema_doubles::real")]
async fn a_slow_line_drops_and_counts_what_it_cannot_carry_and_keeps_nobody_waiting() {
    let cable = Cable::new();
    let left = open(cable.left(), 9_600).await;
    let right = open(cable.right(), 9_600).await;

    // A hundred times what the line carries in the time that it may make frames wait.
    for _ in 0..1_000 {
        left.send(Line, vec![7; 90]);
    }
    let TransportCounters { sent, dropped, .. } = left.counters().await;

    assert!(dropped >= 980, "{dropped} dropped, {sent} sent");
    // What was taken arrives, and a late one is not kept behind a thousand others.
    for _ in 0..1_000 - dropped {
        assert_eq!(right.frames.expect().await.frame, vec![7; 90]);
    }
    left.send(Line, "late");
    assert_eq!(right.frames.expect().await.frame, "late");
}

#[test]
fn what_waits_for_a_slow_line_is_counted_with_the_age_of_the_oldest() {
    let _turn = blastema_doubles::turn();
    paused(async {
        let cable = Cable::new();
        let left = open(cable.left(), 9_600).await;
        let _right = open(cable.right(), 9_600).await;
        assert_eq!(left.counters().await.backlog, TransmitBacklog::default());

        (0..5).for_each(|_| left.send(Line, vec![7; 90]));
        let first = left.counters().await.backlog;
        advance(Duration::from_millis(20)).await;
        let later = left.counters().await.backlog;

        // A frame takes a tenth of a second; the first is on the line.
        assert!((4..=5).contains(&first.frames) && first.oldest.is_zero(), "{first:?}");
        assert!(later.frames >= 4, "{later:?}");
        assert!(later.oldest >= Duration::from_millis(20), "{later:?}");
    });
}

#[test]
fn the_line_is_given_no_more_than_its_speed_carries() {
    let _turn = blastema_doubles::turn();
    paused(async {
        let cable = Cable::new();
        let config = |path| {
            let mut config = SerialConfig::new(path);
            (config.baud, config.mtu) = (Some(10_000), Some(400));
            config
        };
        assert_eq!(config(cable.left()).time_of(400), Duration::from_millis(400));
        let left = with(config(cable.left()));
        let right = with(config(cable.right()));
        left.opened().await;
        right.opened().await;

        left.send(Line, vec![7; 400]);
        let mut milliseconds = 0;
        while right.frames.is_empty() && milliseconds < 1_000_000 {
            advance(Duration::from_millis(1)).await;
            milliseconds += 1;
        }

        assert_eq!(right.frames.drain()[0].frame, vec![7; 400]);
        // The first piece goes out at once, and how late the rest arrives is the system's business.
        assert!(milliseconds > 350, "400 bytes took {milliseconds} ms at 1,000 bytes a second");
    });
}

#[test]
fn what_is_urgent_waits_for_one_frame_of_a_full_line_and_no_more() {
    let _turn = blastema_doubles::turn();
    paused(async {
        let cable = Cable::new();
        let left = open(cable.left(), 9_600).await;
        let right = open(cable.right(), 9_600).await;

        // More than there is room for.
        (0..20_u8).for_each(|number| left.send(Line, vec![number; 96]));
        let TransportCounters { dropped, .. } = left.counters().await;
        assert!(dropped >= 11, "{dropped} dropped");
        for (lane, frame) in [(FrameLane::Urgent, "acknowledged"), (FrameLane::Hello, "hello")] {
            left.transport.transmit.do_send(Transmit { to: Line, frame: frame.into(), lane });
        }
        let mut came = Vec::new();
        for _ in 0..100_000 {
            advance(Duration::from_millis(10)).await;
            came.extend(right.frames.drain().into_iter().map(|received| received.frame));
            if came.len() as u64 == 22 - dropped {
                break;
            }
        }

        assert_eq!(came[0], vec![0; 96], "it had begun");
        assert_eq!((&came[1][..], &came[2][..]), (&b"hello"[..], &b"acknowledged"[..]));
        assert_eq!(came[3], vec![1; 96]);
        assert_eq!(left.counters().await.dropped, dropped, "the urgent have a lane of their own");
    });
}
