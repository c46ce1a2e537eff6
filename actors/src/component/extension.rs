//! What the features of a node add to the environment of its components.

use std::any::Any;
use std::sync::Arc;

/// One value per node and type: the topics, the variables, the actuators.
pub(crate) trait Extension: Any + Send + Sync {}

/// The extensions of a node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Extensions(Arc<[Arc<dyn Any + Send + Sync>]>);

impl Extensions {
    /// The same, with one more. It replaces one of the same type.
    pub(crate) fn with<T: Extension>(self, extension: T) -> Self {
        let others = self.0.iter().filter(|known| !known.is::<T>()).cloned();
        let extension: Arc<dyn Any + Send + Sync> = Arc::new(extension);
        Extensions(others.chain([extension]).collect())
    }

    /// The extension of this type.
    pub(crate) fn get<T: Extension>(&self) -> &T {
        let found = self.0.iter().find_map(|known| known.downcast_ref());
        found.expect("a node registers every extension before its first component")
    }
}
