//! What the monitor remembers of one object.

use super::{CurrentHandler, ExitReason, MonitorRow, ObjectKind, Opinion};
use crate::{FaultKind, FaultLocation, Incarnation, Instant, Lifecycle};

/// One line of the monitor's table, as it is kept.
#[derive(Clone, Debug)]
pub(super) struct MonitoredObject {
    pub(super) kind: ObjectKind,
    pub(super) incarnation: Incarnation,
    pub(super) state: Option<Lifecycle>,
    /// A guard reports its states.
    pub(super) guarded: bool,
    /// It may end itself in order.
    pub(super) may_end: bool,
    pub(super) signs: SignsOfLife,
    pub(super) restarts: u32,
    pub(super) end: Option<LastExit>,
    pub(super) isolated: bool,
    /// There only while it holds something: most objects are well.
    remarks: Option<Box<Remarks>>,
}

/// The signs of life of an incarnation, and what kept it from giving them.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SignsOfLife {
    pub(super) last: Option<Instant>,
    /// Silence was observed and not yet broken.
    pub(super) silent: bool,
    /// It waits behind the hang of another object.
    suspect: bool,
    /// How often it came to wait so.
    suspicions: u32,
}

impl SignsOfLife {
    /// It moves, and waits behind no other object.
    pub(super) fn handle_sign(&mut self, now: Instant) {
        (self.last, self.suspect) = (Some(now), false);
    }

    /// Another object on its thread hangs.
    pub(super) fn handle_suspicion(&mut self) {
        if !std::mem::replace(&mut self.suspect, true) {
            self.suspicions = self.suspicions.saturating_add(1);
        }
    }
}

/// What is to be said of an object that is not well.
#[derive(Clone, Debug, Default)]
struct Remarks {
    /// What it has been doing for too long, and since when.
    current: Option<(&'static str, Instant)>,
    /// What stands beside it and why, the newest last: one for each cause.
    notes: Vec<(NoteCause, String)>,
}

/// Why a note was made. The note goes with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum NoteCause {
    /// The incarnation ended.
    End,
    /// The component is in an error state.
    State,
    /// The object declared this fault.
    Declared(FaultKind),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LastExit {
    /// The component reached `Finalized`; its guard has not reported the end yet.
    Finalized,
    /// Its guard reported an ordered stop.
    Stopped,
    /// Its guard saw it die.
    Died,
}

impl MonitoredObject {
    pub(super) fn new(kind: ObjectKind, incarnation: Incarnation) -> Self {
        MonitoredObject {
            kind,
            incarnation,
            state: None,
            guarded: false,
            may_end: false,
            signs: SignsOfLife::default(),
            restarts: 0,
            end: None,
            isolated: false,
            remarks: None,
        }
    }

    /// Puts a note beside it, in place of an older one of the same cause.
    pub(super) fn note(&mut self, cause: NoteCause, text: String) {
        self.erase(&cause);
        self.remarks.get_or_insert_default().notes.push((cause, text));
    }

    /// The note of this cause.
    pub(super) fn noted(&self, cause: &NoteCause) -> Option<String> {
        let remarks = self.remarks.as_ref()?;
        let note = remarks.notes.iter().find(|(known, _)| known == cause);
        note.map(|(_, text)| text.clone())
    }

    /// The cause of a note is away.
    pub(super) fn erase(&mut self, cause: &NoteCause) {
        if let Some(remarks) = &mut self.remarks {
            remarks.notes.retain(|(known, _)| known != cause);
        }
        self.tidy();
    }

    /// What it has been doing for too long, and since when.
    pub(super) fn current(&self) -> Option<(&'static str, Instant)> {
        self.remarks.as_ref()?.current
    }

    pub(super) fn set_current(&mut self, current: Option<(&'static str, Instant)>) {
        self.remarks.get_or_insert_default().current = current;
        self.tidy();
    }

    fn tidy(&mut self) {
        self.remarks.take_if(|remarks| remarks.current.is_none() && remarks.notes.is_empty());
    }

    /// Empties the history: what was known was known of another incarnation. Isolation outlives a
    /// restart.
    pub(super) fn begin(&mut self, incarnation: Incarnation) {
        let MonitoredObject { kind, guarded, may_end, isolated, restarts, .. } = *self;
        let first = self.incarnation == Incarnation::default();
        let restarts = restarts.saturating_add(u32::from(!first));
        let fresh = MonitoredObject::new(kind, incarnation);
        *self = MonitoredObject { guarded, may_end, isolated, restarts, ..fresh };
    }

    fn opinion(&self) -> Opinion {
        match self.end {
            Some(LastExit::Died) => Opinion::Failed,
            Some(LastExit::Stopped | LastExit::Finalized) => Opinion::Stopped,
            None if self.signs.silent || self.current().is_some() => Opinion::Failed,
            None if self.signs.suspect => Opinion::Suspect,
            None if self.signs.last.is_none() => Opinion::Unheard,
            None => Opinion::Trusted,
        }
    }

    /// The row of the table, but for what only the sampler knows.
    pub(super) fn row(&self, location: FaultLocation, now: Instant) -> MonitorRow {
        MonitorRow {
            incarnation: self.incarnation,
            state: self.state,
            waiting_for: self.noted(&NoteCause::Declared(FaultKind::Unavailable)),
            opinion: self.opinion(),
            last_sign: self.signs.last.map(|sign| now - sign),
            restarts: self.restarts,
            suspicions: self.signs.suspicions,
            current: self
                .current()
                .map(|(during, since)| CurrentHandler { during, age: now - since }),
            isolated: self.isolated,
            note: self.remarks.as_ref().and_then(|remarks| Some(remarks.notes.last()?.1.clone())),
            ..MonitorRow::blank(location, self.kind)
        }
    }
}

/// How an incarnation ended, as a note.
pub(super) fn describe(exit: &ExitReason) -> String {
    match exit {
        ExitReason::Returned => "it ended itself".into(),
        ExitReason::Fatal => "it could not go on".into(),
        ExitReason::Panicked { text, at, during } if at.is_empty() => {
            format!("panicked in {during}: {text}")
        }
        ExitReason::Panicked { text, at, during } => {
            format!("panicked in {during} at {at}: {text}")
        }
        ExitReason::Aborted => "its arbiter went away".into(),
        ExitReason::Stopped => "it was told to stop".into(),
    }
}
