//! Late components, and the component that occupies their thread.

use super::lateness::{Counts, OverloadRoot, WINDOW};
use super::{
    Arbiter, Around, ComponentEntry, ComponentRecord, Episode, HangDetector, Late, LivenessEvent,
    Looked, QueueReading, Silence, SlotId,
};
use crate::detection::hang::occupancy::Occupancy;
use crate::detection::{Finding, NodeCondition, OverloadFigures};
use crate::sorted::SortedMap;
use crate::{Instant, ObjectName};
use std::collections::BTreeSet;
use std::time::Duration;

/// A thread that is free less often than in one of five looks makes its components wait for each
/// other.
pub(super) const SATURATED: f32 = 0.8;
/// How long nothing may be late before an overload is over. Shorter reports one that comes and goes
/// as many: one good window among bad ones ends none.
const RELIEF: Duration = Duration::from_secs(3);
/// The interval of the usual looks, by which a span is turned into a number of them.
pub(super) const LOOK: Duration = Duration::from_millis(10);

fn looks_in(span: Duration) -> usize {
    let looks = usize::try_from(span.as_nanos() / LOOK.as_nanos()).unwrap_or(usize::MAX);
    looks.clamp(1, Occupancy::<SlotId>::LOOKS)
}

impl Arbiter {
    /// It has had no time to spare for so long.
    pub(super) fn is_saturated(&self, span: Duration) -> bool {
        self.occupancy.busy(looks_in(span)) >= SATURATED
    }

    /// What has kept this component from the thread for so long: that the thread got no processor;
    /// else the component that was on it most often, or the one that was so when an overload began
    /// and still is for half as often.
    pub(super) fn kept_by(&self, slot: SlotId, span: Duration) -> Option<OverloadRoot> {
        if self.processor.was_scarce(span) {
            return Some(OverloadRoot::Computer);
        }
        if !self.is_saturated(span) {
            return None;
        }
        let looks = looks_in(span);
        let (largest, share) = self.occupancy.largest(looks)?;
        let known =
            self.overloaded.filter(|root| self.occupancy.share_of(*root, looks) >= share / 2.0);
        let root = known.unwrap_or(largest);
        (root != slot).then_some(OverloadRoot::Component(root))
    }
}

/// So many times its limit a component may be silent on a thread that does not turn, while an
/// overload of the computer may be why. More is the component's own, or its thread's.
const STARVED: u32 = 5;

impl ComponentRecord {
    /// Says so if it is silent. One that works meanwhile, or is kept from its thread, is late.
    pub(super) fn judge_silence(
        &mut self,
        around: &Around<'_>,
        looked: &impl Looked,
        now: Instant,
        late: &mut Vec<Late>,
    ) -> Option<LivenessEvent> {
        let reading = self.reading?;
        let pushed = self.judged.limits.max_silence.filter(|_| reading.speaks);
        let pushed =
            pushed.map(|limit| if self.last_sign.is_some() { limit.between } else { limit.first });
        let limit = pushed.or(self.judged.limits.max_unanswered)?.max(reading.allowance);
        let silent_for = now - self.awaited.since;
        if silent_for < limit {
            return None;
        }
        let root = around.kept_by(silent_for);
        let had_time = self.had_time(limit);
        let root = root.filter(|root| *root != OverloadRoot::Computer || !had_time);
        if around.hangs() {
            // A hang is the root of what happens behind it. What was given up is not judged any
            // more.
            around.arbiter.filter(|arbiter| arbiter.fenced_since.is_none())?;
        } else if root.is_some() || self.is_flooded(around, looked, silent_for) {
            let slot = around.slot;
            let (itself, queue) = (OverloadRoot::Component(slot), QueueReading::default());
            let root = root.unwrap_or(itself);
            late.push(Late { slot, root, queue, missed: 0, expired: 0, silent_for });
            if root == itself || root == OverloadRoot::Computer {
                return None;
            }
        } else if around.stands(now) && silent_for < limit.max(self.judged.limits.max_block) {
            return None; // The operating system does not run the thread.
        } else if around.is_overloaded
            && !had_time
            && silent_for < STARVED * limit.max(self.judged.limits.max_block)
        {
            // For how long a thread has waited is known when it is run again.
            return None;
        }
        if self.silence == Silence::Reported {
            return None;
        }
        self.silence = Silence::Reported;
        Some(self.says(reading, Finding::Silent { age: silent_for }))
    }

    /// Its thread has turned as often as it does within this limit on a processor of its own, and it
    /// awaits nothing: it had time for a sign of life, however seldom the thread was run.
    fn had_time(&self, limit: Duration) -> bool {
        let beats = u32::try_from(self.beat.saturating_sub(self.awaited.beat)).unwrap_or(u32::MAX);
        self.reading.is_some_and(|reading| reading.turn.is_multiple_of(2))
            && LOOK.saturating_mul(beats) >= limit
    }

    /// It has so much else to do that it gives no sign of life.
    fn is_flooded(&self, around: &Around<'_>, looked: &impl Looked, span: Duration) -> bool {
        let keeps_its_thread = |arbiter: &Arbiter| {
            arbiter.occupancy.share_of(around.slot, looks_in(span)) >= SATURATED
        };
        self.awaited.worked
            && (around.arbiter.is_some_and(keeps_its_thread)
                || looked.queue(around.slot).oldest > self.judged.limits.max_delay)
    }

    /// Looks at its queue and its rounds.
    pub(super) fn judge_flow(
        &mut self,
        around: &Around<'_>,
        looked: &impl Looked,
        turned: bool,
        now: Instant,
        late: &mut Vec<Late>,
    ) {
        let Some(reading) = self.reading else { return };
        let slot = around.slot;
        let max_delay = self.lateness.max_delay(&self.judged.limits);
        let root = if around.is_busy { around.kept_by(WINDOW) } else { None };
        let limits = &self.judged.limits;
        let counts = self.lateness.handle_counts(limits, &reading, root, now, around.missed);
        // One that is silent does nothing, which is another fault.
        let counts = counts.filter(|_| self.silence != Silence::Reported);
        let looks = turned || reading.turn % 2 == 1 || around.is_busy;
        let queue = if looks { looked.queue(slot) } else { QueueReading::default() };
        // One that is not at work, because its device is away or its start fails, serves nothing:
        // that is another fault.
        let serves = reading.speaks && reading.allowance.is_zero();
        let waits = serves && queue.queued > 0 && queue.oldest > max_delay;
        let moves = now - self.turn_since < max_delay;
        // One that is asked is late too where its thread is free.
        let is_asked = self.judged.limits.max_unanswered.is_some();
        let delayed = waits && (root.is_some() || moves || (is_asked && !around.stands(now)));
        let delayed = self.lateness.handle_delay(delayed, now);
        let root = if delayed { root } else { counts.and_then(|counts| counts.root) };
        if delayed || counts.is_some() {
            let Counts { missed, expired, .. } = counts.unwrap_or_default();
            let root = root.unwrap_or(OverloadRoot::Component(slot));
            let silent_for = Duration::ZERO;
            late.push(Late { slot, root, queue, missed, expired, silent_for });
        }
    }
}

impl HangDetector {
    /// Finds the root of each late component, and reports a root where that is news.
    pub(super) fn blame(&mut self, late: Vec<Late>, looked: &impl Looked, now: Instant) {
        let mut roots: SortedMap<OverloadRoot, Vec<Late>> = SortedMap::new();
        let home = |slot| Some(self.judged(slot)?.arbiter);
        // The component that kept the thread may have left it, and another may have its slot.
        let is_known = |late: &Late| match late.root {
            OverloadRoot::Computer => true,
            OverloadRoot::Component(root) => home(root) == home(late.slot),
        };
        let late = late.into_iter().filter(is_known);
        late.for_each(|late| roots.entry(late.root).or_default().push(late));
        for (root, late) in roots {
            match root {
                OverloadRoot::Computer => self.blame_computer(&late, now),
                OverloadRoot::Component(slot) => self.blame_component(slot, &late, looked, now),
            }
        }
    }

    fn blame_component(&mut self, slot: SlotId, late: &[Late], looked: &impl Looked, now: Instant) {
        let missed = self.missed();
        let Some(root) = self.components.get_mut(slot) else { return };
        let root = root.wake(looked.activity(slot), now, missed);
        let Some(reading) = root.reading else { return };
        let episode = root.overload.get_or_insert_with(|| Episode::new(now));
        let victims = late.iter().map(|late| late.slot).filter(|one| *one != slot);
        if !episode.note(victims, figures(late, looked.queue(slot)), now) {
            return;
        }
        let (mut figures, victims) = (episode.worst, episode.victims.clone());
        let (object, home) = (root.judged.object.clone(), root.judged.arbiter);
        if let Some(arbiter) = self.arbiters.get_mut(&home) {
            let share = arbiter.occupancy.share_of(slot, usize::MAX);
            figures.utilisation_percent = percent(share);
            if share > 0.0 {
                arbiter.overloaded = Some(slot);
            }
        }
        let victims = self.names(victims).into();
        let (incarnation, finding) =
            (reading.incarnation, Finding::Overloaded { figures, victims });
        self.outputs.push_back(LivenessEvent::Component { object, incarnation, finding });
    }

    fn blame_computer(&mut self, late: &[Late], now: Instant) {
        let homes =
            late.iter().filter_map(|late| self.arbiters.get(&self.judged(late.slot)?.arbiter));
        let waited = homes.map(|home| home.processor.shares(WINDOW).1).fold(0.0, f32::max);
        let episode = self.computer.get_or_insert_with(|| Episode::new(now));
        let victims = late.iter().map(|late| late.slot);
        if episode.note(victims, figures(late, QueueReading::default()), now) {
            let (figures, victims) = (episode.worst, episode.victims.clone());
            let (waited_percent, victims) = (percent(waited), self.names(victims).into());
            let condition = NodeCondition::Overloaded { waited_percent, figures, victims };
            self.outputs.push_back(LivenessEvent::Computer(condition));
        }
    }

    fn names(&self, slots: BTreeSet<SlotId>) -> Vec<ObjectName> {
        let name = |slot| Some(self.judged(slot)?.object.clone());
        slots.into_iter().filter_map(name).collect()
    }

    /// Overloads are over when nothing has been late because of them for long enough.
    pub(super) fn relieve(&mut self, now: Instant) {
        let mut free = Vec::new();
        let is_over = |episode: &mut Episode| now - episode.latest >= RELIEF;
        if self.computer.take_if(is_over).is_some() {
            self.outputs.push_back(LivenessEvent::Computer(NodeCondition::Relieved));
        }
        for &slot in &self.awake {
            let entry = self.components.get_mut(slot);
            let Some(component) = entry.and_then(ComponentEntry::awake_mut) else { continue };
            let Some(episode) = component.overload.take_if(is_over) else { continue };
            let Some(reading) = component.reading else { continue };
            if let Some(arbiter) = self.arbiters.get_mut(&component.judged.arbiter) {
                arbiter.overloaded.take_if(|root| *root == slot);
            }
            self.outputs.push_back(component.says(reading, Finding::Flows));
            free.extend(episode.victims);
        }
        for victim in free {
            let entry = self.components.get_mut(victim);
            if let Some(component) = entry.and_then(ComponentEntry::awake_mut)
                && component.silence == Silence::Reported
            {
                component.silence = Silence::Void;
                component.await_sign(now);
            }
        }
    }
}

/// The worst of the components that are late.
fn figures(late: &[Late], own: QueueReading) -> OverloadFigures {
    let queues = late.iter().map(|late| late.queue).chain([own]);
    let worst = queues.max_by_key(|queue| queue.oldest).unwrap_or_default();
    OverloadFigures {
        utilisation_percent: 0,
        queued: worst.queued,
        oldest: worst.oldest,
        missed_rounds: late.iter().map(|late| late.missed).sum(),
        expired: late.iter().map(|late| late.expired).sum(),
        silent_for: late.iter().map(|late| late.silent_for).max().unwrap_or_default(),
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a share lies between 0 and 1"
)]
fn percent(share: f32) -> u8 {
    (share * 100.0) as u8
}
