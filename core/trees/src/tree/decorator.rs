//! The nodes with one child.

use super::execute::NodeAnswer;
use super::{LoopQueue, PortError, Tree, TreeNodeId};
use crate::status::Status;
use crate::value::Value;
use std::time::Duration;

impl Tree {
    /// Ticks the child, and resets it when it is done.
    fn tick_and_reset(&mut self, id: TreeNodeId) -> NodeAnswer {
        let status = self.execute(self.child(id, 0))?;
        if status.is_completed() {
            self.reset(self.child(id, 0))?;
        }
        Ok(status)
    }

    /// `Inverter`, `ForceSuccess`, `ForceFailure`, `KeepRunningUntilFailure`.
    pub(super) fn map_child(
        &mut self,
        id: TreeNodeId,
        map: impl Fn(Status) -> Status,
    ) -> NodeAnswer {
        self.node_mut(id).status = Status::Running;
        self.tick_and_reset(id).map(map)
    }

    /// `Repeat` until FAILURE, `RetryUntilSuccessful` until SUCCESS; `memory.count` counts cycles.
    /// A cycle that is done at once ends the tick; one that was RUNNING does not.
    pub(super) fn repeat(&mut self, id: TreeNodeId, until: Status) -> NodeAnswer {
        let due = |count: u32, cycles: i32| cycles == -1 || i64::from(count) < i64::from(cycles);
        let mut cycles: i32 = self.port(id, 0)?;
        self.node_mut(id).status = Status::Running;
        let child = self.child(id, 0);
        while due(self.memory(id).count, cycles) {
            let was_idle = self.node(child).status == Status::Idle;
            let status = self.execute(self.child(id, 0))?;
            if status == Status::Running {
                return Ok(status);
            }
            self.reset(child)?;
            if status == Status::Skipped {
                return Ok(status);
            }
            if status == until {
                self.memory(id).count = 0;
                return Ok(status);
            }
            let count = self.memory(id).count.saturating_add(1);
            self.memory(id).count = count;
            // An attempt may have changed how many there are to be.
            if until == Status::Success {
                cycles = self.port(id, 0)?;
            }
            if was_idle && due(count, cycles) {
                return self.yield_now();
            }
        }
        self.memory(id).count = 0;
        Ok(Status::from(until == Status::Failure))
    }

    /// The flag is set, and `memory.time` is the deadline, from the start to the child's answer.
    fn start_timer(&mut self, id: TreeNodeId) -> Result<(), Box<super::TickError>> {
        let msec: u32 = self.port(id, 0)?;
        if !self.memory(id).flag {
            let deadline = self.now + Duration::from_millis(msec.into());
            let node = self.node_mut(id);
            (node.memory.flag, node.memory.time) = (true, deadline);
            node.status = Status::Running;
        }
        Ok(())
    }

    pub(super) fn delay(&mut self, id: TreeNodeId) -> NodeAnswer {
        let started = self.memory(id).flag;
        self.start_timer(id)?;
        let deadline = self.memory(id).time;
        if !started || self.now < deadline {
            self.wake_at(deadline);
            return Ok(Status::Running);
        }
        let status = self.tick_and_reset(id)?;
        if status.is_completed() {
            self.memory(id).flag = false;
        }
        Ok(status)
    }

    /// Without a limit if that is 0 ms.
    pub(super) fn timeout(&mut self, id: TreeNodeId) -> NodeAnswer {
        let limited = self.port::<u32>(id, 0)? > 0;
        self.start_timer(id)?;
        let deadline = self.memory(id).time;
        let child = self.child(id, 0);
        if limited && self.now >= deadline && self.node(child).status == Status::Running {
            self.reset(child)?;
            self.memory(id).flag = false;
            return Ok(Status::Failure);
        }
        let status = self.tick_and_reset(id)?;
        if status != Status::Running {
            // Also after SKIPPED, so that the next run is limited.
            self.memory(id).flag = false;
        } else if limited {
            self.wake_at(deadline);
        }
        Ok(status)
    }

    /// The flag is set when the child has answered once, for ever, and `memory.status` is that.
    pub(super) fn run_once(&mut self, id: TreeNodeId) -> NodeAnswer {
        let then_skip = self.port(id, 0)?;
        let memory = self.memory(id);
        if memory.flag {
            return Ok(if then_skip { Status::Skipped } else { memory.status });
        }
        self.node_mut(id).status = Status::Running;
        let status = self.tick_and_reset(id)?;
        let memory = self.memory(id);
        (memory.flag, memory.status) = (status.is_completed(), status);
        Ok(status)
    }

    /// The flag is set from when the condition holds to the child's answer.
    pub(super) fn precondition(&mut self, id: TreeNodeId) -> NodeAnswer {
        if !self.memory(id).flag {
            if !self.holds(id, self.node(id).part)? {
                return self.port(id, 1);
            }
            self.memory(id).flag = true;
        }
        let status = self.tick_and_reset(id)?;
        if status.is_completed() {
            self.memory(id).flag = false;
        }
        Ok(status)
    }

    /// The flag is set while the child runs.
    pub(super) fn tick_loop(&mut self, id: TreeNodeId) -> NodeAnswer {
        let part = self.node(id).part as usize;
        if self.node(id).status == Status::Idle {
            self.memory(id).flag = false;
            self.loops[part].loaded = false;
            self.loops[part].queue.clear();
        }
        if !self.memory(id).flag {
            if !self.loops[part].loaded {
                self.load_queue(id, part)?;
            }
            let Some(element) = self.loops[part].queue.pop_front() else {
                return self.port(id, 1);
            };
            if let Some(key) = self.key(id, 2) {
                let value = element.to_string();
                self.board.assign(key, element).map_err(|kind| {
                    let error = PortError::Type { port: "value".into(), value, kind };
                    self.error(id, error)
                })?;
            }
        }
        self.node_mut(id).status = Status::Running;
        let status = self.tick_and_reset(id)?;
        self.memory(id).flag = status == Status::Running;
        Ok(if status == Status::Failure { status } else { Status::Running })
    }

    /// Takes a copy of the elements, which are then gone through.
    fn load_queue(&mut self, id: TreeNodeId, part: usize) -> Result<(), Box<super::TickError>> {
        let Some(value) = self.raw(id, 0).cloned() else { return Ok(()) };
        let LoopQueue { element, queue, loaded } = &mut self.loops[part];
        let mut push = |value: &Value| element.admit(value).map(|value| queue.push_back(value));
        let complete = match &value {
            Value::Text(text) => {
                text.split_terminator(';').all(|part| push(&Value::text(part)).is_some())
            }
            Value::List(list) => list.iter().all(|value| push(value).is_some()),
            _ => false,
        };
        *loaded = true;
        if complete {
            return Ok(());
        }
        let kind = element.name();
        let error = PortError::Type { port: "queue".into(), value: value.to_string(), kind };
        Err(self.error(id, error))
    }

    /// `SkipUnlessUpdated` and `WaitValueUpdate`. The flag is set while the child runs.
    pub(super) fn updated(&mut self, id: TreeNodeId, otherwise: Status) -> NodeAnswer {
        if !self.memory(id).flag && !self.is_updated(id) {
            return Ok(otherwise);
        }
        let status = self.execute(self.child(id, 0))?;
        self.memory(id).flag = status == Status::Running;
        Ok(status)
    }

    /// Whether the entry has been written since this was last asked; `memory.writes` keeps how
    /// often it was then.
    pub(super) fn is_updated(&mut self, id: TreeNodeId) -> bool {
        let Some(writes) = self.key(id, 0).and_then(|key| self.board.writes(key)) else {
            return false;
        };
        std::mem::replace(&mut self.memory(id).writes, writes) != writes
    }

    pub(super) fn subtree(&mut self, id: TreeNodeId) -> NodeAnswer {
        let node = self.node_mut(id);
        if node.status == Status::Idle {
            node.status = Status::Running;
        }
        self.tick_and_reset(id)
    }
}
