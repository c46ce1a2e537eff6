//! A commander's right to move an actuator, which ends by itself.
//!
//! ```text
//!            claim              lease over, or released
//!   Free ─────────────► Held ───────────────────────────► Settling
//!    ▲                   │ ▲                                 │ safe outputs applied,
//!    │                   └─┘ renewed, commanded              │ and cut-off returned
//!    └───────────────────────────────────────────────────────┘
//! ```
//!
//! The lease is counted where the actuator is, on its clock alone: whatever becomes of the
//! commander, its process or the cable, the safe outputs are applied there when the lease is over.
//! Every claim that is granted has a greater epoch than any before; what comes under an older one
//! is refused.

use crate::{DeliveryError, Incarnation, Instant, Machine, ObjectName};
use std::collections::VecDeque;
use std::time::Duration;

/// How soon safe outputs that did not get through are applied again: one beat.
const RETRY: Duration = Duration::from_millis(10);

/// The identity of a commander.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommanderId {
    /// Its name, unique in the robot.
    pub name: String,
    /// In which incarnation.
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

/// Why a lease ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeaseEnd {
    /// The commander was silent for too long.
    Expired,
    /// The commander gave it back.
    Released,
}

/// The status of a lease, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseStatus {
    /// There is no commander; the outputs are safe.
    Free,
    /// A commander holds the lease.
    Held {
        /// Who.
        commander: CommanderId,
        /// Under which epoch.
        epoch: u64,
        /// How long the lease still holds unless it is renewed.
        left: Duration,
    },
    /// The safe outputs are being applied.
    Settling {
        /// Who commanded until then.
        commander: CommanderId,
    },
}

/// An output of the lease's machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LeaseOutput {
    /// Apply the safe outputs, and tell [`Lease::handle_applied`] what came of it. Where this is
    /// not a retry, call the cut-off as well, and tell [`Lease::handle_cut_off_returned`] when it
    /// has returned, or at once where the actuator has none.
    ApplySafeOutputs {
        /// Who commanded until now.
        commander: CommanderId,
        /// Under which epoch.
        epoch: u64,
        /// Why no longer.
        end: LeaseEnd,
        /// It has been tried before.
        again: bool,
    },
}

/// The lease of one actuator.
#[derive(Debug)]
pub struct Lease {
    actuator: ObjectName,
    span: Duration,
    last_epoch: u64,
    state: State,
    outputs: VecDeque<LeaseOutput>,
}

#[derive(Debug)]
enum State {
    Free,
    Held { commander: CommanderId, due: Instant },
    Settling { commander: CommanderId, end: LeaseEnd, retry: Option<Instant>, awaited: Awaited },
}

/// What the next claim waits for. A cut-off that is still to be called, or runs, would stop the
/// actuator under its next commander.
#[derive(Clone, Copy, Debug)]
struct Awaited {
    safe_outputs: bool,
    cut_off: bool,
}

impl Lease {
    /// A lease of `actuator` without a holder. Epochs are above `last_epoch`; let it rise with
    /// every incarnation of the node, so that commands from before are known as such.
    pub fn new(actuator: ObjectName, span: Duration, last_epoch: u64) -> Self {
        Lease { actuator, span, last_epoch, state: State::Free, outputs: VecDeque::new() }
    }

    /// Returns the holder of the lease and its epoch.
    pub fn holder(&self) -> Option<(&CommanderId, u64)> {
        match &self.state {
            State::Held { commander, .. } => Some((commander, self.last_epoch)),
            State::Free | State::Settling { .. } => None,
        }
    }

    /// How it stands at `now`.
    pub fn status(&self, now: Instant) -> LeaseStatus {
        match &self.state {
            State::Free => LeaseStatus::Free,
            State::Held { commander, due } => LeaseStatus::Held {
                commander: commander.clone(),
                epoch: self.last_epoch,
                left: *due - now,
            },
            State::Settling { commander, .. } => {
                LeaseStatus::Settling { commander: commander.clone() }
            }
        }
    }

    /// A commander claims the lease.
    ///
    /// # Errors
    /// [`DeliveryError::Held`] while another one does; a later incarnation of the same commander
    /// takes over from the one before. [`DeliveryError::Restarting`] while safe outputs are being
    /// applied, or the cut-off has not returned.
    pub fn handle_claim(
        &mut self,
        commander: CommanderId,
        now: Instant,
    ) -> Result<LeaseGrant, DeliveryError> {
        self.handle_timeout(now);
        match &self.state {
            State::Settling { .. } => return Err(DeliveryError::Restarting),
            State::Held { commander: holder, .. }
                if holder.name != commander.name || holder.incarnation > commander.incarnation =>
            {
                let by = format!("{}{}", holder.name, holder.incarnation);
                let actuator = self.actuator.to_string();
                return Err(DeliveryError::Held { actuator, by });
            }
            State::Free | State::Held { .. } => {}
        }
        self.last_epoch += 1;
        self.state = State::Held { commander, due: now + self.span };
        Ok(LeaseGrant { epoch: self.last_epoch, span: self.span })
    }

    /// The commander renews the lease, or commands: the lease's time starts again.
    ///
    /// # Errors
    /// [`DeliveryError::Superseded`] where another claim holds, [`DeliveryError::LeaseEnded`] where
    /// none does.
    pub fn handle_renewal(&mut self, epoch: u64, now: Instant) -> Result<(), DeliveryError> {
        self.handle_timeout(now);
        let span = self.span;
        match &mut self.state {
            State::Held { due, .. } if epoch == self.last_epoch => {
                *due = now + span;
                Ok(())
            }
            State::Held { .. } => Err(DeliveryError::Superseded { epoch: self.last_epoch }),
            State::Free | State::Settling { .. } => {
                Err(DeliveryError::LeaseEnded { actuator: self.actuator.to_string() })
            }
        }
    }

    /// The commander gives the lease back.
    pub fn handle_release(&mut self, epoch: u64) {
        if epoch == self.last_epoch {
            self.end(LeaseEnd::Released);
        }
    }

    /// The safe outputs were applied, or could not be.
    pub fn handle_applied(&mut self, applied: bool, now: Instant) {
        if let State::Settling { retry, awaited, .. } = &mut self.state {
            match applied {
                true => awaited.safe_outputs = false,
                false => *retry = Some(now + RETRY),
            }
        }
        self.free_once_settled();
    }

    /// The cut-off has returned, panicked, or is absent.
    pub fn handle_cut_off_returned(&mut self) {
        if let State::Settling { awaited, .. } = &mut self.state {
            awaited.cut_off = false;
        }
        self.free_once_settled();
    }

    fn free_once_settled(&mut self) {
        if let State::Settling {
            awaited: Awaited { safe_outputs: false, cut_off: false }, ..
        } = self.state
        {
            self.state = State::Free;
        }
    }

    fn end(&mut self, end: LeaseEnd) {
        if let State::Held { commander, .. } = &self.state {
            let commander = commander.clone();
            self.apply(&commander, end, false);
            let awaited = Awaited { safe_outputs: true, cut_off: true };
            self.state = State::Settling { commander, end, retry: None, awaited };
        }
    }

    fn apply(&mut self, commander: &CommanderId, end: LeaseEnd, again: bool) {
        let (commander, epoch) = (commander.clone(), self.last_epoch);
        self.outputs.push_back(LeaseOutput::ApplySafeOutputs { commander, epoch, end, again });
    }
}

impl Machine for Lease {
    type Output = LeaseOutput;

    fn poll_output(&mut self) -> Option<LeaseOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        match &self.state {
            State::Free => None,
            State::Held { due, .. } => Some(*due),
            State::Settling { retry, .. } => *retry,
        }
    }

    fn handle_timeout(&mut self, now: Instant) {
        match &mut self.state {
            State::Held { due, .. } if now >= *due => self.end(LeaseEnd::Expired),
            State::Settling { commander, end, retry, .. }
                if retry.is_some_and(|due| now >= due) =>
            {
                *retry = None;
                let (commander, end) = (commander.clone(), *end);
                self.apply(&commander, end, true);
            }
            State::Free | State::Held { .. } | State::Settling { .. } => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPAN: Duration = Duration::from_millis(100);

    fn ms(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn who(name: &str, incarnation: u64) -> CommanderId {
        CommanderId { name: name.into(), incarnation: Incarnation(incarnation) }
    }

    fn held() -> (Lease, u64) {
        let mut lease = Lease::new(ObjectName::new("wheel").unwrap(), SPAN, 7);
        let grant = lease.handle_claim(who("planner", 1), ms(0)).unwrap();
        assert_eq!(grant, LeaseGrant { epoch: 8, span: SPAN });
        (lease, grant.epoch)
    }

    fn ended() -> Result<(), DeliveryError> {
        Err(DeliveryError::LeaseEnded { actuator: "wheel".into() })
    }

    fn held_by(commander: &str) -> Result<LeaseGrant, DeliveryError> {
        Err(DeliveryError::Held { actuator: "wheel".into(), by: commander.into() })
    }

    fn applied(lease: &mut Lease) -> Option<(LeaseEnd, bool)> {
        let LeaseOutput::ApplySafeOutputs { end, again, .. } = lease.poll_output()?;
        Some((end, again))
    }

    #[test]
    fn every_state_is_shown() {
        let (mut lease, epoch) = held();
        let commander = who("planner", 1);
        let (now, left) = (ms(40), SPAN - Duration::from_millis(40));
        let held = LeaseStatus::Held { commander: commander.clone(), epoch, left };
        assert_eq!(lease.status(now), held);
        lease.handle_timeout(ms(100));
        assert_eq!(lease.status(ms(100)), LeaseStatus::Settling { commander });
        lease.handle_applied(true, ms(101));
        lease.handle_cut_off_returned();
        assert_eq!(lease.status(ms(102)), LeaseStatus::Free);
    }

    #[test]
    fn safe_outputs_are_applied_when_the_lease_is_over_and_not_before() {
        let (mut lease, epoch) = held();
        lease.handle_renewal(epoch, ms(60)).unwrap();

        lease.handle_timeout(ms(159));
        assert_eq!(applied(&mut lease), None);
        assert_eq!(lease.poll_timeout(), Some(ms(160)));
        lease.handle_timeout(ms(160));

        assert_eq!(applied(&mut lease), Some((LeaseEnd::Expired, false)));
        assert_eq!(lease.holder(), None);
        assert_eq!(lease.handle_renewal(epoch, ms(161)), ended());
    }

    #[test]
    fn a_late_command_ends_the_lease_itself_where_the_timer_was_later_still() {
        let (mut lease, epoch) = held();
        assert_eq!(lease.handle_renewal(epoch, ms(100)), ended());
        assert_eq!(applied(&mut lease), Some((LeaseEnd::Expired, false)));
    }

    #[test]
    fn a_second_commander_is_refused_while_the_lease_holds_and_until_all_is_safe() {
        let (mut lease, epoch) = held();
        let held = held_by("planner#1");
        assert_eq!(lease.handle_claim(who("console", 1), ms(99)), held);

        let settling = lease.handle_claim(who("console", 1), ms(100));
        assert_eq!(settling, Err(DeliveryError::Restarting));
        assert_eq!(applied(&mut lease), Some((LeaseEnd::Expired, false)));
        lease.handle_applied(true, ms(101));
        lease.handle_cut_off_returned();
        let grant = lease.handle_claim(who("console", 1), ms(102)).unwrap();

        assert!(grant.epoch > epoch);
        assert_eq!(
            lease.handle_renewal(epoch, ms(103)),
            Err(DeliveryError::Superseded { epoch: grant.epoch })
        );
        lease.handle_release(epoch);
        assert_eq!(lease.holder(), Some((&who("console", 1), grant.epoch)));
    }

    #[test]
    fn no_commander_is_granted_the_lease_before_the_cut_off_has_returned() {
        let (mut lease, epoch) = held();
        lease.handle_release(epoch);
        let claim = |lease: &mut Lease| lease.handle_claim(who("console", 1), ms(12));

        lease.handle_applied(true, ms(11));
        assert_eq!(claim(&mut lease), Err(DeliveryError::Restarting));
        lease.handle_cut_off_returned();
        let epoch = claim(&mut lease).unwrap().epoch;

        lease.handle_release(epoch);
        lease.handle_cut_off_returned();
        assert_eq!(claim(&mut lease), Err(DeliveryError::Restarting));
        lease.handle_applied(true, ms(13));
        assert!(claim(&mut lease).is_ok());
    }

    #[test]
    fn the_next_incarnation_of_a_commander_takes_over_and_fences_the_one_before() {
        let (mut lease, old) = held();
        let grant = lease.handle_claim(who("planner", 2), ms(10)).unwrap();
        assert_eq!(
            lease.handle_renewal(old, ms(11)),
            Err(DeliveryError::Superseded { epoch: grant.epoch })
        );
        let late = lease.handle_claim(who("planner", 1), ms(12));
        assert_eq!(late, held_by("planner#2"));
        assert_eq!(applied(&mut lease), None);
    }

    #[test]
    fn safe_outputs_that_did_not_get_through_are_applied_again_and_again() {
        let (mut lease, epoch) = held();
        lease.handle_release(epoch);
        assert_eq!(applied(&mut lease), Some((LeaseEnd::Released, false)));
        for round in 1..100 {
            lease.handle_applied(false, ms(10 * round));
            lease.handle_timeout(ms(10 * round + 9));
            assert_eq!(applied(&mut lease), None);
            lease.handle_timeout(ms(10 * round + 10));
            assert_eq!(applied(&mut lease), Some((LeaseEnd::Released, true)));
        }
        lease.handle_applied(true, ms(2000));
        assert_eq!(lease.poll_timeout(), None);
    }
}
