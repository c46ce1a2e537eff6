//! What a supervisor does with a hosted component.

use super::executor::{ComponentExecutor, SharedExecutor};
use super::lifecycle::is_message;
use crate::arbiter::pool::ArbiterSlot;
use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::control::{CommandQueue, HostCommand};
use crate::liveness::label;
use crate::messaging::death_watch::{Down, DownReason, Watchable, Watcher};
use crate::messaging::injection::Injection;
use actix::Recipient;
use blastema_contract::child::{Child, ChildEvent, ChildReport, RestartGrant};
use blastema_core::{DeliveryError, Incarnation, Lifecycle, ObjectName};
use std::any::Any;
use std::sync::Arc;

/// A hosted component in the hands of its supervisor.
pub(crate) struct ComponentChild<C: Component> {
    anchor: Arc<ComponentCell<C>>,
    report: Option<Arc<Recipient<ChildReport>>>,
    /// Where the last incarnation was. The next one stays there if it can, so that what is spread
    /// over the arbiters stays so, and events keep their order.
    seat: Option<ArbiterSlot>,
    /// It was moved, or began so.
    own_thread: bool,
    /// The last incarnation was given up while it kept its thread: the next one has a thread for
    /// itself, so that it keeps no other component if it hangs too.
    kept_thread: bool,
}

impl<C: Component> ComponentChild<C> {
    pub(crate) fn new(anchor: Arc<ComponentCell<C>>) -> Self {
        crate::platform::panics::install_hook();
        let own_thread = anchor.record.limits.own_thread;
        ComponentChild { anchor, report: None, seat: None, own_thread, kept_thread: false }
    }

    /// An incarnation is there, or on its way.
    fn is_alive(&self) -> bool {
        self.anchor.lane.owner().is_some()
    }

    fn order(&self, command: HostCommand) {
        if let Some(control) = self.anchor.control() {
            control.send(command);
        }
    }

    fn tell(&self, incarnation: Incarnation, event: ChildEvent) {
        if let Some(report) = &self.report {
            let object = self.anchor.record.name.clone();
            report.do_send(ChildReport { object, incarnation, event });
        }
    }
}

impl<C: Component> Child for ComponentChild<C> {
    fn name(&self) -> &ObjectName {
        &self.anchor.record.name
    }

    fn start(
        &mut self,
        incarnation: Incarnation,
        report: Arc<Recipient<ChildReport>>,
    ) -> Incarnation {
        self.abandon();
        self.report = Some(report.clone());
        let record = &self.anchor.record;
        record.set_state(Lifecycle::Created);
        let apart =
            std::mem::take(&mut self.kept_thread) && !record.environment.arbiters.are_here();
        let known = self.seat.take().filter(|seat| !apart && seat.is_usable());
        let arbiters = &record.environment.arbiters;
        let place = || arbiters.place(&record.name, self.own_thread || apart);
        let seat = match known.map_or_else(place, Ok) {
            Ok(seat) => seat,
            Err(error) => {
                record.set_incarnation(incarnation);
                let reason = format!("it was given no thread: {error}");
                self.own_thread = record.limits.own_thread;
                self.tell(incarnation, ChildEvent::StartFailed { reason });
                return incarnation;
            }
        };
        let incarnation = self.anchor.lane.begin(incarnation);
        record.set_incarnation(incarnation);
        // Until this incarnation is in its place it has none: that of the one before is another's.
        drop(record.take_seat());
        let control = Arc::<CommandQueue>::default();
        self.anchor.set_control(Some(control.clone()));
        let anchor = Some(self.anchor.clone());
        let boarding = PendingStart { anchor, incarnation, report, control };
        self.seat = Some(seat.clone());
        let begin = move |seat| {
            if let Some(pump) = boarding.enter(seat) {
                actix_rt::spawn(pump);
            }
        };
        arbiters.board(seat, Box::new(begin));
        incarnation
    }

    fn stop(&mut self) {
        if self.is_alive() {
            return self.order(HostCommand::Stop);
        }
        self.anchor.end();
        self.tell(self.anchor.record.incarnation(), ChildEvent::Stopped);
    }

    fn make_way(&mut self) {
        if self.is_alive() {
            return self.order(HostCommand::MakeWay);
        }
        self.tell(self.anchor.record.incarnation(), ChildEvent::Stopped);
    }

    fn retire(&mut self) {
        self.anchor.end();
    }

    fn abandon(&mut self) {
        let record = &self.anchor.record;
        let Some(incarnation) = self.anchor.lane.owner() else { return };
        self.anchor.lane.leave(incarnation);
        let seated = record.take_seat();
        if let Some(seated) = &seated {
            record.keep_unwinding(incarnation, seated);
        }
        record.tell_exits(incarnation);
        if let Some(seated) = seated {
            seated.token.end();
            record.environment.watch_list.leave(seated.slot.index);
            let reading = seated.slot.stamp.read();
            let during = label::name(reading.during);
            if reading.turn % 2 == 1 && is_message(during) {
                record.record_dead_letter(during, &DeliveryError::PeerDied { incarnation });
            }
            record.record_fatal_message(incarnation);
            let pulse = &seated.seat.pulse;
            if pulse.running() == Some(seated.slot.index) && !pulse.is_here() {
                record.environment.arbiters.fence(&seated.seat, &record.name);
                self.kept_thread = true;
            }
        }
        // A handler that awaits is dropped by its own pump, which sees that it has been given up.
        if let Some(control) = self.anchor.control() {
            control.wake();
        }
        self.anchor.set_control(None);
        record.announce(|listener| listener.deactivated());
        let (object, ending) = (record.name.clone(), DownReason::Abandoned);
        record.mourners.tell(|| Down { object, node: None, incarnation, ending });
    }

    fn move_to_own_thread(&mut self) -> Result<(), &'static str> {
        if self.own_thread {
            return Err("it has a thread of its own already");
        }
        if self.anchor.record.environment.arbiters.are_here() {
            return Err("the whole node lives on one thread");
        }
        (self.own_thread, self.seat) = (true, None);
        Ok(())
    }

    fn reset(&mut self) {
        if self.is_alive() {
            return self.order(HostCommand::Reset);
        }
        let reason = "it is not alive".to_owned();
        self.tell(self.anchor.record.incarnation(), ChildEvent::ResetFailed { reason });
    }

    fn isolate(&mut self, isolated: bool) {
        self.anchor.isolate(isolated);
        if isolated && !self.is_alive() {
            // No incarnation lives for which the queue could be kept.
            self.anchor.close(&DeliveryError::Isolated);
        }
    }

    fn standing_order(&mut self, order: Option<RestartGrant>) {
        self.anchor.record.set_order(order);
    }
}

impl<C: Component> Drop for ComponentChild<C> {
    fn drop(&mut self) {
        self.abandon();
        self.anchor.end();
        let record = &self.anchor.record;
        // Before the name is free for another component.
        record.announce(|listener| listener.removed());
        record.environment.registry.unregister(&record.name);
    }
}

impl<C: Component> ComponentCell<C> {
    /// The component is not started again for now: closes its queue and its subscriptions.
    pub(crate) fn end(self: &Arc<Self>) {
        self.close(&DeliveryError::Stopped);
        self.subscriptions().iter().for_each(|subscription| subscription.end(self));
    }

    /// The same, by the incarnation that ends in order.
    pub(crate) fn end_by(&self, incarnation: Incarnation) {
        if self.lane.owner() == Some(incarnation) {
            self.close_by(incarnation);
            self.subscriptions().iter().for_each(|subscription| subscription.end(self));
        }
    }
}

impl<C: Component> Watchable for ComponentCell<C> {
    fn cell(self: Arc<Self>) -> Option<Arc<dyn Any + Send + Sync>> {
        Some(self)
    }

    fn component_type(&self) -> Option<&'static str> {
        Some(std::any::type_name::<C>())
    }

    fn inject(&self, injection: Injection) {
        self.record.injected.put_in(injection);
        if injection == Injection::Panic
            && let Some(control) = self.control()
        {
            control.send(HostCommand::Panic);
        }
    }

    fn watch(&self, mourner: Watcher) {
        let mourner = Arc::new(mourner);
        self.record.mourners.join(mourner.clone());
        if self.lane.owner().is_none() {
            (mourner.tell)(Down {
                object: self.record.name.clone(),
                node: None,
                incarnation: self.record.incarnation(),
                ending: DownReason::NotAlive,
            });
        }
    }
}

/// An incarnation on its way to its arbiter. If that goes away first, the supervisor is told.
struct PendingStart<C: Component> {
    anchor: Option<Arc<ComponentCell<C>>>,
    incarnation: Incarnation,
    report: Arc<Recipient<ChildReport>>,
    control: Arc<CommandQueue>,
}

impl<C: Component> PendingStart<C> {
    /// The pump of the incarnation, unless that has been given up meanwhile.
    fn enter(mut self, seat: ArbiterSlot) -> Option<SharedExecutor<C>> {
        let anchor = self.anchor.take()?;
        if anchor.lane.owner() != Some(self.incarnation) {
            seat.vacate();
            return None;
        }
        for subscription in anchor.subscriptions().iter() {
            subscription.attach(&anchor);
        }
        let incarnation = self.incarnation;
        let (report, control) = (self.report.clone(), self.control.clone());
        Some(SharedExecutor::new(ComponentExecutor::new(
            anchor,
            incarnation,
            seat,
            report,
            control,
        )))
    }
}

impl<C: Component> Drop for PendingStart<C> {
    fn drop(&mut self) {
        let Some(anchor) = self.anchor.take() else { return };
        if anchor.lane.leave(self.incarnation) {
            let reason = "its arbiter went away before it was there".to_owned();
            let object = anchor.record.name.clone();
            let event = ChildEvent::StartFailed { reason };
            self.report.do_send(ChildReport { object, incarnation: self.incarnation, event });
        }
    }
}
