//! The crate's tests: robot files go in, and descriptions, findings and nodes come out. Nothing
//! here starts a process or opens a medium.

mod life;
mod program;
mod right_files;
mod schema;
mod sizes;
mod wrong_files;
