//! One suite for every medium, plain and behind the fault wrapper. A new medium implements `Medium`
//! here and is held to all of it.
//!
//! Sockets are real, on loopback and ports that the system chose; every wait is for an event.

pub(crate) mod end;
pub(crate) mod media;
mod suite;

use actix::dev::ContextFut;
use actix::prelude::*;
use blastema_contract::transport::{
    Attach, Close, ConnectionTrust, MediumAddress, ReadInjectedFaults, Received, Transport,
    TransportCounters, TransportReport,
};
use blastema_doubles::{PATIENCE, Probe, Turn, turn, turn_if_long};
use bytes::Bytes;
use media::*;
use std::cell::Cell;
use std::ops::Deref;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{self, Poll};
use suite::*;

/// How the suite opens ends of one medium.
trait Medium: Default + 'static {
    /// A peer that is gone is noticed by the medium itself.
    const CONNECTS: bool = false;
    /// What may wait for a receiver that hangs, in frames, apart from the kernel's buffers.
    const HELD: u64 = 256;
    /// Frames that are sent while no peer is at the other end may arrive later.
    const KEEPS: bool = false;

    /// Runs a test on the clock that suits the medium.
    fn run(test: impl Future<Output = ()>) {
        end::in_real_time(test);
    }

    /// An end at this address, or anywhere.
    fn open(&self, at: Option<MediumAddress>) -> Opened;

    /// Puts onto the wire what no transport would.
    fn garbage(&self, to: &MediumAddress);
}

/// A transport, and how to throw its present incarnation away.
struct Opened {
    transport: Transport,
    wrapper: Option<Recipient<ReadInjectedFaults>>,
    panic: Rc<Cell<bool>>,
}

impl Opened {
    fn of<A>(actor: A) -> Self
    where
        A: Actor<Context = Context<A>> + Supervised,
        Addr<A>: Into<Transport>,
    {
        let (address, panic) = start(actor);
        Opened { transport: address.into(), wrapper: None, panic }
    }
}

/// An end, and what is behind it.
struct End {
    end: end::End,
    wrapper: Option<Recipient<ReadInjectedFaults>>,
    panic: Rc<Cell<bool>>,
}

impl Deref for End {
    type Target = end::End;

    fn deref(&self) -> &end::End {
        &self.end
    }
}

impl End {
    fn new(Opened { transport, wrapper, panic }: Opened) -> Self {
        End { end: end::End::new(transport), wrapper, panic }
    }

    async fn ended(&self) {
        self.reports.wait(|report| *report == TransportReport::Ended).await;
    }

    fn send(&self, to: &MediumAddress, frame: impl Into<Bytes>) {
        self.end.send(to.clone(), frame);
    }

    /// How many frames were taken from the medium and not thrown away since.
    async fn taken(&self) -> u64 {
        let thrown = match &self.wrapper {
            Some(wrapper) => {
                wrapper.send(ReadInjectedFaults).await.expect("it lives").incoming.overflowed
            }
            None => 0,
        };
        self.counters().await.received - thrown
    }

    /// What was reported, but for what the medium is like.
    fn events(&self) -> Vec<TransportReport> {
        let mut reports = self.reports.drain();
        reports.retain(|report| !matches!(report, TransportReport::Rate { .. }));
        reports
    }
}

fn attach(transport: &Transport) -> (Probe<Received>, Probe<TransportReport>) {
    end::attach(transport, ConnectionTrust::Claimed)
}

/// Starts an actor as the guardian of the node does, which gives it its next incarnation after a
/// panic.
fn start<A: Actor<Context = Context<A>> + Supervised>(actor: A) -> (Addr<A>, Rc<Cell<bool>>) {
    struct Ward<A: Actor<Context = Context<A>>>(ContextFut<A, Context<A>>, Rc<Cell<bool>>);
    impl<A: Actor<Context = Context<A>> + Supervised> Future for Ward<A> {
        type Output = ();
        fn poll(mut self: Pin<&mut Self>, task: &mut task::Context<'_>) -> Poll<()> {
            if self.1.take() {
                self.0.restart();
            }
            Pin::new(&mut self.0).poll(task)
        }
    }
    let future = Context::new().into_future(actor);
    let (address, panic) = (future.address(), Rc::new(Cell::new(false)));
    actix_rt::spawn(Ward(future, panic.clone()));
    (address, panic)
}

/// The turn of a test of this module. Of the media behind the wrapper, a long list, one is tried by
/// day.
fn turn_of(module: &str) -> Option<Turn> {
    let by_night = module.ends_with("_behind_the_wrapper") && !module.starts_with("udp");
    if by_night { turn_if_long() } else { Some(turn()) }
}

/// Instantiates the suite for one medium.
macro_rules! conformance {
    ($module:ident, $medium:ty: $($test:ident),+ $(,)?) => {
        mod $module {
            use super::*;
            $(
                #[test]
                fn $test() {
                    let Some(_turn) = turn_of(stringify!($module)) else { return };
                    <$medium as Medium>::run(super::$test::<$medium>());
                }
            )+
        }
    };
    (@all $module:ident, $medium:ty, $($more:ident),*) => {
        conformance! {
            $module, $medium:
            frames_arrive_whole,
            the_empty_and_the_largest_frame_arrive,
            a_frame_that_is_too_large_is_refused_and_counted,
            an_address_of_another_medium_is_refused_and_counted,
            many_frames_keep_their_order_and_none_is_doubled,
            attaching_replaces_who_was_attached_and_tells_the_present_state,
            a_peer_that_is_gone_and_back_is_reached_again,
            closing_releases_the_port,
            garbage_on_the_wire_harms_nobody,
            a_flood_before_a_receiver_that_hangs_stays_bounded,
            the_next_incarnation_after_a_panic_opens_at_the_same_address_for_the_same_receiver,
            $($more),*
        }
    };
    // Media that any number of programs use at once: no port of them is ever taken.
    (shared: $($module:ident: $medium:ty),+ $(,)?) => {
        $(conformance! { @all $module, $medium, })+
    };
    ($($module:ident: $medium:ty),+ $(,)?) => {
        $(conformance! {
            @all $module, $medium, a_port_that_is_taken_is_reported_and_opened_when_it_is_free
        })+
    };
}

conformance! {
    memory: OverMemory,
    udp: OverUdp,
    multicast: OverMulticast,
    tcp: OverTcp,
    unix: OverUnix,
    serial: OverSerial,
    slcan: OverSlcan,
    memory_behind_the_wrapper: Behind<OverMemory>,
    udp_behind_the_wrapper: Behind<OverUdp>,
    tcp_behind_the_wrapper: Behind<OverTcp>,
    unix_behind_the_wrapper: Behind<OverUnix>,
    serial_behind_the_wrapper: Behind<OverSerial>,
    slcan_behind_the_wrapper: Behind<OverSlcan>,
}

#[cfg(feature = "zenoh")]
mod zenoh_network;

#[cfg(guest)]
mod socket_can;
