//! Behaviour trees as components.
//!
//! ```text
//!  XML file ─ TreeLeaves ─► BehaviorTree: a component; ticks at its rate, and when something changed
//!                              │ tick        ▲ done, failed, changed
//!                              ▼             │
//!  conditions, functions (at once)    LeafTask: one future for each leaf that waits
//! ```
//!
//! [`TreeLeaves`] knows the leaves: those that come with it, and those of the application. A
//! [`BehaviorTree`] is the component that ticks one tree. The engine is the crate `blastema-trees`,
//! whose types are here too. The [manual](crate::manual::trees) shows how they work together.

mod actor;
mod connected;
mod host;
mod leaves;
mod message;
mod rows;
mod shared;
mod task;

pub use actor::BehaviorTree;
pub use blastema_trees::{
    Halt, Leaf, LeafContext, LeafError, LeafResult, Port, PortType, PortValue, Status, TreeErrors,
    Value, byte_at,
};
pub use leaves::{LeafFault, LeafRules, TreeLeaves};
pub(crate) use rows::TreeTable;
pub use rows::{TreeChangeRow, TreeNodeRow};
pub use task::LeafTask;
