//! The errors of ticks and of ports.

use super::TreeNodeId;

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
        /// The name of the port.
        port: String,
        /// The entry's key.
        key: String,
    },
    /// The value does not convert.
    #[error("the port `{port}` is `{value}`, which is no {kind}")]
    Type {
        /// The name of the port.
        port: String,
        /// The value, as text.
        value: String,
        /// The type that was expected.
        kind: &'static str,
    },
}

impl PortError {
    /// The value of this port is none of this kind.
    pub(super) fn of_type(port: &str, value: impl ToString, kind: &'static str) -> PortError {
        PortError::Type { port: port.to_owned(), value: value.to_string(), kind }
    }
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
    /// What went wrong in that node.
    #[source]
    pub problem: TickProblem,
}

/// The cause of a failed tick.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TickProblem {
    /// The leaf failed to do its work.
    #[error("the leaf has an error: {0}")]
    Leaf(LeafError),
    /// The file, or what is on the blackboard, keeps the node from its work: a script or a port
    /// fails, a threshold is too high, or a node answers what it may not.
    #[error("{0}")]
    Node(String),
}
