//! The supervision tree as it is described, and how it is prepared.

use crate::component::Component;
use crate::component::environment::ComponentEnvironment;
use crate::component::spec_error::SpecError;
use crate::fault_chain::detection::DetectionActor;
use crate::fault_chain::supervisor::directory::SupervisorDirectory;
use crate::fault_chain::supervisor::{
    SupervisorActor, SupervisorChild, SupervisorNeighbours, SupervisorSetup,
};
use crate::host::spec::ChildSpec;
use crate::runtime::guardian::Guardian;
use crate::settings::{INTENSITY, SettingError, intensity_period};
use actix::{Addr, ArbiterHandle, Recipient};
use blastema_contract::child::Child;
use blastema_contract::reports::AreYouAlive;
use blastema_core::ObjectName;
use blastema_core::recovery::{ChildRules, Plan, Restart, Strategy, SupervisorRules, WhenExceeded};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// A supervisor and what stands below it.
///
/// ```
/// use blastema::prelude::*;
/// use std::time::Duration;
/// # struct Motors; impl Component for Motors {}
/// # struct Planner; impl Component for Planner {}
///
/// let drive = SupervisorSpec::new("drive", Strategy::RestForOne)
///     .intensity(3, Duration::from_secs(10))
///     .child(ChildSpec::new("drive/motors", || Motors))
///     .child(ChildSpec::new("drive/planner", || Planner));
/// ```
#[must_use = "a supervisor spec does nothing until it is given to a node or another supervisor"]
pub struct SupervisorSpec {
    name: String,
    rules: SupervisorRules,
    /// How its own supervisor keeps it.
    kept: ChildRules,
    children: Vec<Subtree>,
}

/// A child of a supervisor as it is described: a component, or a supervisor and all below it. A
/// component is permanent unless its restart type is given with it.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::Subtree;
/// # struct Lamp; impl Component for Lamp {}
///
/// let lamp = Subtree::from(ChildSpec::new("lamp", || Lamp));
/// let spare = Subtree::from((ChildSpec::new("spare", || Lamp), Restart::Temporary));
/// let lamps = Subtree::from(SupervisorSpec::new("lamps", Strategy::OneForOne));
/// ```
#[must_use = "a subtree does nothing until it is added to a node"]
pub struct Subtree(Entry);

enum Entry {
    Component(PrepareComponent, Restart),
    Supervisor(SupervisorSpec),
}

/// Gives a component of whatever type its name and ports.
type PrepareComponent =
    Box<dyn FnOnce(&Arc<ComponentEnvironment>) -> Result<PreparedComponent, Vec<SpecError>> + Send>;

/// A component that waits to be started, what it depends on, and the rules that its spec gives.
type PreparedComponent = (Box<dyn Child>, Vec<String>, ChildRules);

impl fmt::Debug for Subtree {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Entry::Component(_, restart) => write!(f, "a component ({restart:?})"),
            Entry::Supervisor(spec) => write!(f, "{spec:?}"),
        }
    }
}

impl<C: Component> From<(ChildSpec<C>, Restart)> for Subtree {
    fn from((spec, restart): (ChildSpec<C>, Restart)) -> Self {
        let prepare = move |environment: &Arc<ComponentEnvironment>| {
            let depends_on = spec.dependencies().to_vec();
            let (ready_within, shutdown_within) = spec.deadlines();
            let essential = spec.is_essential();
            let rules = ChildRules::guarded(ready_within, shutdown_within);
            let (child, _) = spec.into_child(environment)?;
            Ok((child, depends_on, ChildRules { essential, ..rules }))
        };
        Subtree(Entry::Component(Box::new(prepare), restart))
    }
}

impl<C: Component> From<ChildSpec<C>> for Subtree {
    fn from(spec: ChildSpec<C>) -> Self {
        Subtree::from((spec, Restart::Permanent))
    }
}

impl From<SupervisorSpec> for Subtree {
    fn from(spec: SupervisorSpec) -> Self {
        Subtree(Entry::Supervisor(spec))
    }
}

impl Subtree {
    /// Gives everything its name and ports. What is wrong is found in the tree then, and there may
    /// be no child.
    pub(super) fn prepare(
        self,
        tree_environment: &TreeEnvironment<'_>,
        tree: &mut PreparedTree,
    ) -> Option<(Box<dyn Child>, ChildRules)> {
        match self.0 {
            Entry::Component(prepare, restart) => {
                let (child, depends_on, rules) = match prepare(tree_environment.environment) {
                    Ok(prepared) => prepared,
                    Err(refused) => {
                        tree.refused.extend(refused);
                        return None;
                    }
                };
                let name = child.name().clone();
                let on_the_spot = tree_environment.plan.restarts_on_the_spot(&name);
                tree.components.push(ComponentFacts { name, depends_on, restart });
                Some((child, ChildRules { restart, on_the_spot, ..rules }))
            }
            Entry::Supervisor(spec) => {
                let kept = spec.kept;
                match spec.prepare(tree_environment, tree) {
                    Ok(child) => Some((Box::new(child), kept)),
                    Err(error) => {
                        tree.refused.push(error);
                        None
                    }
                }
            }
        }
    }
}

impl fmt::Debug for SupervisorSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let children = self.children.len();
        write!(f, "{} ({:?}, {children} children)", self.name, self.rules.strategy)
    }
}

impl SupervisorSpec {
    /// A supervisor without children, which allows three restarts of each in ten seconds.
    pub fn new(name: &str, strategy: Strategy) -> Self {
        let rules = SupervisorRules { strategy, ..SupervisorRules::default() };
        let (name, kept) = (name.to_owned(), ChildRules::supervisor());
        SupervisorSpec { name, rules, kept, children: Vec::new() }
    }

    /// Sets how many restarts are allowed in one `period`: of each child, or of all together where
    /// the strategy is not [`OneForOne`](Strategy::OneForOne) or
    /// [`when_exceeded`](Self::when_exceeded) requires it. 1000 times at most; the period has at
    /// least 1 ms for each of them.
    pub fn intensity(mut self, times: u32, period: Duration) -> Self {
        (self.rules.intensity, self.rules.period) = (times, period);
        self
    }

    /// Sets what happens when restarts exceed the [`intensity`](Self::intensity). By default the
    /// child is stopped and its siblings continue.
    pub fn when_exceeded(mut self, when_exceeded: WhenExceeded) -> Self {
        self.rules.when_exceeded = when_exceeded;
        self
    }

    /// Makes its first start one operation, which completes or is undone: as soon as the plan has
    /// given up a child that cannot be started, all children end in reverse order, and the parent
    /// of the supervisor is informed. The parent of the root is the node:
    /// [`NodeBuilder::start`](crate::NodeBuilder::start) fails with the reason. A
    /// [temporary](Restart::Temporary) child may be missing; one that waits for
    /// [what is not there yet](crate::Failure::unavailable) has been started.
    pub fn whole_start(mut self) -> Self {
        self.rules.whole_start = true;
        self
    }

    /// Its own supervisor cannot do without it: see [`ChildSpec::essential`].
    pub fn essential(mut self) -> Self {
        self.kept.essential = true;
        self
    }

    /// Sets how long the children may take to start together. Unlimited by default: each child has
    /// a deadline of its own. A supervisor that takes longer has failed to start, which is a fault
    /// of it.
    pub fn ready_within(mut self, span: Duration) -> Self {
        self.kept.ready_within = span;
        self
    }

    /// Sets how long the children may take to stop together, before they are abandoned. Unlimited
    /// by default: each child has a deadline of its own.
    pub fn shutdown_within(mut self, span: Duration) -> Self {
        self.kept.shutdown_within = span;
        self
    }

    /// Adds a permanent child: every end is followed by a restart. Children start in the order in
    /// which they are added.
    pub fn child<C: Component>(self, spec: ChildSpec<C>) -> Self {
        self.child_with(spec, Restart::Permanent)
    }

    /// Adds a child with this restart type.
    pub fn child_with<C: Component>(mut self, spec: ChildSpec<C>, restart: Restart) -> Self {
        self.children.push(Subtree::from((spec, restart)));
        self
    }

    /// Adds a supervisor as a child.
    pub fn supervisor(mut self, spec: SupervisorSpec) -> Self {
        self.children.push(Subtree::from(spec));
        self
    }

    /// It is called `root`, and its end is the node's safe state.
    pub(super) fn rooted(mut self) -> Self {
        self.rules.root = true;
        "root".clone_into(&mut self.name);
        self
    }
}

/// What preparation needs of the node.
pub(super) struct TreeEnvironment<'a> {
    pub(super) environment: &'a Arc<ComponentEnvironment>,
    pub(super) guardian: &'a Guardian,
    pub(super) arbiter: Option<&'a ArbiterHandle>,
    pub(super) monitor: Addr<DetectionActor>,
    pub(super) directory: SupervisorDirectory,
    pub(super) plan: &'a Plan,
    /// The first start of each supervisor is whole, whatever its spec says.
    pub(super) whole_start: bool,
}

/// What was prepared: every component, and every supervisor's name.
#[derive(Default)]
pub(super) struct PreparedTree {
    pub(super) components: Vec<ComponentFacts>,
    pub(super) supervisors: Vec<(ObjectName, Recipient<AreYouAlive>)>,
    /// The specs that are wrong, in the order of the description.
    pub(super) refused: Vec<SpecError>,
}

impl PreparedTree {
    /// The names of all that was prepared.
    pub(super) fn names(&self) -> impl Iterator<Item = &ObjectName> {
        let components = self.components.iter().map(|facts| &facts.name);
        self.supervisors.iter().map(|(name, _)| name).chain(components)
    }
}

/// What the node must know of a component after its supervisor has it.
pub(super) struct ComponentFacts {
    pub(super) name: ObjectName,
    pub(super) depends_on: Vec<String>,
    pub(super) restart: Restart,
}

impl SupervisorSpec {
    fn check_intensity(&self) -> Result<(), SettingError> {
        let SupervisorRules { intensity, period, .. } = self.rules;
        INTENSITY.check(intensity)?;
        // Where none is allowed, each is too many, whatever the period.
        intensity_period(intensity).check(period)
    }

    /// Makes the supervisors and gives them their children. Nothing is started yet.
    pub(super) fn prepare(
        self,
        tree_environment: &TreeEnvironment<'_>,
        tree: &mut PreparedTree,
    ) -> Result<SupervisorChild, SpecError> {
        let name = ObjectName::new(&self.name).map_err(SpecError::Supervisor)?;
        let name = SpecError::check_name(name)?;
        let registry = &tree_environment.environment.registry;
        let reserved = registry.reserve_for_supervisor(&name)?;
        let refused = self.check_intensity().err();
        tree.refused.extend(refused.map(|error| SpecError::setting(&self.name, error)));
        let children = self.children.into_iter();
        let children = children.filter_map(|child| child.prepare(tree_environment, tree)).collect();
        let setup = SupervisorSetup {
            name,
            rules: SupervisorRules {
                whole_start: self.rules.whole_start || tree_environment.whole_start,
                ..self.rules
            },
            children,
            neighbours: SupervisorNeighbours {
                monitor: tree_environment.monitor.clone().recipient(),
                states: tree_environment.monitor.clone().recipient(),
                isolation: tree_environment.monitor.clone().recipient(),
                directory: tree_environment.directory.clone(),
            },
            reserved: Some(reserved),
        };
        let supervisor =
            SupervisorActor::start(tree_environment.guardian, tree_environment.arbiter, setup);
        tree.supervisors.push((supervisor.name().clone(), supervisor.pings()));
        Ok(supervisor)
    }
}
