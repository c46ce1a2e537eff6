//! Stands for an arbiter that sweeps deadlines. None passes in a model.

pub(crate) mod deadline {
    use blastema_core::DeliveryError;
    use std::sync::Arc;
    use std::time::Duration;

    pub(crate) trait Cancel: Send + Sync {
        fn cancel(&self, why: DeliveryError);
        #[expect(dead_code, reason = "only a request that is overdue is asked")]
        fn asker(&self) -> Option<u32>;
    }

    pub(crate) struct Deadline;

    impl Deadline {
        pub(crate) fn set(_: Duration, _: Arc<dyn Cancel>) -> Self {
            Deadline
        }
    }
}

pub(crate) mod heartbeat {
    pub(crate) struct ArbiterHeartbeat;

    pub(crate) fn running_here() -> Option<u32> {
        None
    }

    impl ArbiterHeartbeat {
        pub(crate) fn beats_here() -> bool {
            true
        }
    }
}
