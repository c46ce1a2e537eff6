//! Measures how long an event takes within a module, with a condition and without (Fig. 10).

use super::measurements::Measurements;
use super::messages::Tick;
use crate::machine_instant::MachineInstant;
use blastema::prelude::*;

/// Publishes.
#[derive(Debug)]
pub(super) struct Ticker {
    pub(super) number: u64,
}

impl Component for Ticker {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.number += 1;
        cx.publish(Tick { number: self.number, made_ns: MachineInstant::now().as_nanos() });
        Ok(())
    }
}

/// Listens without a condition.
#[derive(Debug)]
pub(super) struct PlainListener {
    pub(super) measurements: Measurements,
}

impl Component for PlainListener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Tick>();
    }
}

impl Handle<Tick> for PlainListener {
    async fn handle(&mut self, tick: Tick, _: &mut Context<Self>) {
        self.measurements
            .record_tick(false, MachineInstant::now() - MachineInstant::from_nanos(tick.made_ns));
    }
}

/// Listens to every second event only.
#[derive(Debug)]
pub(super) struct ChoosyListener {
    pub(super) measurements: Measurements,
}

impl Component for ChoosyListener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Tick>().only_if(|tick| tick.number % 2 == 0);
    }
}

impl Handle<Tick> for ChoosyListener {
    async fn handle(&mut self, tick: Tick, _: &mut Context<Self>) {
        self.measurements
            .record_tick(true, MachineInstant::now() - MachineInstant::from_nanos(tick.made_ns));
    }
}
