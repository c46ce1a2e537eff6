//! Names of the whole robot, as a node claims them and knows them.

use crate::directory::{Claim, ClaimError, ClaimPolicy, ClaimRow, Holder, NameWatch};
use crate::node::Node;
use crate::registry::remote::NameResolver;
use blastema_core::directory::ClaimRequest;
use blastema_core::{NameError, ObjectName};

/// Names of the whole robot; with the feature `network`.
impl Node {
    /// Claims a [name of the whole robot](crate::manual::names) for the object that is called so
    /// here, and waits until that is decided: for a second at most after the start of the node,
    /// else not at all. Messages to `*:<name>` reach that object then, from every node. The name is
    /// given back when the [`Claim`] is dropped; a component claims by
    /// [`ChildSpec::claim`](crate::ChildSpec::claim).
    ///
    /// # Errors
    /// [`ClaimRefused::Held`](crate::ClaimRefused::Held) where another object has the name, on
    /// whichever node, and the policy is to be refused.
    pub async fn claim(&self, name: &str, policy: ClaimPolicy) -> Result<Claim, ClaimError> {
        self.claim_for(name, name, policy).await
    }

    /// Claims a name of the whole robot for the object `object` of this node.
    ///
    /// # Errors
    /// As [`claim`](Self::claim).
    pub async fn claim_for(
        &self,
        name: &str,
        object: &str,
        policy: ClaimPolicy,
    ) -> Result<Claim, ClaimError> {
        let (name, object) = (ObjectName::new(name)?, ObjectName::new(object)?);
        Claim::make(self.0.environment.directory(), ClaimRequest { name, object, policy }).await
    }

    /// Returns the holder of a global name, as known to this node.
    pub fn holder(&self, name: &str) -> Option<Holder> {
        self.0.environment.directory().holder(&ObjectName::new(name).ok()?)
    }

    /// Reports the holder of a global name, now and at each change.
    ///
    /// # Errors
    /// The name does not parse.
    pub fn watch_name(&self, name: &str) -> Result<NameWatch, NameError> {
        Ok(NameWatch::new(self.0.environment.directory(), ObjectName::new(name)?))
    }

    /// Returns the global names that have a holder.
    pub fn claims(&self) -> Vec<ClaimRow> {
        self.0.environment.directory().rows()
    }
}
