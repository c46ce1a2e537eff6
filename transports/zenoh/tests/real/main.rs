//! The suite of all media, robots at two sites, and the bridge. Routers are processes of their own.

mod bridge;
#[path = "../../../tests/real/conformance/mod.rs"]
mod conformance;
mod router;
mod sites;
