//! Media of the Blastema middleware: one file and one feature each.
//!
//! A transport is an actor that owns a medium and speaks [`blastema_contract::transport`], nothing
//! else. Adding a medium is adding one file here. What all of them share:
//!
//! * `medium.rs`: an actor around a medium. Reading and writing are polled on the actor's own
//!   arbiter, after its mailbox and with a budget, so that a flooded medium still takes orders.
//!   After a panic the next incarnation opens at the same address and knows who is attached.
//! * `upstream.rs`: frames go to the attached receiver, never more than a few hundred unconfirmed;
//!   a receiver that hangs makes the medium's own buffers overflow, not the process.
//! * `transmit_queues.rs`: frames that wait for a medium, in lanes: hellos go first, then
//!   acknowledgements and other urgent frames.
//! * `medium_timer.rs`: a time that a medium waits for.
//! * `reopen_backoff.rs`: a medium that cannot be opened is tried again, with back-off.
//! * `can_node.rs`: what CAN sockets and CAN adapters share: messages longer than a frame.
//! * `bound_address.rs`, `descriptors.rs`, `frame_split.rs`: what the media with sockets share;
//!   `stream/`: what those with connections do; `usb_device.rs`: what adapters on USB do.
//! * `frame_transport.rs`, `reach.rs`: the transport of a medium of the application's own, and from
//!   how far away an address can be used.
//!
//! Deliberately not here: who is a neighbour and whether it lives (the link), what a frame says
//! (router, session), order and repetition (session).

#[cfg(any(feature = "udp", feature = "tcp"))]
mod bound_address;
#[cfg(any(feature = "udp", feature = "tcp", feature = "unix"))]
mod descriptors;
#[cfg(any(feature = "udp", feature = "tcp", feature = "unix"))]
mod frame_split;
mod frame_transport;
mod medium;
mod medium_timer;
mod reach;
mod reopen_backoff;
#[cfg(any(feature = "tcp", feature = "unix"))]
mod stream;
mod transmit_queues;
mod upstream;
#[cfg(any(feature = "serial", feature = "slcan"))]
mod usb_device;

#[cfg(all(feature = "can", target_os = "linux"))]
pub mod can;
#[cfg(any(all(feature = "can", target_os = "linux"), feature = "slcan"))]
pub mod can_node;
pub mod endpoint;
#[cfg(feature = "fault")]
pub mod fault_injector;
pub mod frame_medium;
#[cfg(feature = "memory")]
pub mod memory;
#[cfg(feature = "serial")]
pub mod serial;
#[cfg(feature = "slcan")]
pub mod slcan;
#[cfg(feature = "tcp")]
pub mod tcp;
#[cfg(feature = "udp")]
pub mod udp;
#[cfg(feature = "unix")]
pub mod unix;

#[cfg(all(feature = "can", target_os = "linux"))]
pub use can::CanBus;
pub use endpoint::{
    CanConfig, CanNodeConfig, Endpoint, EndpointError, SlcanConfig, TcpConfig, UdpConfig,
    UnixConfig,
};

#[cfg(feature = "fault")]
pub use crate::fault_injector::FaultInjector;
#[cfg(feature = "fault")]
pub use crate::fault_injector::FaultInjectorConfig;
pub use crate::reach::Reach;
pub use frame_medium::FrameMedium;
pub use frame_transport::FrameTransport;
#[cfg(feature = "memory")]
pub use memory::{Memory, MemoryMedium};
#[cfg(feature = "serial")]
pub use serial::{Rs485, SerialConfig, SerialLine};
#[cfg(feature = "slcan")]
pub use slcan::SlcanBus;
#[cfg(feature = "tcp")]
pub use tcp::Tcp;
#[cfg(feature = "udp")]
pub use udp::Udp;
#[cfg(feature = "unix")]
pub use unix::Unix;
