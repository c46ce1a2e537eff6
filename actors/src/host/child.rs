//! What a supervisor does with a hosted component.

use super::executor::{ComponentExecutor, SharedExecutor};
use super::lifecycle::{is_message, is_start};
use crate::arbiter::pool::ArbiterSlot;
use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::control::{CommandQueue, HostCommand};
use crate::liveness::{label, sampler};
use crate::messaging::death_watch::{DownReason, Watchable};
use crate::messaging::injection::Injection;
use actix::Recipient;
use blastema_contract::child::{Child, ChildEvent, ChildOrder, ChildReport};
use blastema_core::{DeliveryError, FaultKind, Incarnation, Lifecycle, ObjectName};
use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

/// A hosted component in the hands of its supervisor.
pub(crate) struct ComponentChild<C: Component> {
    cell: Arc<ComponentCell<C>>,
    report: Option<Arc<Recipient<ChildReport>>>,
    /// Where the last incarnation was. The next one stays there if it can, so that what is spread
    /// over the arbiters stays so, and events keep their order.
    arbiter: Option<ArbiterSlot>,
    /// It was moved, or began so.
    own_thread: bool,
    /// The last incarnation was given up while it kept its thread: the next one has a thread for
    /// itself, so that it keeps no other component if it hangs too.
    kept_thread: bool,
}

impl<C: Component> ComponentChild<C> {
    pub(crate) fn new(cell: Arc<ComponentCell<C>>) -> Self {
        crate::platform::panics::install_hook();
        let own_thread = cell.record.limits.own_thread;
        ComponentChild { cell, report: None, arbiter: None, own_thread, kept_thread: false }
    }

    /// An incarnation is there, or on its way.
    fn command(&self, command: HostCommand) {
        if let Some(control) = self.cell.control() {
            control.send(command);
        }
    }

    /// Ends the present incarnation without waiting for it, and says whether it keeps its thread.
    /// `is_overdue`: it has had its time, and that is reported then.
    fn give_up(&mut self, is_overdue: bool) -> bool {
        let record = &self.cell.record;
        // At once: the guard may be about to pass the queue on to a replacement.
        let Some(incarnation) = self.cell.queue.evict() else { return false };
        record.environment.cut_short.fetch_add(1, Relaxed);
        let mut keeps_thread = false;
        if let Some(placement) = record.take_placement() {
            placement.token.end();
            record.environment.watch_list.leave(placement.slot.index);
            let reading = placement.slot.activity.read();
            let during = label::name(reading.during);
            if reading.component.turn % 2 == 1 && is_message(during) {
                record.record_dead_letter(during, &DeliveryError::PeerDied { incarnation });
            }
            record.record_fatal_message(incarnation);
            let heartbeat = &placement.arbiter.heartbeat;
            keeps_thread =
                heartbeat.running() == Some(placement.slot.index) && !heartbeat.is_here();
            if keeps_thread {
                // The hang detector judges it no more.
                if is_overdue && !heartbeat.is_fenced() {
                    let is_named =
                        reading.component.turn % 2 == 1 || reading.tasks || reading.condition;
                    let what = if is_named { sampler::during(&reading) } else { "its Drop" };
                    let phase = if is_start(during) { "start" } else { "stop" };
                    let detail = format!("{what} keeps its thread, and its {phase} was cut off");
                    record.declare(FaultKind::Hang, detail);
                }
                record.environment.arbiters.fence(&placement.arbiter, &record.name);
                self.kept_thread = true;
            }
        }
        // A handler that awaits is dropped by its own executor, which sees that it has been given
        // up.
        if let Some(control) = self.cell.control() {
            control.wake();
        }
        self.cell.set_control(None);
        if is_overdue {
            record.leave_work();
        }
        record.announce(|listener| listener.deactivated());
        record.tell_watchers(incarnation, DownReason::Abandoned);
        keeps_thread
    }

    fn tell(&self, incarnation: Incarnation, event: ChildEvent) {
        if let Some(report) = &self.report {
            let object = self.cell.record.name.clone();
            report.do_send(ChildReport { object, incarnation, event });
        }
    }
}

impl<C: Component> Child for ComponentChild<C> {
    fn name(&self) -> &ObjectName {
        &self.cell.record.name
    }

    fn start(
        &mut self,
        incarnation: Incarnation,
        report: Arc<Recipient<ChildReport>>,
    ) -> Incarnation {
        self.give_up(false);
        self.report = Some(report.clone());
        let record = &self.cell.record;
        record.set_state(Lifecycle::Created);
        let apart =
            std::mem::take(&mut self.kept_thread) && !record.environment.arbiters.are_here();
        let known = self.arbiter.take().filter(|arbiter| !apart && arbiter.is_usable());
        let arbiters = &record.environment.arbiters;
        let own_thread = (self.own_thread || apart).then_some(record.limits.scheduling);
        let place = || arbiters.place(&record.name, own_thread);
        let arbiter = match known.map_or_else(place, Ok) {
            Ok(arbiter) => arbiter,
            Err(error) => {
                record.set_incarnation(incarnation);
                let reason = format!("it was given no thread: {error}");
                self.own_thread = record.limits.own_thread;
                // No executor declares it, and the supervisor waits for the recoverer's decision.
                record.declare(FaultKind::InitializationFailed, reason.clone());
                self.tell(incarnation, ChildEvent::StartFailed { reason });
                return incarnation;
            }
        };
        let incarnation = self.cell.queue.begin(incarnation);
        record.set_incarnation(incarnation);
        // Until this incarnation is in its place it has none: that of the one before is another's.
        drop(record.take_placement());
        let control = Arc::<CommandQueue>::default();
        self.cell.set_control(Some(control.clone()));
        let cell = Some(self.cell.clone());
        let pending = PendingStart { cell, incarnation, report, control };
        self.arbiter = Some(arbiter.clone());
        let begin = move |arbiter| {
            if let Some(executor) = pending.enter(arbiter) {
                actix_rt::spawn(executor);
            }
        };
        arbiters.start_on(arbiter, Box::new(begin));
        incarnation
    }

    fn order(&mut self, order: ChildOrder) -> bool {
        let is_alive = self.cell.queue.owner().is_some();
        match order {
            ChildOrder::Stop { again: true } if is_alive => self.command(HostCommand::MakeWay),
            ChildOrder::Stop { .. } if is_alive => self.command(HostCommand::Stop),
            ChildOrder::Stop { again } => {
                if !again {
                    self.cell.record.leave_work();
                    self.cell.end();
                }
                self.tell(self.cell.record.incarnation(), ChildEvent::Stopped);
            }
            ChildOrder::ExpectEnd => {}
            ChildOrder::Retire => {
                self.give_up(false);
                self.cell.end();
            }
            ChildOrder::Abandon => {
                self.give_up(false);
            }
            ChildOrder::CutOff => return self.give_up(true),
            ChildOrder::Reset if is_alive => self.command(HostCommand::Reset),
            ChildOrder::Reset => {
                let reason = "it is not alive".to_owned();
                self.tell(self.cell.record.incarnation(), ChildEvent::ResetFailed { reason });
            }
            ChildOrder::Isolate(isolated) => self.cell.isolate(isolated),
            ChildOrder::GrantRestart(granted) => self.cell.record.grant_restart(granted),
        }
        false
    }

    fn move_to_own_thread(&mut self) -> Result<(), &'static str> {
        if self.own_thread {
            return Err("it has a thread of its own already");
        }
        if self.cell.record.environment.arbiters.are_here() {
            return Err("the whole node lives on one thread");
        }
        (self.own_thread, self.arbiter) = (true, None);
        Ok(())
    }

    fn explain_isolation(&mut self, reason: &str) {
        self.cell.record.cold().explain_isolation(Some(reason.to_owned()));
    }
}

impl<C: Component> Drop for ComponentChild<C> {
    fn drop(&mut self) {
        self.order(ChildOrder::Retire);
        let record = &self.cell.record;
        // Before the name is free for another component.
        record.announce(|listener| listener.removed());
        record.environment.registry.unregister(&record.name);
    }
}

impl<C: Component> Watchable for ComponentCell<C> {
    fn cell(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        Some(self)
    }

    fn component_type(&self) -> Option<&'static str> {
        Some(std::any::type_name::<C>())
    }

    fn life_cycle(&self) -> Option<(Incarnation, Lifecycle)> {
        Some((self.record.incarnation(), self.record.state()))
    }

    fn activate(&self, active: bool) {
        if let Some(control) = self.control() {
            control.send(HostCommand::Activate(active));
        }
    }

    fn inject(&self, injection: Injection) {
        self.record.cold().injected.put_in(injection);
        if injection == Injection::Panic
            && let Some(control) = self.control()
        {
            control.send(HostCommand::Panic);
        }
    }

    fn listen(self: Arc<Self>, like: usize, topic: &ObjectName) -> Result<(), DeliveryError> {
        self.add_subscription(like, topic)
    }

    fn stop_listening(&self, topic: &ObjectName) {
        self.remove_subscription(topic);
    }

    fn absent(&self) -> Option<Incarnation> {
        self.queue.owner().is_none().then(|| self.record.incarnation())
    }
}

/// An incarnation on its way to its arbiter. If that goes away first, the supervisor is notified.
struct PendingStart<C: Component> {
    cell: Option<Arc<ComponentCell<C>>>,
    incarnation: Incarnation,
    report: Arc<Recipient<ChildReport>>,
    control: Arc<CommandQueue>,
}

impl<C: Component> PendingStart<C> {
    /// The executor of the incarnation, unless that has been given up meanwhile.
    fn enter(mut self, arbiter: ArbiterSlot) -> Option<SharedExecutor<C>> {
        let cell = self.cell.take()?;
        if cell.queue.owner() != Some(self.incarnation) {
            arbiter.vacate();
            return None;
        }
        cell.attach(false);
        let incarnation = self.incarnation;
        let (report, control) = (self.report.clone(), self.control.clone());
        Some(SharedExecutor::new(ComponentExecutor::new(
            cell,
            incarnation,
            arbiter,
            report,
            control,
        )))
    }
}

impl<C: Component> Drop for PendingStart<C> {
    fn drop(&mut self) {
        let Some(cell) = self.cell.take() else { return };
        if cell.queue.leave(self.incarnation) {
            let reason = "its arbiter went away before it was there".to_owned();
            let object = cell.record.name.clone();
            let event = ChildEvent::StartFailed { reason };
            self.report.do_send(ChildReport { object, incarnation: self.incarnation, event });
        }
    }
}
