//! What the files of `tests/compile_fail` do wrong, done right, through the facade and without
//! serde.

use blastema::{Event, Request, Structure};
use std::collections::BTreeMap;

/// With every attribute that a contract may have.
#[derive(Clone, Debug, Event)]
#[contract(name = "laser/scan", version = 2, max_size = 4096, max_age = "100ms")]
pub struct Scan {
    /// How far it is, for each beam.
    #[contract(unit = "m", frame = "laser")]
    pub ranges: Vec<f32>,
    /// Where each reflector is.
    pub poses: BTreeMap<u32, Pose>,
}

/// A part of messages.
#[derive(Clone, Debug, Structure)]
pub struct Pose {
    /// The distance ahead.
    pub x: f64,
    /// Row by row.
    pub covariance: [f64; 36],
}

/// A generic event with fields that have no names.
#[derive(Clone, Debug, Event)]
#[contract(name = "stamped")]
pub struct Stamped<T>(pub u64, pub T);

/// A request without fields, with an optional reply.
#[derive(Debug, Request)]
#[contract(reply = Option<Pose>)]
pub struct WhereAmI;

fn main() {
    fn is_event<E: blastema::core::Event>() {}
    fn is_request<R: blastema::core::Request<Reply = Option<Pose>>>() {}
    is_event::<Scan>();
    is_event::<Stamped<Pose>>();
    is_request::<WhereAmI>();
}
