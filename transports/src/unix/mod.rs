//! Unix-domain sockets, between processes of one machine.

mod config;

pub use self::config::UnixConfig;
