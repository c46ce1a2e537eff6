//! Threads that run components and the middleware's own actors: the pool, the heartbeat by which a
//! thread that stands still is found, and the budget of a turn.

pub(crate) mod deadline;
pub(crate) mod heartbeat;
pub(crate) mod pool;
pub(crate) mod turn_budget;
