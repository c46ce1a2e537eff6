//! Components that a test needs for one thing only.

use crate::MS;
use blastema::{
    ActuatorSpec, ChildSpec, Component, Context, Contract, Direction, Event, Handle, Link,
    MemoryMedium, Network, Node, NodeBuilder, Request,
};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What a [`Part`] may keep.
pub trait State: Clone + Send + Sync + 'static {}

impl<T: Clone + Send + Sync + 'static> State for T {}

/// What a [`Part`] does with a message: changes its state, and replies.
pub type Act<S, M> = fn(&mut S, M, &mut Context<Part<S, M>>) -> <M as Contract>::Reply;

/// A component that handles one contract by a function. Each incarnation begins with a clone of the
/// state that the test gave it; a [`Notes`] among it is one for all of them.
pub struct Part<S: 'static, M: Contract> {
    state: S,
    act: Act<S, M>,
}

impl<S: 'static, M: Contract> Component for Part<S, M> {}

impl<S: 'static, M: Contract> Handle<M> for Part<S, M> {
    async fn handle(&mut self, message: M, cx: &mut Context<Self>) -> M::Reply {
        (self.act)(&mut self.state, message, cx)
    }
}

/// A part without a port: the test declares it, by [`ChildSpec::with_ports`].
///
/// ```
/// use blastema::prelude::*;
/// use blastema_tests::part;
///
/// #[derive(Clone, Debug, Event)]
/// struct Scan(u32);
///
/// let nearest = part("nearest", u32::MAX, |nearest, Scan(distance), _| {
///     *nearest = distance.min(*nearest);
/// });
/// let _nearest = nearest.with_ports(|ports| {
///     ports.listen::<Scan>().on("front");
/// });
/// ```
pub fn part<S: State, M: Contract>(name: &str, state: S, act: Act<S, M>) -> ChildSpec<Part<S, M>> {
    ChildSpec::new(name, move || Part { state: state.clone(), act })
}

/// A part that serves a request.
pub fn serves<S: State, R: Request>(name: &str, state: S, act: Act<S, R>) -> ChildSpec<Part<S, R>> {
    part(name, state, act).with_ports(|ports| {
        ports.serve::<R>();
    })
}

/// A part that takes an event as a command by its name.
pub fn accepts<S: State, E: Event>(name: &str, state: S, act: Act<S, E>) -> ChildSpec<Part<S, E>> {
    part(name, state, act).with_ports(|ports| {
        ports.accept::<E>();
    })
}

/// A part that listens to a topic.
pub fn listens<S: State, E: Event>(
    name: &str,
    topic: &'static str,
    state: S,
    act: Act<S, E>,
) -> ChildSpec<Part<S, E>> {
    part(name, state, act).with_ports(move |ports| {
        ports.listen::<E>().on(topic);
    })
}

/// A part that the holder of its lease moves.
pub fn moves<S: State, R: Request>(
    name: &str,
    spec: ActuatorSpec<R>,
    state: S,
    act: Act<S, R>,
) -> ChildSpec<Part<S, R>> {
    part(name, state, act).with_ports(|ports| {
        ports.actuator(spec);
    })
}

/// Hooks of a component, each by its method `act`, which gets the name of the hook.
#[macro_export]
macro_rules! hooks {
    ($($hook:ident)+) => {
        $(
            async fn $hook(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
                self.act(stringify!($hook), cx).await
            }
        )+
    };
}

/// What components wrote down, in order. All clones are one.
#[derive(Debug)]
pub struct Notes<T>(Arc<Mutex<Vec<T>>>);

impl<T> Clone for Notes<T> {
    fn clone(&self) -> Self {
        Notes(self.0.clone())
    }
}

impl<T> Default for Notes<T> {
    fn default() -> Self {
        Notes(Arc::default())
    }
}

impl<T> Notes<T> {
    /// The notes themselves.
    pub fn lock(&self) -> MutexGuard<'_, Vec<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes this down.
    pub fn note(&self, what: impl Into<T>) {
        self.lock().push(what.into());
    }

    /// All that was written down since it was last taken.
    pub fn take(&self) -> Vec<T> {
        std::mem::take(&mut *self.lock())
    }
}

impl<T: Clone> Notes<T> {
    /// All that was written down.
    pub fn all(&self) -> Vec<T> {
        self.lock().clone()
    }
}

/// A node on the network `ethernet` of this medium, with a link to another one and a cable that a
/// test can cut.
pub fn on_ethernet(own: &str, far: &str, medium: &MemoryMedium) -> NodeBuilder {
    meshed(own, &[far], medium, 50 * MS)
}

/// The same with a link to each of these nodes but itself, and hellos so often.
pub fn meshed(own: &str, all: &[&str], medium: &MemoryMedium, hello: Duration) -> NodeBuilder {
    let mut network = Network::memory("ethernet", medium, own);
    for far in all.iter().filter(|far| **far != own) {
        network = network.link(Link::to(far, far).hello_every(hello));
    }
    Node::builder(own).network(network.with_faults(7))
}

/// Pulls the cable of this node from its network `ethernet`.
///
/// # Panics
/// It has no such cable.
pub fn pull_cable(node: &Node) {
    node.cable("ethernet").expect("a cable").cut(Direction::Both, false);
}

/// Plugs it in again.
///
/// # Panics
/// It has no such cable.
pub fn plug_cable(node: &Node) {
    node.cable("ethernet").expect("a cable").restore();
}
