//! The components of a bridge to plain keys of Zenoh.
//!
//! ```text
//!  topic ─► outlet ─ JSON ─► client ═══ Zenoh ═══ any other client, such as Python's
//!  topic ◄─ inlet  ◄─ queue ◄─ parsed ◄─ client ═══
//!           connection: opens the client, and says when no router is there
//! ```
//!
//! Each bridged topic has a component of its own, so that what goes wrong with it is named after
//! it, and ends nothing else. What comes from outside is parsed and bounded on a thread of Zenoh's;
//! only events get to an arbiter.

mod connection;
mod description;
mod inlet;
mod outlet;
mod schema;

pub use description::{BridgeError, ZenohBridge};

use blastema::core::{ContractIdentity, Event, LayoutDescription};

/// An event's contract, as the other side of a bridge sees it.
#[derive(Clone, Debug)]
struct BridgedContract {
    /// What stands behind `application/json;` in the encoding: `demo/pose@1`.
    tag: String,
    /// Its JSON Schema.
    schema: Vec<u8>,
}

impl BridgedContract {
    /// # Errors
    /// JSON cannot hold such events.
    fn of<E: Event>() -> Result<Self, String> {
        let identity = ContractIdentity::of::<E>();
        let layout = LayoutDescription::of_message((identity.message)());
        schema::check(&layout).map_err(|why| format!("{} as JSON: {why}", E::NAME))?;
        let schema = schema::of(&identity, &layout, E::MAX_SIZE, E::LATCHED);
        let tag = format!("{}@{}", identity.name, identity.version);
        Ok(BridgedContract { tag, schema: schema.to_string().into_bytes() })
    }

    /// The encoding that its samples carry.
    fn encoding(&self) -> String {
        format!("application/json;{}", self.tag)
    }
}
