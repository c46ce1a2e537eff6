//! What threads share state through, where the order of their steps matters: the queue, the reply
//! slot, the token of an incarnation, the activity record, what a listener leaves at a hub. These
//! files name it here, so that `tests/tests/interleavings` can build them with the types of a model
//! checker instead.

pub(crate) use std::sync::{Mutex, MutexGuard, atomic};
