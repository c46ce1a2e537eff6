//! The types of nodes that the engine has itself: controls, decorators and leaves.

use super::{LoopQueue, NodeAnswer, PortBinding, PortError, TickError, Tree, TreeNodeId};
use crate::blackboard::KeyId;
use crate::model::TickOrder;
use crate::script::equal;
use crate::status::Status;
use crate::value::Value;
use std::time::Duration;

/// The nodes with several children.
impl Tree {
    /// The first so many children in turn. `memory.index` is the present one, and `memory.count`
    /// counts the skipped ones of a run.
    pub(super) fn ordered(&mut self, id: TreeNodeId, order: TickOrder, count: u32) -> NodeAnswer {
        let node = self.node_mut(id);
        if node.status == Status::Idle {
            node.memory.count = 0;
        }
        node.status = Status::Running;
        while self.memory(id).index < count {
            let index = self.memory(id).index;
            let child = self.child(id, index);
            let was_idle = self.node(child).status == Status::Idle;
            match self.execute(child)? {
                Status::Running => return Ok(Status::Running),
                Status::Skipped => {
                    let memory = self.memory(id);
                    memory.index += 1;
                    memory.count += 1;
                }
                status if status == order.go => {
                    self.memory(id).index += 1;
                    if order.yields && was_idle && index + 1 < count {
                        return self.yield_now();
                    }
                }
                status => {
                    self.reset_children(id, if order.keeps { index } else { 0 })?;
                    if !order.keeps {
                        self.memory(id).index = 0;
                    }
                    return Ok(status);
                }
            }
        }
        let skipped = self.memory(id).count == count;
        self.reset_children(id, 0)?;
        let memory = self.memory(id);
        (memory.index, memory.count) = (0, 0);
        Ok(if skipped { Status::Skipped } else { order.go })
    }

    /// `ReactiveSequence` and `ReactiveFallback`: from the first child on in each tick.
    pub(super) fn reactive(&mut self, id: TreeNodeId, go: Status) -> NodeAnswer {
        self.node_mut(id).status = Status::Running;
        let mut all_skipped = true;
        for index in 0..self.node(id).child_count {
            let child = self.child(id, index);
            let status = self.execute(child)?;
            all_skipped &= status == Status::Skipped;
            match status {
                Status::Running => {
                    for other in (0..self.node(id).child_count).filter(|other| *other != index) {
                        self.reset(self.child(id, other))?;
                    }
                    return Ok(status);
                }
                Status::Skipped => self.reset(child)?,
                status if status == go => {}
                status => {
                    self.reset_children(id, 0)?;
                    return Ok(status);
                }
            }
        }
        self.reset_children(id, 0)?;
        Ok(if all_skipped { Status::Skipped } else { go })
    }

    /// The threshold that a port of `Parallel` or `ParallelAll` sets, and whether it counts from
    /// the number of children down.
    fn threshold(&self, id: TreeNodeId, port: usize) -> Result<(u32, bool), Box<TickError>> {
        let children = self.node(id).child_count;
        let threshold: i32 = self.port(id, port)?;
        let from_above = threshold < 0;
        let threshold = if from_above {
            u32::try_from(i64::from(children) + i64::from(threshold) + 1).unwrap_or(0)
        } else {
            threshold.unsigned_abs()
        };
        if threshold > children {
            let problem = format!("a threshold of {threshold} with {children} children");
            return Err(self.error(id, problem));
        }
        Ok((threshold, from_above))
    }

    /// `memory.count` and `memory.failures` count the children that are done.
    pub(super) fn parallel(&mut self, id: TreeNodeId) -> NodeAnswer {
        let (successes, from_above) = self.threshold(id, 0)?;
        let (failures, _) = self.threshold(id, 1)?;
        self.node_mut(id).status = Status::Running;
        let count = self.node(id).child_count;
        let mut skipped = 0;
        for index in 0..count {
            self.tick_undone(id, index, &mut skipped)?;
            let memory = self.memory(id);
            let done = memory.count;
            let may_succeed = count - memory.failures >= successes;
            let failed = !may_succeed || memory.failures == failures;
            let succeeded = done >= successes || from_above && done + skipped >= successes;
            if succeeded || failed {
                self.end_parallel(id)?;
                return Ok(Status::from(succeeded));
            }
        }
        Ok(if skipped == count { Status::Skipped } else { Status::Running })
    }

    pub(super) fn parallel_all(&mut self, id: TreeNodeId) -> NodeAnswer {
        let (failures, _) = self.threshold(id, 0)?;
        self.node_mut(id).status = Status::Running;
        let count = self.node(id).child_count;
        let mut skipped = 0;
        for index in 0..count {
            self.tick_undone(id, index, &mut skipped)?;
        }
        let memory = self.memory(id);
        let failed = memory.failures >= failures;
        if skipped == count {
            return Ok(Status::Skipped);
        }
        if skipped + memory.count + memory.failures < count {
            return Ok(Status::Running);
        }
        self.end_parallel(id)?;
        Ok(Status::from(!failed))
    }

    /// Ticks a child that is not done, and counts what it answers.
    fn tick_undone(&mut self, id: TreeNodeId, index: u32, skipped: &mut u32) -> NodeAnswer {
        let child = self.child(id, index);
        if self.node(child).done {
            return Ok(self.node(child).status);
        }
        let status = self.execute(child)?;
        self.node_mut(child).done = status.is_completed();
        let memory = self.memory(id);
        match status {
            Status::Success => memory.count += 1,
            Status::Failure => memory.failures += 1,
            Status::Skipped => *skipped += 1,
            _ => {}
        }
        Ok(status)
    }

    fn end_parallel(&mut self, id: TreeNodeId) -> Result<(), Box<TickError>> {
        let memory = self.memory(id);
        (memory.count, memory.failures) = (0, 0);
        self.undo_done(id);
        self.reset_children(id, 0)
    }

    /// `IfThenElse` looks at its condition before a branch begins, `WhileDoElse` in each tick.
    /// `memory.index` is the branch that runs; 0 before one does.
    pub(super) fn branch(&mut self, id: TreeNodeId, looks_again: bool) -> NodeAnswer {
        self.node_mut(id).status = Status::Running;
        let has_else = self.node(id).child_count == 3;
        if looks_again || self.memory(id).index == 0 {
            let branch = match self.execute(self.child(id, 0))? {
                Status::Running => return Ok(Status::Running),
                Status::Success => 1,
                Status::Failure if has_else => 2,
                Status::Failure => {
                    if looks_again {
                        self.reset_children(id, 0)?;
                    }
                    return Ok(Status::Failure);
                }
                status => return Err(self.may_not_answer(self.child(id, 0), status)),
            };
            if looks_again && has_else {
                self.reset(self.child(id, 3 - branch))?;
            }
            self.memory(id).index = branch;
        }
        let branch = self.memory(id).index;
        let status = self.execute(self.child(id, branch))?;
        if status != Status::Running {
            self.reset_children(id, 0)?;
            self.memory(id).index = 0;
        }
        Ok(status)
    }

    /// `memory.index` is the number of the child that runs, from 1; 0 if none does.
    pub(super) fn switch(&mut self, id: TreeNodeId, cases: u32) -> NodeAnswer {
        let is_meant = |variable: &Value, case: u32| {
            let case = self.raw(id, case as usize + 1);
            case.is_some_and(|case| same(variable, case))
        };
        let chosen =
            self.raw(id, 0).and_then(|value| (0..cases).find(|case| is_meant(value, *case)));
        let chosen = chosen.unwrap_or(cases);
        let running = self.memory(id).index;
        if running != 0 && running != chosen + 1 {
            self.reset(self.child(id, running - 1))?;
        }
        let status = self.execute(self.child(id, chosen))?;
        self.memory(id).index = if status == Status::Running { chosen + 1 } else { 0 };
        if status.is_completed() {
            self.reset_children(id, 0)?;
        }
        Ok(status)
    }

    /// A sequence of all children but the last; the flag is set while that one runs.
    pub(super) fn try_catch(&mut self, id: TreeNodeId) -> NodeAnswer {
        let last = self.node(id).child_count - 1;
        if !self.memory(id).flag {
            match self.ordered(id, TickOrder::SEQUENCE, last)? {
                Status::Failure => self.memory(id).flag = true,
                status => return Ok(status),
            }
        }
        if self.execute(self.child(id, last))? == Status::Running {
            return Ok(Status::Running);
        }
        self.reset_children(id, 0)?;
        self.memory(id).flag = false;
        Ok(Status::Failure)
    }

    /// Ticks the last child once where a halt is to be caught.
    pub(super) fn halt_try_catch(&mut self, id: TreeNodeId) -> Result<(), Box<TickError>> {
        let catches = self.node(id).status == Status::Running && !self.memory(id).flag;
        let memory = self.memory(id);
        (memory.index, memory.count, memory.flag) = (0, 0, false);
        if catches && self.port(id, 0)? {
            let last = self.node(id).child_count - 1;
            for index in 0..last {
                self.reset(self.child(id, index))?;
            }
            self.execute(self.child(id, last))?;
        }
        Ok(())
    }
}

/// The nodes with one child.
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
    fn start_timer(&mut self, id: TreeNodeId) -> Result<(), Box<TickError>> {
        let msec: u32 = self.port(id, 0)?;
        if !self.memory(id).flag {
            let deadline = self.clock.now + Duration::from_millis(msec.into());
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
        if !started || self.clock.now < deadline {
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
        if limited && self.clock.now >= deadline && self.node(child).status == Status::Running {
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
                self.assign(id, key, element)?;
            }
        }
        self.node_mut(id).status = Status::Running;
        let status = self.tick_and_reset(id)?;
        self.memory(id).flag = status == Status::Running;
        Ok(if status == Status::Failure { status } else { Status::Running })
    }

    /// Takes a copy of the elements, which are then gone through.
    fn load_queue(&mut self, id: TreeNodeId, part: usize) -> Result<(), Box<TickError>> {
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
        let error = PortError::of_type("queue", value, element.name());
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

impl Tree {
    /// Copies a value, or the literal text, into an entry whose name a port gives.
    pub(super) fn set_blackboard(&mut self, id: TreeNodeId) -> NodeAnswer {
        let to = self.named_key(id, 1)?;
        let Some(value) = self.raw(id, 0).cloned() else { return Ok(Status::Failure) };
        if let Some(from) = self.key(id, 0) {
            self.board.take_kind(to, from);
        }
        self.assign(id, to, value).map(|()| Status::Success)
    }

    /// Writes the port `value` of a node to an entry.
    fn assign(&mut self, id: TreeNodeId, key: KeyId, value: Value) -> Result<(), Box<TickError>> {
        let assigned = self.board.assign(key, value.clone());
        assigned.map_err(|kind| self.error(id, PortError::of_type("value", value, kind)))
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
                self.memory(id).time = self.clock.now + Duration::from_millis(msec.into());
            }
        }
        let until = self.memory(id).time;
        if self.clock.now >= until {
            return Ok(Status::Success);
        }
        self.wake_at(until);
        Ok(Status::Running)
    }
}

/// Whether a case is meant: the texts are the same, or the numbers.
fn same(variable: &Value, case: &Value) -> bool {
    match (variable, case) {
        (Value::Text(variable), Value::Text(case)) if variable == case => true,
        _ => matches!((variable.as_real(), case.as_real()), (Some(a), Some(b)) if equal(a, b)),
    }
}
