//! The list of faults that is fixed when the robot is designed.

use crate::{Incarnation, Instant, NodeName, ObjectAddress};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// The kind of a fault. The plan chooses the recovery by it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[non_exhaustive]
pub enum FaultKind {
    /// A component panicked in a handler, hook, timer or task of its own.
    Panic,
    /// A component ended without an order to stop.
    UnexpectedExit,
    /// A handler keeps its arbiter, or waits, longer than it may.
    Hang,
    /// An object that should give a sign of life gave none.
    Silence,
    /// A component reported that it is in error.
    ErrorState,
    /// A component's `on_initialize` failed.
    InitializationFailed,
    /// A component, or its supervisor, declared that this incarnation cannot go on.
    Fatal,
    /// Data that is checked at a fixed point was wrong.
    CheckFailed,
    /// A component works, and is, or makes others on its thread, later than they may be. Or a topic
    /// loses a tenth of its events for lack of capacity.
    Overload,
    /// Two parties hold different versions of one contract.
    ContractMismatch,
    /// A link to a neighbour is gone.
    LinkDown,
    /// A link delivers late or loses too much.
    LinkDegraded,
    /// A node cannot be reached over any path, or has died.
    NodeLost,
    /// The same fault came back more often than its supervisor allows.
    RestartStorm,
    /// Another node does harm: what it sends must be refused, or it dies again and again. Or it was
    /// isolated by others.
    NodeFaulty,
    /// Two have one name: two nodes, or two claimants that were out of each other's sight; or two
    /// nodes have one address on a bus.
    NameTaken,
    /// A commander is gone without giving its actuator back, and none has claimed it since.
    CommanderGone,
    /// A whole node is in the safe state: its safe outputs were applied, and nothing of it
    /// serves.
    NodeInSafeState,
    /// A service goes on, and too few others hold its state for it to outlive the node that serves.
    Unreplicated,
    /// A service went on without a part of its state for which callers had been answered: no node
    /// that held it was left.
    StateLost,
    /// A service has no primary, as far as a node knows that carries it, for longer than a takeover
    /// takes.
    ServiceUnavailable,
    /// Something that a component needs to begin its work, such as its device, is not there yet. It
    /// tries again by itself, for as long as that takes.
    Unavailable,
    /// Another node's process dies and is started again, over and over.
    CrashLoop,
    /// No thread of this node ran for a while: its process was stopped, or its computer stood
    /// still. What it finds of links and other nodes just then is a symptom of that.
    NodePaused,
    /// A network leaves the computer without authentication: every station on it can command the
    /// robot. It stands while the node runs.
    Insecure,
    /// A node wanted to do what the robot's policy does not let it: shown by the node that refused
    /// it, and by the one whose subscription was refused.
    Forbidden,
    /// A condition does not hold: an operator, a node or a topic is silent for longer than it may
    /// be. Or accepted messages were lost with the session to another node.
    ConnectionLost,
    /// A fault of the application's own list.
    Custom(Arc<str>),
}

/// The most bytes of a fault's detail, and of what is kept beside it.
const DETAIL_MAX: usize = 2_048;

/// The beginning of a text about a fault. The rest of a longer one is not kept.
pub fn shortened(text: &str) -> &str {
    let end = (0..=DETAIL_MAX.min(text.len())).rev().find(|&at| text.is_char_boundary(at));
    &text[..end.unwrap_or_default()]
}

/// How bad a fault is for the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Service goes on; a user should look.
    Warning,
    /// A service is interrupted until recovery has done its work.
    Error,
    /// Several services are gone, or recovery itself failed.
    Critical,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Severity::Warning => "warning",
            Severity::Error => "error",
            Severity::Critical => "critical",
        })
    }
}

/// What is known of the built-in kinds, in the order of their codes: code, text, severity, and
/// whether what depends on the place of such a fault suffers from it.
static BUILT_IN: [(FaultKind, &str, &str, Severity, bool); 27] = {
    use FaultKind::*;
    use Severity::{Critical, Error, Warning};
    [
        (Panic, "B01", "panic", Error, true),
        (UnexpectedExit, "B02", "unexpected exit", Error, true),
        (Hang, "B03", "hang", Error, true),
        (Silence, "B04", "silence", Error, true),
        (ErrorState, "B05", "error state", Error, true),
        (InitializationFailed, "B06", "initialisation failed", Error, true),
        (Fatal, "B07", "fatal error", Critical, true),
        (CheckFailed, "B08", "check failed", Warning, false),
        (Overload, "B09", "overload", Warning, false),
        (ContractMismatch, "B10", "contract mismatch", Error, false),
        (LinkDown, "B11", "link down", Error, true),
        (LinkDegraded, "B12", "link degraded", Warning, false),
        (NodeLost, "B13", "node lost", Critical, true),
        (RestartStorm, "B14", "restart storm", Critical, true),
        (NodeFaulty, "B15", "node faulty", Critical, true),
        (NameTaken, "B16", "name taken", Error, false),
        (CommanderGone, "B17", "commander gone", Warning, false),
        (NodeInSafeState, "B18", "node in safe state", Critical, true),
        (Unreplicated, "B19", "service unreplicated", Warning, false),
        (StateLost, "B20", "state lost", Critical, false),
        (ServiceUnavailable, "B21", "service unavailable", Error, true),
        (Unavailable, "B22", "unavailable", Error, true),
        (CrashLoop, "B23", "crash loop", Critical, true),
        (NodePaused, "B24", "node paused", Warning, false),
        (Insecure, "B25", "insecure", Warning, false),
        (Forbidden, "B26", "forbidden", Warning, false),
        (ConnectionLost, "B27", "connection lost", Error, false),
    ]
};

impl FaultKind {
    /// Every built-in kind, in the order of its code.
    pub fn built_in() -> impl Iterator<Item = &'static FaultKind> {
        BUILT_IN.iter().map(|(kind, ..)| kind)
    }

    fn facts(&self) -> Option<&'static (FaultKind, &'static str, &'static str, Severity, bool)> {
        BUILT_IN.iter().find(|(kind, ..)| kind == self)
    }

    /// The code by which logs, tables and manuals know this kind: `B01` to `B27`, or the
    /// application's own.
    pub fn code(&self) -> &str {
        self.own().unwrap_or_else(|| self.facts().map_or("", |facts| facts.1))
    }

    /// A text that a person understands.
    pub fn text(&self) -> &str {
        self.own().unwrap_or_else(|| self.facts().map_or("", |facts| facts.2))
    }

    /// Returns the default severity of this kind.
    pub fn severity(&self) -> Severity {
        self.facts().map_or(Severity::Error, |facts| facts.3)
    }

    /// Whether a place with this fault no longer serves those that depend on it.
    pub(crate) fn is_down(&self) -> bool {
        self.facts().is_some_and(|facts| facts.4)
    }

    fn own(&self) -> Option<&str> {
        match self {
            FaultKind::Custom(code) => Some(code),
            _ => None,
        }
    }
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.text())
    }
}

/// Where a fault is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum FaultLocation {
    /// In an object.
    Object(ObjectAddress),
    /// In a link from one node to a neighbour, by the link's name.
    Link {
        /// Who sees the link.
        node: NodeName,
        /// The link's name in that node's configuration.
        link: Arc<str>,
        /// Who is at its other end, once known.
        neighbour: Option<NodeName>,
    },
    /// A whole node.
    Node(NodeName),
}

impl fmt::Display for FaultLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FaultLocation::Object(address) => write!(f, "{address}"),
            FaultLocation::Link { node, link, neighbour: Some(neighbour) } => {
                write!(f, "{node} -{link}- {neighbour}")
            }
            FaultLocation::Link { node, link, neighbour: None } => write!(f, "{node} -{link}-"),
            FaultLocation::Node(node) => write!(f, "{node}"),
        }
    }
}

/// The number of a fault, assigned by the detector of the node that found it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FaultId(pub u64);

impl fmt::Display for FaultId {
    /// As in `fault 7`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "fault {}", self.0)
    }
}

/// A fault that was found: what, where, since when, and how often since.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fault {
    /// Its number in the finder's record.
    pub id: FaultId,
    /// The kind of the fault.
    pub kind: FaultKind,
    /// How bad it is.
    pub severity: Severity,
    /// Where it is.
    pub location: FaultLocation,
    /// Which incarnation of the place it struck.
    pub incarnation: Incarnation,
    /// The particulars: a panic's text and source line, a check's value and limit. Of one that was
    /// found again while it stood, those of the last time.
    pub detail: String,
    /// When it was found, on the finder's clock. It is no good on another one: its encoding is
    /// without it.
    #[serde(skip)]
    pub found_at: Instant,
    /// The fault further up that this one is a consequence of.
    pub symptom_of: Option<FaultId>,
    /// How often it was seen while latched; 1 for once.
    pub count: u32,
}

impl fmt::Display for Fault {
    /// As in `error: hang of module1:arm: a handler of Drive keeps its thread`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} of {}", self.severity, self.kind, self.location)?;
        match self.detail.as_str() {
            "" => Ok(()),
            detail => write!(f, ": {detail}"),
        }
    }
}

impl Fault {
    /// Whether restored service means that the cause is away.
    ///
    /// It does for an object: a component that was restarted is as good as new. What a component
    /// found itself is over when it says so, or has not found it for long. A link or a node is
    /// repaired only when it is there again, whatever path the traffic takes meanwhile.
    pub fn is_repaired_by_recovery(&self) -> bool {
        let is_own = matches!(self.kind, FaultKind::CheckFailed | FaultKind::Custom(_));
        matches!(self.location, FaultLocation::Object(_)) && !is_own
    }

    /// The fault as the reason of what follows from it, such as `hang: Move has kept its thread for
    /// 500 ms at least, fault 7`.
    pub fn as_reason(&self) -> String {
        let Fault { kind, detail, id, symptom_of, .. } = self;
        let root = symptom_of.map(|root| format!(", a symptom of fault {}", root.0));
        format!("{kind}: {detail}, fault {}{}", id.0, root.unwrap_or_default())
    }

    /// A fault of a whole node that its controller found itself: it stands in no detector's record.
    #[doc(hidden)]
    pub fn of_node(node: NodeName, kind: FaultKind, detail: String, found_at: Instant) -> Self {
        Fault {
            id: FaultId(0),
            severity: Severity::Critical,
            kind,
            location: FaultLocation::Node(node),
            incarnation: Incarnation::FIRST,
            detail,
            found_at,
            symptom_of: None,
            count: 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::de::IntoDeserializer;
    use serde::de::value::{Error, StrDeserializer};

    fn parsed(name: &str) -> Result<FaultKind, Error> {
        let name: StrDeserializer<'_, Error> = name.into_deserializer();
        FaultKind::deserialize(name)
    }

    #[test]
    fn every_built_in_kind_has_its_row() {
        // Of what is no kind, serde says which kinds there are, each between backticks.
        let error = parsed("").expect_err("no kind").to_string();
        let names = error.split('`').skip(3).step_by(2).filter(|name| *name != "Custom");
        let kinds: Vec<_> = names.map(|name| parsed(name).expect("a kind")).collect();
        assert!(FaultKind::built_in().eq(&kinds));
    }
}
