//! The leaves that the engine has itself.

use super::execute::Tick;
use super::{Binding, PortError, TickProblem, Tree, TreeNodeId};
use crate::status::Status;
use crate::value::Value;
use std::time::Duration;

impl Tree {
    /// Copies a value, or the literal text, into an entry whose name a port gives.
    pub(super) fn set_blackboard(&mut self, id: TreeNodeId) -> Tick {
        let to = match self.binding(id, 1).clone() {
            Binding::Key(name) => {
                // The entry holds the name of the entry that is written.
                let Some(name) = self.board.value(name).map(Value::to_string) else {
                    let key = self.board.name(name).to_string();
                    let error = PortError::Unset { port: "output_key".into(), key };
                    return Err(self.error(id, error.into()));
                };
                if self.board.is_full() {
                    return Err(self.error(id, TickProblem::Full));
                }
                self.board.key(self.node(id).board, &name)
            }
            Binding::Entry(key) => key,
            _ => return Ok(Status::Failure),
        };
        let Some(value) = self.raw(id, 0).cloned() else { return Ok(Status::Failure) };
        if let Some(from) = self.key(id, 0) {
            self.board.take_kind(to, from);
        }
        self.board.assign(to, value.clone()).map_err(|kind| {
            let value = value.to_string();
            self.error(id, PortError::Type { port: "value".into(), value, kind }.into())
        })?;
        Ok(Status::Success)
    }

    pub(super) fn unset_blackboard(&mut self, id: TreeNodeId) -> Tick {
        let board = self.node(id).board;
        let key = match *self.binding(id, 0) {
            Binding::Entry(key) => key,
            _ => {
                let name: String = self.port(id, 0)?;
                if self.board.is_full() {
                    return Err(self.error(id, TickProblem::Full));
                }
                self.board.key(board, &name)
            }
        };
        self.board.erase(board, key);
        Ok(Status::Success)
    }

    /// `memory.time` is when it wakes up.
    pub(super) fn sleep(&mut self, id: TreeNodeId) -> Tick {
        match self.node(id).status {
            Status::Running => {}
            Status::Success => return Ok(Status::Success),
            _ => {
                let msec: u32 = self.port(id, 0)?;
                if msec == 0 {
                    return Ok(Status::Success);
                }
                self.memory(id).time = self.now + Duration::from_millis(msec.into());
            }
        }
        let until = self.memory(id).time;
        if self.now >= until {
            return Ok(Status::Success);
        }
        self.wake_at(until);
        Ok(Status::Running)
    }

    pub(super) fn was_entry_updated(&mut self, id: TreeNodeId) -> Tick {
        Ok(Status::from(self.is_updated(id)))
    }
}
