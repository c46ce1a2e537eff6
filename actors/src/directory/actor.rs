//! The actor of the directory.

use crate::directory::{ClaimCommand, ClaimState, DirectoryTable};
use crate::platform;
use crate::registry::Registry;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use crate::runtime::reports::{FaultReporter, FaultReports};
use crate::topic::{TopicKey, Topics};
use actix::prelude::*;
use blastema_contract::reports::AreYouAlive;
use blastema_contract::router::InjectPanic;
use blastema_contract::session::{DirectoryReport, SendToDirectory};
use blastema_core::directory::{
    ClaimRefused, ClaimRequest, Directory, DirectoryConfig, DirectoryKey, DirectoryOutput,
    NameHeld, UnmetClaims,
};
use blastema_core::net::refusal_alarms::RefusalAlarms;
use blastema_core::net::trust::access::AccessPolicy;
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, NodeName, ObjectName};
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::sync::watch;
use tracing::{error, info, warn};

/// How long a name is kept for a node that no path leads to any more. With the usual hellos that is
/// found within 200 ms, so that the name is free a second after the node has died.
const CLAIM_LEASE: Duration = Duration::from_millis(800);
/// How often it is looked for objects and publishers of this node that came or went.
const OWN_INTERVAL: Duration = Duration::from_millis(200);
/// How often it is looked at what was refused.
const REFUSAL_CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// What a [`DirectoryActor`] is made of.
#[derive(Clone)]
pub(crate) struct DirectorySetup {
    pub(crate) node: NodeName,
    pub(crate) incarnation: Incarnation,
    /// How long nothing is granted after the start.
    pub(crate) settle: Duration,
    /// Nodes after whose word that is over.
    pub(crate) expected: Vec<NodeName>,
    /// The network, once it is started; a node without one has no other to talk to.
    pub(crate) network: Arc<OnceLock<Recipient<SendToDirectory>>>,
    pub(crate) registry: Registry,
    pub(crate) topics: Topics,
    pub(crate) names: DirectoryTable,
    pub(crate) reports: FaultReports,
}

/// A name that is claimed here.
struct Own {
    wanted: ClaimRequest,
    number: u64,
    state_sender: watch::Sender<ClaimState>,
    unattended: bool,
}

pub(crate) struct DirectoryActor {
    setup: DirectorySetup,
    wake: WakeTimer,
    own: SortedMap<ObjectName, Own>,
    /// Claims of components that the roster refuses: made again when there is another.
    forbidden: SortedMap<ObjectName, Own>,
    alarms: RefusalAlarms<NodeName>,
    faults: FaultReporter,
    /// Who goes without a name, and what was said of that last.
    without: UnmetClaims,
    reported_conflict: Option<String>,
    /// As of which revisions of the registry and the topics other nodes know what is here.
    revisions: Option<(u64, u64)>,
    /// How many objects and publishers of this node are not reported to other nodes.
    unsent: usize,
}

/// Where a [`DirectoryActor`] receives its messages.
pub(crate) struct DirectoryRecipients {
    pub(crate) reports: Recipient<DirectoryReport>,
    pub(crate) pings: Recipient<AreYouAlive>,
    #[cfg(test)]
    panic: Recipient<InjectPanic>,
}

impl DirectoryActor {
    /// Starts it under the guardian, and leads those who claim to it.
    pub(crate) fn start(
        setup: DirectorySetup,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> DirectoryRecipients {
        let names = setup.names.clone();
        let mut machine = Directory::new(config(&setup), platform::now());
        if let Some(policy) = setup.registry.access().policy() {
            machine.handle_access((*policy).clone(), platform::now());
        }
        setup.registry.set_name_resolver(Arc::new(names.clone()));
        // The actor may start on its own thread before this one goes on.
        names.begin(machine);
        let make = move |_: &mut Context<Self>| DirectoryActor {
            wake: WakeTimer::default(),
            own: SortedMap::new(),
            forbidden: SortedMap::new(),
            alarms: RefusalAlarms::default(),
            faults: FaultReporter::new(crate::net::named("directory"), setup.reports.clone()),
            without: UnmetClaims::default(),
            reported_conflict: None,
            revisions: None,
            unsent: 0,
            setup,
        };
        let actor = guardian.start(crate::net::named("directory"), arbiter, make);
        names.lead_to(actor.clone().recipient());
        DirectoryRecipients {
            #[cfg(test)]
            panic: actor.clone().recipient(),
            reports: actor.clone().recipient(),
            pings: actor.recipient(),
        }
    }

    fn tell(&self, name: &ObjectName, state: ClaimState) {
        if let Some(own) = self.own.get(name) {
            own.state_sender.send_if_modified(|sent| {
                let new = *sent != state;
                *sent = state;
                new
            });
        }
    }

    /// The claim is over, and its claimant is told why.
    fn end(&mut self, name: &ObjectName, state: ClaimState) {
        self.tell(name, state);
        self.own.remove(name);
    }

    /// As it is now.
    fn say_who_goes_without(&mut self) {
        match self.without.text() {
            Some(text) if self.reported_conflict.as_ref() != Some(&text) => {
                self.reported_conflict = Some(text.clone());
                error!("{text}");
                self.faults.declare(FaultKind::NameTaken, text);
            }
            None if self.reported_conflict.take().is_some() => {
                self.faults.clear(FaultKind::NameTaken);
            }
            Some(_) | None => {}
        }
    }

    /// A claim is granted, or given back.
    fn has_its_name(&mut self, name: &ObjectName, number: u64) {
        self.without.handle_end(name, number);
        self.say_who_goes_without();
    }

    fn refused(&mut self, name: &ObjectName, refused: ClaimRefused) {
        warn!(%name, "a claim is refused: {refused}");
        if let Some(own) = self.own.get(name).filter(|own| own.unattended) {
            let object = own.wanted.object.clone();
            self.without.handle_refused(name.clone(), own.number, object, &refused);
            self.say_who_goes_without();
        }
        let is_forbidden = matches!(refused, ClaimRefused::Forbidden { .. });
        self.tell(name, ClaimState::Refused(refused));
        if let Some(own) = self.own.remove(name).filter(|own| own.unattended && is_forbidden) {
            self.forbidden.insert(name.clone(), own);
        }
    }

    fn forget_forbidden(&mut self, name: &ObjectName, number: u64) {
        if self.forbidden.get(name).is_some_and(|own| own.number == number) {
            self.forbidden.remove(name);
        }
    }

    fn claim(&mut self, own: Own) {
        let (name, wanted) = (own.wanted.name.clone(), own.wanted.clone());
        self.own.insert(name.clone(), own);
        let now = platform::now();
        let claimed = self.setup.names.change(|machine| machine.handle_claim(wanted, now));
        if let Err(refused) = claimed {
            self.refused(&name, refused);
        }
    }

    /// Tells other nodes which objects and publishers there are here, if they have changed.
    fn look_at_own(&mut self) {
        let DirectorySetup { registry, topics, .. } = &self.setup;
        let revisions = Some((registry.revision(), topics.revision()));
        if std::mem::replace(&mut self.revisions, revisions) == revisions {
            return;
        }
        let objects = registry.objects().into_iter().map(|(name, _)| DirectoryKey::Object(name));
        let publishers = topics.published().into_iter().map(|TopicKey { topic, contract }| {
            DirectoryKey::Publisher { topic, contract: contract.to_string() }
        });
        let present = objects.chain(publishers).collect();
        let unsent = self.setup.names.change(|machine| machine.handle_present(present));
        if unsent > self.unsent {
            warn!(unsent, "other nodes are not told of objects and publishers: there are too many");
        }
        self.unsent = unsent;
    }

    /// The policy of the robot is another: what it had forbidden is claimed again.
    fn take_policy(&mut self, policy: AccessPolicy, context: &mut Context<Self>) {
        self.setup.names.change(|machine| machine.handle_access(policy, platform::now()));
        self.drive(context);
        for (name, own) in std::mem::take(&mut self.forbidden) {
            match self.own.contains_key(&name) {
                // Another component has it by now.
                true => drop(self.forbidden.insert(name, own)),
                false => self.claim(own),
            }
        }
    }

    /// Raises an alarm for a node whose messages are refused for seconds.
    fn look_at_refusals(&mut self) {
        let alarms = &mut self.alarms;
        let raised = self.setup.names.read(|machine| {
            let refusals = machine.refusals().map(|(node, refusals)| (node.clone(), refusals));
            alarms.handle_look(refusals)
        });
        for (node, since) in raised {
            let detail = format!("what {node} says that it has is refused all the time: {since}");
            self.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }
}

fn config(setup: &DirectorySetup) -> DirectoryConfig {
    DirectoryConfig {
        node: setup.node.clone(),
        incarnation: setup.incarnation,
        lease: CLAIM_LEASE,
        settle: setup.settle,
        expected: setup.expected.iter().cloned().collect(),
    }
}

answers_the_monitor!(DirectoryActor);

impl Actor for DirectoryActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.run_interval(REFUSAL_CHECK_INTERVAL, |actor, _| actor.look_at_refusals());
        context.run_interval(OWN_INTERVAL, |actor, context| {
            actor.look_at_own();
            actor.drive(context);
        });
        self.look_at_own();
        self.drive(context);
    }
}

impl Supervised for DirectoryActor {
    /// What is claimed here, and what others have told, stays so.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.setup.names.rebuild();
        self.revisions = None;
        self.wake = WakeTimer::default();
        self.started(context);
        // The panic may have lost the word that a claim is over: it is made again, and answered.
        let names = self.setup.names.clone();
        let ended = |name: &&ObjectName| !names.read(|machine| machine.is_claimed_here(name));
        let ended: Vec<_> = self.own.keys().filter(ended).cloned().collect();
        for own in ended.iter().filter_map(|name| self.own.remove(name)).collect::<Vec<_>>() {
            self.claim(own);
        }
        self.drive(context);
    }
}

impl MachineActor for DirectoryActor {
    type Machine = DirectoryTable;

    fn driven(&mut self) -> (&mut DirectoryTable, &mut WakeTimer) {
        (&mut self.setup.names, &mut self.wake)
    }

    fn carry_out(&mut self, output: DirectoryOutput, _: &mut Context<Self>) {
        match output {
            DirectoryOutput::Send { to: node, message } => {
                if let Some(network) = self.setup.network.get() {
                    network.do_send(SendToDirectory { node, message });
                }
            }
            DirectoryOutput::Granted { name, epoch } => {
                info!(%name, epoch, "a name is ours");
                self.tell(&name, ClaimState::Held { epoch });
                if let Some(number) = self.own.get(&name).map(|own| own.number) {
                    self.has_its_name(&name, number);
                }
            }
            DirectoryOutput::StandsBy { name } => self.tell(&name, ClaimState::StandsBy),
            DirectoryOutput::Refused { name, refused } => self.refused(&name, refused),
            DirectoryOutput::AccessDenied { denied } => {
                self.setup.registry.access().record(*denied)
            }
            DirectoryOutput::Lost { name, to, epoch, stands_by } => {
                let what = if stands_by {
                    "it stands by for it from now on"
                } else {
                    "it is to claim another, or to stand by"
                };
                let detail = format!(
                    "the name {name} is lost to {to}, whose claim {epoch} is the later one of two \
                     that were made out of each other's sight; {what}"
                );
                error!("{detail}");
                // Each of the two knows it now, and what becomes of it.
                self.faults.declare_passing(FaultKind::NameTaken, detail);
                match stands_by {
                    true => self.tell(&name, ClaimState::StandsBy),
                    false => self.end(&name, ClaimState::Lost { to, epoch }),
                }
            }
            DirectoryOutput::Held { name, holder } => {
                self.without.handle_holder(&name, holder.as_ref());
                self.say_who_goes_without();
                self.setup.names.holder_changed();
            }
        }
    }
}

impl Handler<ClaimCommand> for DirectoryActor {
    type Result = ();

    fn handle(&mut self, wish: ClaimCommand, context: &mut Context<Self>) {
        match wish {
            ClaimCommand::Claim { wanted, number, state_sender, unattended } => {
                let name = wanted.name.clone();
                match self.own.get(&name) {
                    // The next incarnation of the same component.
                    Some(own) if own.number == number => return,
                    Some(Own { wanted: own, .. }) => {
                        let other = own.object.clone();
                        let holder = self.setup.node.clone();
                        let epoch = self
                            .setup
                            .names
                            .read(|machine| machine.holder(&name))
                            .map_or(0, |held| held.epoch);
                        let held = NameHeld { name, holder, epoch };
                        if unattended {
                            let (name, object) = (held.name.clone(), wanted.object);
                            self.without.handle_doubled(name, number, object, &other);
                            self.say_who_goes_without();
                        }
                        state_sender.send_replace(ClaimState::Refused(held.into()));
                        return;
                    }
                    None => {}
                }
                self.forget_forbidden(&name, number);
                self.claim(Own { wanted, number, state_sender, unattended });
            }
            ClaimCommand::Withdraw { name, number } => {
                self.forget_forbidden(&name, number);
                if self.own.get(&name).is_some_and(|own| own.number == number) {
                    self.own.remove(&name);
                    let now = platform::now();
                    self.setup.names.change(|machine| machine.handle_withdrawn(&name, now));
                }
                // Also of one that was refused, and goes without.
                self.has_its_name(&name, number);
            }
        }
        self.drive(context);
    }
}

impl Handler<DirectoryReport> for DirectoryActor {
    type Result = ();

    fn handle(&mut self, report: DirectoryReport, context: &mut Context<Self>) {
        let (now, names) = (platform::now(), self.setup.names.clone());
        match report {
            DirectoryReport::Opened { node, incarnation } => {
                self.look_at_own();
                names.change(|machine| machine.handle_opened(node, incarnation, now));
            }
            DirectoryReport::Reachable { node } => {
                names.change(|machine| machine.handle_reachable(&node, now));
            }
            DirectoryReport::Unreachable { node } => {
                names.change(|machine| machine.handle_unreachable(&node, now));
            }
            DirectoryReport::Ended { node } => {
                names.change(|machine| machine.handle_ended(&node, now));
            }
            DirectoryReport::Left { node } => {
                names.change(|machine| machine.handle_left(&node, now));
            }
            DirectoryReport::Said { node, message } => {
                names.change(|machine| machine.handle_message(&node, &message, now));
            }
            DirectoryReport::Policy(policy) => self.take_policy(*policy, context),
        }
        self.drive(context);
    }
}

impl Handler<InjectPanic> for DirectoryActor {
    type Result = ();

    fn handle(&mut self, _: InjectPanic, _: &mut Context<Self>) {
        panic!("the directory panics on purpose");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directory::Claim;
    use crate::messaging::dead_letters::DeadLetterLog;
    use crate::registry::remote::NameResolver;
    use blastema_contract::reports::{DeclaredFaultCleared, FaultDeclared};
    use blastema_core::Machine;
    use blastema_core::directory::ClaimPolicy;
    use blastema_doubles::{Probe, advance, settle};

    fn wanted() -> ClaimRequest {
        ClaimRequest::new(ObjectName::new("map").unwrap(), ClaimPolicy::Refuse)
    }

    fn setup(names: &DirectoryTable) -> DirectorySetup {
        DirectorySetup {
            node: NodeName::new("a").unwrap(),
            incarnation: Incarnation(1),
            settle: Duration::ZERO,
            expected: Vec::new(),
            network: Arc::default(),
            registry: Registry::default(),
            topics: Topics::new(DeadLetterLog::default(), FaultReports::default()),
            names: names.clone(),
            reports: FaultReports::default(),
        }
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn that_a_component_goes_without_its_name_is_over_when_it_has_it() {
        let (declared, cleared) =
            (Probe::<FaultDeclared>::start(), Probe::<DeclaredFaultCleared>::start());
        let (faults, over) = (Some(declared.recipient()), Some(cleared.recipient()));
        let reports = FaultReports { faults, cleared: over, ..FaultReports::default() };
        let names = DirectoryTable::default();
        let setup = DirectorySetup { reports, ..setup(&names) };
        let _ports = DirectoryActor::start(setup, &Guardian::default(), None);
        let claim = Claim::make(&names, wanted()).await.unwrap();

        drop(names.claim(wanted(), 98, true));
        assert_eq!(declared.expect().await.kind, FaultKind::NameTaken);
        cleared.expect_none_for(Duration::from_secs(100)).await;
        drop(claim);
        drop(names.claim(wanted(), 99, true));
        cleared.expect_none_for(Duration::from_secs(100)).await;
        names.withdraw(&wanted().name, 99);
        // The next incarnation of the one that was refused.
        drop(names.claim(wanted(), 98, true));

        assert_eq!(cleared.expect().await.kind, FaultKind::NameTaken);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn that_a_component_goes_without_its_name_is_over_when_it_is_removed() {
        let cleared = Probe::<DeclaredFaultCleared>::start();
        let names = DirectoryTable::default();
        let over = Some(cleared.recipient());
        let reports = FaultReports { cleared: over, ..FaultReports::default() };
        let setup = DirectorySetup { reports, ..setup(&names) };
        let _ports = DirectoryActor::start(setup, &Guardian::default(), None);
        let _claim = Claim::make(&names, wanted()).await.unwrap();
        drop(names.claim(wanted(), 98, true));
        drop(names.claim(wanted(), 99, true));

        names.withdraw(&wanted().name, 98);
        cleared.expect_none_for(Duration::from_secs(100)).await;
        names.withdraw(&wanted().name, 99);

        assert_eq!(cleared.expect().await.kind, FaultKind::NameTaken);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn what_is_claimed_outlives_a_panic_of_those_who_keep_it() {
        let names = DirectoryTable::default();
        let setup = setup(&names);
        let ports = DirectoryActor::start(setup, &Guardian::default(), None);
        let claim = Claim::make(&names, wanted()).await.unwrap();
        let epoch = claim.epoch().unwrap();

        ports.panic.do_send(InjectPanic);
        settle().await;

        assert_eq!(claim.epoch(), Some(epoch));
        assert_eq!(names.holder(claim.name()).unwrap().epoch, epoch);
        assert!(Claim::make(&names, wanted()).await.is_err(), "it has it still");
        drop(claim);
        advance(CLAIM_LEASE).await;
        assert_eq!(names.rows(), []);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_claimant_whose_claim_was_lost_in_a_panic_learns_how_it_stands() {
        let names = DirectoryTable::default();
        let ports = DirectoryActor::start(setup(&names), &Guardian::default(), None);
        let claim = Claim::make(&names, wanted()).await.unwrap();
        let node = NodeName::new("b").unwrap();
        let incarnation = Incarnation(9);
        let b = DirectorySetup { node: node.clone(), incarnation, ..setup(&names) };
        let now = platform::now();
        let mut b = Directory::new(config(&b), now);
        b.handle_claim(wanted(), now).unwrap();
        b.handle_opened(NodeName::new("a").unwrap(), Incarnation(1), now);

        // What comes of it is not carried out before the panic.
        names.change(|machine| {
            machine.handle_opened(node.clone(), incarnation, now);
            while let Some(output) = b.poll_output() {
                if let DirectoryOutput::Send { message, .. } = output {
                    machine.handle_message(&node, &message, now);
                }
            }
        });
        ports.panic.do_send(InjectPanic);
        settle().await;

        assert_eq!(names.holder(claim.name()).unwrap().node, node);
        let refused = matches!(claim.state(), ClaimState::Refused(ClaimRefused::Held(_)));
        assert!(refused, "{claim:?}");
    }
}
