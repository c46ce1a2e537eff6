//! Serial ports without hardware, made of ptys: for tests and examples.
//!
//! | double | stands in for |
//! | --- | --- |
//! | [`Cable`] | a serial cable, which can be unplugged, and on which there may be noise |
//! | [`Adapters`] | CAN adapters on serial ports (SLCAN), with the bus between them |
//!
//! What opens such a port cannot tell it from a real one, but for its speed: a pty carries as much
//! as it is given, unless the cable is a slow one, and does not say how much of it waits.
//! Deliberately not here: doubles of what speaks the middleware's contract (`blastema-doubles`).

mod adapters;
mod cable;

pub use adapters::Adapters;
pub use cable::Cable;
