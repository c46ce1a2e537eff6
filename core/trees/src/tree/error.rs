//! The errors of ticks and of ports.

use super::TreeNodeId;
use crate::script::ScriptError;
use crate::status::Status;

/// The error of a leaf, of any type.
pub type LeafError = Box<dyn std::error::Error + Send + Sync>;

/// The error of a port that cannot be read or written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PortError {
    /// The leaf does not declare the port: a mistake in its code.
    #[error("the leaf has no port `{0}`")]
    Undeclared(String),
    /// The port is optional, and the tree does not give it.
    #[error("the port `{0}` is not given")]
    Missing(String),
    /// The entry that the port is connected to has no value yet.
    #[error("the port `{port}` reads `{key}`, which has no value")]
    Unset {
        /// The port.
        port: String,
        /// The entry's key.
        key: String,
    },
    /// The value does not convert.
    #[error("the port `{port}` is `{value}`, which is no {kind}")]
    Type {
        /// The port.
        port: String,
        /// The value, as text.
        value: String,
        /// The type that was expected.
        kind: &'static str,
    },
}

/// A tick that could not be carried out. No node is halted by it: the driver decides whether the
/// tree goes on with the next tick, or is halted.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct TickError {
    /// The node in which it happened.
    pub node: TreeNodeId,
    /// The node's path.
    pub path: String,
    /// The cause.
    #[source]
    pub problem: TickProblem,
}

/// The cause of a failed tick.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TickProblem {
    /// A script cannot be run to its end.
    #[error("its script `{text}` fails: {error}")]
    Script {
        /// The script.
        text: String,
        /// The script's error.
        error: ScriptError,
    },
    /// A port cannot be read or written.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The leaf failed to do its work.
    #[error("the leaf has an error: {0}")]
    Leaf(LeafError),
    /// The node answered a status that it may not answer.
    #[error("it answered {0}, which it may not")]
    Answer(Status),
    /// `Parallel` and `ParallelAll` have fewer children than a threshold.
    #[error("a threshold of {threshold} with {children} children")]
    Threshold {
        /// The number of children that are to succeed or to fail.
        threshold: u32,
        /// The number of children.
        children: u32,
    },
    /// The tree has made up too many keys.
    #[error("the blackboard is full")]
    Full,
}
