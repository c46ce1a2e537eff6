//! The number by which packets name a node.

use crate::NodeName;
use std::fmt;

/// A node's number: a hash of its name, so that numbers need not be assigned.
///
/// Two names with one number cannot be in one network; the chance is one in 86 million for ten
/// nodes. A node that meets such a pair refuses the second and reports it; another name helps.
///
/// ```
/// use blastema_core::{NodeName, net::NodeId};
/// let module1 = NodeName::new("module1")?;
/// assert_eq!(NodeId::of(&module1).to_string(), "1c30bec4");
/// # Ok::<(), blastema_core::NameError>(())
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(pub u32);

impl NodeId {
    /// The number of the node of this name (FNV-1a, 32 bit).
    pub fn of(name: &NodeName) -> Self {
        let hash = name
            .as_str()
            .bytes()
            .fold(0x811c_9dc5_u32, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193));
        NodeId(hash)
    }
}

impl fmt::Display for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:08x}", self.0)
    }
}

impl fmt::Debug for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}
