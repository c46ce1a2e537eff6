//! Robots over Zenoh, whose crates compile for minutes: `tests/zenoh/run`. The routers are processes of their own.

mod bridge;
mod sites;
