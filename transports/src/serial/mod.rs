//! Serial lines with a node at each end.

mod config;

pub use self::config::{Parity, SerialConfig, StopBits};
