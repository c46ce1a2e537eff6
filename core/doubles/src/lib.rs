//! Test doubles that speak the contract of the Blastema middleware, and nothing else.
//!
//! | double | stands in for |
//! | --- | --- |
//! | [`Probe`] | any receiver of a message: records it, replies as told |
//! | [`MockTransport`] | a medium: records what is sent, lets the test receive and report |
//! | [`SimulatedNetwork`] | a medium with several ends, bad as told, the same for one seed |
//! | [`FakeCrypto`] | the cryptography of sealed frames: fast, and panics when a nonce is used twice |
//! | [`paused`](fn@paused), [`advance`] | the clock |
//! | [`Record`] | what a double of your own has seen |
//! | [`program_in`] | nothing: it lets another user run a program |
//! | [`turn`](fn@turn) | nothing: it lets tests on real threads run one after the other |
//! | [`long`] | nothing: whether long lists of cases are run whole |
//!
//! ```
//! use blastema_contract::transport::{Attach, MediumAddress, Transmit};
//! use blastema_core::medium::impairment::Impairment;
//! use blastema_doubles::{Probe, SimulatedNetwork, paused};
//! use std::time::Duration;
//!
//! paused(async {
//!     let network = SimulatedNetwork::new(7);
//!     let (left, right) = (network.end("left"), network.end("right"));
//!     let slow = Impairment { delay: Duration::from_secs(3600), ..Impairment::NONE };
//!     network.impair("left", "right", slow);
//!     let (frames, reports) = (Probe::start(), Probe::start());
//!     let (frames_to, reports_to) = (frames.recipient(), reports.recipient());
//!     right.transport().attach.do_send(Attach::new(frames_to, reports_to));
//!
//!     let to = right.local();
//!     left.transport().transmit.do_send(Transmit::new(to, "hello".into()));
//!
//!     frames.expect_none_for(Duration::from_secs(3599)).await; // no time passes for you
//!     assert_eq!(frames.wait(|_| true).await.frame, "hello");
//! });
//! ```

mod fake_crypto;
mod mock_transport;
mod network;
mod paused;
mod probe;
mod program;
mod record;
mod turn;

pub use fake_crypto::{FakeCrypto, FakeHandshake, NonceLedger};
pub use mock_transport::MockTransport;
pub use network::SimulatedNetwork;
pub use paused::{advance, now, paused, settle};
pub use probe::Probe;
pub use program::program_in;
pub use record::{PATIENCE, Record};
pub use turn::{Turn, long, turn, turn_if_long, turn_within};
