//! A robot from one file: its nodes with their networks, supervision trees, components and plans.
//!
//! ```text
//!  robot.xml ─ reader ─► RobotDescription ─ check ─► findings, each with its place
//!                              │   ▲
//!                    Types ────┴───┘ registered component types, strategies, safe outputs
//!                              │
//!                              ▼
//!                         NodeBuilder, one process for each node
//! ```
//!
//! A program registers its [`Types`] by name and ends with [`Types::main`]; the file composes the
//! robot. What is unknown in a file is an error, and all mistakes are found before anything starts.
//! The format is described in the manual's page *The robot file*.
//!
//! Deliberately not here: the checks of a component or network, which are those of
//! [`NodeBuilder`](blastema::NodeBuilder); geometry and behaviour, which have formats of their own.

pub mod description;

mod check;
mod element;
mod finding;
mod graph;
mod launch;
mod own_process;
mod program;
mod reader;
#[cfg(test)]
mod tests;
mod types;
mod value;

pub use description::RobotDescription;
pub use program::{RobotFileError, program_of};
pub use types::Types;

/// The schema of a robot file for editors and for `xmllint`, as XSD 1.0. It knows the shape of a
/// file; names, references and types are what a check decides.
pub const XSD: &str = include_str!("../robot-1.xsd");
