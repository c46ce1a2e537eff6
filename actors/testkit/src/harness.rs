//! One component, alone on a bench.

use crate::node::TestNode;
use blastema::prelude::*;
use blastema::{Contract, Lifecycle, RequestError, SendError};
use std::ops::{Deref, DerefMut};

/// A component under test: the only one of a node of its own, or one among doubles.
///
/// It is the [`TestNode`] in which the component lives, and talks to the component as others do.
///
/// # Examples
/// ```
/// use blastema::prelude::*;
/// use blastema_testkit::{Harness, Probe, TestNode};
///
/// #[derive(Debug, Request)]
/// #[contract(reply = f64)]
/// struct Range;
///
/// #[derive(Debug, Request)]
/// #[contract(reply = bool)]
/// struct IsClear;
///
/// /// Asks the laser before it lets the robot go.
/// struct Gate;
/// impl Component for Gate {}
/// impl Handle<IsClear> for Gate {
///     async fn handle(&mut self, _: IsClear, cx: &mut Context<Self>) -> bool {
///         let Ok(laser) = cx.sender::<Range>("laser") else { return false };
///         laser.ask(Range).await.is_ok_and(|range| range > 0.5)
///     }
/// }
///
/// blastema_testkit::run(async {
///     let laser = Probe::<Range>::new();
///     let near = laser.server("laser", |_| 0.3);
///     let node = TestNode::start(Node::builder("module1").child(near)).await;
///     let gate = Harness::within(node, ChildSpec::new("gate", || Gate)).await;
///
///     assert!(!gate.ask(IsClear).await?);
///     assert_eq!(laser.len(), 1);
///     Ok::<(), blastema::RequestError<IsClear>>(())
/// })?;
/// # Ok::<(), blastema::RequestError<IsClear>>(())
/// ```
pub struct Harness<C: Component> {
    node: TestNode,
    actor: ActorRef<C>,
}

impl<C: Component> Deref for Harness<C> {
    type Target = TestNode;

    fn deref(&self) -> &TestNode {
        &self.node
    }
}

impl<C: Component> DerefMut for Harness<C> {
    fn deref_mut(&mut self) -> &mut TestNode {
        &mut self.node
    }
}

impl<C: Component> Harness<C> {
    /// Starts the component alone in a node `test`. When this returns, it has done what it does
    /// without waiting: if it is sound and quick to initialise, it is active.
    ///
    /// # Panics
    /// When the spec is wrong, or the component's start fails; the text says why. What becomes of a
    /// component whose start fails is tested with a [`TestNode`], which awaits the fault.
    pub async fn start(spec: ChildSpec<C>) -> Self {
        Harness::within(TestNode::start(Node::builder("test")).await, spec).await
    }

    /// Starts the component as one more of a node, in which its partners live already.
    ///
    /// # Panics
    /// As [`start`](Self::start), and when its name is taken.
    pub async fn within(node: TestNode, spec: ChildSpec<C>) -> Self {
        let actor = match node.add_child(spec).await {
            Ok(actor) => actor,
            Err(error) => panic!("the component was not started: {error}"),
        };
        node.settle().await;
        // One whose device is not there yet waits, and is not at its end.
        if actor.state() == Lifecycle::Finalized
            && let Some(faults) = node.faults_of(actor.name()).await
        {
            panic!("the component was not started: {}", faults.trim_end());
        }
        Harness { node, actor }
    }

    /// A reference to the component.
    pub fn actor(&self) -> &ActorRef<C> {
        &self.actor
    }

    /// Where the component stands in its incarnation.
    pub fn state(&self) -> Lifecycle {
        self.actor.state()
    }

    /// Sends the component a message.
    ///
    /// # Errors
    /// As [`ActorRef::tell`].
    pub fn tell<M: Contract>(&self, message: M) -> Result<(), SendError<M>>
    where
        C: Handle<M>,
    {
        self.actor.tell(message)
    }

    /// Asks the component, and waits for the reply.
    ///
    /// # Errors
    /// As [`ActorRef::ask`].
    pub async fn ask<M: Contract>(&self, message: M) -> Result<M::Reply, RequestError<M>>
    where
        C: Handle<M>,
    {
        self.actor.ask(message).await
    }
}
