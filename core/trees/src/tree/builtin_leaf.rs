//! The leaves that the engine has itself.

use super::execute::NodeAnswer;
use super::{PortBinding, PortError, TickError, Tree, TreeNodeId};
use crate::blackboard::KeyId;
use crate::status::Status;
use std::time::Duration;

impl Tree {
    /// Copies a value, or the literal text, into an entry whose name a port gives.
    pub(super) fn set_blackboard(&mut self, id: TreeNodeId) -> NodeAnswer {
        let to = self.named_key(id, 1)?;
        let Some(value) = self.raw(id, 0).cloned() else { return Ok(Status::Failure) };
        if let Some(from) = self.key(id, 0) {
            self.board.take_kind(to, from);
        }
        self.board.assign(to, value.clone()).map_err(|kind| {
            let value = value.to_string();
            self.error(id, PortError::Type { port: "value".into(), value, kind })
        })?;
        Ok(Status::Success)
    }

    /// The entry that a port names, or whose name is in the entry that the port is connected to.
    fn named_key(&mut self, id: TreeNodeId, port: usize) -> Result<KeyId, Box<TickError>> {
        if let PortBinding::Entry(key) = self.binding(id, port) {
            return Ok(*key);
        }
        let name: String = self.port(id, port)?;
        if self.board.is_full() {
            return Err(self.error(id, "the blackboard is full"));
        }
        Ok(self.board.key(self.node(id).board, &name))
    }

    pub(super) fn unset_blackboard(&mut self, id: TreeNodeId) -> NodeAnswer {
        let (board, key) = (self.node(id).board, self.named_key(id, 0)?);
        self.board.erase(board, key);
        Ok(Status::Success)
    }

    /// `memory.time` is when it wakes up.
    pub(super) fn sleep(&mut self, id: TreeNodeId) -> NodeAnswer {
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
}
