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
//! Between two HELLOs a command is therefore carried out at most once, and exactly once if its
//! reply arrives. A reset erases the device's memory. Exactly once over crashes is then impossible
//! (Fekete, Lynch, Mansour, Spinelli, J. ACM 40(5), 1993): the command ends as
//! [`Unknown`](CommandOutcome::Unknown). The medium may lose, repeat and reorder packets. It must
//! not delay one by 7 further commands, or past the next HELLO: a late HELLO opens its session again,
//! in which a late copy of a command is carried out a second time.
//!
//! **One exchange.** At most one request waits for its answer. After two unanswered commands a PING
//! follows: a device that was reset answers nothing else.

mod command;
mod config;
mod event;
mod matching;
mod mirror;
mod pings;
mod tries;

pub use command::{CommandError, DeviceCommand};
pub use config::HostConfig;
pub use event::{CommandOutcome, DeviceIdentity, HostEvent};
pub use matching::Mismatch;
pub use tries::Tries;

use crate::message::{self, DeviceState, Status};
use crate::packet::{DATA_MAX, DevicePacket, OBJECTS_MAX, PACKET_MAX};
use crate::port::{Port, PortKind, PortSet};
use command::CommandSlot;
use core::time::Duration;
use event::EventQueue;
use matching::{Matching, MatchingStep};
use mirror::Mirror;
use pings::PingSchedule;
use tries::LossEstimate;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Probing,
    Greeting,
    Matching(Matching),
    Serving,
    Refused,
}

/// A kind of request, with its answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Exchange {
    Ping,
    Poll,
    Hello,
    Describe,
    Restart,
    Command,
}

/// A request that waits for its answer.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    exchange: Exchange,
    /// The first byte of its data, which an answer of the link repeats.
    first: u8,
    due: Duration,
}

/// RESTART is sent again only after a PONG has shown that the device is still in the session: a
/// second one would reset the chip a second time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RestartOrder {
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
/// for all hosts of the line. Nothing is sent that is not polled: when the driver hangs, the device
/// is stopped by its dead-man.
#[derive(Clone, Debug)]
pub struct Host<P> {
    config: HostConfig<P>,
    phase: Phase,
    session: u16,
    exchange: Option<Waiting>,
    answers: AnswerRecord,
    pings: PingSchedule,
    mirror: Mirror,
    contract_matches: bool,
    restart: RestartOrder,
    work: SessionWork,
    payload: ReplyPayload,
    events: EventQueue,
}

/// How the device answers.
#[derive(Clone, Debug)]
struct AnswerRecord {
    /// Unanswered requests in a row.
    misses: u32,
    /// When the device last answered.
    received: Duration,
    lost: bool,
    loss: LossEstimate,
    out_of_turn: u32,
}

/// What is still to be done in the session.
#[derive(Clone, Debug)]
struct SessionWork {
    /// Frames wait for a POLL.
    waiting: bool,
    /// A STATE event was lost: the states are read again.
    event_lost: bool,
    published: PortSet,
    command: CommandSlot,
}

/// The payload of the last reply or data.
#[derive(Clone, Debug)]
struct ReplyPayload {
    data: [u8; DATA_MAX],
    length: usize,
}

/// A command is abandoned after so many times the tries that declare a silent device lost: a device
/// that answers pings but not the command is faulty.
const COMMAND_ROUNDS: u32 = 4;

/// A device of a multi-drop line that is lost is asked in every tenth round, so that it does not
/// cost the others its slot each time.
const LOST_ROUNDS: u32 = 10;

impl<P: AsRef<[Port]>> Host<P> {
    /// A host that begins to look for its device.
    pub fn new(config: HostConfig<P>, now: Duration) -> Self {
        let loss = LossEstimate::new(config.tries);
        Host {
            session: config.session,
            config,
            phase: Phase::Probing,
            exchange: None,
            answers: AnswerRecord { misses: 0, received: now, lost: false, loss, out_of_turn: 0 },
            pings: PingSchedule::new(now),
            mirror: Mirror::new(),
            contract_matches: false,
            restart: RestartOrder::None,
            work: SessionWork {
                waiting: false,
                event_lost: false,
                published: PortSet::default(),
                command: CommandSlot::new(),
            },
            payload: ReplyPayload { data: [0; DATA_MAX], length: 0 },
            events: EventQueue::default(),
        }
    }

    /// Returns the configuration that the host was made with.
    pub fn config(&self) -> &HostConfig<P> {
        &self.config
    }

    /// Whether commands and values flow.
    pub fn is_serving(&self) -> bool {
        self.phase == Phase::Serving
    }

    /// Whether the device has been declared lost and has not entered a session since.
    pub fn is_lost(&self) -> bool {
        self.answers.lost
    }

    /// Whether a request waits for its answer: on a multi-drop line the device has the turn.
    pub fn is_waiting(&self) -> bool {
        self.exchange.is_some()
    }

    /// How many packets the device has sent outside of its turns. They are dropped: a device that
    /// does so disturbs the others of its line.
    pub fn out_of_turn(&self) -> u32 {
        self.answers.out_of_turn
    }

    /// The state of an object, from 1, as the device has last reported it.
    pub fn state(&self, object: u8) -> Option<DeviceState> {
        self.mirror.state(object)
    }

    /// The bytes that belong to the last [`HostEvent::Data`] or [`HostEvent::Done`].
    pub fn payload(&self) -> &[u8] {
        &self.payload.data[..self.payload.length]
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
        self.work.command.accept(command, self.config.ports.as_ref())
    }

    /// Announces a new value of an in port. It is sent once, without an answer; the host asks for
    /// it when it sends, so that the newest value goes. On media that reorder packets, give a
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
        self.work.published.insert(port);
        Ok(())
    }

    /// Restarts the chip of a device that serves or is refused; it is greeted as a new incarnation.
    /// The outstanding command ends as unknown. The order is dropped when the device is lost.
    pub fn handle_restart(&mut self) {
        if matches!(self.phase, Phase::Serving | Phase::Refused) {
            self.restart = RestartOrder::Wanted;
        }
    }

    /// Declares the device lost at once: its line is closed or unplugged.
    pub fn handle_line_closed(&mut self) {
        self.exchange = None;
        self.lose();
    }

    /// Takes the bytes of one packet. Bytes that are no packet of this device are dropped.
    pub fn handle_packet(&mut self, bytes: &[u8], now: Duration) {
        let address = self.config.address;
        let Some(packet) = DevicePacket::decode(bytes, address.is_some(), self.session) else {
            return;
        };
        if !packet.from_device || packet.address != address {
            return;
        }
        if address.is_some() && self.exchange.is_none() {
            self.answers.out_of_turn = self.answers.out_of_turn.saturating_add(1);
            return;
        }
        match (packet.sequence, packet.object, packet.message) {
            (None, message::LINK, message) => self.link_packet(message, packet.data, now),
            // Events count only in a session that the device has confirmed.
            (None, ..) if matches!(self.phase, Phase::Probing | Phase::Greeting) => {}
            (None, object, message::STATE) => self.state_event(object, packet.data),
            (None, object, message) => self.data(object, message, packet.data),
            (Some(_), ..) => self.reply(&packet, now),
        }
    }

    /// Lets the host act on everything that is due.
    pub fn handle_timeout(&mut self, now: Duration) {
        let Some(Waiting { exchange, .. }) = self.exchange.filter(|waiting| waiting.due <= now)
        else {
            return;
        };
        self.exchange = None;
        self.answers.misses = self.answers.misses.saturating_add(1);
        self.estimate(true);
        // Repetitions follow each other faster than pings; the silence must be as long all the
        // same.
        let silence = self.config.interval * self.answers.loss.tries().into();
        if self.answers.misses >= self.answers.loss.tries().into()
            && now.saturating_sub(self.answers.received) >= silence
        {
            self.lose();
        } else if exchange == Exchange::Command
            && self.work.command.miss() >= COMMAND_ROUNDS * u32::from(self.answers.loss.tries())
        {
            self.greet(low(self.session));
        }
    }

    /// When `handle_timeout`, and a poll for a packet, are due at the latest.
    pub fn poll_timeout(&self) -> Duration {
        self.exchange.map_or(self.pings.due(), |waiting| waiting.due)
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<HostEvent> {
        self.events.pop()
    }

    /// Writes the next packet into `bytes` and returns it; `None` when there is none to send now.
    /// `values` writes the newest struct of an in port into the slice.
    pub fn poll_packet<'b>(
        &mut self,
        now: Duration,
        mut values: impl FnMut(usize, &mut [u8]),
        bytes: &'b mut [u8; PACKET_MAX],
    ) -> Option<&'b [u8]> {
        let session = self.session;
        let mut data = [0; DATA_MAX];
        if let Some(index) = self.work.published.pop() {
            let port = self.config.ports.as_ref()[index];
            let value = &mut data[..usize::from(port.size())];
            values(index, value);
            let packet = DevicePacket {
                object: port.object(),
                message: port.id(),
                data: value,
                ..DevicePacket::to_device(self.config.address)
            };
            return Some(packet.encode(session, bytes));
        }
        if self.exchange.is_some() {
            return None;
        }
        let exchange = self.next_exchange(now)?;
        let (packet, back) = self.compose(exchange, &mut data, now)?;
        let first = packet.data.first().copied().unwrap_or(0);
        let (out, packet) = (packet.data.len(), packet.encode(session, bytes));
        let due = now + self.config.exchange_time(out, back);
        self.exchange = Some(Waiting { exchange, first, due });
        Some(packet)
    }

    /// What is to be asked next. It is called only while no request waits.
    fn next_exchange(&self, now: Duration) -> Option<Exchange> {
        match self.phase {
            Phase::Greeting => return Some(Exchange::Hello),
            Phase::Matching(_) => return Some(Exchange::Describe),
            Phase::Probing | Phase::Serving | Phase::Refused => {}
        }
        if self.restart == RestartOrder::Wanted {
            return Some(Exchange::Restart);
        }
        let silent = self.work.command.is_taken() && self.answers.misses % 3 == 2;
        // A POLL restarts the dead-man, which must stop a refused device.
        if self.work.waiting && self.phase == Phase::Serving && !silent {
            return Some(Exchange::Poll);
        }
        if self.work.command.is_taken() && !silent && !self.pings.is_forced(now) {
            return Some(Exchange::Command);
        }
        let due = silent || now >= self.pings.due() || self.work.command.is_taken();
        due.then_some(Exchange::Ping)
    }

    /// The packet of a request, and the most bytes of its answer's data.
    fn compose<'d>(
        &'d mut self,
        request: Exchange,
        data: &'d mut [u8; DATA_MAX],
        now: Duration,
    ) -> Option<(DevicePacket<'d>, usize)> {
        let address = self.config.address;
        let (message, length, back) = match request {
            Exchange::Ping => {
                let rounds = if self.answers.lost && address.is_some() { LOST_ROUNDS } else { 1 };
                let serves = self.phase == Phase::Serving;
                data[0] = self.pings.send(serves, now, self.config.interval * rounds);
                (message::PING, 1, 4)
            }
            Exchange::Poll => {
                self.work.waiting = false;
                // All at once, so that no port waits behind another that always has something.
                let (events, bytes) = self.config.events();
                data[0] = events;
                (message::POLL, 1, bytes + 4)
            }
            Exchange::Hello => {
                let deadman_ms = self.config.deadman.as_millis().min(u16::MAX.into()) as u16;
                data[..2].copy_from_slice(&self.session.to_le_bytes());
                data[2..4].copy_from_slice(&deadman_ms.to_le_bytes());
                // A device may have more objects than have ports here: their states come too late
                // for a first HELLO, and on a multi-drop line outside of the turn.
                let identity = self.mirror.identity();
                let last = identity.map_or(self.config.objects(), |device| device.objects);
                let objects = if self.answers.lost { OBJECTS_MAX } else { last.into() };
                (message::HELLO, 4, 10 + objects)
            }
            Exchange::Describe => {
                let Phase::Matching(matching) = self.phase else { return None };
                data[0] = matching.index();
                (message::DESCRIBE, 1, 8)
            }
            Exchange::Restart => {
                self.restart = RestartOrder::Sent;
                data[..4].copy_from_slice(&self.device_type().to_le_bytes());
                (message::RESTART, 4, 2)
            }
            Exchange::Command => return self.work.command.send(address),
        };
        let data = &data[..length];
        Some((DevicePacket { message, data, ..DevicePacket::to_device(address) }, back))
    }

    /// A refused device is restarted by its own type, which may be another than the expected one.
    fn device_type(&self) -> u32 {
        self.mirror.identity().map_or(self.config.device_type, |identity| identity.device_type)
    }

    fn link_packet(&mut self, message: u8, data: &[u8], now: Duration) {
        let Some(Waiting { exchange, first, .. }) = self.exchange else { return };
        let [number, data @ ..] = data else { return };
        if *number != first {
            return;
        }
        match (message, exchange, data) {
            (message::PING, Exchange::Ping | Exchange::Poll, &[boot, flags, session]) => {
                self.answered(now);
                self.pings.handle_pong(now, self.config.interval);
                // A device with much to send does not keep a command from more than one turn.
                let polled = exchange == Exchange::Poll && self.work.command.is_taken();
                self.work.waiting = flags & message::FLAG_WAITING != 0 && !polled;
                // Until a POLL, reports of faults may still wait on the device.
                let all_reported = exchange == Exchange::Poll || flags & message::FLAG_WAITING == 0;
                let event_lost = self.mirror.handle_pong(boot, flags, all_reported);
                let has_session = flags & message::FLAG_SESSION != 0;
                self.pong(has_session.then_some(session), event_lost);
            }
            (message::HELLO, Exchange::Hello, reply) => {
                if let Some((identity, states)) = DeviceIdentity::from_reply(reply) {
                    self.answered(now);
                    self.greeted(identity, states);
                }
            }
            (message::DESCRIBE, Exchange::Describe, record) => {
                let Phase::Matching(matching) = &mut self.phase else { return };
                let Some(progress) = matching.record(self.config.ports.as_ref(), record) else {
                    return;
                };
                self.answered(now);
                match progress {
                    MatchingStep::Next => {}
                    MatchingStep::Right => self.serve(),
                    MatchingStep::Wrong(mismatch) => self.refuse(mismatch),
                }
            }
            (message::RESTART, Exchange::Restart, &[_]) => {
                self.answered(now);
                self.restart = RestartOrder::None;
            }
            _ => {}
        }
    }

    fn pong(&mut self, session: Option<u8>, event_lost: bool) {
        if self.phase == Phase::Probing || session != Some(low(self.session)) {
            self.greet(session.unwrap_or(0));
        } else if self.phase == Phase::Serving && event_lost {
            // The reply to HELLO lists the states; a command comes first.
            self.work.event_lost = true;
            self.refresh();
        }
        if self.restart == RestartOrder::Sent {
            self.restart = RestartOrder::Wanted;
        }
    }

    fn refresh(&mut self) {
        if self.work.event_lost && !self.work.command.is_taken() {
            self.greet(low(self.session));
        }
    }

    fn greeted(&mut self, identity: DeviceIdentity, states: &[u8]) {
        let identity = self.mirror.handle_hello(identity, states);
        self.answers.lost = false;
        if identity.reset {
            self.restart = RestartOrder::None;
        }
        self.events.push(HostEvent::Greeted(identity));
        if identity.device_type != self.config.device_type {
            self.refuse(Mismatch::Type(identity.device_type));
        } else if self.contract_matches && !identity.reset {
            self.serve();
        } else {
            self.phase = Phase::Matching(Matching::default());
        }
    }

    fn serve(&mut self) {
        self.contract_matches = true;
        self.phase = Phase::Serving;
        self.events.push(HostEvent::Serving);
    }

    fn refuse(&mut self, mismatch: Mismatch) {
        self.contract_matches = false;
        self.phase = Phase::Refused;
        self.events.push(HostEvent::Refused(mismatch));
    }

    fn state_event(&mut self, object: u8, data: &[u8]) {
        if let &[state, code] = data
            && let Some(state) = self.mirror.handle_state(object, state)
        {
            self.events.push(HostEvent::State { object, state, code });
        }
    }

    fn data(&mut self, object: u8, message: u8, data: &[u8]) {
        let ports = self.config.ports.as_ref();
        let Some(port) = Port::find(ports, object, message) else { return };
        let (kind, size) = (ports[port].kind(), usize::from(ports[port].size()));
        let is_serving = self.phase == Phase::Serving;
        if is_serving && kind == PortKind::Out && size == data.len() {
            self.keep(data);
            self.events.push(HostEvent::Data { port });
        }
    }

    fn reply(&mut self, packet: &DevicePacket<'_>, now: Duration) {
        let Some((status, payload)) = self.work.command.reply(packet) else { return };
        self.answered(now);
        if status == Status::OutOfStep {
            self.events.push(HostEvent::OutOfStep);
            return self.greet(low(self.session));
        }
        if (message::LIFECYCLE..message::START).contains(&packet.message)
            && let &[state] = payload
        {
            self.mirror.note_state(packet.object, state);
        }
        self.keep(payload);
        self.work.command.finish();
        self.events.push(HostEvent::Done(CommandOutcome::Replied(status)));
        self.refresh();
    }

    /// Takes the end of an exchange.
    fn answered(&mut self, now: Duration) {
        self.exchange = None;
        self.answers.misses = 0;
        self.answers.received = now;
        self.estimate(false);
    }

    fn estimate(&mut self, missed: bool) {
        // A device that is switched off is no measure of the line.
        if !self.answers.lost {
            self.answers.loss.count(missed, self.config.interval);
        }
    }

    fn lose(&mut self) {
        if !self.answers.lost {
            self.answers.lost = true;
            self.events.push(HostEvent::Lost);
        }
        self.restart = RestartOrder::None;
        self.end_session();
        self.phase = Phase::Probing;
    }

    /// Opens a new session, whose lower byte differs from that of the device's present one: a PONG
    /// shows that byte.
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
        self.exchange = None;
        if self.restart == RestartOrder::Sent {
            self.restart = RestartOrder::None;
        }
        self.work.waiting = false;
        self.work.event_lost = false;
        // A value from before an interruption must not move an actuator after it.
        self.work.published = PortSet::default();
        if let Some(outcome) = self.work.command.end_session() {
            self.events.push(HostEvent::Done(outcome));
        }
    }

    fn keep(&mut self, payload: &[u8]) {
        self.payload.length = payload.len();
        self.payload.data[..payload.len()].copy_from_slice(payload);
    }
}

fn low(number: u16) -> u8 {
    number.to_le_bytes()[0]
}

#[cfg(test)]
mod tests;
