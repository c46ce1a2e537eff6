//! How lives end, and what follows: a replacement on the spot, or a report and rest.

use super::{Pump, Service};
use crate::component::Component;
use crate::death_watch::{Down, Ending};
use crate::host::course::{Course, End};
use crate::host::label;
use crate::host::life::Life;
use crate::host::pump::outbox::Notice;
use crate::panics::{self, Guarded};
use crate::platform;
use blastema_contract::child::{ChildEvent, StandingOrder};
use blastema_contract::reports::{Exit, Exited};
use blastema_core::{Incarnation, Lifecycle, Why};
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;

impl<C: Component> Pump<C> {
    /// A condition that the component gave has panicked.
    pub(crate) fn die_of(&mut self, payload: Box<dyn Any + Send>, during: &'static str) {
        self.died(payload, during);
        if let Some(waker) = &self.waker {
            waker.wake_by_ref();
        }
    }

    pub(super) fn died_in_service(&mut self, payload: Box<dyn Any + Send>) {
        let during = label::name(self.slot.stamp.read().during);
        self.died(payload, during);
    }

    /// This life has ended by a panic. Begins the next one where a standing order says so.
    #[cold]
    pub(super) fn died(&mut self, payload: Box<dyn Any + Send>, during: &'static str) {
        let exit =
            Exit::Panicked { text: panics::text_of(payload), at: panics::take_place(), during };
        if self.slot.stamp.is_busy() {
            self.slot.stamp.step();
        }
        let incarnation = self.life.incarnation;
        self.life.token.end();
        if let Service::Message(_) = self.service {
            let contract = label::name(self.slot.stamp.read().during);
            self.anchor.record.blame(incarnation);
            self.anchor.record.bury(contract, &Why::PeerDied { incarnation });
        }
        self.bury();
        let restarted_as = self.may_restart().then(|| incarnation.next());
        let mine = match restarted_as {
            Some(next) => self.anchor.lane.pass_on(incarnation, next),
            None => self.anchor.lane.leave(incarnation),
        };
        if !mine {
            return self.leave(); // It had been given up before; nobody waits for its report.
        }
        match restarted_as {
            Some(next) => {
                self.life = Rc::new(Life::new(next, self.slot.stamp));
                self.course = Course::new(self.course.is_starting());
                self.start_failed = false;
                self.begin_life();
                let subscriptions = self.anchor.subscriptions();
                subscriptions.iter().for_each(|subscription| subscription.catch_up(&self.anchor));
            }
            None => self.over = true,
        }
        self.report_exit(incarnation, exit, restarted_as);
    }

    /// Draws on the standing order, if there is one.
    pub(super) fn may_restart(&mut self) -> bool {
        let Some(StandingOrder { times, period, .. }) = self.anchor.record.order() else {
            return false;
        };
        if self.course.is_ending() {
            return false;
        }
        let now = platform::now();
        while self.deaths.front().is_some_and(|&death| now - death > period) {
            self.deaths.pop_front();
        }
        let allowed = self.deaths.len() < usize::try_from(times).unwrap_or(usize::MAX);
        if allowed {
            self.deaths.push_back(now);
        }
        allowed
    }

    /// Tells how a life has ended: the monitor, the supervisor, and those who watch.
    pub(super) fn report_exit(
        &mut self,
        incarnation: Incarnation,
        exit: Exit,
        restarted_as: Option<Incarnation>,
    ) {
        let record = &self.anchor.record;
        if restarted_as.is_none() {
            record.give_names_back();
        }
        let object = record.name.clone();
        let ending = Ending::from(&exit);
        record.mourners.tell(&Down { object: object.clone(), incarnation, ending });
        let event = match (&exit, self.course.is_starting() && restarted_as.is_none()) {
            (Exit::Stopped, _) => ChildEvent::Stopped,
            (Exit::Panicked { text, at, .. }, true) => {
                ChildEvent::StartFailed { reason: format!("it panicked at {at}: {text}") }
            }
            _ => ChildEvent::Died { exit: exit.clone(), restarted_as },
        };
        // A life of which the supervisor knows that it never began does not die in addition.
        let known = self.start_failed && matches!(event, ChildEvent::Died { .. });
        let exited = Notice::Exited(Exited { object, incarnation, exit, restarted_as });
        // A replacement's own news come after the end of the life that it replaces.
        let place = self.outbox.iter().position(|notice| notice.is_of_after(incarnation));
        let place = place.unwrap_or(self.outbox.len());
        let child = (!known).then_some(Notice::Child(event, incarnation));
        self.outbox.splice(place..place, [exited].into_iter().chain(child));
    }

    /// The life ends without a panic, its hooks done.
    pub(super) fn end(&mut self, end: End) {
        let incarnation = self.life.incarnation;
        self.over = true;
        self.life.token.end();
        self.bury();
        let exit = match end {
            End::Stopped => {
                self.anchor.end_by(incarnation);
                Exit::Stopped
            }
            End::Replaced => {
                self.anchor.lane.leave(incarnation);
                Exit::Stopped
            }
            End::Returned => {
                self.anchor.lane.leave(incarnation);
                Exit::Returned
            }
            End::Fatal => {
                self.anchor.lane.leave(incarnation);
                Exit::Fatal
            }
        };
        self.anchor.record.set_state(Lifecycle::Finalized);
        self.report_exit(incarnation, exit, None);
    }

    /// Drops what is the user's: its `Drop` may panic, but not while unwinding and not into actix.
    pub(super) fn bury(&mut self) {
        let service = std::mem::replace(&mut self.service, Service::Idle);
        let nests = std::mem::take(&mut self.nests);
        self.followed = false;
        dispose((service, nests));
        dispose(self.chores.clear());
        dispose(self.life.take_wishes());
        dispose(self.home.take());
    }

    /// Somebody gave this life up and begins, or has begun, the next.
    pub(super) fn is_abandoned(&self) -> bool {
        self.life.token.has_ended() && !self.over
    }

    /// Ends without a word, after having been given up.
    pub(super) fn leave(&mut self) {
        self.over = true;
        let _guarded = Guarded::enter();
        self.bury();
        self.outbox.clear();
        if self.pulse.is_lost() {
            self.seat.return_late();
        } else {
            self.pulse.lift();
        }
    }

    /// The future is dropped: after its end, or because its arbiter goes away.
    pub(super) fn drop_before_the_end(&mut self) {
        if self.over {
            return;
        }
        if self.is_abandoned() {
            return self.leave();
        }
        let incarnation = self.life.incarnation;
        self.over = true;
        self.life.token.end();
        self.anchor.record.blame(incarnation);
        self.bury();
        self.anchor.lane.leave(incarnation);
        self.report_exit(incarnation, Exit::Aborted, None);
        self.flush();
    }
}

/// Drops a thing whose `Drop` is the user's.
pub(super) fn dispose<T>(thing: T) {
    let _guarded = Guarded::enter();
    if let Err(payload) = catch_unwind(AssertUnwindSafe(move || drop(thing))) {
        panics::text_of(payload); // What was thrown is the user's too.
    }
}
