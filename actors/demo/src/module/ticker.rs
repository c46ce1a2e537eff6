//! Measures how long an event takes within a module, with a condition and without (Fig. 10).

use super::counters::Counters;
use super::messages::Tick;
use crate::messages::{FILTERED, UNFILTERED};
use blastema::prelude::*;

/// Publishes a [`Tick`] in every round.
#[derive(Debug, Default)]
pub(super) struct Ticker {
    number: u64,
}

impl Component for Ticker {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Tick>("tick");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.number += 1;
        let tick = Tick { number: self.number, sent: cx.now().as_nanos() };
        Ok(cx.port::<Publisher<Tick>>("tick")?.publish(tick)?)
    }
}

/// Listens without a condition.
#[derive(Debug, Default)]
pub(super) struct PlainListener;

impl Component for PlainListener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Tick>().named("tick");
    }
}

impl Handle<Tick> for PlainListener {
    async fn handle(&mut self, tick: Tick, _: &mut Context<Self>) {
        Counters::lock().measure(UNFILTERED, tick.sent);
    }
}

/// Listens to every second event only.
#[derive(Debug, Default)]
pub(super) struct ChoosyListener;

impl Component for ChoosyListener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Tick>().only_if(|tick| tick.number % 2 == 0).named("tick");
    }
}

impl Handle<Tick> for ChoosyListener {
    async fn handle(&mut self, tick: Tick, _: &mut Context<Self>) {
        Counters::lock().measure(FILTERED, tick.sent);
    }
}
