//! What the watch thread has seen: handlers that take too long, overload, silence, and a process
//! that stood still.

use super::Monitor;
use crate::detection::hang::LivenessEvent;
use crate::detection::{Finding, NodeCondition, Observation};
use crate::{FaultLocation, Incarnation, Instant, ObjectName};

impl Monitor {
    /// The sampler has found this.
    pub fn handle_liveness(&mut self, event: LivenessEvent, now: Instant) {
        match event {
            LivenessEvent::Component { object, incarnation, finding } => {
                self.handle_found(&object, incarnation, finding, now);
            }
            LivenessEvent::Computer(condition) => self.observe_this_node(condition, now),
            LivenessEvent::Resumed { objects } => self.handle_resumed(&objects, now),
            LivenessEvent::Lost { culprit, victims, .. } => {
                self.handle_lost(&culprit, &victims, now);
            }
            // Which fault that is, if any, the detector decides.
            LivenessEvent::Stalled { gap: span } => {
                self.observe_this_node(NodeCondition::Paused { span }, now);
            }
        }
    }

    /// Something was found of an incarnation: by the sampler, or by asking.
    pub(super) fn handle_found(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        finding: Finding,
        now: Instant,
    ) {
        let Some(entry) = self.alive(object, incarnation) else { return };
        match &finding {
            // One that has waited and keeps its thread now is news again.
            Finding::Hangs { during, age, .. } | Finding::Waits { during, age } => {
                let since = Instant::ORIGIN + (now - (Instant::ORIGIN + *age));
                entry.set_current(Some((during, since)));
            }
            Finding::Silent { .. } => entry.signs.silent = true,
            Finding::Spoke => {
                entry.signs.handle_sign(now);
                if !std::mem::take(&mut entry.signs.silent) {
                    return;
                }
            }
            _ => {}
        }
        if let Finding::Hangs { victims, .. } = &finding {
            for victim in victims.iter().filter(|&victim| victim != object) {
                if let Some(entry) = self.objects.get_mut(victim) {
                    entry.signs.handle_suspicion();
                }
            }
        }
        self.observe_object(object, incarnation, finding, now);
    }

    /// The watch thread saw these move again.
    pub(super) fn handle_resumed(&mut self, objects: &[ObjectName], now: Instant) {
        for object in objects {
            let Some(entry) = self.objects.get_mut(object) else { continue };
            entry.set_current(None);
            entry.signs.handle_sign(now);
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
        let (incarnation, finding) = (Incarnation::default(), Finding::Node(condition));
        self.observe(Observation { location, incarnation, finding, seen_at: now });
    }
}
