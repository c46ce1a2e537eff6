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
            **member != self.config.own
                && self.agreement.known.get(*member).is_none_or(|known| !known.seen)
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
        if let RoleState::Primary(_) = self.role {
            return ServiceState::Primary;
        }
        match (self.health, self.role()) {
            (Health::Inactive { .. }, _) => ServiceState::Resting,
            (_, Role::Standby { primary: None, .. }) if self.agreement.is_disputed() => {
                ServiceState::Fenced
            }
            (_, Role::Standby { primary: None, .. }) => ServiceState::Candidate,
            (_, Role::Standby { in_step: true, .. }) => ServiceState::Standby,
            _ => ServiceState::Behind,
        }
    }
}
