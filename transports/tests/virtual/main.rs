//! Tests of transports in virtual time, or of functions and machines alone: for each, one run is as
//! good as a hundred, so that a failure shuts the gate.

mod faulty;
mod frame_transport;
mod slow_line;
