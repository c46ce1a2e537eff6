//! Changes of the supervision tree while the node runs, and restarts.
//!
//! ```text
//!  add ──► prepare ──► dependencies, monitor ──► AddChild ──► at work
//!             │ wrong          │ wrong              │ not started
//!             └────────────────┴────────────────────┴──────► undone in reverse
//!  remove ──► dependencies ──► ChildRequest (stops in reverse) ──► forgotten
//! ```
//!
//! An object is entered in the dependencies before its supervisor has it, and is taken out before
//! that stops it: so nothing begins to depend on what is about to end.

use super::controller::{RestartError, RestartRoot};
use super::to_the_end::ToTheEnd;
use super::tree::{PreparedTree, Subtree, TreeEnvironment};
use super::{Node, Shared};
use crate::arbiter::pool::CULPRITS_LIMIT;
use crate::component::Component;
use crate::component::spec_error::{SpecError, did_you_mean};
use crate::fault_chain::supervisor::SupervisorActor;
use crate::host::reference::ActorRef;
use crate::host::spec::ChildSpec;
use crate::platform::{self, lock};
use actix::{Addr, Recipient};
use blastema_contract::reports::AreYouAlive;
use blastema_contract::supervisor::{
    AddChild, ChildAction, ChildRequest, GaveUp, ReadTree, Recovered,
};
use blastema_core::detection::dependencies::{Dependencies, DependencyError};
use blastema_core::recovery::{GiveUpReason, Plan};
use blastema_core::{Incarnation, ObjectName};
use std::sync::Mutex;
use std::time::Duration;

/// Between two attempts at a supervisor that was restarted, or is full of requests.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);

/// The state of a component after [`Node::restart_child`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum RestartedChild {
    /// The component is active in this incarnation.
    Running(Incarnation),
    /// This incarnation has begun, and waits for something that is not there yet, such as its
    /// device, or a component below waits for that. It tries again by itself, and the fault
    /// *unavailable* stands until then.
    Unavailable(Incarnation),
    /// The child is not restarted: it is temporary, or transient and ended in order.
    Finished,
}

/// Why a component or supervisor is not removed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RemoveError {
    /// No supervisor of this node keeps an object of this name.
    #[error("no supervisor of this node keeps {name}{}", did_you_mean(nearest.as_ref()))]
    Unknown {
        /// The name that was given.
        name: String,
        /// The child whose name is spelt most like it.
        nearest: Option<ObjectName>,
    },
    /// Another object of the node depends on it. Remove that first, or both by their supervisor.
    #[error(transparent)]
    Needed(#[from] DependencyError),
    /// The node was shut down, and has ended.
    #[error("the node was shut down")]
    ShutDown,
}

impl Node {
    /// Adds a component, or a supervisor and all below it, while the node runs: as the last child of
    /// the supervisor `parent`, or of the root. Resolves when all of it is at work, or waits for
    /// what is not there yet. From then on it is a child like any other: recovery, order and
    /// shutdown include it, and no budget of restarts has counted its start.
    ///
    /// The addition completes or is undone. A component has one attempt; components below a
    /// supervisor that is added are restarted as its rules say. Where one cannot be started, all
    /// that has started ends in reverse order, and all names are free again. While the supervisor
    /// recovers others, the start waits for its turn. The order is carried out also if the future is
    /// dropped.
    ///
    /// ```
    /// use blastema::prelude::*;
    ///
    /// struct Lamp;
    /// impl Component for Lamp {}
    ///
    /// blastema::run(async {
    ///     let node = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp)).start().await?;
    ///     let lamp = |name| ChildSpec::new(name, || Lamp);
    ///     let porch = SupervisorSpec::new("porch", Strategy::OneForAll).child(lamp("porch/left"));
    ///
    ///     node.add(None, porch).await?;
    ///     node.add(Some("porch"), lamp("porch/right").depends_on(["porch/left"])).await?;
    ///     let refused = node.remove_child("porch/left").await.unwrap_err();
    ///     assert!(refused.to_string().starts_with("porch/right depends on porch/left"));
    ///     node.remove_child("porch").await?;
    ///     node.shutdown().await;
    ///     Ok::<(), Box<dyn std::error::Error>>(())
    /// })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// What [`NodeBuilder::start`](crate::NodeBuilder::start) refuses in a component or supervisor;
    /// [`SpecError::NoSupervisor`], [`SpecError::NotStarted`], and [`SpecError::Refused`] where the
    /// parent is not at work.
    pub async fn add(
        &self,
        parent: Option<&str>,
        subtree: impl Into<Subtree>,
    ) -> Result<(), SpecError> {
        self.take_in(parent, subtree.into(), true).await.map(drop)
    }

    /// Adds a component under the root supervisor while the node runs, and does not wait until it is
    /// at work, as [`add`](Self::add) does: where it cannot be started, the plan decides. It is
    /// permanent: every end is followed by a restart.
    ///
    /// # Errors
    /// Its name is taken or does not parse, a setting makes no sense, what it depends on is not
    /// there or depends on it, or the root refuses it.
    pub async fn add_child<C: Component>(
        &self,
        spec: ChildSpec<C>,
    ) -> Result<ActorRef<C>, SpecError> {
        let name = self.take_in(None, spec.into(), false).await?;
        let cell = self.0.environment.registry.cell(&name).and_then(|cell| cell.downcast().ok());
        // It may have been removed in between.
        cell.map(ActorRef).ok_or(SpecError::Refused { name })
    }

    /// Removes a component, or a supervisor and all below it, while the node runs: it stops in the
    /// reverse of its start order, its faults are closed, and its names are free. Its siblings go
    /// on, and no budget of restarts counts it. Messages to it fail from then on as those to
    /// any object that is gone.
    ///
    /// A handler of a component that is removed must not await this, as it would be waited for
    /// itself: it counts as hanging after [`max_wait`](ChildSpec::max_wait). Spawn it with
    /// `actix_rt::spawn`. The order is carried out also if the future is dropped.
    ///
    /// # Errors
    /// [`RemoveError::Unknown`] where no supervisor keeps it, as the root itself;
    /// [`RemoveError::Needed`] where another object [depends](ChildSpec::depends_on) on any of it.
    pub async fn remove_child(&self, name: &str) -> Result<(), RemoveError> {
        let nearest = || self.0.chain.directory.nearest(name);
        let unknown = || RemoveError::Unknown { name: name.to_owned(), nearest: nearest() };
        let object = ObjectName::new(name).map_err(|_| unknown())?;
        let supervisor = self.0.chain.directory.supervisor_of(&object).ok_or_else(unknown)?;
        let names = {
            let mut dependencies = lock(&self.0.tree.dependencies);
            // Else another call removes it already.
            dependencies.has(&object).then_some(()).ok_or_else(unknown)?;
            let names = self.0.chain.directory.subtree(&object);
            dependencies.remove(&names)?;
            names
        };
        let node = self.clone();
        let removal = async move { node.carry_out_removal(object, &supervisor, names).await };
        ToTheEnd::of(self.0.chain.arbiter.clone(), removal).await
    }

    /// Restarts a node from the safe state within its process: all components start their next
    /// incarnations in the start order, also those that were in the safe state or isolated before.
    /// Resolves when all are active. The cause of the safe state must have been removed: this is
    /// for a person, or an application that knows better.
    ///
    /// Who still has to be stopped is waited for. Threads that were given up stay so, and are
    /// counted on.
    ///
    /// # Errors
    /// [`RestartError::NotInSafeState`] unless the node is in the safe state;
    /// [`RestartError::ThreadsHang`] where that would not help; [`RestartError::GaveUp`] where it
    /// entered the safe state again, when all components have ended.
    pub async fn restart(&self) -> Result<(), RestartError> {
        let lost = self.0.environment.arbiters.lost();
        if lost.len() >= CULPRITS_LIMIT {
            return Err(RestartError::ThreadsHang { count: lost.values().sum() });
        }
        // The controller ends with the node's threads.
        self.0.chain.controller.send(RestartRoot).await.unwrap_or(Err(RestartError::ShutDown))
    }

    /// Starts the next incarnation of a component, or of a supervisor and all below it. This ends
    /// its safe state or isolation; an active component is stopped in order first. Its siblings are
    /// restarted as their supervisor's strategy requires. Resolves when all of them are at work, or
    /// wait for what is not there yet, and says which of it is so. No budget of restarts counts it.
    ///
    /// A handler of a component that this restarts must not await it, as it would be waited for
    /// itself: it counts as hanging after [`max_wait`](crate::ChildSpec::max_wait). A component
    /// restarts itself by [`cx.stop()`](crate::Context::stop).
    ///
    /// # Errors
    /// [`RestartError::Unknown`] where no supervisor keeps it; [`RestartError::SupervisorRests`] in
    /// a node in the safe state; [`RestartError::ChildGaveUp`] where it did not come back.
    pub async fn restart_child(&self, name: &str) -> Result<RestartedChild, RestartError> {
        let unknown = || RestartError::Unknown {
            name: name.to_owned(),
            nearest: self.0.chain.directory.nearest(name),
        };
        let object = ObjectName::new(name).map_err(|_| unknown())?;
        let controller = self.0.chain.directory.supervisor_of(&object).ok_or_else(unknown)?;
        let restart = ChildRequest { object, action: ChildAction::Restart(None) };
        match controller.send(restart).await {
            Ok(Ok(Recovered { incarnation, waits, .. })) => Ok(match (incarnation, waits) {
                (Some(incarnation), false) => RestartedChild::Running(incarnation),
                (Some(incarnation), true) => RestartedChild::Unavailable(incarnation),
                (None, _) => RestartedChild::Finished,
            }),
            Ok(Err(GaveUp { object: name, why: GiveUpReason::NotAtWork })) => {
                Err(RestartError::SupervisorRests { name })
            }
            Ok(Err(GaveUp { object: name, why: reason })) => {
                Err(RestartError::ChildGaveUp { name, reason })
            }
            Err(_) => Err(RestartError::ShutDown),
        }
    }

    async fn carry_out_removal(
        &self,
        object: ObjectName,
        supervisor: &Addr<SupervisorActor>,
        names: Vec<ObjectName>,
    ) -> Result<(), RemoveError> {
        let below = names.iter().filter_map(|name| self.0.chain.directory.supervisor(name));
        let below: Vec<_> = below.map(Addr::recipient).collect();
        let remove = ChildRequest { object, action: ChildAction::Remove };
        loop {
            match supervisor.send(remove.clone()).await {
                Ok(Err(GaveUp { why: GiveUpReason::Forgotten, .. }))
                | Ok(Err(GaveUp { why: GiveUpReason::Full { .. }, .. })) => {
                    platform::sleep(RETRY_INTERVAL).await;
                }
                Ok(_) => break,
                Err(_) => return Err(RemoveError::ShutDown),
            }
        }
        await_ends(below).await;
        names.into_iter().for_each(|name| self.0.chain.dismiss(name));
        Ok(())
    }

    /// Prepares a subtree, and gives it to its supervisor.
    async fn take_in(
        &self,
        parent: Option<&str>,
        subtree: Subtree,
        whole: bool,
    ) -> Result<ObjectName, SpecError> {
        let name = parent.unwrap_or("root");
        let directory = &self.0.chain.directory;
        let no_supervisor = || {
            let nearest = directory.nearest_supervisor(name);
            SpecError::NoSupervisor { name: name.to_owned(), nearest }
        };
        let parent = ObjectName::new(name).map_err(|_| no_supervisor())?;
        let supervisor = directory.supervisor(&parent).ok_or_else(no_supervisor)?;
        let mut tree = PreparedTree::default();
        let prepared = subtree.prepare(&self.0.tree_environment(true), &mut tree);
        let entered = match tree.refused.is_empty() {
            true => self.enter(&parent, &tree).and_then(|is_there| match is_there {
                true => Ok(()),
                false => Err(no_supervisor()),
            }),
            false => Err(tree.refused.swap_remove(0)),
        };
        let (child, rules) = match (entered, prepared) {
            (Ok(()), Some(prepared)) => prepared,
            (entered, prepared) => {
                drop(prepared);
                await_ends(tree.supervisors.into_iter().rev().map(|(_, pings)| pings)).await;
                return Err(entered.expect_err("what is not prepared is refused"));
            }
        };
        let addition = AddChild { child, rules, whole };
        let node = self.clone();
        let added =
            async move { node.carry_out_addition(parent, &supervisor, addition, tree).await };
        ToTheEnd::of(self.0.chain.arbiter.clone(), added).await
    }

    async fn carry_out_addition(
        &self,
        parent: ObjectName,
        supervisor: &Addr<SupervisorActor>,
        addition: AddChild,
        tree: PreparedTree,
    ) -> Result<ObjectName, SpecError> {
        let name = addition.child.name().clone();
        self.0.chain.register(&self.0.name, &tree).await;
        let added = supervisor.send(addition).await;
        // The parent may have been removed meanwhile, and this with it.
        let stays = lock(&self.0.tree.dependencies).has(&parent);
        let why = match added {
            Ok(Ok(_)) if stays => return Ok(name),
            Ok(Ok(_)) | Err(_) => None,
            Ok(Err(GaveUp { why, .. })) => Some(why),
        };
        if let Some(GiveUpReason::Forgotten | GiveUpReason::Full { .. }) = why {
            // It may be there all the same.
            let remove = ChildRequest { object: name.clone(), action: ChildAction::Remove };
            let _ = supervisor.send(remove).await;
        }
        let names: Vec<_> = tree.names().cloned().collect();
        // At once: what is gone has no fault that could be recovered.
        names.iter().for_each(|name| self.0.chain.dismiss(name.clone()));
        await_ends(tree.supervisors.into_iter().rev().map(|(_, pings)| pings)).await;
        lock(&self.0.tree.dependencies).forget(&names);
        Err(match why {
            Some(GiveUpReason::StartFailed { reason }) => SpecError::NotStarted { name, reason },
            _ => SpecError::Refused { name },
        })
    }

    /// Enters the dependencies of what is to be added, if its parent is there.
    fn enter(&self, parent: &ObjectName, tree: &PreparedTree) -> Result<bool, SpecError> {
        let mut dependencies = lock(&self.0.tree.dependencies);
        if !dependencies.has(parent) {
            return Ok(false);
        }
        let supervisors = tree.supervisors.iter().map(|(name, _)| (name, &[][..]));
        let components = tree.components.iter().map(|facts| (&facts.name, &*facts.depends_on));
        dependencies.add(supervisors.chain(components))?;
        Ok(true)
    }
}

/// The supervision tree of a node.
pub(super) struct KeptTree {
    /// Where it is read, once it is prepared.
    pub(super) root: Option<Recipient<ReadTree>>,
    /// Who needs whom.
    pub(super) dependencies: Mutex<Dependencies>,
    pub(super) plan: Plan,
}

impl Shared {
    /// What the preparation of a subtree needs.
    pub(super) fn tree_environment(&self, whole_start: bool) -> TreeEnvironment<'_> {
        TreeEnvironment {
            environment: &self.environment,
            guardian: &self.chain.guardian,
            arbiter: self.chain.arbiter.as_ref(),
            monitor: self.chain.monitor.clone(),
            directory: self.chain.directory.clone(),
            plan: &self.tree.plan,
            whole_start,
        }
    }
}

/// Waits until supervisors that were told to end have dropped their children: each before those
/// below it.
async fn await_ends(supervisors: impl IntoIterator<Item = Recipient<AreYouAlive>>) {
    for supervisor in supervisors {
        // It answers no more when it has ended.
        let _ = supervisor.send(AreYouAlive).await;
    }
}
