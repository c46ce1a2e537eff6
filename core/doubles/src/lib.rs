//! Test doubles that speak the contract of the Blastema middleware, and nothing else.
//!
//! | double | stands in for |
//! | --- | --- |
//! | [`Probe`] | any receiver of a message: records it, replies as told |
//! | [`MockTransport`] | a medium: records what is sent, lets the test receive and report |
//! | [`FakeCrypto`] | the cryptography of sealed frames: fast, and panics when a nonce is used twice |
//! | [`paused`](fn@paused), [`advance`] | the clock |
//! | [`Record`] | what a double of your own has seen |
//! | [`real`] | nothing: it runs a test on real threads, in its turn |
//! | [`program_in`] | nothing: it lets another user run a program |
//! | [`turn`](fn@turn) | nothing: it lets tests on real threads run one after the other |
//! | [`long`] | nothing: whether long lists of cases are run whole |
//!
//! ```
//! use blastema_contract::transport::{Attach, MediumAddress};
//! use blastema_doubles::{MockTransport, Probe, paused};
//! use std::time::Duration;
//!
//! paused(async {
//!     let medium = MockTransport::start("here");
//!     let (frames, reports) = (Probe::start(), Probe::start());
//!     let attach = Attach::new(frames.recipient(), reports.recipient());
//!     medium.transport().attach.do_send(attach);
//!
//!     frames.expect_none_for(Duration::from_secs(3599)).await; // no time passes for you
//!     medium.receive(MediumAddress::Memory("there".into()), "hello");
//!     assert_eq!(frames.wait(|_| true).await.frame, "hello");
//! });
//! ```

#![allow(clippy::disallowed_methods, clippy::disallowed_types, reason = "doubles run tests")]

mod fake_crypto;
mod mock_transport;
mod paused;
mod probe;
mod program;
pub mod real;
mod record;
mod turn;

pub use fake_crypto::{FakeCrypto, FakeHandshake, NonceLedger};
pub use mock_transport::MockTransport;
/// By the name that the attribute `test` of `blastema_macros` calls it.
pub use paused::paused as run;
pub use paused::{advance, now, paused, settle};
pub use probe::Probe;
pub use program::program_in;
pub use record::{PATIENCE, Record};
pub use turn::{Turn, long, turn, turn_if_long, turn_within};
