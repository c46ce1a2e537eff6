//! Faults that no recoverer treats because another incarnation is on its way already.
//!
//! Such a fault is recovered when the next incarnation is at work. Where that one fails by another
//! fault, it shares what becomes of that; where it ends in order, and none follows, nothing is left
//! to recover.

use super::Detector;
use crate::detection::correlation::is_down;
use crate::{Fault, FaultId, FaultLocation, Instant, Lifecycle};
use std::iter;

impl Detector {
    /// This fault ends with the incarnation after it, which may have ended before the fault was
    /// told.
    pub(super) fn await_next_incarnation(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        entry.unhanded = true;
        let Fault { location, incarnation, .. } = entry.fault.clone();
        let FaultLocation::Object(address) = &location else { return };
        let seen = self.objects.get(&address.object);
        match seen.filter(|seen| seen.incarnation > incarnation).map(|seen| seen.state) {
            Some(Lifecycle::Active) => {
                self.recover(id, at);
                self.withdraw(id, at);
            }
            Some(Lifecycle::Finalized) => self.end_unhanded_at(&location, at),
            _ => {
                let given_up = self.fault_log.open_faults_at(&location).find_map(|fault| {
                    let later = Some(fault.id).filter(|_| fault.incarnation > incarnation)?;
                    self.fault_log.entry(later)?.given_up.clone()
                });
                if let Some((_, reason)) = given_up {
                    self.give_up(id, at, reason);
                }
            }
        }
    }

    /// An object that ended in order takes along what only its next incarnation could have ended,
    /// unless it was stopped to be replaced: then that incarnation begins soon.
    pub(super) fn end_unhanded_at(&mut self, location: &FaultLocation, at: Instant) {
        let ended: Vec<FaultId> = self.unhanded_at(location).map(|fault| fault.id).collect();
        let due = Some(at + self.limits.next_incarnation);
        for id in ended {
            if let Some(entry) = self.fault_log.entry_mut(id) {
                entry.end_due = due;
            }
        }
    }

    /// No incarnation has begun in time after the one that ended in order.
    pub(super) fn end_unhanded(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        entry.end_due = None;
        let FaultLocation::Object(address) = &entry.fault.location else { return };
        let seen = self.objects.get(&address.object);
        if entry.unhanded
            && !self.ending
            && seen.is_some_and(|seen| seen.state == Lifecycle::Finalized)
        {
            self.end(id, at);
        }
    }

    /// This fault, and those that were to end with its incarnation: of the incarnations before it,
    /// or, where this one is its end, of a reset that came to wait.
    pub(super) fn sharing_the_outcome_of(&self, id: FaultId) -> Vec<FaultId> {
        let Some(entry) = self.fault_log.entry(id) else { return Vec::new() };
        let (fault, ends) = (&entry.fault, is_down(&entry.fault));
        let shares = |other: &&Fault| {
            other.incarnation < fault.incarnation
                || ends && other.incarnation == fault.incarnation && other.id != id
        };
        let sharing = self.unhanded_at(&fault.location).filter(shares).map(|other| other.id);
        iter::once(id).chain(sharing).collect()
    }

    pub(super) fn unhanded_at(&self, location: &FaultLocation) -> impl Iterator<Item = &Fault> {
        let open = self.fault_log.open_faults_at(location);
        open.filter(|fault| self.fault_log.entry(fault.id).is_some_and(|entry| entry.unhanded))
    }
}
