//! The types of nodes: their names, ports and numbers of children.

use crate::status::Status;
use crate::value::{PortType, PortValue, Value};
use std::ops::RangeInclusive;

/// The direction of a port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PortDirection {
    /// The node reads it.
    Input,
    /// The node writes it.
    Output,
    /// The node reads and writes it.
    InOut,
}

/// What right values are called, and which they are.
type PortLimit = (&'static str, fn(&Value) -> bool);

/// A port of a type of node.
#[derive(Clone, Debug)]
pub struct Port {
    pub(crate) name: &'static str,
    pub(crate) direction: PortDirection,
    pub(crate) kind: PortType,
    pub(crate) default: Option<&'static str>,
    pub(crate) optional: bool,
    pub(crate) limit: Option<PortLimit>,
    pub(crate) role: PortRole,
    pub(crate) about: &'static str,
}

impl Port {
    const fn new(name: &'static str, direction: PortDirection, kind: PortType) -> Port {
        Port {
            name,
            direction,
            kind,
            default: None,
            optional: false,
            limit: None,
            role: PortRole::Value,
            about: "",
        }
    }

    /// A port that the node reads. Each tree must give it, unless it has a default or is optional.
    pub const fn input<T: PortValue>(name: &'static str) -> Port {
        Port::new(name, PortDirection::Input, T::TYPE)
    }

    /// A port that the node writes. A tree need not connect it.
    pub const fn output<T: PortValue>(name: &'static str) -> Port {
        Port::new(name, PortDirection::Output, T::TYPE)
    }

    /// A port that the node reads and writes.
    pub const fn inout<T: PortValue>(name: &'static str) -> Port {
        Port::new(name, PortDirection::InOut, T::TYPE)
    }

    /// Returns the port's name.
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// The port's default, as a tree would write it: `3.0` or `{key}`.
    pub const fn or(mut self, default: &'static str) -> Port {
        self.default = Some(default);
        self
    }

    /// A tree need not give the port.
    pub const fn optional(mut self) -> Port {
        self.optional = true;
        self
    }

    /// Only values that are right are taken, which are called so: `share from 0 to 1`. Another one
    /// in a file is an error of the file, and one that is read from an entry is an error of the leaf.
    pub const fn only(mut self, kind: &'static str, is_right: fn(&Value) -> bool) -> Port {
        self.limit = Some((kind, is_right));
        self
    }

    /// What values are called that this one is not, if it may not be given.
    pub(crate) fn refuses(&self, value: &Value) -> Option<&'static str> {
        self.limit.and_then(|(kind, is_right)| (!is_right(value)).then_some(kind))
    }

    /// A sentence for editors of trees.
    pub const fn about(mut self, about: &'static str) -> Port {
        self.about = about;
        self
    }

    const fn role(mut self, role: PortRole) -> Port {
        self.role = role;
        self
    }
}

/// The meaning of a port's text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PortRole {
    /// A value, or in braces the entry that holds it.
    Value,
    Script,
    /// The name of an entry, or in braces the entry that holds its name.
    Name,
    /// The name of an entry, in braces or not.
    Entry,
}

/// The kinds of leaves of the application.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeafKind {
    /// Called in each tick; may answer RUNNING.
    Condition,
    /// Called in each tick; does not answer RUNNING.
    SyncAction,
    /// Started, then asked in each tick while it is RUNNING, and halted if it is left.
    Action,
}

/// The types of nodes, some of which differ in a parameter only.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Kind {
    /// `Sequence`, `Fallback` and their like.
    Ordered(TickOrder),
    /// `ReactiveSequence` and `ReactiveFallback`.
    Reactive { go: Status },
    /// All children in each tick, until enough have ended.
    Parallel,
    /// All children in each tick, until all have ended.
    ParallelAll,
    /// `IfThenElse`, or `WhileDoElse`, which looks at its condition in each tick.
    Branch { looks_again: bool },
    /// With so many cases.
    Switch(u8),
    /// The last child is ticked when one of the others fails.
    TryCatch,
    /// SUCCESS for FAILURE, and FAILURE for SUCCESS.
    Inverter,
    /// `ForceSuccess` and `ForceFailure`.
    Force(Status),
    /// `Repeat` ends with FAILURE, `RetryUntilSuccessful` with SUCCESS.
    Repeat { until: Status },
    /// Its child begins again until it fails.
    KeepRunningUntilFailure,
    /// Its child begins after a time.
    Delay,
    /// Its child is halted after a time.
    Timeout,
    /// Its child is run to its end once.
    RunOnce,
    /// Its child is ticked where an expression holds.
    Precondition,
    /// Its child is ticked for each element of a queue.
    Loop,
    /// `SkipUnlessUpdated` and `WaitValueUpdate`: the answer while the entry is not written.
    Updated(Status),
    /// A tree by its id.
    #[default]
    SubTree,
    /// `AlwaysSuccess` and `AlwaysFailure`.
    Always(Status),
    /// Runs a script.
    Script,
    /// Whether an expression holds.
    ScriptCondition,
    /// Writes an entry.
    SetBlackboard,
    /// Removes an entry.
    UnsetBlackboard,
    /// RUNNING for a time.
    Sleep,
    /// Whether an entry was written since it was last asked.
    WasEntryUpdated,
    /// A leaf of the user.
    Leaf(LeafKind),
}

/// A rule by which children are ticked in turn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TickOrder {
    /// The answer after which the next child is ticked; any other one stops.
    pub(crate) go: Status,
    /// A child that is done at once ends the tick.
    pub(crate) yields: bool,
    /// Neither a stop nor a halt leads back to the first child.
    pub(crate) keeps: bool,
}

impl TickOrder {
    pub(crate) const SEQUENCE: TickOrder =
        TickOrder { go: Status::Success, yields: false, keeps: false };
    const FALLBACK: TickOrder = TickOrder { go: Status::Failure, ..TickOrder::SEQUENCE };
    const ASYNC_SEQUENCE: TickOrder = TickOrder { yields: true, ..TickOrder::SEQUENCE };
    const ASYNC_FALLBACK: TickOrder = TickOrder { yields: true, ..TickOrder::FALLBACK };
    const WITH_MEMORY: TickOrder = TickOrder { keeps: true, ..TickOrder::ASYNC_SEQUENCE };
}

impl Kind {
    /// The numbers of children that a node may have.
    pub(crate) fn children(self) -> RangeInclusive<usize> {
        use Kind::*;
        match self {
            Branch { .. } => 2..=3,
            Switch(cases) => usize::from(cases) + 1..=usize::from(cases) + 1,
            TryCatch => 2..=usize::MAX,
            Ordered(_) | Reactive { .. } | Parallel | ParallelAll => 1..=usize::MAX,
            Always(_) | Script | ScriptCondition | SetBlackboard | UnsetBlackboard | Sleep
            | WasEntryUpdated | Leaf(_) => 0..=0,
            _ => 1..=1,
        }
    }
}

/// A port of no particular type.
const fn any(name: &'static str, direction: PortDirection) -> Port {
    Port::new(name, direction, PortType::ANY)
}

const fn loops<T: PortValue>() -> [Port; 3] {
    [any("queue", PortDirection::InOut), IF_EMPTY, Port::output::<T>("value")]
}
const IF_EMPTY: Port = Port::input::<Status>("if_empty").or("SUCCESS");
const ENTRY: Port = any("entry", PortDirection::Input).role(PortRole::Entry);
const CODE: Port = Port::input::<String>("code").role(PortRole::Script);
/// The ports of `Switch2` are the first three, and so on.
const SWITCH: [Port; 7] = [
    Port::input::<String>("variable").optional(),
    Port::input::<String>("case_1").optional(),
    Port::input::<String>("case_2").optional(),
    Port::input::<String>("case_3").optional(),
    Port::input::<String>("case_4").optional(),
    Port::input::<String>("case_5").optional(),
    Port::input::<String>("case_6").optional(),
];

/// The name, kind and ports of a type of node.
pub(crate) type Builtin = (&'static str, Kind, &'static [Port]);

/// All types of nodes of BehaviorTree.CPP 4.10 that need no application, but for
/// `ManualSelector`, which asks on a terminal.
pub(crate) static BUILTINS: [Builtin; 42] = [
    ("Sequence", Kind::Ordered(TickOrder::SEQUENCE), &[]),
    ("AsyncSequence", Kind::Ordered(TickOrder::ASYNC_SEQUENCE), &[]),
    ("SequenceWithMemory", Kind::Ordered(TickOrder::WITH_MEMORY), &[]),
    ("ReactiveSequence", Kind::Reactive { go: Status::Success }, &[]),
    ("Fallback", Kind::Ordered(TickOrder::FALLBACK), &[]),
    ("AsyncFallback", Kind::Ordered(TickOrder::ASYNC_FALLBACK), &[]),
    ("ReactiveFallback", Kind::Reactive { go: Status::Failure }, &[]),
    (
        "Parallel",
        Kind::Parallel,
        &[
            Port::input::<i32>("success_count").or("-1"),
            Port::input::<i32>("failure_count").or("1"),
        ],
    ),
    ("ParallelAll", Kind::ParallelAll, &[Port::input::<i32>("max_failures").or("1")]),
    ("IfThenElse", Kind::Branch { looks_again: false }, &[]),
    ("WhileDoElse", Kind::Branch { looks_again: true }, &[]),
    ("Switch2", Kind::Switch(2), SWITCH.split_at(3).0),
    ("Switch3", Kind::Switch(3), SWITCH.split_at(4).0),
    ("Switch4", Kind::Switch(4), SWITCH.split_at(5).0),
    ("Switch5", Kind::Switch(5), SWITCH.split_at(6).0),
    ("Switch6", Kind::Switch(6), &SWITCH),
    ("TryCatch", Kind::TryCatch, &[Port::input::<bool>("catch_on_halt").or("false")]),
    ("Inverter", Kind::Inverter, &[]),
    ("ForceSuccess", Kind::Force(Status::Success), &[]),
    ("ForceFailure", Kind::Force(Status::Failure), &[]),
    ("Repeat", Kind::Repeat { until: Status::Failure }, &[Port::input::<i32>("num_cycles")]),
    (
        "RetryUntilSuccessful",
        Kind::Repeat { until: Status::Success },
        &[Port::input::<i32>("num_attempts")],
    ),
    ("KeepRunningUntilFailure", Kind::KeepRunningUntilFailure, &[]),
    ("Delay", Kind::Delay, &[Port::input::<u32>("delay_msec")]),
    ("Timeout", Kind::Timeout, &[Port::input::<u32>("msec")]),
    ("RunOnce", Kind::RunOnce, &[Port::input::<bool>("then_skip").or("true")]),
    (
        "Precondition",
        Kind::Precondition,
        &[
            Port::input::<String>("if").role(PortRole::Script),
            Port::input::<Status>("else").or("FAILURE"),
        ],
    ),
    ("LoopInt", Kind::Loop, &const { loops::<i32>() }),
    ("LoopBool", Kind::Loop, &const { loops::<bool>() }),
    ("LoopDouble", Kind::Loop, &const { loops::<f64>() }),
    ("LoopString", Kind::Loop, &const { loops::<String>() }),
    ("SkipUnlessUpdated", Kind::Updated(Status::Skipped), &[ENTRY]),
    ("WaitValueUpdate", Kind::Updated(Status::Running), &[ENTRY]),
    ("SubTree", Kind::SubTree, &[]),
    ("AlwaysSuccess", Kind::Always(Status::Success), &[]),
    ("AlwaysFailure", Kind::Always(Status::Failure), &[]),
    ("Script", Kind::Script, &[CODE]),
    ("ScriptCondition", Kind::ScriptCondition, &[CODE]),
    (
        "SetBlackboard",
        Kind::SetBlackboard,
        &[
            any("value", PortDirection::Input),
            any("output_key", PortDirection::InOut).role(PortRole::Name),
        ],
    ),
    (
        "UnsetBlackboard",
        Kind::UnsetBlackboard,
        &[Port::input::<String>("key").role(PortRole::Name)],
    ),
    ("Sleep", Kind::Sleep, &[Port::input::<u32>("msec")]),
    ("WasEntryUpdated", Kind::WasEntryUpdated, &[ENTRY]),
];

/// Whether nodes and trees may have this name.
pub(crate) fn may_be_name(name: &str) -> bool {
    let forbidden = |c: char| c.is_control() || " <>&\"'/\\:*?|.".contains(c);
    !name.is_empty() && !name.eq_ignore_ascii_case("root") && !name.contains(forbidden)
}

/// Whether an attribute of this name connects a port: not `name`, `ID` and what begins with `_`.
pub(crate) fn is_port(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_alphabetic()) && name != "name" && name != "ID"
}

/// The key that the text of a port names, if it names one: `{key}` with blanks around it, or `{=}`
/// and `=` for the port's own name.
pub(crate) fn key_of<'a>(port: &'a str, text: &'a str) -> Option<&'a str> {
    if text == "=" {
        return Some(port);
    }
    let key = text.trim_matches(' ').strip_prefix('{')?.strip_suffix('}')?;
    Some(if key == "=" { port } else { key.trim_matches(' ') })
}
