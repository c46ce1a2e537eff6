//! The device's side: executes each command once, keeps the life cycle, watches the host.
//!
//! The C library in `c/` is the same machine for chips on which no Rust runs. This one is its
//! reference in tests, the device of simulations, and firmware.
//!
//! ```text
//! packet ──► handle_packet ──► hooks, values of the firmware
//!                 │
//!                 ▼
//!   pending: one answer │ states │ published ports ──► poll_packet ──► packet
//! ```
//!
//! The machine queues no packets. It keeps flags of what is to be sent, and builds each packet when
//! the driver polls it: a published port is sent with its newest value. On a multi-drop line,
//! states and ports wait for a POLL.

use crate::firmware::{DeviceHook, Firmware};
use crate::message::{self, DeviceState, ResetCause, Status};
use crate::packet::{DATA_MAX, DevicePacket, OBJECTS_MAX, PACKET_MAX};
use crate::port::{PORTS_MAX, Port, PortKind, PortSet};
use core::time::Duration;

/// What a device is.
#[derive(Clone, Copy, Debug)]
pub struct DeviceConfig<'a> {
    /// The type, by which the host notices a swapped device or a wrong firmware.
    pub device_type: u32,
    /// The ports and variables.
    pub ports: &'a [Port],
    /// The address on a multi-drop line, 1 to 247; `None` if the device has the line to itself.
    pub address: Option<u8>,
    /// How often the chip has started; 0 if it cannot count.
    pub boot: u16,
    /// Why it started this time.
    pub cause: ResetCause,
    /// The longest silence of the host before the dead-man expires. The host may ask for less.
    pub deadman_max: Duration,
}

/// The answer that the driver has not polled yet. The host has one exchange at a time, so a newer
/// answer replaces an older one.
#[derive(Clone, Copy, Debug)]
enum Answer {
    None,
    Pong(u8),
    Hello,
    Describe(u8),
    /// POLL: so many frames may still be sent; the number for the PONG.
    Turn(u8, u8),
    Restart(u8, Status),
    /// The reply that is kept.
    Reply,
    OutOfStep(Head),
}

/// What a reply repeats of its command.
#[derive(Clone, Copy, Debug)]
struct Head {
    /// `None` in plain packets.
    sequence: Option<u8>,
    object: u8,
    message: u8,
}

#[derive(Clone, Copy, Debug)]
struct Object {
    state: DeviceState,
    code: u8,
    /// A STATE event waits to be sent.
    waiting: bool,
}

/// The machine of a device with `OBJECTS` objects, at most [`OBJECTS_MAX`], and `PORTS` ports and
/// variables.
///
/// `now` is the time since any fixed origin. The driver calls `handle_packet` and `handle_timeout`,
/// then [`poll_packet`](Self::poll_packet) until it returns `None`.
#[derive(Clone, Debug)]
pub struct Device<'a, const OBJECTS: usize, const PORTS: usize> {
    config: DeviceConfig<'a>,
    session: u16,
    reply: KeptReply,
    answer: Answer,
    restarts: bool,
    objects: [Object; OBJECTS],
    faults: u8,
    published: PortSet,
    deadman: DeadmanTimer,
    executions: ExecutionClock,
    /// When each in port with a deadline was written, or its object activated.
    written: [Duration; PORTS],
}

/// The reply to the last command that was carried out.
#[derive(Clone, Debug)]
struct KeptReply {
    /// The sequence of that command; 0 after HELLO.
    last: u8,
    kept: Option<(Head, usize)>,
    data: [u8; DATA_MAX],
}

/// Whether the node is silent, and for how long it may be.
#[derive(Clone, Debug)]
struct DeadmanTimer {
    limit: Duration,
    expired: bool,
    /// When the last packet was accepted.
    received: Duration,
    silent: bool,
}

/// When the objects are executed.
#[derive(Clone, Debug)]
struct ExecutionClock {
    running: bool,
    period: Duration,
    next: Duration,
}

impl<'a, const OBJECTS: usize, const PORTS: usize> Device<'a, OBJECTS, PORTS> {
    /// Starts a device: runs `on_initialize` of each object.
    ///
    /// # Panics
    ///
    /// If `PORTS` is not the number of ports, or one belongs to no object of the device.
    pub fn new(config: DeviceConfig<'a>, now: Duration, firmware: &mut impl Firmware) -> Self {
        assert_eq!(config.ports.len(), PORTS, "the table has as many ports as the device");
        assert!(PORTS <= PORTS_MAX && OBJECTS <= OBJECTS_MAX, "one byte counts ports and objects");
        let known = config.ports.iter().all(|port| usize::from(port.object()) <= OBJECTS);
        assert!(known, "each port belongs to an object of the device");
        let object = Object { state: DeviceState::Created, code: 0, waiting: false };
        let mut device = Device {
            config,
            session: 0,
            reply: KeptReply { last: 0, kept: None, data: [0; DATA_MAX] },
            answer: Answer::None,
            restarts: false,
            objects: [object; OBJECTS],
            faults: 0,
            published: PortSet::default(),
            deadman: DeadmanTimer {
                limit: config.deadman_max,
                expired: false,
                received: now,
                silent: false,
            },
            executions: ExecutionClock {
                running: true,
                period: FIRST_PERIOD,
                next: now + FIRST_PERIOD,
            },
            written: [now; PORTS],
        };
        for object in 1..=OBJECTS as u8 {
            let code = device.hook(object, DeviceHook::Initialize, 0, firmware);
            let state = if code == 0 { DeviceState::Inactive } else { DeviceState::Finalized };
            *device.object(object) = Object { state, code, waiting: false };
        }
        device
    }

    /// The state of an object, counted from 1.
    ///
    /// # Panics
    ///
    /// If there is no such object.
    pub fn state(&self, object: u8) -> DeviceState {
        self.objects[usize::from(object) - 1].state
    }

    /// Whether the host has ordered a restart of the chip, and the reply was polled. The driver
    /// restarts it after the bytes have left.
    pub fn restarts(&self) -> bool {
        self.restarts
    }

    /// Sends an out port's value at the next opportunity, from outside of hooks.
    pub fn publish(&mut self, port: usize) {
        self.published.insert(port);
    }

    /// Takes the bytes of one packet. Bytes that are no packet for this device are dropped.
    pub fn handle_packet(&mut self, bytes: &[u8], now: Duration, firmware: &mut impl Firmware) {
        let address = self.config.address;
        let Some(packet) = DevicePacket::decode(bytes, address.is_some(), self.session) else {
            return;
        };
        // Packets to all are never answered, so commands to all cannot be carried out once.
        let to_all = packet.address == Some(0) && packet.sequence.is_none();
        let for_us = packet.address == address || to_all;
        let is_link = packet.object == message::LINK;
        let in_place = if is_link { packet.sequence.is_none() } else { self.session != 0 };
        if packet.from_device || !for_us || !in_place {
            return;
        }
        let is_probe = is_link
            && packet.message == message::PING
            && packet.data.first().is_some_and(|number| number & message::PING_PROBE != 0);
        if !is_probe {
            (self.deadman.received, self.deadman.silent) = (now, false);
        }
        match packet.sequence {
            None if is_link => {
                let answer = self.link_answer(&packet);
                self.answer = if to_all { Answer::None } else { answer };
            }
            _ if !self.has_exact_length(&packet) => {}
            None => self.write(&packet, now, firmware),
            Some(sequence) => self.command(sequence, &packet, now, firmware),
        }
    }

    /// Lets the device act on everything that is due: dead-man, deadlines, execution.
    pub fn handle_timeout(&mut self, now: Duration, firmware: &mut impl Firmware) {
        if self.session != 0
            && !self.deadman.silent
            && now.saturating_sub(self.deadman.received) >= self.deadman.limit
        {
            self.deadman.silent = true;
            self.deadman.expired = true;
            for object in 1..=OBJECTS as u8 {
                if self.state(object) == DeviceState::Active {
                    self.abort(object, message::CODE_DEADMAN, firmware);
                }
            }
        }
        for port in 0..PORTS {
            let (object, limit) = (self.config.ports[port].object(), self.deadline(port));
            let late = limit.is_some_and(|limit| now.saturating_sub(self.written[port]) >= limit);
            if late && self.state(object) == DeviceState::Active {
                self.abort(object, message::CODE_INPUT_TOO_OLD, firmware);
            }
        }
        if !self.executions.running || now < self.executions.next {
            return;
        }
        self.executions.next += self.executions.period;
        if self.executions.next <= now {
            // Executions that were missed are skipped.
            self.executions.next = now + self.executions.period;
        }
        for object in 1..=OBJECTS as u8 {
            match *self.object(object) {
                Object { state: DeviceState::Active, .. } => {
                    let code = self.hook(object, DeviceHook::Execute, 0, firmware);
                    if code != 0 {
                        self.abort(object, code, firmware);
                    }
                }
                Object { state: DeviceState::Error, code, .. } => {
                    self.hook(object, DeviceHook::Error, code, firmware);
                }
                _ => {}
            }
        }
    }

    /// When `handle_timeout` is due at the latest; `None` while nothing runs.
    pub fn poll_timeout(&self) -> Option<Duration> {
        let is = |wanted| self.objects.iter().any(|object| object.state == wanted);
        if !is(DeviceState::Active) {
            return (self.executions.running && is(DeviceState::Error))
                .then_some(self.executions.next);
        }
        let watched = (0..PORTS)
            .filter(|&port| self.state(self.config.ports[port].object()) == DeviceState::Active);
        let deadlines = watched.filter_map(|port| Some(self.written[port] + self.deadline(port)?));
        let expiry = (!self.deadman.silent).then_some(self.deadman.received + self.deadman.limit);
        deadlines.chain(expiry).chain(self.executions.running.then_some(self.executions.next)).min()
    }

    /// Writes the next packet into `bytes` and returns it; `None` when there is none to send.
    pub fn poll_packet<'b>(
        &mut self,
        firmware: &mut impl Firmware,
        bytes: &'b mut [u8; PACKET_MAX],
    ) -> Option<&'b [u8]> {
        let may_report = match self.answer {
            Answer::Turn(left, _) => left > 0,
            _ => self.config.address.is_none(),
        };
        let mut data = [0; DATA_MAX];
        let event = if may_report { self.next_event(firmware, &mut data) } else { None };
        if let (Some(_), Answer::Turn(left, _)) = (event, &mut self.answer) {
            *left -= 1;
        }
        let (head, length) = event.or_else(|| self.next_answer(&mut data))?;
        let packet = DevicePacket {
            address: self.config.address,
            from_device: true,
            sequence: head.sequence,
            object: head.object,
            message: head.message,
            data: &data[..length],
        };
        Some(packet.encode(self.session, bytes))
    }

    /// Data of another length than the message's are a sign of noise that the checksum missed.
    /// Only a command of an unknown message passes, to be answered.
    fn has_exact_length(&self, packet: &DevicePacket<'_>) -> bool {
        let ports = self.config.ports;
        let length = match (packet.message, Port::find(ports, packet.object, packet.message)) {
            (message::LIFECYCLE..=message::STOP, _) => 0,
            (message::RATE, _) => 2,
            (message::TEXT, _) => 1,
            (message, Some(at)) if ports[at].kind() == PortKind::Out || is_get(message) => 0,
            (_, Some(at)) => usize::from(ports[at].size()),
            (_, None) => return packet.sequence.is_some(),
        };
        packet.data.len() == length
    }

    fn link_answer(&mut self, packet: &DevicePacket<'_>) -> Answer {
        match (packet.message, packet.data) {
            (message::PING, &[number]) => Answer::Pong(number),
            (message::POLL, &[frames]) if self.config.address.is_some() => {
                Answer::Turn(frames, frames)
            }
            (message::DESCRIBE, &[index]) => Answer::Describe(index),
            (message::RESTART, guard @ &[first, _, _, _]) => {
                let ours = *guard == self.config.device_type.to_le_bytes();
                Answer::Restart(first, if ours { Status::Well } else { Status::NoSuch })
            }
            (message::HELLO, &[a, b, c, d]) if (a, b) != (0, 0) => {
                self.open(u16::from_le_bytes([a, b]), u16::from_le_bytes([c, d]));
                Answer::Hello
            }
            _ => Answer::None,
        }
    }

    /// HELLO leaves the life cycle alone: a host's restart stops no actuator.
    fn open(&mut self, session: u16, deadman_ms: u16) {
        if session != self.session {
            self.session = session;
            self.reply.last = 0;
            self.reply.kept = None;
            self.deadman.expired = false;
        }
        let asked = Duration::from_millis(deadman_ms.into());
        let asked = if asked.is_zero() { self.config.deadman_max } else { asked };
        self.deadman.limit = asked.min(self.config.deadman_max);
    }

    /// A plain packet: the newest value wins, and nothing is answered.
    fn write(&mut self, packet: &DevicePacket<'_>, now: Duration, firmware: &mut impl Firmware) {
        let port = Port::find(self.config.ports, packet.object, packet.message);
        if let Some(port) = port.filter(|port| self.config.ports[*port].kind() == PortKind::In) {
            self.written[port] = now;
            firmware.write(port, packet.data);
        }
    }

    fn command(
        &mut self,
        sequence: u8,
        packet: &DevicePacket<'_>,
        now: Duration,
        firmware: &mut impl Firmware,
    ) {
        let DevicePacket { object, message, .. } = *packet;
        let head = Head { sequence: Some(sequence), object, message };
        if sequence == self.reply.last && self.reply.kept.is_some() {
            self.answer = Answer::Reply;
        } else if sequence == (self.reply.last + 1) % 8 {
            self.reply.last = sequence;
            let mut reply = [0; DATA_MAX];
            let (status, length) = self.execute(packet, now, firmware, &mut reply[1..]);
            reply[0] = status as u8;
            self.reply.data = reply;
            self.reply.kept = Some((head, 1 + length));
            self.answer = Answer::Reply;
        } else {
            self.answer = Answer::OutOfStep(head);
        }
    }

    /// Carries a command out; returns how many bytes follow the status.
    fn execute(
        &mut self,
        packet: &DevicePacket<'_>,
        now: Duration,
        firmware: &mut impl Firmware,
        reply: &mut [u8],
    ) -> (Status, usize) {
        let &DevicePacket { object, message, data, .. } = packet;
        if usize::from(object) > OBJECTS {
            return (Status::NoSuch, 0);
        }
        match message {
            message::LIFECYCLE..message::START => {
                let status = self.change(object, message, now, firmware);
                reply[0] = self.state(object) as u8;
                return (status, 1);
            }
            message::START | message::STOP => {
                self.executions.running = message == message::START;
                self.executions.next = now + self.executions.period;
                return (Status::Well, 0);
            }
            message::RATE => {
                let period_ms =
                    u16::from_le_bytes([data[0], data[1]]).clamp(1, message::PERIOD_MAX_MS);
                self.executions.period = Duration::from_millis(period_ms.into());
                self.executions.next = now + self.executions.period;
                return (Status::Well, 0);
            }
            message::TEXT => {
                let text = firmware.text(object, data[0]).as_bytes();
                let length = text.len().min(message::TEXT_MAX);
                reply[..length].copy_from_slice(&text[..length]);
                return (Status::Well, length);
            }
            _ => {}
        }
        let Some(index) = Port::find(self.config.ports, object, message) else {
            return (Status::NoSuch, 0);
        };
        let port = self.config.ports[index];
        let (size, result) = (usize::from(port.size()), usize::from(port.reply()));
        match port.kind() {
            PortKind::Call if firmware.call(index, data, &mut reply[..result]) => {
                (Status::Well, result)
            }
            PortKind::Call => (Status::HookFailed, 0),
            PortKind::Variable | PortKind::In if !is_get(message) => {
                self.written[index] = now;
                firmware.write(index, data);
                (Status::Well, 0)
            }
            _ => {
                firmware.read(index, &mut reply[..size]);
                (Status::Well, size)
            }
        }
    }

    fn change(
        &mut self,
        object: u8,
        message: u8,
        now: Duration,
        firmware: &mut impl Firmware,
    ) -> Status {
        let (from, hook, to) = CHANGES[usize::from(message - message::LIFECYCLE)];
        if self.state(object) != from {
            return Status::WrongState;
        }
        let code = self.hook(object, hook, 0, firmware);
        if code != 0 {
            self.abort(object, code, firmware);
            return Status::HookFailed;
        }
        // An event that still waits reports the newest state.
        let changed = self.object(object);
        (changed.state, changed.code) = (to, 0);
        // The age of inputs counts from the activation.
        for (port, written) in self.config.ports.iter().zip(&mut self.written) {
            if port.object() == object {
                *written = now;
            }
        }
        Status::Well
    }

    fn abort(&mut self, object: u8, code: u8, firmware: &mut impl Firmware) {
        *self.object(object) = Object { state: DeviceState::Error, code, waiting: true };
        self.faults = (self.faults + 1) % 16;
        self.hook(object, DeviceHook::Aborting, code, firmware);
    }

    fn hook(&mut self, object: u8, hook: DeviceHook, why: u8, firmware: &mut impl Firmware) -> u8 {
        firmware.hook(object, hook, why, &mut self.published)
    }

    fn object(&mut self, object: u8) -> &mut Object {
        &mut self.objects[usize::from(object) - 1]
    }

    fn deadline(&self, port: usize) -> Option<Duration> {
        let limit_ms = self.config.ports[port].deadline_ms();
        (limit_ms > 0).then(|| Duration::from_millis(limit_ms.into()))
    }

    fn is_waiting(&self) -> bool {
        !self.published.is_empty() || self.objects.iter().any(|object| object.waiting)
    }

    /// Takes the next STATE or DATA out of the flags; nothing is sent without a session.
    fn next_event(
        &mut self,
        firmware: &mut impl Firmware,
        data: &mut [u8; DATA_MAX],
    ) -> Option<(Head, usize)> {
        if self.session == 0 {
            return None;
        }
        if let Some(at) = self.objects.iter().position(|object| object.waiting) {
            let object = &mut self.objects[at];
            object.waiting = false;
            data[..2].copy_from_slice(&[object.state as u8, object.code]);
            let head = Head { sequence: None, object: at as u8 + 1, message: message::STATE };
            return Some((head, 2));
        }
        let index = self.published.pop()?;
        let port = self.config.ports.get(index).filter(|port| port.kind() == PortKind::Out)?;
        let size = usize::from(port.size());
        firmware.read(index, &mut data[..size]);
        Some((Head { sequence: None, object: port.object(), message: port.id() }, size))
    }

    /// Takes the answer.
    fn next_answer(&mut self, data: &mut [u8; DATA_MAX]) -> Option<(Head, usize)> {
        let link = |message| Head { sequence: None, object: message::LINK, message };
        let answer = core::mem::replace(&mut self.answer, Answer::None);
        Some(match answer {
            Answer::None => return None,
            Answer::Pong(number) | Answer::Turn(_, number) => {
                let has_session = self.session != 0;
                let waits = self.config.address.is_some() && self.is_waiting();
                let flag = |set, flag| if set { flag } else { 0 };
                let flags = flag(has_session, message::FLAG_SESSION)
                    | flag(self.deadman.expired, message::FLAG_DEADMAN)
                    | flag(waits, message::FLAG_WAITING)
                    | (self.faults << 4);
                let [boot, _] = self.config.boot.to_le_bytes();
                let [session, _] = self.session.to_le_bytes();
                data[..4].copy_from_slice(&[number, boot, flags, session]);
                (link(message::PING), 4)
            }
            Answer::Hello => {
                [data[0], _] = self.session.to_le_bytes();
                data[1..3].copy_from_slice(&self.config.boot.to_le_bytes());
                data[3] = self.config.cause as u8;
                data[4..8].copy_from_slice(&self.config.device_type.to_le_bytes());
                (data[8], data[9]) = (DATA_MAX as u8, OBJECTS as u8);
                for (byte, object) in data[10..].iter_mut().zip(&self.objects) {
                    *byte = object.state as u8;
                }
                (link(message::HELLO), 10 + OBJECTS)
            }
            Answer::Describe(index) => match self.config.ports.get(usize::from(index)) {
                Some(port) => {
                    data[..4].copy_from_slice(&[index, port.object(), port.id(), port.size()]);
                    data[4..8].copy_from_slice(&port.fingerprint().to_le_bytes());
                    (link(message::DESCRIBE), 8)
                }
                None => {
                    data[..2].copy_from_slice(&[index, Status::End as u8]);
                    (link(message::DESCRIBE), 2)
                }
            },
            Answer::Restart(first, status) => {
                self.restarts |= status == Status::Well;
                data[..2].copy_from_slice(&[first, status as u8]);
                (link(message::RESTART), 2)
            }
            Answer::Reply => {
                let (head, length) = self.reply.kept?;
                data[..length].copy_from_slice(&self.reply.data[..length]);
                (head, length)
            }
            Answer::OutOfStep(head) => {
                data[0] = Status::OutOfStep as u8;
                (head, 1)
            }
        })
    }
}

/// What the four messages of the life cycle do: from this state, by this hook, to that state.
const CHANGES: [(DeviceState, DeviceHook, DeviceState); 4] = [
    (DeviceState::Inactive, DeviceHook::Activated, DeviceState::Active),
    (DeviceState::Active, DeviceHook::Deactivated, DeviceState::Inactive),
    (DeviceState::Error, DeviceHook::Reset, DeviceState::Inactive),
    (DeviceState::Inactive, DeviceHook::Finalize, DeviceState::Finalized),
];

/// The context's period before the first RATE.
const FIRST_PERIOD: Duration = Duration::from_millis(10);

fn is_get(message: u8) -> bool {
    message >= message::SET | message::GET_BIT
}

#[cfg(test)]
mod tests;
