//! The crate's tests, in virtual time: files go in, and ticks, calls and errors come out.

mod oracle;
mod scripted;
