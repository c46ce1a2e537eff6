//! Runs the scenario on three processes, which are children of the director's node: for them it is
//! what the init system is on a robot's computers.

use crate::faults::{Blow, FAULTS};
use crate::messages::{ModuleReport, ReadModule, Strike};
use crate::report::Report;
use crate::robot::Module;
use crate::run_folder::{AGENT, DIRECTOR, RunFolder, control_network, reason_of};
use crate::scenario::{Scenario, ScenarioOrder};
use blastema::platform::{self, Termination, Terminations};
use blastema::prelude::*;
use blastema::{
    Contract, FaultEvent, FaultEvents, FaultLocation, FaultTransition, Instant, ProcessSpec,
};
use rustix::process::{Resource, getrlimit};
use std::cell::Cell;
use std::fs;
use std::io::{self, Write};
use std::pin::pin;
use std::rc::Rc;
use std::time::Duration;
use tokio::sync::mpsc::{Sender as Queue, channel};
use tokio::task::spawn_local;
use tokio::time::{MissedTickBehavior, interval};

/// How often each module is looked at.
const LOOK: Duration = Duration::from_millis(100);
/// Reports that may wait for the director: those of some seconds.
const QUEUE: usize = 64;
/// How long a module may take to answer.
const ANSWER: Duration = Duration::from_secs(1);
/// How long a module may take to do what it is told, on a busy machine.
const ORDER: Duration = Duration::from_secs(10);
/// A module that gives no sign of life for so long is restarted.
const WATCHDOG: Duration = Duration::from_secs(3);
/// How long a module may take to stop in order before it is killed.
const FAREWELL: Duration = Duration::from_secs(2);
/// How long a module's process may take to be ready, on a busy machine.
const ENTRY: Duration = Duration::from_secs(20);
/// Restarts of a module in a run: more than the scenario needs, and fewer than for ever.
const RESTARTS: u32 = 5;
/// Files that a module's process must be able to open: about sixty for its threads and cables, and
/// reserve.
const FILES: u64 = 96;

/// Runs the scenario, shows its lines or not, and ends all processes. The report is missing if it
/// did not begin.
pub(crate) async fn run(shows_lines: bool) -> (Option<Report>, Result<(), String>) {
    let (mut signals, folder) = match prepare() {
        Ok(prepared) => prepared,
        Err(error) => return (None, Err(error)),
    };
    let mut scenario = Scenario::new(platform::now());
    let mut builder = Node::builder(DIRECTOR)
        .supervisor(modules(&folder))
        .network(control_network(folder.path(), DIRECTOR))
        .components_on_this_thread()
        .without_signal_handling();
    let mut faults = builder.fault_events();
    let mut starting = pin!(builder.start());
    let started = tokio::select! {
        started = &mut starting => started.map_err(|error| {
            with_reasons(format!("the modules do not start: {error}"), &folder)
        }),
        signal = signals.next() => {
            // A start that is dropped leaves processes behind, which end a little later.
            let ended = async {
                if let Ok(node) = starting.await {
                    node.shutdown().await;
                }
            };
            tokio::select! {
                () = ended => {}
                _ = signals.next() => {}
            }
            Err(interrupted(signal))
        }
    };
    let node = match started {
        Ok(node) => node,
        Err(error) => return (None, Err(error)),
    };
    let outcome =
        direct(&mut scenario, &node, &folder, &mut faults, &mut signals, shows_lines).await;
    // A second signal ends the wait.
    tokio::select! {
        () = node.shutdown() => {}
        _ = signals.next() => {}
    }
    (Some(scenario.report()), outcome)
}

/// Catches signals before the first process is started, so that none is left behind.
fn prepare() -> Result<(Terminations, RunFolder), String> {
    let files = getrlimit(Resource::Nofile).current;
    if let Some(files) = files.filter(|files| *files < FILES) {
        return Err(format!(
            "a process may open {files} files here, and a module needs {FILES}: raise the limit, as \
             with `ulimit -n {FILES}`"
        ));
    }
    let system = |what| move |error: io::Error| format!("{what}: {error}");
    let signals = Terminations::listen().map_err(system("signals cannot be caught"))?;
    let what = "no folder for keys and sockets; set TMPDIR to a folder that can be written to";
    Ok((signals, RunFolder::make().map_err(system(what))?))
}

/// The processes of the modules.
fn modules(folder: &RunFolder) -> SupervisorSpec {
    let director = std::process::id().to_string();
    let modules = SupervisorSpec::new("modules", Strategy::OneForOne);
    Module::ALL.into_iter().fold(modules.intensity(RESTARTS, ENTRY), |modules, module| {
        // The link stays right even if the file is replaced while the demonstration runs.
        let process = ProcessSpec::new(module.name(), "/proc/self/exe")
            .arguments(["module", "--name", module.name(), "--director", &director, "--folder"])
            .arguments([folder.path()])
            .watchdog(WATCHDOG);
        modules.child(process.child().ready_within(ENTRY).shutdown_within(FAREWELL))
    })
}

async fn direct(
    scenario: &mut Scenario,
    node: &Node,
    folder: &RunFolder,
    faults: &mut FaultEvents,
    signals: &mut Terminations,
    shows_lines: bool,
) -> Result<(), String> {
    let (reports, mut reported) = channel(QUEUE);
    let since = Rc::new(Cell::new(Instant::default()));
    for module in Module::ALL {
        spawn_local(watch(agent(node, module), module, since.clone(), reports.clone()));
    }
    let mut ticks = interval(LOOK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        match scenario.advance(platform::now()) {
            Some(ScenarioOrder::Strike(order)) => {
                let struck = strike(node, order).await;
                scenario.handle_struck(struck, platform::now());
            }
            Some(ScenarioOrder::End) => return Ok(()),
            Some(ScenarioOrder::NotAssembled(missing)) => {
                return Err(with_reasons(
                    format!("the robot was not assembled: {missing}"),
                    folder,
                ));
            }
            None => {}
        }
        since.set(scenario.watched_since());
        while let Some(line) = scenario.poll_line() {
            if shows_lines && writeln!(io::stdout(), "{line}").is_err() {
                return Err("standard output was closed by its reader".to_owned());
            }
        }
        tokio::select! {
            biased;
            signal = signals.next() => return Err(interrupted(signal)),
            // A step in the history of a fault of the director's own node.
            Some(event) = faults.next() => {
                if let Some((module, how)) = end_of_module(event) {
                    scenario.handle_end(module, &how, platform::now());
                }
            }
            Some((module, report)) = reported.recv() => {
                scenario.handle_report(module, *report, platform::now());
            }
            _ = ticks.tick() => {}
        }
    }
}

/// Looks at a module, again and again.
async fn watch(
    agent: Sender<ReadModule>,
    module: Module,
    since: Rc<Cell<Instant>>,
    reports: Queue<(Module, Box<ModuleReport>)>,
) {
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    while !reports.is_closed() {
        looks.tick().await;
        // While the module starts again, it does not answer.
        if let Ok(report) =
            agent.ask_within(ReadModule { since: since.get().as_nanos() }, ANSWER).await
        {
            let _ = reports.send((module, Box::new(report))).await;
        }
    }
}

/// Injects or repairs a fault in all modules that it strikes. Returns when it was done at the first
/// and at the last of them.
async fn strike(node: &Node, order: Strike) -> Result<[Instant; 2], String> {
    let fault = &FAULTS[order.fault as usize];
    let mut instants = Vec::new();
    for module in fault.struck() {
        let agent = agent::<Strike>(node, module);
        let at = if fault.blow == Blow::Kill {
            // A process that is killed answers nothing.
            let at = platform::now().as_nanos();
            agent.tell(order).map(|()| at).map_err(|error| error.to_string())
        } else {
            let answer = agent.ask_within(order, ORDER).await;
            answer.map_err(|error| error.to_string()).flatten()
        };
        let at = at.map_err(|reason| format!("{module}: {reason}"))?;
        instants.push(Instant::from_nanos(at));
    }
    instants.sort_unstable();
    let ends = instants.first().zip(instants.last());
    ends.map(|(first, last)| [*first, *last]).ok_or("it strikes no module".to_owned())
}

/// The director's agent in a module.
fn agent<M: Contract>(node: &Node, module: Module) -> Sender<M> {
    node.sender(&format!("{module}:{AGENT}")).expect("the name is that of an object elsewhere")
}

/// Returns the module whose process has ended, or is to be ended, and why.
fn end_of_module(event: FaultEvent) -> Option<(Module, String)> {
    let FaultLocation::Object(address) = &event.fault.location else { return None };
    let is_module = |module: &Module| module.name() == address.object.as_str();
    let module = Module::ALL.into_iter().find(is_module)?;
    matches!(event.turn, FaultTransition::Found | FaultTransition::Repeated)
        .then(|| (module, format!("{}: {}", event.fault.kind, event.fault.detail)))
}

/// Adds why modules could not start.
fn with_reasons(text: String, folder: &RunFolder) -> String {
    Module::ALL.iter().fold(text, |text, module| {
        match fs::read_to_string(reason_of(folder.path(), module.name())) {
            Ok(reason) => format!("{text}; {module}: {reason}"),
            Err(_) => text,
        }
    })
}

fn interrupted(signal: Termination) -> String {
    let by = match signal {
        Termination::Interrupt => "Ctrl-C",
        Termination::HangUp => "SIGHUP",
        _ => "SIGTERM",
    };
    format!("interrupted by {by}; all processes have ended")
}
