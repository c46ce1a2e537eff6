//! Strategies: the actions that each node has are calls of the tools. Each strategy of the
//! application has an actor on a thread of its own, made when it is first needed.
//!
//! ```text
//! Recoverer ─────────────────────────────────────────────────────► tools
//! Recoverer ──ExecuteAction(order)──► StrategyHost ──► RecoveryStrategy::carry_out(order, tools)
//!           ◄──RecoveryDone | Failed───┘                        │
//!                          Supervisor ◄──ChildRequest───┤ tools
//!                          Router     ◄──Reroute────────┘
//! ```

mod host;
mod outputs;
mod table;
mod tools;

pub(crate) use outputs::{ApplyOutputs, NOT_RETURNED, SAFE_OUTPUTS, SafeOutputs};
pub(crate) use table::{EngagedStrategy, StrategyTable, object_of};
pub use tools::StrategyContext;
pub(crate) use tools::StrategyTargets;

use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

/// A recovery strategy of the application.
///
/// The node gets it by name, and calls it for the faults that the plan answers with this name. The
/// node creates it at its first order, and keeps it until the node ends or the recoverer restarts.
///
/// Orders for different places are carried out at the same time: whatever must be remembered
/// between them is kept in a cell. A strategy that panics, or takes longer than
/// [`RecoveryOrder::within`], has failed, and the recoverer goes on up its ladder.
///
/// Each strategy has a thread of its own. Where it blocks that thread for longer than
/// [`callback_limit`](crate::NodeBuilder::callback_limit), the order that it blocks for has failed,
/// the thread is abandoned, and a fault of `chain/strategy/<name>` says so; the other orders that
/// it had are given to a new instance of it, on a fresh thread, from their beginning.
///
/// ```
/// use blastema::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
/// use blastema::{RecoveryStrategy, StrategyContext};
///
/// /// Lets a joint go limp before it is restarted.
/// struct LimpFirst;
///
/// impl RecoveryStrategy for LimpFirst {
///     async fn carry_out(
///         &self,
///         order: &RecoveryOrder,
///         tools: &StrategyContext,
///     ) -> Result<RecoveryDone, RecoveryFailed> {
///         tools.isolate(&order.fault.location).await?;
///         tools.restart(&order.fault).await
///     }
/// }
/// ```
pub trait RecoveryStrategy: 'static {
    /// Carries one action out.
    ///
    /// # Errors
    /// [`RecoveryFailed`] says why it did not help; a text converts into it.
    fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> impl Future<Output = Result<RecoveryDone, RecoveryFailed>>;
}
