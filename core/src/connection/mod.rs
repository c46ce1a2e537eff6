//! Whether a channel to another node is connected, and how good it is.
//!
//! A channel is a topic, a node, a session, a link or a commander. Its owner measures it; this
//! module only judges the measurements, and never reads a clock.
//!
//! ```text
//!  ChannelReading ─► ConnectionJudge ─┐
//!  ChannelReading ─► ConnectionJudge ─┼─ at least k of n: Combination ─► state, cause
//!  ChannelReading ─► ConnectionJudge ─┘                                    │
//!                                               LostCommunication ◄────────┘ rungs
//! ```
//!
//! A channel that was never heard is lost. A limit that is broken is kept only when the figure has
//! fallen to half of it, so that a channel at its limit changes its state once.

mod condition;
mod judge;
mod lost_communication;
mod round_trips;
mod topic;

pub use condition::Combination;
pub use judge::{ChannelReading, ConditionState, ConnectionJudge, ConnectionLimits};
pub use judge::{ConnectionRules, Latency};
pub use lost_communication::{LostCommunication, LostCommunicationEnd, LostCommunicationOutput};
pub use round_trips::RoundTripEstimator;
pub use topic::{LossEstimator, TopicArrival, TopicEstimator};
