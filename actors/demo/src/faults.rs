//! The ten faults of the demonstration, and how each is judged.

use crate::messages::FaultReport;
use crate::robot::{CABLES, DemoCable, FLOWS, Flow, Module};
use blastema::{FaultKind, FaultLocation, Injection};
use serde::Serialize;
use std::fmt;

/// A fault that the demonstration injects.
#[derive(Debug, Serialize)]
pub(crate) struct DemoFault {
    /// Its kind, for the table.
    #[serde(rename = "fault")]
    pub(crate) title: &'static str,
    /// The module that is struck; of a cable the one at its far end.
    #[serde(skip)]
    pub(crate) module: Module,
    /// The object that is struck; empty if it is no component.
    #[serde(skip)]
    pub(crate) object: &'static str,
    /// What is done.
    #[serde(skip)]
    pub(crate) blow: Blow,
    /// As what the middleware must find it.
    #[serde(skip)]
    pub(crate) kind: FaultKind,
    /// What is broken.
    pub(crate) broken: &'static str,
    /// What the robot does.
    pub(crate) robot_does: &'static str,
    /// What a user sees.
    pub(crate) user_sees: &'static str,
    /// The mark of a note, and the paper's mean in milliseconds, if it measured something like it.
    pub(crate) paper: Option<(char, f64)>,
}

/// What is done to the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Blow {
    /// These injections, one after the other.
    Inject(&'static [Injection]),
    /// The object is told to break itself, in a way of its own, and keeps its incarnation or not.
    Break { restarts: bool },
    /// The object needs 2 ms for each message, and its queue is kept full until it has taken so
    /// many.
    Flood { messages: u32 },
    /// The cable is silent at both ends, and left so.
    Cut(&'static str),
    /// All cables to the module are silent, and are plugged in when that was found.
    Blackout,
    /// The router panics.
    Router,
    /// The process is killed with signal 9.
    Kill,
}

/// The relation of a reported fault to the injected one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FaultMatch {
    /// The report names the injected fault and its place.
    Named,
    /// A consequence of the injected fault, a warning, or marked as a symptom.
    Companion,
    /// The report names another place or kind.
    Foreign,
}

/// The faults in their order.
pub(crate) static FAULTS: [DemoFault; 10] = [
    fault("panic", Module::Module1, "skin/17", Blow::Inject(&[Injection::Panic]), FaultKind::Panic)
        .told([
            "A cell of the skin panics.",
            "Its supervisor makes a new one, which takes the messages that wait.",
            "Nothing: the cell feels again before its next round.",
        ])
        .paper('a', 11.1),
    fault("hang", Module::Module2, "laser", Blow::Break { restarts: true }, FaultKind::Hang).told(
        [
            "A handler of the laser keeps its thread for 2.5 s.",
            "The thread is abandoned; the laser and its neighbours are restarted on another one.",
            "Nothing: for half a second the robot drives on by the last sweep.",
        ],
    ),
    fault(
        "error state",
        Module::Module3,
        "motors",
        Blow::Break { restarts: false },
        FaultKind::ErrorState,
    )
    .told([
        "The motors report an error of their device.",
        "They are reset, with their wheels stopped, and go to work again.",
        "The robot stops for a moment.",
    ]),
    fault(
        "failed initialisation",
        Module::Module1,
        "planner",
        Blow::Inject(&[Injection::FailedInitializations(1), Injection::Panic]),
        FaultKind::InitializationFailed,
    )
    .told([
        "The planner panics, and the next one cannot be initialised.",
        "The supervisor tries again, and the second one comes to work.",
        "The robot stops until it gets commands again: the motors need one every 200 ms.",
    ]),
    fault(
        "silent object",
        Module::Module3,
        "odometry",
        Blow::Inject(&[Injection::Silence]),
        FaultKind::Silence,
    )
    .told([
        "The odometry gives no sign of life.",
        "It is restarted after five that were missed.",
        "The robot counts its position from the start again.",
    ]),
    fault("cable cut", CABLES[0].far, "", Blow::Cut(CABLES[0].name), FaultKind::LinkDown)
        .told([
            "The first cable to the head goes silent, and stays so.",
            "Hellos are missed, and all messages take the second path.",
            "Nothing: what was on its way is sent again.",
        ])
        .paper('b', 12.0),
    fault("both cables cut, return", CABLES[0].far, "", Blow::Blackout, FaultKind::NodeLost).told(
        [
            "Both cables to the head are silent until that is found.",
            "Each side works on alone, and sessions go on when the cables return.",
            "The robot stands still: without a sweep of the laser the planner gives no command.",
        ],
    ),
    fault("panic in the router", Module::Module1, "", Blow::Router, FaultKind::Panic).told([
        "The router of the middle module panics: the middleware itself breaks.",
        "The guardian makes a new one, to which links and sessions attach.",
        "Nothing: what was on its way is sent again.",
    ]),
    fault("kill -9, rejoin", Module::Module3, "", Blow::Kill, FaultKind::NodeLost).told([
        "The process of the base is killed.",
        "The director, whose child it is, starts it again, and it joins the robot.",
        "The robot stands still until its base is back.",
    ]),
    fault(
        "flood",
        Module::Module2,
        "operator",
        Blow::Flood { messages: 1_000 },
        FaultKind::Overload,
    )
    .told([
        "The operator's panel gets twice the messages that its queue holds.",
        "What exceeds the queue is refused to its sender, and the rest is served in order.",
        "The panel is late for some seconds, and the robot drives on.",
    ]),
];

/// A fault in the object of this name; an empty one for what is no component.
const fn fault(
    title: &'static str,
    module: Module,
    object: &'static str,
    blow: Blow,
    kind: FaultKind,
) -> DemoFault {
    let [broken, robot_does, user_sees] = [""; 3];
    let paper = None;
    DemoFault { title, module, object, blow, kind, broken, robot_does, user_sees, paper }
}

impl DemoFault {
    const fn told(mut self, story: [&'static str; 3]) -> DemoFault {
        [self.broken, self.robot_does, self.user_sees] = story;
        self
    }

    const fn paper(mut self, mark: char, mean_ms: f64) -> DemoFault {
        self.paper = Some((mark, mean_ms));
        self
    }

    /// Returns the place, for the table.
    pub(crate) fn place(&self) -> String {
        let module = self.module;
        match self.blow {
            Blow::Cut(cable) => format!("{} -{cable}- {module}", Module::Module1),
            Blow::Blackout => format!("{} - {module}", Module::Module1),
            Blow::Router => format!("{module}, its router"),
            Blow::Kill => module.to_string(),
            Blow::Inject(_) | Blow::Break { .. } | Blow::Flood { .. } => {
                format!("{module}:{}", self.object)
            }
        }
    }

    /// Returns the cables that are cut.
    pub(crate) fn cables(&self) -> impl Iterator<Item = DemoCable> + '_ {
        CABLES.into_iter().filter(|cable| match self.blow {
            Blow::Cut(name) => cable.name == name,
            Blow::Blackout => cable.far == self.module,
            _ => false,
        })
    }

    /// Returns the modules in which something is done.
    pub(crate) fn struck(&self) -> Vec<Module> {
        match self.blow {
            Blow::Cut(_) | Blow::Blackout => vec![Module::Module1, self.module],
            _ => vec![self.module],
        }
    }

    /// Returns the flows on which messages must arrive again; none if the object must answer.
    pub(crate) fn flows(&self) -> impl Iterator<Item = &'static Flow> + '_ {
        FLOWS.iter().filter(|flow| self.object.is_empty() && flow.passes(self.module))
    }

    /// Returns whether a report of this fault proves it over: of an object, if its recovery was
    /// reported. Software cannot recover a cut cable, a process, or a computer that has no time.
    pub(crate) fn is_settled_by(&self, report: &FaultReport) -> bool {
        report.recovered || !matches!(report.location, FaultLocation::Object(_))
    }

    /// Returns whether this fault, found before the injection and not ended, may be the only one: an
    /// overload that stands is not found again.
    pub(crate) fn may_stand_before(&self, report: &FaultReport) -> bool {
        report.kind == FaultKind::Overload && self.judge(report) == FaultMatch::Named
    }

    /// Returns the relation of a reported fault to this one.
    pub(crate) fn judge(&self, report: &FaultReport) -> FaultMatch {
        let (FaultReport { kind, location, .. }, module) = (report, self.module);
        let is_kind = *kind == self.kind;
        let is_cut = |link: &str| self.cables().any(|cable| cable.name == link);
        let (named, touched) = match (self.blow, location) {
            (Blow::Cut(_) | Blow::Blackout, FaultLocation::Link { link, .. }) => {
                (is_cut(link) && *kind == FaultKind::LinkDown, is_cut(link))
            }
            // Each side loses all that it reached through the other one.
            (Blow::Blackout, _) => (is_kind, is_kind),
            (Blow::Router, FaultLocation::Object(at)) => {
                let here = at.node.as_str() == module.name() && at.object.as_str() == "net/stack";
                (here && is_kind, here)
            }
            // A module that gets no processor names the computer, and the panel as its victim.
            (Blow::Flood { .. }, FaultLocation::Node(node)) => {
                (is_kind && node.as_str() == module.name(), false)
            }
            (Blow::Kill, FaultLocation::Node(node)) => {
                let here = node.as_str() == module.name();
                (here && is_kind, here)
            }
            (Blow::Kill, FaultLocation::Object(at)) => (false, at.node.as_str() == module.name()),
            (Blow::Kill, FaultLocation::Link { node, link, .. }) => {
                let ends = CABLES.iter().find(|cable| *cable.name == **link).map(|cable| cable.far);
                (false, node.as_str() == module.name() || ends == Some(module))
            }
            (_, FaultLocation::Object(at)) if !self.object.is_empty() => {
                let here = at.node.as_str() == module.name() && at.object.as_str() == self.object;
                // An object that hangs is silent as well; to fail its initialisation it must panic.
                let along = match self.kind {
                    FaultKind::Hang => *kind == FaultKind::Silence,
                    FaultKind::InitializationFailed => *kind == FaultKind::Panic,
                    _ => false,
                };
                (here && is_kind, here && along)
            }
            _ => (false, false),
        };
        match (named, touched || report.is_warning() || report.symptom_of.is_some()) {
            (true, _) => FaultMatch::Named,
            (false, true) => FaultMatch::Companion,
            (false, false) => FaultMatch::Foreign,
        }
    }
}

impl fmt::Display for DemoFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} in {}", self.title, self.place())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema::FaultId;
    use blastema::core::{NodeName, ObjectAddress, ObjectName};

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a name")
    }

    fn object(module: &str, object: &str) -> FaultLocation {
        let object = ObjectName::new(object).expect("a name");
        FaultLocation::Object(ObjectAddress::new(node(module), object))
    }

    fn link(module: &str, link: &str) -> FaultLocation {
        FaultLocation::Link { node: node(module), link: link.into(), neighbour: None }
    }

    fn check(title: &str, kind: FaultKind, location: FaultLocation, wanted: FaultMatch) {
        let fault =
            FAULTS.iter().find(|fault| fault.title == title).expect("there is such a fault");
        let mut report = crate::robot_state::fake::fault(1, kind, location);
        assert_eq!(fault.judge(&report), wanted, "{title}: {report:?}");
        if wanted == FaultMatch::Foreign {
            report.symptom_of = Some(FaultId(1));
            assert_eq!(fault.judge(&report), FaultMatch::Companion, "{title}: {report:?}");
        }
    }

    #[test]
    fn the_struck_object_is_named_and_its_innocent_neighbour_is_not() {
        check("hang", FaultKind::Hang, object("module2", "laser"), FaultMatch::Named);
        check("hang", FaultKind::Silence, object("module2", "laser"), FaultMatch::Companion);
        check("hang", FaultKind::Panic, object("module2", "laser"), FaultMatch::Foreign);
        check("hang", FaultKind::Hang, object("module2", "operator"), FaultMatch::Foreign);
        check("hang", FaultKind::Hang, object("module1", "laser"), FaultMatch::Foreign);
        let router = object("module1", "net/stack");
        check("panic in the router", FaultKind::Panic, router.clone(), FaultMatch::Named);
        check("panic", FaultKind::Panic, router, FaultMatch::Foreign);
    }

    #[test]
    fn a_flood_is_named_by_its_panel_or_by_its_module_that_has_no_time() {
        let check = |location, wanted| check("flood", FaultKind::Overload, location, wanted);
        check(object("module2", "operator"), FaultMatch::Named);
        check(object("module2", "laser"), FaultMatch::Companion);
        check(FaultLocation::Node(node("module2")), FaultMatch::Named);
        check(FaultLocation::Node(node("module1")), FaultMatch::Companion);
    }

    #[test]
    fn a_cut_is_named_by_its_cable_from_either_end() {
        for end in ["module1", "module2"] {
            check("cable cut", FaultKind::LinkDown, link(end, "ethernet"), FaultMatch::Named);
        }
        let other = link("module1", "ieee1394-b");
        check("cable cut", FaultKind::LinkDown, other.clone(), FaultMatch::Foreign);
        check("both cables cut, return", FaultKind::LinkDown, other, FaultMatch::Named);
    }

    #[test]
    fn a_killed_node_takes_its_links_and_objects_along() {
        let check = |kind, location, wanted| check("kill -9, rejoin", kind, location, wanted);
        check(FaultKind::NodeLost, FaultLocation::Node(node("module3")), FaultMatch::Named);
        check(FaultKind::NodeLost, FaultLocation::Node(node("module2")), FaultMatch::Foreign);
        check(FaultKind::LinkDown, link("module1", "ieee1394"), FaultMatch::Companion);
        check(FaultKind::LinkDown, link("module1", "ethernet"), FaultMatch::Foreign);
        check(FaultKind::Silence, object("module3", "motors"), FaultMatch::Companion);
        let lost = FaultLocation::Node(node("module3"));
        check(FaultKind::ConnectionLost, lost, FaultMatch::Companion);
    }

    #[test]
    fn all_that_passes_through_the_middle_waits_for_its_router() {
        let flows = |title: &str| {
            let fault = FAULTS.iter().find(|fault| fault.title == title).expect("there is one");
            fault.flows().count()
        };
        assert_eq!(flows("panic in the router"), FLOWS.len());
        assert_eq!(flows("kill -9, rejoin"), 3);
        assert_eq!(flows("panic"), 0);
    }
}
