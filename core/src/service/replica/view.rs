//! What a replica shows of itself.

use super::super::view::{ServiceState, ServiceView};
use super::*;

impl Replica {
    /// What this replica knows of its service now.
    pub fn view(&self) -> ServiceView {
        let primary = match &self.role {
            Acting::Primary(_) => Some(self.config.own.clone()),
            Acting::Standby(standby) => standby.primary.clone(),
        };
        let unheard = |member: &&NodeName| {
            **member != self.config.own && !self.accord.reached.contains(*member)
        };
        ServiceView {
            state: self.state_shown(),
            epoch: self.epoch,
            primary,
            unheard: self.config.members.iter().filter(unheard).cloned().collect(),
            unprotected: self.faults.contains_key(&FaultKind::Unreplicated),
        }
    }

    fn state_shown(&self) -> ServiceState {
        let Acting::Standby(standby) = &self.role else { return ServiceState::Primary };
        match (self.health, self.role()) {
            (Health::Gone { .. }, _) => ServiceState::Resting,
            (_, Role::Standby { primary: None, .. }) if self.accord.is_hopeless() => {
                ServiceState::Fenced
            }
            (_, Role::Standby { primary: None, .. }) => ServiceState::Candidate,
            _ if standby.learns() => ServiceState::Learner,
            (_, Role::Standby { in_step: true, .. }) => ServiceState::Standby,
            _ => ServiceState::Behind,
        }
    }
}
