//! Tests of whole robots in virtual time, or of functions and machines alone: for each, one run is
//! as good as a hundred, so that a failure shuts the gate.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod architecture;
mod leaving;
mod manual;
mod ports;
mod readme;
mod robot_file;
mod robots;
mod scenarios;
mod seals;
mod trees;
