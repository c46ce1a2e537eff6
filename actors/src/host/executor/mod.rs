//! Serves one component's incarnation: hooks, timers, tasks and the data queue, every poll under
//! the guard.
//!
//! The guard is `catch_unwind` around each poll, inside the actor: actix never sees a panic, and
//! only the component is rebuilt. The component stays in its [`ComponentSlot`] while a handler that
//! unwinds borrows it, so that unwinding never runs its `Drop`; it is dropped afterwards, under a
//! guard of its own.

mod at_once;
mod ending;
mod reports;
mod service;
mod shared;

pub(crate) use shared::{SharedExecutor, executor_here};

use reports::ReportOutbox;
use service::{CurrentService, Service};

use super::lifecycle::{Hook, IncarnationLifecycle, LifecycleStep, StopOrder};
use super::schedule::{DueWork, ScheduledWork};
use crate::arbiter::pool::ArbiterSlot;
use crate::arbiter::turn_budget::TurnBudget;
use crate::component::Component;
use crate::component::cell::{Blame, ComponentCell, CurrentPlacement};
use crate::component::context::Context;
use crate::component::control::{CommandQueue, HostCommand};
use crate::component::envelope::{BoxedEnvelope, Envelope, EnvelopeHeader};
use crate::component::incarnation::IncarnationState;
use crate::component::slot::ComponentSlot;
use crate::liveness::activity::ActivitySlotRef;
use crate::liveness::label::{FACTORY, TASK, TIMER};
use crate::liveness::sampler::SampledComponent;
use crate::messaging::message_log;
use crate::messaging::queue::Popped;
use crate::platform;
use crate::platform::panics::PanicGuard;
use actix::Recipient;
use blastema_contract::child::ChildReport;
use blastema_core::{DeliveryError, Incarnation};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::task::{self, Poll, Waker};

/// Messages per poll while they are quick; then neighbours and the control queue have their turn.
const BUDGET: usize = 64;

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
    service: CurrentService<C>,
    schedule: ScheduledWork<C>,
    /// Shared with the component's tasks.
    budget: Rc<TurnBudget>,
    arbiter: ArbiterSlot,
    control: ControlInbox,
    /// This incarnation is over, and none comes after it here.
    over: bool,
    outbox: ReportOutbox,
}

/// The commands to an executor, and what wakes it for them and for anything else.
struct ControlInbox {
    commands: Arc<CommandQueue>,
    /// There from the first poll on.
    waker: Option<Waker>,
}

impl ControlInbox {
    /// Has commands wake this task from now on.
    fn follow(&mut self, waker: &Waker) {
        if self.waker.as_ref().is_none_or(|known| !known.will_wake(waker)) {
            self.waker = Some(waker.clone());
            self.commands.set_waker(self.waker.clone());
        }
    }

    /// Has the executor go on in a poll of its own.
    fn wake(&self) {
        if let Some(waker) = &self.waker {
            waker.wake_by_ref();
        }
    }
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
        let service = CurrentService::new();
        let state = Rc::new(IncarnationState::new(incarnation, service.slot.activity));
        let mut executor = ComponentExecutor {
            cell,
            state,
            lifecycle: IncarnationLifecycle::new(),
            component: None,
            service,
            schedule: ScheduledWork::default(),
            budget: Rc::default(),
            arbiter,
            control: ControlInbox { commands, waker: None },
            over: false,
            outbox: ReportOutbox::new(supervisor),
        };
        executor.begin_incarnation();
        let record = &executor.cell.record;
        let cell = Arc::downgrade(&executor.cell);
        let watched = SampledComponent {
            object: record.name.clone(),
            inside: cell,
            heartbeat: executor.arbiter.heartbeat.clone(),
            activity: executor.service.slot.activity,
            limits: record.limits.hang.clone(),
        };
        record.environment.watch_list.enter(executor.service.slot.index, watched);
        executor
    }

    fn begin_incarnation(&mut self) {
        let record = &self.cell.record;
        self.service.slot.activity.begin_incarnation(self.state.incarnation.0);
        self.state.token.mute(record.is_isolated());
        let (arbiter, token) = (self.arbiter.clone(), self.state.token.clone());
        let placement = CurrentPlacement { arbiter, slot: self.activity_slot(), token };
        let is_newest = record.enter(self.state.incarnation, placement);
        if let Some(lateness) = record.cold_if_used().and_then(|cold| cold.lateness.get()) {
            lateness.clear();
        }
        self.schedule.begin(record.limits.interval, self.arbiter.is_own_thread());
        self.service.slot.activity.run_every(record.limits.interval);
        // An incarnation that was abandoned before its placement was known was not notified.
        if !is_newest || self.cell.queue.owner() != Some(self.state.incarnation) {
            self.state.token.end();
        }
    }

    #[inline]
    pub(crate) fn activity_slot(&self) -> ActivitySlotRef {
        ActivitySlotRef { index: self.service.slot.index, activity: self.service.slot.activity }
    }

    /// Executes its commands.
    fn obey(&mut self) {
        for command in self.control.commands.take() {
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
        self.control.follow(cx.waker());
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
        self.arbiter.heartbeat.run(Some(self.service.slot.index));
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
        if work_waits && self.schedule.has_tasks_first() {
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
                    if !self.service.is_idle() && !self.budget.lasts() {
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
        self.service.slot.activity.poll_tasks(true);
        let polled = catch_unwind(AssertUnwindSafe(|| self.schedule.poll(cx)));
        self.service.slot.activity.poll_tasks(false);
        self.service.slot.activity.miss(self.schedule.take_missed());
        if let Err(payload) = polled {
            self.died(payload, TASK);
        }
        self.handle_limits();
        let is_spent = self.budget.is_spent();
        self.schedule.end_poll(is_spent);
        is_spent
    }

    /// One hook, timer or message a little further.
    fn step(&mut self, cx: &mut task::Context<'_>) -> Progress {
        if self.state.has_wishes() {
            self.grant();
        }
        if !self.service.is_idle() {
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
        if let Some(work) = self.schedule.next_in_turn() {
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
            self.service.slot.activity.expire();
            self.cell.return_envelope(envelope, DeliveryError::Expired);
            return Progress::More;
        }
        let followed = if header.is_followed { self.follow(&*envelope) } else { Ok(false) };
        let is_followed = match followed {
            Ok(is_followed) => is_followed,
            Err(why) => {
                self.cell.return_envelope(envelope, why);
                return Progress::More;
            }
        };
        self.begin_message(&header, &mut *envelope, is_followed);
        drop(envelope);
        self.advance(cx)
    }

    /// Notes the sender to notify if this message causes death, and returns whether the message is
    /// blamed by its identity then; fails if it is not to be served.
    fn follow(&mut self, envelope: &dyn Envelope<C>) -> Result<bool, DeliveryError> {
        if envelope.is_void() {
            self.service.slot.activity.expire();
            return Err(DeliveryError::DeadlinePassed);
        }
        let id = envelope.id();
        if id.is_some()
            && let Some(why) = self.cell.record.refusal(id)
        {
            return Err(why);
        }
        self.cell.record.begin_service(envelope.revocable(), id);
        Ok(id.is_some())
    }

    /// Fills the contract's slot.
    #[inline]
    fn begin_message(
        &mut self,
        header: &EnvelopeHeader,
        envelope: &mut dyn Envelope<C>,
        is_followed: bool,
    ) {
        let at = self.note_message(header, envelope);
        let Some(component) = &self.component else { return };
        if self.service.slots_in_use[at].future_slot.refill(envelope.contents(), component) {
            self.service.current = Service::Message { at, is_followed };
        } else {
            self.service.slot.activity.step();
        }
    }

    /// Names what is taken into service, and says which slot its future has.
    #[inline]
    fn note_message(&mut self, header: &EnvelopeHeader, envelope: &dyn Envelope<C>) -> usize {
        self.state.captured_at.set(Some(header.captured_at));
        message_log::begun(header.name, &self.cell.record.name, self.state.incarnation);
        let at = self.service.slot_for(header.contract, header.name, || envelope.future_slot());
        self.service.slot.activity.begin(self.service.slots_in_use[at].label);
        at
    }

    fn begin_hook(&mut self, hook: Hook) {
        let Some(component) = &self.component else { return };
        self.service.begin_hook(hook, component.clone());
    }

    /// What is in service, a little further.
    #[inline]
    fn advance(&mut self, cx: &mut task::Context<'_>) -> Progress {
        match &mut self.service.current {
            Service::Idle => return Progress::More,
            &mut Service::Message { at, is_followed } => {
                if self.service.slots_in_use[at].future_slot.poll(cx).is_pending() {
                    return self.wait();
                }
                self.service.current = Service::Idle;
                if is_followed {
                    self.cell.record.end_service();
                }
                self.service.slot.activity.step();
            }
            Service::Hook(hook, future) => {
                let Poll::Ready(result) = future.as_mut().poll(cx) else { return self.wait() };
                let hook = *hook;
                self.service.current = Service::Idle;
                self.hook_done(hook, result);
                self.service.slot.activity.step();
            }
        }
        Progress::More
    }

    /// What is in service awaits something, perhaps what it has just started.
    fn wait(&mut self) -> Progress {
        if self.state.has_wishes() {
            self.grant();
        }
        // A limit is set only for an incarnation that is not ready at once.
        if let Some(began) = self.state.began.take()
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
        self.service.slot.activity.begin(FACTORY.number());
        let cx = Context::new(self.cell.clone(), self.state.clone());
        let component = (self.cell.factory)();
        self.component = Some(Rc::new(ComponentSlot::new(component, cx)));
        self.service.slot.activity.step();
        self.pass_reports();
    }

    /// Fulfils what a handler or hook asked for.
    fn grant(&mut self) {
        let wishes = self.state.take_wishes();
        if let Some(interval) = wishes.interval {
            self.schedule.set_interval(interval);
            self.service.slot.activity.run_every(interval);
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
                self.service.slot.activity.tick();
                self.cell.record.begin_round(platform::now() - due);
                self.begin_hook(Hook::Execute);
                self.advance(cx)
            }
            DueWork::Timer(id) => {
                if let (Some(component), Some((mut action, missed))) =
                    (&self.component, self.schedule.lift(id))
                {
                    self.service.slot.activity.tick();
                    self.service.slot.activity.miss(missed.into());
                    self.service.slot.activity.begin(TIMER.number());
                    {
                        let mut contents = component.contents.borrow_mut();
                        let (component, cx) = contents.both();
                        action(component, cx);
                    }
                    self.service.slot.activity.step();
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
        if self.service.is_idle() {
            return;
        }
        self.lose_message();
        self.service.dispose(&self.cell.record, Blame::Log);
        self.service.slot.activity.step();
    }
}
