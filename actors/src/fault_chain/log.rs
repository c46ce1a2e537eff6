//! What is logged of faults, and what is printed where no log is kept.
//!
//! Every step of every fault is an event of [`tracing`] with the target `blastema::fault`:
//!
//! | step | level |
//! | --- | --- |
//! | a root is found, or again for the 2nd, 4th, 8th, … time, or was taken for a symptom | WARN for a warning, else ERROR |
//! | the recoverer gives a fault up | ERROR |
//! | a recovery action has failed, and another attempt or action follows | WARN |
//! | a symptom is found; a decision, a recovery, a repair | INFO |
//!
//! Its fields are `node`, `location`, `object` (of faults of objects), `kind`, `code`, `severity`,
//! `fault`, `incarnation`, `count`, `symptom_of`, `step` and `detail`. A program without a
//! subscriber gets the steps of the first three rows on standard error, a line each; a fault that
//! is found again is not printed again.

use crate::platform;
use blastema_contract::detector::FaultEvent;
use blastema_core::detection::FaultTransition;
use blastema_core::{Fault, FaultLocation, NodeName, Severity};
use std::borrow::Cow;
use tracing::{Level, event};

/// The target of all events about faults.
const TARGET: &str = "blastema::fault";

/// How a step is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Shown {
    level: Level,
    /// It is printed where no log is kept.
    printed: bool,
}

/// Logs one step of a fault that `node` has found.
pub(crate) fn log_step(node: &NodeName, step: &FaultEvent) {
    let FaultEvent { fault, turn, .. } = step;
    if tracing::dispatcher::has_been_set() {
        log(node, step);
    } else if shown(fault, turn).printed {
        platform::tell_of_node(&line(node, fault, turn));
    }
}

fn log(node: &NodeName, step: &FaultEvent) {
    let FaultEvent { fault, turn, .. } = step;
    let shown = shown(fault, turn);
    macro_rules! log_at {
        ($level:expr) => {
            event!(
                target: TARGET,
                $level,
                %node,
                location = %fault.location,
                object = object(&fault.location),
                kind = %fault.kind,
                code = fault.kind.code(),
                severity = ?fault.severity,
                fault = fault.id.0,
                incarnation = fault.incarnation.0,
                count = fault.count,
                symptom_of = fault.symptom_of.map(|root| root.0),
                step = step_name(turn),
                detail = &*detail(fault, turn),
            )
        };
    }
    match shown.level {
        Level::ERROR => log_at!(Level::ERROR),
        Level::WARN => log_at!(Level::WARN),
        _ => log_at!(Level::INFO),
    }
}

fn shown(fault: &Fault, turn: &FaultTransition) -> Shown {
    let of_severity = match fault.severity {
        Severity::Warning => Level::WARN,
        Severity::Error | Severity::Critical => Level::ERROR,
    };
    let is_root = fault.symptom_of.is_none();
    match turn {
        FaultTransition::Found if is_root => Shown { level: of_severity, printed: true },
        FaultTransition::Repeated if is_root => Shown { level: of_severity, printed: false },
        FaultTransition::Explained if is_root => Shown { level: of_severity, printed: true },
        FaultTransition::GaveUp { .. } => Shown { level: Level::ERROR, printed: true },
        FaultTransition::Failed { .. } => Shown { level: Level::WARN, printed: true },
        _ => Shown { level: Level::INFO, printed: false },
    }
}

fn object(location: &FaultLocation) -> Option<&str> {
    match location {
        FaultLocation::Object(address) => Some(address.object.as_str()),
        FaultLocation::Link { .. } | FaultLocation::Node(_) => None,
    }
}

fn step_name(turn: &FaultTransition) -> &'static str {
    match turn {
        FaultTransition::Found => "found",
        FaultTransition::Repeated => "found again",
        FaultTransition::Explained => "explained",
        FaultTransition::Decided { .. } => "decided",
        FaultTransition::Failed { .. } => "action failed",
        FaultTransition::Recovered => "recovered",
        FaultTransition::GaveUp { .. } => "given up",
        FaultTransition::Cleared => "cleared",
        _ => "changed",
    }
}

/// What is new in the step, or the particulars of the fault.
fn detail<'a>(fault: &'a Fault, turn: &'a FaultTransition) -> Cow<'a, str> {
    match turn {
        FaultTransition::Decided { action } => action.into(),
        FaultTransition::Failed { action, reason } => format!("{action}: {reason}").into(),
        FaultTransition::GaveUp { reason } => reason.into(),
        _ => match fault.symptom_of {
            Some(root) => format!("{}; it is a symptom of fault {}", fault.detail, root.0).into(),
            None => (&fault.detail).into(),
        },
    }
}

/// A step as one line for a person.
fn line(node: &NodeName, fault: &Fault, turn: &FaultTransition) -> String {
    let severity = match fault.severity {
        Severity::Warning => "warning",
        Severity::Error => "error",
        Severity::Critical => "critical error",
    };
    let (kind, location) = (&fault.kind, &fault.location);
    let text = match turn {
        FaultTransition::GaveUp { reason } => {
            let (detail, id) = (&fault.detail, fault.id.0);
            format!("{kind} of {location} is given up: {detail}, fault {id}: {reason}")
        }
        FaultTransition::Failed { action, reason } => {
            format!("{kind} of {location}: {action} has failed: {reason}")
        }
        _ => format!("{kind} of {location}: {}", fault.detail),
    };
    let line = format!("{severity} on node {node}: {text}");
    // Texts come from other nodes, too, and a terminal would obey their control characters.
    line.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::{FaultId, FaultKind, Incarnation, Instant};

    fn fault(kind: FaultKind, symptom_of: Option<u64>) -> Fault {
        Fault {
            id: FaultId(7),
            severity: kind.severity(),
            kind,
            location: FaultLocation::Object("module1:arm".parse().unwrap()),
            incarnation: Incarnation(2),
            detail: "boom\nat arm.rs:7".to_owned(),
            found_at: Instant::ORIGIN,
            symptom_of: symptom_of.map(FaultId),
            count: 1,
        }
    }

    #[test]
    fn what_a_user_must_act_on_is_a_warning_or_an_error_and_nothing_else_is() {
        let gave_up = || FaultTransition::GaveUp { reason: "no".to_owned() };
        let decided = || FaultTransition::Decided { action: "restart".to_owned() };
        let check = |kind, symptom_of, turn, level, printed| {
            let shown = shown(&fault(kind, symptom_of), &turn);
            assert_eq!(shown, Shown { level, printed }, "{turn:?}");
        };
        check(FaultKind::Panic, None, FaultTransition::Found, Level::ERROR, true);
        check(FaultKind::NodeLost, None, FaultTransition::Found, Level::ERROR, true);
        check(FaultKind::Overload, None, FaultTransition::Found, Level::WARN, true);
        check(FaultKind::Overload, None, FaultTransition::Repeated, Level::WARN, false);
        check(FaultKind::Panic, None, gave_up(), Level::ERROR, true);
        let failed = FaultTransition::Failed { action: "mine".into(), reason: "no".into() };
        check(FaultKind::Panic, None, failed, Level::WARN, true);
        check(FaultKind::Panic, Some(1), gave_up(), Level::ERROR, true);
        check(FaultKind::Panic, Some(1), FaultTransition::Found, Level::INFO, false);
        check(FaultKind::Panic, Some(1), FaultTransition::Repeated, Level::INFO, false);
        check(FaultKind::Panic, None, FaultTransition::Explained, Level::ERROR, true);
        check(FaultKind::Panic, Some(1), FaultTransition::Explained, Level::INFO, false);
        for turn in [decided(), FaultTransition::Recovered, FaultTransition::Cleared] {
            check(FaultKind::Panic, None, turn, Level::INFO, false);
        }
    }

    #[test]
    fn a_symptom_names_its_root_and_a_fault_that_is_given_up_what_it_was() {
        let symptom = fault(FaultKind::Hang, Some(3));
        let text = detail(&symptom, &FaultTransition::Found);
        assert_eq!(text, "boom\nat arm.rs:7; it is a symptom of fault 3");

        let (node, root) = (NodeName::new("module1").unwrap(), fault(FaultKind::Hang, None));
        let line = line(&node, &root, &FaultTransition::GaveUp { reason: "too often".into() });
        let text = "hang of module1:arm is given up: boom at arm.rs:7, fault 7: too often";
        assert_eq!(line, format!("error on node module1: {text}"));
    }

    #[test]
    fn a_printed_fault_is_one_line_with_node_object_and_detail() {
        let node = NodeName::new("module1").unwrap();
        let line = line(&node, &fault(FaultKind::Panic, None), &FaultTransition::Found);
        assert_eq!(line, "error on node module1: panic of module1:arm: boom at arm.rs:7");
    }
}
