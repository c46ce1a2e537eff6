//! What is logged.

use crate::Notes;
use std::collections::BTreeMap;
use std::fmt::Debug;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};

/// The fields of an event by their names, as text.
pub type LogLine = BTreeMap<&'static str, String>;

/// A subscriber that keeps the events that are wanted. All clones are one.
#[derive(Clone)]
pub struct LogLines {
    wanted: fn(&Metadata<'_>) -> bool,
    /// What was logged so far.
    pub lines: Notes<LogLine>,
}

impl LogLines {
    /// Keeps these events.
    pub fn of(wanted: fn(&Metadata<'_>) -> bool) -> Self {
        LogLines { wanted, lines: Notes::default() }
    }
}

struct Fields(LogLine);

impl Visit for Fields {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.insert(field.name(), value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.0.insert(field.name(), format!("{value:?}"));
    }
}

impl Subscriber for LogLines {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        (self.wanted)(metadata)
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut fields = Fields(LogLine::new());
        event.record(&mut fields);
        self.lines.note(fields.0);
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}
