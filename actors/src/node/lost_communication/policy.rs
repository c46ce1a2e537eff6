//! The description of a policy for lost communication.

use crate::actuator::table::{DeclaredActuator, FieldError, FieldTexts};
use crate::actuator::{ActuatorKey, ActuatorTable};
use crate::component::Component;
use crate::component::environment::ComponentEnvironment;
use crate::condition::{ConditionError, Connected};
use crate::host::spec::ChildSpec;
use crate::node::conditions::{NodeSlot, keep_while};
use crate::node::error::PolicyPart;
use crate::registry::encoding::encoded;
use crate::settings::LAST_RUNG_AFTER;
use blastema_core::connection::LostCommunicationEnd;
use blastema_core::suggestion::nearest;
use blastema_core::{Contract, NodeName, ObjectName};
use bytes::Bytes;
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fmt;
use std::pin::Pin;
use std::time::Duration;
use tokio::sync::watch;

/// Runs a component of the node while the ladder stands at the rung of this place.
type RunFn = Box<
    dyn FnOnce(NodeSlot, watch::Receiver<Option<usize>>, usize) -> Pin<Box<dyn Future<Output = ()>>>
        + Send,
>;

/// What a robot does when it loses a commander: a ladder in time, given to
/// [`NodeBuilder::lost_communication`](crate::NodeBuilder::lost_communication).
///
/// ```
/// use blastema::prelude::*;
/// use blastema::{ActuatorSpec, Connected, LostCommunicationPolicy, Rung};
/// use std::time::Duration;
///
/// #[derive(Clone, Debug, Request)]
/// #[contract(name = "wheels/drive", reply = ())]
/// struct Drive(f32);
///
/// struct Wheels;
/// impl Component for Wheels {
///     fn ports(ports: &mut Ports<Self>) {
///         ports.actuator(ActuatorSpec::new(Drive(0.0), Duration::from_millis(250)));
///     }
/// }
/// impl Handle<Drive> for Wheels {
///     async fn handle(&mut self, _: Drive, _: &mut Context<Self>) {}
/// }
///
/// /// Drives the robot back to its dock.
/// struct Return;
/// impl Component for Return {}
///
/// let policy = LostCommunicationPolicy::new("operator", Connected::heartbeat("operator/beat"))
///     .after(Duration::from_secs(1), Rung::command("hold", "wheels", Drive(0.0)))
///     .after(Duration::from_secs(10), Rung::run("return", || ChildSpec::new("return", || Return)))
///     .after(Duration::from_secs(60), Rung::command("stop", "wheels", Drive(0.0)));
/// let builder = Node::builder("rover")
///     .child(ChildSpec::new("wheels", || Wheels))
///     .lost_communication(policy);
/// # blastema::run(async {
/// let node = builder.start().await?;
/// assert_eq!(node.lost_communication()[0].rung, None);
/// # node.shutdown().await;
/// # Ok::<(), StartError>(())
/// # })?;
/// # Ok::<(), StartError>(())
/// ```
#[derive(Debug)]
#[must_use = "a policy does nothing until it is given to a node"]
pub struct LostCommunicationPolicy {
    pub(super) name: String,
    pub(super) needs: Connected,
    pub(super) commander: Option<String>,
    pub(super) rungs: Vec<(Duration, Rung)>,
    pub(super) end: LostCommunicationEnd,
}

/// Why a policy cannot work: the part that is wrong, and what to write.
pub(super) type WrongPart = (PolicyPart, String);

/// One step of the ladder: commands to actuators, or a component that runs, or both.
pub struct Rung {
    pub(super) name: String,
    pub(super) commands: Vec<RungCommand>,
    /// The component that it runs.
    pub(super) component: Option<String>,
    /// What runs that, until the policy starts.
    pub(super) run: Option<RunFn>,
}

/// Makes the command for an actuator, encoded.
type MakeCommand = Box<dyn Fn(&DeclaredActuator) -> Result<Bytes, Vec<FieldError>> + Send>;

pub(super) struct RungCommand {
    actuator: String,
    contract: Cow<'static, str>,
    command: MakeCommand,
}

impl RungCommand {
    /// The actuator with the command; none where the node has no such actuator.
    pub(super) fn resolved(
        &self,
        table: &ActuatorTable,
    ) -> Option<(ActuatorKey, Result<Bytes, Vec<FieldError>>)> {
        table.command_for(&self.actuator, &self.contract, &self.command)
    }
}

impl fmt::Debug for Rung {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Rung {}", self.name)
    }
}

impl LostCommunicationPolicy {
    /// For how long communication must be back, unless
    /// [`until_stable_for`](Self::until_stable_for) says so.
    pub const STABLE: Duration = Duration::from_secs(5);

    /// A policy for the loss of what is needed: it begins when the condition of this name is lost
    /// after it was connected.
    pub fn new(name: &str, needs: Connected) -> Self {
        let (commander, rungs) = (None, Vec::new());
        let end = LostCommunicationEnd { stable: Self::STABLE, is_acknowledged: false };
        LostCommunicationPolicy { name: name.to_owned(), needs, commander, rungs, end }
    }

    /// Names the node whose commanders are lost: another one, of the roster where there is one.
    /// With the first rung their leases end, also if only the condition was lost; their claims are
    /// refused until the ladder has ended.
    pub fn commander(mut self, node: &str) -> Self {
        self.commander = Some(node.to_owned());
        self
    }

    /// Adds a rung, which begins so long after the loss and ends the one before. Times rise.
    pub fn after(mut self, loss: Duration, rung: Rung) -> Self {
        self.rungs.push((loss, rung));
        self
    }

    /// Sets for how long communication must be back, within its limits, before the ladder ends: 5 s
    /// unless set. A break before that counts from the first loss.
    pub fn until_stable_for(mut self, span: Duration) -> Self {
        self.end.stable = span;
        self
    }

    /// Keeps the rung until a person ends it by [`Node::acknowledge`](crate::Node::acknowledge),
    /// once communication is back.
    pub fn until_acknowledged(mut self) -> Self {
        self.end.is_acknowledged = true;
        self
    }

    /// The actuators that its rungs command, with their contracts.
    fn actuators(&self) -> BTreeSet<(&str, &str)> {
        let commands = self.rungs.iter().flat_map(|(_, rung)| &rung.commands);
        commands.map(|of| (&*of.actuator, &*of.contract)).collect()
    }

    /// The components that its rungs run.
    pub(in crate::node) fn components(&self) -> impl Iterator<Item = &str> {
        self.rungs.iter().filter_map(|(_, rung)| rung.component.as_deref())
    }

    /// Finds what cannot work before anything starts, beside its rungs.
    pub(super) fn check(
        &self,
        node: &NodeName,
        environment: &ComponentEnvironment,
    ) -> Result<(), WrongPart> {
        if self.commander.as_deref() == Some(node.as_str()) {
            let reason = format!("its commander {node} is this node: name the one that is lost");
            return Err((PolicyPart::Commander, reason));
        }
        if self.rungs.is_empty() {
            return Err((PolicyPart::Whole, "it has no rungs: add one by `after`".to_owned()));
        }
        if self.needs.has_commander() {
            let reason = "its condition needs a commander, whose claims are refused until the \
                          ladder ends: let it need a heartbeat, a session or a node";
            return Err((PolicyPart::Whole, reason.to_owned()));
        }
        self.needs.check(&self.name, environment).map_err(|error| match error {
            ConditionError::Refused { place: Some((place, setting)), reason, .. } => {
                (PolicyPart::Need(place, setting), reason)
            }
            ConditionError::Refused { reason, .. } => (PolicyPart::AtLeast, reason),
            error => (PolicyPart::Whole, error.to_string()),
        })
    }

    /// Finds what cannot work of the rung at this place.
    pub(super) fn check_rung(
        &self,
        place: usize,
        environment: &ComponentEnvironment,
    ) -> Vec<WrongPart> {
        let (after, rung) = &self.rungs[place];
        if place > 0 && self.rungs[place - 1].0 >= *after {
            let reason = "its rungs do not rise in time: write the earlier ones first";
            return vec![(PolicyPart::RungTime(place), reason.to_owned())];
        }
        if let Err(error) = LAST_RUNG_AFTER.check(*after) {
            return vec![(PolicyPart::RungTime(place), error.to_string())];
        }
        if place + 1 == self.rungs.len() && rung.component.is_some() {
            let reason = format!(
                "its last rung, {}, runs a component, which may die: let the last one be a command",
                rung.name
            );
            return vec![(PolicyPart::Rung(place), reason)];
        }
        if let Some(name) = &rung.component
            && let Ok(object) = ObjectName::new(name)
            && let Some(kind) = environment.registry.kind_of(&object)
        {
            let rung = &rung.name;
            let reason =
                format!("its rung {rung} runs {name}, and {kind} has that name: rename one");
            return vec![(PolicyPart::Rung(place), reason)];
        }
        rung.check(place, environment.feature::<ActuatorTable>())
    }

    /// Finds what two policies of one node would fight for.
    pub(super) fn check_beside(&self, other: &LostCommunicationPolicy) -> Result<(), WrongPart> {
        let [own, others] = [self, other].map(LostCommunicationPolicy::actuators);
        let shared = own.into_iter().find(|key| others.contains(key));
        let mut components = self.components();
        let component = components.find(|own| other.components().any(|known| known == *own));
        let what = match (shared, &self.commander) {
            _ if self.name == other.name => "its name".to_owned(),
            (Some((actuator, _)), _) => format!("the actuator {actuator}"),
            (None, Some(node)) if self.commander == other.commander => format!("commander {node}"),
            (None, _) => match component {
                Some(component) => format!("the component {component}"),
                None => return Ok(()),
            },
        };
        let other = &other.name;
        let reason = format!(
            "it has {what} in common with the policy {other}: make one policy of both, whose \
             condition needs all that theirs do"
        );
        Err((PolicyPart::Whole, reason))
    }
}

impl Rung {
    /// Commands an actuator of this node until the next rung that commands it, or the end of the
    /// ladder: again and again where its commands count for a while. It is taken from any other
    /// commander.
    pub fn command<M: Contract + Clone>(name: &str, actuator: &str, command: M) -> Self {
        Rung::new(name).and_command(actuator, command)
    }

    /// A rung without commands: they are to be added.
    pub fn new(name: &str) -> Self {
        Rung { name: name.to_owned(), commands: Vec::new(), component: None, run: None }
    }

    /// Commands one more actuator.
    #[must_use]
    pub fn and_command<M: Contract + Clone>(mut self, actuator: &str, command: M) -> Self {
        let command = encoded(&command).map(Bytes::from);
        let command = Box::new(move |_: &_| {
            let refused = |why| vec![FieldError { field: None, why: format!("{why}") }];
            command.clone().map_err(refused)
        });
        let actuator = actuator.to_owned();
        self.commands.push(RungCommand { actuator, contract: M::NAME.into(), command });
        self
    }

    /// Commands one more actuator, whose commands are of this contract, by its safe command with
    /// other values of these fields, each with its unit, as in `0.2 m/s`.
    #[must_use]
    pub fn and_fields(mut self, actuator: &str, contract: &str, fields: &FieldTexts) -> Self {
        let (actuator, contract) = (actuator.to_owned(), contract.to_owned().into());
        let fields = fields.to_vec();
        let command = Box::new(move |of: &DeclaredActuator| (of.with_fields)(&of.safe, &fields));
        self.commands.push(RungCommand { actuator, contract, command });
        self
    }

    /// Runs a component under the root supervisor for as long as the rung lasts, such as one that
    /// drives back, or a tree. It may claim the actuators of the ladder that this rung does not
    /// command. Its ports may be [connected](crate::NodeBuilder::connect) before the node starts.
    pub fn run<C: Component>(name: &str, spec: impl Fn() -> ChildSpec<C> + Send + 'static) -> Self {
        let component = Some(spec().name().to_owned());
        let run: RunFn = Box::new(move |node, ladder, place| {
            let stands = move |rung: &Option<usize>| *rung == Some(place);
            Box::pin(keep_while(node, ladder, stands, None, spec))
        });
        Rung { name: name.to_owned(), commands: Vec::new(), component, run: Some(run) }
    }

    /// Finds what cannot work of it at this place.
    fn check(&self, place: usize, table: &ActuatorTable) -> Vec<WrongPart> {
        let (rung, mut seen, mut wrong) = (&self.name, BTreeSet::new(), Vec::new());
        if self.commands.is_empty() && self.component.is_none() {
            let reason = format!("the rung {rung} does nothing: give it a command");
            return vec![(PolicyPart::Rung(place), reason)];
        }
        for (at, command) in self.commands.iter().enumerate() {
            let part = |field| PolicyPart::Command { rung: place, command: at, field };
            let RungCommand { actuator, contract, .. } = command;
            let Some((key, encoded)) = command.resolved(table) else {
                let rows = table.rows();
                let known = rows.iter().filter(|row| row.contract == *contract);
                let hint = nearest(actuator, known.map(|row| row.object.as_str()));
                let hint = hint.map(|near| format!("; did you mean {near}?")).unwrap_or_default();
                let reason = format!(
                    "the rung {rung} commands {actuator} by `{contract}`, and the node has no \
                     such actuator: name one of its own{hint}"
                );
                wrong.push((part(None), reason));
                continue;
            };
            for FieldError { field, why } in encoded.err().into_iter().flatten() {
                let reason = format!("the command of the rung {rung} to {actuator}: {why}");
                wrong.push((part(field), reason));
            }
            if !seen.insert(key) {
                let reason =
                    format!("the rung {rung} has two commands for {actuator}: leave one out");
                wrong.push((part(None), reason));
            }
        }
        wrong
    }
}
