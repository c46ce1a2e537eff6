//! Every typed message between two objects of the Blastema middleware.
//!
//! Objects know each other by contract, never by type: an object that holds a [`Recipient`] of one
//! of these messages knows all that it may know about the object behind it. Requests go down,
//! events go up.
//!
//! [`Recipient`]: actix::Recipient

pub mod child;
pub mod detector;
pub mod link;
pub mod monitor;
pub mod notifier;
pub mod recoverer;
pub mod reports;
pub mod router;
pub mod session;
pub mod strategy;
pub mod supervisor;
pub mod transport;

/// The answer to a hand-over of fault information: it has arrived and is in the receiver's record.
///
/// A hand-over that is not confirmed is repeated by its sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq, actix::MessageResponse)]
pub struct Confirmed;
