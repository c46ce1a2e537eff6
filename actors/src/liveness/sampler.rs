//! The sampler: reads heartbeats and activity records at even intervals, and reports to the
//! monitor.
//!
//! It runs on a thread of its own, so that a busy robot is not a dead one and a stuck arbiter is
//! still seen. In tests it is a task under their clock. The judging is [`HangDetector`]'s.

use super::activity::{ActivityRecord, ActivitySample};
use super::label;
use crate::arbiter::heartbeat::{self, ArbiterHeartbeat};
use crate::arbiter::pool::ArbiterPool;
use crate::platform;
use crate::platform::lock;
use crate::platform::processor_time::ThreadNumber;
use actix::Recipient;
use blastema_contract::reports::LivenessReported;
use blastema_core::detection::hang::{
    ActivityMark, ArbiterSample, ArbiterStatus, ComponentSample, HangDetector, HangDetectorConfig,
    HangLimits, JudgedComponent, LivenessEvent, Looked, QueueReading, SlotId, SlotTable,
};
use blastema_core::detection::{CurrentHandler, MonitorRow, QueueSample, RoundLateness};
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultLocation, Incarnation, Instant, Machine, NodeName, ObjectName};
use std::collections::BTreeSet;
use std::io;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, Weak};
use std::thread::JoinHandle;
use std::time::Duration;

/// How often heartbeats are sampled: as often as they beat.
const HEARTBEATS: Duration = crate::arbiter::heartbeat::HEARTBEAT_INTERVAL;
/// Activity records are sampled once in so many samples. There are many of them: in every sample it
/// would cost six percent of a core for a hundred thousand.
const STAMPS: u64 = 10;

/// What can be told of a component without asking it.
pub(crate) trait AliveSource: Send + Sync {
    /// The incarnation that began last.
    fn incarnation(&self) -> Incarnation;
    /// How many messages wait, and how long the oldest of them has.
    fn queue(&self) -> QueueReading;
    /// Whether what waits is kept from it, since it is isolated.
    fn is_held(&self) -> bool;
    /// The slots of the components whose requests wait in its queue.
    fn askers(&self) -> Vec<u32>;
    /// How late its rounds begin.
    fn round_lateness(&self) -> Option<RoundLateness>;
}

/// One component as the watch sees it.
pub(crate) struct SampledComponent {
    pub(crate) object: ObjectName,
    pub(crate) inside: Weak<dyn AliveSource>,
    pub(crate) heartbeat: Arc<ArbiterHeartbeat>,
    pub(crate) activity: &'static ActivityRecord,
    pub(crate) limits: Arc<HangLimits>,
}

impl SampledComponent {
    fn judged(&self) -> JudgedComponent {
        let (object, limits) = (self.object.clone(), self.limits.clone());
        JudgedComponent { object, arbiter: self.heartbeat.id(), limits }
    }

    fn read(&self) -> ComponentSample {
        self.activity.read().component
    }
}

/// Everything that is to be watched: as many entries as components live. Clones share it.
#[derive(Clone, Default)]
pub(crate) struct SampledComponents(Arc<Entries>);

#[derive(Default)]
struct Entries {
    by_slot: Mutex<SortedMap<u32, Arc<SampledComponent>>>,
    /// The component that declares its ports now, before it has a slot.
    declaring: Mutex<Option<ObjectName>>,
    /// The slots whose entries the watch has not learnt of yet.
    changed: Mutex<BTreeSet<u32>>,
    last: Mutex<LastLook>,
}

/// What the last sample found.
#[derive(Clone, Default)]
struct LastLook {
    /// What was in service: slot, turn, and since when.
    busy: Vec<(u32, u64, Instant)>,
    /// When components that give signs of life by themselves were seen to have given one, by slot.
    signs: Vec<(u32, Option<Instant>)>,
    arbiters: SortedMap<u64, ArbiterStatus>,
}

/// Who lives on an arbiter.
pub(crate) struct ArbiterResidents {
    pub(crate) heartbeat: Arc<ArbiterHeartbeat>,
    /// Who is on the thread right now.
    pub(crate) running: Option<ObjectName>,
    /// Each with the number of messages that wait for it.
    pub(crate) components: Vec<(ObjectName, usize)>,
}

impl ArbiterResidents {
    pub(crate) fn none(heartbeat: &Arc<ArbiterHeartbeat>) -> Self {
        ArbiterResidents { heartbeat: heartbeat.clone(), running: None, components: Vec::new() }
    }
}

impl SampledComponents {
    pub(crate) fn enter(&self, slot: u32, watched: SampledComponent) {
        lock(&self.0.by_slot).insert(slot, Arc::new(watched));
        self.note_change(slot);
    }

    /// After the entry was changed, so that who learns of it finds it so.
    fn note_change(&self, slot: u32) {
        lock(&self.0.changed).insert(slot);
    }

    /// This component declares its ports from now on, or none does.
    pub(crate) fn declare(&self, object: Option<ObjectName>) {
        *lock(&self.0.declaring) = object;
    }

    /// The component that runs on this thread; empty if none of this node does.
    pub(crate) fn name_here(&self) -> String {
        let entries = lock(&self.0.by_slot);
        let here = heartbeat::running_here().and_then(|slot| entries.get(&slot));
        here.map_or_else(String::new, |watched| watched.object.to_string())
    }

    /// Where the component on this thread waits for `asked`, and that one for it, directly or by
    /// way of others: all of them, each asking the next, and the incarnation of the first.
    pub(crate) fn circle(&self, asked: &ObjectName) -> Option<(Incarnation, Vec<ObjectName>)> {
        let own = heartbeat::running_here()?;
        let entries = lock(&self.0.by_slot).clone();
        let first = entries.get(&own)?;
        let incarnation = first.inside.upgrade()?.incarnation();
        let mut circle = vec![first.object.clone()];
        // Each with the one that it asks.
        let mut asks = SortedMap::new();
        let mut found = vec![own];
        while let Some(mut slot) = found.pop() {
            let Some(watched) = entries.get(&slot) else { continue };
            if watched.object == *asked {
                while slot != own {
                    circle.push(entries.get(&slot)?.object.clone());
                    slot = *asks.get(&slot)?;
                }
                return Some((incarnation, circle));
            }
            for asker in watched.inside.upgrade().map_or(Vec::new(), |inside| inside.askers()) {
                if asker != own && !asks.contains_key(&asker) {
                    asks.insert(asker, slot);
                    found.push(asker);
                }
            }
        }
        None
    }

    /// Who lives on which arbiter now.
    pub(crate) fn residents(&self) -> SortedMap<u64, ArbiterResidents> {
        let mut residents = SortedMap::new();
        for (slot, watched) in lock(&self.0.by_slot).iter() {
            let Some(inside) = watched.inside.upgrade() else { continue };
            let heartbeat = &watched.heartbeat;
            let on = residents
                .entry(heartbeat.id())
                .or_insert_with(|| ArbiterResidents::none(heartbeat));
            if heartbeat.running() == Some(*slot) {
                on.running = Some(watched.object.clone());
            }
            on.components.push((watched.object.clone(), inside.queue().queued));
        }
        residents
    }

    /// What the last sample found of the arbiters.
    pub(crate) fn seen(&self) -> SortedMap<u64, ArbiterStatus> {
        lock(&self.0.last).arbiters.clone()
    }

    /// Completes the rows of this node's components by what they are doing now, also if they are
    /// stuck.
    pub(crate) fn show_in(&self, node: &NodeName, rows: &mut [MonitorRow]) {
        let now = platform::now();
        let LastLook { busy, signs, .. } = lock(&self.0.last).clone();
        let entries = lock(&self.0.by_slot).clone();
        let by_name: SortedMap<&ObjectName, _> =
            entries.iter().map(|(slot, watched)| (&watched.object, (slot, watched))).collect();
        for row in rows {
            let FaultLocation::Object(address) = &row.location else { continue };
            let watched = by_name.get(&address.object).filter(|_| address.node == *node);
            let Some((slot, watched)) = watched else { continue };
            let reading = watched.activity.read();
            let ComponentSample { turn, missed_ticks, .. } = reading.component;
            let inside = watched.inside.upgrade();
            let Some(inside) = inside.filter(|inside| inside.incarnation() == row.incarnation)
            else {
                continue;
            };
            let since = busy.binary_search_by_key(*slot, |entry| entry.0).ok().map(|at| busy[at]);
            let since = since.filter(|(_, then, _)| *then == turn);
            let age = since.map_or(Duration::ZERO, |(_, _, since)| now - since);
            let is_busy = turn % 2 == 1;
            let sign = signs.binary_search_by_key(*slot, |entry| entry.0).ok();
            let last_sign = match (sign.map(|at| signs[at].1), is_busy) {
                (Some(sign), _) => sign.map(|at| now - at),
                (None, true) => Some(age),
                (None, false) => watched.heartbeat.last_beat().map(|at| now - at),
            };
            row.missed_rounds = missed_ticks;
            row.round_lateness = inside.round_lateness();
            let QueueReading { queued, oldest } = inside.queue();
            row.queue = Some(QueueSample { queued, oldest, age: Duration::ZERO });
            row.current = is_busy.then(|| CurrentHandler { during: during(&reading), age });
            // The monitor knows of reports, and the watch of everything else.
            row.last_sign = row.last_sign.into_iter().chain(last_sign).min();
        }
    }

    pub(crate) fn leave(&self, slot: u32) {
        if lock(&self.0.by_slot).remove(&slot).is_some() {
            self.note_change(slot);
        }
    }
}

/// Tells from outside which component is on a thread of a node; it keeps nothing of the node.
#[derive(Clone)]
pub struct Running(pub(crate) SampledComponents);

impl std::fmt::Debug for Running {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.components()).finish()
    }
}

impl Running {
    /// The components that are on a thread now, each with what it does and the number of its turn.
    pub fn components(&self) -> Vec<(ObjectName, &'static str, u64)> {
        let on_thread = |(slot, watched): (&u32, &Arc<SampledComponent>)| {
            let reading = watched.activity.read();
            let running = watched.heartbeat.running() == Some(*slot);
            running.then(|| (watched.object.clone(), during(&reading), reading.component.turn))
        };
        let declaring = lock(&self.0.0.declaring).clone().map(|object| (object, "ports", 0));
        lock(&self.0.0.by_slot).iter().filter_map(on_thread).chain(declaring).collect()
    }
}

/// Ends the watch when dropped.
pub(crate) struct SamplerGuard {
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for SamplerGuard {
    fn drop(&mut self) {
        self.ended.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread never blocks, so that it ends after the present sample.
            let _ = thread.join();
        }
    }
}

/// Watches from a thread of its own, or else as a task under the clock of this thread.
///
/// # Errors
/// The operating system has no thread left.
pub(crate) fn start(
    list: SampledComponents,
    arbiters: ArbiterPool,
    config: HangDetectorConfig,
    monitor: Recipient<LivenessReported>,
    on_thread: bool,
) -> io::Result<SamplerGuard> {
    let ended = Arc::new(AtomicBool::new(false));
    let mut sampler = Sampler::new(list, arbiters, config, monitor, on_thread);
    let stop = ended.clone();
    if on_thread {
        let thread = platform::start_thread("watch", move || {
            while !stop.load(Relaxed) {
                platform::wait(HEARTBEATS);
                sampler.sample(platform::now());
            }
        })?;
        return Ok(SamplerGuard { ended, thread: Some(thread) });
    }
    actix_rt::spawn(async move {
        while !stop.load(Relaxed) {
            tokio::time::sleep(HEARTBEATS).await;
            sampler.sample(platform::now());
        }
    });
    Ok(SamplerGuard { ended, thread: None })
}

/// What the watch knows between two samples.
struct Sampler {
    list: SampledComponents,
    scanner: HangDetector,
    samples: u64,
    activities: SampledActivities,
    /// Each with how many components live on it.
    heartbeats: SortedMap<u64, (Arc<ArbiterHeartbeat>, usize)>,
    arbiters: ArbiterPool,
    monitor: Recipient<LivenessReported>,
    /// It goes by the system's clock, as the processors do.
    is_real: bool,
}

/// What is known by slot.
#[derive(Default)]
struct SampledActivities(SlotTable<Known>);

/// A component, and its record beside it: most samples read records alone.
struct Known {
    activity: &'static ActivityRecord,
    component: Arc<SampledComponent>,
}

impl SampledActivities {
    fn get(&self, slot: SlotId) -> Option<&Arc<SampledComponent>> {
        self.0.get(slot).map(|known| &known.component)
    }

    fn enter(&mut self, slot: SlotId, component: Arc<SampledComponent>) {
        self.0.insert(slot, Known { activity: component.activity, component });
    }

    fn leave(&mut self, slot: SlotId) -> Option<Arc<SampledComponent>> {
        self.0.remove(slot).map(|known| known.component)
    }
}

impl Looked for SampledActivities {
    fn activity(&self, slot: SlotId) -> ComponentSample {
        read(self.get(slot))
    }

    fn mark(&self, slot: SlotId) -> ActivityMark {
        self.0.get(slot).map(|known| known.activity.mark()).unwrap_or_default()
    }

    fn during(&self, slot: SlotId) -> &'static str {
        self.get(slot).map_or("nothing", |known| during(&known.activity.read()))
    }

    fn queue(&self, slot: SlotId) -> QueueReading {
        let inside = self.get(slot).and_then(|known| known.inside.upgrade());
        // What is kept from it makes it neither late nor stuck.
        inside.filter(|inside| !inside.is_held()).map(|inside| inside.queue()).unwrap_or_default()
    }
}

impl Sampler {
    fn new(
        list: SampledComponents,
        arbiters: ArbiterPool,
        config: HangDetectorConfig,
        monitor: Recipient<LivenessReported>,
        is_real: bool,
    ) -> Self {
        Sampler {
            list,
            scanner: HangDetector::new(config),
            samples: 0,
            activities: SampledActivities::default(),
            heartbeats: SortedMap::new(),
            arbiters,
            monitor,
            is_real,
        }
    }

    fn sample(&mut self, now: Instant) {
        self.learn();
        self.scanner.handle_look(now);
        for (id, (heartbeat, _)) in &self.heartbeats {
            let running = heartbeat.running();
            let known = running.and_then(|slot| self.activities.get(slot));
            let reading = ArbiterSample {
                beat: heartbeat.beats(),
                running,
                activity: known.map(|known| known.read()),
                during: known.map_or("nothing", |known| during(&known.activity.read())),
                fenced: heartbeat.is_fenced(),
                used: running
                    .and_then(|_| heartbeat.thread())
                    .and_then(ThreadNumber::used_while_ready),
            };
            self.scanner.handle_heartbeat(*id, reading);
        }
        if self.samples.is_multiple_of(STAMPS) {
            let times = self.heartbeats.iter().filter_map(|(id, (heartbeat, _))| {
                let time = heartbeat.thread().filter(|_| self.is_real)?.processor_time()?;
                Some((*id, time))
            });
            times.for_each(|(id, time)| self.scanner.handle_processor_time(id, time));
            self.scanner.handle_activities(&self.activities);
            let busy = self.scanner.busy().collect();
            let signs = self.scanner.last_signs().collect();
            let arbiters = self.scanner.arbiters().collect();
            *lock(&self.list.0.last) = LastLook { busy, signs, arbiters };
        }
        self.samples += 1;
        self.arbiters.move_pending(now);
        while let Some(event) = self.scanner.poll_output() {
            // It may have come back just now; then its components stay.
            let stays = match &event {
                LivenessEvent::Lost { arbiter, .. } => {
                    let lost = self.heartbeats.get(arbiter);
                    !lost.is_some_and(|(heartbeat, _)| self.arbiters.mark_lost(heartbeat))
                }
                _ => false,
            };
            if !stays {
                self.monitor.do_send(LivenessReported(event));
            }
        }
    }

    /// Brings what is known up to date with the list.
    fn learn(&mut self) {
        let changed = &self.list.0.changed;
        let changed = std::mem::take(&mut *lock(changed));
        if changed.is_empty() {
            return;
        }
        for slot in changed {
            let entry = lock(&self.list.0.by_slot).get(&slot).cloned();
            let known = self.activities.get(slot);
            if let (Some(entry), Some(known)) = (&entry, known)
                && entry.object == known.object
                && entry.heartbeat.id() == known.heartbeat.id()
            {
                self.activities.enter(slot, entry.clone());
                continue;
            }
            if let Some(known) = self.activities.leave(slot) {
                self.scanner.handle_leave(slot);
                if let Some((_, population)) = self.heartbeats.get_mut(&known.heartbeat.id()) {
                    *population = population.saturating_sub(1);
                }
            }
            let Some(entry) = entry else { continue };
            self.scanner.handle_enter(slot, entry.judged());
            let heartbeat = || (entry.heartbeat.clone(), 0);
            self.heartbeats.entry(entry.heartbeat.id()).or_insert_with(heartbeat).1 += 1;
            self.activities.enter(slot, entry);
        }
        // A fenced arbiter is followed until it comes back or is lost, also without components.
        let is_over = |(heartbeat, population): &(Arc<ArbiterHeartbeat>, usize)| {
            *population == 0 && (!heartbeat.is_fenced() || heartbeat.is_lost())
        };
        let over = self.heartbeats.iter().filter(|(_, of)| is_over(of)).map(|(id, _)| *id);
        for id in over.collect::<Vec<_>>() {
            self.heartbeats.remove(&id);
            self.scanner.handle_gone(id);
        }
    }
}

/// What runs, for display.
pub(crate) fn during(reading: &ActivitySample) -> &'static str {
    match reading {
        ActivitySample { condition: true, .. } => label::CONDITION.name,
        ActivitySample { tasks: true, .. } => label::TASK,
        _ => label::name(reading.during),
    }
}

fn read(known: Option<&Arc<SampledComponent>>) -> ComponentSample {
    known.map(|known| known.read()).unwrap_or_default()
}
