//! Leaves of the application, and their view of the tree.

use super::{LeafError, PortError, Tree, TreeNodeId};
use crate::blackboard::KeyId;
use crate::model::{LeafKind, Port};
use crate::status::Status;
use crate::value::{PortValue, Value};
use std::any::Any;
use std::sync::Arc;
use std::time::Duration;

/// The answer of a leaf.
pub type LeafResult = Result<Status, LeafError>;

/// Whether a halted leaf has come to rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Halt {
    /// The leaf has come to rest.
    Done,
    /// It needs further ticks. No action of the tree is started meanwhile.
    Pending,
}

/// A leaf of the application that keeps something from one call to the next.
///
/// An action that waits for something outside answers RUNNING from `start`. Its driver later calls
/// [`Tree::complete`] with the value of [`LeafContext::run`].
///
/// ```
/// use blastema_trees::{Factory, Halt, Leaf, LeafContext, LeafResult, Port, Status};
/// use std::time::Duration;
///
/// /// Drives for a while.
/// #[derive(Default)]
/// struct Drive {
///     until: Duration,
/// }
///
/// impl Leaf for Drive {
///     fn ports() -> Vec<Port> {
///         vec![Port::input::<f64>("seconds").or("2.0"), Port::output::<bool>("moved")]
///     }
///
///     fn start(&mut self, cx: &mut LeafContext<'_>) -> LeafResult {
///         self.until = cx.now() + Duration::from_secs_f64(cx.input("seconds")?);
///         cx.wake_at(self.until);
///         Ok(Status::Running)
///     }
///
///     fn running(&mut self, cx: &mut LeafContext<'_>) -> LeafResult {
///         if cx.now() < self.until {
///             cx.wake_at(self.until);
///             return Ok(Status::Running);
///         }
///         cx.output("moved", true)?;
///         Ok(Status::Success)
///     }
/// }
///
/// let mut factory = Factory::new();
/// factory.leaf("Drive", Drive::default);
/// let text = r#"<root BTCPP_format="4"><BehaviorTree ID="Main"><Drive/></BehaviorTree></root>"#;
/// let mut tree = factory.load("main.xml", text)?;
///
/// assert_eq!(tree.tick(Duration::ZERO)?, Status::Running);
/// assert_eq!(tree.next_tick(), Some(Duration::from_secs(2)));
/// assert_eq!(tree.tick(Duration::from_secs(2))?, Status::Success);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub trait Leaf: Send + 'static {
    /// Returns the ports of the leaf's type.
    fn ports() -> Vec<Port>
    where
        Self: Sized,
    {
        Vec::new()
    }

    /// The kind of leaf. Conditions, and actions that are done at once, have only `start`.
    fn kind() -> LeafKind
    where
        Self: Sized,
    {
        LeafKind::Action
    }

    /// Starts the leaf.
    ///
    /// # Errors
    ///
    /// The leaf's own. The tick ends with them.
    fn start(&mut self, cx: &mut LeafContext<'_>) -> LeafResult;

    /// Called in each tick while the leaf is RUNNING, unless the driver has completed it.
    ///
    /// # Errors
    ///
    /// The leaf's own. The tick ends with them.
    fn running(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
        Ok(Status::Running)
    }

    /// Called once when the leaf is left while it is RUNNING.
    fn halt(&mut self, _: &mut LeafContext<'_>) -> Halt {
        Halt::Done
    }

    /// Called at the beginning of each tick after `halt` has answered that it is pending, unless
    /// the driver has completed the leaf.
    fn halting(&mut self, _: &mut LeafContext<'_>) -> Halt {
        Halt::Pending
    }
}

/// A function is a leaf that is called when it starts.
impl<F: Fn(&mut LeafContext<'_>) -> LeafResult + Send + 'static> Leaf for F {
    fn start(&mut self, cx: &mut LeafContext<'_>) -> LeafResult {
        self(cx)
    }
}

/// A registered type of leaf.
pub(crate) struct LeafModel {
    pub(crate) name: String,
    pub(crate) kind: LeafKind,
    pub(crate) ports: Vec<Port>,
    pub(crate) make: MakeLeaf,
}

/// Makes one leaf.
pub(crate) type MakeLeaf = Box<dyn Fn() -> Box<dyn Leaf> + Send + Sync>;

/// One leaf in a tree.
pub(crate) struct LeafState {
    pub(crate) node: TreeNodeId,
    pub(crate) model: Arc<LeafModel>,
    /// None before the first call, and after a panic: it is made again for the next start.
    pub(crate) leaf: Option<Box<dyn Leaf>>,
    /// The driver's answer, which the next tick gives.
    pub(crate) answer: Option<Status>,
    /// The number of starts.
    pub(crate) starts: u32,
    /// The time of the last start.
    pub(crate) since: Duration,
    /// To be started as soon as no leaf is halting.
    pub(crate) deferred: bool,
}

impl LeafState {
    pub(crate) fn new(node: TreeNodeId, model: Arc<LeafModel>) -> LeafState {
        let (starts, since) = (0, Duration::ZERO);
        LeafState { node, model, leaf: None, answer: None, starts, since, deferred: false }
    }
}

/// One start of one leaf. An answer for an earlier start is not taken for a later one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeafRun {
    /// The number of the leaf.
    pub node: TreeNodeId,
    pub(super) start: u32,
}

/// A port of a node.
#[derive(Debug)]
pub(crate) struct BoundPort {
    pub(crate) name: &'static str,
    pub(crate) binding: PortBinding,
}

/// The connection of a port.
#[derive(Clone, Debug)]
pub(crate) enum PortBinding {
    Missing,
    /// A literal, converted while the tree is loaded.
    Literal(Value),
    Key(KeyId),
    /// The entry that a literal names, of a port that takes names.
    Entry(KeyId),
}

/// The tree as a leaf sees it while it is called.
pub struct LeafContext<'a> {
    pub(super) tree: &'a mut Tree,
    pub(super) run: LeafRun,
}

impl LeafContext<'_> {
    /// The time that the driver gave to the tick.
    pub fn now(&self) -> Duration {
        self.tree.clock.now
    }

    /// The leaf's path in the tree.
    pub fn path(&self) -> &str {
        self.tree.path(self.run.node)
    }

    /// This start of the leaf, by which the driver completes it later.
    pub fn run(&self) -> LeafRun {
        self.run
    }

    /// What the driver [lends](Tree::lend) to the leaves, if it is of this type.
    pub fn lent<T: Any>(&self) -> Option<&T> {
        self.tree.lent.as_deref()?.downcast_ref()
    }

    /// Asks for a tick at this time, if the leaf is still RUNNING then.
    pub fn wake_at(&mut self, at: Duration) {
        self.tree.wake_at(at);
    }

    /// The value of a port.
    ///
    /// # Errors
    ///
    /// It is not given, not written yet, or does not convert.
    pub fn input<T: PortValue>(&self, port: &str) -> Result<T, PortError> {
        self.optional_input(port)?.ok_or_else(|| PortError::Missing(port.into()))
    }

    /// The value of a port, or none where the tree does not give it.
    ///
    /// # Errors
    ///
    /// It is not written yet, does not convert, or is none of the [right](Port::only) values.
    pub fn optional_input<T: PortValue>(&self, port: &str) -> Result<Option<T>, PortError> {
        let (port, bound) = self.bound(port)?;
        if let PortBinding::Missing = bound.binding {
            return Ok(None);
        }
        let value = value_of(self.tree, bound)?;
        match port.refuses(value) {
            Some(kind) => Err(PortError::of_type(port.name, value, kind)),
            None => converted(bound, value).map(Some),
        }
    }

    /// Writes a port; nothing is written where the tree does not connect it.
    ///
    /// # Errors
    ///
    /// The entry keeps another type.
    pub fn output<T: PortValue>(&mut self, port: &str, value: T) -> Result<(), PortError> {
        let PortBinding::Key(key) = self.bound(port)?.1.binding else { return Ok(()) };
        let written = self.tree.board.set(key, value);
        written.map_err(|kind| PortError::of_type(port, T::TYPE.name(), kind))
    }

    fn bound(&self, port: &str) -> Result<(&Port, &BoundPort), PortError> {
        let mut ports = self.tree.leaf(self.run.node).model.ports.iter().enumerate();
        let found = ports.find(|(_, known)| known.name == port);
        let bound = found.map(|(index, known)| (known, self.tree.bound(self.run.node, index)));
        bound.ok_or_else(|| PortError::Undeclared(port.into()))
    }
}

/// The value that a port reads.
pub(super) fn read<T: PortValue>(tree: &Tree, bound: &BoundPort) -> Result<T, PortError> {
    converted(bound, value_of(tree, bound)?)
}

fn value_of<'t>(tree: &'t Tree, bound: &'t BoundPort) -> Result<&'t Value, PortError> {
    let port = || bound.name.to_owned();
    match &bound.binding {
        PortBinding::Missing | PortBinding::Entry(_) => Err(PortError::Missing(port())),
        PortBinding::Literal(value) => Ok(value),
        PortBinding::Key(key) => tree.board.value(*key).ok_or_else(|| {
            let key = tree.board.name(*key).to_string();
            PortError::Unset { port: port(), key }
        }),
    }
}

fn converted<T: PortValue>(bound: &BoundPort, value: &Value) -> Result<T, PortError> {
    T::from_value(value).ok_or_else(|| PortError::of_type(bound.name, value, T::TYPE.name()))
}
