//! For tests of Blastema components: a test node, probes, a paused clock.
//!
//! A dev-dependency of packages with components. Tests run in virtual time: no test sleeps, an hour
//! passes in milliseconds, and no result depends on how busy the machine is.
//!
//! | item | what it is for |
//! | --- | --- |
//! | [`test`](macro@test), [`run`] | a test in virtual time |
//! | [`Harness`] | one component on a bench |
//! | [`TestNode`] | a whole node, with its supervisors and its fault chain |
//! | [`Probe`] | a component in the place of the partners of the one under test: a listener, a target of commands, a server, an actuator |
//! | [`owner`] | a component that owns a variable, in the place of its real owner |
//! | [`advance`], [`settle`], [`now`] | the clock |
//! | [`doubles`] | for those who work on the middleware: its transports and plain actors |
//!
//! Faults are put into a component of a [`TestNode`] by its name, and it need not know of it:
//! [`kill`](TestNode::kill), [`hang`](TestNode::hang), [`silence`](TestNode::silence),
//! [`fail_init`](TestNode::fail_init), [`slow`](TestNode::slow). A handler that never returns keeps
//! the only thread there is: the test program ends then, with the component's name.
//!
//! What needs real threads is not to be had in virtual time, since every thread has a clock of its
//! own: recovery from a handler that blocks its thread, processes, and sockets.
//!
//! # Examples
//!
//! A component, and all that is to be said about it:
//!
//! ```
//! use blastema::prelude::*;
//! use blastema_testkit::Harness;
//! use std::time::Duration;
//!
//! #[derive(Clone, Debug, Event)]
//! struct Tick(u32);
//!
//! struct Clock(u32);
//! impl Component for Clock {
//!     async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
//!         self.0 += 1;
//!         cx.publish(Tick(self.0));
//!         Ok(())
//!     }
//! }
//!
//! # blastema_testkit::run(
//! async { // in a test file: #[blastema_testkit::test] async fn a_clock_ticks_on_for_a_minute()
//!     let mut clock = Harness::start(ChildSpec::new("clock", || Clock(0)).rate_hz(10.0)).await;
//!     let ticks = clock.listen::<Tick>().await;
//!
//!     clock.advance(Duration::from_secs(60)).await;
//!
//!     assert_eq!(ticks.drain().len(), 600);
//!     clock.expect_no_faults().await;
//! }
//! # );
//! ```

mod guard;
mod harness;
mod node;
mod probe;

pub use blastema_doubles as doubles;
pub use blastema_doubles::{PATIENCE, advance, settle};
pub use blastema_macros::test;
pub use harness::Harness;
pub use node::TestNode;
pub use probe::{Owner, Probe, TestDouble, owner};

pub use blastema::platform::now;

/// Runs a test on this thread, in virtual time: the clock stands while a task can run, and then
/// jumps to the next timer.
///
/// [`#[blastema_testkit::test]`](macro@test) does the same to a test function.
///
/// # Panics
/// When the test does, or when it is called within another.
///
/// # Examples
/// ```
/// use blastema_testkit::{advance, now};
/// use std::time::Duration;
///
/// blastema_testkit::run(async {
///     let before = now();
///     advance(Duration::from_secs(3600)).await;
///     assert_eq!(now() - before, Duration::from_secs(3600));
/// });
/// ```
pub fn run<F: Future>(test: F) -> F::Output {
    blastema_doubles::paused(test)
}
