//! The capacity that a message takes from its acceptance until the peer's session has acknowledged
//! it (credit-based flow control).

use std::fmt;
use std::sync::Arc;

/// Grants a bounded amount of credit.
pub trait CreditPool: Send + Sync {
    /// One message of so many bytes takes no capacity any more.
    fn give_back(&self, bytes: usize);
}

/// The capacity of one message; dropping it gives it back.
///
/// It goes with its message from queue to queue. None of them needs a bound of its own for what
/// holds credit.
pub struct Credit {
    pool: Arc<dyn CreditPool>,
    bytes: usize,
}

impl Credit {
    /// For so many bytes, which the pool has counted.
    pub fn new(pool: Arc<dyn CreditPool>, bytes: usize) -> Self {
        Credit { pool, bytes }
    }
}

impl Drop for Credit {
    fn drop(&mut self) {
        self.pool.give_back(self.bytes);
    }
}

/// As much of the same pool.
impl PartialEq for Credit {
    fn eq(&self, other: &Credit) -> bool {
        Arc::ptr_eq(&self.pool, &other.pool) && self.bytes == other.bytes
    }
}

impl Eq for Credit {}

impl fmt::Debug for Credit {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.debug_struct("Credit").field("bytes", &self.bytes).finish_non_exhaustive()
    }
}
