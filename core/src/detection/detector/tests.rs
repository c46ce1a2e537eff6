//! Every finding in every state, roots and symptoms, and the reports of them.

mod findings;
mod incarnations;
mod record;
mod symptoms;

use super::*;
use crate::detection::{
    ConfirmedQueueOutput, ExitReason, FaultStatus, Finding, LinkCondition, NodeCondition, Notifier,
    OverloadFigures, RecovererPort,
};
use crate::testing::{at, node, object};
use crate::{ObjectAddress, Severity};
use std::sync::Arc;

const ONE: Incarnation = Incarnation(1);
const TWO: Incarnation = Incarnation(2);

/// A place as it is written: `arm` is an object here, `n:arm` one there, `-eth-n` a link to n, `@n`
/// a node.
fn location(text: &str) -> FaultLocation {
    if let Some(name) = text.strip_prefix('@') {
        return FaultLocation::Node(node(name));
    }
    if let Some((link, neighbour)) = text.strip_prefix('-').and_then(|t| t.split_once('-')) {
        return FaultLocation::Link {
            node: node("m"),
            link: link.into(),
            neighbour: Some(node(neighbour)),
        };
    }
    FaultLocation::Object(address(text))
}

fn address(text: &str) -> ObjectAddress {
    let local = || ObjectAddress::new(node("m"), object(text));
    text.parse().unwrap_or_else(|_| local())
}

/// A detector with its clock, and the notifier behind it.
struct Bench {
    detector: Detector,
    notifier: Notifier,
    now: Instant,
}

impl Bench {
    fn new() -> Self {
        let mut notifier = Notifier::default();
        notifier.add_port(RecovererPort::Local, at(0));
        Bench { detector: Detector::new(node("m")), notifier, now: at(0) }
    }

    fn state_of(&self, name: &str) -> Option<(Incarnation, Lifecycle)> {
        self.detector.objects.get(&object(name)).map(|seen| (seen.incarnation, seen.state))
    }

    fn see(&mut self, text: &str, incarnation: Incarnation, finding: Finding) {
        let (location, seen_at) = (location(text), self.now);
        self.detector.handle_observed(Observation { location, incarnation, finding, seen_at });
    }

    fn depend(&mut self, object: &str, on: &[&str]) {
        let depends_on: Arc<[ObjectAddress]> = on.iter().map(|text| address(text)).collect();
        self.see(object, ONE, Finding::Enrolled { may_end: false, depends_on });
    }

    /// What was told ("Found 1") and handed over ("+1", "-1"), all of it confirmed.
    fn outputs(&mut self) -> Vec<String> {
        let mut outputs = Vec::new();
        while let Some(output) = self.detector.poll_output() {
            match output {
                DetectorOutput::Tell { fault, turn, .. } => {
                    let turn = format!("{turn:?}");
                    let turn = turn.split([' ', '{']).next().unwrap_or_default();
                    outputs.push(format!("{turn} {}", fault.id.0));
                }
                DetectorOutput::Notify { notice, .. } => {
                    self.notifier.handle_notice(notice, self.now);
                }
            }
        }
        while let Some((port, ConfirmedQueueOutput::Deliver { number, item: notice })) =
            self.notifier.poll_output()
        {
            let sign = if matches!(notice, FaultNotice::Found(_)) { '+' } else { '-' };
            outputs.push(format!("{sign}{}", notice.id().0));
            self.notifier.handle_confirmed(&port, number, self.now);
        }
        outputs
    }

    fn run_until(&mut self, until: u64) -> Vec<String> {
        let mut outputs = self.outputs();
        while let Some(due) = self.detector.poll_timeout().filter(|&due| due <= at(until)) {
            self.now = due;
            self.detector.handle_timeout(due);
            outputs.extend(self.outputs());
        }
        self.now = at(until);
        outputs
    }

    fn entries(&self) -> Vec<super::super::FaultEntry> {
        self.detector.read_record().entries
    }

    fn given_up(&self, id: u64) -> String {
        let entry = self.detector.fault_log.entry(FaultId(id)).expect("it is recorded");
        entry.given_up.clone().expect("it is given up").1
    }

    fn fault(&self, id: u64) -> Fault {
        let entry = self.detector.fault_log.entry(FaultId(id)).expect("it is recorded");
        entry.fault.clone()
    }
}

fn exited(exit: ExitReason) -> Finding {
    Finding::Exited { exit, restarted_as: None }
}

fn panicked() -> ExitReason {
    ExitReason::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" }
}

fn state(state: Lifecycle) -> Finding {
    let fails = matches!(state, Lifecycle::Error | Lifecycle::Fatal);
    Finding::State { state, reason: fails.then(|| "why".into()) }
}

fn silent() -> Finding {
    Finding::Silent { age: Duration::from_millis(350) }
}

fn overloaded(victims: &[&str]) -> Finding {
    let figures = OverloadFigures {
        utilisation_percent: 97,
        missed_rounds: 40,
        ..OverloadFigures::default()
    };
    Finding::Overloaded { figures, victims: victims.iter().map(|name| object(name)).collect() }
}

fn declared() -> Finding {
    Finding::Declared { kind: FaultKind::CheckFailed, detail: "speed is 9".into() }
}

fn insecure() -> Finding {
    Finding::Declared { kind: FaultKind::Insecure, detail: "network lan is insecure".into() }
}

fn unavailable() -> Finding {
    Finding::Declared { kind: FaultKind::Unavailable, detail: "no device".into() }
}

fn down() -> Finding {
    Finding::Link(LinkCondition::Down { reason: "no hello".into() })
}

fn lost() -> Finding {
    Finding::Node(NodeCondition::Lost { reason: "no path".into() })
}

fn hangs(victims: &[&str]) -> Finding {
    let victims = victims.iter().map(|name| object(name)).collect();
    Finding::Hangs { during: "Scan", age: Duration::from_millis(500), victims }
}
