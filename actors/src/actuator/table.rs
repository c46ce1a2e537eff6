//! The actuators of a node and their commanders: drives the lease machines.
//!
//! A command is handled on the thread that delivers it. An actor on the fault chain's arbiter
//! watches the leases' time, so that a component that hangs does not delay another actuator's safe
//! command.

use super::command::{ActuatorCommand, CommandDone, CommandKind};
use crate::messaging::reply::Responder;
use crate::platform::{self, lock};
use crate::registry::access::{AccessControl, MessageOrigin};
use crate::registry::encoding::{RequestRefusal, named_contract};
use crate::registry::{ContractPort, MessageMetadata, ReplyTo, Skeleton};
use crate::runtime::callbacks::{CallOutcome, Callbacks};
use crate::runtime::guardian::Guardian;
use crate::runtime::timekeeper::Timekeeper;
use actix::prelude::{ArbiterHandle, Recipient};
use blastema_contract::reports::AreYouAlive;
use blastema_core::lease::{
    CommanderId, Lease, LeaseOutput, LeaseRules, LeaseStatus, RestCause, StopBy,
};
use blastema_core::net::trust::policy::Verb;
use blastema_core::sorted::SortedMap;
use blastema_core::{
    ContractIdentity, DeliveryError, FaultKind, GatherBuffer, Incarnation, Instant, Machine,
    ObjectName,
};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::sync::atomic::Ordering::{Relaxed, SeqCst};
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tracing::{error, info, warn};

/// Brings outputs to rest without the component.
pub(crate) type SafeOutputFn = Arc<dyn Fn() + Send + Sync>;

/// Why fields of a command cannot be set.
#[derive(Debug)]
pub(crate) struct FieldError {
    /// The field; `None` where it is the whole command.
    pub(crate) field: Option<String>,
    /// What is wrong, and what to write.
    pub(crate) why: String,
}

/// Fields of a command with their values as text.
pub(crate) type FieldTexts = [(String, String)];

/// An actuator as its component declares it.
pub(crate) struct DeclaredActuator {
    pub(crate) identity: ContractIdentity,
    pub(crate) rules: LeaseRules,
    /// How old the data may be that a command is made from.
    pub(crate) max_age: Option<Duration>,
    /// The command that brings it to rest, encoded.
    pub(crate) safe: Bytes,
    /// Makes a command of the safe one by other values of fields.
    pub(crate) with_fields: fn(&Bytes, &FieldTexts) -> Result<Bytes, Vec<FieldError>>,
    /// The command that stops it, encoded.
    pub(crate) stop: Bytes,
    pub(crate) settle_within: Duration,
    pub(crate) cut_off: Option<SafeOutputFn>,
}

/// An actuator and its commander, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ActuatorRow {
    /// The name of the component that declares the actuator.
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

/// A component and the contract of its commands.
pub(crate) type ActuatorKey = (ObjectName, &'static str);
type Actuators = SortedMap<ActuatorKey, Arc<Actuator>>;

/// What a policy for lost communication has done by an actuator, also while its component is away.
struct RungOrder {
    policy: CommanderId,
    /// The command, encoded; the safe one where the policy has given none.
    command: Option<Bytes>,
    /// This commander may claim the actuator meanwhile.
    yields_to: Option<String>,
}

/// The actuators of a node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct ActuatorTable {
    /// As many as its components declare.
    actuators: Arc<Mutex<Actuators>>,
    timekeeper: Arc<Timekeeper>,
    /// Runs the cut-off functions.
    callbacks: Callbacks,
    /// The node is in the safe state, in which no lease is granted.
    rests: Arc<AtomicBool>,
    /// The nodes whose commanders were lost, and components whose rungs are not carried out.
    suspended: Arc<Mutex<BTreeSet<String>>>,
    /// The actuators that policies for lost communication have rungs for.
    with_policy: Arc<Mutex<BTreeSet<ActuatorKey>>>,
    /// What policies for lost communication have done now.
    rungs: Arc<Mutex<SortedMap<ActuatorKey, RungOrder>>>,
}

/// Whether this commander has that name, or is of the node of that name.
fn is_of(commander: &str, name: &str) -> bool {
    commander == name || commander.split_once(':').is_some_and(|(node, _)| node == name)
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
        self.timekeeper.start(move |now| table.advance(now), name, guardian, arbiter)
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
            let actuator = Arc::new(actuator);
            lock(&self.actuators).insert(key.clone(), actuator.clone());
            if lock(&self.with_policy).contains(&key) {
                lock(&actuator.lease).handle_policy();
            }
            self.begin_rung(&actuator);
        }
        let (table, object) = (self.clone(), object.clone());
        let serve = move |order: ActuatorCommand,
                          from: MessageOrigin,
                          reply: Responder<ActuatorCommand>| {
            table.serve(&object, &access, order, from, reply)
        };
        ContractPort::served_by(serve)
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
        let mut settle_within = Duration::ZERO;
        for actuator in self.all().iter().filter(|actuator| actuator.object == *object) {
            let mut lease = lock(&actuator.lease);
            handle(&mut lease);
            if lease.is_stopping() {
                settle_within = settle_within.max(actuator.declared.settle_within);
            }
            drop(lease);
            self.carry_out(actuator);
        }
        self.timekeeper.look();
        settle_within
    }

    /// The node enters the safe state: every lease ends now, and none is granted before it goes to
    /// work again.
    pub(crate) fn rest(&self) {
        self.rests.store(true, SeqCst);
        for actuator in self.all() {
            lock(&actuator.lease).handle_rest();
            self.carry_out(&actuator);
        }
    }

    fn all(&self) -> Vec<Arc<Actuator>> {
        lock(&self.actuators).values().cloned().collect()
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
        self.all().iter().all(|actuator| lock(&actuator.lease).status(now) == LeaseStatus::Free)
    }

    /// The node goes to work again, and policies for lost communication go on.
    pub(crate) fn resume(&self) {
        self.rests.store(false, SeqCst);
        self.all().iter().for_each(|actuator| self.begin_rung(actuator));
    }

    /// All of them, and who commands each.
    pub(crate) fn rows(&self) -> Vec<ActuatorRow> {
        let now = platform::now();
        let row = |actuator: &Arc<Actuator>| ActuatorRow {
            object: actuator.object.clone(),
            contract: actuator.declared.identity.name,
            status: lock(&actuator.lease).status(now),
        };
        self.all().iter().map(row).collect()
    }

    /// The commander that holds an actuator of this component.
    pub(crate) fn commander_of(&self, object: &ObjectName) -> Option<CommanderId> {
        let all = self.all().into_iter().filter(|actuator| actuator.object == *object);
        all.filter_map(|actuator| lock(&actuator.lease).commander().cloned()).last()
    }

    /// Ends the leases of the commander of this name, or of all of the node of this name, and
    /// refuses claims from now on.
    pub(crate) fn suspend(&self, name: &str) {
        lock(&self.suspended).insert(name.to_owned());
        for actuator in self.all() {
            let is_meant = |commander: &CommanderId| is_of(&commander.name, name);
            lock(&actuator.lease).handle_suspended(is_meant, platform::now());
            self.carry_out(&actuator);
        }
        self.timekeeper.look();
    }

    /// Lets those claim again.
    pub(crate) fn resume_commander(&self, name: &str) {
        lock(&self.suspended).remove(name);
    }

    /// A policy for lost communication has rungs for this actuator.
    pub(crate) fn keep_by_policy(&self, key: &ActuatorKey) {
        lock(&self.with_policy).insert(key.clone());
        self.find(key).iter().for_each(|actuator| lock(&actuator.lease).handle_policy());
    }

    /// Has the actuator carry out this command, encoded, of a policy for lost communication, until
    /// the next one or the end. Without a command the one before counts on, and this commander may
    /// claim the actuator from the policy.
    pub(crate) fn enter_rung(
        &self,
        key: &ActuatorKey,
        policy: &CommanderId,
        command: Option<Bytes>,
        yields_to: Option<&String>,
    ) {
        let mut rungs = lock(&self.rungs);
        let before = rungs.get(key).and_then(|order| order.yields_to.as_ref());
        if command.is_none() && before == yields_to {
            return;
        }
        let command = command.or_else(|| rungs.remove(key)?.command);
        let (policy, yields_to) = (policy.clone(), yields_to.cloned());
        rungs.insert(key.clone(), RungOrder { policy, command, yields_to });
        drop(rungs);
        if let Some(actuator) = self.find(key) {
            self.begin_rung(&actuator);
        }
    }

    /// The policy that commands this actuator lets others command it again.
    pub(crate) fn end_rungs(&self, key: &ActuatorKey) {
        lock(&self.rungs).remove(key);
        if let Some(actuator) = self.find(key) {
            lock(&actuator.lease).handle_rungs_over(platform::now());
            self.carry_out(&actuator);
            self.timekeeper.look();
        }
    }

    /// Takes the lease for the policy that commands this actuator, if one does.
    fn begin_rung(&self, actuator: &Arc<Actuator>) {
        let mut lease = lock(&actuator.lease);
        // As for a claim: the safe state comes before all policies.
        if let Some(order) = lock(&self.rungs).get(&actuator.key())
            && !self.rests.load(SeqCst)
        {
            lease.handle_rung(order.policy.clone(), order.yields_to.clone(), platform::now());
        }
        drop(lease);
        self.carry_out(actuator);
        self.timekeeper.look();
    }

    /// The actuator of this name and contract, and the command that `make` makes for it.
    pub(crate) fn command_for<T>(
        &self,
        object: &str,
        contract: &str,
        make: impl FnOnce(&DeclaredActuator) -> T,
    ) -> Option<(ActuatorKey, T)> {
        let all = self.all().into_iter();
        let mut named = all.filter(|known| known.object.as_str() == object);
        let actuator = named.find(|known| known.declared.identity.name == contract)?;
        Some((actuator.key(), make(&actuator.declared)))
    }

    fn find(&self, key: &ActuatorKey) -> Option<Arc<Actuator>> {
        lock(&self.actuators).get(key).cloned()
    }

    /// The actuator that a message is for, if its sender may command it and means its contract.
    /// Each message is checked: the number of a lease is easily guessed.
    fn meant(
        &self,
        object: &ObjectName,
        access: &AccessControl,
        identity: &[u8],
        from: MessageOrigin,
    ) -> Result<Arc<Actuator>, RequestRefusal> {
        let theirs = named_contract(identity)?;
        access.check(from, Verb::Lease, object, || theirs.name.clone())?;
        let named = |actuator: &&Arc<Actuator>| {
            actuator.object == *object && actuator.declared.identity.name == theirs.name
        };
        let actuator = lock(&self.actuators).values().find(named).cloned();
        let unknown = || DeliveryError::Unknown { name: format!("{} of {object}", theirs.name) };
        let actuator = actuator.ok_or_else(unknown)?;
        RequestRefusal::check(&actuator.declared.identity, &theirs)?;
        Ok(actuator)
    }

    fn serve(
        &self,
        object: &ObjectName,
        access: &AccessControl,
        ActuatorCommand { identity, wish }: ActuatorCommand,
        from: MessageOrigin,
        reply: Responder<ActuatorCommand>,
    ) {
        let actuator = match self.meant(object, access, &identity, from) {
            Ok(actuator) => actuator,
            Err(refusal) => return reply.settle(Err(refusal)),
        };
        let now = platform::now();
        let mut lease = lock(&actuator.lease);
        // Looked at under the lease's lock: who comes later finds that it has ended.
        let rests = self.rests.load(SeqCst).then_some(DeliveryError::Stopped);
        let refused = rests.or_else(|| actuator.impersonation(&wish, from, &lease, now));
        let mut is_granted = false;
        let done = match (refused, wish) {
            (Some(why), _) => Err(why),
            // Its first command would wait, perhaps for longer than the lease.
            (None, CommandKind::Claim { .. }) if !actuator.skeleton.is_at_work() => {
                Err(DeliveryError::Restarting)
            }
            (None, CommandKind::Claim { commander, .. })
                if lock(&self.suspended).iter().any(|name| is_of(&commander, name)) =>
            {
                let by = "the policy for lost communication".to_owned();
                Err(DeliveryError::Held { actuator: actuator.object.to_string(), by })
            }
            (None, CommandKind::Claim { commander, incarnation }) => {
                let commander =
                    CommanderId { name: commander, incarnation: Incarnation(incarnation) };
                lease.handle_claim(commander, now).map(|grant| {
                    is_granted = true;
                    *lock(&actuator.claimed_from) = from;
                    let span_us = u64::try_from(grant.span.as_micros()).unwrap_or(u64::MAX);
                    CommandDone { epoch: grant.epoch, span_us, ..CommandDone::default() }
                })
            }
            (None, CommandKind::Renew { epoch }) => {
                lease.handle_renewal(epoch, now).map(|()| CommandDone::default())
            }
            (None, CommandKind::Release { epoch }) => {
                lease.handle_release(epoch);
                Ok(CommandDone::default())
            }
            (None, CommandKind::Command { epoch, age_us, way_us, message }) => {
                let way_us = if from.is_elsewhere() { way_us } else { 0 };
                // What it took longer than the fastest request is missing from its deadline, which
                // is the lease's span.
                let left = reply.until().map_or(actuator.declared.rules.span, |until| until - now);
                let age = Duration::from_micros(age_us.saturating_add(way_us))
                    .saturating_add(actuator.declared.rules.span.saturating_sub(left));
                match lease.handle_renewal(epoch, now) {
                    Ok(()) if actuator.declared.max_age.is_some_and(|limit| age > limit) => {
                        Err(DeliveryError::Expired)
                    }
                    Ok(()) => {
                        actuator.command(message, age, &mut lease, reply);
                        drop(lease);
                        return self.timekeeper.look();
                    }
                    Err(why) => Err(why),
                }
            }
        };
        drop(lease);
        self.carry_out(&actuator);
        if is_granted {
            self.take_back(&actuator);
        }
        self.timekeeper.look();
        reply.settle(done.map_err(RequestRefusal::Why));
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

    /// Lets all leases act on the time, and says when they want to be looked at again.
    fn advance(&self, now: Instant) -> Option<Instant> {
        let actuators = self.all();
        for actuator in &actuators {
            lock(&actuator.lease).handle_timeout(now);
            self.carry_out(actuator);
        }
        actuators.iter().filter_map(|actuator| lock(&actuator.lease).poll_timeout()).min()
    }

    fn carry_out(&self, actuator: &Arc<Actuator>) {
        let object = &actuator.object;
        loop {
            let output = lock(&actuator.lease).poll_output();
            match output {
                None => return,
                Some(LeaseOutput::Apply { commander, epoch, cause, again }) => {
                    self.give(actuator, cause);
                    // A log may block, and the rung's other actuators wait.
                    if again || matches!(cause, RestCause::Rung(_)) {
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

    /// Gives the safe command, the stop command, or that of a rung.
    fn give(&self, actuator: &Arc<Actuator>, cause: RestCause) {
        let DeclaredActuator { rules, safe, stop, .. } = &actuator.declared;
        let command = match (cause, rules.stop_by) {
            // The component's hook stops the actuator.
            (RestCause::Stopped, StopBy::Hook) => return,
            (RestCause::Stopped, _) => stop.clone(),
            (RestCause::Rung(_), _) => {
                let rungs = lock(&self.rungs);
                let ordered = rungs.get(&actuator.key()).and_then(|order| order.command.clone());
                ordered.unwrap_or_else(|| safe.clone())
            }
            _ => safe.clone(),
        };
        actuator.turn.store(actuator.skeleton.turn(), Relaxed);
        let (table, applied_at) = (self.clone(), actuator.clone());
        let applied: ReplyTo = Box::new(move |result: Result<GatherBuffer, DeliveryError>| {
            lock(&applied_at.lease).handle_applied(cause, result.is_ok());
            table.carry_out(&applied_at);
        });
        let metadata = MessageMetadata { is_first: true, ..MessageMetadata::default() };
        // What came of it is told to the closure in every case.
        let _ = actuator.skeleton.deliver(&command, metadata, Some(applied));
    }

    /// Has the cut-off called. The next lease is granted after it has returned: a cut-off that
    /// blocks keeps the actuator from every commander, and a fault says so.
    fn cut_off(&self, actuator: &Arc<Actuator>) {
        let Some(cut_off) = actuator.declared.cut_off.clone() else {
            return lock(&actuator.lease).handle_cut_off_returned();
        };
        let (actuator, object) = (actuator.clone(), actuator.object.clone());
        self.callbacks.call(
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
    fn key(&self) -> ActuatorKey {
        (self.object.clone(), self.declared.identity.name)
    }

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
        message: Vec<u8>,
        age: Duration,
        lease: &mut Lease,
        reply: Responder<ActuatorCommand>,
    ) {
        if self.busy.swap(true, Relaxed) {
            return reply.refuse(DeliveryError::Full, None);
        }
        lease.handle_command(platform::now());
        let busy = self.busy.clone();
        let reply_to: ReplyTo = Box::new(move |result: Result<GatherBuffer, DeliveryError>| {
            busy.store(false, Relaxed);
            let done = |bytes: GatherBuffer| CommandDone {
                reply: bytes.into_bytes().into(),
                ..CommandDone::default()
            };
            reply.settle(result.map(done).map_err(RequestRefusal::Why));
        });
        let metadata = MessageMetadata { age, ..MessageMetadata::default() };
        // What came of it is told to the closure in every case.
        let _ = self.skeleton.deliver(&message.into(), metadata, Some(reply_to));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::service_fn::ServiceFn;
    use blastema_core::NodeName;
    use blastema_core::net::NodeId;
    use std::sync::mpsc;

    /// What a node wants of the actuator, as it comes through the network.
    fn reply(table: &ActuatorTable, node: &str, wish: CommandKind) -> Result<u64, DeliveryError> {
        let wheels = ObjectName::new("wheels").expect("a name");
        let identity = ContractIdentity::of::<ActuatorCommand>().brief().encode();
        let peer = Some(NodeId::of(&NodeName::new(node).expect("a name")));
        let (sent, reply) = mpsc::channel();
        let responder = Responder::called_back(Box::new(move |done| drop(sent.send(done))), None);
        let (order, access) = (ActuatorCommand { identity, wish }, AccessControl::default());
        table.serve(&wheels, &access, order, MessageOrigin { peer }, responder);
        let done = reply.try_recv().expect("it is answered at once")?;
        Ok(done.expect("it is the same contract").epoch)
    }

    fn claim(commander: &str) -> CommandKind {
        CommandKind::Claim { commander: commander.to_owned(), incarnation: 1 }
    }

    #[test]
    fn a_lease_is_used_from_the_node_that_claimed_it_and_a_commander_has_its_nodes_name() {
        let (table, wheels) =
            (ActuatorTable::default(), ObjectName::new("wheels").expect("a name"));
        let serve = |_, _, responder: Responder<ActuatorCommand>| {
            responder.give(Ok(CommandDone::default()));
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
            with_fields: |safe, _| Ok(safe.clone()),
            stop: Bytes::new(),
            settle_within: Duration::ZERO,
            cut_off: None,
        };
        table.declare(&wheels, vec![(declared, skeleton)], AccessControl::default());
        table.handle_work(&wheels, Lease::handle_at_work);

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
