//! What is known of a panic: its text and its place, without the cost of a backtrace.
//!
//! The standard hook symbolises a backtrace on the spot and stalls the whole arbiter for a tenth to
//! half a second. Where a guard is going to catch the panic, our hook notes the place instead;
//! every other panic goes to the hook that was there before.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic;
use std::sync::Once;

thread_local! {
    static GUARDED: Cell<u32> = const { Cell::new(0) };
    static PLACE: RefCell<String> = const { RefCell::new(String::new()) };
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
            if let Some(at) = info.location() {
                PLACE.with_borrow_mut(|place| *place = format!("{}:{}", at.file(), at.line()));
            }
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

/// Runs what is the user's outside of a life, and says where and how it panicked, if it did.
pub(crate) fn caught<T>(run: impl FnOnce() -> T) -> Result<T, String> {
    let _guarded = PanicGuard::enter();
    panic::catch_unwind(panic::AssertUnwindSafe(run)).map_err(|payload| {
        let at = take_place();
        format!("panicked at {at}: {}", text_of(payload))
    })
}

/// The file and line of this thread's last guarded panic.
pub(crate) fn take_place() -> String {
    PLACE.take()
}

/// The text of a panic.
pub(crate) fn text_of(payload: Box<dyn Any + Send>) -> String {
    match payload.downcast::<String>() {
        Ok(text) => *text,
        Err(other) => match other.downcast::<&str>() {
            Ok(text) => (*text).to_string(),
            Err(other) => {
                // The payload is the user's; its Drop may panic in turn.
                let _ = panic::catch_unwind(panic::AssertUnwindSafe(|| drop(other)));
                "a panic whose payload is no text".into()
            }
        },
    }
}
