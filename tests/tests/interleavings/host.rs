//! What the host consists of, as far as the models need it.

#[path = "../../../actors/src/component/life.rs"]
#[expect(
    dead_code,
    unreachable_pub,
    reason = "the models use a part of it, and nothing is exported from here"
)]
pub(crate) mod life;
#[path = "../../../actors/src/liveness/activity.rs"]
#[expect(
    dead_code,
    unused_imports,
    reason = "the models use a part, and its unit tests do not run"
)]
pub(crate) mod stamp;

/// Stands for an arbiter that sweeps deadlines. None passes in a model.
pub(crate) mod pulse {
    use crate::reply::Cancel;
    use std::sync::Arc;
    use std::time::Duration;

    pub(crate) struct ArbiterHeartbeat;

    impl ArbiterHeartbeat {
        pub(crate) fn beats_here() -> bool {
            true
        }
    }

    pub(crate) struct Deadline;

    impl Deadline {
        pub(crate) fn set(_: Duration, _: Arc<dyn Cancel>) -> Self {
            Deadline
        }
    }
}
