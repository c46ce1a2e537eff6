//! Tests on real threads, whose clock is the computer's.

/// Runs a test in an actix system of its own, while it has the [`turn`](fn@crate::turn).
///
/// # Panics
/// When the test does, or when there is a system on this thread already.
#[track_caller]
pub fn run<F: Future>(test: F) -> F::Output {
    let _turn = crate::turn();
    actix_rt::System::new().block_on(test)
}
