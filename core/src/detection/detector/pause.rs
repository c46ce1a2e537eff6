//! What links and other nodes suffer when this node itself did not run.
//!
//! A node that does not run sends no hellos, so its peers declare its links down, rightly. What it
//! finds of links and nodes afterwards has its cause here and not there.

use super::{AFTER_PAUSE, Cause, Detector, PAUSE, Scene};
use crate::{Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant};
use std::time::Duration;

/// A span in which this node did not run.
#[derive(Clone, Debug)]
pub(super) struct Pause {
    location: FaultLocation,
    span: Duration,
    ended_at: Instant,
    /// Until then, what is found of links and nodes is a symptom of it.
    pub(super) until: Instant,
    /// Its fault; `None` while it is short and nothing has suffered from it.
    fault: Option<FaultId>,
}

impl Detector {
    /// What was found of links and other nodes since this node began to stand still is a symptom of
    /// that, and so is what is found for a while from now on.
    pub(super) fn judge_pause(&mut self, scene: &Scene, span: Duration) {
        let is_long = span >= PAUSE;
        let (before, fault) = match self.pause.take() {
            Some(Pause { until, fault, .. }) => (until, fault.filter(|_| !is_long)),
            None => (Instant::ORIGIN, None),
        };
        let (location, ended_at) = (scene.location.clone(), scene.at);
        let until = before.max(scene.at + PAUSE);
        self.pause = Some(Pause { location, span, ended_at, until, fault });
        let suffers = |fault: &&Fault| {
            let of_network =
                matches!(fault.location, FaultLocation::Link { .. } | FaultLocation::Node(_));
            let fresh = scene.at - fault.found_at <= span;
            of_network && fresh && fault.location != scene.location && fault.symptom_of.is_none()
        };
        let suffer = self.fault_log.all_open().filter(suffers).map(|fault| fault.id);
        let suffer: Vec<FaultId> = suffer.collect();
        if is_long || !suffer.is_empty() {
            let root = self.fault_of_pause();
            self.explain(&suffer, root, scene.at);
        }
    }

    /// What a fault of a link or a node is a symptom of: the pause, if there was one lately.
    pub(super) fn pause_or(&mut self, cause: Cause) -> Cause {
        self.fault_of_pause().map_or(cause, Cause::Known)
    }

    /// The fault of the latest pause, recorded now if it was not yet.
    fn fault_of_pause(&mut self) -> Option<FaultId> {
        let Pause { location, span, ended_at: at, fault, .. } = self.pause.clone()?;
        if fault.is_some() {
            return fault;
        }
        let detail = format!(
            "it did not run for {:.1} s: its process was stopped, or its computer stood still or \
             is overloaded",
            span.as_secs_f32()
        );
        let scene = Scene { location, incarnation: Incarnation::default(), at };
        let id = self.count_or_record(&scene, FaultKind::NodePaused, detail, Cause::Itself);
        self.recover(id, at);
        let pause = self.pause.as_mut()?;
        pause.fault = Some(id);
        pause.until = pause.until.max(at + AFTER_PAUSE);
        Some(id)
    }

    /// The latest pause is no cause of anything any more.
    pub(super) fn end_pause(&mut self, now: Instant) {
        let over = self.pause.take_if(|pause| pause.until <= now);
        let Some(id) = over.and_then(|pause| pause.fault) else { return };
        self.repair(id, now);
        let outlives = |fault: &&Fault| fault.symptom_of == Some(id);
        let outlive = self.fault_log.all_open().filter(outlives).map(|fault| fault.id);
        let outlive: Vec<FaultId> = outlive.collect();
        self.explain(&outlive, None, now);
    }
}
