//! For all packets of a device at all times, its host neither panics nor floods it, ends each command
//! once, and its next timeout is in the future.

#![no_main]

use blastema_lite::{
    DeviceCommand, DevicePacket, Host, HostConfig, HostEvent, LifecycleChange, PACKET_MAX, Port,
    Tries, message,
};
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

const PORTS: [Port; 3] =
    [Port::input(1, 0, 2, 1), Port::output(2, 0, 3, 2), Port::call(1, 0, 1, 4, 3)];

type Script = (Option<u8>, Vec<(u8, u8, Option<(bool, u8, u8)>, Vec<u8>)>);

fuzz_target!(|script: Script| {
    let (address, script) = script;
    let mut now = Duration::ZERO;
    let config = HostConfig {
        address,
        device_type: 1,
        ports: PORTS,
        session: 0,
        interval: Duration::from_millis(10),
        tries: Tries::Auto,
        deadman: Duration::from_millis(500),
        byte_time: Duration::from_micros(87),
        turnaround: Duration::ZERO,
    };
    let mut host = Host::new(config, now);
    // The device's memory: the session of the last HELLO, and the last request.
    let (mut session, mut asked) = (0, (None, 0, 0, [0; 4]));
    let mut outstanding = false;
    for (wait_ms, order, fields, mut data) in script {
        now += Duration::from_millis((wait_ms % 32).into());
        host.handle_timeout(now);
        let accepted = match order % 16 {
            0 => host.handle_command(DeviceCommand::Call(2, &[7])),
            1 => host.handle_command(DeviceCommand::Change(1, LifecycleChange::Activate)),
            2 => host.handle_command(DeviceCommand::Text(1, 7)),
            3 => {
                host.handle_restart();
                host.handle_publish(0)
            }
            _ => Ok(()),
        };
        assert!(!(outstanding && order % 16 < 3 && accepted.is_ok()), "one at a time");
        outstanding |= order % 16 < 3 && accepted.is_ok();
        drain(&mut host, &mut outstanding);
        let mut bytes = [0; PACKET_MAX];
        let bytes = match fields {
            Some((answers, object, message)) if data.len() <= 240 => {
                let (sequence, object, message) = match answers {
                    true => (asked.0, asked.1, asked.2),
                    false => (None, object, message),
                };
                // A PONG repeats the number; its session is right for the most part.
                if answers && (object, message) == (message::LINK, message::PING) {
                    data.resize(4, 1);
                    data[0] = asked.3[0];
                    data[3] = if wait_ms < 200 { session as u8 } else { data[3] };
                }
                if answers && (object, message) == (message::LINK, message::DESCRIBE) {
                    data.insert(0, asked.3[0]);
                }
                if answers && message == message::HELLO && object == message::LINK {
                    data.splice(.., [session as u8, 1, 0, 1, 1, 0, 0, 0, 240, 2, 1, 1]);
                }
                let fields = DevicePacket {
                    address,
                    from_device: true,
                    sequence,
                    object,
                    message,
                    data: &data,
                };
                fields.encode(session, &mut bytes)
            }
            _ => &data,
        };
        host.handle_packet(bytes, now);
        drain(&mut host, &mut outstanding);
        let mut room = [0; PACKET_MAX];
        let mut sent = 0;
        while let Some(packet) = host.poll_packet(now, |_, value| value.fill(3), &mut room) {
            sent += 1;
            assert!(sent <= 2, "a value and a request");
            let head = usize::from(address.is_some());
            let data = &packet[head + 3..packet.len() - 1];
            let mut first = [0; 4];
            first[..data.len().min(4)].copy_from_slice(&data[..data.len().min(4)]);
            let is_command = packet[head] & 0x10 != 0;
            let sequence = is_command.then_some(packet[head] & 7);
            asked = (sequence, packet[head + 1], packet[head + 2], first);
            if asked.1 == message::LINK && asked.2 == message::HELLO {
                session = u16::from_le_bytes([first[0], first[1]]);
            }
        }
        assert!(host.poll_timeout() > now);
    }
});

fn drain(host: &mut Host<[Port; 3]>, outstanding: &mut bool) {
    while let Some(event) = host.poll_event() {
        if matches!(event, HostEvent::Done(_)) {
            assert!(std::mem::take(outstanding), "a command ends once");
        }
    }
}
