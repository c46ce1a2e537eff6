//! The protocols of a CAN bus, as pure logic: frames, addresses, messages longer than a frame, and
//! the text that serial adapters speak.
//!
//! ```text
//!        messages ──► isotp ──► frames ──► socket                 (SocketCAN)
//!                       │          └─────► slcan ──► serial line  (adapters)
//!                    address: who speaks to whom, in the identifier
//! ```
//!
//! Not here: sockets, serial lines, and what a message means.

pub mod address;
pub mod frame;
pub mod isotp;
pub mod slcan;

pub use address::{AddressInfo, BusAddress};
pub use frame::{CLASSIC_MAX, CanFrame, CanId, FD_MAX, Format, bits_on_bus};
pub use isotp::{IsoTp, IsoTpConfig, IsoTpOutput};
