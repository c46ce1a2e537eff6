//! The suite of all media, robots at two sites, and the bridge. Routers are processes of their own.
#![expect(clippy::disallowed_methods, reason = "tests read clocks and make queues as they like")]

mod bridge;
#[path = "../../../tests/real/conformance/mod.rs"]
mod conformance;
mod router;
mod sites;
