//! The view of a replica, for display.

use super::super::view::{ServiceState, ServiceView};
use super::*;

impl Replica {
    /// Returns what this replica knows of its service now.
    pub fn view(&self) -> ServiceView {
        let primary = match &self.role {
            RoleState::Primary(_) => Some(self.config.own.clone()),
            RoleState::Standby(standby) => standby.primary.clone(),
        };
        let unreachable = |member: &&NodeName| {
            **member != self.config.own && !self.agreement.reachable.contains(*member)
        };
        ServiceView {
            state: self.state_shown(),
            epoch: self.epoch,
            primary,
            unreachable: self.config.members.iter().filter(unreachable).cloned().collect(),
            unreplicated: self.faults.contains_key(&FaultKind::Unreplicated),
        }
    }

    fn state_shown(&self) -> ServiceState {
        let RoleState::Standby(standby) = &self.role else { return ServiceState::Primary };
        match (self.health, self.role()) {
            (Health::Inactive { .. }, _) => ServiceState::Resting,
            (_, Role::Standby { primary: None, .. }) if self.agreement.is_fenced() => {
                ServiceState::Fenced
            }
            (_, Role::Standby { primary: None, .. }) => ServiceState::Candidate,
            _ if standby.is_learner() => ServiceState::Learner,
            (_, Role::Standby { in_step: true, .. }) => ServiceState::Standby,
            _ => ServiceState::Behind,
        }
    }
}
