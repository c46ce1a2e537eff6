//! Does in a module what the director asks for.

use super::counters::Counters;
use super::messages::{Break, Ping};
use crate::faults::{Blow, DemoFault, FAULTS};
use crate::messages::{FaultReport, ModuleReport, ReadModule, SourceReport, Strike};
use crate::robot::FLOWS;
use blastema::core::detection::{FaultEntry, MonitorRow, Opinion};
use blastema::prelude::*;
use blastema::{DeadReason, DeliveryError, Direction, FaultLocation, Injection, platform};
use rustix::process::{Signal, getpid, kill_process};
use std::time::Duration;
use tokio::task::yield_now;
use tokio::time::sleep;

/// How long an object may take to answer: about what a person would call at once.
const ANSWER: Duration = Duration::from_millis(100);
/// Pings without a pause, so that a return within microseconds is measured as such.
const EAGER_PINGS: u32 = 100;
/// The pause between two of the further pings.
const BETWEEN_PINGS: Duration = Duration::from_millis(1);
/// How long an object needs for one message of a flood, so that its queue fills.
const FLOODED: Duration = Duration::from_millis(2);

/// The director's agent. It is on a node of its own, whose network is never cut.
#[derive(Debug)]
pub(super) struct Agent {
    /// The module's node of the robot.
    pub(super) robot: Node,
}

impl Component for Agent {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Strike>().serve::<ReadModule>();
    }
}

impl Handle<Strike> for Agent {
    async fn handle(&mut self, strike: Strike, cx: &mut Context<Self>) -> Result<u64, String> {
        let fault = FAULTS.get(strike.fault as usize).ok_or("there is no such fault")?;
        let at = cx.now().as_nanos();
        match fault.blow {
            Blow::Cut(_) | Blow::Blackout => {
                for cable in fault.cables() {
                    let cable = self.robot.cable(cable.name).ok_or("no such cable")?;
                    match strike.repair {
                        true => cable.restore(),
                        // The medium reports nothing.
                        false => cable.cut(Direction::Both, false),
                    }
                }
            }
            Blow::Router => self.robot.panic_router(),
            Blow::Kill => kill_process(getpid(), Signal::KILL).map_err(|e| e.to_string())?,
            Blow::Inject(_) | Blow::Break { .. } | Blow::Flood { .. } => {
                let struck = self.strike_object(fault, strike.fault, cx).await;
                return struck.map_err(|error| error.to_string());
            }
        }
        Ok(at)
    }
}

impl Agent {
    /// Breaks an object, and looks from then on when it answers again.
    async fn strike_object(
        &self,
        fault: &'static DemoFault,
        number: u32,
        cx: &mut Context<Self>,
    ) -> Result<u64, Box<dyn std::error::Error>> {
        let (object, robot) = (fault.object, self.robot.clone());
        let ping = robot.sender::<Ping>(object)?;
        let before = ping.ask(Ping {}).await?;
        let at = platform::now().as_nanos();
        match fault.blow {
            Blow::Break { .. } => robot.sender::<Break>(object)?.tell(Break {})?,
            Blow::Inject(injections) => {
                for injection in injections {
                    robot.inject(object, *injection)?;
                }
            }
            _ => robot.inject(object, Injection::Delay(FLOODED))?,
        }
        let answers = match fault.blow {
            // A reset, or a queue that is served, keeps the incarnation.
            Blow::Break { restarts: false } | Blow::Flood { .. } => before,
            _ => before + 1,
        };
        cx.spawn(async move {
            if let Blow::Flood { messages } = fault.blow {
                flood(&ping, messages).await;
            }
            served(&ping, answers).await;
            Counters::lock().served = Some((number, platform::now().as_nanos()));
            // What was put in goes with the incarnation that it was to end.
            let _ = robot.inject(object, Injection::Nothing);
        });
        Ok(at)
    }
}

impl Handle<ReadModule> for Agent {
    async fn handle(&mut self, read: ReadModule, _: &mut Context<Self>) -> ModuleReport {
        let (table, faults) = (self.robot.table().await, self.robot.faults().await);
        let letters = self.robot.dead_letters().counts();
        let source = |flow: &str, sent: u64| {
            let to = FLOWS.iter().find(|known| known.name == flow).map(|known| known.to.name());
            let count = |died: bool| {
                let of_flow = letters.iter().filter(|letter| {
                    letter.contract == "demo/numbered"
                        && letter.node.as_ref().map(|node| node.as_str()) == to
                        && (letter.reason == DeadReason::PeerDied) == died
                });
                of_flow.map(|letter| letter.count).sum()
            };
            let (perished, returned) = (count(true), count(false));
            SourceReport { flow: flow.to_owned(), sent, perished, returned }
        };
        let mut counters = Counters::lock();
        ModuleReport {
            process: counters.process,
            at: platform::now().as_nanos(),
            since: read.since,
            cables: table.iter().filter_map(cable).collect(),
            sources: counters.sent.iter().map(|(flow, sent)| source(flow, *sent)).collect(),
            sinks: counters
                .sinks
                .iter()
                .map(|(flow, sink)| sink.report(flow, read.since))
                .collect(),
            measured: std::mem::take(&mut counters.measured).into_iter().collect(),
            faults: faults.entries.iter().map(fault_report).collect(),
            served: counters.served,
        }
    }
}

/// Waits until this incarnation, or a later one, answers.
async fn served(ping: &Sender<Ping>, incarnation: u64) {
    let mut pings = 0;
    loop {
        match ping.ask_within(Ping {}, ANSWER).await {
            Ok(answering) if answering >= incarnation => return,
            _ if pings < EAGER_PINGS => yield_now().await,
            _ => sleep(BETWEEN_PINGS).await,
        }
        pings += 1;
    }
}

/// Keeps the queue full until it has taken so many messages: a pace in time is no flood where the
/// computer is so busy that this sleeps for longer than the object needs.
async fn flood(ping: &Sender<Ping>, messages: u32) {
    let mut taken = 0;
    while taken < messages {
        match ping.tell(Ping {}) {
            Ok(()) => taken += 1,
            Err(refused) if refused.kind == DeliveryError::Full => {
                sleep(Duration::from_millis(1)).await;
            }
            Err(_) => return,
        }
    }
}

fn cable(row: &MonitorRow) -> Option<(String, bool)> {
    match &row.location {
        // A degraded link is suspected, and still carries messages.
        FaultLocation::Link { link, .. } => {
            Some((link.to_string(), row.opinion != Opinion::Failed))
        }
        _ => None,
    }
}

fn fault_report(entry: &FaultEntry) -> FaultReport {
    let fault = entry.fault.clone();
    FaultReport {
        id: fault.id,
        kind: fault.kind,
        location: fault.location,
        found_at: fault.found_at.as_nanos(),
        detail: fault.detail,
        symptom_of: fault.symptom_of,
        recovered: entry.recovered_at.or(entry.repaired_at).is_some(),
        given_up: entry.given_up.as_ref().map(|(_, reason)| reason.clone()),
    }
}
