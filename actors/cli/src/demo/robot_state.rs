//! What the director knows of the robot at a moment.

use super::flow_accounting::Ledger;
use super::machine_instant::Moment;
use super::protocol::{Event, Snapshot, SourceState};
use super::robot::{CABLES, Cable, Module};
use super::timings::Timings;
use std::collections::BTreeMap;

/// The robot as its modules told it, with the age of what they told.
#[derive(Debug, Default)]
pub(crate) struct Known {
    /// The books of the flows.
    pub(crate) ledger: Ledger,
    modules: BTreeMap<Module, KnownModule>,
    finished: Measured,
}

/// What was measured along the way.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Measured {
    /// Response times by pair of modules.
    pub(crate) responses: BTreeMap<(Module, Module), Timings>,
    /// Delivery of an event to a listener without a condition.
    pub(crate) unfiltered: Timings,
    /// The same to a listener with a condition.
    pub(crate) filtered: Timings,
    /// How often the middleware gave a message back to a flow's source, which offered it again.
    pub(crate) given_back: u64,
}

/// One module as it told itself.
#[derive(Clone, Debug, Default)]
pub(crate) struct KnownModule {
    /// Its process has told that its node is started, and has not ended since.
    pub(crate) ready: bool,
    /// The last snapshot of the present or the last process.
    pub(crate) snapshot: Snapshot,
}

impl Known {
    /// Takes over what a module tells.
    pub(crate) fn handle_event(&mut self, from: Module, event: &Event) {
        let module = self.modules.entry(from).or_default();
        match event {
            Event::Ready => module.ready = true,
            Event::Snapshot(snapshot) => {
                self.ledger.handle_snapshot(snapshot);
                module.snapshot = Snapshot::clone(snapshot);
            }
            _ => {}
        }
    }

    /// A module's process has ended; what it measured is kept.
    pub(crate) fn handle_exit(&mut self, module: Module) {
        let known = self.modules.entry(module).or_default();
        known.ready = false;
        self.finished.add(module, &known.snapshot);
        known.snapshot = Snapshot { at: known.snapshot.at, ..Snapshot::default() };
    }

    /// What was measured in all processes so far.
    pub(crate) fn measured(&self) -> Measured {
        let mut sum = self.finished.clone();
        for (module, known) in &self.modules {
            sum.add(*module, &known.snapshot);
        }
        sum
    }

    /// One module.
    pub(crate) fn module(&self, module: Module) -> Option<&KnownModule> {
        self.modules.get(&module)
    }

    /// Both ends hear each other.
    pub(crate) fn is_up(&self, cable: &Cable) -> bool {
        cable.ends().iter().all(|end| {
            let links = self.modules.get(end).map_or(&[][..], |known| &known.snapshot.links);
            links.iter().any(|link| link.cable == cable.name && link.up)
        })
    }

    /// Every module is ready.
    pub(crate) fn are_ready(&self) -> bool {
        Module::ALL.iter().all(|module| self.modules.get(module).is_some_and(|known| known.ready))
    }

    /// Every module is ready, the cables for which `wanted` is true are up, and every flow flows.
    pub(crate) fn is_together(&self, wanted: impl Fn(&Cable) -> bool) -> bool {
        let up = CABLES.iter().filter(|cable| wanted(cable)).all(|cable| self.is_up(cable));
        up && self.are_ready() && self.ledger.is_flowing()
    }

    /// What is still missing for that, for a person.
    pub(crate) fn missing(&self, wanted: impl Fn(&Cable) -> bool) -> String {
        let modules = Module::ALL
            .into_iter()
            .filter(|module| !self.modules.get(module).is_some_and(|known| known.ready));
        let cables = CABLES.iter().filter(|cable| wanted(cable) && !self.is_up(cable));
        let mut parts: Vec<String> =
            modules.map(|module| format!("{module} is not ready")).collect();
        parts.extend(cables.map(|cable| format!("{} to {} is down", cable.name, cable.far)));
        if !self.ledger.is_flowing() {
            parts.push("a flow has not begun".into());
        }
        parts.join(", ")
    }

    /// When a module was last heard.
    pub(crate) fn heard_at(&self, module: Module) -> Option<Moment> {
        self.modules.get(&module).map(|known| known.snapshot.at)
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
        let given_back = |source: &SourceState| source.given_back;
        self.given_back += snapshot.sources.iter().map(given_back).sum::<u64>();
    }
}
