//! What the watch thread has seen: handlers that take too long, overload, silence, and a process
//! that stood still.

use super::Monitor;
use crate::detection::hang::OverloadFigures;
use crate::detection::{Finding, NodeCondition};
use crate::{FaultLocation, Incarnation, Instant, ObjectName};
use std::sync::Arc;
use std::time::Duration;

impl Monitor {
    /// The watch thread saw this object's handler keep its arbiter from turning.
    pub fn handle_hangs(
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

    /// The watch thread saw this object's handler await something for too long.
    pub fn handle_waits(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        age: Duration,
        now: Instant,
    ) {
        self.handle_slow(object, incarnation, during, Finding::Waits { during, age }, now);
    }

    /// The watch thread saw these move again.
    pub fn handle_resumed(&mut self, objects: &[ObjectName], now: Instant) {
        for object in objects {
            let Some(entry) = self.objects.get_mut(object) else { continue };
            entry.set_current(None);
            entry.suspect = false;
            entry.last_sign = Some(now);
            let incarnation = entry.incarnation;
            self.observe_object(object, incarnation, Finding::Resumed, now);
        }
        self.settle(now);
    }

    /// The watch thread gives up hope that these will move again behind `culprit`.
    pub fn handle_lost(&mut self, culprit: &ObjectName, victims: &[ObjectName], now: Instant) {
        for victim in victims.iter().filter(|&victim| victim != culprit) {
            let Some(entry) = self.objects.get_mut(victim) else { continue };
            entry.set_current(Some(("nothing: another object hangs", now)));
            let incarnation = entry.incarnation;
            let culprit = culprit.clone();
            self.observe_object(victim, incarnation, Finding::Lost { culprit }, now);
        }
        self.settle(now);
    }

    /// The watch thread found this object silent for `age`.
    pub fn handle_silent(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        age: Duration,
        now: Instant,
    ) {
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        entry.silent = true;
        self.observe_object(object, incarnation, Finding::Silent { age }, now);
        self.settle(now);
    }

    /// The watch thread found this object working and late, and those behind it.
    pub fn handle_overloaded(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        figures: OverloadFigures,
        victims: Arc<[ObjectName]>,
        now: Instant,
    ) {
        if self.alive(object, incarnation, now).is_some() {
            let finding = Finding::Overloaded { figures, victims };
            self.observe_object(object, incarnation, finding, now);
        }
        self.settle(now);
    }

    /// The watch thread found that this object, and those behind it, have caught up.
    pub fn handle_flows(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        if self.alive(object, incarnation, now).is_some() {
            self.observe_object(object, incarnation, Finding::Flows, now);
        }
        self.settle(now);
    }

    /// The sampler saw a sign of life of this object.
    pub fn handle_spoke(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        entry.last_sign = Some(now);
        entry.suspect = false;
        if std::mem::replace(&mut entry.silent, false) {
            self.observe_object(object, incarnation, Finding::Spoke, now);
        }
        self.settle(now);
    }

    /// The watch, or the whole process, was not scheduled for `gap`: every silence up to now is
    /// void. Which fault that is, if any, the detector decides.
    pub fn handle_stall(&mut self, gap: Duration, now: Instant) {
        self.pings.handle_stall(gap, now);
        self.observe_this_node(NodeCondition::Paused { span: gap }, now);
    }

    /// The watch thread found that the computer has no time for these objects.
    pub fn handle_computer_overloaded(
        &mut self,
        waited_percent: u8,
        figures: OverloadFigures,
        victims: Arc<[ObjectName]>,
        now: Instant,
    ) {
        self.observe_this_node(NodeCondition::Overloaded { waited_percent, figures, victims }, now);
    }

    /// The watch thread found that the computer has time for all objects again.
    pub fn handle_computer_relieved(&mut self, now: Instant) {
        self.observe_this_node(NodeCondition::Relieved, now);
    }

    fn observe_this_node(&mut self, condition: NodeCondition, now: Instant) {
        let location = FaultLocation::Node(self.node.clone());
        self.observe(location, Incarnation::default(), Finding::Node(condition), now);
        self.settle(now);
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
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        let since = Instant::ORIGIN + (now - (Instant::ORIGIN + age));
        entry.set_current(Some((during, since)));
        self.observe_object(object, incarnation, finding, now);
        self.settle(now);
    }
}
