//! How a component is to be run.

use super::child::ComponentChild;
use crate::component::Component;
use crate::component::cell::{CellCore, ComponentCell};
use crate::component::environment::ComponentEnvironment;
use crate::component::ports::Ports;
use crate::component::spec_error::SpecError;
use crate::host::reference::ActorRef;
use crate::liveness::limits::ComponentLimits;
use crate::messaging::queue::WhenFull;
use crate::platform::{self, panics};
use crate::settings::{
    MAX_BLOCK, MAX_DELAY, OWN_RATE_HZ, QUEUE, RATE_HZ, READY_WITHIN, SHARED_RATE_HZ,
    SHUTDOWN_WITHIN, SettingError,
};
use blastema_contract::child::Child;
use blastema_core::ObjectName;
use blastema_core::detection::Liveness;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Describes a component: its name, its factory, and how it is run and monitored.
#[must_use = "a child spec does nothing until it is given to a node or a supervisor"]
pub struct ChildSpec<C: Component> {
    name: String,
    factory: Box<dyn Fn() -> C + Send + Sync>,
    queue: (usize, WhenFull),
    rate_hz: Option<f64>,
    /// Copied when they are changed.
    limits: Arc<ComponentLimits>,
    max_wait: Option<Duration>,
    depends_on: Vec<String>,
    essential: bool,
    parameters: Vec<(String, String)>,
    more_ports: Vec<MorePorts<C>>,
}

/// Declares ports that depend on more than the component's type.
type MorePorts<C> = Box<dyn FnOnce(&mut Ports<C>) + Send>;

/// A component for its supervisor, and a reference to it.
type NamedChild<C> = (Box<dyn Child>, ActorRef<C>);

impl<C: Component> fmt::Debug for ChildSpec<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ChildSpec").field("name", &self.name).finish_non_exhaustive()
    }
}

impl<C: Component> ChildSpec<C> {
    /// The capacity of a component's [`queue`](Self::queue), unless that is set.
    pub const QUEUE: usize = QUEUE.default;
    /// The limit of [`max_block`](Self::max_block), unless that is set.
    pub const MAX_BLOCK: Duration = MAX_BLOCK.default;
    /// The limit of [`max_delay`](Self::max_delay), unless that is set.
    pub const MAX_DELAY: Duration = MAX_DELAY.default;
    /// The limit of [`ready_within`](Self::ready_within), unless that is set.
    pub const READY_WITHIN: Duration = READY_WITHIN.default;
    /// The limit of [`shutdown_within`](Self::shutdown_within), unless that is set.
    pub const SHUTDOWN_WITHIN: Duration = SHUTDOWN_WITHIN.default;

    /// A component that `factory` builds for every incarnation.
    ///
    /// Its queue holds 64 messages and refuses more; it shares an arbiter; its guard and the watch
    /// thread look after it.
    pub fn new(name: &str, factory: impl Fn() -> C + Send + Sync + 'static) -> Self {
        ChildSpec {
            name: name.to_owned(),
            factory: Box::new(factory),
            queue: (QUEUE.default, WhenFull::Refuse),
            rate_hz: None,
            limits: ComponentLimits::shared(),
            max_wait: None,
            depends_on: Vec::new(),
            essential: false,
            parameters: Vec::new(),
            more_ports: Vec::new(),
        }
    }

    fn limits(&mut self) -> &mut ComponentLimits {
        Arc::make_mut(&mut self.limits)
    }

    /// The component's name.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Declares ports in addition to `Component::ports`: those that depend on values of the
    /// program, such as the topic of one of several cameras, or the default of a variable.
    pub fn with_ports(mut self, declare: impl FnOnce(&mut Ports<C>) + Send + 'static) -> Self {
        self.more_ports.push(Box::new(declare));
        self
    }

    /// Calls `on_execute` so many times a second while the component is active: up to 500 times on a
    /// thread that it shares, and up to 10,000 times on [a thread of its own](Self::on_own_thread),
    /// whose timer is the kernel's. More is refused at start.
    ///
    /// Rounds are due at the start and then after each period. Of those that fall due while a round
    /// takes longer than a period, the latest is run, and the others are missed and counted.
    ///
    /// Where the node [has no thread](crate::NodeBuilder::components_on_this_thread) for the
    /// component, rounds are timed to the millisecond. In virtual time no rate is refused up to
    /// 100,000.
    pub fn rate_hz(mut self, rate_hz: f64) -> Self {
        self.rate_hz = Some(rate_hz);
        self
    }

    /// Sets the capacity of the queue, and what happens to a message that exceeds it. A longer
    /// queue bridges longer pauses and delivers older messages.
    pub fn queue(mut self, capacity: usize, when_full: WhenFull) -> Self {
        self.queue = (capacity, when_full);
        self
    }

    /// How its signs of life come.
    pub fn liveness(mut self, watch: Liveness) -> Self {
        self.limits().set_watch(watch);
        self
    }

    /// Runs the component on a thread of its own: for long computations or blocking calls.
    pub fn on_own_thread(mut self) -> Self {
        self.limits().own_thread = true;
        self
    }

    /// Gives the component's [own thread](Self::on_own_thread) a real-time priority, 1 to 99
    /// (`SCHED_FIFO`): it runs before every thread of a lower priority, and of none. Threads that it
    /// starts have the same priority.
    ///
    /// The start is refused where the system forbids it: it needs `rtprio` in
    /// `/etc/security/limits.conf`, `LimitRTPRIO=` of a systemd service, or CAP_SYS_NICE. Without
    /// effect where the node [has no thread](crate::NodeBuilder::components_on_this_thread) for it,
    /// as in virtual time.
    pub fn priority(mut self, priority: u8) -> Self {
        self.limits().scheduling.priority = Some(priority);
        self
    }

    /// Runs the component's [own thread](Self::on_own_thread) on the processor of this number alone.
    /// Others may run there too, unless the kernel keeps it free (`isolcpus`). The start is refused
    /// where the process may not use it. Without effect where [`priority`](Self::priority) is.
    pub fn cpu(mut self, cpu: usize) -> Self {
        self.limits().scheduling.cpu = Some(cpu);
        self
    }

    /// Sets how long a handler may keep its arbiter before it counts as a hang; at least 10 ms. A
    /// longer limit tolerates slow handlers, and delays neighbours longer behind a hang.
    pub fn max_block(mut self, span: Duration) -> Self {
        self.limits().hang().max_block = span;
        self
    }

    /// How long a handler or hook may await something before it counts as hanging; at least 1 ms.
    /// Unless set, it is the shortest command timeout of the component's
    /// [actuators](crate::ActuatorSpec::new), or 10 s where it has none.
    pub fn max_wait(mut self, span: Duration) -> Self {
        self.max_wait = Some(span);
        self
    }

    /// Sets how long a message may wait in the queue while the component works, before it is an
    /// [overload](blastema_core::FaultKind::Overload); one second unless set, at least 1 ms.
    pub fn max_delay(mut self, span: Duration) -> Self {
        self.limits().hang().max_delay = span;
        self
    }

    /// How many of its rounds may be missed, in percent, before that is an
    /// [overload](blastema_core::FaultKind::Overload) of what keeps its thread; 25 unless set, 100
    /// for any number.
    pub fn max_missed_rounds(mut self, percent: u8) -> Self {
        self.limits().hang().max_missed_percent = percent;
        self
    }

    /// How long an incarnation may take to become active; at least 1 ms.
    pub fn ready_within(mut self, span: Duration) -> Self {
        self.limits().ready_within = span;
        self
    }

    /// How long an incarnation may take to end in order; after that it is ended out of order. Zero
    /// gives it no time at all.
    pub fn shutdown_within(mut self, span: Duration) -> Self {
        self.limits().shutdown_within = span;
        self
    }

    /// Names the objects, on any node, without which the component cannot work. While one of them
    /// is down, a fault of the component counts as its symptom. Objects of this node must exist,
    /// and none of them may depend on this component.
    pub fn depends_on<'a>(mut self, names: impl IntoIterator<Item = &'a str>) -> Self {
        self.depends_on.extend(names.into_iter().map(str::to_owned));
        self
    }

    /// Gives one of its [parameters](crate::manual::parameters) a value, written with its unit, as
    /// in `12 m`. A [file of parameters](crate::NodeBuilder::parameters_from) prevails.
    pub fn parameter(mut self, key: &str, value: &str) -> Self {
        self.parameters.push((key.to_owned(), value.to_owned()));
        self
    }

    /// Its supervisor cannot do without it: if it is not worth restarting any more, or is put into
    /// the safe state because of a fault, the supervisor ends its children and itself and leaves
    /// the decision to its parent. Directly under the root that is the node's safe state.
    pub fn essential(mut self) -> Self {
        self.essential = true;
        self
    }

    pub(crate) fn is_essential(&self) -> bool {
        self.essential
    }

    /// What it depends on, as it was written.
    pub(crate) fn dependencies(&self) -> &[String] {
        &self.depends_on
    }

    /// How long an incarnation may take to become active, and to end in order.
    pub(crate) fn deadlines(&self) -> (Duration, Duration) {
        (self.limits.ready_within, self.limits.shutdown_within)
    }

    /// Gives the component its name and its ports. It lives when its supervisor starts it.
    ///
    /// # Errors
    /// Everything in the description that is wrong, else the first other error.
    pub(crate) fn into_child(
        self,
        environment: &Arc<ComponentEnvironment>,
    ) -> Result<NamedChild<C>, Vec<SpecError>> {
        let mut limits = self.limits.clone();
        let name = ObjectName::new(&self.name).map_err(SpecError::from)?;
        let name = SpecError::check_name(name)?;
        let more_ports = self.more_ports;
        let is_written = !self.parameters.is_empty();
        environment.configured().write(&name, self.parameters);
        environment.watch_list.declare(Some(name.clone()));
        let declared = panics::caught(move || {
            let mut ports = Ports::<C>::of();
            more_ports.into_iter().for_each(|declare| declare(&mut ports));
            ports
        });
        environment.watch_list.declare(None);
        let ports =
            declared.map_err(|panicked| SpecError::Ports { name: name.clone(), panicked })?;
        let interval = interval(self.rate_hz, limits.own_thread);
        if let Ok(Some(interval)) = interval {
            Arc::make_mut(&mut limits).interval = Some(interval);
        }
        if let Some(span) = self.max_wait.or(ports.max_wait) {
            Arc::make_mut(&mut limits).hang().max_wait = span;
        }
        let own = [interval.err(), QUEUE.check(self.queue.0).err()];
        let settings = own.into_iter().flatten().chain(limits.check());
        let setting = |error| SpecError::setting(&self.name, error);
        let mut refused: Vec<SpecError> = settings.map(setting).collect();
        let queues = ports.queues(self.queue.0);
        let capacities = queues.values().filter_map(|(capacity, _)| QUEUE.check(*capacity).err());
        refused.extend(capacities.map(setting));
        refused.extend(ports.check(&name).err());
        refused.extend(ports.refused(&name, &limits));
        if is_written || ports.parameters.is_some() {
            refused.extend(environment.configured().refused(&name, ports.parameters));
        }
        let scheduling = limits.scheduling;
        if refused.is_empty() && !scheduling.is_default() && !environment.arbiters.are_here() {
            refused.extend(scheduling.try_out().err().map(setting));
        }
        if !refused.is_empty() {
            return Err(refused);
        }
        let longest = u64::try_from(limits.shutdown_within.as_millis()).unwrap_or(u64::MAX);
        environment.longest_stop_ms.fetch_max(longest, Relaxed);
        let record = CellCore::new(name.clone(), limits, environment.clone());
        let cell = Arc::new(ComponentCell::new(record, self.queue, queues, self.factory));
        let registered = environment.registry.register(&name, ports.skeletons(&cell), cell.clone());
        registered.map_err(SpecError::from)?;
        // From here on the child gives the name back when it is dropped.
        let child = ComponentChild::new(cell.clone());
        ports.bind(&cell)?;
        Ok((Box::new(child), ActorRef(cell)))
    }
}

/// The time between two rounds.
fn interval(rate_hz: Option<f64>, own_thread: bool) -> Result<Option<Duration>, SettingError> {
    let Some(rate_hz) = rate_hz else { return Ok(None) };
    let kept = match own_thread {
        _ if platform::clock_stands() => RATE_HZ,
        true => OWN_RATE_HZ,
        false => SHARED_RATE_HZ,
    };
    kept.check(rate_hz)?;
    let interval = Duration::try_from_secs_f64(1.0 / rate_hz);
    interval
        .map(Some)
        .map_err(|_| RATE_HZ.refuse(format!("{rate_hz:?}"), "an interval that long cannot be kept"))
}
