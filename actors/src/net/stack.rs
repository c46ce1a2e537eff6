//! The network's stack: gateway, sessions and router, which call each other.
//!
//! ```text
//!  objects ─► gateway ─► sessions ─► router ─► links
//!  objects ◄─ gateway ◄─ sessions ◄─ router ◄─ links
//! ```
//!
//! After a panic the router's machine is built again: the new one is given what the links have
//! reported, and the sessions retransmit. If the panic was not the router's, every session is
//! reset as well.

use super::NetEnvironment;
use super::gateway::{LocalInput, ObjectGateway};
use super::gateway_messages::SendToPeer;
use super::keys::RosterRow;
use super::own_name::OwnName;
use super::roster_watch::{RosterChanged, RosterFound, RosterWatch};
use super::router::{NodeRouter, Verdict};
use super::stub::PeerStubs;
use crate::platform;
use crate::registry::remote_watch::DeathWatchService;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::link::{AddLinks, LinkChanged, ReceivedOnLink};
use blastema_contract::recoverer::SafeStateChanged;
use blastema_contract::router::{InjectPanic, ReadRoutes};
use blastema_contract::session::{ReadSessions, SendToDirectory, SessionRow};
use blastema_contract::strategy::{IsolateNode, Reroute};
use blastema_core::net::{NodeId, RouterOutput, SessionOutput};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use blastema_core::{FaultLocation, Instant, Machine};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tokio::sync::oneshot;
use tracing::{debug, error, info};

/// How often what was lost is brought together, and what has waited too long given up.
const TIME_INTERVAL: Duration = Duration::from_millis(200);
/// How often it is looked at what was refused and lost.
const LOOK_INTERVAL: Duration = Duration::from_secs(1);

/// The actor of the gateway, the sessions and the router.
pub(super) struct NetworkStack {
    pub(super) floors: Floors,
    wake: WakeTimer,
}

/// The gateway with its table of peers, whose sessions are driven with the router as one machine.
pub(super) struct Floors {
    pub(super) gateway: ObjectGateway,
    pub(super) router: NodeRouter,
    /// The router is being served.
    in_router: bool,
    /// A change of a path that waits for what the sessions do about earlier segments.
    held: Option<RouterOutput>,
}

/// Takes the rosters of other nodes from now on.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct AttachRosterWatch(pub(super) Weak<RosterWatch>);

/// Asks for the roster that is used.
#[derive(Message)]
#[rtype(result = "Option<RosterRow>")]
pub(super) struct ReadRoster;

/// What [`Floors`] want done.
pub(super) enum StackOutput {
    Router(RouterOutput),
    Session(NodeId, SessionOutput),
}

impl Floors {
    /// A panic in here costs the router's machine, and no session.
    fn with_router<T>(&mut self, act: impl FnOnce(&mut NodeRouter) -> T) -> T {
        self.in_router = true;
        let result = act(&mut self.router);
        self.in_router = false;
        result
    }
}

impl Machine for Floors {
    type Output = StackOutput;

    /// Segments that arrive together are given to the sessions before those answer.
    fn poll_output(&mut self) -> Option<StackOutput> {
        loop {
            let held = self.held.take();
            let output = held.or_else(|| self.with_router(|router| router.machine.poll_output()));
            match output {
                Some(RouterOutput::Segment { source, segment, authentic }) => {
                    self.gateway.handle_segment(source, segment, authentic);
                    continue;
                }
                None
                | Some(
                    RouterOutput::Undelivered { .. }
                    | RouterOutput::Reachable { .. }
                    | RouterOutput::PathChanged { .. }
                    | RouterOutput::Lost { .. },
                ) => {}
                Some(output) => return Some(StackOutput::Router(output)),
            }
            let Some((peer, of_session)) = self.gateway.protocol.peers.poll_output() else {
                return output.map(StackOutput::Router);
            };
            self.held = output;
            let SessionOutput::Transmit { class, segment, everywhere } = of_session else {
                return Some(StackOutput::Session(peer, of_session));
            };
            self.with_router(|router| match everywhere {
                true => router.machine.handle_copies(peer, class, &segment),
                false => router.machine.handle_segment(peer, class, segment),
            });
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let router = self.router.machine.poll_timeout();
        [self.gateway.protocol.peers.poll_timeout(), router].into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.gateway.protocol.peers.handle_timeout(now);
        self.with_router(|router| router.machine.handle_timeout(now));
    }
}

impl NetworkStack {
    pub(super) fn maker(
        environment: &NetEnvironment,
        stubs: Arc<PeerStubs>,
        deaths: DeathWatchService,
        own_name: OwnName,
    ) -> impl FnOnce(&mut Context<Self>) -> Self + Send + 'static {
        let environment = environment.clone();
        move |context| {
            let faults = environment.own_faults("stack");
            let stack = context.address().recipient();
            let gateway = ObjectGateway::new(&environment, stubs, deaths, faults.clone(), stack);
            let NetEnvironment { node, incarnation, reports, keys, .. } = environment;
            let router = NodeRouter::new(node, incarnation, reports.nodes, own_name, faults, keys);
            let floors = Floors { gateway, router, in_router: false, held: None };
            NetworkStack { floors, wake: WakeTimer::default() }
        }
    }

    /// Carries out all that waits on every floor.
    fn drive_all(&mut self, context: &mut Context<Self>) {
        self.floors.gateway.drive();
        self.drive(context);
    }

    /// Gives the sessions what the gateway sends. It goes out with what follows at once.
    fn drive_all_soon(&mut self, context: &mut Context<Self>) {
        self.floors.gateway.drive();
        self.drive_soon(context);
    }

    fn carry_out_of_router(&mut self, output: RouterOutput) {
        let Floors { gateway, .. } = &mut self.floors;
        let (peers, now) = (&mut gateway.protocol.peers, platform::now());
        match output {
            RouterOutput::Undelivered { destination, reason } => {
                debug!(node = %destination, %reason, "a packet came back");
                if let Some(peer) = peers.get_mut(destination) {
                    peer.session.handle_undelivered(reason, now);
                }
            }
            RouterOutput::Reachable { node, incarnation, mtu } => {
                let before = peers.get(NodeId::of(&node)).and_then(|peer| Some(peer.path?.0));
                gateway.handle_reachable(&node, incarnation, mtu);
                self.floors.with_router(|router| router.reachable(&node, incarnation, before));
            }
            RouterOutput::PathChanged { node, mtu } => {
                if let Some(peer) = peers.get_mut(node) {
                    peer.handle_path(mtu, now);
                }
            }
            RouterOutput::Lost { node, incarnation } => {
                gateway.handle_unreachable(&node);
                self.floors.with_router(|router| router.lost(&node, incarnation));
            }
            output => self.floors.with_router(|router| router.carry_out(output)),
        }
    }

    fn carry_out_of_session(&mut self, peer: NodeId, output: SessionOutput) {
        let Floors { gateway, .. } = &mut self.floors;
        match output {
            SessionOutput::Opened { incarnation, number } => {
                gateway.session_opened(peer, incarnation, number);
            }
            SessionOutput::Message { message, .. } | SessionOutput::Newest { message, .. } => {
                gateway.handle_message(peer, message);
            }
            SessionOutput::Returned { message, why, sent, .. } => {
                gateway.handle_returned(peer, message, why, sent);
            }
            SessionOutput::Ended { incarnation, why } => {
                info!(%peer, %incarnation, %why, "session ended");
                gateway.session_ended(peer, why);
            }
            SessionOutput::Incompatible { theirs } => {
                error!(%peer, theirs, "the peer's sessions speak another version: update one node");
            }
            SessionOutput::Transmit { .. } => unreachable!("the floors transmit"),
        }
    }
}

answers_the_monitor!(NetworkStack);

impl Actor for NetworkStack {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.floors.gateway.take_interest();
        context.run_interval(TIME_INTERVAL, |stack, context| {
            stack.floors.gateway.handle_time();
            stack.drive_all(context);
        });
        context.run_interval(LOOK_INTERVAL, |stack, _| {
            stack.floors.gateway.look();
        });
    }
}

impl Supervised for NetworkStack {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.wake = WakeTimer::default();
        // What the old machine reported and was not carried out, the new one reports again.
        self.floors.held = None;
        self.floors.router.rebuild(&self.floors.gateway.protocol.peers);
        if !std::mem::take(&mut self.floors.in_router) {
            self.floors.gateway.restart();
        }
        self.started(context);
        // Later, where a panic leads to the next restart.
        self.drive_soon(context);
    }
}

impl MachineActor for NetworkStack {
    type Machine = Floors;

    fn driven(&mut self) -> (&mut Floors, &mut WakeTimer) {
        (&mut self.floors, &mut self.wake)
    }

    fn carry_out(&mut self, output: StackOutput, _: &mut Context<Self>) {
        match output {
            StackOutput::Router(output) => self.carry_out_of_router(output),
            StackOutput::Session(peer, output) => self.carry_out_of_session(peer, output),
        }
        self.floors.gateway.drive();
    }
}

impl Handler<AddLinks> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: AddLinks, _: &mut Context<Self>) {
        self.floors.with_router(|router| router.add_links(message));
    }
}

impl Handler<LinkChanged> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: LinkChanged, context: &mut Context<Self>) {
        self.floors.with_router(|router| router.handle_link(message));
        self.drive(context);
    }
}

impl Handler<ReceivedOnLink> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: ReceivedOnLink, context: &mut Context<Self>) {
        let ReceivedOnLink { link, load } = message;
        self.floors.with_router(|router| router.handle_load(link, load));
        self.drive_soon(context);
    }
}

impl Handler<SendToPeer> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: SendToPeer, context: &mut Context<Self>) {
        self.floors.gateway.handle_send(message);
        self.drive_all_soon(context);
    }
}

impl Handler<LocalInput> for NetworkStack {
    type Result = ();

    fn handle(&mut self, input: LocalInput, context: &mut Context<Self>) {
        // A panic must not come between the order to end and what peers are told.
        let is_end = matches!(input, LocalInput::Ending);
        self.floors.gateway.handle_local(input);
        if is_end { self.drive_all(context) } else { self.drive_all_soon(context) }
    }
}

/// A recovery strategy, an operator or the application has decided so, for this node alone: each
/// node decides for itself, and all follow the roster.
impl Handler<IsolateNode> for NetworkStack {
    type Result = Result<RecoveryDone, RecoveryFailed>;

    fn handle(&mut self, message: IsolateNode, context: &mut Context<Self>) -> Self::Result {
        if self.floors.gateway.handle_isolation(&message.node, message.isolated) {
            self.floors.with_router(|router| router.handle_isolation(message));
        }
        self.drive_all(context);
        Ok(RecoveryDone::default())
    }
}

impl Handler<RosterChanged> for NetworkStack {
    type Result = ();

    fn handle(&mut self, RosterChanged(keys): RosterChanged, context: &mut Context<Self>) {
        self.floors.gateway.handle_roster(&keys);
        self.floors.with_router(|router| router.handle_roster(keys));
        self.drive_all(context);
    }
}

impl Handler<RosterFound> for NetworkStack {
    type Result = ();

    fn handle(&mut self, RosterFound(keys): RosterFound, context: &mut Context<Self>) {
        self.floors.gateway.announce_roster(&keys);
        self.drive_all(context);
    }
}

impl Handler<AttachRosterWatch> for NetworkStack {
    type Result = ();

    fn handle(&mut self, AttachRosterWatch(watch): AttachRosterWatch, _: &mut Context<Self>) {
        self.floors.gateway.attach_roster_watch(watch);
    }
}

impl Handler<ReadRoster> for NetworkStack {
    type Result = MessageResult<ReadRoster>;

    fn handle(&mut self, _: ReadRoster, _: &mut Context<Self>) -> Self::Result {
        MessageResult(self.floors.router.roster())
    }
}

impl Handler<SafeStateChanged> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: SafeStateChanged, context: &mut Context<Self>) {
        self.floors.gateway.handle_safe_state(message);
        self.drive_all(context);
    }
}

impl Handler<SendToDirectory> for NetworkStack {
    type Result = ();

    fn handle(&mut self, message: SendToDirectory, context: &mut Context<Self>) {
        let SendToDirectory { node, message } = message;
        self.floors.gateway.protocol.handle_directory(NodeId::of(&node), message);
        self.drive_all_soon(context);
    }
}

/// The alternative was chosen before it was needed: what is left to do is to say whether there is
/// one. Where the only one may have failed as well, the answer waits until its link says so or
/// recovers.
impl Handler<Reroute> for NetworkStack {
    type Result = PendingAnswer<Verdict>;

    fn handle(&mut self, message: Reroute, context: &mut Context<Self>) -> Self::Result {
        let node = match message.location {
            FaultLocation::Link { neighbour: Some(node), .. } | FaultLocation::Node(node) => node,
            other => {
                let error = format!("the node behind {other} is not known");
                return PendingAnswer::new(async { Err(error.into()) });
            }
        };
        let (answer, verdict) = oneshot::channel();
        self.floors.with_router(|router| router.inquire(node, answer));
        self.drive(context);
        PendingAnswer::new(async {
            verdict.await.unwrap_or_else(|_| Err("the network was restarted".into()))
        })
    }
}

impl Handler<ReadRoutes> for NetworkStack {
    type Result = MessageResult<ReadRoutes>;

    fn handle(&mut self, _: ReadRoutes, _: &mut Context<Self>) -> Self::Result {
        let machine = &self.floors.router.machine;
        let mut routes: Vec<_> = machine.routes().map(|(_, route)| route.clone()).collect();
        routes.sort_by(|a, b| a.node.cmp(&b.node));
        MessageResult(routes)
    }
}

impl Handler<ReadSessions> for NetworkStack {
    type Result = MessageResult<ReadSessions>;

    fn handle(&mut self, _: ReadSessions, _: &mut Context<Self>) -> Self::Result {
        let ObjectGateway { protocol, sessions, .. } = &self.floors.gateway;
        let rows = protocol.peers.iter().map(|(id, peer)| SessionRow {
            node: peer.node.clone(),
            status: peer.session.status(),
            rate: sessions.rates.rate(id),
            differences: peer.differences().to_vec(),
        });
        MessageResult(rows.collect())
    }
}

impl Handler<InjectPanic> for NetworkStack {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        self.floors.with_router(|_| panic!("the router panics on purpose"));
    }
}

/// Runs on the stack what a test does there.
#[cfg(test)]
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct RunOnStack(pub(super) Box<dyn FnOnce(&mut NetworkStack) + Send>);

#[cfg(test)]
impl Handler<RunOnStack> for NetworkStack {
    type Result = ();

    fn handle(&mut self, RunOnStack(act): RunOnStack, context: &mut Context<Self>) {
        act(self);
        self.drive_all(context);
    }
}
