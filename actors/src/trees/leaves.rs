//! The leaves of an application's trees.

use super::connected;
use super::message;
use super::task::{LeafTask, MakeTask};
use crate::settings::DEFAULT_DEADLINE;
use blastema_core::{Contract, DeliveryError, Described, Event, Lifecycle, Request, Variable};
use blastema_trees::{Factory, Leaf, LeafContext, LeafError, LeafResult, Port, Status};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// What becomes of a leaf that panics, has an error, or exceeds its time limit. Each is a fault
/// [`CheckFailed`](crate::FaultKind::CheckFailed) of the tree's component, whose detail names the
/// leaf by its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeafFault {
    /// The leaf answers FAILURE, and the tree goes on.
    Fail,
    /// The leaf is started again, so many times in a row; then it answers FAILURE.
    Retry(u32),
    /// All nodes are halted, and the tree begins again in its next round.
    RestartTree,
    /// All nodes are halted and the component is in error, so that the
    /// [plan](crate::recovery::Plan) decides.
    Plan,
}

/// How long a leaf may take, and what becomes of its faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeafRules {
    /// The longest time of one run without an answer or a [sign of life](LeafTask::alive), and of
    /// coming to rest after a halt; 60 s by default. A longer limit tolerates slow work, and finds
    /// later that it stands still.
    pub within: Duration,
    /// After an error or the time limit; by default the leaf [fails](LeafFault::Fail).
    pub on_error: LeafFault,
    /// After a panic, whose consequences are not known; by default the
    /// [tree is restarted](LeafFault::RestartTree).
    pub on_panic: LeafFault,
}

impl Default for LeafRules {
    fn default() -> Self {
        let within = Duration::from_secs(60);
        LeafRules { within, on_error: LeafFault::Fail, on_panic: LeafFault::RestartTree }
    }
}

impl LeafRules {
    pub(super) fn after(self, panicked: bool) -> LeafFault {
        if panicked { self.on_panic } else { self.on_error }
    }
}

/// The leaves of an application's trees, by the names that files use. Each name is registered once,
/// and has the ports that it declares.
///
/// ```
/// use blastema::trees::{Port, Status, TreeLeaves};
/// # use blastema::prelude::*;
/// # #[derive(Debug, Request)] #[contract(name = "map/nearest", reply = f64)] struct Nearest { within: f64 }
///
/// let leaves = TreeLeaves::new()
///     .condition("IsCharged", [Port::input::<f64>("charge")], |cx| {
///         Ok(Status::from(cx.input::<f64>("charge")? > 0.2))
///     })
///     .task("Wait", [Port::input::<f64>("seconds").or("1.0")], |leaf| async move {
///         blastema::sleep(std::time::Duration::from_secs_f64(leaf.input("seconds")?)).await;
///         Ok(Status::Success)
///     })
///     .request::<Nearest>("FindNearest"); // ports: component, deadline_sec, within; reply
/// assert!(leaves.model().contains("FindNearest"));
/// ```
#[derive(Clone)]
pub struct TreeLeaves {
    pub(super) factory: Factory,
    pub(super) tasks: BTreeMap<String, MakeTask>,
    pub(super) rules: BTreeMap<String, LeafRules>,
}

impl fmt::Debug for TreeLeaves {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.names()).finish()
    }
}

impl Default for TreeLeaves {
    fn default() -> Self {
        TreeLeaves::new()
    }
}

const COMPONENT: Port = Port::input::<String>("component").about("its name, as in `base:arm`");
const ACTUATOR: Port = Port::input::<String>("actuator").about("its name, as in `base:wheels`");

impl TreeLeaves {
    /// The leaves that come with every tree: [their table](crate::manual::trees#leaves).
    pub fn new() -> Self {
        let mut factory = Factory::new();
        connected::register(&mut factory);
        let leaves = TreeLeaves { factory, tasks: BTreeMap::new(), rules: BTreeMap::new() };
        let port = Port::input::<String>("component").about("a component of this node");
        leaves
            .task("ActivateComponent", [port.clone()], |leaf| steer(leaf, Lifecycle::Active))
            .task("DeactivateComponent", [port], |leaf| steer(leaf, Lifecycle::Initialized))
    }

    /// Adds a condition: a function that is called in each tick.
    ///
    /// # Panics
    /// The name or a port's name is taken or none that files can have, or a default does not
    /// convert: a mistake in the program. So do all functions that add leaves.
    #[must_use]
    pub fn condition(
        mut self,
        name: &str,
        ports: impl Into<Vec<Port>>,
        function: impl Fn(&mut LeafContext<'_>) -> LeafResult + Send + Sync + 'static,
    ) -> Self {
        self.factory.condition(name, ports, function);
        self
    }

    /// Adds an action that is done at once.
    #[must_use]
    pub fn action(
        mut self,
        name: &str,
        ports: impl Into<Vec<Port>>,
        function: impl Fn(&mut LeafContext<'_>) -> LeafResult + Send + Sync + 'static,
    ) -> Self {
        self.factory.action(name, ports, function);
        self
    }

    /// Adds a leaf that keeps something between ticks; `make` makes one for each place in a tree.
    #[must_use]
    pub fn leaf<L: Leaf>(
        mut self,
        name: &str,
        make: impl Fn() -> L + Send + Sync + 'static,
    ) -> Self {
        self.factory.leaf(name, make);
        self
    }

    /// Adds an action that waits: RUNNING until the future ends. A halted leaf's future is dropped.
    #[must_use]
    pub fn task<F: Future<Output = LeafResult> + 'static>(
        mut self,
        name: &str,
        ports: impl Into<Vec<Port>>,
        start: impl Fn(LeafTask) -> F + Send + Sync + 'static,
    ) -> Self {
        self.factory.driven(name, ports);
        let start = Arc::new(start);
        let make: MakeTask = Arc::new(move |leaf| {
            let start = start.clone();
            // A panic of `start` itself is one of the leaf, too.
            Box::pin(async move { start(leaf).await })
        });
        self.tasks.insert(name.to_owned(), make);
        self
    }

    /// Adds an action that sends this request to the component that a port names, and is RUNNING
    /// until the reply. Each field of the request is a port, and each field of the reply one that
    /// is written. A request that fails, or whose reply is an `Err`, is a FAILURE.
    #[must_use]
    pub fn request<M: Request>(self, name: &str) -> Self {
        let deadline = connected::span("deadline_sec").optional().about("by default 5 s");
        let mut ports = vec![COMPONENT, deadline];
        ports.extend(message::inputs::<M>().into_iter().chain(message::outputs::<M::Reply>()));
        self.task(name, ports, |mut leaf| async move {
            let (component, message) = (leaf.input::<String>("component")?, leaf.message::<M>()?);
            let deadline = leaf.optional_input::<f64>("deadline_sec")?;
            let deadline = deadline.map_or(DEFAULT_DEADLINE, Duration::from_secs_f64);
            let sender = leaf.context().sender::<M>(&component);
            let asked = async {
                sender?.ask_within(message, deadline).await.map_err(|refused| refused.kind)
            };
            leaf.done(asked.await)
        })
    }

    /// Adds an action that publishes an event on the topic that a port names, by default that of
    /// the contract. Each field of the event is a port.
    #[must_use]
    pub fn publish<E: Event>(self, name: &str) -> Self {
        let mut ports = vec![Port::input::<String>("topic").or(E::NAME)];
        ports.extend(message::inputs::<E>());
        self.task(name, ports, |mut leaf| async move {
            let (topic, event) = (leaf.input::<String>("topic")?, leaf.message::<E>()?);
            let publisher = leaf.context().publisher::<E>(&topic);
            leaf.done(publisher.and_then(|to| to.publish(event).map_err(|refused| refused.kind)))
        })
    }

    /// Adds `Read…` and `Write…`, which read and write this variable of the component that a port
    /// names. Each field of the variable is a port.
    #[must_use]
    pub fn variable<V: Variable>(self, name: &str) -> Self {
        let ports = |more: Vec<Port>| [vec![COMPONENT], more].concat();
        let reads = ports(message::outputs::<V>());
        let reading = self.task(&format!("Read{name}"), reads, |mut leaf| async move {
            let component: String = leaf.input("component")?;
            let variable = leaf.context().variable::<V>(&component);
            let read = async { variable?.read().await.map(|reading| reading.value) };
            leaf.done(read.await)
        });
        let writes = ports(message::inputs::<V>());
        reading.task(&format!("Write{name}"), writes, |mut leaf| async move {
            let (component, value) = (leaf.input::<String>("component")?, leaf.message::<V>()?);
            let variable = leaf.context().variable::<V>(&component);
            let written = async { variable?.write(value).await.map(drop) };
            leaf.done(written.await)
        })
    }

    /// Adds `Claim…`, `Command…` and `Release…`, which claim, command and give back the actuator
    /// that a port names. Each field of the command is a port of `Command…`. A lease is held until
    /// it is given back, or the tree is halted as a whole.
    #[must_use]
    pub fn actuator<M: Contract>(self, name: &str) -> Self {
        let within = connected::span("within_sec").or("1.0").about("waits so long, in s");
        let claim = format!("Claim{name}");
        let claims = self.task(&claim, [ACTUATOR, within], |mut leaf| async move {
            let within = Duration::from_secs_f64(leaf.input("within_sec")?);
            let commander = leaf.commander::<M>()?;
            let claimed = async { commander?.claim_within(within).await.map(drop) };
            leaf.done(claimed.await)
        });
        let ports = [vec![ACTUATOR], message::inputs::<M>(), message::outputs::<M::Reply>()];
        let command = format!("Command{name}");
        let commands = claims.task(&command, ports.concat(), |mut leaf| async move {
            let (command, commander) = (leaf.message::<M>()?, leaf.commander::<M>()?);
            leaf.done(async { commander?.command(command).await }.await)
        });
        commands.task(&format!("Release{name}"), [ACTUATOR], |mut leaf| async move {
            let commander = leaf.commander::<M>()?;
            leaf.done(async { commander?.release().await }.await)
        })
    }

    /// Sets the rules of a leaf; [`LeafRules::default`] are those of all others.
    ///
    /// # Panics
    /// No leaf has this name.
    #[must_use]
    pub fn rules(mut self, name: &str, rules: LeafRules) -> Self {
        assert!(self.names().any(|known| known == name), "no leaf is called `{name}`");
        self.rules.insert(name.to_owned(), rules);
        self
    }

    /// The names of all leaves.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.factory.names()
    }

    /// The `TreeNodesModel` of all leaves, as a file that the editor Groot2 loads.
    pub fn model(&self) -> String {
        self.factory.model()
    }
}

impl LeafTask {
    /// The commander of the actuator that the leaf's port names.
    fn commander<M: Contract>(
        &mut self,
    ) -> Result<Result<crate::Commander<M>, DeliveryError>, LeafError> {
        let actuator: String = self.input("actuator")?;
        let (shared, cx) = (self.shared.clone(), &mut self.cx);
        Ok(shared.commander(&actuator, || cx.commander::<M>(&actuator)))
    }

    /// The answer of a leaf whose work succeeded or not; why not is logged with its path.
    fn done<T: Described>(&self, result: Result<T, DeliveryError>) -> LeafResult {
        match result {
            Ok(value) => Ok(Status::from(self.write(&value)?)),
            Err(why) => {
                tracing::info!(tree = %self.cx.name(), leaf = self.path(), "the leaf fails: {why}");
                Ok(Status::Failure)
            }
        }
    }
}

/// Has a component of this node work, or leave work, and waits until it does.
async fn steer(leaf: LeafTask, wanted: Lifecycle) -> LeafResult {
    let component: String = leaf.input("component")?;
    let registry = leaf.cx.cell.record.environment.registry.clone();
    registry.watchable(&component)?.steer(wanted).await?;
    Ok(Status::Success)
}
