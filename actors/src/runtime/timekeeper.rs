//! The actor that lets a table which several threads share act on the time.

use crate::platform;
use crate::runtime::guardian::{Guardian, answers_the_monitor};
use actix::prelude::*;
use blastema_contract::reports::AreYouAlive;
use blastema_core::{Instant, ObjectName};
use std::sync::OnceLock;

/// The table has changed: it may want to act earlier than it said.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) struct Look;

/// Sees that a table acts in time.
struct TimekeeperActor {
    /// Acts on the time, and says when the table wants to act again.
    advance: Box<dyn FnMut(Instant) -> Option<Instant> + Send>,
    armed: Option<(Instant, SpawnHandle)>,
}

impl TimekeeperActor {
    fn look(&mut self, context: &mut Context<Self>) {
        let now = platform::now();
        let Some(due) = (self.advance)(now) else { return };
        match &self.armed {
            // Inputs that push the time out, such as renewals, arm nothing: the timer is left
            // standing, and looks again.
            Some((armed, _)) if *armed <= due && *armed > now => return,
            Some((_, handle)) => drop(context.cancel_future(*handle)),
            None => {}
        }
        let timer = tokio::time::sleep_until(platform::timer_at(due));
        let timer = actix::fut::wrap_future::<_, Self>(timer);
        let handle = context.spawn(timer.map(|(), timekeeper: &mut Self, context| {
            timekeeper.armed = None;
            timekeeper.look(context);
        }));
        self.armed = Some((due, handle));
    }
}

/// The timekeeper of one table, once it is started.
#[derive(Default)]
pub(crate) struct Timekeeper(OnceLock<Recipient<Look>>);

impl Timekeeper {
    /// Has `advance` called now, when it says, and when the table has changed. Returns where the
    /// actor that does can be asked whether it lives. A table is started once, with its node.
    pub(crate) fn start(
        &self,
        advance: impl FnMut(Instant) -> Option<Instant> + Send + 'static,
        name: ObjectName,
        guardian: &Guardian,
        arbiter: Option<&ArbiterHandle>,
    ) -> Recipient<AreYouAlive> {
        let advance = Box::new(advance);
        let make = move |_: &mut Context<_>| TimekeeperActor { advance, armed: None };
        let actor = guardian.start(name, arbiter, make);
        // The first one stays.
        let _ = self.0.set(actor.clone().recipient());
        actor.recipient()
    }

    /// The table has changed.
    pub(crate) fn look(&self) {
        if let Some(actor) = self.0.get() {
            actor.do_send(Look);
        }
    }
}

answers_the_monitor!(TimekeeperActor);

impl Actor for TimekeeperActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.armed = None;
        self.look(context);
    }
}

impl Supervised for TimekeeperActor {
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.started(context);
    }
}

impl Handler<Look> for TimekeeperActor {
    type Result = ();

    fn handle(&mut self, _: Look, context: &mut Context<Self>) {
        self.look(context);
    }
}
