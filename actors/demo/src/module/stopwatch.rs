//! Measures how long other modules take to answer.

use super::counters::Counters;
use super::messages::EchoRequest;
use blastema::prelude::*;
use std::time::Duration;

/// Longer than any path takes, shorter than what the watch would call a hang.
const DEADLINE: Duration = Duration::from_millis(50);

/// Asks one other module again and again.
#[derive(Debug, Default)]
pub(super) struct Stopwatch {
    number: u64,
}

impl Component for Stopwatch {
    fn ports(ports: &mut Ports<Self>) {
        ports.asks::<EchoRequest>("echo");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let echo = cx.port::<Sender<EchoRequest>>("echo")?;
        self.number += 1;
        let asked = cx.now().as_nanos();
        // A request that fails is not an answer: the flows count what is lost.
        let answer = echo.ask_within(EchoRequest { number: self.number }, DEADLINE).await;
        if answer.is_ok_and(|number| number == self.number) {
            Counters::lock().measure(cx.name().as_str(), asked);
        }
        Ok(())
    }
}

/// Answers at once.
#[derive(Debug, Default)]
pub(super) struct Answerer;

impl Component for Answerer {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<EchoRequest>().named("echo");
    }
}

impl Handle<EchoRequest> for Answerer {
    async fn handle(&mut self, echo: EchoRequest, _: &mut Context<Self>) -> u64 {
        echo.number
    }
}
