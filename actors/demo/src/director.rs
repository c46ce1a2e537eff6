//! Runs the scenario on three processes.

use super::control::{ControlError, ControlListener, LineReader, LineWriter};
use super::display::{Display, Mode, OutputClosed};
use super::launcher::{ModuleEnded, Process};
use super::machine_instant::MachineInstant;
use super::protocol::{DirectorCommand, ModuleEvent, VERSION};
use super::report::Report;
use super::robot::Module;
use super::scenario::{ProgressLine, Scenario, ScenarioOutput, ScenarioPlan};
use super::trial::TrialOutput;
use super::view::{DemoView, LINE_LIMIT};
use super::wiring::CableAddresses;
use crate::run_keys::RunKeys;
use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::time::Duration;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, sleep_until, timeout};

/// How often the live view is drawn.
const FRAME: Duration = Duration::from_millis(100);
/// Events that may wait between a module and the director: those of one second at the highest rate.
const QUEUE: usize = 1_024;
/// How long a module may take from its start to its first line, on a busy machine.
const ENTRY: Duration = Duration::from_secs(10);
/// How long modules may take to end in order before they are killed.
const FAREWELL: Duration = Duration::from_secs(2);
/// Files that a module's process must be able to open: about forty for its threads and cables, and
/// reserve.
const FILES: u64 = 64;
/// How often a module that was never ready is started, and how often ports are chosen again.
const ATTEMPTS: u32 = 5;
/// After this many frames without an event of a ready module its process is killed and restarted,
/// as the watchdog of an init system would do: three seconds, thirty times the interval of its
/// snapshots. Frames are counted instead of time, so that a stopped director kills no module.
const QUIET_FRAMES: u32 = 30;
/// The pause between two starts of a module that is not ready.
const BETWEEN_ATTEMPTS: Duration = Duration::from_millis(200);

/// The reason why the demonstration was not run to its end.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DemoError {
    /// See [`ControlError`].
    #[error(transparent)]
    Control(#[from] ControlError),
    /// The operating system refuses a required resource.
    #[error("{what}: {source}")]
    System {
        /// The operation.
        what: &'static str,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The process of a module does not become ready.
    #[error("{module} does not start: {reason}")]
    Module {
        /// The module.
        module: Module,
        /// Its last message.
        reason: String,
    },
    /// The limit of open files is too low.
    #[error(
        "a process may open {0} files here, and a module needs {FILES}: raise the limit, as with \
         `ulimit -n {FILES}`"
    )]
    Files(u64),
    /// The processes run, and do not connect or do not become ready.
    #[error("the robot was not assembled: {0}")]
    NotTogether(String),
    /// A signal ended the run.
    #[error("interrupted by {0}; all processes have ended")]
    Interrupted(&'static str),
    /// See [`OutputClosed`].
    #[error(transparent)]
    OutputClosed(#[from] OutputClosed),
}

/// An input of the director.
enum Happening {
    Said(Said),
    Ended(ModuleEnded),
    Entered(i32, LineReader, LineWriter),
    EntryFailed(io::Error),
    Due,
    Frame,
    Interrupted(&'static str),
}

/// Runs the scenario and supervises its processes.
pub(crate) struct Director {
    scenario: Scenario,
    lines: VecDeque<ProgressLine>,
    wiring: CableAddresses,
    rewired: u32,
    /// The modules' keys: the same for a module that is started again.
    keys: RunKeys,
    listener: Option<ControlListener>,
    crew: BTreeMap<Module, Member>,
    messages: (Sender<Said>, Receiver<Said>),
    ended: (Sender<ModuleEnded>, Receiver<ModuleEnded>),
    signals: Signals,
}

/// An event from the process of a module.
struct Said {
    module: Module,
    process: i32,
    event: ModuleEvent,
}

/// One module's process, as the director keeps it.
struct Member {
    process: Process,
    commands: Option<Sender<DirectorCommand>>,
    entry_due: Instant,
    failures: u32,
    reason: String,
    /// Frames since its last event.
    quiet: u32,
}

struct Signals {
    interrupt: Signal,
    terminate: Signal,
    hang_up: Signal,
}

impl Director {
    /// Starts the three processes.
    ///
    /// # Errors
    /// See [`DemoError`].
    pub(crate) fn start(plan: ScenarioPlan) -> Result<Director, DemoError> {
        let files = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        if let Some(files) = files.filter(|files| *files < FILES) {
            return Err(DemoError::Files(files));
        }
        // Signals are caught before the first process is started, so that none is left behind.
        let signals = Signals::catch()?;
        let wiring = CableAddresses::choose()
            .map_err(system("the loopback addresses cannot be used (is the interface lo up?)"))?;
        let keys = RunKeys::new("demonstration", &Module::ALL.map(Module::name))
            .map_err(ControlError::Keys)?;
        let mut director = Director {
            scenario: Scenario::new(plan, MachineInstant::now()),
            lines: VecDeque::new(),
            wiring,
            rewired: 0,
            keys,
            listener: None,
            crew: BTreeMap::new(),
            messages: channel(QUEUE),
            ended: channel(QUEUE),
            signals,
        };
        for module in Module::ALL {
            director.launch(module, 0)?;
        }
        Ok(director)
    }

    /// Runs the scenario to its end and ends all processes.
    ///
    /// # Errors
    /// See [`DemoError`]; the processes have ended in any case.
    pub(crate) async fn run(mut self, display: &Display) -> (Report, Result<(), DemoError>) {
        let outcome = self.direct(display).await;
        self.dismiss().await;
        (self.scenario.report(), outcome)
    }

    async fn direct(&mut self, display: &Display) -> Result<(), DemoError> {
        let mut frames = interval(FRAME);
        frames.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            while let Some(output) = self.scenario.poll_output() {
                match output {
                    ScenarioOutput::Do(output) => self.carry_out(output),
                    ScenarioOutput::Tell(line) => self.tell(line, display)?,
                    ScenarioOutput::Finished => return Ok(()),
                    ScenarioOutput::Stillborn(text) => return Err(self.not_together(text)),
                }
            }
            let due = self.next_due();
            let happening = tokio::select! {
                biased;
                name = self.signals.next() => Happening::Interrupted(name),
                Some(messages) = self.messages.1.recv() => Happening::Said(messages),
                Some(ended) = self.ended.1.recv() => Happening::Ended(ended),
                entered = admit(self.listener.as_ref()) => match entered {
                    Ok((process, reader, writer)) => Happening::Entered(process, reader, writer),
                    Err(error) => Happening::EntryFailed(error),
                },
                () = wait(due) => Happening::Due,
                _ = frames.tick() => Happening::Frame,
            };
            self.handle(happening, display)?;
        }
    }

    fn handle(&mut self, happening: Happening, display: &Display) -> Result<(), DemoError> {
        let now = MachineInstant::now();
        match happening {
            Happening::Said(messages) => self.handle_said(&messages, now)?,
            Happening::Ended(ended) => self.handle_ended(ended, now)?,
            Happening::Entered(process, reader, writer) => self.enter(process, reader, writer),
            Happening::EntryFailed(error) => return Err(ControlError::Socket(error).into()),
            Happening::Due => {
                self.kill_the_mute();
                self.scenario.handle_timeout(now);
            }
            Happening::Frame => {
                self.kill_the_quiet();
                if display.mode() == Mode::Live {
                    display.view(DemoView::new(&self.scenario, &self.lines, now))?;
                }
            }
            Happening::Interrupted(name) => return Err(DemoError::Interrupted(name)),
        }
        Ok(())
    }

    fn handle_said(&mut self, messages: &Said, now: MachineInstant) -> Result<(), DemoError> {
        let &Said { module, process, ref event } = messages;
        let member = self.crew.get_mut(&module).filter(|member| member.process.id == process);
        let Some(member) = member else {
            // The event comes from a process that has ended.
            return Ok(());
        };
        member.quiet = 0;
        match event {
            ModuleEvent::Hello { name, version }
                if name != module.name() || *version != VERSION =>
            {
                let reason = "its executable is not the director's; run the command again".into();
                return Err(DemoError::Module { module, reason });
            }
            ModuleEvent::StartFailed { reason, address_taken } => {
                member.reason.clone_from(reason);
                if *address_taken {
                    self.rewire()?;
                }
            }
            ModuleEvent::Ready => {
                member.failures = 0;
                member.reason.clear();
            }
            _ => {}
        }
        self.scenario.handle_event(module, event, now);
        if self.scenario.robot.are_ready() {
            // From here on the file system holds nothing of the run.
            self.listener = None;
        }
        Ok(())
    }

    /// Another program took a port between its choice and its use: all modules restart with others.
    fn rewire(&mut self) -> Result<(), DemoError> {
        self.rewired += 1;
        if self.rewired <= ATTEMPTS {
            self.wiring = CableAddresses::choose().map_err(system("no free port on loopback"))?;
            self.crew.values_mut().for_each(|member| member.process.kill());
        }
        Ok(())
    }

    fn handle_ended(&mut self, ended: ModuleEnded, now: MachineInstant) -> Result<(), DemoError> {
        let ModuleEnded { module, id, how } = ended;
        let Some(member) = self.crew.get(&module).filter(|member| member.process.id == id) else {
            return Ok(());
        };
        let was_ready = self.scenario.robot.module(module).is_some_and(|module| module.ready);
        let failures = match (was_ready, member.process.is_killed()) {
            (true, _) => 0,
            (false, true) => member.failures,
            (false, false) => member.failures + 1,
        };
        let how = match member.quiet {
            QUIET_FRAMES.. => "it said nothing for 3 s, and was killed".into(),
            _ => how,
        };
        let is_ordered = member.process.is_killed() && member.quiet < QUIET_FRAMES;
        let unasked = (was_ready && !is_ordered).then_some(how.as_str());
        if failures >= ATTEMPTS {
            let reason = if member.reason.is_empty() { how } else { member.reason.clone() };
            return Err(DemoError::Module { module, reason });
        }
        let reason = member.reason.clone();
        self.scenario.handle_exit(module, unasked, now);
        // A process that has ended is restarted.
        self.launch(module, failures)?;
        self.crew.entry(module).and_modify(|member| member.reason = reason);
        Ok(())
    }

    fn launch(&mut self, module: Module, failures: u32) -> Result<(), DemoError> {
        let listener = match self.listener.take() {
            Some(listener) => listener,
            None => ControlListener::open(&self.keys)?,
        };
        let listener = self.listener.insert(listener);
        let process = Process::launch(module, listener, self.ended.0.clone())
            .map_err(system("a module's process cannot be started"))?;
        let entry_due = Instant::now() + ENTRY;
        let reason = String::new();
        let member = Member { process, commands: None, entry_due, failures, reason, quiet: 0 };
        self.crew.insert(module, member);
        Ok(())
    }

    fn enter(&mut self, process: i32, reader: LineReader, writer: LineWriter) {
        let found = self.crew.iter_mut().find(|(_, member)| member.process.id == process);
        // A process of the same user that the director has not started: it is refused.
        let Some((&module, member)) = found else { return };
        let delay = if member.failures == 0 { Duration::ZERO } else { BETWEEN_ATTEMPTS };
        let (commands, queue) = channel(QUEUE);
        tokio::spawn(speak(writer, queue, self.wiring.clone(), delay));
        tokio::spawn(listen(module, process, reader, self.messages.0.clone()));
        member.commands = Some(commands);
    }

    fn carry_out(&mut self, output: TrialOutput) {
        match output {
            TrialOutput::Send(module, command) => {
                let member = self.crew.get(&module);
                // A module that does not read will be found lost; its commands are void.
                let _ = member
                    .and_then(|member| member.commands.as_ref())
                    .map(|commands| commands.try_send(command));
            }
            TrialOutput::Kill(module) => {
                let at = MachineInstant::now();
                if let Some(member) = self.crew.get_mut(&module) {
                    member.process.kill();
                }
                self.scenario.handle_killed(at, at);
            }
        }
    }

    fn tell(&mut self, line: ProgressLine, display: &Display) -> Result<(), DemoError> {
        if self.lines.len() == LINE_LIMIT {
            self.lines.pop_front();
        }
        self.lines.push_back(line.clone());
        Ok(display.progress(line)?)
    }

    fn next_due(&self) -> Option<Instant> {
        let entry = self.crew.values().filter(|member| member.commands.is_none());
        let scenario =
            self.scenario.poll_timeout().map(|at| Instant::now() + (at - MachineInstant::now()));
        entry.map(|member| member.entry_due).chain(scenario).min()
    }

    fn kill_the_mute(&mut self) {
        let now = Instant::now();
        for member in self.crew.values_mut() {
            if member.commands.is_none() && member.entry_due <= now {
                member.reason = "it did not report in time".into();
                member.failures += 1;
                member.entry_due = now + ENTRY;
                member.process.kill();
            }
        }
    }

    fn kill_the_quiet(&mut self) {
        for (module, member) in &mut self.crew {
            if self.scenario.robot.module(*module).is_some_and(|module| module.ready) {
                member.quiet = member.quiet.saturating_add(1);
            }
            if member.quiet == QUIET_FRAMES {
                member.process.kill();
            }
        }
    }

    /// Describes what is missing, with the last reason of each module that has sent one.
    fn not_together(&self, text: String) -> DemoError {
        let messages = self.crew.iter().filter(|(_, member)| !member.reason.is_empty());
        let messages = messages.map(|(module, member)| format!("{module}: {}", member.reason));
        let is_mute = |module: &Module, member: &Member| {
            let ready = self.scenario.robot.module(*module).is_some_and(|module| module.ready);
            member.reason.is_empty() && !ready
        };
        let mute = self.crew.iter().filter(|(module, member)| is_mute(module, member));
        let mute = mute.map(|(module, _)| {
            format!("{module} has sent no reason: check whether `ulimit -u` permits its threads")
        });
        let messages = messages.chain(mute);
        DemoError::NotTogether(std::iter::once(text).chain(messages).collect::<Vec<_>>().join("; "))
    }

    /// Shuts all modules down and kills those that do not end in time.
    async fn dismiss(&mut self) {
        for member in self.crew.values_mut() {
            match &member.commands {
                Some(commands) if commands.try_send(DirectorCommand::Shutdown).is_ok() => {}
                _ => member.process.kill(),
            }
        }
        // A second signal ends the wait.
        tokio::select! {
            () = all_ended(&mut self.crew, &mut self.ended.1, &mut self.messages.1) => {}
            () = sleep(FAREWELL) => {}
            _ = self.signals.next() => {}
        }
        self.crew.values_mut().for_each(|member| member.process.kill());
        // A process cannot refuse signal 9; the limit protects against a kernel that does not kill.
        let end = all_ended(&mut self.crew, &mut self.ended.1, &mut self.messages.1);
        let _ = timeout(FAREWELL, end).await;
        self.listener = None;
    }
}

async fn all_ended(
    crew: &mut BTreeMap<Module, Member>,
    ended: &mut Receiver<ModuleEnded>,
    messages: &mut Receiver<Said>,
) {
    while !crew.is_empty() {
        tokio::select! {
            Some(ModuleEnded { module, id, .. }) = ended.recv() => {
                if crew.get(&module).is_some_and(|member| member.process.id == id) {
                    crew.remove(&module);
                }
            }
            // Events are discarded, so that they do not block the module's writer.
            Some(_) = messages.recv() => {}
        }
    }
}

/// Sends the commands of the director to a module, beginning with `Start`.
async fn speak(
    mut writer: LineWriter,
    mut queue: Receiver<DirectorCommand>,
    wiring: CableAddresses,
    delay: Duration,
) {
    sleep(delay).await;
    let mut command = Some(DirectorCommand::Start { wiring });
    while let Some(next) = command {
        // The end of the process reports a module that has ended.
        if writer.send(&next).await.is_err() {
            break;
        }
        command = queue.recv().await;
    }
}

/// Receives the events of a module until it ends.
async fn listen(module: Module, process: i32, mut reader: LineReader, messages: Sender<Said>) {
    // A failed channel is closed; the module then ends, which is reported.
    while let Ok(Some(event)) = reader.next().await {
        if messages.send(Said { module, process, event }).await.is_err() {
            break;
        }
    }
}

async fn admit(listener: Option<&ControlListener>) -> io::Result<(i32, LineReader, LineWriter)> {
    match listener {
        Some(listener) => listener.admit().await,
        None => std::future::pending().await,
    }
}

async fn wait(due: Option<Instant>) {
    match due {
        Some(due) => sleep_until(due).await,
        None => std::future::pending().await,
    }
}

impl Signals {
    fn catch() -> Result<Signals, DemoError> {
        let catch = |kind| signal(kind).map_err(system("signals cannot be caught"));
        Ok(Signals {
            interrupt: catch(SignalKind::interrupt())?,
            terminate: catch(SignalKind::terminate())?,
            hang_up: catch(SignalKind::hangup())?,
        })
    }

    async fn next(&mut self) -> &'static str {
        tokio::select! {
            _ = self.interrupt.recv() => "Ctrl-C",
            _ = self.terminate.recv() => "SIGTERM",
            _ = self.hang_up.recv() => "SIGHUP",
        }
    }
}

fn system(what: &'static str) -> impl Fn(io::Error) -> DemoError {
    move |source| DemoError::System { what, source }
}
