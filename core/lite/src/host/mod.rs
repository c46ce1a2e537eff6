//! The host's side of one device: a session, one command at a time, pings, life-cycle states.
//!
//! ```text
//!           PONG             HELLO answered       contract right
//! Probing ───────► Greeting ────────────────► Matching ──────► Serving
//!    ▲                ▲                          │ differs        │
//!    │                │   PONG without our       ▼                │
//!    │                ├──────────────────────── Refused           │
//!    │                └── session, out of step, lost event ◄──────┤
//!    └─────────────── n tries without an answer, line closed ◄────┘
//! ```
//!
//! **Once.** The host repeats a command unchanged until its reply arrives, then takes the next of 8
//! sequence numbers. The device carries out number `last + 1` and answers `last` from memory.
//! Between two HELLOs a command is therefore carried out at most once, and exactly once if its reply
//! arrives. A reset erases the device's memory. Exactly once over crashes is then impossible
//! (Fekete, Lynch, Mansour, Spinelli, J. ACM 40(5), 1993): the command ends as
//! [`Unknown`](CommandOutcome::Unknown).
//!
//! **One exchange.** At most one request waits for its answer. After two unanswered commands a PING
//! follows: a device that was reset answers nothing else.

mod command;
mod config;
mod event;

pub use command::{CommandError, DeviceCommand};
pub use config::{HostConfig, Tries};
pub use event::{CommandOutcome, DeviceIdentity, HostEvent, Mismatch};

use crate::message::{self, DeviceState, ResetCause, Status};
use crate::packet::{DATA_MAX, DevicePacket, OBJECTS_MAX, PACKET_MAX};
use crate::port::{Port, PortKind, PortSet};
use command::Outstanding;
use core::time::Duration;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Probing,
    Greeting,
    /// This record of the port table is asked for.
    Matching(u8),
    Serving,
    Refused,
}

/// A request that waits for its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Request {
    Ping(u8),
    Poll(u8),
    Hello,
    Describe(u8),
    Restart,
    Command,
}

/// RESTART is sent again only after a PONG has shown that the device is still in the session: a
/// second one would reset the chip a second time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Restart {
    None,
    Wanted,
    Sent,
}

/// The host machine of one device.
///
/// `now` is the time since any fixed origin. After each input the driver sends what
/// [`poll_packet`](Self::poll_packet) returns and takes every event of
/// [`poll_event`](Self::poll_event), and calls [`handle_timeout`](Self::handle_timeout) at
/// [`poll_timeout`](Self::poll_timeout). On serial lines, a [`HostLine`](crate::HostLine) does this
/// for all hosts of the line.
#[derive(Clone, Debug)]
pub struct Host<P> {
    config: HostConfig<P>,
    phase: Phase,
    session: u16,
    /// The sequence of the last command.
    sequence: u8,
    request: Option<(Request, Duration)>,
    /// Unanswered requests in a row.
    misses: u32,
    /// When the device last answered.
    heard: Duration,
    lost: bool,
    tries: u8,
    /// Requests since the loss was last estimated, and those that were not answered.
    asked: (u32, u32),
    ping_number: u8,
    next_ping: Duration,
    next_forced_ping: Duration,
    /// The fault count that the next PONG shows if no event was lost.
    faults: u8,
    identity: Option<DeviceIdentity>,
    reset_seen: bool,
    states: [Option<DeviceState>; OBJECTS_MAX],
    /// The record before the one that is asked for: a late repetition of its answer is ignored.
    previous: Option<Port>,
    matched: PortSet,
    contract_matches: bool,
    restart: Restart,
    /// Frames wait for a POLL.
    waiting: bool,
    /// A STATE event was lost: the states are read again.
    event_lost: bool,
    published: PortSet,
    outstanding: Option<Outstanding>,
    command_data: [u8; DATA_MAX],
    payload: [u8; DATA_MAX],
    payload_length: usize,
    events: [Option<HostEvent>; EVENTS_MAX],
}

/// One input causes at most three events: out of step, an outcome, a warning.
const EVENTS_MAX: usize = 4;

/// The estimate of the loss rests on so many requests.
const ESTIMATE_AFTER: u32 = 1_000;

/// A command is abandoned after so many times the tries that declare a silent device lost: a device
/// that answers pings but not the command is faulty.
const COMMAND_PATIENCE: u32 = 4;

/// A busy line hides a lost STATE event for so many intervals at most: only a PONG shows it.
const FORCED_PING: u32 = 10;

/// A device of a multi-drop line that is lost is asked in every tenth round, so that it does not
/// cost the others its slot each time.
const LOST_ROUNDS: u32 = 10;

/// The most frames that a device sends in one turn.
const FRAMES_PER_POLL: u8 = 4;

impl<P: AsRef<[Port]>> Host<P> {
    /// A host that begins to look for its device.
    pub fn new(config: HostConfig<P>, now: Duration) -> Self {
        let tries = match config.tries {
            Tries::Auto => Tries::LEAST,
            Tries::Fixed(tries) => tries.max(1),
        };
        Host {
            session: config.session,
            config,
            phase: Phase::Probing,
            sequence: 0,
            request: None,
            misses: 0,
            heard: now,
            lost: false,
            tries,
            asked: (0, 0),
            ping_number: 0,
            next_ping: now,
            next_forced_ping: now,
            faults: 0,
            identity: None,
            reset_seen: false,
            states: [None; OBJECTS_MAX],
            previous: None,
            matched: PortSet::default(),
            contract_matches: false,
            restart: Restart::None,
            waiting: false,
            event_lost: false,
            published: PortSet::default(),
            outstanding: None,
            command_data: [0; DATA_MAX],
            payload: [0; DATA_MAX],
            payload_length: 0,
            events: [None; EVENTS_MAX],
        }
    }

    /// What the host was told of its device.
    pub fn config(&self) -> &HostConfig<P> {
        &self.config
    }

    /// Whether commands and values flow.
    pub fn is_serving(&self) -> bool {
        self.phase == Phase::Serving
    }

    /// Whether the device has been declared lost and has not answered since.
    pub fn is_lost(&self) -> bool {
        self.lost
    }

    /// Whether a request waits for its answer: on a multi-drop line the device has the turn.
    pub fn is_waiting(&self) -> bool {
        self.request.is_some()
    }

    /// The state of an object, from 1, as the device has last reported it.
    pub fn state(&self, object: u8) -> Option<DeviceState> {
        *self.states.get(usize::from(object).checked_sub(1)?)?
    }

    /// The bytes that belong to the last [`HostEvent::Data`] or [`HostEvent::Done`].
    pub fn payload(&self) -> &[u8] {
        &self.payload[..self.payload_length]
    }

    /// Gives the device a command. Its end is a [`HostEvent::Done`].
    ///
    /// # Errors
    ///
    /// [`CommandError`]; the command was not accepted.
    pub fn handle_command(&mut self, command: DeviceCommand<'_>) -> Result<(), CommandError> {
        if self.phase != Phase::Serving {
            return Err(CommandError::NotServing);
        }
        if self.outstanding.is_some() {
            return Err(CommandError::Busy);
        }
        let ports = self.config.ports.as_ref();
        self.outstanding = Some(command.encode(ports, &mut self.command_data)?);
        self.sequence = (self.sequence + 1) % 8;
        Ok(())
    }

    /// Announces a new value of an in port. It is sent once, without an answer; the host asks for it
    /// when it sends, so that the newest value goes. On media that reorder packets, give a
    /// [`DeviceCommand::Write`] instead.
    ///
    /// # Errors
    ///
    /// [`CommandError::NotServing`] or [`CommandError::NoSuchPort`].
    pub fn handle_publish(&mut self, port: usize) -> Result<(), CommandError> {
        if self.phase != Phase::Serving {
            return Err(CommandError::NotServing);
        }
        let known = self.config.ports.as_ref().get(port);
        known.filter(|port| port.kind() == PortKind::In).ok_or(CommandError::NoSuchPort)?;
        self.published.insert(port);
        Ok(())
    }

    /// Restarts the chip, also one that is refused. The outstanding command ends as unknown.
    pub fn handle_restart(&mut self) {
        if matches!(self.phase, Phase::Serving | Phase::Refused) {
            self.restart = Restart::Wanted;
        }
    }

    /// Declares the device lost at once: its line is closed or unplugged.
    pub fn handle_line_closed(&mut self) {
        self.request = None;
        self.lose();
    }

    /// Takes the bytes of one packet. Bytes that are no packet of this device are dropped.
    pub fn handle_packet(&mut self, bytes: &[u8], now: Duration) {
        let address = self.config.address;
        let Ok(packet) = DevicePacket::decode(bytes, address.is_some(), self.session) else {
            return;
        };
        if !packet.from_device || packet.address != address {
            return;
        }
        match (packet.sequence, packet.object, packet.message) {
            (None, message::LINK, message) => self.link_packet(message, packet.data, now),
            // Events count only in a session that the device has confirmed.
            (None, ..) if matches!(self.phase, Phase::Probing | Phase::Greeting) => {}
            (None, object, message::STATE) => self.state_event(object, packet.data),
            (None, object, message) => self.data(object, message, packet.data),
            (Some(sequence), object, message) => {
                let expected = self.outstanding.map(|command| (command.object, command.message));
                if sequence == self.sequence && expected == Some((object, message)) {
                    self.reply(packet.data, now);
                }
            }
        }
    }

    /// Lets the host act on everything that is due.
    pub fn handle_timeout(&mut self, now: Duration) {
        let Some((request, _)) = self.request.filter(|(_, due)| *due <= now) else { return };
        self.request = None;
        self.misses += 1;
        if !self.lost {
            self.estimate(true);
        }
        // Repetitions follow each other faster than pings; the silence must be as long all the same.
        let silence = self.config.interval * self.tries.into();
        if self.misses >= self.tries.into() && now.saturating_sub(self.heard) >= silence {
            self.lose();
        } else if request == Request::Command
            && let Some(command) = &mut self.outstanding
        {
            command.misses += 1;
            if command.misses >= COMMAND_PATIENCE * u32::from(self.tries) {
                self.greet(low(self.session));
            }
        }
    }

    /// When the host wants `handle_timeout`, or a poll for a packet, at the latest.
    pub fn poll_timeout(&self) -> Duration {
        self.request.map_or(self.next_ping, |(_, due)| due)
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<HostEvent> {
        let first = self.events[0].take();
        self.events.rotate_left(1);
        first
    }

    /// Writes the next packet into `bytes` and returns it; `None` when there is none to send now.
    /// `values` writes the newest struct of an in port into the slice.
    pub fn poll_packet<'b>(
        &mut self,
        now: Duration,
        mut values: impl FnMut(usize, &mut [u8]),
        bytes: &'b mut [u8; PACKET_MAX],
    ) -> Option<&'b [u8]> {
        if let Some(index) = self.published.pop() {
            let port = self.config.ports.as_ref()[index];
            let mut value = [0; DATA_MAX];
            let value = &mut value[..usize::from(port.size())];
            values(index, value);
            return Some(self.encode(None, (port.object(), port.id()), value, bytes));
        }
        if self.request.is_some() {
            return None;
        }
        let request = self.next_request(now)?;
        let mut data = [0; DATA_MAX];
        let (names, length, back) = self.compose(request, &mut data, now);
        self.request = Some((request, now + self.config.exchange_time(length, back)));
        let sequence = (request == Request::Command).then_some(self.sequence);
        Some(self.encode(sequence, names, &data[..length], bytes))
    }

    /// What is to be asked next. It is called only while no request waits.
    fn next_request(&mut self, now: Duration) -> Option<Request> {
        match self.phase {
            Phase::Greeting => return Some(Request::Hello),
            Phase::Matching(index) => return Some(Request::Describe(index)),
            Phase::Probing | Phase::Serving | Phase::Refused => {}
        }
        if self.restart == Restart::Wanted {
            return Some(Request::Restart);
        }
        let silent = self.outstanding.is_some() && self.misses % 3 == 2;
        if self.waiting && !silent {
            return Some(Request::Poll(FRAMES_PER_POLL));
        }
        if self.outstanding.is_some() && !silent && now < self.next_forced_ping {
            return Some(Request::Command);
        }
        if silent || now >= self.next_ping || self.outstanding.is_some() {
            self.ping_number = self.ping_number.wrapping_add(1);
            return Some(Request::Ping(self.ping_number));
        }
        None
    }

    /// Writes the request's data; returns command 0 and 1, and the data's length and the reply's.
    fn compose(
        &mut self,
        request: Request,
        data: &mut [u8; DATA_MAX],
        now: Duration,
    ) -> ((u8, u8), usize, usize) {
        let (message, length, back) = match request {
            Request::Ping(number) => {
                self.next_ping = now + self.pause();
                data[0] = number;
                (message::PING, 1, 4)
            }
            Request::Poll(frames) => {
                self.waiting = false;
                data[0] = frames;
                let outs = self.config.ports.as_ref().iter();
                let outs = outs.filter(|port| port.kind() == PortKind::Out);
                let largest = outs.map(|port| usize::from(port.size())).max().unwrap_or(2);
                // Around each struct there are eight bytes.
                (message::POLL, 1, usize::from(frames) * (largest.max(2) + 8) + 4)
            }
            Request::Hello => {
                let deadman_ms = self.config.deadman.as_millis().min(u16::MAX.into()) as u16;
                data[..2].copy_from_slice(&self.session.to_le_bytes());
                data[2..4].copy_from_slice(&deadman_ms.to_le_bytes());
                let objects = self.config.ports.as_ref().iter().map(|port| port.object()).max();
                (message::HELLO, 4, 10 + usize::from(objects.unwrap_or(1)))
            }
            Request::Describe(index) => {
                data[0] = index;
                (message::DESCRIBE, 1, 8)
            }
            Request::Restart => {
                self.restart = Restart::Sent;
                data[..4].copy_from_slice(&self.device_type().to_le_bytes());
                (message::RESTART, 4, 1)
            }
            Request::Command => {
                let command = self.outstanding.as_mut().expect("a command is outstanding");
                command.sent = true;
                data.copy_from_slice(&self.command_data);
                let names = (command.object, command.message);
                return (names, command.length, 1 + command.reply.1);
            }
        };
        ((message::LINK, message), length, back)
    }

    /// A refused device is restarted by its own type, which may be another than the expected one.
    fn device_type(&self) -> u32 {
        self.identity.map_or(self.config.device_type, |identity| identity.device_type)
    }

    fn pause(&self) -> Duration {
        let interval = self.config.interval;
        if self.phase == Phase::Refused {
            // Pings feed the dead-man, and a device that is refused must not stay active.
            interval.max(self.config.deadman * 2)
        } else if self.lost && self.config.address.is_some() {
            interval * LOST_ROUNDS
        } else {
            interval
        }
    }

    fn encode<'b>(
        &self,
        sequence: Option<u8>,
        (object, message): (u8, u8),
        data: &[u8],
        bytes: &'b mut [u8; PACKET_MAX],
    ) -> &'b [u8] {
        let address = self.config.address;
        let packet = DevicePacket { address, from_device: false, sequence, object, message, data };
        packet.encode(self.session, bytes)
    }

    fn link_packet(&mut self, message: u8, data: &[u8], now: Duration) {
        let Some((request, _)) = self.request else { return };
        match (message, request, data) {
            (
                message::PING,
                Request::Ping(n) | Request::Poll(n),
                &[number, boot, flags, session],
            ) if n == number => {
                self.answered(now);
                self.next_forced_ping = now + self.config.interval * FORCED_PING;
                // A device with much to send does not keep a command from more than one turn.
                let polled = matches!(request, Request::Poll(_)) && self.outstanding.is_some();
                self.waiting = flags & message::FLAG_WAITING != 0 && !polled;
                self.pong(boot, flags, session);
            }
            (
                message::HELLO,
                Request::Hello,
                &[0, b0, b1, cause, t0, t1, t2, t3, data_max, objects, ref states @ ..],
            ) if states.len() == usize::from(objects) => {
                self.answered(now);
                let identity = DeviceIdentity {
                    boot: u16::from_le_bytes([b0, b1]),
                    cause: ResetCause::from_byte(cause).unwrap_or(ResetCause::Unknown),
                    device_type: u32::from_le_bytes([t0, t1, t2, t3]),
                    data_max,
                    objects,
                    reset: false,
                };
                self.greeted(identity, states);
            }
            (message::DESCRIBE, Request::Describe(index), &[status])
                if Status::from_byte(status) == Some(Status::End) =>
            {
                self.answered(now);
                self.described(index);
            }
            (
                message::DESCRIBE,
                Request::Describe(index),
                &[0, object, id, size, f0, f1, f2, f3],
            ) => {
                let record =
                    Port::from_record(object, id, size, u32::from_le_bytes([f0, f1, f2, f3]));
                if self.previous != Some(record) {
                    self.answered(now);
                    self.previous = Some(record);
                    self.record(index, record);
                }
            }
            (message::RESTART, Request::Restart, &[_]) => {
                self.answered(now);
                self.restart = Restart::None;
            }
            _ => {}
        }
    }

    fn pong(&mut self, boot: u8, flags: u8, session: u8) {
        let has_session = flags & message::FLAG_SESSION != 0;
        let faults = flags >> 4;
        if let Some(identity) = self.identity {
            self.reset_seen |= !has_session || boot != low(identity.boot);
        }
        let ours = self.phase != Phase::Probing && has_session && session == low(self.session);
        if !ours {
            self.faults = faults;
            self.greet(session);
        } else if self.phase == Phase::Serving && faults != self.faults {
            // A STATE event was lost. The reply to HELLO lists the states; a command comes first.
            self.faults = faults;
            self.event_lost = true;
            self.refresh();
        }
        if self.restart == Restart::Sent {
            self.restart = Restart::Wanted;
        }
    }

    fn refresh(&mut self) {
        if self.event_lost && self.outstanding.is_none() {
            self.greet(low(self.session));
        }
    }

    fn greeted(&mut self, mut identity: DeviceIdentity, states: &[u8]) {
        let rebooted = self.identity.is_some_and(|known| known.boot != identity.boot);
        identity.reset = core::mem::take(&mut self.reset_seen) || rebooted;
        self.identity = Some(identity);
        self.sequence = 0;
        self.states = [None; OBJECTS_MAX];
        for (known, byte) in self.states.iter_mut().zip(states) {
            *known = DeviceState::from_byte(*byte);
        }
        self.push(HostEvent::Greeted(identity));
        if identity.device_type != self.config.device_type {
            self.refuse(Mismatch::Type(identity.device_type));
        } else if self.contract_matches && !identity.reset {
            self.serve();
        } else {
            self.previous = None;
            self.matched = PortSet::default();
            self.phase = Phase::Matching(0);
        }
    }

    fn record(&mut self, index: u8, record: Port) {
        let ports = self.config.ports.as_ref();
        if let Some(at) = Port::find(ports, record.object(), record.id()) {
            let expected = ports[at];
            if (expected.size(), expected.fingerprint()) != (record.size(), record.fingerprint()) {
                return self.refuse(Mismatch::Port(at, record));
            }
            self.matched.insert(at);
        }
        match index.checked_add(1) {
            Some(next) => self.phase = Phase::Matching(next),
            None => self.described(index),
        }
    }

    /// A chip that is too small for a port table has an empty one; its type alone must match.
    fn described(&mut self, records: u8) {
        let ports = 0..self.config.ports.as_ref().len();
        let missing = ports.into_iter().find(|port| !self.matched.contains(*port));
        match missing.filter(|_| records > 0) {
            Some(port) => self.refuse(Mismatch::Missing(port)),
            None => self.serve(),
        }
    }

    fn serve(&mut self) {
        self.contract_matches = true;
        self.phase = Phase::Serving;
        self.push(HostEvent::Serving);
    }

    fn refuse(&mut self, mismatch: Mismatch) {
        self.contract_matches = false;
        self.phase = Phase::Refused;
        self.push(HostEvent::Refused(mismatch));
    }

    fn state_event(&mut self, object: u8, data: &[u8]) {
        let &[state, code] = data else { return };
        let Some(state) = DeviceState::from_byte(state) else { return };
        let known = usize::from(object).checked_sub(1).and_then(|at| self.states.get_mut(at));
        let Some(known) = known else { return };
        *known = Some(state);
        self.faults = (self.faults + 1) % 16;
        self.push(HostEvent::State { object, state, code });
    }

    fn data(&mut self, object: u8, message: u8, data: &[u8]) {
        let ports = self.config.ports.as_ref();
        let Some(port) = Port::find(ports, object, message) else { return };
        let (kind, size) = (ports[port].kind(), usize::from(ports[port].size()));
        if kind == PortKind::Out && size == data.len() {
            self.keep(data);
            self.push(HostEvent::Data { port });
        }
    }

    fn reply(&mut self, data: &[u8], now: Duration) {
        let Some(command) = self.outstanding else { return };
        let [status, payload @ ..] = data else { return };
        let Some(status) = Status::from_byte(*status) else { return };
        let is_change = (message::LIFECYCLE..message::START).contains(&command.message);
        let (least, most) = match status {
            Status::Well => command.reply,
            Status::WrongState | Status::HookFailed if is_change => (1, 1),
            _ => (0, 0),
        };
        if !(least..=most).contains(&payload.len()) {
            return;
        }
        self.answered(now);
        if status == Status::OutOfStep {
            self.push(HostEvent::OutOfStep);
            return self.greet(low(self.session));
        }
        if is_change && let &[state] = payload {
            let known = usize::from(command.object).checked_sub(1);
            if let Some(known) = known.and_then(|at| self.states.get_mut(at)) {
                *known = DeviceState::from_byte(state);
            }
        }
        self.keep(payload);
        self.outstanding = None;
        self.push(HostEvent::Done(CommandOutcome::Replied(status)));
        self.refresh();
    }

    /// Notes a sign of life.
    fn answered(&mut self, now: Duration) {
        self.request = None;
        self.misses = 0;
        self.heard = now;
        self.lost = false;
        self.estimate(false);
    }

    fn estimate(&mut self, missed: bool) {
        let (asked, failed) = (self.asked.0 + 1, self.asked.1 + u32::from(missed));
        self.asked = (asked, failed);
        if asked < ESTIMATE_AFTER {
            return;
        }
        self.asked = (0, 0);
        let needed = Tries::needed(failed, asked, self.config.interval);
        if self.config.tries == Tries::Auto {
            self.tries = needed;
        } else if needed > self.tries {
            let failed_per_mille = (failed * 1_000 / asked) as u16;
            self.push(HostEvent::TooFewTries { needed, failed_per_mille });
        }
    }

    fn lose(&mut self) {
        if !self.lost {
            self.lost = true;
            self.push(HostEvent::Lost);
        }
        self.end_session();
        self.phase = Phase::Probing;
    }

    /// Opens a new session, whose lower byte differs from that of the device's present one: a PONG
    /// tells the two apart.
    fn greet(&mut self, present: u8) {
        self.end_session();
        loop {
            self.session = self.session.wrapping_add(1);
            if self.session != 0 && low(self.session) != present {
                break;
            }
        }
        self.phase = Phase::Greeting;
    }

    fn end_session(&mut self) {
        self.request = None;
        self.restart = Restart::None;
        self.waiting = false;
        self.event_lost = false;
        // A value from before an interruption must not move an actuator after it.
        self.published = PortSet::default();
        if let Some(command) = self.outstanding.take() {
            let outcome =
                if command.sent { CommandOutcome::Unknown } else { CommandOutcome::NotSent };
            self.push(HostEvent::Done(outcome));
        }
    }

    fn keep(&mut self, payload: &[u8]) {
        self.payload_length = payload.len();
        self.payload[..payload.len()].copy_from_slice(payload);
    }

    fn push(&mut self, event: HostEvent) {
        let free = self.events.iter_mut().find(|place| place.is_none());
        debug_assert!(free.is_some(), "the driver takes all events after each input");
        if let Some(place) = free {
            *place = Some(event);
        }
    }
}

fn low(number: u16) -> u8 {
    number.to_le_bytes()[0]
}
