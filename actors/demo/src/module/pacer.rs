//! Sends the numbered messages of a flow.

use super::measurements::Measurements;
use super::messages::Numbered;
use crate::robot::Flow;
use blastema::prelude::*;

/// The source of one flow.
#[derive(Debug)]
pub(super) struct Pacer {
    pub(super) measurements: Measurements,
    pub(super) flow: &'static Flow,
}

impl Component for Pacer {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let to = format!("{}:{}", self.flow.to, self.flow.sink);
        let Ok(sink) = cx.sender::<Numbered>(&to) else { return Ok(()) };
        self.measurements.offer(self.flow, |sample| {
            let (number, made_ns) = (sample.number, sample.sent.as_nanos());
            sink.tell(Numbered { epoch: sample.epoch, number, made_ns }).is_ok()
        });
        Ok(())
    }
}
