//! Connects the director with the node of the module.

use super::fault_target::FaultTarget;
use super::measurements::Measurements;
use super::module_node;
use super::report::{event_of, links_of, objects_of, returned_of};
use crate::machine_instant::MachineInstant;
use crate::protocol::{DirectorCommand, ModuleEvent, OrderId, Snapshot};
use crate::robot::Module;
use crate::wiring::CableAddresses;
use blastema::prelude::*;
use blastema::{FaultEvent, FaultEvents};
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;
use tokio::sync::mpsc::{Receiver, Sender as Queue};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};

/// How often a snapshot is sent.
const SNAPSHOT: Duration = Duration::from_millis(100);
/// How long the node may take to stop in order. The director waits longer.
const FAREWELL: Duration = Duration::from_secs(1);
/// How long the last event may take to the director.
const LAST_WORD: Duration = Duration::from_millis(50);

/// The agent of the director in a module.
#[derive(Debug)]
pub(super) struct ModuleAgent {
    module: Module,
    keys: PathBuf,
    measurements: Measurements,
}

impl ModuleAgent {
    /// The module's key is the file `keys`, and reports go to `events`.
    pub(super) fn new(module: Module, keys: PathBuf, events: Queue<ModuleEvent>) -> ModuleAgent {
        ModuleAgent { module, keys, measurements: Measurements::new(module, events) }
    }

    /// Runs the node and executes commands until `Shutdown` or the end of the channel.
    pub(super) async fn hold(
        self,
        wiring: CableAddresses,
        mut commands: Receiver<DirectorCommand>,
    ) {
        let (node, mut faults) = match self.start(&wiring).await {
            Ok(started) => started,
            Err(event) => {
                self.measurements.tell(event);
                sleep(LAST_WORD).await;
                return;
            }
        };
        self.measurements.tell(ModuleEvent::Ready);
        let mut snapshots = interval(SNAPSHOT);
        snapshots.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                command = commands.recv() => match command {
                    None | Some(DirectorCommand::Shutdown) => break,
                    Some(command) => self.obey(&node, command).await,
                },
                Some(step) = faults.next() => self.pass_on(step),
                _ = snapshots.tick() => self.report(&node).await,
            }
        }
        // A node that does not shut down in time ends with its process.
        let _ = timeout(FAREWELL, node.shutdown()).await;
    }

    /// Starts the node, or returns why it cannot be started.
    async fn start(&self, wiring: &CableAddresses) -> Result<(Node, FaultEvents), ModuleEvent> {
        module_node::check_addresses(self.module, wiring).map_err(|error| {
            ModuleEvent::StartFailed { reason: error.to_string(), address_taken: true }
        })?;
        let builder = module_node::build(self.module, wiring, &self.measurements);
        let mut builder = builder.keys(&self.keys);
        let mut faults = builder.fault_events();
        let mut starting = pin!(builder.start());
        // Faults found during the start explain a failed start.
        let node = loop {
            tokio::select! {
                node = &mut starting => break node,
                Some(step) = faults.next() => self.pass_on(step),
            }
        };
        let failed = |error: StartError| ModuleEvent::StartFailed {
            reason: error.to_string(),
            address_taken: false,
        };
        Ok((node.map_err(failed)?, faults))
    }

    fn pass_on(&self, step: FaultEvent) {
        if let Some(event) = event_of(step) {
            self.measurements.tell(event);
        }
    }

    async fn obey(&self, node: &Node, command: DirectorCommand) {
        match command {
            DirectorCommand::Strike { order, object, fault } => {
                match FaultTarget::new(node, &self.measurements, order, object.as_str()) {
                    Ok(duty) => drop(tokio::spawn(duty.carry_out(fault))),
                    Err(why) => self.refuse(order, why.to_string()),
                }
            }
            DirectorCommand::Cut { order, cables } => {
                let cut = |cable: &String| module_node::cut(node, cable);
                self.answer(order, cables.iter().try_for_each(cut));
            }
            DirectorCommand::Restore { order, cables } => {
                let restore = |cable: &String| module_node::restore(node, cable);
                self.answer(order, cables.iter().try_for_each(restore));
            }
            DirectorCommand::PanicRouter { order } => {
                let at = MachineInstant::now();
                node.panic_router();
                self.measurements.tell(ModuleEvent::CarriedOut { order, at });
            }
            DirectorCommand::Watch { since } => self.measurements.watch(since),
            DirectorCommand::Status => self.report(node).await,
            DirectorCommand::Start { .. } | DirectorCommand::Shutdown => {}
        }
    }

    async fn report(&self, node: &Node) {
        let table = node.table().await;
        let (objects, links) = (objects_of(&table), links_of(&table));
        let mut snapshot = Snapshot { objects, links, ..self.measurements.snapshot() };
        let dead_letters = node.dead_letters().counts();
        for source in &mut snapshot.sources {
            source.returned = returned_of(&source.flow, &dead_letters);
        }
        self.measurements.tell(ModuleEvent::Snapshot(Box::new(snapshot)));
    }

    fn answer(&self, order: OrderId, outcome: Result<(), DeliveryError>) {
        match outcome {
            Ok(()) => {
                self.measurements.tell(ModuleEvent::CarriedOut { order, at: MachineInstant::now() })
            }
            Err(why) => self.refuse(order, why.to_string()),
        }
    }

    fn refuse(&self, order: OrderId, reason: String) {
        self.measurements.tell(ModuleEvent::Refused { order, reason });
    }
}
