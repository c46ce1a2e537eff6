//! A commander's right to move an actuator, which ends by itself.
//!
//! ```text
//!            claim              lease over, released, or stopped
//!   Free ─────────────► Held ───────────────────────────────────► Settling
//!    ▲                   │ ▲                                         │ safe command carried out,
//!    │                   └─┘ renewed, commanded                      │ and cut-off returned
//!    └───────────────────────────────────────────────────────────────┘
//! ```
//!
//! The lease is counted where the actuator is, on its clock alone: whatever becomes of the
//! commander, its process or the cable, the safe outputs are applied there when the lease is over.
//! Every claim that is granted has a greater epoch than any before; what comes under an older one
//! is refused.
//!
//! A command counts for the command timeout, and while the incarnation lasts that it was given to.
//! Then the safe command is given once. The commander keeps its lease, which being alive renews,
//! and its next command counts again. The cut-off is called once where the component does not take
//! the safe command.
//!
//! While the component leaves work in order, claims are refused, and an actuator that has carried
//! out a command gets its stop command. The cut-off is called only where that fails or comes too
//! late.
//!
//! A policy for lost communication takes the lease without a cut-off, and holds it over all its
//! rungs. Meanwhile the rung's command takes the place of the safe command and the cut-off of a
//! lease that ends. It is given until it is carried out, and again as often as the command timeout
//! asks for. The cut-off is called once where it is not carried out in time. A lease that ends for
//! the sake of a policy, or before its first rung, ends with the safe command, and with the cut-off
//! only where the component does not take that. One that its commander gives back ends as any.

use crate::{DeliveryError, Incarnation, Instant, Machine, ObjectName};
use std::collections::VecDeque;
use std::time::Duration;

/// How long a component has to begin its safe command before it is looked at: one beat.
const BEAT: Duration = Duration::from_millis(10);
/// How long a component has to carry out the command of a rung, unless its `max_wait` is longer. A
/// shorter time cuts an actuator off whose component is only being restarted.
const RUNG_WITHIN: Duration = Duration::from_secs(1);
/// How often it is looked at whether the command of a rung is to be given again.
const RUNG_INTERVAL: Duration = Duration::from_millis(100);

/// The identity of a commander.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommanderId {
    /// Its name, unique in the robot.
    pub name: String,
    /// The commander's incarnation.
    pub incarnation: Incarnation,
}

/// A right to command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeaseGrant {
    /// Stands in every command.
    pub epoch: u64,
    /// For how long it holds unless it is renewed.
    pub span: Duration,
}

/// Why an actuator is brought to rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RestCause {
    /// The last command has counted for as long as it may, or its incarnation has failed. The
    /// commander keeps its lease.
    CommandTimeout,
    /// The commander was silent for too long.
    Expired,
    /// The commander gave it back.
    Released,
    /// The component leaves work in order.
    Stopped,
    /// A policy for lost communication commands it, under this number.
    Rung(u64),
}

/// What stops an actuator whose component leaves work in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopBy {
    /// The safe command.
    SafeCommand,
    /// A command of its own, which the safe command does not replace: a drone that hovers is to
    /// land.
    StopCommand,
    /// The component's hook `on_deactivated`.
    Hook,
}

/// What an actuator's lease goes by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeaseRules {
    /// How long a lease holds unless it is renewed.
    pub span: Duration,
    /// How long a command counts; `None` for ever.
    pub command_timeout: Option<Duration>,
    /// How long the component has to begin the safe command of a command timeout while it could.
    pub max_wait: Duration,
    /// What stops the actuator in order.
    pub stop_by: StopBy,
}

/// The status of a lease, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseStatus {
    /// There is no commander; the outputs are safe.
    Free,
    /// A commander holds the lease.
    Held {
        /// The commander that holds it.
        commander: CommanderId,
        /// The epoch of the lease.
        epoch: u64,
        /// How long the lease still holds unless it is renewed.
        left: Duration,
    },
    /// The safe or the stop command is being carried out.
    Settling {
        /// The commander whose lease has ended.
        commander: CommanderId,
    },
}

/// An output of the lease's machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseOutput {
    /// Give the safe command, or the stop command where the cause is [`RestCause::Stopped`], and
    /// tell [`Lease::handle_applied`] what came of it.
    Apply {
        /// The commander whose lease ends.
        commander: CommanderId,
        /// The epoch of the lease.
        epoch: u64,
        /// Why the lease ends.
        cause: RestCause,
        /// It has been tried before.
        again: bool,
    },
    /// The safe command has not been carried out yet: tell [`Lease::handle_check`] whether the
    /// component still serves what it served before. It is asked every beat after a command
    /// timeout, and from its limit on where the lease has ended for a policy.
    CheckTaken {
        /// The component has had its `max_wait` to begin it.
        is_late: bool,
    },
    /// Call the cut-off, and tell [`Lease::handle_cut_off_returned`] when it has returned, or at
    /// once where the actuator has none.
    CutOff {
        /// Why it is called.
        cause: RestCause,
    },
}

/// The lease of one actuator.
#[derive(Debug)]
pub struct Lease {
    actuator: ObjectName,
    rules: LeaseRules,
    last_epoch: u64,
    /// The last one.
    commander: CommanderId,
    state: State,
    /// A command was carried out, and since then none that stops the actuator.
    moves: bool,
    /// Until when the last command counts; `None` where none does, or for ever.
    counts_until: Option<Instant>,
    rest: RestDebt,
    work: Work,
    policy: RungState,
    outputs: VecDeque<LeaseOutput>,
}

/// What brings the actuator to rest.
#[derive(Debug, Default)]
struct RestDebt {
    /// What was given and has not been carried out.
    given: Option<RestCause>,
    /// By when that is owed, unless the actuator is cut off.
    owed: Option<Owed>,
    /// Cut-offs that are still to be called, or run: they would stop the actuator under its next
    /// commander.
    cut_offs: u32,
    /// It has been cut off, and since then the component has taken neither a command nor one that
    /// brings it to rest.
    is_cut: bool,
}

/// What policies for lost communication do with the lease.
#[derive(Debug, Default)]
struct RungState {
    /// A policy has rungs for the actuator.
    has_rungs: bool,
    /// The policy that holds the lease.
    rung: Option<RungHold>,
    /// How many commands rungs had.
    rungs: u64,
}

/// What the component owes.
#[derive(Clone, Copy, Debug)]
struct Owed {
    by: Instant,
    /// It has to be begun by then, and from here on to go on: both are looked at every beat. `None`
    /// where it has to be carried out by then.
    look_at: Option<Instant>,
}

/// The hold of a policy for lost communication.
#[derive(Debug)]
struct RungHold {
    policy: CommanderId,
    /// This commander may claim the lease, and the policy has it back after it.
    yields_to: Option<String>,
    /// When to look whether the command is to be given again.
    again_at: Instant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Free,
    Held { due: Instant },
    Settling,
}

/// Whether the component is at work, as far as its actuators know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Work {
    /// The component is at work.
    Goes,
    /// It leaves work, has left it, or was never at work. Whether how the actuator stops is still open.
    Ends { stops: bool },
}

impl Lease {
    /// A lease of `actuator` without a holder. Epochs are above `last_epoch`; let it rise with
    /// every incarnation of the node, so that commands from before are known as such.
    pub fn new(actuator: ObjectName, rules: LeaseRules, last_epoch: u64) -> Self {
        Lease {
            actuator,
            rules,
            last_epoch,
            commander: CommanderId { name: String::new(), incarnation: Incarnation(0) },
            state: State::Free,
            moves: false,
            counts_until: None,
            rest: RestDebt::default(),
            work: Work::Ends { stops: false },
            policy: RungState::default(),
            outputs: VecDeque::new(),
        }
    }

    /// How it stands at `now`.
    pub fn status(&self, now: Instant) -> LeaseStatus {
        let (commander, epoch) = (self.commander.clone(), self.last_epoch);
        match (&self.state, &self.policy.rung) {
            (State::Held { due }, _) => LeaseStatus::Held { commander, epoch, left: *due - now },
            (_, Some(RungHold { policy, .. })) => {
                LeaseStatus::Held { commander: policy.clone(), epoch, left: self.rules.span }
            }
            (State::Free, None) => LeaseStatus::Free,
            (State::Settling, None) => LeaseStatus::Settling { commander },
        }
    }

    /// The commander that holds the lease, which a policy for lost communication is not.
    pub fn commander(&self) -> Option<&CommanderId> {
        matches!(self.state, State::Held { .. }).then_some(&self.commander)
    }

    /// A commander claims the lease.
    ///
    /// # Errors
    /// [`DeliveryError::Held`] while another one does, or a policy for lost communication; a later
    /// incarnation of the same commander takes over from the one before.
    /// [`DeliveryError::Restarting`] while the safe command is being carried out, the cut-off has
    /// not returned, or the component is not at work.
    pub fn handle_claim(
        &mut self,
        commander: CommanderId,
        now: Instant,
    ) -> Result<LeaseGrant, DeliveryError> {
        self.expire(now);
        let held = |holder: &CommanderId| {
            let by = format!("{}{}", holder.name, holder.incarnation);
            Err(DeliveryError::Held { actuator: self.actuator.to_string(), by })
        };
        match (&self.state, &self.policy.rung) {
            (State::Settling, _) => return Err(DeliveryError::Restarting),
            _ if self.work != Work::Goes => return Err(DeliveryError::Restarting),
            (_, Some(rung)) if rung.yields_to.as_ref() != Some(&commander.name) => {
                return held(&rung.policy);
            }
            // The command of the rung comes first.
            (State::Free, _) if self.rest.cut_offs > 0 || self.rest.owed.is_some() => {
                return Err(DeliveryError::Restarting);
            }
            (State::Held { .. }, _)
                if self.commander.name != commander.name
                    || self.commander.incarnation > commander.incarnation =>
            {
                return held(&self.commander);
            }
            (State::Free | State::Held { .. }, _) => {}
        }
        self.last_epoch += 1;
        self.commander = commander;
        self.state = State::Held { due: now + self.rules.span };
        Ok(LeaseGrant { epoch: self.last_epoch, span: self.rules.span })
    }

    /// The commander renews the lease: its time starts again.
    ///
    /// # Errors
    /// [`DeliveryError::Superseded`] where another claim holds, [`DeliveryError::LeaseEnded`] where
    /// none does.
    pub fn handle_renewal(&mut self, epoch: u64, now: Instant) -> Result<(), DeliveryError> {
        self.expire(now);
        let span = self.rules.span;
        match &mut self.state {
            State::Held { due } if epoch == self.last_epoch => {
                *due = now + span;
                Ok(())
            }
            State::Held { .. } => Err(DeliveryError::Superseded { epoch: self.last_epoch }),
            State::Free | State::Settling => {
                Err(DeliveryError::LeaseEnded { actuator: self.actuator.to_string() })
            }
        }
    }

    /// The commander's command is handed to the component, and counts from now on.
    pub fn handle_command(&mut self, now: Instant) {
        (self.moves, self.rest.given, self.rest.owed) = (true, None, None);
        self.counts_until = self.rules.command_timeout.map(|timeout| now + timeout);
    }

    /// Whether the component has begun the safe command of a command timeout, or could have.
    pub fn handle_check(&mut self, is_taken: bool) {
        if !is_taken && self.rest.owed.take_if(|owed| owed.look_at.is_some()).is_some() {
            self.miss();
        }
    }

    /// The commander gives the lease back.
    pub fn handle_release(&mut self, epoch: u64) {
        if epoch == self.last_epoch {
            self.end(RestCause::Released, None);
        }
    }

    /// A policy for lost communication ends the lease of a commander that is meant.
    pub fn handle_suspended(&mut self, is_meant: impl Fn(&CommanderId) -> bool, now: Instant) {
        if self.commander().is_some_and(is_meant) {
            self.end(RestCause::Released, Some(now));
        }
    }

    /// A policy for lost communication has rungs for the actuator.
    pub fn handle_policy(&mut self) {
        self.policy.has_rungs = true;
    }

    /// A policy for lost communication takes the lease for its next command, or holds it already:
    /// no cut-off is called and no safe command given. A rung that yields to a commander lets it
    /// claim the lease, and has it back, with the last command, when that ends.
    pub fn handle_rung(&mut self, policy: CommanderId, yields_to: Option<String>, now: Instant) {
        let holder = self.commander().map(|holder| &holder.name);
        let is_taken = holder.is_some() && holder != yields_to.as_ref();
        if is_taken {
            self.state = State::Free;
        }
        if let Some(rung) = self.policy.rung.as_mut().filter(|_| yields_to.is_some() && !is_taken) {
            rung.yields_to = yields_to;
            return;
        }
        self.policy.rungs += 1;
        self.policy.rung = Some(RungHold { policy, yields_to, again_at: now + RUNG_INTERVAL });
        if self.give_rung(false) {
            // What the rung before has not carried out has no new limit.
            self.owe(now);
        }
    }

    /// The policy for lost communication lets others command again: the actuator gets its safe
    /// command, and is not cut off unless it does not carry that out.
    pub fn handle_rungs_over(&mut self, now: Instant) {
        if self.policy.rung.take().is_some() && self.work == Work::Goes {
            self.state = State::Settling;
            self.give(RestCause::Released, false);
            self.rest.owed = None;
            self.owe(now);
        }
    }

    /// The node enters the safe state: whatever commands the actuator ends.
    pub fn handle_rest(&mut self) {
        let is_held = self.policy.rung.take().is_some() || self.commander().is_some();
        // A safe command that has not been carried out yet is not waited for any more.
        let is_owed = self.rest.given.is_some() && !self.rest.is_cut;
        if (is_held || is_owed) && self.work == Work::Goes {
            self.bring_to_rest(RestCause::Released);
        }
        self.handle_stop_failed();
    }

    /// What was given has to be carried out, unless something is owed already.
    fn owe(&mut self, now: Instant) {
        let by = now + self.rules.max_wait.max(RUNG_WITHIN);
        self.rest.owed.get_or_insert(Owed { by, look_at: None });
    }

    /// Gives the rung's command, if one counts and the component is at work. Says whether it did.
    fn give_rung(&mut self, again: bool) -> bool {
        let is_held = self.commander().is_some();
        let Some(rung) = self.policy.rung.as_ref().filter(|_| !is_held) else { return false };
        if self.work == Work::Goes {
            (self.commander, self.moves) = (rung.policy.clone(), true);
            self.give(RestCause::Rung(self.policy.rungs), again);
        }
        self.work == Work::Goes
    }

    fn look_at_rung(&mut self, now: Instant) {
        // Also what an incarnation owes that has failed after it was carried out.
        let is_owed = self.rest.given.is_some() && !self.rest.is_cut && self.work == Work::Goes;
        if is_owed && self.policy.rung.is_some() && self.commander().is_none() {
            self.owe(now);
        }
        if let Some(rung) = self.policy.rung.as_mut().filter(|rung| now >= rung.again_at) {
            let interval = self.rules.command_timeout.map(|timeout| timeout / 3);
            // Three commands in a timeout tolerate two late ones.
            rung.again_at = now + interval.unwrap_or(RUNG_INTERVAL);
            if interval.is_some() && self.rest.given.is_none() {
                self.give_rung(true);
            }
        }
        if self.rest.owed.take_if(|owed| owed.look_at.is_none() && now >= owed.by).is_some() {
            // One that leaves work in order is stopped.
            if let (Some(cause), Work::Goes) = (self.rest.given, self.work) {
                self.cut_off(cause);
            }
        }
    }

    /// The safe, the stop, or a rung's command that was given for this cause was carried out, or
    /// could not be.
    pub fn handle_applied(&mut self, cause: RestCause, applied: bool) {
        self.rest.is_cut &= !applied;
        // Another one may have taken its place.
        if self.rest.given != Some(cause) {
            return;
        }
        match applied {
            true => {
                self.moves &= match cause {
                    RestCause::Rung(_) => true,
                    RestCause::Stopped => false,
                    _ => self.rules.stop_by == StopBy::StopCommand,
                };
                self.rest.given = None;
                // A commanded handler that fails after its reply has not gone on with it.
                let is_held = self.commander().is_some();
                self.rest.owed.take_if(|owed| owed.look_at.is_none() || !is_held);
                self.free_once_settled();
            }
            false if cause == RestCause::Stopped => self.handle_stop_failed(),
            // It is given again when the component is at work again.
            false => self.handle_check(false),
        }
    }

    /// The cut-off has returned, panicked, or is absent.
    pub fn handle_cut_off_returned(&mut self) {
        self.rest.cut_offs = self.rest.cut_offs.saturating_sub(1);
        // It may have ended what the rung's command began.
        if self.rest.cut_offs == 0 {
            self.give_rung(true);
        }
        self.free_once_settled();
    }

    /// The component is at work, at first or again.
    pub fn handle_at_work(&mut self) {
        self.work = Work::Goes;
        if self.give_rung(true) {
            // A new incarnation may have switched on what was cut off.
            self.rest.is_cut = false;
            return;
        }
        match self.rest.given {
            Some(cause) => self.give(cause, true),
            // The next command reaches an incarnation that owes nothing.
            None => self.rest.is_cut = false,
        }
    }

    /// The component leaves work in order: the lease ends, and none is granted before the component
    /// is at work again.
    pub fn handle_leaving(&mut self) {
        if self.work == Work::Goes {
            self.work = Work::Ends { stops: self.moves };
            self.state = State::Settling;
            (self.rest.given, self.rest.owed) = (None, None);
            if self.moves { self.give(RestCause::Stopped, false) } else { self.free_once_settled() }
        }
    }

    /// Whether the component leaves work, and this actuator is being stopped.
    pub fn is_stopping(&self) -> bool {
        self.work == Work::Ends { stops: true }
    }

    /// The stop command, or the work that follows it, has failed.
    pub fn handle_stop_failed(&mut self) {
        if self.is_stopping() {
            self.work = Work::Ends { stops: false };
            (self.state, self.moves, self.rest.given) = (State::Settling, false, None);
            self.cut_off(RestCause::Stopped);
        }
    }

    /// The component goes on no longer after its stop command.
    pub fn handle_settled(&mut self) {
        if self.rules.stop_by != StopBy::Hook && self.rest.given.is_none() {
            self.handle_stopped();
        }
    }

    /// The component has left work, or its work has failed: its hook has, or has not, ended well.
    pub fn handle_left(&mut self, hook_done: bool) {
        match hook_done && self.rules.stop_by == StopBy::Hook {
            true => self.handle_stopped(),
            false => self.handle_stop_failed(),
        }
        // It may have been the safe command that failed.
        self.handle_check(hook_done);
        // What it was commanded counts no more: it has its safe command to carry out when it is at
        // work again.
        if !hook_done && self.work == Work::Goes && self.moves {
            self.counts_until = None;
            self.rest.given.get_or_insert(RestCause::CommandTimeout);
        }
    }

    /// The incarnation has ended, and none follows at once.
    pub fn handle_ended(&mut self) {
        self.handle_left(false);
        if self.rest.given.is_some() && self.moves {
            self.miss();
        }
    }

    /// The actuator has been stopped in order.
    fn handle_stopped(&mut self) {
        if self.is_stopping() {
            self.work = Work::Ends { stops: false };
            (self.moves, self.rest.given) = (false, None);
            self.free_once_settled();
        }
    }

    fn free_once_settled(&mut self) {
        if self.state == State::Settling && self.rest.given.is_none() && self.rest.cut_offs == 0 {
            self.state = State::Free;
        }
    }

    /// Ends a lease: where it ends in order, by the safe command, which is looked at from then on.
    fn end(&mut self, cause: RestCause, in_order_at: Option<Instant>) {
        match (&self.state, &self.policy.rung, in_order_at) {
            (State::Held { .. }, Some(_), _) => {
                self.state = State::Free;
                self.give_rung(false);
            }
            (State::Held { .. }, None, Some(now)) => {
                // The safe command of a command timeout that is late already has no new limit.
                let by = now + self.rules.max_wait.min(RUNG_WITHIN);
                let earlier = self.rest.owed.take_if(|owed| owed.look_at.is_some());
                let by = earlier.map_or(by, |earlier| by.min(earlier.by));
                self.state = State::Settling;
                self.give(cause, false);
                // A handler that is busy meanwhile cuts nothing off: a drone goes on hovering.
                self.rest.owed = Some(Owed { by, look_at: Some(by) });
            }
            (State::Held { .. }, None, None) => self.bring_to_rest(cause),
            (State::Free | State::Settling, ..) => {}
        }
    }

    fn bring_to_rest(&mut self, cause: RestCause) {
        (self.state, self.rest.owed) = (State::Settling, None);
        self.cut_off(cause);
        self.give(cause, false);
    }

    fn expire(&mut self, now: Instant) {
        if let State::Held { due } = self.state
            && now >= due
        {
            self.end(RestCause::Expired, self.policy.has_rungs.then_some(now));
        }
    }

    /// The component does not take its safe command.
    fn miss(&mut self) {
        if !self.rest.is_cut {
            self.cut_off(RestCause::CommandTimeout);
        }
    }

    fn cut_off(&mut self, cause: RestCause) {
        self.rest.cut_offs += 1;
        self.rest.is_cut = true;
        self.outputs.push_back(LeaseOutput::CutOff { cause });
    }

    fn give(&mut self, cause: RestCause, again: bool) {
        (self.rest.given, self.counts_until) = (Some(cause), None);
        self.rest.owed.take_if(|owed| owed.look_at.is_some());
        let (commander, epoch) = (self.commander.clone(), self.last_epoch);
        self.outputs.push_back(LeaseOutput::Apply { commander, epoch, cause, again });
    }
}

impl Machine for Lease {
    type Output = LeaseOutput;

    fn poll_output(&mut self) -> Option<LeaseOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let rung = self.policy.rung.as_ref().map(|rung| rung.again_at);
        let held = match self.state {
            State::Held { due } => [Some(due), self.counts_until],
            State::Free | State::Settling => [None; 2],
        };
        let owed = self.rest.owed.map(|owed| owed.look_at.unwrap_or(owed.by));
        held.into_iter().chain([rung, owed]).flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.expire(now);
        self.look_at_rung(now);
        let is_held = matches!(self.state, State::Held { .. });
        if is_held && self.counts_until.is_some_and(|until| now >= until) {
            self.give(RestCause::CommandTimeout, false);
            self.rest.owed =
                Some(Owed { by: now + self.rules.max_wait, look_at: Some(now + BEAT) });
        } else if let Some(Owed { by, look_at: Some(at) }) = self.rest.owed
            && now >= at
        {
            self.rest.owed = self.rest.given.map(|_| Owed { by, look_at: Some(now + BEAT) });
            let is_late = now >= by;
            self.outputs.extend(self.rest.given.map(|_| LeaseOutput::CheckTaken { is_late }));
        }
    }
}

#[cfg(test)]
mod tests;
