//! Measures how long other modules take to answer.

use super::measurements::Measurements;
use super::messages::EchoRequest;
use crate::machine_instant::MachineInstant;
use crate::robot::Module;
use blastema::prelude::*;
use std::time::Duration;

/// The object that answers, in every module.
pub(super) const ECHO: &str = "measure/echo";

/// Longer than any path takes, shorter than what the watch would call a hang.
const DEADLINE: Duration = Duration::from_millis(50);

/// Asks one other module again and again.
#[derive(Debug)]
pub(super) struct Stopwatch {
    pub(super) measurements: Measurements,
    pub(super) of: Module,
    pub(super) number: u64,
}

impl Component for Stopwatch {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let Ok(other) = cx.sender::<EchoRequest>(&format!("{}:{ECHO}", self.of)) else {
            return Ok(());
        };
        self.number += 1;
        let asked = MachineInstant::now();
        // A request that fails is not an answer: the flows count what is lost.
        let answer = other.ask_within(EchoRequest { number: self.number }, DEADLINE).await;
        if answer.is_ok_and(|number| number == self.number) {
            self.measurements.answered(self.of, MachineInstant::now() - asked);
        }
        Ok(())
    }
}

/// Answers at once.
#[derive(Debug)]
pub(super) struct Answerer;

impl Component for Answerer {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<EchoRequest>();
    }
}

impl Handle<EchoRequest> for Answerer {
    async fn handle(&mut self, echo: EchoRequest, _: &mut Context<Self>) -> u64 {
        echo.number
    }
}
