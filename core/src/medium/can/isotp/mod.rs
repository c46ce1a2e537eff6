//! Messages longer than a CAN frame: ISO 15765-2 (2016), between all the nodes of one bus.
//!
//! ```text
//! sender                                receiver
//!   ├─ first: 1,000 bytes, the first 6 ───►│
//!   │◄──── flow: go on, 8 at a time, 1 ms ─┤
//!   ├─ consecutive 1 ─────────────────────►│
//!   ├─ … 8 ───────────────────────────────►│
//!   │◄──────── flow: go on ────────────────┤
//!   ├─ consecutive 9 …  ──────────────────►│
//! ```
//!
//! * Between two nodes one message is under way at a time in each direction; between different
//!   pairs any number. Where several of ours go out, frames take turns.
//! * To all nodes a message goes without flow control, at a fixed pace. The standard knows only
//!   single frames to all; longer messages go as Linux sends them (`CAN_ISOTP_CF_BROADCAST`).
//! * All messages that wait for a target that does not answer are dropped: they would be too old
//!   when it is back.
//! * A receiver of another make may let a sender wait. This one does not: its user takes every
//!   message, or drops it.
//!
//! Nothing is repeated here: a message that fails is reported and gone. ISO 15765-2 has no check
//! over a message, only that of each frame; a user that wants one puts it into the message.

mod config;
mod pdu;
mod reception;
mod transmission;

pub use config::IsoTpConfig;
pub use pdu::{FlowControl, FlowStatus, Pdu, PduWriter, SHORT_LENGTH_MAX, SeparationTime};
pub use reception::ReceptionError;
pub use transmission::TransmissionError;

use self::reception::{FrameResult, Reception, ReceptionContext};
use self::transmission::{TargetType, Transmission};
use super::address::{AddressInfo, BusAddress};
use super::frame::{CanFrame, Format};
use crate::medium::lane::FrameLane;
use crate::sorted::SortedMap;
use crate::{Instant, Machine};
use bytes::Bytes;
use std::collections::VecDeque;

/// Why a message is not taken to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EnqueueError {
    /// It is for this node itself.
    #[error("{to} is the address of this node itself")]
    Ourselves {
        /// The address that was given.
        to: BusAddress,
    },
    /// It is longer than `message_max`, or empty, which ISO 15765-2 cannot say.
    #[error("a message has 1 to {limit} bytes, this one {length}")]
    Length {
        /// Of the message.
        length: usize,
        /// The configured `message_max`, in bytes.
        limit: usize,
    },
    /// Too much waits for the target already.
    #[error("the queue towards {to} is full")]
    Full {
        /// The address with the full queue.
        to: BusAddress,
    },
}

/// What an [`IsoTp`] has to say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsoTpOutput {
    /// A message arrived.
    Received {
        /// The address of the sender.
        from: BusAddress,
        /// The whole message.
        message: Bytes,
    },
    /// A message is out; its receiver may have got it.
    Sent {
        /// The address that it was sent to.
        to: BusAddress,
    },
    /// A message is not out.
    NotSent {
        /// The address that it was for.
        to: BusAddress,
        /// Why it was not sent.
        error: TransmissionError,
        /// How many others that waited for the same target are gone with it.
        with_it: u64,
    },
    /// A message is lost on its way in, or a frame belongs to none.
    NotReceived {
        /// The address of the sender.
        from: BusAddress,
        /// Why it was not received.
        error: ReceptionError,
    },
    /// Another node sends under this node's address, or the bus hands back what this node sent.
    AddressTaken,
    /// A frame that ISO 15765-2 does not know, or flow control that was not asked for.
    Refused,
}

/// The machine of one node on one bus.
///
/// It hands out frames only as the bus takes them, by [`poll_frame`](IsoTp::poll_frame): nothing
/// piles up between it and the bus.
#[derive(Debug)]
pub struct IsoTp {
    own: BusAddress,
    config: IsoTpConfig,
    outgoing: SortedMap<BusAddress, Lane>,
    /// What is under way to us, by source, and whether it is to all.
    incoming: SortedMap<(BusAddress, bool), Reception>,
    /// Whose frame went out last.
    last: BusAddress,
    outputs: VecDeque<IsoTpOutput>,
}

/// What goes to one target.
#[derive(Debug, Default)]
struct Lane {
    current: Option<Transmission>,
    /// Goes before the waiting.
    urgent: VecDeque<Bytes>,
    waiting: VecDeque<Bytes>,
}

impl IsoTp {
    /// A node with this address; `None` where no node can have it.
    pub fn new(own: BusAddress, config: IsoTpConfig) -> Option<Self> {
        (own != BusAddress::ALL).then(|| IsoTp {
            own,
            config,
            outgoing: SortedMap::new(),
            incoming: SortedMap::new(),
            last: BusAddress::ALL,
            outputs: VecDeque::new(),
        })
    }

    /// Takes a message to be sent. One that must not wait goes before the others that wait for the
    /// same target, and has as much room as all of them.
    ///
    /// # Errors
    /// [`EnqueueError`]; the message is dropped.
    pub fn handle_message(
        &mut self,
        to: BusAddress,
        message: Bytes,
        priority: FrameLane,
        now: Instant,
    ) -> Result<(), EnqueueError> {
        if to == self.own {
            return Err(EnqueueError::Ourselves { to });
        }
        let (length, limit) = (message.len(), self.config.message_max);
        if length == 0 || length > limit {
            return Err(EnqueueError::Length { length, limit });
        }
        let lane = self.outgoing.entry(to).or_default();
        if lane.current.is_none() {
            lane.current = Some(Transmission::new(message, target(to), now));
            return Ok(());
        }
        let queue = match priority {
            FrameLane::Usual => &mut lane.waiting,
            FrameLane::Hello | FrameLane::Urgent => &mut lane.urgent,
        };
        if queue.len() >= self.config.queue_messages {
            return Err(EnqueueError::Full { to });
        }
        queue.push_back(message);
        Ok(())
    }

    /// A frame came from the bus.
    pub fn handle_frame(&mut self, frame: &CanFrame, now: Instant) {
        // Others are of other things on the bus: no fault at all.
        let Some(AddressInfo { source, target }) = AddressInfo::of(frame.id()) else { return };
        if source == self.own {
            return self.outputs.push_back(IsoTpOutput::AddressTaken);
        }
        let to_all = target == BusAddress::ALL;
        if !to_all && target != self.own {
            return;
        }
        match Pdu::decode(frame.data()) {
            Some(Pdu::Flow(flow)) => self.handle_flow(source, to_all, flow, now),
            Some(pdu) => self.handle_content(source, to_all, pdu, now),
            None => self.outputs.push_back(IsoTpOutput::Refused),
        }
    }

    fn handle_flow(&mut self, source: BusAddress, to_all: bool, flow: FlowControl, now: Instant) {
        let lane = self.outgoing.get_mut(&source).filter(|_| !to_all);
        let current = lane.and_then(|lane| lane.current.as_mut());
        let asked = current.is_some_and(|current| current.handle_flow(flow, now));
        if !asked {
            self.outputs.push_back(IsoTpOutput::Refused);
        }
        self.settle(source, now);
    }

    fn handle_content(&mut self, from: BusAddress, to_all: bool, pdu: Pdu<'_>, now: Instant) {
        let key = (from, to_all);
        let target = if to_all { TargetType::All } else { TargetType::One };
        let admitted =
            self.incoming.contains_key(&key) || self.incoming.len() < self.config.receptions_max;
        let context = ReceptionContext { config: &self.config, now };
        let reception = self.incoming.entry(key).or_insert_with(|| Reception::new(target));
        let result = match pdu {
            Pdu::Single(data) => reception.handle_single(data),
            Pdu::First { length, data } => reception.handle_first(length, data, admitted, context),
            Pdu::Consecutive { sequence, data } => {
                reception.handle_consecutive(sequence, data, context)
            }
            Pdu::Flow(_) => FrameResult::default(),
        };
        if reception.is_idle() {
            self.incoming.remove(&key);
        }
        let FrameResult { failed, message } = result;
        if let Some(error) = failed {
            self.fail(from, error);
        }
        if let Some(message) = message {
            self.outputs.push_back(IsoTpOutput::Received { from, message });
        }
    }

    /// The next frame that is to go out now, if any. Ask only when the bus takes one: it counts as
    /// sent.
    pub fn poll_frame(&mut self, now: Instant) -> Option<CanFrame> {
        self.poll_answer(now).or_else(|| self.poll_message(now))
    }

    /// Others wait for our word: it goes before what we have to say ourselves.
    fn poll_answer(&mut self, now: Instant) -> Option<CanFrame> {
        let (&(source, to_all), reception) =
            self.incoming.iter_mut().find(|(_, reception)| reception.is_ready())?;
        let writer = writer(self.own, source, self.config.format);
        let context = ReceptionContext { config: &self.config, now };
        let frame = reception.poll_frame(&writer, context);
        if reception.is_idle() {
            self.incoming.remove(&(source, to_all));
        }
        frame
    }

    /// Whose frame is next: the first target after the last one that has one.
    fn turn(&self) -> Option<BusAddress> {
        let ready = |(_, lane): &(&BusAddress, &Lane)| {
            lane.current.as_ref().is_some_and(Transmission::is_ready)
        };
        let after = (std::ops::Bound::Excluded(self.last), std::ops::Bound::Unbounded);
        let mut rest = self.outgoing.range(after).chain(self.outgoing.range(..=self.last));
        rest.find(ready).map(|(to, _)| *to)
    }

    fn poll_message(&mut self, now: Instant) -> Option<CanFrame> {
        let to = self.turn()?;
        let writer = writer(self.own, to, self.config.format);
        let current = self.outgoing.get_mut(&to)?.current.as_mut()?;
        let frame = current.poll_frame(&writer, now);
        self.last = to;
        self.settle(to, now);
        frame
    }

    /// Looks whether the message to this target has ended, and begins the next.
    fn settle(&mut self, to: BusAddress, now: Instant) {
        let Some(lane) = self.outgoing.get_mut(&to) else { return };
        let Some(result) = lane.current.as_ref().and_then(Transmission::ended) else { return };
        if matches!(result, Err(TransmissionError::Unanswered | TransmissionError::BusStuck)) {
            let with_it = (lane.urgent.len() + lane.waiting.len()) as u64;
            let error = result.expect_err("it was one a moment ago");
            self.outgoing.remove(&to);
            self.outputs.push_back(IsoTpOutput::NotSent { to, error, with_it });
            return;
        }
        self.outputs.push_back(match result {
            Ok(()) => IsoTpOutput::Sent { to },
            Err(error) => IsoTpOutput::NotSent { to, error, with_it: 0 },
        });
        match lane.urgent.pop_front().or_else(|| lane.waiting.pop_front()) {
            Some(message) => {
                lane.current = Some(Transmission::new(message, target(to), now));
            }
            None => drop(self.outgoing.remove(&to)),
        }
    }

    fn fail(&mut self, from: BusAddress, error: ReceptionError) {
        self.outputs.push_back(IsoTpOutput::NotReceived { from, error });
    }
}

fn writer(own: BusAddress, target: BusAddress, format: Format) -> PduWriter {
    let id = AddressInfo { source: own, target }.id();
    PduWriter { id: id.expect("this node has an address"), format }
}

fn target(to: BusAddress) -> TargetType {
    if to == BusAddress::ALL { TargetType::All } else { TargetType::One }
}

impl Machine for IsoTp {
    type Output = IsoTpOutput;

    fn poll_output(&mut self) -> Option<IsoTpOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let out = self.outgoing.values().filter_map(|lane| lane.current.as_ref()?.poll_timeout());
        out.chain(self.incoming.values().filter_map(Reception::poll_timeout)).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        let due = |lane: &Lane| {
            let timeout = lane.current.as_ref().and_then(Transmission::poll_timeout);
            timeout.is_some_and(|due| due <= now)
        };
        let late: Vec<BusAddress> =
            self.outgoing.iter().filter(|(_, lane)| due(lane)).map(|(to, _)| *to).collect();
        for to in late {
            let current = self.outgoing.get_mut(&to).and_then(|lane| lane.current.as_mut());
            if let Some(current) = current {
                current.handle_timeout(now);
            }
            self.settle(to, now);
        }
        let mut failed = Vec::new();
        for ((from, _), reception) in &mut self.incoming {
            failed.extend(reception.handle_timeout(now).map(|error| (*from, error)));
        }
        self.incoming.retain(|_, reception| !reception.is_idle());
        failed.into_iter().for_each(|(from, error)| self.fail(from, error));
    }
}

#[cfg(test)]
mod tests;
