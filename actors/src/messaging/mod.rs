//! Messages from a sender to the queue of a component: queues, replies, retries, dead letters,
//! death watch.

pub(crate) mod dead_letters;
pub(crate) mod death_watch;
pub(crate) mod error;
pub(crate) mod incarnation;
pub(crate) mod injection;
pub(crate) mod message_id;
pub(crate) mod message_log;
pub(crate) mod queue;
pub(crate) mod reply;
pub(crate) mod retry;
pub(crate) mod sender;
pub(crate) mod sink;
