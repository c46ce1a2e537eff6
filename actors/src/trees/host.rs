//! What the conditions of a tree look at beside their ports.

use crate::component::environment::ComponentEnvironment;
use crate::condition::Conditions;
use crate::condition::{Condition, ConditionUse, Connected};
use crate::platform::{self, lock};
use blastema_core::FaultLocation;
use blastema_core::detection::FaultRecord;
use blastema_trees::{LeafContext, LeafError, TreeNodeId};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// What a node lends to the conditions of a tree.
pub(super) struct TreeHost {
    pub(super) environment: Arc<ComponentEnvironment>,
    /// Those of each leaf, by their numbers; those that are new are still to be watched.
    conditions: Mutex<BTreeMap<(TreeNodeId, usize), ConditionUse>>,
    fresh: Mutex<Vec<Condition>>,
    faults: Mutex<FaultRecord>,
}

impl TreeHost {
    pub(super) fn new(environment: Arc<ComponentEnvironment>) -> Self {
        let (conditions, fresh, faults) = Default::default();
        TreeHost { environment, conditions, fresh, faults }
    }

    /// The host of a leaf's tree.
    pub(super) fn of<'a>(cx: &'a LeafContext<'_>) -> Result<&'a TreeHost, LeafError> {
        cx.lent().ok_or_else(|| "this leaf needs a node: run the tree as a component".into())
    }

    /// The condition of this number that a leaf looks at. It is declared when the leaf asks for one
    /// of this name first, and takes the place of the one before.
    pub(super) fn condition(
        cx: &LeafContext<'_>,
        number: usize,
        name: &str,
        needs: impl FnOnce() -> Connected,
    ) -> Result<Condition, LeafError> {
        let host = TreeHost::of(cx)?;
        let mut known = lock(&host.conditions);
        let place = (cx.run().node, number);
        if let Some(ConditionUse(_, condition)) = known.get(&place)
            && condition.name() == name
        {
            return Ok(condition.clone());
        }
        let conditions = host.environment.feature::<Conditions>();
        let condition = conditions.declare(name, &needs(), platform::now(), Some(1))?;
        known.insert(place, ConditionUse(conditions.clone(), condition.clone()));
        lock(&host.fresh).push(condition.clone());
        Ok(condition)
    }

    /// The conditions that were declared since this was called before.
    pub(super) fn take_fresh(&self) -> Vec<Condition> {
        std::mem::take(&mut lock(&self.fresh))
    }

    /// Takes the record of faults. Says whether it has changed.
    pub(super) fn take_faults(&self, record: FaultRecord) -> bool {
        let mut known = lock(&self.faults);
        let before = std::mem::replace(&mut *known, record);
        before != *known
    }

    /// Whether a fault of this code stands, in this object if one is named.
    pub(super) fn has_fault(&self, code: &str, object: Option<&str>) -> bool {
        let is_there = |location: &FaultLocation| match (object, location) {
            (None, _) => true,
            (Some(object), FaultLocation::Object(at)) => at.object.as_str() == object,
            (Some(object), other) => other.to_string() == object,
        };
        let faults = lock(&self.faults);
        let mut standing = faults.entries.iter().filter(|entry| entry.stands());
        standing.any(|entry| entry.fault.kind.code() == code && is_there(&entry.fault.location))
    }
}
