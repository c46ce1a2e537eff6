//! Serves one component's incarnation: hooks, timers, tasks and the data queue, every poll under
//! the guard.
//!
//! The guard is `catch_unwind` around each poll, inside the actor: actix never sees a panic, and
//! only the component is rebuilt. The component stays in its [`ComponentSlot`] while a handler that
//! unwinds borrows it, so that unwinding never runs its `Drop`; it is dropped afterwards, under a
//! guard of its own.

mod at_once;
mod ending;
mod shared;

pub(crate) use shared::{SharedExecutor, executor_here};

use ending::DeferredReport;

use super::lifecycle::{Hook, IncarnationLifecycle, LifecycleStep, StopOrder};
use super::schedule::{DueWork, ScheduledWork};
use crate::arbiter::pool::ArbiterSlot;
use crate::arbiter::turn_budget::TurnBudget;
use crate::component::cell::{Blame, ComponentCell, CurrentPlacement};
use crate::component::context::Context;
use crate::component::control::{CommandQueue, HostCommand};
use crate::component::envelope::{BoxedEnvelope, Envelope, EnvelopeHeader, FutureSlot};
use crate::component::incarnation::IncarnationState;
use crate::component::slot::ComponentSlot;
use crate::component::{Component, Failure};
use crate::liveness::activity::{ActivitySlot, ActivitySlotRef};
use crate::liveness::label::{self, FACTORY, TASK, TIMER};
use crate::liveness::sampler::SampledComponent;
use crate::messaging::message_log;
use crate::messaging::queue::Popped;
use crate::platform;
use crate::platform::panics::PanicGuard;
use actix::Recipient;
use blastema_contract::child::ChildReport;
use blastema_core::{DeliveryError, Incarnation, Instant, SlidingWindow};
use std::any::TypeId;
use std::future::Future;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::task::{self, Poll, Waker};

/// Messages per poll while they are quick; then neighbours and the control queue have their turn.
const BUDGET: usize = 64;
/// Future slots kept at most; a component that takes more contracts than this pays a box for the others.
const SLOTS_MAX: usize = 4;

/// What is in service.
enum Service {
    Idle,
    /// A message, in the slot of this number.
    Message(usize),
    Hook(Hook, Pin<Box<dyn Future<Output = Result<(), Failure>>>>),
}

struct SlotInUse<C: Component> {
    contract: TypeId,
    label: u32,
    future_slot: Box<dyn FutureSlot<C>>,
}

/// How far one step came.
enum Progress {
    /// Something is done; there may be more.
    More,
    /// Nothing to do now.
    Wait,
    /// Nothing to do for ever.
    Over,
}

pub(crate) struct ComponentExecutor<C: Component> {
    cell: Arc<ComponentCell<C>>,
    state: Rc<IncarnationState<C>>,
    lifecycle: IncarnationLifecycle,
    component: Option<Rc<ComponentSlot<C>>>,
    service: Service,
    slots_in_use: Vec<SlotInUse<C>>,
    schedule: ScheduledWork<C>,
    /// Shared with the component's tasks.
    budget: Rc<TurnBudget>,
    /// The last turn went to the component's tasks; this one begins with the next step.
    step_first: bool,
    /// The last step went to a round or a timer.
    message_next: bool,
    slot: ActivitySlot,
    arbiter: ArbiterSlot,
    waker: Option<Waker>,
    /// The message in service is to be blamed by its identity if it brings death.
    followed: bool,
    /// When the incarnation began, until it first awaits something.
    began: Option<Instant>,
    /// This incarnation is over, and none comes after it here.
    over: bool,
    /// The latest restarts by its guard, as far back as they count. There only where it has.
    deaths: Option<Box<SlidingWindow>>,
    outbox: Vec<DeferredReport>,
    supervisor: Arc<Recipient<ChildReport>>,
    commands: Arc<CommandQueue>,
}

impl<C: Component> ComponentExecutor<C> {
    /// An executor for an incarnation that begins on this arbiter.
    pub(crate) fn new(
        cell: Arc<ComponentCell<C>>,
        incarnation: Incarnation,
        arbiter: ArbiterSlot,
        supervisor: Arc<Recipient<ChildReport>>,
        commands: Arc<CommandQueue>,
    ) -> Self {
        let slot = ActivitySlot::claim();
        let state = Rc::new(IncarnationState::new(incarnation, slot.activity));
        let mut executor = ComponentExecutor {
            cell,
            state,
            lifecycle: IncarnationLifecycle::new(),
            component: None,
            service: Service::Idle,
            slots_in_use: Vec::new(),
            schedule: ScheduledWork::default(),
            budget: Rc::default(),
            step_first: false,
            message_next: false,
            slot,
            arbiter,
            waker: None,
            followed: false,
            began: None,
            over: false,
            deaths: None,
            outbox: Vec::new(),
            supervisor,
            commands,
        };
        executor.begin_incarnation();
        let record = &executor.cell.record;
        let cell = Arc::downgrade(&executor.cell);
        let watched = SampledComponent {
            object: record.name.clone(),
            inside: cell,
            heartbeat: executor.arbiter.heartbeat.clone(),
            activity: executor.slot.activity,
            limits: record.limits.hang.clone(),
        };
        record.environment.watch_list.enter(executor.slot.index, watched);
        executor
    }

    fn begin_incarnation(&mut self) {
        let record = &self.cell.record;
        self.slot.activity.begin_incarnation(self.state.incarnation.0);
        self.state.token.mute(record.is_isolated());
        let (arbiter, token) = (self.arbiter.clone(), self.state.token.clone());
        let placement = CurrentPlacement { arbiter, slot: self.activity_slot(), token };
        let is_newest = record.enter(self.state.incarnation, placement);
        if let Some(lateness) = record.cold_if_used().and_then(|cold| cold.lateness.get()) {
            lateness.clear();
        }
        self.schedule.begin(record.limits.interval, self.arbiter.is_own_thread());
        self.slot.activity.run_every(record.limits.interval);
        self.began = Some(platform::now());
        // An incarnation that was abandoned before its placement was known was not notified.
        if !is_newest || self.cell.queue.owner() != Some(self.state.incarnation) {
            self.state.token.end();
        }
    }

    #[inline]
    pub(crate) fn activity_slot(&self) -> ActivitySlotRef {
        ActivitySlotRef { index: self.slot.index, activity: self.slot.activity }
    }

    /// Executes its commands.
    fn obey(&mut self) {
        for command in self.commands.take() {
            match command {
                HostCommand::Stop => self.leave_by(StopOrder::Stop),
                HostCommand::MakeWay => self.leave_by(StopOrder::MakeWay),
                HostCommand::Reset => self.lifecycle.handle_reset(),
                HostCommand::Activate(active) => self.lifecycle.handle_activate(active),
                // The arbiter of the next incarnation attaches them all.
                HostCommand::Attach if self.is_abandoned() => {}
                HostCommand::Attach => self.cell.attach(true),
                HostCommand::Panic => {
                    drop(self.die_of(Box::new("it was told to panic"), "an injected fault"));
                }
            }
            self.pass_reports();
        }
    }

    fn leave_by(&mut self, order: StopOrder) {
        self.state.is_leaving.set(true);
        self.lifecycle.handle_stop(order);
    }

    /// One poll of everything. Ready when the last incarnation here is over.
    fn run(&mut self, cx: &mut task::Context<'_>) -> Poll<()> {
        if self.waker.as_ref().is_none_or(|waker| !waker.will_wake(cx.waker())) {
            self.waker = Some(cx.waker().clone());
            self.commands.set_waker(self.waker.clone());
        }
        self.obey();
        if self.is_abandoned() {
            self.leave();
            return Poll::Ready(());
        }
        if self.arbiter.heartbeat.is_lost() {
            return Poll::Pending; // The arbiter came back too late; the successor is on its way.
        }
        if self.budget.is_resting() {
            return Poll::Pending; // The scheduler wakes it when the others have had their turn.
        }
        let muted = self.state.token.is_muted();
        if muted {
            self.arbiter.heartbeat.mute(true);
        }
        self.arbiter.heartbeat.run(Some(self.slot.index));
        let guarded = PanicGuard::enter();
        self.budget.begin();
        let over = self.turn(cx);
        self.budget.end(cx.waker());
        drop(guarded);
        self.arbiter.heartbeat.run(None);
        if muted {
            self.arbiter.heartbeat.mute(false);
        }
        if self.is_abandoned() {
            self.leave();
            return Poll::Ready(());
        }
        self.flush();
        if over { Poll::Ready(()) } else { Poll::Pending }
    }

    /// Says whether the last incarnation here is over.
    fn turn(&mut self, cx: &mut task::Context<'_>) -> bool {
        if self.over {
            return true;
        }
        let mut work_waits = !self.schedule.is_empty();
        if work_waits && !std::mem::take(&mut self.step_first) {
            work_waits = false;
            if self.poll_chores(cx) {
                return self.over;
            }
        }
        for _ in 0..BUDGET {
            if self.over || self.state.token.has_ended() {
                return true;
            }
            match catch_unwind(AssertUnwindSafe(|| self.step(cx))) {
                Ok(Progress::More) => {}
                Ok(Progress::Wait) => {
                    if !matches!(self.service, Service::Idle) && !self.budget.lasts() {
                        return self.over;
                    }
                    if !work_waits && !self.schedule.is_fresh() {
                        return false;
                    }
                    work_waits = false;
                    if self.poll_chores(cx) {
                        return self.over;
                    }
                }
                Ok(Progress::Over) => return true,
                Err(payload) => self.died(payload, self.in_service()),
            }
            if !self.budget.lasts() {
                return self.over;
            }
        }
        self.budget.pause(cx.waker());
        false
    }

    /// Says whether that has used the turn up.
    fn poll_chores(&mut self, cx: &mut task::Context<'_>) -> bool {
        self.slot.activity.poll_tasks(true);
        let polled = catch_unwind(AssertUnwindSafe(|| self.schedule.poll(cx)));
        self.slot.activity.poll_tasks(false);
        self.slot.activity.miss(self.schedule.take_missed());
        if let Err(payload) = polled {
            self.died(payload, TASK);
        }
        self.handle_limits();
        self.step_first = self.budget.is_spent();
        self.step_first
    }

    /// One hook, timer or message a little further.
    fn step(&mut self, cx: &mut task::Context<'_>) -> Progress {
        if self.state.has_wishes() {
            self.grant();
        }
        if !matches!(self.service, Service::Idle) {
            return self.advance(cx);
        }
        if self.component.is_none() {
            self.build();
        }
        if !self.lifecycle.is_serving() {
            match self.lifecycle.next() {
                LifecycleStep::Run(hook) => {
                    self.begin_hook(hook);
                    return self.advance(cx);
                }
                LifecycleStep::Settle if self.is_settled() => {
                    self.cell.record.announce(|listener| listener.settled());
                    self.lifecycle.handle_settled();
                    return Progress::More;
                }
                LifecycleStep::Settle | LifecycleStep::Serve => {}
                LifecycleStep::Rest => return Progress::Wait,
                LifecycleStep::End(end) => {
                    self.end(end);
                    return Progress::Over;
                }
            }
        }
        // A message follows each round and timer, so that those which are late all the time leave
        // room.
        if !std::mem::take(&mut self.message_next)
            && let Some(work) = self.schedule.next_due()
        {
            self.message_next = true;
            return self.do_work(work, cx);
        }
        match self.cell.queue.take(self.state.incarnation, cx.waker()) {
            Popped::Got(envelope) => self.open(envelope, cx),
            Popped::Empty => match self.schedule.next_due() {
                Some(work) => self.do_work(work, cx),
                None => Progress::Wait,
            },
            Popped::Retired => {
                self.state.token.end();
                Progress::Over
            }
        }
    }

    /// Takes a message into service.
    #[inline]
    fn open(&mut self, mut envelope: BoxedEnvelope<C>, cx: &mut task::Context<'_>) -> Progress {
        let header = envelope.header();
        if header.is_expired() {
            self.slot.activity.expire();
            self.cell.return_envelope(envelope, DeliveryError::Expired);
            return Progress::More;
        }
        if header.is_followed
            && let Some(why) = self.follow(&*envelope)
        {
            self.cell.return_envelope(envelope, why);
            return Progress::More;
        }
        self.begin_message(&header, &mut *envelope);
        drop(envelope);
        self.advance(cx)
    }

    /// Notes the sender to notify if this message causes death; returns why it is not to be served.
    fn follow(&mut self, envelope: &dyn Envelope<C>) -> Option<DeliveryError> {
        if envelope.is_void() {
            self.slot.activity.expire();
            return Some(DeliveryError::DeadlinePassed);
        }
        let id = envelope.id();
        if id.is_some()
            && let Some(why) = self.cell.record.refusal(id)
        {
            return Some(why);
        }
        self.cell.record.begin_service(envelope.revocable(), id);
        self.followed = id.is_some();
        None
    }

    /// Fills the contract's slot.
    #[inline]
    fn begin_message(&mut self, header: &EnvelopeHeader, envelope: &mut dyn Envelope<C>) {
        let at = self.note_message(header, envelope);
        let Some(component) = &self.component else { return };
        if self.slots_in_use[at].future_slot.refill(envelope.contents(), component) {
            self.service = Service::Message(at);
        } else {
            self.slot.activity.step();
        }
    }

    /// Names what is taken into service, and says which slot its future has.
    #[inline]
    fn note_message(&mut self, header: &EnvelopeHeader, envelope: &dyn Envelope<C>) -> usize {
        self.state.captured_at.set(Some(header.captured_at));
        message_log::begun(header.name, &self.cell.record.name, self.state.incarnation);
        let at = self.slot_for(header.contract, header.name, || envelope.future_slot());
        self.slot.activity.begin(self.slots_in_use[at].label);
        at
    }

    /// Which slot the futures of a contract have.
    #[inline]
    fn slot_for(
        &mut self,
        contract: TypeId,
        name: &'static str,
        make: impl FnOnce() -> Box<dyn FutureSlot<C>>,
    ) -> usize {
        let known = self.slots_in_use.iter().position(|in_use| in_use.contract == contract);
        known.unwrap_or_else(|| {
            let label = label::number(name);
            self.slots_in_use.truncate(SLOTS_MAX - 1);
            self.slots_in_use.push(SlotInUse { contract, label, future_slot: make() });
            self.slots_in_use.len() - 1
        })
    }

    fn begin_hook(&mut self, hook: Hook) {
        let Some(component) = &self.component else { return };
        self.slot.activity.begin(hook.label().number());
        self.service = Service::Hook(hook, Box::pin(run_hook(component.clone(), hook)));
    }

    /// What is in service, a little further.
    #[inline]
    fn advance(&mut self, cx: &mut task::Context<'_>) -> Progress {
        match &mut self.service {
            Service::Idle => return Progress::More,
            Service::Message(at) => {
                if self.slots_in_use[*at].future_slot.poll(cx).is_pending() {
                    return self.wait();
                }
                self.end_message();
            }
            Service::Hook(hook, future) => {
                let Poll::Ready(result) = future.as_mut().poll(cx) else { return self.wait() };
                let hook = *hook;
                self.service = Service::Idle;
                self.hook_done(hook, result);
                self.slot.activity.step();
            }
        }
        Progress::More
    }

    /// The message in service has been served.
    #[inline]
    fn end_message(&mut self) {
        self.service = Service::Idle;
        if self.followed {
            self.followed = false;
            self.cell.record.end_service();
        }
        self.slot.activity.step();
    }

    /// What is in service awaits something, perhaps what it has just started.
    fn wait(&mut self) -> Progress {
        if self.state.has_wishes() {
            self.grant();
        }
        // A limit is set only for an incarnation that is not ready at once.
        if let Some(began) = self.began.take()
            && self.lifecycle.is_starting()
        {
            let within = self.cell.record.limits.ready_within;
            self.schedule
                .limit(DueWork::ReadyLimit, within.saturating_sub(platform::now() - began));
        }
        Progress::Wait
    }

    /// Builds the component; user code, so it runs under the guard.
    fn build(&mut self) {
        self.slot.activity.begin(FACTORY.number());
        let cx = Context::new(self.cell.clone(), self.state.clone());
        let component = (self.cell.factory)();
        self.component = Some(Rc::new(ComponentSlot::new(component, cx)));
        self.slot.activity.step();
        self.pass_reports();
    }

    /// Fulfils what a handler or hook asked for.
    fn grant(&mut self) {
        let wishes = self.state.take_wishes();
        if let Some(interval) = wishes.interval
            && self.schedule.set_interval(interval)
        {
            self.slot.activity.run_every(interval);
            self.lifecycle.handle_rate_changed();
        }
        if let Some(failure) = wishes.failure {
            self.cell.record.announce(|listener| listener.left_work(false));
            self.lifecycle.handle_failure(failure);
        }
        if wishes.stop {
            self.lifecycle.handle_return();
        }
        let timers = self.state.timers.get();
        self.schedule.take_on(wishes.tasks, &wishes.cancelled, timers, &self.budget);
        self.pass_reports();
    }

    fn do_work(&mut self, work: DueWork, cx: &mut task::Context<'_>) -> Progress {
        match work {
            DueWork::Execute(due) => {
                self.slot.activity.tick();
                self.cell.record.begin_round(platform::now() - due);
                self.begin_hook(Hook::Execute);
                self.advance(cx)
            }
            DueWork::Timer(id) => {
                if let (Some(component), Some((mut action, missed))) =
                    (&self.component, self.schedule.lift(id))
                {
                    self.slot.activity.tick();
                    self.slot.activity.miss(missed.into());
                    self.slot.activity.begin(TIMER.number());
                    {
                        let mut contents = component.contents.borrow_mut();
                        let (component, cx) = contents.both();
                        action(component, cx);
                    }
                    self.slot.activity.step();
                    self.schedule.put_back(id, action);
                }
                Progress::More
            }
            DueWork::ReadyLimit | DueWork::StopLimit | DueWork::SettleLimit | DueWork::Retry => {
                Progress::More
            }
        }
    }

    /// Gives up what is in service; its sender is notified.
    fn drop_service(&mut self) {
        if matches!(self.service, Service::Idle) {
            return;
        }
        self.lose_message();
        self.followed = false;
        self.dispose_service(Blame::Log);
        self.slot.activity.step();
    }
}

#[expect(
    clippy::await_holding_refcell_ref,
    reason = "messages wait while one is served; the control queue does not borrow"
)]
async fn run_hook<C: Component>(slot: Rc<ComponentSlot<C>>, hook: Hook) -> Result<(), Failure> {
    let mut contents = slot.contents.borrow_mut();
    let (component, cx) = contents.both();
    if let Some(injected) = cx.before() {
        injected.await;
    }
    match hook {
        Hook::Initialize if cx.fails_initialization() => Err("it was told to fail".into()),
        Hook::Initialize => component.on_initialize(cx).await,
        Hook::Startup => component.on_startup(cx).await,
        Hook::Activated => component.on_activated(cx).await,
        Hook::Execute => component.on_execute(cx).await,
        Hook::RateChanged => component.on_rate_changed(cx).await,
        Hook::Deactivated => component.on_deactivated(cx).await,
        Hook::Aborting => component.on_aborting(cx).await,
        Hook::Error => component.on_error(cx).await,
        Hook::Reset => component.on_reset(cx).await,
        Hook::Shutdown => component.on_shutdown(cx).await,
        Hook::Finalize => component.on_finalize(cx).await,
    }
}
