//! A cell of the robot's skin: one of a hundred small objects. Some receive a flow.

use super::counters::Counters;
use super::messages::{Numbered, Ping, answers};
use blastema::prelude::*;

/// Feels pressure, ten times a second.
#[derive(Debug, Default)]
pub(super) struct SkinCell {
    pressure: f32,
}

impl Component for SkinCell {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>();
        ports.accept::<Numbered>().named("numbered");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.pressure = 0.9 * self.pressure + 0.01;
        cx.check_range("pressure", &self.pressure, 0.0..1.0);
        Ok(())
    }
}

impl Handle<Numbered> for SkinCell {
    async fn handle(&mut self, message: Numbered, cx: &mut Context<Self>) {
        let now = cx.now().as_nanos();
        let sinks = &mut Counters::lock().sinks;
        sinks.entry(message.flow.clone()).or_default().handle(&message, now);
    }
}

answers!(SkinCell);
