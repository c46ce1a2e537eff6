//! One replica of a service: the body of the machine in the core.

use super::finder::Finder;
use super::peers::{self, Spoken};
use super::roster::Roster;
use super::words::{
    Answered, AskService, CompareTerms, LoadState, ReplicaSays, RoleChanged, SaveState, Serving,
    Task, WhoServes,
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

/// How soon a component that could not take a state over is given it again.
const LOAD_AGAIN: Duration = Duration::from_millis(5);
/// How often a component that was stopped or isolated is asked whether it takes something again.
/// Shorter makes its node a candidate sooner; each question is one small message within the node.
const LOOK_AGAIN: Duration = Duration::from_millis(100);
/// The most bytes of one task: the caller's limit, which is checked there as well.
const TASK_MAX: usize = 2 * 1024 * 1024;

/// Questions that may wait for somebody to serve: a few of each of many callers. Further ones are
/// answered with what is known.
const WONDERING_MAX: usize = 1024;

/// A service as a node carries it.
#[derive(Clone)]
pub(crate) struct Carried {
    pub(crate) name: ObjectName,
    /// The component's name.
    pub(crate) component: ObjectName,
    /// The replica's own.
    pub(crate) body: ObjectName,
    pub(crate) config: ReplicaConfig,
    pub(crate) initial: Bytes,
    /// Services without which it does not take over.
    pub(crate) depends_on: Vec<ObjectName>,
}

/// Nobody mourns a service: its component has lives of its own.
struct Undying;

impl crate::messaging::death_watch::Watchable for Undying {}

/// The body.
pub(crate) struct ReplicaBody {
    pub(super) carried: Carried,
    pub(super) machine: Replica,
    wake: WakeTimer,
    pub(super) registry: Registry,
    pub(super) roster: Roster,
    pub(super) reports: FaultReports,
    callers: SortedMap<u64, Responder<AskService>>,
    /// Who wants to know who serves, while nobody does.
    wondering: VecDeque<Wondered>,
    inquiry: Option<SpawnHandle>,
    next: u64,
    /// It is going to be asked whether it takes something again.
    looking: bool,
    others: SortedMap<NodeName, Sender<ReplicaSays>>,
}

impl ReplicaBody {
    /// Starts the replica, and gives the service its name here.
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
            ReplicaBody {
                machine: Replica::new(config, initial, platform::now()),
                carried: kept,
                wake: WakeTimer::default(),
                registry: names,
                roster: known,
                reports,
                callers: SortedMap::new(),
                wondering: VecDeque::new(),
                inquiry: None,
                next: 0,
                looking: false,
                others: SortedMap::new(),
            }
        };
        let body = guardian.start(carried.body.clone(), arbiter, make);
        let mut ports = SortedMap::new();
        let asked = body.clone().recipient::<Asked>();
        let serve = ServiceFn::<AskService>(Arc::new(move |ask, _, answer| {
            asked.do_send(Asked(ask, answer));
        }));
        let wondered = body.clone().recipient::<Wondered>();
        let who = ServiceFn::<WhoServes>(Arc::new(move |question, _, answer| {
            wondered.do_send(Wondered(question, answer));
        }));
        ports.insert(ReplicaSays::NAME, peers::port::<ReplicaSays>(body.clone().recipient()));
        ports.insert(AskService::NAME, ContractPort::of_service_fn(serve));
        ports.insert(WhoServes::NAME, ContractPort::of_service_fn(who));
        ports.insert(CompareTerms::NAME, peers::port::<CompareTerms>(body.clone().recipient()));
        registry.register(&carried.name, ports, Arc::new(Undying))?;
        let told = body.clone().recipient::<Died>();
        let tell = move |down: Down| {
            if !matches!(down.ending, DownReason::NotAlive | DownReason::Unknown) {
                told.do_send(Died);
            }
        };
        let life = Arc::new(IncarnationToken::default());
        let mourner = Watcher {
            who: carried.name.clone(),
            incarnation: life,
            outlasts_object: true,
            tell: Box::new(tell),
        };
        registry.watch(carried.component.clone(), mourner);
        Ok(body.recipient())
    }

    /// Hands something to the component; the answer comes back to this body.
    fn hand_over(
        &self,
        (contract, message): (&str, Vec<u8>),
        then: impl FnOnce(Result<Bytes, DeliveryError>) -> Done + Send + 'static,
        context: &mut Context<Self>,
    ) {
        let body = context.address();
        let reply_to: ReplyTo =
            Box::new(move |result| body.do_send(then(result.map(GatherBuffer::into_bytes))));
        match self.registry.skeleton(&self.carried.component, contract) {
            // What came of it is told to the closure in every case.
            Ok((_, doorway)) => {
                let _ =
                    doorway.deliver(&message.into(), MessageMetadata::default(), Some(reply_to));
            }
            Err(why) => reply_to(Err(why)),
        }
    }

    fn execute(&mut self, request: &[u8], save: bool, context: &mut Context<Self>) {
        let refused = |why: DeliveryError, context: &mut Context<Self>| {
            context.address().do_send(Done::Executed { result: Err(why), save: false });
        };
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
                let then = move |result| Done::Executed { result, save };
                self.hand_over((&contract, payload), then, context);
            }
            Err(why) => refused(why, context),
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
                Ok(true) => Done::Loaded,
                Ok(false) => Done::NotLoaded,
                Err(why) if super::takes_nothing(&why) => Done::Gone,
                Err(_) => Done::LoadAgain { state },
            }
        };
        self.hand_over((LoadState::NAME, bytes), then, context);
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
                Some(result) => Done::Both { result, state },
                None => Done::Saved { state },
            }
        };
        self.hand_over((SaveState::NAME, bytes), then, context);
    }

    fn tell(&mut self, to: &NodeName, message: Bytes) {
        if message.len() > MESSAGE_MAX {
            let detail = "a reply is too large to be kept for the standbys: let it be smaller";
            return self.declare(FaultKind::CheckFailed, detail);
        }
        if !self.others.contains_key(to) {
            let name = format!("{to}:{}", self.carried.name);
            let Ok(sender) = self.registry.sender::<ReplicaSays>(&name) else { return };
            self.others.insert(to.clone(), sender);
        }
        if let Some(other) = self.others.get(to) {
            let from = self.carried.config.own.to_string();
            // One that cannot be reached now will be told again.
            let told = other.tell(ReplicaSays { from, message: message.into() });
            let kept_out =
                told.is_err_and(|refused| matches!(refused.kind, DeliveryError::Isolated { .. }));
            self.machine.handle_sent(to, kept_out);
        }
    }

    /// A fault of the service.
    fn declare(&self, kind: FaultKind, detail: &str) {
        let name = &self.carried.name;
        warn!(service = %name, "{detail}");
        if let Some(faults) = &self.reports.faults {
            let (object, incarnation) =
                (self.carried.body.clone(), crate::runtime::guardian::alive().incarnation);
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
                let primary = primary.as_ref().map_or("nobody", NodeName::as_str);
                info!(service = %name, primary, in_step, "this node stands by");
                None
            }
        };
        let before = self.roster.role(name);
        self.roster.note(name, role.clone());
        self.tell_all_who_serves();
        if matches!(before, Some(Role::Primary { .. })) || epoch.is_some() {
            self.tell_role(context);
        }
    }

    fn tell_all_who_serves(&mut self) {
        for question in std::mem::take(&mut self.wondering) {
            self.tell_who_serves(question);
        }
    }

    /// Shows people what is known of the service now.
    pub(super) fn show(&self) {
        self.roster.show(&self.carried.name, self.machine.view(), platform::now());
    }

    /// Under which epoch it serves, as was told last, or somebody does.
    fn epoch(&self) -> u64 {
        match self.roster.role(&self.carried.name) {
            Some(Role::Primary { epoch }) => epoch,
            _ => self.machine.view().epoch,
        }
    }

    /// Answers at once where somebody serves, or nobody may, else as soon as anybody does.
    fn tell_who_serves(&mut self, Wondered(question, answer): Wondered) {
        let config = &self.carried.config;
        let primary = self.roster.primary(&self.carried.name, &config.own);
        let primary = primary.map(|node| node.to_string());
        let disputed = self.machine.dispute().map(str::to_owned);
        let known = disputed.is_some() || primary.is_some() && primary != question.besides;
        if !known && self.wondering.len() >= WONDERING_MAX {
            // Those whose deadline has passed.
            self.wondering.retain(|Wondered(_, answer)| answer.is_wanted());
        }
        if !known && self.wondering.len() < WONDERING_MAX {
            return self.wondering.push_back(Wondered(question, answer));
        }
        let keeps = config.kind != StandbyKind::Cold;
        let members = config.members.iter().map(NodeName::to_string).collect();
        answer.give(Serving { primary, epoch: self.epoch(), keeps, members, disputed });
    }

    /// The component is to know whether it serves.
    fn tell_role(&self, context: &mut Context<Self>) {
        let epoch = match self.roster.role(&self.carried.name) {
            Some(Role::Primary { epoch }) => Some(epoch),
            _ => None,
        };
        let mut bytes = Vec::new();
        // A number always fits.
        let _ = codec::encode(&RoleChanged { epoch }, &mut bytes);
        self.hand_over((RoleChanged::NAME, bytes), |told| Done::Told(told.map(drop)), context);
    }

    /// Asks in a while whether the component takes something again.
    fn look_again(&mut self, context: &mut Context<Self>) {
        if !std::mem::replace(&mut self.looking, true) {
            context.run_later(LOOK_AGAIN, |body, context| {
                body.looking = false;
                body.tell_role(context);
            });
        }
    }

    /// Waits for the others that this service needs; there is one inquiry at a time.
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
        let told = |(), body: &mut Self, context: &mut Context<Self>| {
            body.inquiry = None;
            body.machine.handle_ready(platform::now());
            body.drive(context);
        };
        self.inquiry = Some(context.spawn(actix::fut::wrap_future::<_, Self>(served).map(told)));
    }
}

impl MachineActor for ReplicaBody {
    type Machine = Replica;

    fn driven(&mut self) -> (&mut Replica, &mut WakeTimer) {
        (&mut self.machine, &mut self.wake)
    }

    fn carry_out(&mut self, output: ReplicaOutput, context: &mut Context<Self>) {
        let shows = matches!(
            output,
            ReplicaOutput::Became(_)
                | ReplicaOutput::Fault { .. }
                | ReplicaOutput::Mended { .. }
                | ReplicaOutput::Disputed { .. }
                | ReplicaOutput::Agreed
        );
        if shows {
            self.show();
        }
        match output {
            ReplicaOutput::Send { to, message } => self.tell(&to, message),
            ReplicaOutput::Became(role) => self.became(&role, context),
            ReplicaOutput::Execute { request, save } => self.execute(&request, save, context),
            ReplicaOutput::Save => self.save(None, context),
            ReplicaOutput::Load { state } => self.load(state, context),
            ReplicaOutput::Fault { kind, detail } => self.declare(kind, &detail),
            ReplicaOutput::Mended { kind } => self.mend(kind),
            ReplicaOutput::Disputed { detail } => {
                self.declare(FaultKind::ContractMismatch, &detail);
                self.tell_all_who_serves();
            }
            ReplicaOutput::Agreed => self.mend(FaultKind::ContractMismatch),
            ReplicaOutput::Compare { with } => self.compare(with, context),
            ReplicaOutput::Inquire => self.inquire(context),
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

answers_the_monitor!(ReplicaBody);

impl Actor for ReplicaBody {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.show();
        self.look_around(context);
        self.drive(context);
    }
}

impl Supervised for ReplicaBody {
    /// It has forgotten what it knew, and comes into step like one whose process began anew.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.machine = self.machine.begun_anew(platform::now());
        // The component lives on, but nobody knows any more what it has done.
        self.machine.handle_component_died(platform::now());
        self.looking = false;
        self.wake = WakeTimer::default();
        self.callers.clear();
        self.wondering.clear();
        self.inquiry = None;
        let nobody = Role::Standby { primary: None, in_step: false };
        self.became(&nobody, context);
        self.started(context);
    }
}

/// Another replica says something.
impl Handler<Spoken<ReplicaSays>> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, spoken: Spoken<ReplicaSays>, context: &mut Context<Self>) {
        let Spoken { by, message: says, answer } = spoken;
        answer.give(());
        match by {
            Some(from) => self.machine.handle_message(&from, &says.message, platform::now()),
            None => self.machine.handle_forged(),
        }
        self.drive(context);
    }
}

/// Somebody asks for the service.
#[derive(Message)]
#[rtype(result = "()")]
struct Asked(AskService, Responder<AskService>);

impl Handler<Asked> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, Asked(ask, answer): Asked, context: &mut Context<Self>) {
        let AskService { sender, sequence, settled, since, task } = ask;
        if matches!(self.machine.role(), Role::Primary { epoch } if epoch < since) {
            // This life has not met those who know better.
            return answer.give(Answered::Elsewhere { primary: None });
        }
        let mut request = Vec::new();
        if codec::encode_bounded(&task, TASK_MAX, &mut request).is_err() {
            let why = encode_kind(&DeliveryError::TooLarge { limit: TASK_MAX });
            return answer.give(Answered::Refused { why });
        }
        self.next += 1;
        let until = answer.until();
        self.callers.insert(self.next, answer);
        let asked = ServiceRequest {
            caller: self.next,
            id: MessageId { sender, sequence },
            settled,
            until,
            request: request.into(),
        };
        self.machine.handle_request(asked, platform::now());
        self.drive(context);
    }
}

/// Somebody wants to know who serves.
#[derive(Message)]
#[rtype(result = "()")]
struct Wondered(WhoServes, Responder<WhoServes>);

impl Handler<Wondered> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, wondered: Wondered, _: &mut Context<Self>) {
        self.tell_who_serves(wondered);
    }
}

/// A life of the component has ended.
#[derive(Message)]
#[rtype(result = "()")]
struct Died;

impl Handler<Died> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, _: Died, context: &mut Context<Self>) {
        self.machine.handle_component_died(platform::now());
        // Its next life knows nothing.
        self.tell_role(context);
        self.drive(context);
    }
}

/// The component has done something.
#[derive(Message)]
#[rtype(result = "()")]
enum Done {
    Executed {
        result: Result<Bytes, DeliveryError>,
        save: bool,
    },
    Both {
        result: Result<Bytes, DeliveryError>,
        state: Result<Bytes, DeliveryError>,
    },
    Saved {
        state: Result<Bytes, DeliveryError>,
    },
    Loaded,
    /// It could not, and has said so.
    NotLoaded,
    /// It takes nothing, and has not loaded the state either.
    Gone,
    LoadAgain {
        state: Bytes,
    },
    /// It knows its role, or why not.
    Told(Result<(), DeliveryError>),
}

impl Handler<Done> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, done: Done, context: &mut Context<Self>) {
        let now = platform::now();
        match done {
            Done::Executed { result: Ok(reply), save: true } => {
                return self.save(Some(Ok(reply)), context);
            }
            Done::Executed { result, .. } => {
                if let Err(DeliveryError::Stopped | DeliveryError::Isolated { .. }) = result {
                    self.look_again(context);
                }
                self.machine.handle_executed(result, None, now);
            }
            Done::Both { result, state } => {
                self.machine.handle_executed(result, Some(state), now);
            }
            Done::Saved { state } => self.machine.handle_saved(state, now),
            Done::Loaded => self.machine.handle_loaded(),
            Done::NotLoaded => self.machine.handle_not_loaded(now),
            Done::Gone => {
                self.machine.handle_not_loaded(now);
                self.machine.handle_component_gone(now);
                self.look_again(context);
            }
            Done::LoadAgain { state } => {
                context.run_later(LOAD_AGAIN, move |body, context| body.load(state, context));
                return;
            }
            Done::Told(Ok(())) => self.machine.handle_component_back(now),
            Done::Told(Err(why)) if super::takes_nothing(&why) => {
                self.machine.handle_component_gone(now);
                self.look_again(context);
            }
            Done::Told(Err(_)) => return,
        }
        self.drive(context);
    }
}
