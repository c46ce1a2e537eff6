//! What the director knows of the robot: the last report of each module, and what was found, lost
//! and measured.

use crate::flow_account::{FlowAccount, FlowLosses};
use crate::messages::{FaultReport, ModuleReport};
use crate::robot::{CABLES, DemoCable, FLOWS, Module};
use blastema::{FaultId, Instant};
use std::collections::BTreeMap;

/// The state of the robot.
#[derive(Debug, Default)]
pub(crate) struct RobotState {
    modules: BTreeMap<Module, ModuleState>,
    flows: [FlowAccount; FLOWS.len()],
    /// Every fault that a module has found, also one whose process has ended.
    pub(crate) found: BTreeMap<FoundKey, FoundFault>,
    /// All that was measured, in nanoseconds, by its name.
    pub(crate) measured: BTreeMap<String, Vec<u64>>,
}

/// The finder of a fault, its process, and the fault's number in its record.
pub(crate) type FoundKey = (Module, u64, FaultId);

/// A fault that a module has found.
#[derive(Clone, Debug)]
pub(crate) struct FoundFault {
    /// As it was last reported.
    pub(crate) report: FaultReport,
    /// The injected fault when it was reported first: its number, and whether it was being tried.
    pub(crate) during: (u32, bool),
    /// When a report last showed that it had not ended.
    pub(crate) stood_at: Instant,
}

impl FoundFault {
    /// Describes that the fault was given up, if it was.
    pub(crate) fn given_up(&self, (module, _, id): &FoundKey) -> Option<String> {
        let reason = self.report.given_up.as_ref()?;
        Some(format!("{module} gave {id} up: {reason}"))
    }
}

#[derive(Debug, Default)]
struct ModuleState {
    /// Its process runs, as far as is known.
    is_ready: bool,
    report: ModuleReport,
}

impl RobotState {
    /// Handles the report of a module, while this fault is tried, or was the last one. Returns
    /// whether the module has a new process.
    pub(crate) fn handle_report(
        &mut self,
        module: Module,
        report: ModuleReport,
        during: (u32, bool),
    ) -> bool {
        for (flow, account) in FLOWS.iter().zip(&mut self.flows) {
            let sources = report.sources.iter().filter(|source| source.flow == flow.name);
            sources.for_each(|source| account.handle_source(source, report.process, report.at));
            let sinks = report.sinks.iter().filter(|sink| sink.flow == flow.name);
            sinks.for_each(|sink| account.handle_sink(sink, report.process));
        }
        for (name, spans) in &report.measured {
            self.measured.entry(name.clone()).or_default().extend(spans);
        }
        for fault in &report.faults {
            let known = self.found.entry((module, report.process, fault.id));
            let stood_at = Instant::from_nanos(report.at);
            let fresh = || FoundFault { report: fault.clone(), during, stood_at };
            let known = known.or_insert_with(fresh);
            known.report.clone_from(fault);
            if !fault.recovered {
                known.stood_at = stood_at;
            }
        }
        let state = self.modules.entry(module).or_default();
        let is_new = report.process != state.report.process;
        *state = ModuleState { is_ready: is_new || state.is_ready, report };
        is_new
    }

    /// Handles the end of a module's process.
    pub(crate) fn handle_end(&mut self, module: Module) {
        self.modules.entry(module).or_default().is_ready = false;
    }

    /// From now on flows are unsettled until all that was sent up to now has arrived.
    pub(crate) fn settle(&mut self, now: Instant) {
        self.flows.iter_mut().for_each(|flow| flow.settle(now.as_nanos()));
    }

    /// Returns the names of the flows that have not settled.
    pub(crate) fn unsettled(&self) -> Vec<&'static str> {
        let open = FLOWS.iter().zip(&self.flows).filter(|(_, account)| !account.is_settled());
        open.map(|(flow, _)| flow.name).collect()
    }

    /// Returns the losses since the start.
    pub(crate) fn losses(&self) -> FlowLosses {
        self.flows.iter().map(FlowAccount::losses).sum()
    }

    /// Returns how many messages have arrived from and at the modules' present processes.
    pub(crate) fn received(&self) -> u64 {
        self.flows.iter().map(FlowAccount::received).sum()
    }

    /// Returns when the first message of a flow arrived that was sent since this instant, unless
    /// none has, or its module has not been asked yet.
    pub(crate) fn passed(&self, flow: &str, since: Instant) -> Option<Instant> {
        let at = FLOWS.iter().position(|known| known.name == flow)?;
        let report = &self.modules.get(&FLOWS[at].to)?.report;
        let passed = self.flows[at].passed().filter(|_| report.since == since.as_nanos());
        passed.map(Instant::from_nanos)
    }

    /// Returns when the object that this fault has struck answered again.
    pub(crate) fn served(&self, module: Module, fault: u32) -> Option<Instant> {
        let served = self.modules.get(&module)?.report.served;
        served.filter(|(of, _)| *of == fault).map(|(_, at)| Instant::from_nanos(at))
    }

    /// Returns whether the module's process is at work.
    pub(crate) fn is_ready(&self, module: Module) -> bool {
        self.modules.get(&module).is_some_and(|state| state.is_ready)
    }

    /// Returns whether the module's process is at work, and has begun after this instant.
    pub(crate) fn is_new(&self, module: Module, since: Instant) -> bool {
        let process = self.modules.get(&module).map_or(0, |state| state.report.process);
        self.is_ready(module) && process > since.as_nanos()
    }

    /// Describes what is missing until every module is ready, the cables for which `wanted` is true
    /// are up, and every flow flows; empty if nothing is.
    pub(crate) fn missing(&self, wanted: impl Fn(&DemoCable) -> bool) -> String {
        let modules = Module::ALL.into_iter().filter(|module| !self.is_ready(*module));
        let cables = CABLES.iter().filter(|cable| wanted(cable) && !self.is_up(cable));
        let flows = FLOWS.iter().zip(&self.flows).filter(|(_, account)| !account.is_flowing());
        let modules = modules.map(|module| format!("{module} is not ready"));
        let cables = cables.map(|cable| format!("{} to {} is down", cable.name, cable.far));
        let flows = flows.map(|(flow, _)| format!("{} has not begun", flow.name));
        modules.chain(cables).chain(flows).collect::<Vec<_>>().join(", ")
    }

    /// Returns whether both ends report the cable as in service.
    pub(crate) fn is_up(&self, cable: &DemoCable) -> bool {
        cable.ends().iter().all(|end| {
            let cables = self.modules.get(end).map_or(&[][..], |state| &state.report.cables);
            cables.iter().any(|(name, is_up)| name == cable.name && *is_up)
        })
    }
}

#[cfg(test)]
pub(crate) mod fake {
    //! Reports of a robot that is well.

    use super::*;
    use crate::messages::{SinkReport, SourceReport};
    use blastema::{FaultKind, FaultLocation};

    /// The numbers of messages that were sent and received on each flow.
    pub(crate) fn report(module: Module, at_ms: u64, sent: u64) -> ModuleReport {
        let process = module as u64 + 1;
        let sources = FLOWS.iter().filter(|flow| flow.from == module);
        let sinks = FLOWS.iter().filter(|flow| flow.to == module);
        ModuleReport {
            process,
            at: at_ms * 1_000_000,
            cables: CABLES
                .iter()
                .filter(|cable| cable.ends().contains(&module))
                .map(|cable| (cable.name.to_owned(), true))
                .collect(),
            sources: sources
                .map(|flow| SourceReport { flow: flow.name.into(), sent, ..Default::default() })
                .collect(),
            sinks: sinks
                .map(|flow| SinkReport {
                    flow: flow.name.into(),
                    source: flow.from as u64 + 1,
                    first: 1,
                    highest: sent,
                    ..SinkReport::default()
                })
                .collect(),
            ..ModuleReport::default()
        }
    }

    /// A fault that was found 150 ms after the start.
    pub(crate) fn fault(id: u64, kind: FaultKind, location: FaultLocation) -> FaultReport {
        FaultReport {
            id: FaultId(id),
            kind,
            location,
            found_at: 150_000_000,
            detail: String::new(),
            symptom_of: None,
            recovered: false,
            given_up: None,
        }
    }

    /// A robot after one report of each module.
    pub(crate) fn robot() -> RobotState {
        let mut robot = RobotState::default();
        for module in Module::ALL {
            robot.handle_report(module, report(module, 100, 100), (0, false));
        }
        robot
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema::{FaultKind, FaultLocation, NodeName};

    #[test]
    fn a_robot_is_together_when_modules_cables_and_flows_are() {
        let mut robot = fake::robot();
        assert_eq!(robot.missing(|_| true), "");

        let mut report = fake::report(Module::Module3, 200, 100);
        report.cables[0].1 = false;
        robot.handle_report(Module::Module3, report, (0, false));
        robot.handle_end(Module::Module2);

        assert_eq!(robot.missing(|_| true), "module2 is not ready, ieee1394 to module3 is down");
        assert_eq!(robot.missing(|cable| cable.name != "ieee1394"), "module2 is not ready");
    }

    #[test]
    fn a_fault_stays_known_as_it_was_last_reported_with_the_step_in_which_it_was_found() {
        let mut robot = fake::robot();
        let node = FaultLocation::Node(NodeName::new("module3").expect("a name"));
        let mut report = fake::report(Module::Module1, 200, 100);
        report.faults = vec![fake::fault(7, FaultKind::NodeLost, node)];
        let key = (Module::Module1, report.process, FaultId(7));

        robot.handle_report(Module::Module1, report.clone(), (4, true));
        report.faults[0].recovered = true;
        robot.handle_report(Module::Module1, report.clone(), (4, false));
        (report.process, report.faults) = (99, vec![]);
        let is_new = robot.handle_report(Module::Module1, report, (5, true));

        let found = &robot.found[&key];
        assert_eq!((found.during, found.report.recovered, is_new), ((4, true), true, true));
    }
}
