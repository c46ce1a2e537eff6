//! What a recoverer does while its node is in the safe state, or ends.

use super::{FaultLocation, Recoverer, RecovererOutput, RecoveryOutcome};
use crate::{Fault, FaultKind, Instant};

/// Why faults of objects are not treated.
pub(super) type TreatmentStop = &'static str;

impl Recoverer {
    /// The node has entered the safe state. Where everything was stopped nothing is treated:
    /// recovery that is in progress is given up, and faults that follow are too. Links and other
    /// nodes go on being treated.
    pub fn handle_rest(&mut self, now: Instant) {
        self.stop_treatment("the node is in the safe state, where nothing is restarted", now);
    }

    /// The node stops: from now on faults of its objects are recorded and not treated, as in the
    /// safe state.
    pub fn handle_node_end(&mut self, now: Instant) {
        self.stop_treatment("the node ends, and restarts nothing", now);
    }

    fn stop_treatment(&mut self, treatment_stop: TreatmentStop, now: Instant) {
        self.treatment_stop = Some(treatment_stop);
        let rests = |location: &&FaultLocation| matches!(location, FaultLocation::Object(_));
        let locations: Vec<FaultLocation> = self.cases.keys().filter(rests).cloned().collect();
        for location in locations {
            let given_up = self.cases[&location].given_up;
            for fault in &self.close(&location, now) {
                self.give_up_hung(fault);
                if !given_up {
                    self.report_untreated(fault, treatment_stop);
                }
            }
        }
    }

    /// The node is at work again.
    pub fn handle_work(&mut self) {
        self.treatment_stop = None;
    }

    /// A fault of an object that is found now.
    pub(super) fn leave_untreated(&mut self, fault: &Fault, treatment_stop: TreatmentStop) {
        self.give_up_hung(fault);
        self.report_untreated(fault, treatment_stop);
    }

    /// Incarnations are stopped one after the other: each that hangs would take all of its time.
    fn give_up_hung(&mut self, fault: &Fault) {
        if fault.kind == FaultKind::Hang {
            self.outputs.push_back(RecovererOutput::AbandonIncarnation { fault: fault.clone() });
        }
    }

    fn report_untreated(&mut self, fault: &Fault, treatment_stop: TreatmentStop) {
        self.tell(fault, RecoveryOutcome::GaveUp { reason: treatment_stop.to_owned() });
    }
}
