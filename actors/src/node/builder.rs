//! How a node is described.

mod networks;

use super::controller::NodeState;
use super::faults::{FaultEvents, FaultListener};
use super::lost_communication::LostCommunicationPolicy;
use super::network::description::NetworkDescription;
use super::tree::SupervisorSpec;
use super::watchdogs::ProcessWatchdogs;
use crate::component::Component;
use crate::fault_chain::strategy::{ApplyOutputs, RecoveryStrategy, StrategyTable};
use crate::host::spec::ChildSpec;
use crate::liveness::sampler::{Running, SampledComponents};
use crate::platform::own_arbiter;
use crate::settings::{CALLBACK_LIMIT, GRACE};
use actix::ArbiterHandle;
use blastema_core::recovery::{Plan, Restart, Strategy, WhenExceeded};
use blastema_core::{Fault, FaultKind};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use std::{fmt, io};
use tokio::sync::watch;

/// Where the values of parameters stand.
pub(super) enum Configuration {
    File(PathBuf),
    Text(String),
}

/// Where a node's actors live.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ActorPlacement {
    /// On threads of the node's own; so many of them are shared by components.
    Threads { shared: usize },
    /// The fault chain on a thread of its own, components on the thread that starts the node.
    ComponentsHere,
    /// Everything on the thread that starts the node, and under its clock.
    Here,
}

impl ActorPlacement {
    /// A thread for actors of the middleware, unless all actors live on the thread that starts the
    /// node.
    pub(super) fn own_arbiter(self) -> io::Result<Option<ArbiterHandle>> {
        match self {
            ActorPlacement::Here => Ok(None),
            ActorPlacement::Threads { .. } | ActorPlacement::ComponentsHere => {
                own_arbiter().map(Some)
            }
        }
    }
}

/// What is done about faults.
#[derive(Default)]
pub(super) struct FaultDescription {
    pub(super) plan: Plan,
    pub(super) own_kinds: Vec<FaultKind>,
    pub(super) strategies: StrategyTable,
    /// A strategy whose name was given to another one before.
    pub(super) strategy_twice: Option<String>,
    pub(super) safe_outputs: Option<ApplyOutputs>,
    pub(super) callback_limit: Duration,
    pub(super) policies: Vec<LostCommunicationPolicy>,
    pub(super) listeners: Vec<FaultListener>,
}

/// How the process of a node runs.
pub(super) struct ProcessDescription {
    pub(super) placement: ActorPlacement,
    pub(super) grace: Duration,
    pub(super) locks_memory: bool,
    pub(super) handles_signals: bool,
    pub(super) watchdogs: ProcessWatchdogs,
}

/// The files and the socket of a node.
#[derive(Default)]
pub(super) struct FileDescription {
    pub(super) variables: Option<PathBuf>,
    pub(super) parameters: Vec<Configuration>,
    #[cfg(feature = "unix")]
    pub(super) inspection_socket: Option<PathBuf>,
    #[cfg(feature = "journal")]
    pub(super) journal: Option<PathBuf>,
}

/// Describes a node. Nothing happens before [`start`](NodeBuilder::start).
#[must_use = "a node lives only after start()"]
pub struct NodeBuilder {
    pub(super) name: String,
    pub(super) root: SupervisorSpec,
    pub(super) connections: Vec<(String, String)>,
    pub(super) faults: FaultDescription,
    pub(super) process: ProcessDescription,
    pub(super) files: FileDescription,
    pub(super) networks: NetworkDescription,
    pub(super) state: watch::Sender<NodeState>,
    pub(super) watch_list: SampledComponents,
}

impl fmt::Debug for NodeBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeBuilder").field("name", &self.name).field("root", &self.root).finish()
    }
}

impl NodeBuilder {
    pub(super) fn new(name: &str) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        NodeBuilder {
            name: name.to_owned(),
            root: SupervisorSpec::new("", Strategy::OneForOne).rooted(),
            connections: Vec::new(),
            faults: FaultDescription {
                callback_limit: CALLBACK_LIMIT.default,
                ..FaultDescription::default()
            },
            process: ProcessDescription {
                placement: ActorPlacement::Threads { shared: cores },
                grace: GRACE.default,
                locks_memory: false,
                handles_signals: true,
                watchdogs: ProcessWatchdogs::default(),
            },
            files: FileDescription::default(),
            networks: NetworkDescription::default(),
            state: watch::Sender::new(NodeState::Starting),
            watch_list: SampledComponents::default(),
        }
    }

    /// Adds a component under the root supervisor. Children start in the order in which they are
    /// added.
    pub fn child<C: Component>(mut self, spec: ChildSpec<C>) -> Self {
        self.root = self.root.child(spec);
        self
    }

    /// Adds a component with this restart type under the root supervisor.
    pub fn child_with<C: Component>(mut self, spec: ChildSpec<C>, restart: Restart) -> Self {
        self.root = self.root.child_with(spec, restart);
        self
    }

    /// Adds a supervisor under the root supervisor, started after the children before it.
    pub fn supervisor(mut self, spec: SupervisorSpec) -> Self {
        self.root = self.root.supervisor(spec);
        self
    }

    /// Replaces the root supervisor by one with the children and rules of this spec, whose name is
    /// not used.
    pub fn root(mut self, spec: SupervisorSpec) -> Self {
        self.root = spec.rooted();
        self
    }

    /// Sets how many restarts of each child directly under the root are allowed in one `period`; of
    /// all together where [`when_exceeded`](Self::when_exceeded) or the strategy of the
    /// [`root`](Self::root) requires it.
    pub fn intensity(mut self, times: u32, period: Duration) -> Self {
        self.root = self.root.intensity(times, period);
        self
    }

    /// Sets what happens when restarts directly under the root exceed the
    /// [`intensity`](Self::intensity): by default the child is stopped; alternatively the node
    /// enters the safe state.
    pub fn when_exceeded(mut self, when_exceeded: WhenExceeded) -> Self {
        self.root = self.root.when_exceeded(when_exceeded);
        self
    }

    /// Keeps the values of variables in this file, so that they outlive the process: what the next
    /// one finds of each is what its [policy](crate::RestorePolicy) leaves. A write is answered
    /// when it is on the disk. A file that is damaged is set aside and becomes a fault. A path that
    /// is not absolute, or at which another node keeps its variables, is refused at start.
    pub fn keep_variables(mut self, file: impl Into<PathBuf>) -> Self {
        self.files.variables = Some(file.into());
        self
    }

    /// Reads the [parameters](crate::manual::parameters) of components from this file at the start.
    /// The file is TOML, with one table for each component: `[arm]`, `["arm/left"]`. Of several
    /// files, the later ones prevail. The path is absolute; any other is refused at start.
    pub fn parameters_from(mut self, file: impl Into<PathBuf>) -> Self {
        self.files.parameters.push(Configuration::File(file.into()));
        self
    }

    /// Takes the parameters of components from this text, written as in a
    /// [file](NodeBuilder::parameters_from).
    pub fn parameters(mut self, toml: &str) -> Self {
        self.files.parameters.push(Configuration::Text(toml.to_owned()));
        self
    }

    /// Shows the node to `blastema monitor`, and to whatever else connects to a Unix socket at this
    /// path: its [`snapshot`](crate::Node::snapshot), and the end. Only processes of the
    /// same user may look, and nothing can be changed from there. It can be seen from the start on,
    /// and in the safe state.
    ///
    /// The path is absolute; any other is refused at start, as is one that cannot be listened at.
    #[cfg(feature = "unix")]
    pub fn inspection_socket(mut self, path: impl Into<PathBuf>) -> Self {
        self.files.inspection_socket = Some(path.into());
        self
    }

    /// Keeps the list of faults in this file, so that it outlives the process: every step of every
    /// fault, with wall-clock times. `blastema fault list --journal` and
    /// [`journal::read`](crate::journal::read) show it, also while the node runs. The path is
    /// absolute.
    ///
    /// A file that cannot be written is a fault, and the node goes on without. A damaged file is
    /// set aside. A path that is not absolute, or at which another node writes its journal, is
    /// refused at start.
    #[cfg(feature = "journal")]
    pub fn journal(mut self, path: impl Into<PathBuf>) -> Self {
        self.files.journal = Some(path.into());
        self
    }

    /// Connects the out port of a component to the port of another one: `laser#scan` to
    /// `planner#scan`. It is connected before the components start.
    ///
    /// One end may be on another node: `base:laser#scan`. The connection is given to one node: for
    /// events to that of the listener, for commands and requests to that of the component that
    /// sends them.
    pub fn connect(mut self, from: &str, to: &str) -> Self {
        self.connections.push((from.to_owned(), to.to_owned()));
        self
    }

    /// Sets the recovery plan. The default plan covers every built-in kind of fault.
    pub fn plan(mut self, plan: Plan) -> Self {
        self.faults.plan = plan;
        self
    }

    /// Adds what the robot does when it loses a commander. It is checked at
    /// [`start`](NodeBuilder::start): rungs rise in time, the last one is a command, and actuators
    /// are this node's.
    pub fn lost_communication(mut self, policy: LostCommunicationPolicy) -> Self {
        self.faults.policies.push(policy);
        self
    }

    /// Declares a kind of fault of the application's own; the plan must answer it, and its code is
    /// no other kind's.
    pub fn fault_kind(mut self, code: &str) -> Self {
        self.faults.own_kinds.push(FaultKind::Custom(code.into()));
        self
    }

    /// Hands over a recovery strategy of the application's own, by the name that the plan uses: one
    /// of a name.
    pub fn recovery<S: RecoveryStrategy>(
        mut self,
        name: &str,
        make: impl Fn() -> S + Send + Sync + 'static,
    ) -> Self {
        if self.faults.strategies.names().any(|known| known == name) {
            self.faults.strategy_twice.get_or_insert(name.to_owned());
        }
        self.faults.strategies.hand_over(name, make);
        self
    }

    /// Sets the function that sets the robot's outputs to their safe value when an object or the
    /// node enters the safe state: brakes on, power off. It is called with the fault, for an object
    /// as for the whole node, on a thread of its own, one call after the other. A call that takes
    /// longer than [`callback_limit`](NodeBuilder::callback_limit) is a fault of `safe-outputs`;
    /// the fault chain then goes on without it.
    ///
    /// It is called too when the node is dropped while it runs, and for SIGTERM, SIGINT and SIGHUP
    /// unless [`without_signal_handling`](NodeBuilder::without_signal_handling) is given.
    pub fn safe_outputs(mut self, apply: impl Fn(&Fault) + Send + Sync + 'static) -> Self {
        self.faults.safe_outputs = Some(Arc::new(apply));
        self
    }

    /// Sets how long a [recovery strategy](RecoveryStrategy) may keep its thread without an await
    /// that waits, and how long [safe outputs](NodeBuilder::safe_outputs) and
    /// [cut-offs](crate::ActuatorSpec::cut_off) may take: 500 ms by default, from 10 ms to a
    /// minute. What takes longer is a fault under its own name, its thread is
    /// [abandoned](crate::Node::abandoned_threads), and the fault chain goes on. Shorter goes on
    /// sooner, and blames code that was merely slow.
    pub fn callback_limit(mut self, limit: Duration) -> Self {
        self.faults.callback_limit = limit;
        self
    }

    /// Notifies the service manager that started the process, such as systemd, that the node has
    /// started (`READY=1`), that it lives (`WATCHDOG=1`), and that it stops (`STOPPING=1`), or why
    /// it is in the safe state where it stops then (`STATUS=`).
    /// `WATCHDOG=1` is sent as long as each actor of the fault chain answers, four times in the
    /// `WatchdogSec=` of the service. Where no service manager has started the process, nothing is
    /// told.
    ///
    /// ```ini
    /// [Service]
    /// Type=notify
    /// WatchdogSec=10
    /// Restart=always
    /// ```
    pub fn notify_systemd(mut self) -> Self {
        self.process.watchdogs.systemd = true;
        self
    }

    /// Strokes the computer's watchdog, such as `/dev/watchdog`, once a second for as long as each
    /// actor of the fault chain answers. It is opened, and so armed, when the node starts.
    /// [`Node::shutdown`](crate::Node::shutdown) disarms it; where the process ends otherwise, or
    /// the fault chain stands, it restarts the computer.
    ///
    /// The path is absolute; any other is refused at start, as is a device that cannot be opened or
    /// is no watchdog. A regular file or a pipe takes the place of the device in a test.
    pub fn watchdog_device(mut self, path: impl Into<PathBuf>) -> Self {
        self.process.watchdogs.device = Some(path.into());
        self
    }

    /// Leaves SIGTERM, SIGINT and SIGHUP to the program. Otherwise a node with safe outputs,
    /// actuators or a journal handles them: the safe outputs are applied, the journal gets an
    /// entry, and the process ends with the status 128 and the signal's number. SIGHUP stays
    /// ignored in a process that was started so, as by `nohup`. Where
    /// [`Node::run_until_signal`](crate::Node::run_until_signal) waits, it shuts the node down
    /// instead.
    pub fn without_signal_handling(mut self) -> Self {
        self.process.handles_signals = false;
        self
    }

    /// Sets the number of arbiters that components share: 1 to 1024, one per core by default.
    pub fn work_threads(mut self, shared: usize) -> Self {
        self.process.placement = ActorPlacement::Threads { shared };
        self
    }

    /// Keeps all memory of the process from being swapped out, from the start on and for as long as
    /// the process runs: a page that is read back from a disk costs a round milliseconds. All of it
    /// is then in use at once, also the 2 MiB of each thread's stack.
    ///
    /// The start is refused where the system forbids it: it needs `memlock unlimited` in
    /// `/etc/security/limits.conf`, `LimitMEMLOCK=infinity` of a systemd service, or CAP_IPC_LOCK.
    /// Without effect in virtual time.
    pub fn locked_memory(mut self) -> Self {
        self.process.locks_memory = true;
        self
    }

    /// The time of [`grace`](Self::grace), unless that is set.
    pub const GRACE: Duration = GRACE.default;

    /// How long a handler that was found hanging still has to return before its neighbours on the
    /// same arbiter are re-created elsewhere; an hour at most.
    pub fn grace(mut self, grace: Duration) -> Self {
        self.process.grace = grace;
        self
    }

    /// Runs the components on the thread that starts the node, beside other tasks of that thread; a
    /// component that hangs takes them along.
    pub fn components_on_this_thread(mut self) -> Self {
        self.process.placement = ActorPlacement::ComponentsHere;
        self
    }

    /// Runs everything on the thread that starts the node and under its clock: for tests in virtual
    /// time. A component that hangs cannot be recovered there.
    pub fn on_this_thread(mut self) -> Self {
        self.process.placement = ActorPlacement::Here;
        self
    }

    /// Tells from outside which component is on a thread, also while the node starts.
    #[doc(hidden)]
    pub fn running(&self) -> Running {
        Running(self.watch_list.clone())
    }

    /// Every step in the history of every fault from the first on, also of those that are found
    /// while the node starts, which [`Node::fault_events`](crate::Node::fault_events) is too late
    /// for.
    ///
    /// ```
    /// use blastema::prelude::*;
    /// # struct Lamp;
    /// # impl Component for Lamp {
    /// #     async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
    /// #         if cx.incarnation().0 > 1 { Ok(()) } else { Err("it is dark".into()) }
    /// #     }
    /// # }
    /// # blastema::run(async {
    /// let mut builder = Node::builder("module1").child(ChildSpec::new("lamp", || Lamp));
    /// let mut faults = builder.fault_events();
    /// let node = builder.start().await?;
    ///
    /// let first = faults.next().await.expect("the lamp did not start at once");
    /// assert_eq!(first.fault.kind, FaultKind::InitializationFailed);
    /// # node.shutdown().await;
    /// # Ok::<(), StartError>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn fault_events(&mut self) -> FaultEvents {
        let (events, listener) = FaultEvents::open(self.state.subscribe());
        self.faults.listeners.push(listener);
        events
    }
}
