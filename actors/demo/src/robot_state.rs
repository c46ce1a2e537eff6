//! What the director knows of the robot at a instant.

use super::flow_accounting::FlowAccounting;
use super::machine_instant::MachineInstant;
use super::protocol::{ModuleEvent, Snapshot};
use super::robot::{CABLES, DemoCable, Module};
use super::timings::Timings;
use std::collections::BTreeMap;

/// The last report of each module, with its age.
#[derive(Debug, Default)]
pub(crate) struct RobotState {
    /// The accounting of the flows.
    pub(crate) accounting: FlowAccounting,
    modules: BTreeMap<Module, ModuleState>,
    finished: Measured,
}

/// The measurements of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Measured {
    /// ResponseTimes times by pair of modules.
    pub(crate) responses: BTreeMap<(Module, Module), Timings>,
    /// DeliveryTimes of an event to a listener without a condition.
    pub(crate) unfiltered: Timings,
    /// The same to a listener with a condition.
    pub(crate) filtered: Timings,
}

/// The last report of one module.
#[derive(Clone, Debug, Default)]
pub(crate) struct ModuleState {
    /// Its process has reported that its node is started, and has not ended since.
    pub(crate) ready: bool,
    /// The last snapshot of the present or the last process.
    pub(crate) snapshot: Snapshot,
}

impl RobotState {
    /// Stores an event of a module.
    pub(crate) fn handle_event(&mut self, from: Module, event: &ModuleEvent) {
        let module = self.modules.entry(from).or_default();
        match event {
            ModuleEvent::Ready => module.ready = true,
            ModuleEvent::Snapshot(snapshot) => {
                self.accounting.handle_snapshot(snapshot);
                module.snapshot = Snapshot::clone(snapshot);
            }
            _ => {}
        }
    }

    /// Handles the end of a module's process; its measurements are kept.
    pub(crate) fn handle_exit(&mut self, module: Module) {
        let robot = self.modules.entry(module).or_default();
        robot.ready = false;
        self.finished.add(module, &robot.snapshot);
        robot.snapshot = Snapshot { at: robot.snapshot.at, ..Snapshot::default() };
    }

    /// Returns the measurements of all processes.
    pub(crate) fn measured(&self) -> Measured {
        let mut sum = self.finished.clone();
        for (module, robot) in &self.modules {
            sum.add(*module, &robot.snapshot);
        }
        sum
    }

    /// One module.
    pub(crate) fn module(&self, module: Module) -> Option<&ModuleState> {
        self.modules.get(&module)
    }

    /// Returns whether both ends report the link as in service.
    pub(crate) fn is_up(&self, cable: &DemoCable) -> bool {
        cable.ends().iter().all(|end| {
            let links = self.modules.get(end).map_or(&[][..], |module| &module.snapshot.links);
            links.iter().any(|link| link.cable == cable.name && link.up)
        })
    }

    /// Every module is ready.
    pub(crate) fn are_ready(&self) -> bool {
        Module::ALL.iter().all(|module| self.modules.get(module).is_some_and(|module| module.ready))
    }

    /// Every module is ready, the cables for which `wanted` is true are up, and every flow flows.
    pub(crate) fn is_together(&self, wanted: impl Fn(&DemoCable) -> bool) -> bool {
        let up = CABLES.iter().filter(|cable| wanted(cable)).all(|cable| self.is_up(cable));
        up && self.are_ready() && self.accounting.is_flowing()
    }

    /// Describes what is missing for that.
    pub(crate) fn missing(&self, wanted: impl Fn(&DemoCable) -> bool) -> String {
        let modules = Module::ALL
            .into_iter()
            .filter(|module| !self.modules.get(module).is_some_and(|module| module.ready));
        let cables = CABLES.iter().filter(|cable| wanted(cable) && !self.is_up(cable));
        let mut parts: Vec<String> =
            modules.map(|module| format!("{module} is not ready")).collect();
        parts.extend(cables.map(|cable| format!("{} to {} is down", cable.name, cable.far)));
        if !self.accounting.is_flowing() {
            parts.push("a flow has not begun".into());
        }
        parts.join(", ")
    }

    /// Returns when the last snapshot of a module was taken.
    pub(crate) fn received_at(&self, module: Module) -> Option<MachineInstant> {
        self.modules.get(&module).map(|module| module.snapshot.at)
    }
}

impl Measured {
    fn add(&mut self, module: Module, snapshot: &Snapshot) {
        for (name, timings) in &snapshot.responses {
            if let Some(other) = Module::from_name(name) {
                let pair = (module.min(other), module.max(other));
                self.responses.entry(pair).or_default().merge(timings);
            }
        }
        self.unfiltered.merge(&snapshot.unfiltered);
        self.filtered.merge(&snapshot.filtered);
    }
}
