//! The measurements of a module. They are stored outside of the objects, so that restarts of
//! objects do not change them.

use super::harm::HarmRecord;
use crate::flow_receiver::{FlowReceiver, Sample};
use crate::machine_instant::MachineInstant;
use crate::protocol::{ModuleEvent, Snapshot, SourceState};
use crate::robot::{FLOWS, Flow, Module};
use crate::timings::Timings;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc::Sender;

/// Messages of a flow that the middleware gave back and that wait to be offered again: a quarter of
/// a minute of the fastest flow. When it is full the flow makes no new ones.
const BACKLOG: usize = 3_000;

/// Everything that is measured in a module. Clones share it.
#[derive(Clone, Debug)]
pub(super) struct Measurements {
    events: Sender<ModuleEvent>,
    process: u64,
    readings: Arc<Mutex<Readings>>,
}

#[derive(Debug, Default)]
struct Readings {
    receivers: BTreeMap<&'static str, FlowReceiver>,
    sources: BTreeMap<&'static str, Source>,
    responses: BTreeMap<Module, Timings>,
    unfiltered: Timings,
    filtered: Timings,
    records: BTreeMap<String, Arc<HarmRecord>>,
}

/// The sending end of a flow.
#[derive(Debug, Default)]
struct Source {
    made: u64,
    waiting: VecDeque<Sample>,
}

impl Measurements {
    /// Creates the measurements of a process that has just started; reports go to `events`.
    pub(super) fn new(module: Module, events: Sender<ModuleEvent>) -> Measurements {
        let process = MachineInstant::now().as_nanos().max(1);
        let mut readings = Readings::default();
        for flow in FLOWS.iter().filter(|flow| flow.to == module) {
            readings.receivers.insert(flow.name, FlowReceiver::new(flow.name, process));
        }
        for flow in FLOWS.iter().filter(|flow| flow.from == module) {
            readings.sources.insert(flow.name, Source::default());
        }
        Measurements { events, process, readings: Arc::new(Mutex::new(readings)) }
    }

    /// Reports to the director.
    pub(super) fn tell(&self, event: ModuleEvent) {
        // A director that does not read is about to end; its events are void.
        let _ = self.events.try_send(event);
    }

    /// Returns the harm record of the object of this name.
    pub(super) fn record(&self, object: &str) -> Arc<HarmRecord> {
        self.read().records.entry(object.to_owned()).or_default().clone()
    }

    /// A message of a flow arrived.
    pub(super) fn arrived(&self, flow: &Flow, sample: Sample) {
        let now = MachineInstant::now();
        let mut readings = self.read();
        let receiver = readings.receivers.get_mut(flow.name);
        let passed = receiver.and_then(|receiver| receiver.handle_sample(sample, now));
        drop(readings);
        if let Some(since) = passed {
            self.tell(ModuleEvent::Passed { flow: flow.name.into(), since, at: now });
        }
    }

    /// Watches all flows that end here for the first message sent after `since`.
    pub(super) fn watch(&self, since: MachineInstant) {
        let mut passed = Vec::new();
        for (flow, receiver) in &mut self.read().receivers {
            passed.extend(receiver.watch(since).map(|at| (flow.to_string(), at)));
        }
        for (flow, at) in passed {
            self.tell(ModuleEvent::Passed { flow, since, at });
        }
    }

    /// Makes one more message of the flow, and offers all that wait, in order, as long as they are
    /// taken.
    pub(super) fn offer(&self, flow: &Flow, mut take: impl FnMut(Sample) -> bool) {
        let now = MachineInstant::now();
        let mut readings = self.read();
        let Some(source) = readings.sources.get_mut(flow.name) else { return };
        if source.waiting.len() < BACKLOG {
            source.made += 1;
            let number = source.made;
            source.waiting.push_back(Sample { epoch: self.process, number, sent: now });
        }
        while let Some(sample) = source.waiting.front() {
            if !take(*sample) {
                break;
            }
            source.waiting.pop_front();
        }
    }

    /// A request to another module was answered.
    pub(super) fn answered(&self, by: Module, after: Duration) {
        self.read().responses.entry(by).or_default().record(after);
    }

    /// An event reached a listener.
    pub(super) fn record_tick(&self, filtered: bool, after: Duration) {
        let mut readings = self.read();
        let timings = if filtered { &mut readings.filtered } else { &mut readings.unfiltered };
        timings.record(after);
    }

    /// Returns all measurements; the caller adds objects, links and dead letters.
    pub(super) fn snapshot(&self) -> Snapshot {
        let readings = self.read();
        let source = |(name, source): (&&'static str, &Source)| SourceState {
            flow: (*name).into(),
            epoch: self.process,
            sent: source.made - source.waiting.len() as u64,
            returned: 0,
        };
        let response =
            |(module, timings): (&Module, &Timings)| (module.to_string(), timings.clone());
        Snapshot {
            at: MachineInstant::now(),
            objects: Vec::new(),
            links: Vec::new(),
            sources: readings.sources.iter().map(source).collect(),
            sinks: readings.receivers.values().map(FlowReceiver::state).collect(),
            responses: readings.responses.iter().map(response).collect(),
            unfiltered: readings.unfiltered.clone(),
            filtered: readings.filtered.clone(),
        }
    }

    fn read(&self) -> MutexGuard<'_, Readings> {
        // A panic while the lock is held leaves valid counters.
        self.readings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::sync::mpsc::{Receiver, channel};

    const FLOW: &Flow = &FLOWS[0];

    fn measurements(module: Module) -> (Measurements, Receiver<ModuleEvent>) {
        let (events, events_out) = channel(16);
        (Measurements::new(module, events), events_out)
    }

    fn source(measurements: &Measurements) -> SourceState {
        let snapshot = measurements.snapshot();
        snapshot.sources.into_iter().find(|source| source.flow == FLOW.name).expect("it is here")
    }

    #[test]
    fn what_is_given_back_is_offered_again_in_order() {
        let (measurements, _events_out) = measurements(FLOW.from);
        let mut taken = Vec::new();

        measurements.offer(FLOW, |_| false);
        measurements.offer(FLOW, |_| false);
        let between = source(&measurements);
        measurements.offer(FLOW, |sample| {
            taken.push(sample.number);
            true
        });

        assert_eq!(between.sent, 0);
        assert_eq!(taken, [1, 2, 3]);
        assert_eq!(source(&measurements).sent, 3);
    }

    #[test]
    fn a_flow_that_nobody_takes_makes_no_more_than_its_backlog_holds() {
        let (measurements, _events_out) = measurements(FLOW.from);

        for _ in 0..2 * BACKLOG {
            measurements.offer(FLOW, |_| false);
        }

        assert_eq!(measurements.read().sources[FLOW.name].waiting.len(), BACKLOG);
    }

    #[test]
    fn a_watched_flow_tells_once_when_it_passes() {
        let (measurements, mut events_out) = measurements(FLOW.to);
        let sample =
            |number, sent| Sample { epoch: 1, number, sent: MachineInstant::from_millis(sent) };

        measurements.watch(MachineInstant::from_millis(10));
        measurements.arrived(FLOW, sample(1, 9));
        measurements.arrived(FLOW, sample(2, 10));
        measurements.arrived(FLOW, sample(3, 11));

        let Ok(ModuleEvent::Passed { flow, since, .. }) = events_out.try_recv() else {
            panic!("not told")
        };
        assert_eq!((flow.as_str(), since), (FLOW.name, MachineInstant::from_millis(10)));
        assert!(events_out.try_recv().is_err());
        assert_eq!(
            measurements.snapshot().sinks.iter().filter(|sink| sink.highest == 3).count(),
            1
        );
    }
}
