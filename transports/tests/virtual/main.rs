//! Tests of transports in virtual time, or of functions and machines alone: for each, one run is as
//! good as a hundred, so that a failure shuts the gate.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod faulty;
mod frame_transport;
mod slow_line;
