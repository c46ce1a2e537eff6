//! A fault that the demonstration injects, and the reports that it expects.

use super::protocol::{DirectorCommand, FaultNote, ObjectFault, OrderId};
use super::robot::{CABLES, DemoCable, FLOWS, Flow, Module, address};
use blastema::core::{FaultKind, FaultLocation, ObjectName};
use std::fmt;

/// An injected fault.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum FaultInjection {
    /// Harm to one object.
    Object {
        /// Its module.
        module: Module,
        /// Its name.
        object: String,
        /// The kind of harm.
        fault: ObjectFault,
    },
    /// One cable is cut.
    Cut {
        /// The cable.
        cable: DemoCable,
        /// It is plugged in again at the end of the step, rather than left to a later one.
        returns: bool,
    },
    /// Every cable to this module is cut; after a while all return.
    Blackout {
        /// The module; never module1.
        far: Module,
    },
    /// The router panics.
    Router {
        /// In this module.
        module: Module,
    },
    /// The whole process is killed with signal 9.
    Kill {
        /// This one.
        module: Module,
    },
}

/// The relation of a reported fault to the injected one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FaultMatch {
    /// The report names the injected fault and its place.
    Named,
    /// A consequence of the injected fault, or marked as a symptom.
    Companion,
    /// The report names another place or kind.
    Foreign,
}

/// The criterion of restored service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ServiceRestored {
    /// The object answers.
    Service,
    /// Messages sent later than the fault (or its repair) arrive on the flows concerned.
    Traffic,
    /// The process runs again, all cables to it are up, and messages arrive.
    Rejoining,
}

impl FaultInjection {
    /// Returns the kind, for the table.
    pub(crate) fn title(&self) -> &'static str {
        match self {
            FaultInjection::Object { fault, .. } => match fault {
                ObjectFault::Panic => "panic",
                ObjectFault::Hang { .. } => "hang",
                ObjectFault::ErrorState => "error state",
                ObjectFault::FailInitialization => "failed initialisation",
                ObjectFault::Silence => "silent object",
                ObjectFault::Flood { .. } => "flood",
            },
            FaultInjection::Cut { .. } => "cable cut",
            FaultInjection::Blackout { .. } => "both cables cut, return",
            FaultInjection::Router { .. } => "panic in the router",
            FaultInjection::Kill { .. } => "kill -9, rejoin",
        }
    }

    /// Returns the place, for the table.
    pub(crate) fn location(&self) -> String {
        match self {
            FaultInjection::Object { module, object, .. } => format!("{module}:{object}"),
            FaultInjection::Cut { cable, .. } => {
                format!("{} -{}- {}", Module::Module1, cable.name, cable.far)
            }
            FaultInjection::Blackout { far } => format!("{} - {far}", Module::Module1),
            FaultInjection::Router { module } => format!("{module}, its router"),
            FaultInjection::Kill { module } => module.to_string(),
        }
    }

    /// Returns the commands that inject the fault; a kill needs none.
    pub(crate) fn strike(&self, order: OrderId) -> Vec<(Module, DirectorCommand)> {
        match self {
            FaultInjection::Object { module, object, fault } => {
                let object = ObjectName::new(object).expect("the objects' names are names");
                vec![(*module, DirectorCommand::Strike { order, object, fault: *fault })]
            }
            FaultInjection::Cut { cable, .. } => at_both_ends(&[*cable], cut(order)),
            FaultInjection::Blackout { far } => at_both_ends(&cables_to(*far), cut(order)),
            FaultInjection::Router { module } => {
                vec![(*module, DirectorCommand::PanicRouter { order })]
            }
            FaultInjection::Kill { .. } => vec![],
        }
    }

    /// Returns the commands without which service cannot be restored.
    pub(crate) fn repair(&self, order: OrderId) -> Vec<(Module, DirectorCommand)> {
        match self {
            FaultInjection::Blackout { far } => at_both_ends(&cables_to(*far), restore(order)),
            _ => vec![],
        }
    }

    /// Returns the commands that restore the former state after the step.
    pub(crate) fn clean_up(&self, order: OrderId) -> Vec<(Module, DirectorCommand)> {
        match self {
            FaultInjection::Cut { cable, returns: true } => at_both_ends(&[*cable], restore(order)),
            _ => vec![],
        }
    }

    /// The criterion of restored service.
    pub(crate) fn comes_back_by(&self) -> ServiceRestored {
        match self {
            FaultInjection::Object { .. } => ServiceRestored::Service,
            FaultInjection::Cut { .. }
            | FaultInjection::Blackout { .. }
            | FaultInjection::Router { .. } => ServiceRestored::Traffic,
            FaultInjection::Kill { .. } => ServiceRestored::Rejoining,
        }
    }

    /// Returns the flows on which messages must arrive again.
    pub(crate) fn flows(&self) -> Vec<&'static Flow> {
        FLOWS.iter().filter(|flow| self.concerns(flow)).collect()
    }

    /// Returns whether the module that found the fault must report its recovery. Software cannot
    /// recover a cut cable; the flows show that messages take another path.
    pub(crate) fn wants_report(&self) -> bool {
        matches!(self, FaultInjection::Object { .. } | FaultInjection::Router { .. })
    }

    /// Returns the relation of a reported fault to this one.
    pub(crate) fn judge(&self, note: &FaultNote) -> FaultMatch {
        let (named, touched) = match self {
            FaultInjection::Object { module, object, fault } => {
                let here = note.location == FaultLocation::Object(address(*module, object));
                let comes_along = companions_of(*fault).contains(&note.kind);
                (here && note.kind == kind_of(*fault), here && comes_along)
            }
            FaultInjection::Cut { cable, .. } => {
                let here = is_cable(&note.location, cable);
                (here && note.kind == FaultKind::LinkDown, here)
            }
            FaultInjection::Blackout { far } => {
                let here = cables_to(*far).iter().any(|cable| is_cable(&note.location, cable));
                let lost = note.kind == FaultKind::NodeLost;
                (lost || here && note.kind == FaultKind::LinkDown, here || lost)
            }
            FaultInjection::Router { module } => {
                let here = matches!(&note.location, FaultLocation::Object(address)
                    if is_node(address.node.as_str(), *module)
                        && address.object.as_str().contains("router"));
                (here && note.kind == FaultKind::Panic, here)
            }
            FaultInjection::Kill { module } => {
                let here = note.location == FaultLocation::Node(address(*module, "node").node);
                (here && note.kind == FaultKind::NodeLost, here || touches(&note.location, *module))
            }
        };
        match (named, touched || note.is_warning() || note.symptom_of.is_some()) {
            (true, _) => FaultMatch::Named,
            (false, true) => FaultMatch::Companion,
            (false, false) => FaultMatch::Foreign,
        }
    }

    fn concerns(&self, flow: &Flow) -> bool {
        match self {
            FaultInjection::Object { .. } => false,
            FaultInjection::Cut { cable: DemoCable { far, .. }, .. }
            | FaultInjection::Blackout { far } => flow.crosses(*far),
            FaultInjection::Router { module } | FaultInjection::Kill { module } => {
                *module == Module::Module1 || flow.crosses(*module)
            }
        }
    }
}

impl fmt::Display for FaultInjection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} in {}", self.title(), self.location())
    }
}

/// Every cable to a module.
pub(crate) fn cables_to(far: Module) -> Vec<DemoCable> {
    CABLES.into_iter().filter(|cable| cable.far == far).collect()
}

fn kind_of(fault: ObjectFault) -> FaultKind {
    match fault {
        ObjectFault::Panic => FaultKind::Panic,
        ObjectFault::Hang { .. } => FaultKind::Hang,
        ObjectFault::ErrorState => FaultKind::ErrorState,
        ObjectFault::FailInitialization => FaultKind::InitializationFailed,
        ObjectFault::Silence => FaultKind::Silence,
        ObjectFault::Flood { .. } => FaultKind::Overload,
    }
}

/// Further kinds of faults that may be reported of the object.
fn companions_of(fault: ObjectFault) -> &'static [FaultKind] {
    match fault {
        // A panic makes the object restart.
        ObjectFault::FailInitialization => &[FaultKind::Panic],
        // An object that hangs is silent as well.
        ObjectFault::Hang { .. } => &[FaultKind::Silence],
        ObjectFault::Panic
        | ObjectFault::ErrorState
        | ObjectFault::Silence
        | ObjectFault::Flood { .. } => &[],
    }
}

fn cut(order: OrderId) -> impl Fn(Vec<String>) -> DirectorCommand {
    move |cables| DirectorCommand::Cut { order, cables }
}

fn restore(order: OrderId) -> impl Fn(Vec<String>) -> DirectorCommand {
    move |cables| DirectorCommand::Restore { order, cables }
}

fn at_both_ends(
    cables: &[DemoCable],
    command: impl Fn(Vec<String>) -> DirectorCommand,
) -> Vec<(Module, DirectorCommand)> {
    let here = |module| {
        let touching = cables.iter().filter(move |cable| cable.touches(module));
        touching.map(|cable| cable.name.to_owned()).collect::<Vec<_>>()
    };
    let ends = Module::ALL.into_iter().map(|module| (module, here(module)));
    ends.filter(|(_, names)| !names.is_empty())
        .map(|(module, names)| (module, command(names)))
        .collect()
}

fn is_node(name: &str, module: Module) -> bool {
    name == module.name()
}

fn is_cable(location: &FaultLocation, cable: &DemoCable) -> bool {
    matches!(location, FaultLocation::Link { link, .. } if **link == *cable.name)
}

fn touches(location: &FaultLocation, module: Module) -> bool {
    match location {
        FaultLocation::Object(address) => is_node(address.node.as_str(), module),
        FaultLocation::Node(node) => is_node(node.as_str(), module),
        FaultLocation::Link { node, link, .. } => {
            is_node(node.as_str(), module)
                || CABLES.iter().any(|cable| *cable.name == **link && cable.touches(module))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine_instant::MachineInstant;
    use blastema::core::NodeName;

    fn note(kind: FaultKind, location: FaultLocation) -> FaultNote {
        let detail = String::new();
        FaultNote {
            id: 1,
            kind,
            location,
            found_at: MachineInstant::default(),
            detail,
            symptom_of: None,
        }
    }

    fn object(module: Module, object: &str) -> FaultLocation {
        FaultLocation::Object(address(module, object))
    }

    fn link(node: &str, link: &str) -> FaultLocation {
        let node = NodeName::new(node).expect("a name");
        FaultLocation::Link { node, link: link.into(), neighbour: None }
    }

    fn strike(fault: ObjectFault) -> FaultInjection {
        FaultInjection::Object { module: Module::Module1, object: "planner".into(), fault }
    }

    #[test]
    fn the_struck_object_is_named_and_its_innocent_neighbour_is_not() {
        let hang = strike(ObjectFault::Hang { millis: 1 });
        let check = |kind, location, wanted| {
            assert_eq!(hang.judge(&note(kind, location)), wanted);
        };
        check(FaultKind::Hang, object(Module::Module1, "planner"), FaultMatch::Named);
        check(FaultKind::Silence, object(Module::Module1, "planner"), FaultMatch::Companion);
        check(FaultKind::Panic, object(Module::Module1, "planner"), FaultMatch::Foreign);
        check(FaultKind::Hang, object(Module::Module1, "safety"), FaultMatch::Foreign);
        check(FaultKind::Hang, object(Module::Module2, "planner"), FaultMatch::Foreign);

        let mut victim = note(FaultKind::Silence, object(Module::Module1, "safety"));
        victim.symptom_of = Some(1);
        assert_eq!(hang.judge(&victim), FaultMatch::Companion);
    }

    #[test]
    fn a_cut_is_named_by_its_cable_from_either_end() {
        let cut = FaultInjection::Cut { cable: CABLES[0], returns: false };
        let check = |location, wanted| {
            assert_eq!(cut.judge(&note(FaultKind::LinkDown, location)), wanted);
        };
        check(link("module1", "ethernet"), FaultMatch::Named);
        check(link("module2", "ethernet"), FaultMatch::Named);
        check(link("module1", "ieee1394-b"), FaultMatch::Foreign);
    }

    #[test]
    fn a_killed_node_takes_its_links_and_objects_along() {
        let kill = FaultInjection::Kill { module: Module::Module3 };
        let node = |name| FaultLocation::Node(NodeName::new(name).expect("a name"));
        let check = |kind, location, wanted| {
            assert_eq!(kill.judge(&note(kind, location)), wanted);
        };
        check(FaultKind::NodeLost, node("module3"), FaultMatch::Named);
        check(FaultKind::NodeLost, node("module2"), FaultMatch::Foreign);
        check(FaultKind::LinkDown, link("module1", "ieee1394"), FaultMatch::Companion);
        check(FaultKind::LinkDown, link("module1", "ethernet"), FaultMatch::Foreign);
        check(FaultKind::Silence, object(Module::Module3, "motors"), FaultMatch::Companion);
    }

    #[test]
    fn a_cable_is_cut_at_both_ends_and_nowhere_else() {
        let commands = FaultInjection::Blackout { far: Module::Module2 }.strike(OrderId(3));

        let cables = vec!["ethernet".to_owned(), "ieee1394-b".to_owned()];
        let wanted = DirectorCommand::Cut { order: OrderId(3), cables };
        assert_eq!(commands, [(Module::Module1, wanted.clone()), (Module::Module2, wanted)],);
    }

    #[test]
    fn all_that_passes_through_module1_waits_for_its_router() {
        assert_eq!(FaultInjection::Router { module: Module::Module1 }.flows().len(), FLOWS.len());
        assert_eq!(FaultInjection::Kill { module: Module::Module3 }.flows().len(), 3);
        assert!(strike(ObjectFault::Panic).flows().is_empty());
    }
}
