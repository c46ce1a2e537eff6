//! Tests of whole robots in virtual time, or of functions and machines alone: for each, one run is
//! as good as a hundred, so that a failure shuts the gate.

mod architecture;
mod leaving;
mod manual;
mod message_log;
mod ports;
mod readme;
mod robot_file;
mod robots;
mod scenarios;
mod seals;
mod trees;
