//! The actor of one replica, which drives the state machine in the core.

use super::finder::Finder;
use super::peers::{self, FromReplica};
use super::roster::Roster;
use super::types::{
    Answered, AskService, CompareConfiguration, LoadState, ReplicaMessage, RoleChanged, SaveState,
    Serving, Task, WhoServes,
};
use crate::component::environment::ComponentEnvironment;
use crate::messaging::death_watch::{Down, DownReason, Watcher};
use crate::messaging::error::encode_kind;
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform;
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, MessageMetadata, NameTaken, Registry, ReplyTo};
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_contract::reports::{AreYouAlive, FaultDeclared};
use blastema_core::contract::codec;
use blastema_core::service::{
    MESSAGE_MAX, Replica, ReplicaConfig, ReplicaOutput, Role, ServiceOutcome, ServiceRequest,
    StandbyKind,
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
/// The most bytes of one task. Callers check the same limit.
const TASK_MAX: usize = 2 * 1024 * 1024;

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

/// The actor.
pub(crate) struct ReplicaActor {
    pub(super) carried: Carried,
    pub(super) machine: Replica,
    wake: WakeTimer,
    pub(super) registry: Registry,
    pub(super) roster: Roster,
    pub(super) reports: FaultReports,
    callers: SortedMap<u64, Responder<AskService>>,
    /// The questions that wait for a primary.
    questions: VecDeque<PrimaryQuestion>,
    inquiry: Option<SpawnHandle>,
    next_caller: u64,
    /// The component is to be asked whether it accepts jobs again.
    polls_component: bool,
    others: SortedMap<NodeName, Sender<ReplicaMessage>>,
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
        let roster = environment.services();
        let (kept, known, names) = (carried.clone(), roster.clone(), registry.clone());
        let reports = environment.reports.clone();
        let make = move |_: &mut Context<Self>| {
            let (config, initial) = (kept.config.clone(), kept.initial.clone());
            ReplicaActor {
                machine: Replica::new(config, initial, platform::now()),
                carried: kept,
                wake: WakeTimer::default(),
                registry: names,
                roster: known,
                reports,
                callers: SortedMap::new(),
                questions: VecDeque::new(),
                inquiry: None,
                next_caller: 0,
                polls_component: false,
                others: SortedMap::new(),
            }
        };
        let actor = guardian.start(carried.actor.clone(), arbiter, make);
        let mut ports = SortedMap::new();
        let ask_recipient = actor.clone().recipient::<AskReceived>();
        let serve = ServiceFn::<AskService>(Arc::new(move |ask, _, answer| {
            ask_recipient.do_send(AskReceived(ask, answer));
        }));
        let question_recipient = actor.clone().recipient::<PrimaryQuestion>();
        let who = ServiceFn::<WhoServes>(Arc::new(move |question, _, answer| {
            question_recipient.do_send(PrimaryQuestion(question, answer));
        }));
        let replicas = peers::port::<ReplicaMessage>(actor.clone().recipient());
        ports.insert(ReplicaMessage::NAME, replicas);
        ports.insert(AskService::NAME, ContractPort::of_service_fn(serve));
        ports.insert(WhoServes::NAME, ContractPort::of_service_fn(who));
        let configurations = peers::port::<CompareConfiguration>(actor.clone().recipient());
        ports.insert(CompareConfiguration::NAME, configurations);
        registry.register(&carried.name, ports, Arc::new(NeverWatched))?;
        let death_recipient = actor.clone().recipient::<ComponentDied>();
        let report = move |down: Down| {
            if !matches!(down.ending, DownReason::NotAlive | DownReason::Unknown) {
                death_recipient.do_send(ComponentDied);
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

    /// Sends a message to the component; the reply comes back to this actor.
    fn hand_over(
        &self,
        contract: &str,
        message: Vec<u8>,
        then: impl FnOnce(Result<Bytes, DeliveryError>) -> ComponentReply + Send + 'static,
        context: &mut Context<Self>,
    ) {
        let actor = context.address();
        let reply_to: ReplyTo =
            Box::new(move |result| actor.do_send(then(result.map(GatherBuffer::into_bytes))));
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
        let undecodable =
            |error: codec::DecodeError| DeliveryError::Undecodable { reason: error.to_string() };
        let read = codec::decode_bounded::<Task, TASK_MAX>(request).map_err(undecodable);
        let read = read.and_then(|Task { identity, payload }| {
            let theirs = PeerIdentity::decode(&identity).map_err(undecodable)?;
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
                let then = move |result| ComponentReply::Executed { result, save };
                self.hand_over(&contract, payload, then, context);
            }
            Err(why) => {
                let refused = ComponentReply::Executed { result: Err(why), save: false };
                context.address().do_send(refused);
            }
        }
    }

    fn load(&mut self, state: Bytes, context: &mut Context<Self>) {
        let mut bytes = Vec::new();
        let message = LoadState { state: state.to_vec() };
        if codec::encode(&message, &mut bytes).is_err() {
            warn!(service = %self.carried.name, "a state is too large to be loaded");
            return self.machine.handle_loaded();
        }
        let then = move |result: Result<Bytes, DeliveryError>| {
            let loaded = result.and_then(|reply| {
                codec::decode_reply::<LoadState>(&reply)
                    .map_err(|error| DeliveryError::Undecodable { reason: error.to_string() })
            });
            match loaded {
                Ok(true) => ComponentReply::Loaded,
                Ok(false) => ComponentReply::NotLoaded,
                Err(why) if super::is_inactive(&why) => ComponentReply::Inactive,
                Err(_) => ComponentReply::LoadFailed { state },
            }
        };
        self.hand_over(LoadState::NAME, bytes, then, context);
    }

    fn save(&mut self, after: Option<Result<Bytes, DeliveryError>>, context: &mut Context<Self>) {
        let mut bytes = Vec::new();
        // A message without fields always fits.
        let _ = codec::encode(&SaveState, &mut bytes);
        let then = move |result: Result<Bytes, DeliveryError>| {
            let state = result.and_then(|reply| {
                codec::decode_reply::<SaveState>(&reply)
                    .map(Bytes::from)
                    .map_err(|error| DeliveryError::Undecodable { reason: error.to_string() })
            });
            match after {
                Some(result) => ComponentReply::ExecutedAndSaved { result, state },
                None => ComponentReply::Saved { state },
            }
        };
        self.hand_over(SaveState::NAME, bytes, then, context);
    }

    fn send(&mut self, to: &NodeName, message: Bytes) {
        if message.len() > MESSAGE_MAX {
            let detail = "a reply is too large to be kept for the standbys: let it be smaller";
            return self.declare(FaultKind::CheckFailed, detail);
        }
        if !self.others.contains_key(to) {
            let name = format!("{to}:{}", self.carried.name);
            let Ok(sender) = self.registry.sender::<ReplicaMessage>(&name) else { return };
            self.others.insert(to.clone(), sender);
        }
        if let Some(other) = self.others.get(to) {
            let from = self.carried.config.own.to_string();
            // The machine repeats what an unreachable node misses.
            let sent = other.tell(ReplicaMessage { from, message: message.into() });
            let isolated =
                sent.is_err_and(|refused| matches!(refused.kind, DeliveryError::Isolated { .. }));
            self.machine.handle_sent(to, isolated);
        }
    }

    /// Declares a fault of the service.
    fn declare(&self, kind: FaultKind, detail: &str) {
        let name = &self.carried.name;
        warn!(service = %name, "{detail}");
        if let Some(faults) = &self.reports.faults {
            let (object, incarnation) =
                (self.carried.actor.clone(), crate::runtime::guardian::alive().incarnation);
            let detail = format!("service {name}: {detail}");
            faults.do_send(FaultDeclared { object, incarnation, kind, detail, hold: None });
        }
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
        let before = self.roster.role(name);
        self.roster.note(name, role.clone());
        self.answer_questions();
        if matches!(before, Some(Role::Primary { .. })) || epoch.is_some() {
            self.send_role(context);
        }
    }

    fn answer_questions(&mut self) {
        for question in std::mem::take(&mut self.questions) {
            self.answer_question(question);
        }
    }

    /// Updates the view of the service, for display.
    pub(super) fn show(&self) {
        self.roster.show(&self.carried.name, self.machine.view(), platform::now());
    }

    /// Returns the epoch in which this node serves, or the greatest one that it knows.
    fn epoch(&self) -> u64 {
        match self.roster.role(&self.carried.name) {
            Some(Role::Primary { epoch }) => epoch,
            _ => self.machine.view().epoch,
        }
    }

    /// Answers a question for the primary: at once if there is one, or if there can be none;
    /// otherwise as soon as one is known.
    fn answer_question(&mut self, PrimaryQuestion(question, answer): PrimaryQuestion) {
        let config = &self.carried.config;
        let primary = self.roster.primary(&self.carried.name, &config.own);
        let primary = primary.map(|node| node.to_string());
        let disputed = self.machine.mismatch();
        let known = disputed.is_some() || primary.is_some() && primary != question.besides;
        if !known && self.questions.len() >= QUESTIONS_MAX {
            // Drop those whose deadlines have passed.
            self.questions.retain(|PrimaryQuestion(_, answer)| answer.is_wanted());
        }
        if !known && self.questions.len() < QUESTIONS_MAX {
            return self.questions.push_back(PrimaryQuestion(question, answer));
        }
        let keeps = config.kind != StandbyKind::Cold;
        let members = config.members.iter().map(NodeName::to_string).collect();
        answer.give(Serving { primary, epoch: self.epoch(), keeps, members, disputed });
    }

    /// Sends the role to the component.
    fn send_role(&self, context: &mut Context<Self>) {
        let epoch = match self.roster.role(&self.carried.name) {
            Some(Role::Primary { epoch }) => Some(epoch),
            _ => None,
        };
        let mut bytes = Vec::new();
        // A number always fits.
        let _ = codec::encode(&RoleChanged { epoch }, &mut bytes);
        let then = |received: Result<Bytes, DeliveryError>| {
            ComponentReply::RoleReceived(received.map(drop))
        };
        self.hand_over(RoleChanged::NAME, bytes, then, context);
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
        self.inquiry =
            Some(context.spawn(actix::fut::wrap_future::<_, Self>(served).map(on_served)));
    }
}

impl MachineActor for ReplicaActor {
    type Machine = Replica;

    fn driven(&mut self) -> (&mut Replica, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: ReplicaOutput, context: &mut Context<Self>) {
        let shows = matches!(
            output,
            ReplicaOutput::RoleChanged(_)
                | ReplicaOutput::Fault { .. }
                | ReplicaOutput::FaultCleared { .. }
        );
        if shows {
            self.show();
        }
        match output {
            ReplicaOutput::Send { to, message } => self.send(&to, message),
            ReplicaOutput::RoleChanged(role) => self.became(&role, context),
            ReplicaOutput::Execute { request, save } => self.execute(&request, save, context),
            ReplicaOutput::Save => self.save(None, context),
            ReplicaOutput::Load { state } => self.load(state, context),
            ReplicaOutput::Fault { kind, detail } => {
                self.declare(kind, &detail);
                // Those who wait for a primary are answered if there can be none.
                self.answer_questions();
            }
            ReplicaOutput::FaultCleared { kind } => self.clear_fault(kind),
            ReplicaOutput::Compare { with } => self.compare(with, context),
            ReplicaOutput::CheckDependencies => self.inquire(context),
            ReplicaOutput::Answer { caller, outcome } => {
                if let Some(answer) = self.callers.remove(&caller) {
                    answer.give(match outcome {
                        ServiceOutcome::Served(Ok(reply)) => {
                            Answered::Done { reply: reply.into(), epoch: self.epoch() }
                        }
                        ServiceOutcome::Served(Err(why)) => {
                            let why = encode_kind(&why);
                            Answered::Failed { why, epoch: self.epoch() }
                        }
                        ServiceOutcome::Refused(why) => {
                            Answered::Refused { why: encode_kind(&why) }
                        }
                        ServiceOutcome::Elsewhere(primary) => {
                            let primary = primary.map(|node| node.to_string());
                            Answered::Elsewhere { primary }
                        }
                    });
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
        self.machine = self.machine.restarted(platform::now());
        // The component still runs, but its state no longer has a position.
        self.machine.handle_component_died(platform::now());
        self.polls_component = false;
        self.wake = WakeTimer::default();
        self.callers.clear();
        self.questions.clear();
        self.inquiry = None;
        let standby = Role::Standby { primary: None, in_step: false };
        self.became(&standby, context);
        self.started(context);
    }
}

/// A message of another replica.
impl Handler<FromReplica<ReplicaMessage>> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, received: FromReplica<ReplicaMessage>, context: &mut Context<Self>) {
        let FromReplica { sender, message, answer } = received;
        answer.give(());
        match sender {
            Some(from) => self.machine.handle_message(&from, &message.message, platform::now()),
            None => self.machine.handle_forged(),
        }
        self.drive(context);
    }
}

/// A caller's request.
#[derive(Message)]
#[rtype(result = "()")]
struct AskReceived(AskService, Responder<AskService>);

impl Handler<AskReceived> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, AskReceived(ask, answer): AskReceived, context: &mut Context<Self>) {
        let AskService { sender, sequence, settled, since, task } = ask;
        if matches!(self.machine.role(), Role::Primary { epoch } if epoch < since) {
            // This process has not met the nodes that know of the later epoch.
            return answer.give(Answered::Elsewhere { primary: None });
        }
        let mut request = Vec::new();
        if codec::encode_bounded(&task, TASK_MAX, &mut request).is_err() {
            let why = encode_kind(&DeliveryError::TooLarge { limit: TASK_MAX });
            return answer.give(Answered::Refused { why });
        }
        self.next_caller += 1;
        let until = answer.until();
        self.callers.insert(self.next_caller, answer);
        let asked = ServiceRequest {
            caller: self.next_caller,
            id: MessageId { sender, sequence },
            settled,
            until,
            request: request.into(),
        };
        self.machine.handle_request(asked, platform::now());
        self.drive(context);
    }
}

/// A question for the primary.
#[derive(Message)]
#[rtype(result = "()")]
struct PrimaryQuestion(WhoServes, Responder<WhoServes>);

impl Handler<PrimaryQuestion> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, question: PrimaryQuestion, _: &mut Context<Self>) {
        self.answer_question(question);
    }
}

/// The component has ended.
#[derive(Message)]
#[rtype(result = "()")]
struct ComponentDied;

impl Handler<ComponentDied> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, _: ComponentDied, context: &mut Context<Self>) {
        self.machine.handle_component_died(platform::now());
        // The restarted component does not know its role.
        self.send_role(context);
        self.drive(context);
    }
}

/// The component's reply to the replica.
#[derive(Message)]
#[rtype(result = "()")]
enum ComponentReply {
    Executed {
        result: Result<Bytes, DeliveryError>,
        save: bool,
    },
    ExecutedAndSaved {
        result: Result<Bytes, DeliveryError>,
        state: Result<Bytes, DeliveryError>,
    },
    Saved {
        state: Result<Bytes, DeliveryError>,
    },
    Loaded,
    /// The component failed to load the state.
    NotLoaded,
    /// The component is stopped or isolated, and has not loaded the state.
    Inactive,
    LoadFailed {
        state: Bytes,
    },
    /// The component has received its role, or why it has not.
    RoleReceived(Result<(), DeliveryError>),
}

impl Handler<ComponentReply> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, done: ComponentReply, context: &mut Context<Self>) {
        let now = platform::now();
        match done {
            ComponentReply::Executed { result: Ok(reply), save: true } => {
                return self.save(Some(Ok(reply)), context);
            }
            ComponentReply::Executed { result, .. } => {
                if let Err(DeliveryError::Stopped | DeliveryError::Isolated { .. }) = result {
                    self.poll_component(context);
                }
                self.machine.handle_executed(result, None, now);
            }
            ComponentReply::ExecutedAndSaved { result, state } => {
                self.machine.handle_executed(result, Some(state), now);
            }
            ComponentReply::Saved { state } => self.machine.handle_saved(state, now),
            ComponentReply::Loaded => self.machine.handle_loaded(),
            ComponentReply::NotLoaded => self.machine.handle_not_loaded(now),
            ComponentReply::Inactive => {
                self.machine.handle_not_loaded(now);
                self.machine.handle_component_stopped(now);
                self.poll_component(context);
            }
            ComponentReply::LoadFailed { state } => {
                context.run_later(LOAD_RETRY, move |actor, context| actor.load(state, context));
                return;
            }
            ComponentReply::RoleReceived(Ok(())) => self.machine.handle_component_resumed(now),
            ComponentReply::RoleReceived(Err(why)) if super::is_inactive(&why) => {
                self.machine.handle_component_stopped(now);
                self.poll_component(context);
            }
            ComponentReply::RoleReceived(Err(_)) => return,
        }
        self.drive(context);
    }
}
