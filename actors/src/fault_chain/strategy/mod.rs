//! Recovery strategies. The node's own actions are calls of the [`StrategyContext`]. Each strategy of
//! the application has an actor on a thread of its own, made when the strategy is first needed.
//!
//! ```text
//! Recoverer ─────────────────────────────────────────────────────► context
//! Recoverer ──ExecuteAction(order)──► StrategyHost ──► RecoveryStrategy::carry_out(order, context)
//!           ◄──RecoveryDone | Failed───┘                        │
//!                          Supervisor ◄──ChildRequest───┤ context
//!                          Router     ◄──Reroute────────┘
//! ```

mod context;
mod host;
mod outputs;
mod table;

pub use context::StrategyContext;
pub(crate) use context::{NetworkOrders, StrategyTargets};
pub(crate) use outputs::{ApplyOutputs, NOT_RETURNED, SAFE_OUTPUTS, SafeOutputs};
pub(crate) use table::{EngagedStrategy, StrategyTable, object_of};

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
///         context: &StrategyContext,
///     ) -> Result<RecoveryDone, RecoveryFailed> {
///         context.isolate(&order.fault.location).await?;
///         context.restart(&order.fault).await
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
        context: &StrategyContext,
    ) -> impl Future<Output = Result<RecoveryDone, RecoveryFailed>>;
}
