//! What a recoverer does while its node is in the safe state.

use super::{FaultResolution, Place, Recoverer};
use crate::{Fault, Instant};

impl Recoverer {
    /// The node has enter the safe state. Where everything was stopped nothing is treated: what was
    /// under way is given up, and so is what comes. Links and other nodes go on being treated.
    pub fn handle_rest(&mut self, now: Instant) {
        self.resting = true;
        let rests = |place: &&Place| matches!(place, Place::Object(_));
        let places: Vec<Place> = self.cases.keys().filter(rests).cloned().collect();
        for place in places {
            let told = self.cases[&place].given_up;
            for fault in self.close(&place, now).iter().filter(|_| !told) {
                self.tell_rest(fault);
            }
        }
    }

    /// The node is at work again.
    pub fn handle_work(&mut self) {
        self.resting = false;
    }

    pub(super) fn tell_rest(&mut self, fault: &Fault) {
        let reason = "the node is in the safe state, where nothing is restarted".to_owned();
        self.tell(fault, FaultResolution::GaveUp { reason });
    }
}
