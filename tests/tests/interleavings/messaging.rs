//! The parts of messaging that threads share, as the product has them.

#[path = "../../../actors/src/messaging/incarnation.rs"]
pub(crate) mod incarnation;
#[path = "../../../actors/src/messaging/queue.rs"]
#[expect(
    dead_code,
    unused_imports,
    unreachable_pub,
    reason = "the models use a part, its unit tests do not run, and nothing is exported from here"
)]
pub(crate) mod queue;
#[path = "../../../actors/src/messaging/reply.rs"]
#[expect(dead_code, reason = "the models use a part of it")]
pub(crate) mod reply;

/// Stands for what a request without a reply ends in.
pub(crate) mod error {
    #[derive(Debug, PartialEq, Eq)]
    pub(crate) struct RequestError<M> {
        pub(crate) kind: blastema_core::DeliveryError,
        pub(crate) message: Option<M>,
    }

    impl<M> RequestError<M> {
        pub(crate) fn new(kind: blastema_core::DeliveryError, message: Option<M>) -> Self {
            RequestError { kind, message }
        }
    }
}
