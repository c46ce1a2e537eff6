//! Finds hangs, silence and overload of components, from the counters that workers
//! write in passing.
//!
//! Workers count; they read no clock. The scanner is shown the counters at even intervals and keeps
//! for each the time at which it first saw it stand. An arbiter whose beat stands while a component
//! is on its thread *hangs*, and that component is the culprit. Where the beat goes on, a handler
//! whose turn stands *waits*.
//!
//! A component that works and is late, by its rounds, its signs of life or its messages, is
//! *overloaded*; where another one keeps their thread, that one is, and the late ones are its
//! victims. What a victim suffers is reported after its root. Where the thread itself waits for a
//! processor, and runs for less than two thirds of the time, it is the computer that is overloaded:
//! such a thread says nothing about its components, but for one that gives no sign of life although
//! the thread has turned as often as it does within the limit. An overload stands until nothing was
//! late because of it for a while, by half of the limits that it exceeded.
//!
//! A handler that keeps its thread is charged the time for which the thread was run, where it is
//! ready to run: all of it, however late the looks come, and nothing else. Everything else is
//! measured by a clock that goes on only while the scanner looks, so that time in which the scanner
//! itself was not scheduled is charged to no component. A computer on which it is late at every
//! look is judged later, and no less.

mod entry;
mod lateness;
mod load;
mod processor;
mod slot_table;
mod turn;
mod types;

pub mod occupancy;

pub use self::processor::ProcessorTime;
pub use self::slot_table::SlotTable;
pub use self::types::{
    ActivityMark, ArbiterId, ArbiterSample, ArbiterStatus, ComponentSample, HangDetectorConfig,
    HangLimits, JudgedComponent, LivenessEvent, Looked, MaxSilence, QueueReading, SlotId,
};

use self::entry::ComponentEntry;
use self::lateness::{Episode, Late, Lateness, OverloadRoot, WINDOW};
use self::processor::ProcessorShare;
use self::turn::ThreadTurn;
use crate::detection::Finding;
use crate::sorted::SortedMap;
use crate::{Instant, Machine, ObjectName};
use occupancy::Occupancy;
use std::collections::VecDeque;
use std::time::Duration;

/// A gap between two looks that is reported to others, so that they wait as much longer. Ten of the
/// usual intervals.
const STALL: Duration = Duration::from_millis(100);
/// How long a beat may stand before the arbiter's components are not judged for awaiting too long,
/// and not for silence where no component is on the thread. Several beats, and well below the
/// shortest tolerance for silence.
const TREATMENT_STOP: Duration = Duration::from_millis(50);

#[derive(Debug)]
struct Arbiter {
    beat: u64,
    /// When this beat was first seen.
    beat_since: Instant,
    turn: ThreadTurn,
    /// For how long it was ready to run, stood, and was not run.
    starved: Duration,
    occupancy: Occupancy<SlotId>,
    processor: ProcessorShare,
    hang: Option<Hang>,
    /// The root of an overload that stands.
    overloaded: Option<SlotId>,
    fenced_since: Option<Instant>,
    lost: bool,
}

#[derive(Debug)]
struct Hang {
    culprit: ObjectName,
    slot: SlotId,
}

#[derive(Debug)]
struct ComponentRecord {
    judged: JudgedComponent,
    reading: Option<ComponentSample>,
    /// Its arbiter's beat at the last look.
    beat: u64,
    /// How long its arbiter had been starved at the last look.
    starved: Duration,
    turn_since: Instant,
    awaited: AwaitedSign,
    /// When it was last seen to have given a sign of life, in this incarnation.
    last_sign: Option<Instant>,
    /// This turn has been reported.
    waits: bool,
    silence: Silence,
    lateness: Lateness,
    /// An overload whose root it is.
    overload: Option<Episode>,
}

/// The next sign of life.
#[derive(Clone, Copy, Debug)]
struct AwaitedSign {
    since: Instant,
    /// The arbiter's beat then.
    beat: u64,
    /// The component's turn has moved since.
    worked: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Silence {
    No,
    Reported,
    /// It was reported, and what had blocked the component is over: it is measured again.
    Void,
}

/// The judge. Shown heartbeats often and activity records less often, each time between
/// [`handle_look`](HangDetector::handle_look) and draining the outputs.
#[derive(Debug)]
pub struct HangDetector {
    config: HangDetectorConfig,
    looked_at: Option<Instant>,
    /// The time in which it has looked.
    clock: Instant,
    /// How far its clock went between the last two looks.
    step: Duration,
    arbiters: SortedMap<ArbiterId, Arbiter>,
    /// By slot; slots are dense.
    components: SlotTable<ComponentEntry>,
    /// Those that were judged at the last look, in order.
    awake: Vec<SlotId>,
    /// An overload of the computer itself.
    computer: Option<Episode>,
    outputs: VecDeque<LivenessEvent>,
}

impl HangDetector {
    /// A scanner that has seen nothing yet.
    pub fn new(config: HangDetectorConfig) -> Self {
        HangDetector {
            config,
            looked_at: None,
            clock: Instant::ORIGIN,
            step: Duration::ZERO,
            arbiters: SortedMap::new(),
            components: SlotTable::default(),
            awake: Vec::new(),
            computer: None,
            outputs: VecDeque::new(),
        }
    }

    /// This component is judged from now on.
    pub fn handle_enter(&mut self, slot: SlotId, judged: JudgedComponent) {
        let component = ComponentRecord::new(judged, self.clock, 0);
        self.components.insert(slot, ComponentEntry::Awake(Box::new(component)));
    }

    /// It is no longer.
    pub fn handle_leave(&mut self, slot: SlotId) {
        let Some(component) = self.components.remove(slot) else { return };
        let JudgedComponent { object, arbiter, .. } = component.judged();
        if let Some(arbiter) = self.arbiters.get_mut(arbiter) {
            if arbiter.turn.running == Some(slot) {
                arbiter.turn.left = Some(object.clone());
            }
            arbiter.overloaded.take_if(|root| *root == slot);
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
        self.step = gap.min(self.config.gap);
        self.clock = self.clock + self.step;
        if gap > STALL {
            self.outputs.push_back(LivenessEvent::Stalled { gap });
        }
    }

    /// How long it has not been scheduled, all in all.
    fn missed(&self) -> Duration {
        self.looked_at.map_or(Duration::ZERO, |at| at - self.clock)
    }

    /// The instant at which its clock stood so.
    fn shown(&self, at: Instant) -> Instant {
        at + self.missed()
    }

    /// What an arbiter says.
    pub fn handle_heartbeat(&mut self, id: ArbiterId, reading: ArbiterSample) {
        let (now, at) = (self.clock, self.looked_at.unwrap_or(Instant::ORIGIN));
        let arbiter = self.arbiters.entry(id).or_insert(Arbiter {
            beat: reading.beat,
            beat_since: now,
            turn: ThreadTurn::new(&reading, at),
            starved: Duration::ZERO,
            occupancy: Occupancy::default(),
            processor: ProcessorShare::default(),
            hang: None,
            overloaded: None,
            fenced_since: None,
            lost: false,
        });
        arbiter.occupancy.note(reading.running);
        let beats = arbiter.beat != reading.beat;
        if beats {
            (arbiter.beat, arbiter.beat_since) = (reading.beat, now);
        }
        let changed = arbiter.turn.handle_sample(&reading, at, beats, arbiter.hang.is_some());
        let charged = arbiter.turn.charge(reading.used, self.step, at);
        if now - arbiter.beat_since >= 2 * load::LOOK {
            arbiter.starved += self.step.saturating_sub(charged);
        }
        arbiter.fenced_since = reading.fenced.then(|| arbiter.fenced_since.unwrap_or(now));
        let resumed = if changed { arbiter.hang.take() } else { None };
        let lost = !arbiter.lost
            && arbiter.fenced_since.is_some_and(|since| now - since >= self.config.grace);
        if let Some(hang) = resumed {
            self.resume(id, &hang, now);
        }
        self.judge_arbiter(id, &reading, at);
        if lost {
            self.lose(id, reading.running);
        }
    }

    fn judge_arbiter(&mut self, id: ArbiterId, reading: &ArbiterSample, at: Instant) {
        let Some(arbiter) = self.arbiters.get(&id) else { return };
        let (Some(slot), None) = (arbiter.turn.running, &arbiter.hang) else { return };
        let Some(culprit) = self.judged(slot) else { return };
        let limit = culprit.limits.max_block.max(arbiter.turn.allowance);
        if arbiter.turn.charged < limit || culprit.arbiter != id {
            return;
        }
        let age = at - arbiter.turn.since;
        let object = culprit.object.clone();
        let victims = self.others_on(id, slot).into();
        if let Some(arbiter) = self.arbiters.get_mut(&id) {
            arbiter.hang = Some(Hang { culprit: object.clone(), slot });
        }
        let incarnation = reading.activity.unwrap_or_default().incarnation;
        let during = reading.during;
        let finding = Finding::Hangs { during, age, victims };
        self.outputs.push_back(LivenessEvent::Component { object, incarnation, finding });
    }

    fn resume(&mut self, id: ArbiterId, hang: &Hang, now: Instant) {
        let mut objects = self.others_on(id, hang.slot);
        let culprit = self.judged(hang.slot);
        objects.extend(culprit.map(|culprit| culprit.object.clone()));
        // A blocked component could not give a sign of life.
        for (_, entry) in self.components.iter_mut() {
            if let Some(component) = entry.awake_mut()
                && component.judged.arbiter == id
            {
                component.void(now);
            }
        }
        let lost = self.arbiters.get(&id).is_some_and(|arbiter| arbiter.lost);
        if !lost {
            self.outputs.push_back(LivenessEvent::Resumed { objects: objects.into() });
        }
    }

    fn lose(&mut self, id: ArbiterId, running: Option<SlotId>) {
        let Some(arbiter) = self.arbiters.get_mut(&id) else { return };
        arbiter.lost = true;
        let hang = arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), hang.slot));
        let left = arbiter.turn.left.clone();
        let known = hang.or_else(|| {
            let slot = running?;
            let runs = || Some(self.judged(slot)?.object.clone());
            Some((left.or_else(runs)?, slot))
        });
        let Some((culprit, slot)) = known else { return };
        let victims = self.others_on(id, slot).into();
        self.outputs.push_back(LivenessEvent::Lost { arbiter: id, culprit, victims });
    }

    fn judged(&self, slot: SlotId) -> Option<&JudgedComponent> {
        self.components.get(slot).map(ComponentEntry::judged)
    }

    fn others_on(&self, arbiter: ArbiterId, but: SlotId) -> Vec<ObjectName> {
        let others = self.components.iter().filter(|(slot, _)| *slot != but);
        let here =
            others.map(|(_, entry)| entry.judged()).filter(|judged| judged.arbiter == arbiter);
        here.map(|judged| judged.object.clone()).collect()
    }

    /// What is known of every arbiter.
    pub fn arbiters(&self) -> impl Iterator<Item = (ArbiterId, ArbiterStatus)> + '_ {
        self.arbiters.iter().map(|(id, arbiter)| {
            let hangs =
                arbiter.hang.as_ref().map(|hang| (hang.culprit.clone(), arbiter.turn.since));
            (*id, ArbiterStatus { busy: arbiter.occupancy.share(), hangs })
        })
    }

    /// Which components have something in service, which turn it is, and since when at least; by
    /// slot.
    pub fn busy(&self) -> impl Iterator<Item = (SlotId, u64, Instant)> + '_ {
        self.awake().filter_map(|(slot, component)| {
            let turn = component.reading?.turn;
            (turn % 2 == 1).then_some((slot, turn, self.shown(component.turn_since)))
        })
    }

    /// When each component that should give signs of life was last seen to have given one; by slot.
    pub fn last_signs(&self) -> impl Iterator<Item = (SlotId, Option<Instant>)> + '_ {
        self.awake().filter_map(|(slot, component)| {
            let expected = component.reading.is_some_and(|reading| reading.speaks);
            let judged = expected && component.judged.limits.max_silence.is_some();
            judged.then_some((slot, component.last_sign.map(|at| self.shown(at))))
        })
    }

    /// The components that were judged at the last look: all that are not at rest.
    fn awake(&self) -> impl Iterator<Item = (SlotId, &ComponentRecord)> + '_ {
        let entry = |slot: SlotId| self.components.get(slot)?.awake();
        self.awake.iter().filter_map(move |slot| Some((*slot, entry(*slot)?)))
    }

    /// Looks at all components. One that rests costs the comparison of its mark.
    pub fn handle_activities(&mut self, looked: &impl Looked) {
        let (now, missed) = (self.clock, self.missed());
        self.judge_processors();
        let is_overloaded = self.computer.is_some();
        let HangDetector { arbiters, components, awake, outputs, .. } = self;
        let is_busy =
            |arbiter: &Arbiter| arbiter.is_saturated(WINDOW) || arbiter.processor.is_scarce();
        let kept = arbiters.iter().filter(|(_, arbiter)| is_busy(arbiter));
        let busy: Vec<ArbiterId> = kept.map(|(id, _)| *id).collect();
        let (mut late, mut silent) = (Vec::new(), Vec::new());
        awake.clear();
        for (slot, watched) in components.iter_mut() {
            let id = watched.judged().arbiter;
            let is_busy = busy.contains(&id);
            if let ComponentEntry::Resting { mark, .. } = watched
                && *mark == looked.mark(slot)
                && !is_busy
            {
                continue;
            }
            let component = watched.wake(looked.activity(slot), now, missed);
            let arbiter = arbiters.get(&id);
            let around = Around { slot, arbiter, is_busy, is_overloaded, missed };
            component.handle(&around, looked, now, outputs, &mut late, &mut silent);
            watched.settle(now);
            awake.push(slot);
        }
        self.blame(late, looked, now);
        self.relieve(now);
        // What a victim suffers is reported after its root.
        self.outputs.extend(silent);
    }
}

/// Where a component is looked at.
struct Around<'a> {
    slot: SlotId,
    arbiter: Option<&'a Arbiter>,
    /// The arbiter has had no time to spare within the window, or gets no processor.
    is_busy: bool,
    /// An overload of the computer stands.
    is_overloaded: bool,
    /// How long the scanner has not been scheduled, all in all.
    missed: Duration,
}

impl Around<'_> {
    /// The arbiter's beat stands.
    fn stands(&self, now: Instant) -> bool {
        self.arbiter.is_some_and(|arbiter| now - arbiter.beat_since > TREATMENT_STOP)
    }

    /// The component is on the thread.
    fn runs(&self) -> bool {
        self.arbiter.is_some_and(|arbiter| arbiter.turn.running == Some(self.slot))
    }

    /// The arbiter hangs, or has been given up: what happens to those on it is decided with it.
    fn hangs(&self) -> bool {
        self.arbiter.is_some_and(|arbiter| arbiter.hang.is_some() || arbiter.fenced_since.is_some())
    }

    /// What has kept the component from its thread for so long.
    fn kept_by(&self, span: Duration) -> Option<OverloadRoot> {
        self.arbiter?.kept_by(self.slot, span)
    }
}

impl ComponentRecord {
    fn new(judged: JudgedComponent, now: Instant, beat: u64) -> Self {
        ComponentRecord {
            judged,
            reading: None,
            beat,
            starved: Duration::ZERO,
            turn_since: now,
            awaited: AwaitedSign { since: now, beat, worked: false },
            last_sign: None,
            waits: false,
            silence: Silence::No,
            lateness: Lateness::default(),
            overload: None,
        }
    }

    /// There is nothing to judge until it takes something into service. One that has just done so
    /// may do it again.
    fn rests(&self, now: Instant) -> bool {
        let HangLimits { max_silence, max_unanswered, .. } = *self.judged.limits;
        let is_idle = |reading: ComponentSample| {
            reading.turn.is_multiple_of(2)
                && reading.interval.is_zero()
                && self.lateness.is_settled(&reading)
        };
        let is_unheard = max_silence.is_none() && max_unanswered.is_none();
        let is_well = self.silence == Silence::No && self.overload.is_none();
        self.turn_since < now && is_unheard && is_well && self.reading.is_some_and(is_idle)
    }

    /// The next sign of life is awaited from now on.
    fn await_sign(&mut self, now: Instant) {
        self.awaited = AwaitedSign { since: now, beat: self.beat, worked: false };
    }

    /// It had no chance to work: all is measured from now on.
    fn void(&mut self, now: Instant) {
        (self.turn_since, self.waits) = (now, false);
        self.await_sign(now);
        self.lateness.void();
        if self.silence == Silence::Reported {
            self.silence = Silence::Void;
        }
    }

    fn handle(
        &mut self,
        around: &Around<'_>,
        looked: &impl Looked,
        now: Instant,
        outputs: &mut VecDeque<LivenessEvent>,
        late: &mut Vec<Late>,
        silent: &mut Vec<LivenessEvent>,
    ) {
        let reading = looked.activity(around.slot);
        let before = self.reading.replace(reading);
        let beat = around.arbiter.map_or(0, |arbiter| arbiter.beat);
        let beats = std::mem::replace(&mut self.beat, beat) != beat;
        let starved = around.arbiter.map_or(Duration::ZERO, |arbiter| arbiter.starved);
        let waited = starved.saturating_sub(std::mem::replace(&mut self.starved, starved));
        let Some(before) = before.filter(|before| before.incarnation == reading.incarnation) else {
            let fresh = ComponentRecord::new(self.judged.clone(), now, beat);
            let lateness = Lateness::new(now, around.missed, &reading);
            *self = ComponentRecord { reading: Some(reading), starved, lateness, ..fresh };
            return;
        };
        self.turn_since = (self.turn_since + waited).min(now);
        self.awaited.since = (self.awaited.since + waited).min(now);
        let turned = before.turn != reading.turn;
        if turned {
            if self.waits {
                let objects = [self.judged.object.clone()].into();
                outputs.push_back(LivenessEvent::Resumed { objects });
            }
            (self.turn_since, self.waits, self.awaited.worked) = (now, false, true);
        }
        if before.allowance != reading.allowance {
            self.turn_since = now;
            self.await_sign(now);
        }
        let signs = before.alive != reading.alive;
        // Where it is asked, any movement is an answer.
        let answers = self.judged.limits.max_unanswered.is_some() && (turned || beats);
        if signs || answers || (!reading.speaks && self.judged.limits.max_unanswered.is_none()) {
            self.await_sign(now);
            if signs {
                self.last_sign = Some(now);
            }
            if self.silence != Silence::No && (signs || answers) {
                self.silence = Silence::No;
                outputs.push_back(self.says(reading, Finding::Spoke));
            }
        }
        if around.runs() && !turned && around.stands(now) {
            return; // Judged as a culprit, not for itself.
        }
        if let Some(event) = self.judge_silence(around, looked, now, late) {
            silent.push(event);
        }
        let age = now - self.turn_since;
        let limit = self.judged.limits.max_wait.max(reading.allowance);
        if reading.turn % 2 == 1 && !self.waits && age >= limit && !around.stands(now) {
            self.waits = true;
            let during = looked.during(around.slot);
            outputs.push_back(self.says(reading, Finding::Waits { during, age }));
        }
        if !around.hangs() {
            self.judge_flow(around, looked, turned, now, late);
        }
    }

    fn says(&self, reading: ComponentSample, finding: Finding) -> LivenessEvent {
        let (object, incarnation) = (self.judged.object.clone(), reading.incarnation);
        LivenessEvent::Component { object, incarnation, finding }
    }
}

impl Machine for HangDetector {
    type Output = LivenessEvent;

    fn poll_output(&mut self) -> Option<LivenessEvent> {
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
