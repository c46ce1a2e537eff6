//! Tests of the doubles for users in virtual time, or of functions and machines alone: for each,
//! one run is as good as a hundred, so that a failure shuts the gate.

mod component;
mod faults;
mod manual;
