//! What the watch thread has seen: handlers that take too long, overload, silence, and a process
//! that stood still.

use super::Monitor;
use crate::detection::hang::LivenessEvent;
use crate::detection::{Finding, NodeCondition};
use crate::{FaultLocation, Incarnation, Instant, ObjectName};
use std::sync::Arc;
use std::time::Duration;

impl Monitor {
    /// The sampler has found this.
    pub fn handle_liveness(&mut self, event: LivenessEvent, now: Instant) {
        match event {
            LivenessEvent::Hangs { object, incarnation, during, age, victims } => {
                self.handle_hangs(&object, incarnation, during, age, victims, now);
            }
            LivenessEvent::Waits { object, incarnation, during, age } => {
                let finding = Finding::Waits { during, age };
                self.handle_slow(&object, incarnation, during, finding, now);
            }
            LivenessEvent::Overloaded { object, incarnation, figures, victims } => {
                if self.alive(&object, incarnation).is_some() {
                    let finding = Finding::Overloaded { figures, victims };
                    self.observe_object(&object, incarnation, finding, now);
                }
            }
            LivenessEvent::Flows { object, incarnation } => {
                if self.alive(&object, incarnation).is_some() {
                    self.observe_object(&object, incarnation, Finding::Flows, now);
                }
            }
            LivenessEvent::ComputerOverloaded { waited_percent, figures, victims } => {
                let condition = NodeCondition::Overloaded { waited_percent, figures, victims };
                self.observe_this_node(condition, now);
            }
            LivenessEvent::ComputerRelieved => self.observe_this_node(NodeCondition::Relieved, now),
            LivenessEvent::Resumed { objects } => self.handle_resumed(&objects, now),
            LivenessEvent::Lost { culprit, victims, .. } => {
                self.handle_lost(&culprit, &victims, now);
            }
            LivenessEvent::Silent { object, incarnation, silent_for: age } => {
                self.note_silence(&object, incarnation, age, now);
            }
            LivenessEvent::Spoke { object, incarnation } => {
                self.hear(&object, incarnation, now);
            }
            // Which fault that is, if any, the detector decides.
            LivenessEvent::Stalled { gap: span } => {
                self.observe_this_node(NodeCondition::Paused { span }, now);
            }
        }
    }

    /// The watch thread saw this object's handler keep its arbiter from turning.
    pub(super) fn handle_hangs(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        age: Duration,
        victims: Arc<[ObjectName]>,
        now: Instant,
    ) {
        for victim in victims.iter().filter(|&victim| victim != object) {
            if let Some(entry) = self.objects.get_mut(victim)
                && !entry.suspect
            {
                entry.suspect = true;
                entry.suspicions = entry.suspicions.saturating_add(1);
            }
        }
        let finding = Finding::Hangs { during, age, victims };
        self.handle_slow(object, incarnation, during, finding, now);
    }

    /// The watch thread saw these move again.
    pub(super) fn handle_resumed(&mut self, objects: &[ObjectName], now: Instant) {
        for object in objects {
            let Some(entry) = self.objects.get_mut(object) else { continue };
            entry.set_current(None);
            entry.suspect = false;
            entry.last_sign = Some(now);
            let incarnation = entry.incarnation;
            self.observe_object(object, incarnation, Finding::Resumed, now);
        }
    }

    /// The watch thread gives up hope that these will move again behind `culprit`.
    pub(super) fn handle_lost(
        &mut self,
        culprit: &ObjectName,
        victims: &[ObjectName],
        now: Instant,
    ) {
        for victim in victims.iter().filter(|&victim| victim != culprit) {
            let Some(entry) = self.objects.get_mut(victim) else { continue };
            entry.set_current(Some(("nothing: another object hangs", now)));
            let incarnation = entry.incarnation;
            let culprit = culprit.clone();
            self.observe_object(victim, incarnation, Finding::Lost { culprit }, now);
        }
    }

    fn observe_this_node(&mut self, condition: NodeCondition, now: Instant) {
        let location = FaultLocation::Node(self.node.clone());
        self.observe(location, Incarnation::default(), Finding::Node(condition), now);
    }

    /// A handler that takes too long. One that has waited and keeps its thread now is news again.
    fn handle_slow(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        finding: Finding,
        now: Instant,
    ) {
        let (Finding::Hangs { age, .. } | Finding::Waits { age, .. }) = finding else { return };
        let Some(entry) = self.alive(object, incarnation) else { return };
        let since = Instant::ORIGIN + (now - (Instant::ORIGIN + age));
        entry.set_current(Some((during, since)));
        self.observe_object(object, incarnation, finding, now);
    }
}
