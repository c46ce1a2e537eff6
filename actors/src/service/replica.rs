//! The actor of one replica, which drives the state machine in the core.

use super::finder::Finder;
use super::is_inactive;
use super::roster::Roster;
use super::types::{
    Answered, AskService, CompareConfiguration, DriveComponent, ReplicaMessage, Serving, TASK_MAX,
    Task, WhoServes,
};
use crate::component::environment::ComponentEnvironment;
use crate::messaging::death_watch::{Down, DownReason, Watcher};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::reply::Responder;
use crate::platform;
use crate::registry::access::MessageOrigin;
use crate::registry::{ContractPort, MessageMetadata, NameTaken, Registry, ReplyTo};
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use crate::runtime::reports::FaultReporter;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::reports::AreYouAlive;
use blastema_core::contract::codec;
use blastema_core::net::NodeId;
use blastema_core::service::{
    MESSAGE_MAX, Replica, ReplicaConfig, ReplicaOutput, Role, STATE_MAX, ServiceOutcome,
    ServiceRequest, StandbyKind,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{
    Contract, DeliveryError, FaultKind, GatherBuffer, MessageId, NodeName, ObjectName, PeerIdentity,
};
use bytes::Bytes;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;
use tracing::{info, warn};

/// The delay before a state is loaded again that a restarting component did not receive.
const LOAD_RETRY: Duration = Duration::from_millis(5);
/// How often a stopped or isolated component is asked whether it accepts jobs again. A shorter
/// interval makes its node a candidate sooner; each question is one small message within the node.
const COMPONENT_POLL: Duration = Duration::from_millis(100);
/// How often the directory is polled for other nodes with an object of the service's name. A
/// shorter interval finds different configurations sooner; each poll costs little.
const DIRECTORY_POLL: Duration = Duration::from_millis(500);
/// How long another replica has to answer with its configuration.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);

/// The most questions that may wait for a primary: a few of each of many callers. Further ones are
/// answered with what is known.
const QUESTIONS_MAX: usize = 1024;

/// A service that this node carries.
#[derive(Clone)]
pub(crate) struct Carried {
    pub(crate) name: ObjectName,
    /// The name of the component.
    pub(crate) component: ObjectName,
    /// The name of the replica's actor.
    pub(crate) actor: ObjectName,
    pub(crate) config: ReplicaConfig,
    pub(crate) initial: Bytes,
    /// The services that this one depends on.
    pub(crate) depends_on: Vec<ObjectName>,
}

/// A service cannot be watched: its component has incarnations of its own.
struct NeverWatched;

impl crate::messaging::death_watch::Watchable for NeverWatched {}

pub(crate) struct ReplicaActor {
    carried: Carried,
    machine: Replica,
    wake: WakeTimer,
    registry: Registry,
    roster: Roster,
    faults: FaultReporter,
    callers: SortedMap<u64, Responder<AskService>>,
    /// The questions that wait for a primary.
    questions: VecDeque<(WhoServes, Responder<WhoServes>)>,
    inquiry: Option<SpawnHandle>,
    next_caller: u64,
    /// The component is to be asked whether it accepts jobs again.
    polls_component: bool,
    /// The epoch in which the component serves, as it was told.
    told_epoch: Option<u64>,
}

impl ReplicaActor {
    /// Starts the replica, and registers the service's name on this node.
    pub(crate) fn start(
        carried: Carried,
        environment: &ComponentEnvironment,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Result<Recipient<AreYouAlive>, NameTaken> {
        let ComponentEnvironment { registry, .. } = environment;
        let roster = environment.feature::<Roster>();
        let (kept, known, names) = (carried.clone(), roster.clone(), registry.clone());
        let faults = FaultReporter::new(carried.actor.clone(), environment.reports.clone());
        let make = move |_: &mut Context<Self>| {
            let (config, initial) = (kept.config.clone(), kept.initial.clone());
            ReplicaActor {
                machine: Replica::new(config, initial, platform::now()),
                carried: kept,
                wake: WakeTimer::default(),
                registry: names,
                roster: known,
                faults,
                callers: SortedMap::new(),
                questions: VecDeque::new(),
                inquiry: None,
                next_caller: 0,
                polls_component: false,
                told_epoch: None,
            }
        };
        let actor = guardian.start(carried.actor.clone(), arbiter, make);
        registry.register(&carried.name, ports(&actor), Arc::new(NeverWatched))?;
        let replica = actor.clone();
        let report = move |down: Down| {
            if !matches!(down.ending, DownReason::NotAlive | DownReason::Unknown) {
                replica.do_send(ReplicaStep(Box::new(|replica, context| {
                    replica.machine.handle_component_died(platform::now());
                    // The restarted component does not know its role.
                    replica.send_role(context);
                })));
            }
        };
        let incarnation = Arc::new(IncarnationToken::default());
        let watcher = Watcher {
            who: carried.name.clone(),
            incarnation,
            outlasts_object: true,
            tell: Box::new(report),
        };
        registry.watch(carried.component.clone(), watcher);
        Ok(actor.recipient())
    }

    /// Sends a message to the component, whose reply comes back to `then`.
    fn hand_over(
        &self,
        contract: &str,
        message: Vec<u8>,
        then: impl FnOnce(&mut Self, Result<Bytes, DeliveryError>, &mut Context<Self>) + Send + 'static,
        context: &mut Context<Self>,
    ) {
        let actor = context.address();
        let reply_to: ReplyTo = Box::new(move |result| {
            let result = result.map(GatherBuffer::into_bytes);
            actor.do_send(ReplicaStep(Box::new(move |replica, context| {
                then(replica, result, context)
            })));
        });
        match self.registry.skeleton(&self.carried.component, contract) {
            // The reply closure is called in every case.
            Ok((_, skeleton)) => {
                let _ =
                    skeleton.deliver(&message.into(), MessageMetadata::default(), Some(reply_to));
            }
            Err(why) => reply_to(Err(why)),
        }
    }

    fn execute(&mut self, request: &[u8], save: bool, context: &mut Context<Self>) {
        let read = codec::decode_bounded::<Task, TASK_MAX>(request).map_err(DeliveryError::from);
        let read = read.and_then(|Task { identity, payload }| {
            let theirs = PeerIdentity::decode(&identity)?;
            let (ours, _) = self.registry.skeleton(&self.carried.component, &theirs.name)?;
            match ours.check(&theirs) {
                Ok(()) => Ok((theirs.name, payload)),
                Err(difference) => {
                    Err(DeliveryError::ContractDiffers { difference: difference.to_string() })
                }
            }
        });
        match read {
            Ok((contract, payload)) => {
                let then =
                    move |replica: &mut Self, result, context: &mut Context<Self>| match result {
                        Ok(reply) if save => replica.save(Some(reply), context),
                        result => {
                            if let Err(DeliveryError::Stopped | DeliveryError::Isolated { .. }) =
                                result
                            {
                                replica.poll_component(context);
                            }
                            replica.machine.handle_executed(result, None, platform::now());
                        }
                    };
                self.hand_over(&contract, payload, then, context);
            }
            Err(why) => self.machine.handle_executed(Err(why), None, platform::now()),
        }
    }

    /// Sends a message of the replica's own to the component, whose reply comes back to `then`.
    fn drive_component(
        &self,
        message: &DriveComponent,
        then: impl FnOnce(&mut Self, Result<Option<Vec<u8>>, DeliveryError>, &mut Context<Self>)
        + Send
        + 'static,
        context: &mut Context<Self>,
    ) {
        let mut bytes = Vec::new();
        // Every message fits: a state that is loaded has at most `STATE_MAX` bytes.
        let _ = codec::encode(message, &mut bytes);
        let read =
            move |replica: &mut Self, reply: Result<Bytes, _>, context: &mut Context<Self>| {
                let decode = |reply: Bytes| Ok(codec::decode_reply::<DriveComponent>(&reply)?);
                then(replica, reply.and_then(decode), context);
            };
        self.hand_over(DriveComponent::NAME, bytes, read, context);
    }

    fn load(&mut self, state: Bytes, context: &mut Context<Self>) {
        if state.len() > STATE_MAX {
            // It is the first state, which the component has. The machine declares it as a fault.
            return self.machine.handle_loaded();
        }
        let message = DriveComponent::Load { state: state.to_vec() };
        let then = move |replica: &mut Self, loaded, context: &mut Context<Self>| match loaded {
            Ok(Some(_)) => replica.machine.handle_loaded(),
            Ok(None) => replica.machine.handle_not_loaded(platform::now()),
            Err(why) if is_inactive(&why) => {
                replica.machine.handle_not_loaded(platform::now());
                replica.handle_inactive(context);
            }
            Err(_) => {
                context.run_later(LOAD_RETRY, move |replica, context| {
                    replica.load(state, context);
                });
            }
        };
        self.drive_component(&message, then, context);
    }

    /// Asks the component for its state, `after` a request with this reply.
    fn save(&mut self, after: Option<Bytes>, context: &mut Context<Self>) {
        let then = move |replica: &mut Self, saved: Result<_, _>, _: &mut Context<Self>| {
            let state = saved.map(|state: Option<Vec<u8>>| state.unwrap_or_default().into());
            match after {
                Some(reply) => {
                    replica.machine.handle_executed(Ok(reply), Some(state), platform::now());
                }
                None => replica.machine.handle_saved(state, platform::now()),
            }
        };
        self.drive_component(&DriveComponent::Save, then, context);
    }

    /// The component is stopped or isolated.
    fn handle_inactive(&mut self, context: &mut Context<Self>) {
        self.machine.handle_component_stopped(platform::now());
        self.poll_component(context);
    }

    fn send(&mut self, to: &NodeName, message: Bytes) {
        if message.len() > MESSAGE_MAX {
            let detail = "a reply is too large to be kept for the standbys: let it be smaller";
            return self.declare(FaultKind::CheckFailed, detail);
        }
        let name = format!("{to}:{}", self.carried.name);
        if let Ok(other) = self.registry.sender::<ReplicaMessage>(&name) {
            let from = self.carried.config.own.to_string();
            // The machine repeats what an unreachable node misses.
            let _ = other.tell(ReplicaMessage { from, message: message.into() });
        }
    }

    /// Declares a fault of the service.
    fn declare(&self, kind: FaultKind, detail: &str) {
        let name = &self.carried.name;
        warn!(service = %name, "{detail}");
        self.faults.declare(kind, format!("service {name}: {detail}"));
    }

    fn became(&mut self, role: &Role, context: &mut Context<Self>) {
        let name = &self.carried.name;
        let epoch = match role {
            Role::Primary { epoch } => {
                info!(service = %name, epoch, "this node serves");
                Some(*epoch)
            }
            Role::Standby { primary, in_step } => {
                let primary = primary.as_ref().map_or("none", NodeName::as_str);
                info!(service = %name, primary, in_step, "this node stands by");
                None
            }
        };
        self.show();
        self.answer_questions();
        if std::mem::replace(&mut self.told_epoch, epoch).is_some() || epoch.is_some() {
            self.send_role(context);
        }
    }

    fn answer_questions(&mut self) {
        for (question, responder) in std::mem::take(&mut self.questions) {
            self.answer_question(question, responder);
        }
    }

    /// Updates the view of the service, for display.
    fn show(&self) {
        self.roster.show(&self.carried.name, self.machine.view(), platform::now());
    }

    /// Returns the epoch in which this node serves, or the greatest one that it knows.
    fn epoch(&self) -> u64 {
        match self.machine.role() {
            Role::Primary { epoch } => epoch,
            Role::Standby { .. } => self.machine.view().epoch,
        }
    }

    /// Answers a question for the primary: at once if there is one, or if there can be none;
    /// otherwise as soon as one is known.
    fn answer_question(&mut self, question: WhoServes, responder: Responder<WhoServes>) {
        let config = &self.carried.config;
        let primary = self.machine.view().primary.map(|node| node.to_string());
        let disputed = self.machine.mismatch();
        let known = disputed.is_some() || primary.is_some() && primary != question.besides;
        if !known && self.questions.len() >= QUESTIONS_MAX {
            // Drop those whose deadlines have passed.
            self.questions.retain(|(_, responder)| responder.is_wanted());
        }
        if !known && self.questions.len() < QUESTIONS_MAX {
            return self.questions.push_back((question, responder));
        }
        let keeps = config.kind != StandbyKind::Cold;
        let members = config.members.iter().map(NodeName::to_string).collect();
        responder.give(Serving { primary, epoch: self.epoch(), keeps, members, disputed });
    }

    /// Sends the role to the component.
    fn send_role(&self, context: &mut Context<Self>) {
        let epoch = match self.machine.role() {
            Role::Primary { epoch } => Some(epoch),
            Role::Standby { .. } => None,
        };
        let then = |replica: &mut Self, received, context: &mut Context<Self>| match received {
            Ok(_) => replica.machine.handle_component_resumed(platform::now()),
            Err(why) if is_inactive(&why) => replica.handle_inactive(context),
            Err(_) => {}
        };
        self.drive_component(&DriveComponent::RoleChanged { epoch }, then, context);
    }

    /// Schedules a question whether the component accepts jobs again.
    fn poll_component(&mut self, context: &mut Context<Self>) {
        if !std::mem::replace(&mut self.polls_component, true) {
            context.run_later(COMPONENT_POLL, |actor, context| {
                actor.polls_component = false;
                actor.send_role(context);
            });
        }
    }

    /// Waits until the services that this one depends on have primaries. A new check replaces the
    /// one before.
    fn inquire(&mut self, context: &mut Context<Self>) {
        if let Some(before) = self.inquiry.take() {
            context.cancel_future(before);
        }
        let finders = self.carried.depends_on.iter();
        let finders: Vec<_> =
            finders.map(|name| Finder::new(name.clone(), &self.registry, &self.roster)).collect();
        let served = async move {
            futures_util::future::join_all(finders.iter().map(Finder::served)).await;
        };
        let on_served = |(), actor: &mut Self, context: &mut Context<Self>| {
            actor.inquiry = None;
            actor.machine.handle_ready(platform::now());
            actor.drive(context);
        };
        self.inquiry = Some(context.spawn(wrap_future::<_, Self>(served).map(on_served)));
    }

    /// Gives the machine the nodes that carry the service, and schedules the next poll.
    fn poll_directory(&mut self, context: &mut Context<Self>) {
        let (access, name) = (self.registry.access(), self.carried.name.clone());
        let may_claim = |node: &NodeName| access.may_claim(node, &name);
        let mut carriers = self.roster.carriers(&name);
        carriers.retain(|node| may_claim(node) && self.registry.is_reachable(node));
        self.machine.handle_carriers(&carriers, may_claim, platform::now());
        self.drive(context);
        self.show();
        context.run_later(DIRECTORY_POLL, Self::poll_directory);
    }

    /// Sends this node's configuration to another one, and asks for its configuration.
    fn compare(&self, with: NodeName, context: &mut Context<Self>) {
        if !self.may_claim(&with) {
            return;
        }
        let address = format!("{with}:{}", self.carried.name);
        let Ok(sender) = self.registry.sender::<CompareConfiguration>(&address) else { return };
        let from = self.carried.config.own.to_string();
        let question =
            CompareConfiguration { from, configuration: self.machine.configuration().into() };
        let asked = async move { sender.ask_within(question, ANSWER_TIMEOUT).await };
        context.spawn(wrap_future::<_, Self>(asked).map(move |answer, actor, context| {
            // The roster may have changed since the question.
            if !actor.may_claim(&with) {
                return;
            }
            match answer.map_err(|error| error.kind) {
                Ok(theirs) => {
                    actor.machine.handle_configuration(&with, &theirs, platform::now());
                }
                Err(DeliveryError::Unknown { .. } | DeliveryError::NotServed { .. }) => {
                    actor.machine.handle_no_service(&with)
                }
                Err(DeliveryError::Left { .. }) => actor.machine.handle_left(&with),
                Err(_) => {}
            }
            actor.drive(context);
        }));
    }

    fn may_claim(&self, node: &NodeName) -> bool {
        self.registry.access().may_claim(node, &self.carried.name)
    }

    /// Handles a message of another replica.
    fn handle_replica_message(
        &mut self,
        from: NodeName,
        ReplicaMessage { message, .. }: ReplicaMessage,
        responder: Responder<ReplicaMessage>,
    ) {
        responder.give(());
        self.machine.handle_message(&from, &message, platform::now());
    }

    /// Handles a question of another replica, with its configuration.
    fn handle_comparison(
        &mut self,
        from: NodeName,
        CompareConfiguration { configuration, .. }: CompareConfiguration,
        responder: Responder<CompareConfiguration>,
    ) {
        match self.may_claim(&from) {
            true => self.machine.handle_configuration(&from, &configuration, platform::now()),
            false => self.machine.handle_refused(),
        }
        // The answer says whether this replica serves now.
        responder.give(self.machine.configuration().into());
    }

    /// Handles a caller's request.
    fn handle_ask(&mut self, ask: AskService, responder: Responder<AskService>) {
        let AskService { sender, sequence, settled, since, task } = ask;
        if matches!(self.machine.role(), Role::Primary { epoch } if epoch < since) {
            // This process has not met the nodes that know of the later epoch.
            let outcome = ServiceOutcome::Elsewhere(None).encode();
            return responder.give(Answered { outcome, epoch: self.epoch() });
        }
        self.next_caller += 1;
        let until = responder.until();
        self.callers.insert(self.next_caller, responder);
        let asked = ServiceRequest {
            caller: self.next_caller,
            id: MessageId { sender, sequence },
            settled,
            until,
            request: task.into(),
        };
        self.machine.handle_request(asked, platform::now());
    }
}

impl MachineActor for ReplicaActor {
    type Machine = Replica;

    fn driven(&mut self) -> (&mut Replica, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: ReplicaOutput, context: &mut Context<Self>) {
        match output {
            ReplicaOutput::Send { to, message } => self.send(&to, message),
            ReplicaOutput::RoleChanged(role) => self.became(&role, context),
            ReplicaOutput::Execute { request, save } => self.execute(&request, save, context),
            ReplicaOutput::Save => self.save(None, context),
            ReplicaOutput::Load { state } => self.load(state, context),
            ReplicaOutput::Fault { kind, detail } => {
                self.show();
                self.declare(kind, &detail);
                // Those who wait for a primary are answered if there can be none.
                self.answer_questions();
            }
            ReplicaOutput::FaultCleared { kind } => {
                self.show();
                self.faults.clear(kind);
            }
            ReplicaOutput::Compare { with } => self.compare(with, context),
            ReplicaOutput::CheckDependencies => self.inquire(context),
            ReplicaOutput::Answer { caller, outcome } => {
                if let Some(responder) = self.callers.remove(&caller) {
                    let epoch = self.epoch();
                    responder.give(Answered { outcome: outcome.encode(), epoch });
                }
            }
        }
    }
}

answers_the_monitor!(ReplicaActor);

impl Actor for ReplicaActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.show();
        self.poll_directory(context);
        self.drive(context);
    }
}

impl Supervised for ReplicaActor {
    /// The replica has lost its state, and comes into step like one whose process restarted.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.machine = self.machine.restarted(self.carried.initial.clone(), platform::now());
        // The component still runs, but its state no longer has a position.
        self.machine.handle_component_died(platform::now());
        self.polls_component = false;
        self.wake = WakeTimer::default();
        self.callers.clear();
        self.questions.clear();
        self.inquiry = None;
        self.became(&Role::default(), context);
        self.started(context);
    }
}

type RunStep = dyn FnOnce(&mut ReplicaActor, &mut Context<ReplicaActor>) + Send;

/// A step of the actor: it handles a message, or a reply of its component.
#[derive(Message)]
#[rtype(result = "()")]
struct ReplicaStep(Box<RunStep>);

impl Handler<ReplicaStep> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, ReplicaStep(step): ReplicaStep, context: &mut Context<Self>) {
        step(self, context);
        self.drive(context);
    }
}

/// Returns the ports of a replica, by their contracts.
fn ports(actor: &Addr<ReplicaActor>) -> SortedMap<&'static str, ContractPort> {
    let messages = port(
        actor,
        |message: &ReplicaMessage, origin| sender(&message.from, origin),
        ReplicaActor::handle_replica_message,
    );
    let comparisons = port(
        actor,
        |question: &CompareConfiguration, origin| sender(&question.from, origin),
        ReplicaActor::handle_comparison,
    );
    let requests =
        port(actor, |_: &_, _| Some(()), |replica, (), ask, to| replica.handle_ask(ask, to));
    let questions = port(
        actor,
        |_: &_, _| Some(()),
        |replica, (), asked, to| replica.answer_question(asked, to),
    );
    let ports = [
        (ReplicaMessage::NAME, messages),
        (CompareConfiguration::NAME, comparisons),
        (AskService::NAME, requests),
        (WhoServes::NAME, questions),
    ];
    ports.into_iter().collect()
}

/// Returns the port for the messages of one contract. A message without a sender is refused.
fn port<M: Contract, S: 'static>(
    actor: &Addr<ReplicaActor>,
    sender: fn(&M, MessageOrigin) -> Option<S>,
    handle: fn(&mut ReplicaActor, S, M, Responder<M>),
) -> ContractPort {
    let actor = actor.clone();
    ContractPort::served_by(move |message: M, origin, responder| {
        let step = move |replica: &mut ReplicaActor, _: &mut Context<ReplicaActor>| match sender(
            &message, origin,
        ) {
            Some(sender) => handle(replica, sender, message, responder),
            None => replica.machine.handle_refused(),
        };
        actor.do_send(ReplicaStep(Box::new(step)));
    })
}

/// Returns the verified sender of a message between replicas. The message names its sender, but any
/// node may write any name: a vote or a configuration in the name of another node could end or
/// elect a primary. So the name has to be that of the session's node. A replica sends no messages
/// to itself.
fn sender(name: &str, MessageOrigin { peer }: MessageOrigin) -> Option<NodeName> {
    NodeName::new(name).ok().filter(|name| peer == Some(NodeId::of(name)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directory::DirectoryTable;
    use crate::runtime::reports::FaultReports;
    use blastema_core::Machine;
    use blastema_core::service::OnPartition;
    use blastema_doubles::settle;
    use std::sync::atomic::AtomicU64;
    use std::sync::atomic::Ordering::SeqCst;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn config(own: &str) -> ReplicaConfig {
        ReplicaConfig {
            own: node(own),
            members: vec![node("n1"), node("n2")],
            kind: StandbyKind::Warm,
            on_partition: OnPartition::Stop,
            depends: false,
            heartbeat_interval: Duration::from_millis(50),
        }
    }

    /// Starts the replica of n1.
    fn started() -> Addr<ReplicaActor> {
        let name = |text| ObjectName::new(text).unwrap();
        let carried = Carried {
            name: name("counter"),
            component: name("counter/replica"),
            actor: name("counter/replica/body"),
            config: config("n1"),
            initial: Bytes::new(),
            depends_on: Vec::new(),
        };
        Guardian::default().start(carried.actor.clone(), None, |_| ReplicaActor {
            machine: Replica::new(config("n1"), Bytes::new(), platform::now()),
            faults: FaultReporter::new(carried.actor.clone(), FaultReports::default()),
            carried,
            wake: WakeTimer::default(),
            registry: Registry::default(),
            roster: Roster::new(DirectoryTable::default()),
            callers: SortedMap::new(),
            questions: VecDeque::new(),
            inquiry: None,
            next_caller: 0,
            polls_component: false,
            told_epoch: None,
        })
    }

    /// Delivers a message from another node, or from this one, and returns whether it was refused.
    async fn is_refused<M: Contract>(message: &M, by: Option<&str>) -> bool {
        let actor = started();
        let mut bytes = Vec::new();
        codec::encode(message, &mut bytes).unwrap();
        let from = by.map(|name| NodeId::of(&node(name)));
        let metadata = MessageMetadata { from, ..MessageMetadata::default() };
        let port = ports(&actor).remove(M::NAME).unwrap().into_skeleton();
        port.deliver(&bytes.into(), metadata, None).unwrap();
        let refused = Arc::new(AtomicU64::new(u64::MAX));
        let count = refused.clone();
        actor.do_send(ReplicaStep(Box::new(move |replica, _| {
            count.store(replica.machine.refused(), SeqCst);
        })));
        settle().await;
        let refused = refused.load(SeqCst);
        assert!(refused <= 1, "the message was handled");
        refused == 1
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_message_that_names_another_sender_is_refused() {
        let mut other = Replica::new(config("n2"), Bytes::new(), platform::now());
        let configuration = Vec::from(other.configuration());
        other.handle_timeout(platform::now() + Duration::from_secs(1));
        let requests_vote = std::iter::from_fn(|| other.poll_output()).find_map(|output| {
            let ReplicaOutput::Send { message, .. } = output else { return None };
            Some(Vec::from(message))
        });
        let message = requests_vote.unwrap();

        let cases = [
            ("n2", Some("n2"), false),
            ("n2", Some("n3"), true),
            ("n2", None, true),
            ("not a name!", Some("n2"), true),
        ];
        for (named, by, expected) in cases {
            let from = named.to_owned();
            let message = ReplicaMessage { from: from.clone(), message: message.clone() };
            assert_eq!(is_refused(&message, by).await, expected, "{named:?} by {by:?}");
            let configuration = configuration.clone();
            let question = CompareConfiguration { from, configuration };
            assert_eq!(is_refused(&question, by).await, expected, "{named:?} by {by:?}");
        }
    }
}
