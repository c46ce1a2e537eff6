//! The sending end of a numbered flow.

use super::counters::Counters;
use super::messages::Numbered;
use blastema::prelude::*;

/// The source of the flow that has its name.
#[derive(Debug, Default)]
pub(super) struct FlowSource;

impl Component for FlowSource {
    fn ports(ports: &mut Ports<Self>) {
        ports.asks::<Numbered>("out");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let out = cx.port::<Sender<Numbered>>("out")?;
        let flow = cx.name().to_string();
        let mut counters = Counters::lock();
        let source = counters.process;
        let sent = counters.sent.entry(flow.clone()).or_default();
        let now = cx.now().as_nanos();
        // What is refused is not on its way, and its number is the next one's.
        if out.tell(Numbered { flow, source, number: *sent + 1, sent: now }).is_ok() {
            *sent += 1;
        }
        Ok(())
    }
}
