//! Who hangs, who waits too long, who is silent: judged from what workers write in passing.
//!
//! Workers count; they read no clock. The scanner is shown the counters at even intervals and keeps
//! for each the time at which it first saw it stand. An arbiter whose beat stands while a component is
//! on its thread *hangs*, and that component is the culprit; all others there are victims and are not
//! judged for as long as it lasts. Where the beat goes on, a handler whose turn stands *waits*.
//!
//! A culprit is not condemned by what the scanner itself missed: when it was not scheduled for a
//! while, everything seen before is void.

mod vocabulary;

pub use self::vocabulary::{
    ArbiterId, ArbiterSeen, Judged, MaxSilence, PulseReading, ScannerConfig, Sighting, SlotId,
    StampReading,
};

use crate::occupancy::Occupancy;
use crate::{Instant, Machine, ObjectName};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

#[derive(Debug)]
struct Arbiter {
    beat: u64,
    running: Option<SlotId>,
    turn: Option<u64>,
    /// When these were first seen.
    since: Instant,
    /// When this beat was first seen.
    beat_since: Instant,
    occupancy: Occupancy,
    hang: Option<Hang>,
    fenced_since: Option<Instant>,
    lost: bool,
}

#[derive(Debug)]
struct Hang {
    culprit: ObjectName,
    slot: SlotId,
}

#[derive(Debug)]
struct Component {
    judged: Judged,
    reading: Option<StampReading>,
    turn_since: Instant,
    alive_since: Instant,
    /// When it was last seen to have given a sign of life, in this incarnation.
    last_sign: Option<Instant>,
    /// This turn has been reported.
    waits: bool,
    /// This life has given a sign.
    heard: bool,
    silent: bool,
}

/// The judge. Shown pulses often and stamps less often, each time between
/// [`handle_look`](Scanner::handle_look) and draining the outputs.
#[derive(Debug)]
pub struct Scanner {
    config: ScannerConfig,
    looked_at: Option<Instant>,
    arbiters: BTreeMap<ArbiterId, Arbiter>,
    /// By slot; slots are dense.
    components: Vec<Option<Component>>,
    outputs: VecDeque<Sighting>,
}

impl Scanner {
    /// A scanner that has seen nothing yet.
    pub fn new(config: ScannerConfig) -> Self {
        Scanner {
            config,
            looked_at: None,
            arbiters: BTreeMap::new(),
            components: Vec::new(),
            outputs: VecDeque::new(),
        }
    }

    /// This component is judged from now on.
    pub fn handle_enter(&mut self, slot: SlotId, judged: Judged, now: Instant) {
        let at = slot as usize;
        if self.components.len() <= at {
            self.components.resize_with(at + 1, || None);
        }
        let (turn_since, alive_since) = (now, now);
        self.components[at] = Some(Component {
            judged,
            reading: None,
            turn_since,
            alive_since,
            last_sign: None,
            waits: false,
            heard: false,
            silent: false,
        });
    }

    /// It is no longer.
    pub fn handle_leave(&mut self, slot: SlotId) {
        if let Some(place) = self.components.get_mut(slot as usize) {
            *place = None;
        }
    }

    /// An arbiter is no more.
    pub fn handle_gone(&mut self, arbiter: ArbiterId) {
        self.arbiters.remove(&arbiter);
    }

    /// A look begins.
    pub fn handle_look(&mut self, now: Instant) {
        let gap = self.looked_at.map_or(Duration::ZERO, |before| now - before);
        self.looked_at = Some(now);
        if gap <= self.config.gap {
            return;
        }
        for arbiter in self.arbiters.values_mut() {
            (arbiter.since, arbiter.beat_since) = (now, now);
            arbiter.fenced_since = arbiter.fenced_since.map(|_| now);
        }
        for component in self.components.iter_mut().flatten() {
            (component.turn_since, component.alive_since) = (now, now);
        }
        self.outputs.push_back(Sighting::Stalled { gap });
    }

    /// What an arbiter says.
    pub fn handle_pulse(&mut self, id: ArbiterId, reading: PulseReading, now: Instant) {
        let arbiter = self.arbiters.entry(id).or_insert(Arbiter {
            beat: reading.beat,
            running: reading.running,
            turn: reading.turn,
            since: now,
            beat_since: now,
            occupancy: Occupancy::default(),
            hang: None,
            fenced_since: None,
            lost: false,
        });
        arbiter.occupancy.note(reading.running.is_some());
        let beats = arbiter.beat != reading.beat;
        if beats {
            arbiter.beat_since = now;
        }
        // A culprit that was given up meanwhile has not thereby moved on.
        let turned = reading.turn.is_some() && arbiter.turn != reading.turn;
        let changed = beats || arbiter.running != reading.running || turned;
        if changed {
            (arbiter.beat, arbiter.running) = (reading.beat, reading.running);
            (arbiter.turn, arbiter.since) = (reading.turn, now);
        }
        arbiter.fenced_since = reading.fenced.then(|| arbiter.fenced_since.unwrap_or(now));
        let age = now - arbiter.since;
        let resumed = if changed { arbiter.hang.take() } else { None };
        let lost = !arbiter.lost
            && arbiter.fenced_since.is_some_and(|since| now - since >= self.config.grace);
        if let Some(hang) = resumed {
            self.resume(id, &hang, now);
        }
        self.judge_arbiter(id, age);
        if lost {
            self.lose(id, reading.running);
        }
    }

    fn judge_arbiter(&mut self, id: ArbiterId, age: Duration) {
        let Some(arbiter) = self.arbiters.get(&id) else { return };
        let (Some(slot), None) = (arbiter.running, &arbiter.hang) else { return };
        let Some(culprit) = self.component(slot) else { return };
        let allowance = culprit.reading.map_or(Duration::ZERO, |reading| reading.allowance);
        if age < culprit.judged.max_block.max(allowance) || culprit.judged.arbiter != id {
            return;
        }
        let object = culprit.judged.object.clone();
        let victims = self.others_on(id, slot);
        if let Some(arbiter) = self.arbiters.get_mut(&id) {
            arbiter.hang = Some(Hang { culprit: object.clone(), slot });
        }
        self.outputs.push_back(Sighting::Hangs { slot, object, age, victims });
    }

    fn resume(&mut self, id: ArbiterId, hang: &Hang, now: Instant) {
        let mut objects = self.others_on(id, hang.slot);
        let culprit = self.component(hang.slot);
        objects.extend(culprit.map(|culprit| culprit.judged.object.clone()));
        // Who stood still had no chance to speak.
        for component in self.components.iter_mut().flatten() {
            if component.judged.arbiter == id {
                (component.turn_since, component.alive_since) = (now, now);
            }
        }
        let lost = self.arbiters.get(&id).is_some_and(|arbiter| arbiter.lost);
        if !lost {
            self.outputs.push_back(Sighting::Resumed { objects });
        }
    }

    fn lose(&mut self, id: ArbiterId, running: Option<SlotId>) {
        let Some(arbiter) = self.arbiters.get_mut(&id) else { return };
        arbiter.lost = true;
        let hang = arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), hang.slot));
        let known = hang.or_else(|| {
            let slot = running?;
            Some((self.component(slot)?.judged.object.clone(), slot))
        });
        let Some((culprit, slot)) = known else { return };
        let victims = self.others_on(id, slot);
        self.outputs.push_back(Sighting::Lost { arbiter: id, culprit, victims });
    }

    fn component(&self, slot: SlotId) -> Option<&Component> {
        self.components.get(slot as usize)?.as_ref()
    }

    fn others_on(&self, arbiter: ArbiterId, but: SlotId) -> Vec<ObjectName> {
        let others = self.components.iter().enumerate().filter(|(at, _)| *at != but as usize);
        let others = others.filter_map(|(_, component)| component.as_ref());
        let here = others.filter(|component| component.judged.arbiter == arbiter);
        here.map(|component| component.judged.object.clone()).collect()
    }

    /// What is known of every arbiter.
    pub fn arbiters(&self) -> impl Iterator<Item = (ArbiterId, ArbiterSeen)> + '_ {
        self.arbiters.iter().map(|(id, arbiter)| {
            let hangs = arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), arbiter.since));
            (*id, ArbiterSeen { busy: arbiter.occupancy.share(), hangs })
        })
    }

    /// Which components have something in service, which turn it is, and since when at least; by slot.
    pub fn busy(&self) -> impl Iterator<Item = (SlotId, u64, Instant)> + '_ {
        let known = (0..).zip(&self.components);
        known.filter_map(|(slot, component)| {
            let component = component.as_ref()?;
            let turn = component.reading?.turn;
            (turn % 2 == 1).then_some((slot, turn, component.turn_since))
        })
    }

    /// When each component that should give signs of life was last seen to have given one; by slot.
    pub fn last_signs(&self) -> impl Iterator<Item = (SlotId, Option<Instant>)> + '_ {
        let known = (0..).zip(&self.components);
        known.filter_map(|(slot, component)| {
            let component = component.as_ref()?;
            let expected = component.reading.is_some_and(|reading| reading.speaks);
            let judged = expected && component.judged.max_silence.is_some();
            judged.then_some((slot, component.last_sign))
        })
    }

    /// Looks at all components; `read` gives what the component of a slot says.
    pub fn handle_stamps(&mut self, now: Instant, mut read: impl FnMut(SlotId) -> StampReading) {
        let Scanner { config, arbiters, components, outputs, .. } = self;
        for (slot, place) in (0..).zip(components) {
            let Some(component) = place else { continue };
            let arbiter = arbiters.get(&component.judged.arbiter);
            let stands =
                arbiter.is_some_and(|arbiter| now - arbiter.beat_since > config.standstill);
            component.handle(slot, read(slot), stands, now, outputs);
        }
    }
}

impl Component {
    fn handle(
        &mut self,
        slot: SlotId,
        reading: StampReading,
        stands: bool,
        now: Instant,
        outputs: &mut VecDeque<Sighting>,
    ) {
        let before = self.reading.replace(reading);
        if before.is_none_or(|before| before.incarnation != reading.incarnation) {
            (self.turn_since, self.alive_since) = (now, now);
            (self.waits, self.heard, self.silent) = (false, false, false);
            self.last_sign = None;
            return;
        }
        let before = before.unwrap_or(reading);
        if before.turn != reading.turn {
            self.turn_since = now;
            self.waits = false;
        }
        let object = &self.judged.object;
        if before.alive != reading.alive || !reading.speaks {
            self.alive_since = now;
            self.heard |= before.alive != reading.alive;
            if before.alive != reading.alive {
                self.last_sign = Some(now);
            }
            if self.silent && before.alive != reading.alive {
                self.silent = false;
                let (object, incarnation) = (object.clone(), reading.incarnation);
                outputs.push_back(Sighting::Spoke { object, incarnation });
            }
        }
        if stands {
            self.alive_since = now;
            return; // Judged as a victim, or as a culprit, not for itself.
        }
        let age = now - self.turn_since;
        let limit = self.judged.max_wait.max(reading.allowance);
        if reading.turn % 2 == 1 && !self.waits && age >= limit {
            self.waits = true;
            let (object, incarnation) = (object.clone(), reading.incarnation);
            outputs.push_back(Sighting::Waits { slot, object, incarnation, age });
        }
        let silent_for = now - self.alive_since;
        let limit = self.judged.max_silence;
        let limit = limit.map(|limit| if self.heard { limit.between } else { limit.first });
        if let Some(limit) = limit
            && !self.silent
            && silent_for >= limit.max(reading.allowance)
        {
            self.silent = true;
            let (object, incarnation) = (object.clone(), reading.incarnation);
            outputs.push_back(Sighting::Silent { object, incarnation, silent_for });
        }
    }
}

impl Machine for Scanner {
    type Output = Sighting;

    fn poll_output(&mut self) -> Option<Sighting> {
        self.outputs.pop_front()
    }

    /// The scanner is shown things at even intervals and wants nothing in between.
    fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    fn handle_timeout(&mut self, _now: Instant) {}
}

#[cfg(test)]
mod tests;
