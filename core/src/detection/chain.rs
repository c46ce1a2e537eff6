//! Monitor, detector and notifier of one node: what one has put out is the input of the next.

use super::{
    ConfirmedQueueOutput, Detector, DetectorOutput, FaultNotice, FaultTransition, Monitor,
    Notifier, RecovererPort, RecoveryOutcome,
};
use crate::{Fault, Instant, Machine, NodeName};

/// The observing half of the fault chain.
///
/// Its three machines are separate, and each is fed directly. Within one node a machine has taken
/// over a finding when its input returns; only the hand-over to recoverers can be lost, and is
/// confirmed.
#[derive(Clone, Debug)]
pub struct DetectionChain {
    /// Keeps the table.
    pub monitor: Monitor,
    /// Decides which observations are faults, and keeps the record.
    pub detector: Detector,
    /// Informs the recoverers.
    pub notifier: Notifier,
}

/// An output of a [`DetectionChain`].
#[derive(Clone, Debug, PartialEq)]
pub enum DetectionOutput {
    /// Report to all subscribers.
    Tell {
        /// The fault, as it now stands.
        fault: Fault,
        /// When it was so.
        at: Instant,
        /// The step in the fault's history.
        turn: FaultTransition,
    },
    /// Inform the recoverer behind this port.
    Notify(RecovererPort, ConfirmedQueueOutput<FaultNotice>),
}

impl DetectionChain {
    /// The chain of `node`, with an empty table, an empty record and no recoverer.
    pub fn new(node: NodeName) -> Self {
        DetectionChain {
            monitor: Monitor::new(node.clone()),
            detector: Detector::new(node),
            notifier: Notifier::default(),
        }
    }

    /// A recoverer never confirmed a notice. If it is this node's own, nothing is done about the
    /// fault.
    pub fn handle_given_up(&mut self, port: &RecovererPort, notice: &FaultNotice, now: Instant) {
        if let (RecovererPort::Local, FaultNotice::Found(fault)) = (port, notice) {
            let reason = "no recoverer has decided about it".into();
            self.detector.handle_outcome(fault.id, now, RecoveryOutcome::GaveUp { reason });
        }
    }

    /// The chain with the same facts, for an actor that panicked within an input.
    #[must_use]
    pub fn restarted(self, now: Instant) -> Self {
        DetectionChain { notifier: self.notifier.restarted(now), ..self }
    }
}

impl Machine for DetectionChain {
    type Output = DetectionOutput;

    fn poll_output(&mut self) -> Option<DetectionOutput> {
        loop {
            if let Some(observation) = self.monitor.poll_output() {
                self.detector.handle_observed(observation);
                continue;
            }
            match self.detector.poll_output() {
                Some(DetectorOutput::Notify { notice, at }) => {
                    self.notifier.handle_notice(notice, at);
                }
                Some(DetectorOutput::Tell { fault, at, turn }) => {
                    return Some(DetectionOutput::Tell { fault, at, turn });
                }
                None => {
                    let (port, output) = self.notifier.poll_output()?;
                    return Some(DetectionOutput::Notify(port, output));
                }
            }
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let all = [
            self.monitor.poll_timeout(),
            self.detector.poll_timeout(),
            self.notifier.poll_timeout(),
        ];
        all.into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.monitor.handle_timeout(now);
        self.detector.handle_timeout(now);
        self.notifier.handle_timeout(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::{ExitReason, FaultEntry, FaultStatus};
    use crate::{Incarnation, ObjectName};

    fn chain() -> DetectionChain {
        let mut chain = DetectionChain::new(NodeName::new("m").expect("a name"));
        assert!(chain.notifier.add_port(RecovererPort::Local, Instant::ORIGIN));
        let exit = ExitReason::Panicked { text: "boom".into(), at: "".into(), during: "Move" };
        let arm = ObjectName::new("arm").expect("a name");
        chain.monitor.handle_exited(&arm, Incarnation::FIRST, exit, None, Instant::ORIGIN);
        chain
    }

    /// What became of the only fault, and how often the recoverer was told of it without an answer.
    fn run(chain: &mut DetectionChain) -> (FaultEntry, u32) {
        let (mut sent, mut now) = (0, Instant::ORIGIN);
        loop {
            while let Some(output) = chain.poll_output() {
                match output {
                    DetectionOutput::Notify(_, ConfirmedQueueOutput::Deliver { .. }) => sent += 1,
                    DetectionOutput::Notify(port, ConfirmedQueueOutput::GivenUp { item, .. }) => {
                        chain.handle_given_up(&port, &item, now);
                    }
                    DetectionOutput::Tell { .. } => {}
                }
            }
            let Some(due) = chain.poll_timeout() else { break };
            now = due;
            chain.handle_timeout(due);
        }
        (chain.detector.read_record().entries.remove(0), sent)
    }

    #[test]
    fn a_fault_that_no_recoverer_takes_is_handed_over_again_and_then_given_up() {
        let (entry, sent) = run(&mut chain());

        assert_eq!((entry.status(), sent), (FaultStatus::GivenUp, 8));
        assert_eq!(entry.given_up.expect("it is").1, "no recoverer has decided about it");
    }

    #[test]
    fn a_chain_that_was_struck_keeps_its_record_and_hands_over_again() {
        let mut chain = chain();
        let outputs = std::iter::from_fn(|| chain.poll_output()).count();
        assert_eq!(outputs, 2, "the fault, and to the recoverer");

        let mut chain = chain.restarted(Instant::from_millis(1));

        let repeated = chain.poll_output();
        let is_handed = matches!(
            repeated,
            Some(DetectionOutput::Notify(_, ConfirmedQueueOutput::Deliver { .. }))
        );
        assert!(is_handed, "{repeated:?}");
        assert_eq!(chain.detector.read_record().entries.len(), 1);
    }
}
