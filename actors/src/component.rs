//! What a user writes: a component, and what it does with each contract.

pub(crate) mod cell;
mod cold_state;
pub(crate) mod context;
pub(crate) mod control;
pub(crate) mod declaration;
pub(crate) mod envelope;
pub(crate) mod environment;
pub(crate) mod incarnation;
pub(crate) mod long_operation;
pub(crate) mod ports;
pub(crate) mod skeleton;
pub(crate) mod slot;
pub(crate) mod spec_error;
pub(crate) mod subscription;

use crate::platform::errors;
use blastema_core::Contract;
use context::Context;
use ports::Ports;
use std::error::Error;
use std::fmt;

/// An application's object: a struct with a life cycle.
///
/// Every hook is optional. A hook that fails ends the component's work: `on_aborting` is called,
/// the component is in error, and the fault is reported. After a panic, or at the next incarnation,
/// the component is built by the factory of its `ChildSpec`.
///
/// ```text
/// built ─ on_initialize ─► Initialized ─ on_startup, on_activated ─► Active ─ on_execute, handlers …
///                              ▲                                       │ a hook fails
///                              └──── on_reset ──── Error ◄─ on_aborting┘
/// at the end: on_deactivated, on_shutdown, on_finalize
/// ```
///
/// Messages are served while the component is active, one at a time; a handler or hook that awaits
/// keeps the others waiting. Names and meaning of the hooks are those of the OMG Robotic Technology
/// Component specification.
pub trait Component: Sized + 'static {
    /// Declares what the component takes, such as requests, events and topics, and its out ports.
    fn ports(ports: &mut Ports<Self>) {
        let _ = ports;
    }

    /// Prepares what an incarnation needs: opens devices, checks settings. A failure here is fatal.
    fn on_initialize(
        &mut self,
        cx: &mut Context<Self>,
    ) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// Follows `on_initialize`, once in an incarnation.
    fn on_startup(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// The component goes to work, at first or after a reset.
    fn on_activated(
        &mut self,
        cx: &mut Context<Self>,
    ) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// One round of periodic work, at the rate of the `ChildSpec`, while active. Rounds that were
    /// missed are skipped.
    fn on_execute(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// The component leaves work in order.
    fn on_deactivated(
        &mut self,
        cx: &mut Context<Self>,
    ) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// The component leaves work because something failed. Bring outputs into a safe state here.
    fn on_aborting(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// The component is in error now, and waits for a reset.
    fn on_error(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// Recovers from an error, within the same incarnation. A failure here is fatal.
    fn on_reset(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// Precedes `on_finalize` where the incarnation ends in order.
    fn on_shutdown(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }

    /// The last word of an incarnation, unless it panicked.
    fn on_finalize(&mut self, cx: &mut Context<Self>) -> impl Future<Output = Result<(), Failure>> {
        let _ = cx;
        async { Ok(()) }
    }
}

/// Takes one contract. Written as `async fn handle`; it may hold `&mut self` across an await.
#[diagnostic::on_unimplemented(
    message = "`{Self}` has no handler for `{M}`",
    label = "`{Self}` does not handle `{M}`",
    note = "write `impl Handle<{M}> for {Self}`, with `async fn handle(&mut self, message: {M}, cx: &mut Context<Self>)` \
            that returns the contract's reply"
)]
pub trait Handle<M: Contract>: Component {
    /// Serves one message; for a request, the result is the reply.
    fn handle(&mut self, message: M, cx: &mut Context<Self>) -> impl Future<Output = M::Reply>;
}

/// Why a hook failed. Any error becomes one by `?`, with the causes that it names; so does a text.
///
/// ```
/// use blastema::Failure;
///
/// let failure = Failure::from("the laser does not answer");
/// assert!(!failure.fatal);
/// assert!(Failure::fatal("the laser is on fire").fatal);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// What went wrong, for display.
    pub reason: String,
    /// This incarnation cannot be saved by a reset.
    pub fatal: bool,
    /// Something that it needs is not there yet: an incarnation that begins, or resets itself,
    /// tries again later.
    pub unavailable: bool,
}

impl Failure {
    /// A failure that no reset clears: the component is to be restarted.
    pub fn fatal(reason: impl Into<String>) -> Self {
        Failure { reason: reason.into(), fatal: true, unavailable: false }
    }

    /// Something outside of the component that it needs is not there yet: a device that is not
    /// plugged in, a server that is still starting.
    ///
    /// From `on_initialize`, `on_startup`, `on_activated` and `on_reset` it is no error of the
    /// component: the same hook of the same incarnation is called again, after 100 ms and then ever
    /// later, up to five seconds apart, for as long as that takes. The fault *unavailable* (`B22`)
    /// stands meanwhile, and no restart is counted. From anywhere else it is a failure like any
    /// other, which the plan answers by a reset first.
    ///
    /// ```
    /// use blastema::prelude::*;
    /// use std::fs::File;
    ///
    /// struct Laser {
    ///     port: Option<File>,
    /// }
    ///
    /// impl Component for Laser {
    ///     async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
    ///         let port = File::open("/dev/ttyUSB0");
    ///         let port = port.map_err(|error| Failure::unavailable(format!("the laser: {error}")))?;
    ///         self.port = Some(port);
    ///         Ok(())
    ///     }
    /// }
    /// ```
    pub fn unavailable(reason: impl Into<String>) -> Self {
        Failure { reason: reason.into(), fatal: false, unavailable: true }
    }
}

// Errors and texts alike, which two impls could not be.
impl<E: Into<Box<dyn Error>>> From<E> for Failure {
    fn from(error: E) -> Self {
        Failure { reason: errors::with_causes(&*error.into()), fatal: false, unavailable: false }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.reason)
    }
}
