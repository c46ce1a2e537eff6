//! The actuators of a node and their commanders: drives the lease machines.
//!
//! A command is handled on the thread that delivers it. An actor on the fault chain's arbiter
//! watches the leases' time, so that a component that hangs does not delay another actuator's safe
//! command.

use super::command::{ActuatorCommand, CommandKind, CommandReply};
use crate::messaging::reply::Responder;
use crate::platform;
use crate::registry::access::{AccessControl, AccessWish, MessageOrigin};
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, MessageMetadata, ReplyTo, Skeleton};
use crate::runtime::callbacks::{CallKind, CallOutcome, Callbacks};
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use actix::prelude::*;
use blastema_contract::reports::AreYouAlive;
use blastema_core::lease::{
    CommanderId, Lease, LeaseOutput, LeaseRules, LeaseStatus, RestCause, StopBy,
};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{
    ContractIdentity, DeliveryError, FaultKind, GatherBuffer, Incarnation, Instant, Machine,
    ObjectName, PeerIdentity,
};
use bytes::Bytes;
use std::sync::atomic::Ordering::{Relaxed, SeqCst};
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;
use tracing::{error, info, warn};

/// Brings outputs to rest without the component.
pub(crate) type SafeOutputFn = Arc<dyn Fn() + Send + Sync>;

/// An actuator as its component declares it.
pub(crate) struct DeclaredActuator {
    pub(crate) identity: ContractIdentity,
    pub(crate) rules: LeaseRules,
    /// How old the data may be that a command is made from.
    pub(crate) max_age: Option<Duration>,
    /// The command that brings it to rest, encoded.
    pub(crate) safe: Bytes,
    /// The command that stops it, encoded.
    pub(crate) stop: Bytes,
    pub(crate) settle_within: Duration,
    pub(crate) cut_off: Option<SafeOutputFn>,
}

/// An actuator and its commander, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActuatorRow {
    /// The component.
    pub object: ObjectName,
    /// The contract of its commands.
    pub contract: &'static str,
    /// The commander, the epoch of its lease, and the time until the lease ends unless renewed.
    pub status: LeaseStatus,
}

/// One actuator: one contract of commands to one component.
struct Actuator {
    object: ObjectName,
    declared: DeclaredActuator,
    lease: Mutex<Lease>,
    /// Where the commander is that holds the lease.
    claimed_from: Mutex<MessageOrigin>,
    skeleton: Arc<dyn Skeleton>,
    /// Its commander is gone, and no other has claimed it since.
    lost: AtomicBool,
    /// What the component served when it got the safe command of a command timeout.
    turn: AtomicU64,
    /// A command has been handed over and not been answered.
    busy: Arc<AtomicBool>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

type Actuators = SortedMap<(ObjectName, &'static str), Arc<Actuator>>;

/// The actuators of a node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct ActuatorTable {
    /// As many as its components declare.
    actuators: Arc<Mutex<Actuators>>,
    timekeeper: Arc<OnceLock<Recipient<Look>>>,
    /// Calls cut-offs.
    callbacks: Callbacks,
    /// The node is in the safe state, in which no lease is granted.
    rests: Arc<AtomicBool>,
    /// The nodes whose commanders were lost.
    suspended: Arc<Mutex<SortedSet<String>>>,
}

/// The node of a commander.
fn node_of(commander: &str) -> &str {
    commander.split(':').next().unwrap_or_default()
}

impl ActuatorTable {
    /// A table whose cut-offs are called so.
    pub(crate) fn new(callbacks: Callbacks) -> Self {
        ActuatorTable { callbacks, ..ActuatorTable::default() }
    }

    /// Watches the time from now on. Says where the one who does can be asked whether it lives.
    pub(crate) fn start(
        &self,
        name: ObjectName,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Recipient<AreYouAlive> {
        let table = self.clone();
        let make = move |_: &mut Context<Timekeeper>| Timekeeper { table, armed: None };
        let timekeeper = guardian.start(name, arbiter, make);
        // A table is started once, with its node.
        let _ = self.timekeeper.set(timekeeper.clone().recipient());
        timekeeper.recipient()
    }

    /// The object has these actuators from now on; the port is where they are commanded.
    pub(crate) fn declare(
        &self,
        object: &ObjectName,
        declared: Vec<(DeclaredActuator, Arc<dyn Skeleton>)>,
        access: AccessControl,
    ) -> ContractPort {
        for (declared, skeleton) in declared {
            // Above every epoch of any earlier process of this node.
            let last_epoch = platform::node_incarnation().0 << 20;
            let key = (object.clone(), declared.identity.name);
            let actuator = Actuator {
                object: object.clone(),
                lease: Mutex::new(Lease::new(object.clone(), declared.rules, last_epoch)),
                declared,
                claimed_from: Mutex::default(),
                skeleton,
                lost: AtomicBool::default(),
                turn: AtomicU64::default(),
                busy: Arc::default(),
            };
            lock(&self.actuators).insert(key, Arc::new(actuator));
        }
        let (table, object) = (self.clone(), object.clone());
        let serve = move |order: ActuatorCommand,
                          from: MessageOrigin,
                          answer: Responder<ActuatorCommand>| {
            table.serve((&object, &access), order, from, answer)
        };
        ContractPort::of_service_fn(ServiceFn::<ActuatorCommand>(Arc::new(serve)))
    }

    /// The object is gone, and its actuators with it.
    pub(crate) fn withdraw(&self, object: &ObjectName) {
        let gone = {
            let mut actuators = lock(&self.actuators);
            let keys: Vec<_> = actuators.keys().filter(|(of, _)| of == object).cloned().collect();
            keys.iter().filter_map(|key| actuators.remove(key)).collect::<Vec<_>>()
        };
        drop(gone);
    }

    /// Something becomes of the component's work. Returns how long it may go on until it has
    /// settled, where it leaves work.
    pub(crate) fn handle_work(&self, object: &ObjectName, handle: impl Fn(&mut Lease)) -> Duration {
        let all: Vec<_> = lock(&self.actuators).values().cloned().collect();
        let mut settle_within = Duration::ZERO;
        for actuator in all.iter().filter(|actuator| actuator.object == *object) {
            let mut lease = lock(&actuator.lease);
            handle(&mut lease);
            if lease.is_stopping() {
                settle_within = settle_within.max(actuator.declared.settle_within);
            }
            drop(lease);
            self.carry_out(actuator);
        }
        settle_within
    }

    /// The node enters the safe state: every lease ends now, and none is granted before it goes to
    /// work again.
    pub(crate) fn rest(&self) {
        self.rests.store(true, SeqCst);
        let now = platform::now();
        let all: Vec<_> = lock(&self.actuators).values().cloned().collect();
        for actuator in all {
            let mut lease = lock(&actuator.lease);
            if let LeaseStatus::Held { epoch, .. } = lease.status(now) {
                lease.handle_release(epoch);
            }
            lease.handle_stop_failed();
            drop(lease);
            self.carry_out(&actuator);
        }
    }

    /// The components of actuators without a cut-off.
    pub(crate) fn without_cut_off(&self) -> Vec<ObjectName> {
        let actuators = lock(&self.actuators);
        let without = actuators.values().filter(|actuator| actuator.declared.cut_off.is_none());
        without.map(|actuator| actuator.object.clone()).collect()
    }

    /// Whether one is being stopped in order.
    pub(crate) fn are_stopping(&self) -> bool {
        lock(&self.actuators).values().any(|actuator| lock(&actuator.lease).is_stopping())
    }

    /// Whether there are none.
    pub(crate) fn is_empty(&self) -> bool {
        lock(&self.actuators).is_empty()
    }

    /// Whether each that was commanded has carried out its safe command.
    pub(crate) fn are_at_rest(&self) -> bool {
        let now = platform::now();
        let all: Vec<_> = lock(&self.actuators).values().cloned().collect();
        all.iter().all(|actuator| lock(&actuator.lease).status(now) == LeaseStatus::Free)
    }

    /// The node goes to work again.
    pub(crate) fn resume(&self) {
        self.rests.store(false, SeqCst);
    }

    /// All of them, and who commands each.
    pub(crate) fn rows(&self) -> Vec<ActuatorRow> {
        let now = platform::now();
        let row = |actuator: &Arc<Actuator>| ActuatorRow {
            object: actuator.object.clone(),
            contract: actuator.declared.identity.name,
            status: lock(&actuator.lease).status(now),
        };
        let actuators: Vec<_> = lock(&self.actuators).values().cloned().collect();
        actuators.iter().map(row).collect()
    }

    /// How long a command of this actuator counts; `None` for ever.
    pub(crate) fn command_timeout(&self, object: &ObjectName, contract: &str) -> Option<Duration> {
        self.named(object, contract)?.declared.rules.command_timeout
    }

    /// Ends the lease of any commander but this one.
    pub(crate) fn seize(&self, object: &ObjectName, contract: &str, own: &str) {
        if let Some(actuator) = self.named(object, contract) {
            self.end_lease(&actuator, |commander| commander != own);
        }
    }

    /// Ends the leases of all commanders of this node, and refuses its claims from now on.
    pub(crate) fn suspend(&self, node: &str) {
        lock(&self.suspended).insert(node.to_owned());
        let all: Vec<_> = lock(&self.actuators).values().cloned().collect();
        for actuator in all {
            self.end_lease(&actuator, |commander| node_of(commander) == node);
        }
    }

    /// Lets commanders of this node claim again.
    pub(crate) fn resume_commander(&self, node: &str) {
        lock(&self.suspended).remove(node);
    }

    /// Calls the cut-off of an actuator that does not take its command.
    pub(crate) fn cut_off_now(&self, object: &str, contract: &str) {
        let object = ObjectName::new(object).ok();
        if let Some(actuator) = object.and_then(|object| self.named(&object, contract)) {
            lock(&actuator.lease).handle_not_taken();
            self.carry_out(&actuator);
        }
    }

    fn end_lease(&self, actuator: &Arc<Actuator>, is_meant: impl Fn(&str) -> bool) {
        let mut lease = lock(&actuator.lease);
        if let LeaseStatus::Held { commander, epoch, .. } = lease.status(platform::now())
            && is_meant(&commander.name)
        {
            lease.handle_release(epoch);
        }
        drop(lease);
        self.carry_out(actuator);
    }

    fn named(&self, object: &ObjectName, contract: &str) -> Option<Arc<Actuator>> {
        let actuators = lock(&self.actuators);
        let mut own = actuators.iter().filter(|((of, name), _)| of == object && *name == contract);
        own.next().map(|(_, actuator)| actuator.clone())
    }

    fn find(&self, object: &ObjectName, theirs: &PeerIdentity) -> Option<Arc<Actuator>> {
        self.named(object, &theirs.name)
    }

    fn serve(
        &self,
        (object, access): (&ObjectName, &AccessControl),
        order: ActuatorCommand,
        from: MessageOrigin,
        answer: Responder<ActuatorCommand>,
    ) {
        let ActuatorCommand { identity, wish } = order;
        let theirs = match PeerIdentity::decode(&identity) {
            Ok(theirs) => theirs,
            Err(error) => {
                let why = DeliveryError::Undecodable { reason: error.to_string() };
                return answer.give(CommandReply::refused(&why));
            }
        };
        // Each message is checked: the number of a lease is easily guessed.
        if let Err(why) = access.check(from, AccessWish::Command, object, || theirs.name.clone()) {
            return answer.give(CommandReply::refused(&why));
        }
        let Some(actuator) = self.find(object, &theirs) else {
            let why = DeliveryError::Unknown { name: format!("{} of {object}", theirs.name) };
            return answer.give(CommandReply::refused(&why));
        };
        if actuator.declared.identity.check(&theirs).is_err() {
            let identity = actuator.declared.identity.full().encode();
            return answer.give(CommandReply::Differs { identity });
        }
        let now = platform::now();
        let mut lease = lock(&actuator.lease);
        // Looked at under the lease's lock: who comes later finds that it has ended.
        if self.rests.load(SeqCst) {
            drop(lease);
            return answer.give(CommandReply::refused(&DeliveryError::Stopped));
        }
        if let Some(why) = actuator.impersonation(&wish, from, &lease, now) {
            drop(lease);
            return answer.give(CommandReply::refused(&why));
        }
        let done = match wish {
            // Its first command would wait, perhaps for longer than the lease.
            CommandKind::Claim { .. } if !actuator.skeleton.is_at_work() => {
                Err(DeliveryError::Restarting)
            }
            CommandKind::Claim { commander, .. }
                if lock(&self.suspended).contains(node_of(&commander)) =>
            {
                let by = "the policy for lost communication".to_owned();
                Err(DeliveryError::Held { actuator: object.to_string(), by })
            }
            CommandKind::Claim { commander, incarnation } => {
                let commander =
                    CommanderId { name: commander, incarnation: Incarnation(incarnation) };
                lease.handle_claim(commander, now).map(|grant| {
                    *lock(&actuator.claimed_from) = from;
                    let span_us = u64::try_from(grant.span.as_micros()).unwrap_or(u64::MAX);
                    CommandReply::Granted { epoch: grant.epoch, span_us }
                })
            }
            CommandKind::Renew { epoch } => {
                lease.handle_renewal(epoch, now).map(|()| CommandReply::Done(Vec::new()))
            }
            CommandKind::Release { epoch } => {
                lease.handle_release(epoch);
                Ok(CommandReply::Done(Vec::new()))
            }
            CommandKind::Command { epoch, age_us, way_us, message } => {
                let way_us = if from.is_elsewhere() { way_us } else { 0 };
                // What it took longer than the fastest request is missing from its deadline, which
                // is the lease's span.
                let left = answer.until().map_or(actuator.declared.rules.span, |until| until - now);
                let age = Duration::from_micros(age_us.saturating_add(way_us))
                    .saturating_add(actuator.declared.rules.span.saturating_sub(left));
                match lease.handle_renewal(epoch, now) {
                    Ok(()) if actuator.declared.max_age.is_some_and(|limit| age > limit) => {
                        Err(DeliveryError::Expired)
                    }
                    Ok(()) => {
                        actuator.command((message, age), &mut lease, answer);
                        drop(lease);
                        return self.look();
                    }
                    Err(why) => Err(why),
                }
            }
        };
        drop(lease);
        self.carry_out(&actuator);
        if matches!(done, Ok(CommandReply::Granted { .. })) {
            self.take_back(&actuator);
        }
        self.look();
        answer.give(done.unwrap_or_else(|why| CommandReply::refused(&why)));
    }

    /// A commander holds the lease again: clears the fault of the former one, unless another
    /// actuator of the same object still lacks its commander.
    fn take_back(&self, actuator: &Actuator) {
        if actuator.lost.swap(false, Relaxed) {
            let waits =
                |other: &Arc<Actuator>| other.object == actuator.object && other.lost.load(Relaxed);
            if !lock(&self.actuators).values().any(waits) {
                actuator.skeleton.clear_fault(FaultKind::CommanderGone);
            }
        }
    }

    /// The timekeeper is to look when it has to be up next.
    fn look(&self) {
        if let Some(timekeeper) = self.timekeeper.get() {
            timekeeper.do_send(Look);
        }
    }

    /// Lets all leases act on the time, and says when they want to be looked at again.
    fn advance(&self, now: Instant) -> Option<Instant> {
        let all: Vec<_> = lock(&self.actuators).values().cloned().collect();
        let mut next: Option<Instant> = None;
        for actuator in all {
            lock(&actuator.lease).handle_timeout(now);
            self.carry_out(&actuator);
            let due = lock(&actuator.lease).poll_timeout();
            next = next.into_iter().chain(due).min();
        }
        next
    }

    fn carry_out(&self, actuator: &Arc<Actuator>) {
        let object = &actuator.object;
        loop {
            let output = lock(&actuator.lease).poll_output();
            match output {
                None => return,
                Some(LeaseOutput::Apply { commander, epoch, cause, again }) => {
                    self.give(actuator, cause);
                    if again {
                        continue;
                    }
                    let (who, incarnation) = (&commander.name, commander.incarnation);
                    if cause == RestCause::Expired {
                        let detail = format!("its commander {who}{incarnation} has gone");
                        actuator.skeleton.declare(FaultKind::CommanderGone, detail);
                        actuator.lost.store(true, Relaxed);
                    }
                    // Last: a log may block.
                    info!(%object, who, %incarnation, epoch, ?cause, "the actuator is brought to rest");
                }
                Some(LeaseOutput::CheckTaken { is_late }) => {
                    let turn = actuator.skeleton.turn();
                    // A neighbour may keep the thread of one that serves nothing.
                    let could_begin = turn.is_multiple_of(2) && !is_late;
                    let is_taken = could_begin || turn != actuator.turn.load(Relaxed);
                    lock(&actuator.lease).handle_check(is_taken);
                }
                Some(LeaseOutput::CutOff { cause }) => {
                    self.cut_off(actuator);
                    warn!(%object, ?cause, "the actuator is cut off");
                }
            }
        }
    }

    /// Gives the safe command, or the stop command.
    fn give(&self, actuator: &Arc<Actuator>, cause: RestCause) {
        let DeclaredActuator { rules, safe, stop, .. } = &actuator.declared;
        let command = match (cause, rules.stop_by) {
            // The component's hook stops the actuator.
            (RestCause::Stopped, StopBy::Hook) => return,
            (RestCause::Stopped, _) => stop,
            _ => safe,
        };
        actuator.turn.store(actuator.skeleton.turn(), Relaxed);
        let (table, applied_at) = (self.clone(), actuator.clone());
        let applied: ReplyTo = Box::new(move |result: Result<GatherBuffer, DeliveryError>| {
            lock(&applied_at.lease).handle_applied(cause, result.is_ok());
            table.carry_out(&applied_at);
        });
        let metadata = MessageMetadata { is_first: true, ..MessageMetadata::default() };
        // What came of it is told to the closure in every case.
        let _ = actuator.skeleton.deliver(command, metadata, Some(applied));
    }

    /// Has the cut-off called. The next lease is granted after it has returned: a cut-off that
    /// blocks keeps the actuator from every commander, and a fault says so.
    fn cut_off(&self, actuator: &Arc<Actuator>) {
        let Some(cut_off) = actuator.declared.cut_off.clone() else {
            return lock(&actuator.lease).handle_cut_off_returned();
        };
        let (actuator, object) = (actuator.clone(), actuator.object.clone());
        self.callbacks.call(
            CallKind::SafeOutput,
            &object,
            move || cut_off(),
            move |outcome| {
                if !matches!(outcome, CallOutcome::Blocked(_)) {
                    lock(&actuator.lease).handle_cut_off_returned();
                }
                let detail = match outcome {
                    CallOutcome::Done => return,
                    CallOutcome::ReturnedLate => {
                        return actuator.skeleton.clear_fault(FaultKind::CheckFailed);
                    }
                    CallOutcome::Panicked(text) => format!("the cut-off panicked: {text}"),
                    CallOutcome::Blocked(limit) => {
                        format!("the cut-off has blocked its thread for {limit:?}")
                    }
                    CallOutcome::NotMade => {
                        "the cut-off was not called: too many cut-offs of the component block"
                            .into()
                    }
                };
                error!(object = %actuator.object, "{detail}");
                actuator.skeleton.declare(FaultKind::CheckFailed, detail);
            },
        );
    }
}

impl Actuator {
    /// Why this is none of the sender's: the name of a commander is that of an object of its node,
    /// and a lease is used from where it was claimed. Its number is easily guessed.
    fn impersonation(
        &self,
        wish: &CommandKind,
        from: MessageOrigin,
        lease: &Lease,
        now: Instant,
    ) -> Option<DeliveryError> {
        if let CommandKind::Claim { commander, .. } = wish {
            let reason = format!("{commander} is no commander of the node that claims for it");
            return (!from.may_be(commander)).then_some(DeliveryError::Undecodable { reason });
        }
        let LeaseStatus::Held { epoch, .. } = lease.status(now) else { return None };
        (*lock(&self.claimed_from) != from).then_some(DeliveryError::Superseded { epoch })
    }

    /// Hands a command over. One at a time: what waits behind a component that is stuck would be
    /// carried out after its lease has ended. It is handed over under the lease's lock, so that a
    /// safe command finds it where it waits.
    fn command(
        &self,
        (message, age): (Vec<u8>, Duration),
        lease: &mut Lease,
        answer: Responder<ActuatorCommand>,
    ) {
        if self.busy.swap(true, Relaxed) {
            return answer.give(CommandReply::refused(&DeliveryError::Full));
        }
        lease.handle_command(platform::now());
        let busy = self.busy.clone();
        let reply_to: ReplyTo = Box::new(move |result: Result<GatherBuffer, DeliveryError>| {
            busy.store(false, Relaxed);
            answer.give(match result {
                Ok(reply) => CommandReply::Done(reply.into_bytes().into()),
                Err(why) => CommandReply::refused(&why),
            });
        });
        let metadata = MessageMetadata { age, ..MessageMetadata::default() };
        // What came of it is told to the closure in every case.
        let _ = self.skeleton.deliver(&message.into(), metadata, Some(reply_to));
    }
}

/// Look when you have to be up next.
#[derive(Message)]
#[rtype(result = "()")]
struct Look;

/// Sees that leases end in time.
struct Timekeeper {
    table: ActuatorTable,
    armed: Option<(Instant, SpawnHandle)>,
}

impl Timekeeper {
    fn look(&mut self, context: &mut Context<Self>) {
        let now = platform::now();
        let Some(due) = self.table.advance(now) else { return };
        match &self.armed {
            // Renewals push the end of a lease out: the timer is left standing, and looks again.
            Some((armed, _)) if *armed <= due && *armed > now => return,
            Some((_, handle)) => drop(context.cancel_future(*handle)),
            None => {}
        }
        let timer = tokio::time::sleep_until(platform::timer_at(due));
        let timer = actix::fut::wrap_future::<_, Self>(timer);
        let handle = context.spawn(timer.map(|(), timekeeper: &mut Self, context| {
            timekeeper.armed = None;
            timekeeper.look(context);
        }));
        self.armed = Some((due, handle));
    }
}

answers_the_monitor!(Timekeeper);

impl Actor for Timekeeper {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.armed = None;
        self.look(context);
    }
}

impl Supervised for Timekeeper {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.started(context);
    }
}

impl Handler<Look> for Timekeeper {
    type Result = ();

    fn handle(&mut self, _: Look, context: &mut Context<Self>) {
        self.look(context);
    }
}

#[cfg(all(test, feature = "network"))]
mod tests {
    use super::*;
    use blastema_core::NodeName;
    use blastema_core::net::NodeId;
    use std::sync::mpsc;

    /// What a node wants of the actuator, as it comes through the network.
    fn reply(table: &ActuatorTable, node: &str, wish: CommandKind) -> Result<u64, DeliveryError> {
        let wheels = ObjectName::new("wheels").expect("a name");
        let identity = ContractIdentity::of::<ActuatorCommand>().brief().encode();
        let peer = Some(NodeId::of(&NodeName::new(node).expect("a name")));
        let (told, reply) = mpsc::channel();
        let answer = Responder::called_back(Box::new(move |result| drop(told.send(result))), None);
        let (order, access) = (ActuatorCommand { identity, wish }, AccessControl::default());
        table.serve((&wheels, &access), order, MessageOrigin { peer }, answer);
        match reply.try_recv().expect("it is answered at once")? {
            CommandReply::Granted { epoch, .. } => Ok(epoch),
            CommandReply::Refused { why } => Err(crate::messaging::error::decode_kind(&why)),
            CommandReply::Done(_) | CommandReply::Differs { .. } => Ok(0),
        }
    }

    fn claim(commander: &str) -> CommandKind {
        CommandKind::Claim { commander: commander.to_owned(), incarnation: 1 }
    }

    #[test]
    fn a_lease_is_used_from_the_node_that_claimed_it_and_a_commander_has_its_nodes_name() {
        let (table, wheels) =
            (ActuatorTable::default(), ObjectName::new("wheels").expect("a name"));
        let serve = |_, _, answer: Responder<ActuatorCommand>| {
            answer.give(CommandReply::Done(Vec::new()));
        };
        let skeleton = Arc::new(ServiceFn::<ActuatorCommand>(Arc::new(serve)));
        let declared = DeclaredActuator {
            identity: ContractIdentity::of::<ActuatorCommand>(),
            rules: LeaseRules {
                span: Duration::from_secs(60),
                command_timeout: None,
                max_wait: Duration::from_secs(60),
                stop_by: StopBy::SafeCommand,
            },
            max_age: None,
            safe: Bytes::new(),
            stop: Bytes::new(),
            settle_within: Duration::ZERO,
            cut_off: None,
        };
        table.declare(&wheels, vec![(declared, skeleton)], AccessControl::default());

        let refused = reply(&table, "arm", claim("base:planner"));
        assert!(matches!(refused, Err(DeliveryError::Undecodable { .. })), "{refused:?}");
        let epoch = reply(&table, "base", claim("base:planner")).expect("it is free");
        for wish in [
            CommandKind::Renew { epoch },
            CommandKind::Release { epoch },
            CommandKind::Command { epoch, age_us: 0, way_us: 0, message: Vec::new() },
        ] {
            assert_eq!(reply(&table, "arm", wish), Err(DeliveryError::Superseded { epoch }));
        }
        assert_eq!(reply(&table, "base", CommandKind::Renew { epoch }), Ok(0));
        // The same commander begins again.
        assert_eq!(reply(&table, "base", claim("base:planner")), Ok(epoch + 1));
    }
}
