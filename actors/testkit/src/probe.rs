//! A component in the place of any partner of the component under test.

use blastema::prelude::*;
use blastema::{ActuatorSpec, Contract, Hold};
use blastema_doubles::Record;
use std::ops::Deref;
use std::sync::Arc;

/// Records the messages of one contract in place of a component, and answers requests.
///
/// It gives the [`ChildSpec`] of a component that listens to a topic, takes commands by name, or
/// serves requests; what that component is sent is found here. Probes outlive the restarts of their
/// component.
///
/// # Examples
/// ```
/// use blastema::prelude::*;
/// use blastema_testkit::{Probe, TestNode};
///
/// #[derive(Clone, Debug, PartialEq, Event)]
/// struct Brake { newton: f64 }
///
/// blastema_testkit::run(async {
///     let brakes = Probe::<Brake>::new();
///     let builder = Node::builder("module1").child(brakes.target("brakes"));
///     let node = TestNode::start(builder).await;
///
///     node.sender("brakes")?.tell(Brake { newton: 40.0 }).map_err(|error| error.kind)?;
///
///     assert_eq!(brakes.expect().await, Brake { newton: 40.0 });
///     Ok::<(), DeliveryError>(())
/// })?;
/// # Ok::<(), blastema::DeliveryError>(())
/// ```
pub struct Probe<M>(Record<M>);

impl<M> Clone for Probe<M> {
    fn clone(&self) -> Self {
        Probe(self.0.clone())
    }
}

impl<M> Default for Probe<M> {
    fn default() -> Self {
        Probe(Record::default())
    }
}

impl<M: Contract> Probe<M> {
    /// A probe that has seen nothing.
    pub fn new() -> Self {
        Probe::default()
    }
}

/// What was received is found in the record.
impl<M> Deref for Probe<M> {
    type Target = Record<M>;

    fn deref(&self) -> &Record<M> {
        &self.0
    }
}

type Answer<M> = Arc<dyn Fn(&M) -> <M as Contract>::Reply + Send + Sync>;

impl<M: Contract> Probe<M> {
    fn double(
        &self,
        name: &str,
        answer: impl Fn(&M) -> M::Reply + Send + Sync + 'static,
        declare: impl FnOnce(&mut Ports<TestDouble<M>>) + Send + 'static,
    ) -> ChildSpec<TestDouble<M>> {
        let (record, answer): (_, Answer<M>) = (self.0.clone(), Arc::new(answer));
        let make = move || TestDouble { record: record.clone(), answer: answer.clone() };
        ChildSpec::new(name, make).with_ports(declare)
    }
}

impl<E: Event> Probe<E> {
    /// A component that listens to the topic that has this event's contract name.
    pub fn listener(&self, name: &str) -> ChildSpec<TestDouble<E>> {
        self.double(name, |_| (), |ports| _ = ports.listen::<E>())
    }

    /// A component that accepts this event as a command by name.
    pub fn target(&self, name: &str) -> ChildSpec<TestDouble<E>> {
        self.double(name, |_| (), |ports| _ = ports.accept::<E>())
    }

    /// An actuator in the place of a real one: it records the commands that its lease lets through,
    /// and `safe` when its commander has gone. The lease lasts as long as that of an
    /// [`ActuatorSpec`] does by default. Its commands are an event; a request, whose commands have
    /// replies, has [`Probe::answering_actuator`].
    pub fn actuator(&self, name: &str, safe: E) -> ChildSpec<TestDouble<E>> {
        self.double(name, |_| (), |ports| _ = ports.actuator(ActuatorSpec::new(safe, Hold)))
    }
}

impl<M: Request> Probe<M> {
    /// An actuator whose commands have replies: as [`Probe::actuator`], and it answers as the
    /// closure says, also `safe`.
    pub fn answering_actuator(
        &self,
        name: &str,
        safe: M,
        answer: impl Fn(&M) -> M::Reply + Send + Sync + 'static,
    ) -> ChildSpec<TestDouble<M>> {
        self.double(name, answer, |ports| _ = ports.actuator(ActuatorSpec::new(safe, Hold)))
    }

    /// A component that serves this request as the closure says. A closure that panics is a
    /// component that does.
    pub fn server(
        &self,
        name: &str,
        answer: impl Fn(&M) -> M::Reply + Send + Sync + 'static,
    ) -> ChildSpec<TestDouble<M>> {
        self.double(name, answer, |ports| _ = ports.serve::<M>())
    }
}

/// The component of a [`Probe`].
pub struct TestDouble<M: Contract> {
    record: Record<M>,
    answer: Answer<M>,
}

impl<M: Contract> Component for TestDouble<M> {}

impl<M: Contract> Handle<M> for TestDouble<M> {
    async fn handle(&mut self, message: M, _: &mut Context<Self>) -> M::Reply {
        let reply = (self.answer)(&message);
        self.record.push(message);
        reply
    }
}

/// A component of this name that owns the variable, which has this value until it is written. The
/// test reads and writes it by [`Node::variable`].
pub fn owner<V: Variable>(name: &str, value: V) -> ChildSpec<Owner> {
    ChildSpec::new(name, || Owner).with_ports(|ports| {
        ports.variable(VariableSpec::new(value));
    })
}

/// The component of [`owner`].
pub struct Owner;

impl Component for Owner {}
