//! Tests of the core in virtual time, or of functions and machines alone: for each, one run is as
//! good as a hundred, so that a failure shuts the gate.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![allow(clippy::disallowed_methods, clippy::disallowed_types, reason = "as a test may")]

mod claims_at_scale;
mod codec;
mod contract_identity;
mod derives;
mod net_header;
mod net_hostile;
mod net_simulation;
mod supervision;

/// What the derives name as the facade.
mod facade {
    pub(crate) use blastema_core::{self as core, serde};
}
