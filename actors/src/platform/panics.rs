//! What is known of a panic: its text and its place, without the cost of a backtrace.
//!
//! The standard hook symbolises a backtrace on the spot and stalls the whole arbiter for a tenth to
//! half a second. Where a guard is going to catch the panic, our hook notes the place instead;
//! every other panic goes to the hook that was there before.

use blastema_core::fault::shortened;
use std::any::Any;
use std::cell::Cell;
use std::panic;
use std::sync::Once;

thread_local! {
    static GUARDED: Cell<u32> = const { Cell::new(0) };
    /// The last guarded panic of this thread, until it is read.
    static NOTED: Cell<Option<PanicRecord>> = const { Cell::new(None) };
}

/// What is known of a panic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct PanicRecord {
    pub(crate) text: String,
    /// The file and line; empty for one that was not guarded.
    pub(crate) at: String,
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
            let text = text_in(info.payload()).to_owned();
            let _ = NOTED.try_with(|noted| noted.set(Some(PanicRecord { text, at })));
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
    panic::catch_unwind(panic::AssertUnwindSafe(run)).map_err(shown)
}

/// What a payload says of where and how it panicked.
pub(crate) fn shown(payload: Box<dyn Any + Send>) -> String {
    let PanicRecord { text, at } = read(payload);
    format!("panicked at {at}: {text}")
}

/// The text and place of this thread's last panic, which was caught under a guard.
pub(crate) fn read(payload: Box<dyn Any + Send>) -> PanicRecord {
    let PanicRecord { text, at } = NOTED.try_with(Cell::take).ok().flatten().unwrap_or_default();
    let known = text_in(&*payload);
    let text = if text == known { text } else { known.to_owned() };
    // The payload may be the user's; its Drop may panic in turn.
    let _ = panic::catch_unwind(panic::AssertUnwindSafe(|| drop(payload)));
    PanicRecord { text, at }
}

fn text_in(payload: &(dyn Any + Send)) -> &str {
    let text = payload.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| payload.downcast_ref::<&str>().copied());
    shortened(text.unwrap_or("a panic whose payload is no text"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_guarded_panic_is_read_with_its_text_and_place() {
        install_hook();
        let caught = caught(|| panic!("ouch"));
        assert!(caught.is_err_and(|text: String| text.ends_with(": ouch")));

        let guarded = PanicGuard::enter();
        let payload = panic::catch_unwind(|| panic!("asked for later")).expect_err("it panics");
        drop(guarded);
        let PanicRecord { text, at } = super::read(payload);
        assert_eq!(text, "asked for later");
        assert!(at.contains("panics.rs:"), "{at}");
    }
}
