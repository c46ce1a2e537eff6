//! Commanding actuators: a commander holds a lease, and the actuator takes its safe command when
//! the commander goes.
//!
//! ```text
//!  Commander ─ claim, renew, command ─► ActuatorTable of its node ─ epoch holds? ─► component
//!      ╳ (killed, cut off, hangs)         └─ lease over ─► cut-off, safe command ─► component
//! ```

mod command;
mod ports;
pub(crate) mod settings;
pub(crate) mod table;

pub use settings::ActuatorSettings;
pub use table::ActuatorRow;
pub(crate) use table::{ActuatorKey, ActuatorTable, DeclaredActuator};

use crate::messaging::sender::Sender;
use crate::platform::{self, lock};
use crate::registry::encoding::{OtherContract, encoded};
use crate::settings::LEASE;
use blastema_core::contract::codec;
use blastema_core::lease::{LeaseRules, StopBy};
use blastema_core::{Contract, ContractIdentity, DeliveryError, Incarnation, Instant};
use command::{ActuatorCommand, CommandDone, CommandKind};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::marker::PhantomData;
use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::Duration;
use tokio::sync::Notify;

/// How long a claim or a release may take.
const CLAIM_WITHIN: Duration = Duration::from_secs(1);
/// A claim that waits for its actuator asks again after this, and after twice as long each time: a
/// component restarts in milliseconds, a node takes seconds to come.
const CLAIM_AGAIN: RangeInclusive<Duration> =
    Duration::from_millis(10)..=Duration::from_millis(160);

/// How long a command of an actuator counts: the required argument of [`ActuatorSpec::new`].
///
/// A [`Duration`] is for commands that come again and again, such as a speed; `Hold` for those that
/// run for long, such as a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CommandTimeout {
    /// For so long after it was received, 10 ms to 1 min. Then the actuator gets its safe command,
    /// unless another command has come.
    After(Duration),
    /// Until another one comes, or the lease ends.
    Hold,
}

impl CommandTimeout {
    /// The time, where there is one.
    fn span(self) -> Option<Duration> {
        match self {
            CommandTimeout::After(timeout) => Some(timeout),
            CommandTimeout::Hold => None,
        }
    }
}

impl From<Duration> for CommandTimeout {
    fn from(timeout: Duration) -> Self {
        CommandTimeout::After(timeout)
    }
}

/// How a component lets itself be commanded; given to [`Ports::actuator`](crate::Ports::actuator).
pub struct ActuatorSpec<M: Contract> {
    safe: M,
    rules: LeaseRules,
    /// The command that stops it, where it is not the safe one.
    stop: Option<M>,
    settle_within: Duration,
    cut_off: Option<table::SafeOutputFn>,
}

impl<M: Contract> ActuatorSpec<M> {
    /// An actuator that `safe` brings to rest: zero speed, brakes on. The component gets this
    /// command like any other when its commander has gone, and when no command has come for
    /// `command_timeout`: a [`Duration`], or [`Hold`](CommandTimeout::Hold) for commands that run
    /// for long. A shorter timeout stops the actuator sooner when the commands cease, and needs
    /// commands that come more often: three of them in a timeout tolerate two late ones.
    ///
    /// The timeout is also the default of the component's [`max_wait`](crate::ChildSpec::max_wait).
    /// Set that where its hooks await something for longer.
    pub fn new(safe: M, command_timeout: impl Into<CommandTimeout>) -> Self {
        let command_timeout = command_timeout.into().span();
        let (span, stop_by) = (LEASE.default, StopBy::SafeCommand);
        // The component's own is known when it is declared.
        let max_wait = command_timeout.unwrap_or_default();
        let rules = LeaseRules { span, command_timeout, max_wait, stop_by };
        ActuatorSpec { safe, rules, stop: None, settle_within: Duration::ZERO, cut_off: None }
    }

    /// Sets how long a commander may be silent: 200 ms by default, 20 ms to 1 min. A shorter lease
    /// stops the actuator sooner, also for a commander that is only late.
    #[must_use]
    pub fn lease(mut self, span: Duration) -> Self {
        self.rules.span = span;
        self
    }

    /// Sets another command than the safe one to stop the actuator when its component leaves work
    /// in order: a drone whose safe command is to hover lands. See [stopping in
    /// order](crate::manual::commanding#stopping-in-order).
    #[must_use]
    pub fn on_stop(mut self, command: M) -> Self {
        (self.stop, self.rules.stop_by) = (Some(command), StopBy::StopCommand);
        self
    }

    /// Gives the actuator no command when its component leaves work in order: the component stops
    /// it in `on_deactivated`. Where that hook fails, or does not end in time, the
    /// [cut-off](Self::cut_off) is called.
    #[must_use]
    pub fn on_stop_by_hook(mut self) -> Self {
        (self.stop, self.rules.stop_by) = (None, StopBy::Hook);
        self
    }

    /// Sets how long the component goes on, with its rounds, timers and messages, after its stop
    /// command, unless it calls [`cx.settled()`](crate::Context::settled) before; zero unless set,
    /// at most its [`shutdown_within`](crate::ChildSpec::shutdown_within). A longer time lets a
    /// slower machine come to rest under control, and delays each orderly stop of one that never
    /// says that it has settled.
    #[must_use]
    pub fn settle_within(mut self, span: Duration) -> Self {
        self.settle_within = span;
        self
    }

    /// Sets a function that sets the outputs to their safe value. It is called when a lease ends
    /// other than by an orderly stop of the component, in addition to the safe command, so that a
    /// hang of the component does not prevent it; where the component does not take the safe
    /// command of a command timeout; where it fails after a command, and is not restarted on the
    /// spot; and where a stop command fails or is not carried out within `shutdown_within`.
    /// The cut-offs and [safe outputs](crate::NodeBuilder::safe_outputs) of a node are called one
    /// after the other on a thread of their own. One that blocks it for longer than
    /// [`callback_limit`](crate::NodeBuilder::callback_limit) is a fault of the component, and the
    /// others go on on a fresh thread.
    #[must_use]
    pub fn cut_off(mut self, cut_off: impl Fn() + Send + Sync + 'static) -> Self {
        self.cut_off = Some(Arc::new(cut_off));
        self
    }

    pub(crate) fn declared(self) -> Result<DeclaredActuator, DeliveryError> {
        let ActuatorSpec { safe, rules, stop, settle_within, cut_off } = self;
        Ok(DeclaredActuator {
            identity: ContractIdentity::of::<M>(),
            rules,
            max_age: M::MAX_AGE,
            stop: encoded(stop.as_ref().unwrap_or(&safe))?.into(),
            safe: encoded(&safe)?.into(),
            with_fields: settings::with_fields::<M>,
            settle_within,
            cut_off,
        })
    }
}

impl<M: Contract> fmt::Debug for ActuatorSpec<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ActuatorSpec of {}, {:?}", M::NAME, self.rules)
    }
}

/// Commands an actuator, here or on another node. The lease is renewed by itself for as long as the
/// incarnation that commands lasts and its thread turns; with the last clone it is given back.
pub struct Commander<M: Contract>(Arc<CommanderState>, PhantomData<fn(M)>);

/// What all clones of a commander share.
struct CommanderState {
    actuator: String,
    sender: Sender<ActuatorCommand>,
    identity: Vec<u8>,
    /// How the actuator's contract differs from the commander's.
    difference: fn(&OtherContract) -> DeliveryError,
    name: String,
    incarnation: Incarnation,
    held: Mutex<Option<Held>>,
    claimed: Notify,
    guard: Mutex<Option<CommandGuard>>,
}

/// Says why the commander may not hold its lease now.
pub(crate) type CommandGuard = Arc<dyn Fn() -> Result<(), DeliveryError> + Send + Sync>;

#[derive(Clone, Copy)]
struct Held {
    epoch: u64,
    span: Duration,
    /// By our own clock, counted from when we asked: never later than the actuator's node has it.
    until: Instant,
    /// As long as the last claim or renewal took, with its answer: no message of them, and none that
    /// is as fast, takes longer one way.
    way: Duration,
}

impl<M: Contract> Clone for Commander<M> {
    fn clone(&self) -> Self {
        Commander(self.0.clone(), PhantomData)
    }
}

impl<M: Contract> fmt::Debug for Commander<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Commander of {} as {}", M::NAME, self.0.name)
    }
}

/// A commander, and the task that renews its lease: where that runs, the commander lives.
pub(crate) fn commander<M: Contract>(
    actuator: String,
    sender: Sender<ActuatorCommand>,
    name: String,
    incarnation: Incarnation,
) -> (Commander<M>, impl Future<Output = ()> + 'static + use<M>) {
    let state = Arc::new(CommanderState {
        actuator,
        sender,
        identity: ContractIdentity::of::<M>().brief().encode(),
        difference: |other| other.difference::<M>("actuator"),
        name,
        incarnation,
        held: Mutex::default(),
        claimed: Notify::new(),
        guard: Mutex::default(),
    });
    let renewing = renew_lease(Arc::downgrade(&state));
    (Commander(state, PhantomData), renewing)
}

/// Renews the lease, a quarter of it after the last time, so that three that are lost in a row are
/// tolerated.
async fn renew_lease(state: Weak<CommanderState>) {
    loop {
        let Some(present) = state.upgrade() else { return };
        let held = present.held();
        match held {
            Some(Held { span, .. }) if present.may_hold().is_err() => {
                present.release(span).await;
            }
            Some(Held { epoch, span, .. }) => {
                let asked = platform::now();
                let renewed = present.send_command(CommandKind::Renew { epoch }, span).await;
                if let (Ok(_), Some(own)) = (&renewed, &mut *present.lock()) {
                    own.way = platform::now() - asked;
                }
                present.take_note(epoch, asked, renewed.map(|_| ()));
                drop(present);
                tokio::time::sleep(span / 4).await;
            }
            None => {
                // A claim may come between the look and the wait: it leaves its permit.
                let claimed = async { present.claimed.notified().await };
                // Dropping the last clone of a commander wakes no waiter: look again.
                let _ = tokio::time::timeout(CLAIM_WITHIN, claimed).await;
            }
        }
    }
}

impl CommanderState {
    fn lock(&self) -> MutexGuard<'_, Option<Held>> {
        lock(&self.held)
    }

    fn held(&self) -> Option<Held> {
        *self.lock()
    }

    fn may_hold(&self) -> Result<(), DeliveryError> {
        let guard = lock(&self.guard).clone();
        guard.map_or(Ok(()), |guard| guard())
    }

    /// Gives the lease back, where one is held.
    async fn release(&self, within: Duration) -> Option<DeliveryError> {
        let Held { epoch, .. } = self.lock().take()?;
        self.send_command(CommandKind::Release { epoch }, within).await.err()
    }

    async fn send_command(
        &self,
        wish: CommandKind,
        within: Duration,
    ) -> Result<CommandDone, DeliveryError> {
        let order = ActuatorCommand { identity: self.identity.clone(), wish };
        let asked = self.sender.ask_within(order, within).await;
        asked.map_err(|error| error.kind)?.map_err(|other| (self.difference)(&other))
    }

    /// The actuator's node has taken, or refused, something that was asked then.
    fn take_note(&self, epoch: u64, asked: Instant, result: Result<(), DeliveryError>) {
        let mut held = self.lock();
        let Some(own) = held.as_mut().filter(|held| held.epoch == epoch) else { return };
        match result {
            Ok(()) => own.until = own.until.max(asked + own.span),
            Err(DeliveryError::LeaseEnded { .. } | DeliveryError::Superseded { .. }) => {
                *held = None
            }
            // It may have arrived all the same. What counts is when it was last known to.
            Err(_) if platform::now() >= own.until => *held = None,
            Err(_) => {}
        }
    }
}

impl Drop for CommanderState {
    fn drop(&mut self) {
        if let Some(Held { epoch, .. }) = self.held() {
            let order = ActuatorCommand {
                identity: self.identity.clone(),
                wish: CommandKind::Release { epoch },
            };
            // Where it does not get through, the lease ends by itself.
            let _ = self.sender.tell(order);
        }
    }
}

impl<M: Contract> Commander<M> {
    /// Requests the lease and returns its epoch. Waits up to one second, as
    /// [`claim_within`](Self::claim_within) does, for an actuator that this commander cannot
    /// command yet.
    ///
    /// # Errors
    /// As [`claim_within`](Self::claim_within).
    pub async fn claim(&self) -> Result<u64, DeliveryError> {
        self.claim_within(CLAIM_WITHIN).await
    }

    /// Requests the lease and returns its epoch. Waits up to `limit` for an actuator that has not
    /// started, is held by another commander, is being restarted or stopped, or whose node cannot
    /// be reached. It asks again after 10 ms, and less and less often, down to every 160 ms: of
    /// several commanders that wait, any may get the lease first.
    ///
    /// A component that claims while it is being activated keeps those waiting that start after it:
    /// where the actuator is one of them, [spawn](crate::Context::spawn) the claim.
    ///
    /// # Errors
    /// [`DeliveryError::ContractDiffers`] at once. [`DeliveryError::Held`] where another commander
    /// still held the lease at the end, [`DeliveryError::Restarting`], [`DeliveryError::Unknown`]
    /// and [`DeliveryError::Unreachable`] where the actuator did not come in time; from other
    /// nodes, what any request may meet with.
    pub async fn claim_within(&self, limit: Duration) -> Result<u64, DeliveryError> {
        let due = platform::now() + limit;
        let mut pause = *CLAIM_AGAIN.start();
        loop {
            let left = due - platform::now();
            let refused = match self.try_claim(left.clamp(*CLAIM_AGAIN.start(), CLAIM_WITHIN)).await
            {
                Err(why) if comes_later(&why) => why,
                result => return result,
            };
            let left = due - platform::now();
            if left.is_zero() {
                return Err(refused);
            }
            platform::sleep(pause.min(left)).await;
            pause = (2 * pause).min(*CLAIM_AGAIN.end());
        }
    }

    async fn try_claim(&self, within: Duration) -> Result<u64, DeliveryError> {
        self.0.may_hold()?;
        let CommanderState { name, incarnation, .. } = &*self.0;
        let asked = platform::now();
        let wish = CommandKind::Claim { commander: name.clone(), incarnation: incarnation.0 };
        let CommandDone { epoch, span_us, .. } = self.0.send_command(wish, within).await?;
        let span = Duration::from_micros(span_us);
        let (until, way) = (asked + span, platform::now() - asked);
        *self.0.lock() = Some(Held { epoch, span, until, way });
        self.0.claimed.notify_one();
        Ok(epoch)
    }

    /// Says whether the lease is known to hold.
    pub fn holds(&self) -> bool {
        self.0.held().is_some_and(|held| platform::now() < held.until)
    }

    /// Sends a command and waits until the actuator has executed it, at most for the span of the
    /// lease. One command is in flight at a time.
    ///
    /// # Errors
    /// [`DeliveryError::LeaseEnded`] where no lease holds any more, [`DeliveryError::Superseded`]
    /// where another commander's does: the command was not carried out. [`DeliveryError::Full`]
    /// while an earlier command is in service. [`DeliveryError::AgeUnknown`] where the contract has
    /// a `max_age`: such commands are sent by [`command_from`](Self::command_from). Others as for
    /// any [request](crate::Sender::ask).
    pub async fn command(&self, message: M) -> Result<M::Reply, DeliveryError> {
        self.send(message, M::MAX_AGE.is_none().then_some(Duration::ZERO)).await
    }

    /// Sends a command that is made from data that was captured then, as
    /// [`cx.captured_at()`](crate::Context::captured_at) tells it. Where the contract of the command
    /// has a `max_age`, the actuator refuses one whose data is older, also if it has grown older on
    /// the way or in the queue: so commands cease where the data does, though its forwarder lives.
    ///
    /// ```text
    /// async fn handle(&mut self, goal: Goal, cx: &mut Context<Self>) {
    ///     let _ = self.wheels.command_from(cx.captured_at(), Drive(goal.speed)).await;
    /// }
    /// ```
    ///
    /// # Errors
    /// [`DeliveryError::Expired`] where the data is too old: the command was not carried out.
    /// [`DeliveryError::AgeUnknown`] for `None` where the contract has a `max_age`. Others as
    /// [`command`](Self::command).
    pub async fn command_from(
        &self,
        captured_at: impl Into<Option<Instant>>,
        message: M,
    ) -> Result<M::Reply, DeliveryError> {
        let captured_at = captured_at.into().or(M::MAX_AGE.is_none().then(platform::now));
        self.send(message, captured_at.map(|at| platform::now() - at)).await
    }

    async fn send(&self, message: M, age: Option<Duration>) -> Result<M::Reply, DeliveryError> {
        let now = platform::now();
        let age = age.ok_or_else(|| DeliveryError::AgeUnknown { contract: M::NAME.to_owned() })?;
        let Held { epoch, span, way, .. } = self
            .0
            .held()
            .filter(|held| now < held.until && self.0.may_hold().is_ok())
            .ok_or_else(|| DeliveryError::LeaseEnded { actuator: self.0.actuator.clone() })?;
        let [age_us, way_us] =
            [age, way].map(|span| u64::try_from(span.as_micros()).unwrap_or(u64::MAX));
        let message = encoded(&message)?;
        let command = CommandKind::Command { epoch, age_us, way_us, message };
        let done = self.0.send_command(command, span).await;
        let noted = done.as_ref().map(|_| ()).map_err(Clone::clone);
        self.0.take_note(epoch, now, noted);
        Ok(codec::decode_reply::<M>(&done?.reply)?)
    }

    /// Gives the lease back. The safe outputs are applied, as whenever a lease ends.
    ///
    /// # Errors
    /// Where this does not get through, the lease ends by itself.
    pub async fn release(&self) -> Result<(), DeliveryError> {
        self.0.release(CLAIM_WITHIN).await.map_or(Ok(()), Err)
    }

    /// Lets the commander claim, command and renew its lease only while this returns no error.
    pub(crate) fn guard(&self, guard: CommandGuard) {
        *lock(&self.0.guard) = Some(guard);
    }
}

/// Whether an actuator that refuses so may be there, and free, a little later.
fn comes_later(why: &DeliveryError) -> bool {
    use DeliveryError::{DeadlinePassed, Full, Held, PeerDied, Restarting, Unknown, Unreachable};
    matches!(
        why,
        Restarting
            | Full
            | DeadlinePassed
            | Held { .. }
            | PeerDied { .. }
            | Unknown { .. }
            | Unreachable { .. }
    )
}
