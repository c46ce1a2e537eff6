//! The description of a policy for lost communication, and how a rung commands.

use crate::actuator::command::ActuatorCommand;
use crate::actuator::{self, ActuatorTable, Commander};
use crate::component::Component;
use crate::condition::Connected;
use crate::host::spec::ChildSpec;
use crate::node::Node;
use crate::node::conditions::OwnedTask;
use crate::platform;
use crate::registry::Registry;
use crate::settings::CONDITION_TIMEOUT;
use blastema_core::connection::LostCommunicationEnd;
use blastema_core::{Contract, DeliveryError, Incarnation, ObjectName};
use std::cell::Cell;
use std::fmt;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;
use tracing::info;

/// Communication that is back for so long is taken for stable.
const STABLE: Duration = Duration::from_secs(5);
/// How long a rung waits for an actuator before it takes it from another commander again.
const CLAIM_WITHIN: Duration = Duration::from_millis(100);
/// After which it tries again what was refused.
const RETRY_DELAY: Duration = Duration::from_millis(20);
/// How often it looks whether it still holds an actuator whose commands count for ever.
const HELD_INTERVAL: Duration = Duration::from_millis(50);

pub(super) type LocalFuture<T> = Pin<Box<dyn Future<Output = T>>>;
/// Commands an actuator until it is dropped. It sets the flag once a command was carried out.
pub(super) type CommandFn = Box<dyn Fn(&RungSetup, Rc<Cell<bool>>) -> LocalFuture<()> + Send>;
/// Adds a component, and says what it is called.
pub(super) type AddFn = Arc<dyn Fn(Node) -> LocalFuture<Result<String, String>> + Send + Sync>;

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
///     .commander("console")
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

/// One step of the ladder: commands to actuators, or a component that runs.
pub struct Rung {
    pub(super) name: String,
    pub(super) deed: RungDeed,
}

pub(super) enum RungDeed {
    Command(Vec<RungCommand>),
    Run(AddFn),
}

pub(super) struct RungCommand {
    pub(super) actuator: String,
    pub(super) contract: &'static str,
    pub(super) command: CommandFn,
}

impl fmt::Debug for Rung {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Rung {}", self.name)
    }
}

impl LostCommunicationPolicy {
    /// A policy for the loss of what is needed: it begins when the condition of this name is lost
    /// after it was connected.
    pub fn new(name: &str, needs: Connected) -> Self {
        let (commander, rungs) = (None, Vec::new());
        let end = LostCommunicationEnd::Stable(STABLE);
        LostCommunicationPolicy { name: name.to_owned(), needs, commander, rungs, end }
    }

    /// Names the node whose commanders are lost. With the first rung their leases end, also if only
    /// the condition was lost; their claims are refused until the ladder has ended.
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
        self.end = LostCommunicationEnd::Stable(span);
        self
    }

    /// Keeps the rung until a person ends it by [`Node::acknowledge`], once communication is back.
    pub fn until_acknowledged(mut self) -> Self {
        self.end = LostCommunicationEnd::Acknowledged;
        self
    }

    /// Finds what cannot work before anything starts.
    pub(super) fn check(&self, actuators: &ActuatorTable) -> Result<(), String> {
        let times: Vec<_> = self.rungs.iter().map(|(after, _)| *after).collect();
        if !times.is_sorted_by(|before, after| before < after) {
            return Err("its rungs do not rise in time: write the earlier ones first".to_owned());
        }
        if times.iter().any(|after| CONDITION_TIMEOUT.check(*after).is_err()) {
            return Err("a rung begins more than an hour after the loss: write less".to_owned());
        }
        match self.rungs.last() {
            None => return Err("it has no rungs: add one by `after`".to_owned()),
            Some((_, Rung { name, deed: RungDeed::Run(_) })) => {
                return Err(format!(
                    "its last rung, {name}, runs a component, which may die: let the last one be a \
                     command"
                ));
            }
            Some(_) => {}
        }
        for (_, rung) in &self.rungs {
            let RungDeed::Command(commands) = &rung.deed else { continue };
            for RungCommand { actuator, contract, .. } in commands {
                let found = ObjectName::new(actuator).is_ok_and(|object| {
                    actuators
                        .rows()
                        .iter()
                        .any(|row| row.object == object && row.contract == *contract)
                });
                if !found {
                    let rung = &rung.name;
                    return Err(format!(
                        "the rung {rung} commands {actuator} by `{contract}`, and the node has no \
                         such actuator: name one of its own"
                    ));
                }
            }
        }
        Ok(())
    }
}

impl Rung {
    /// Commands an actuator of this node, for as long as the rung lasts: again and again where its
    /// commands count for a while. It is taken from any other commander.
    pub fn command<M: Contract + Clone>(name: &str, actuator: &str, command: M) -> Self {
        let rung = Rung { name: name.to_owned(), deed: RungDeed::Command(Vec::new()) };
        rung.and_command(actuator, command)
    }

    /// Commands one more actuator. A rung that runs a component commands none.
    ///
    /// # Panics
    /// The rung runs a component.
    #[must_use]
    pub fn and_command<M: Contract + Clone>(mut self, actuator: &str, command: M) -> Self {
        let RungDeed::Command(commands) = &mut self.deed else {
            panic!("the rung {} runs a component, which commands actuators itself", self.name);
        };
        let object = actuator.to_owned();
        let command: CommandFn = Box::new(move |setup: &RungSetup, done| {
            Box::pin(keep_commanding(setup.clone(), object.clone(), command.clone(), done))
        });
        commands.push(RungCommand { actuator: actuator.to_owned(), contract: M::NAME, command });
        self
    }

    /// Runs a component under the root supervisor for as long as the rung lasts, such as one that
    /// drives back, or a tree.
    pub fn run<C: Component>(
        name: &str,
        spec: impl Fn() -> ChildSpec<C> + Send + Sync + 'static,
    ) -> Self {
        let spec = Arc::new(spec);
        let add: AddFn = Arc::new(move |node: Node| {
            let spec = spec.clone();
            Box::pin(async move {
                let added = node.add_child(spec()).await;
                added.map(|actor| actor.name().to_string()).map_err(|error| error.to_string())
            })
        });
        Rung { name: name.to_owned(), deed: RungDeed::Run(add) }
    }
}

/// What rungs command with.
#[derive(Clone)]
pub(super) struct RungSetup {
    pub(super) registry: Registry,
    pub(super) actuators: ActuatorTable,
    /// The commander's name, which is that of an object of this node.
    pub(super) own: String,
    pub(super) incarnation: Incarnation,
}

/// Claims the actuator and commands it until it is dropped, which gives the lease back.
async fn keep_commanding<M: Contract + Clone>(
    setup: RungSetup,
    actuator: String,
    message: M,
    done: Rc<Cell<bool>>,
) {
    let RungSetup { registry, actuators, own, incarnation } = setup;
    let Ok(object) = ObjectName::new(&actuator) else { return };
    // Three commands in a timeout tolerate two late ones.
    let repeat = actuators.command_timeout(&object, M::NAME).map(|timeout| timeout / 3);
    let (commander, renewing): (Commander<M>, _) = loop {
        match registry.sender::<ActuatorCommand>(&actuator) {
            Ok(way) => {
                break actuator::commander(actuator.clone(), way, (own.clone(), incarnation));
            }
            // Its component is not there; the last rung cuts it off.
            Err(_) => platform::sleep(RETRY_DELAY).await,
        }
    };
    let _renewing = OwnedTask::spawn(renewing);
    let mut counts = false;
    loop {
        if !commander.holds() {
            counts = false;
            actuators.seize(&object, M::NAME, &own);
            if let Err(why) = commander.claim_within(CLAIM_WITHIN).await {
                info!(actuator, %why, "the policy for lost communication claims again");
                platform::sleep(RETRY_DELAY).await;
                continue;
            }
        }
        if counts && repeat.is_none() {
            platform::sleep(HELD_INTERVAL).await;
            continue;
        }
        match commander.command_from(platform::now(), message.clone()).await {
            // A command that counts for ever may take longer than a lease.
            Ok(_) | Err(DeliveryError::DeadlinePassed) => {
                done.set(true);
                counts = true;
                platform::sleep(repeat.unwrap_or(HELD_INTERVAL)).await;
            }
            Err(_) => platform::sleep(RETRY_DELAY).await,
        }
    }
}
