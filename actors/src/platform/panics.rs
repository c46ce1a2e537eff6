//! What is known of a panic: its text and its place, without the cost of a backtrace.
//!
//! The standard hook symbolises a backtrace on the spot and stalls the whole arbiter for a tenth to
//! half a second. Where a guard is going to catch the panic, our hook notes the place instead;
//! every other panic goes to the hook that was there before.
//!
//! The hook runs before the panic unwinds. What unwinds may block, in the `Drop` of a local value:
//! so the text and place are noted where other threads [find](Unwinding::read) them, until the
//! panic is caught.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic;
use std::sync::{Arc, Mutex, MutexGuard, Once, OnceLock, PoisonError};
use std::thread;

thread_local! {
    static GUARDED: Cell<u32> = const { Cell::new(0) };
    static PLACE: RefCell<String> = const { RefCell::new(String::new()) };
    static UNWINDING: OnceLock<Arc<Unwinding>> = const { OnceLock::new() };
    /// Something is noted there.
    static UNWINDS: Cell<bool> = const { Cell::new(false) };
}

/// The guarded panic that unwinds on one thread, for other threads to read.
#[derive(Debug, Default)]
pub(crate) struct Unwinding(Mutex<Option<UnwindingPanic>>);

/// A panic that has not been caught yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UnwindingPanic {
    pub(crate) text: String,
    /// The file and line.
    pub(crate) at: String,
}

impl Unwinding {
    fn lock(&self) -> MutexGuard<'_, Option<UnwindingPanic>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The panic that unwinds now.
    pub(crate) fn read(&self) -> Option<UnwindingPanic> {
        self.lock().clone()
    }

    /// Guarded panics of this thread are noted in `unwinding` from now on.
    pub(crate) fn note_here(unwinding: &Arc<Unwinding>) {
        UNWINDING.with(|here| {
            let _ = here.set(unwinding.clone());
        });
    }

    fn note(panic: UnwindingPanic) {
        let noted = UNWINDING.try_with(|here| here.get().map(|here| here.lock().replace(panic)));
        UNWINDS.set(matches!(noted, Ok(Some(_))));
    }

    /// The last panic of this thread was caught.
    #[cold]
    fn end() {
        UNWINDS.set(false);
        let _ = UNWINDING.try_with(|here| here.get().map(|here| here.lock().take()));
    }
}

/// While it lives, panics on this thread are going to be caught by a guard.
pub(crate) struct PanicGuard(());

impl PanicGuard {
    /// Enters guarded code.
    #[inline]
    pub(crate) fn enter() -> Self {
        GUARDED.set(GUARDED.get() + 1);
        PanicGuard(())
    }
}

impl Drop for PanicGuard {
    #[inline]
    fn drop(&mut self) {
        GUARDED.set(GUARDED.get() - 1);
        if UNWINDS.get() && !thread::panicking() {
            Unwinding::end();
        }
    }
}

/// Installs the hook, once in a process.
pub(crate) fn install_hook() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let previous = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if GUARDED.try_with(Cell::get).unwrap_or(0) == 0 {
                // The reader has ended on purpose, as `head` does: `end_of_program` sets the
                // status.
                if !is_reader_gone(info.payload()) {
                    previous(info);
                }
                return;
            }
            let Some(at) = info.location() else { return };
            let at = format!("{}:{}", at.file(), at.line());
            PLACE.with_borrow_mut(|place| place.clone_from(&at));
            Unwinding::note(UnwindingPanic { text: text_in(info.payload()), at });
        }));
    });
}

/// Whether this is the panic of `println!` after the reader of standard output has ended.
fn is_reader_gone(payload: &(dyn Any + Send)) -> bool {
    payload.downcast_ref::<String>().is_some_and(|text| {
        text.starts_with("failed printing to stdout") && text.contains("Broken pipe")
    })
}

/// What a panic that ends a program becomes: the end of a Unix program whose reader has gone, or
/// itself.
pub(crate) fn end_of_program(payload: Box<dyn Any + Send>) -> ! {
    /// 128 and the number of SIGPIPE, as a shell says it.
    const READER_GONE: i32 = 141;
    if is_reader_gone(&*payload) {
        std::process::exit(READER_GONE);
    }
    panic::resume_unwind(payload)
}

/// Runs what is the user's outside of an incarnation, and says where and how it panicked, if it
/// did.
pub(crate) fn caught<T>(run: impl FnOnce() -> T) -> Result<T, String> {
    let _guarded = PanicGuard::enter();
    panic::catch_unwind(panic::AssertUnwindSafe(run)).map_err(|payload| {
        let at = take_place();
        format!("panicked at {at}: {}", text_of(payload))
    })
}

/// The file and line of this thread's last guarded panic, which was caught.
pub(crate) fn take_place() -> String {
    if UNWINDS.get() && !thread::panicking() {
        Unwinding::end();
    }
    PLACE.take()
}

/// The text of a panic.
pub(crate) fn text_of(payload: Box<dyn Any + Send>) -> String {
    let text = text_in(&*payload);
    // The payload may be the user's; its Drop may panic in turn.
    let _ = panic::catch_unwind(panic::AssertUnwindSafe(|| drop(payload)));
    text
}

fn text_in(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| payload.downcast_ref::<&str>().copied());
    text.unwrap_or("a panic whose payload is no text").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What another thread would read in the middle of unwinding.
    struct Reads<'a>(&'a Unwinding, &'a Mutex<Vec<Option<String>>>);

    impl Drop for Reads<'_> {
        fn drop(&mut self) {
            // A guard that is left meanwhile ends nothing.
            drop(PanicGuard::enter());
            self.1.lock().unwrap().push(self.0.read().map(|panic| panic.text));
        }
    }

    #[test]
    fn a_panic_can_be_read_from_the_hook_on_until_it_is_caught() {
        install_hook();
        let (unwinding, read) = (Arc::new(Unwinding::default()), Mutex::default());
        Unwinding::note_here(&unwinding);
        assert_eq!(unwinding.read(), None);

        let caught = caught(|| {
            let _reads = Reads(&unwinding, &read);
            panic!("ouch")
        });

        assert!(caught.is_err_and(|text: String| text.ends_with(": ouch")));
        assert_eq!(*read.lock().unwrap(), [Some("ouch".to_owned())]);
        assert_eq!(unwinding.read(), None);

        let guarded = PanicGuard::enter();
        assert!(panic::catch_unwind(|| panic!("not asked for its place")).is_err());
        assert!(unwinding.read().is_some());
        drop(guarded);
        assert_eq!(unwinding.read(), None, "the guard is left");
    }
}
