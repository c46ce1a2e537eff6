//! The nodes with several children.

use super::execute::NodeAnswer;
use super::{TickError, Tree, TreeNodeId};
use crate::model::ChildOrder;
use crate::script::equal;
use crate::status::Status;
use crate::value::Value;
use std::collections::BTreeMap;

impl Tree {
    /// The first so many children in turn. `memory.index` is the present one, and `memory.count`
    /// counts the skipped ones of a run.
    pub(super) fn ordered(&mut self, id: TreeNodeId, order: ChildOrder, count: u32) -> NodeAnswer {
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
            case.is_some_and(|case| same(variable, case, &self.enums))
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
            match self.ordered(id, ChildOrder::SEQUENCE, last)? {
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

/// Whether a case is meant: the texts are the same, or the numbers.
fn same(variable: &Value, case: &Value, enums: &BTreeMap<String, i64>) -> bool {
    if let (Value::Text(variable), Value::Text(case)) = (variable, case)
        && variable == case
    {
        return true;
    }
    let number = |value: &Value| match value {
        Value::Text(text) if enums.contains_key(&**text) => Some(enums[&**text] as f64),
        other => other.as_real(),
    };
    matches!((number(variable), number(case)), (Some(a), Some(b)) if equal(a, b))
}
