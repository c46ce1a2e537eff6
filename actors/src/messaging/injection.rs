//! Faults that a test injects into an unmodified component.
//!
//! They belong to the component, not to an incarnation: silence and delay act on every one until
//! they are taken out; a hang acts once, failed initialisations as often as was said, and a panic
//! at once. Where none is put in, each handler and hook costs one more load.

use blastema_core::Instant;
use std::pin::Pin;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64};
use std::time::Duration;

/// A fault that is put into a component on purpose, by [`Node::inject`](crate::Node::inject).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Injection {
    /// The component panics.
    Panic,
    /// The next handler or hook that begins awaits for ever. It does not keep its thread.
    Hang,
    /// The component works, but reports no sign of life and answers no ping.
    Silence,
    /// So many times from now on its initialisation fails.
    FailedInitializations(u32),
    /// Each handler and hook begins this much later, and keeps the component busy meanwhile.
    Delay(Duration),
    /// Whatever was put in and still acts is taken out.
    Nothing,
}

/// What was put into one component.
#[derive(Debug, Default)]
pub(crate) struct InjectionState {
    any: AtomicBool,
    hangs: AtomicBool,
    silent: AtomicBool,
    failed_initializations: AtomicU32,
    delay_nanos: AtomicU64,
}

impl InjectionState {
    /// Panics are not kept: they happen.
    pub(crate) fn put_in(&self, injection: Injection) {
        match injection {
            Injection::Panic => return,
            Injection::Hang => self.hangs.store(true, Relaxed),
            Injection::Silence => self.silent.store(true, Relaxed),
            Injection::FailedInitializations(times) => {
                self.failed_initializations.store(times, Relaxed);
            }
            Injection::Delay(span) => {
                let nanos = (Instant::ORIGIN + span).as_nanos();
                self.delay_nanos.store(nanos, Relaxed);
            }
            Injection::Nothing => {
                self.hangs.store(false, Relaxed);
                self.silent.store(false, Relaxed);
                self.failed_initializations.store(0, Relaxed);
                self.delay_nanos.store(0, Relaxed);
            }
        }
        self.any.store(injection != Injection::Nothing, Relaxed);
    }

    /// What a handler or hook awaits before it begins.
    #[inline]
    pub(crate) fn before(&self) -> Option<Pin<Box<dyn Future<Output = ()>>>> {
        if self.any.load(Relaxed) { self.found_before() } else { None }
    }

    #[cold]
    fn found_before(&self) -> Option<Pin<Box<dyn Future<Output = ()>>>> {
        if self.hangs.swap(false, Relaxed) {
            return Some(Box::pin(std::future::pending()));
        }
        match self.delay_nanos.load(Relaxed) {
            0 => None,
            nanos => Some(Box::pin(tokio::time::sleep(Duration::from_nanos(nanos)))),
        }
    }

    #[inline]
    pub(crate) fn is_silent(&self) -> bool {
        self.any.load(Relaxed) && self.silent.load(Relaxed)
    }

    /// Whether this initialisation is one of those that are to fail.
    pub(crate) fn fails_initialization(&self) -> bool {
        let one_less = |times: u32| times.checked_sub(1);
        self.failed_initializations.fetch_update(Relaxed, Relaxed, one_less).is_ok()
    }
}
