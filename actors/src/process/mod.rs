//! Programs in any language as children of a supervisor.
//!
//! ```text
//!  supervisor ─ hooks ─► SupervisedProcess ─► launcher ─► program
//!             ◄─ faults ─                  ◄─ sd_notify, exit status, memory, output
//! ```
//!
//! The component's life cycle is that of the program, so that order of start, restarts, plans,
//! dependencies and orders by hand are those of any component. Deliberately not here: messages; a
//! program that takes part in those is a node.

mod supervised;

pub use supervised::SupervisedProcess;

use crate::component::cell::ComponentCell;
use crate::component::declaration::Declarations;
use crate::component::spec_error::SpecError;
use crate::host::spec::ChildSpec;
use crate::liveness::limits::ComponentLimits;
use crate::platform::launcher::STAGE;
use crate::platform::processes::{ProgramCall, launcher};
use crate::settings::{MEMORY_LIMIT, WATCHDOG};
use blastema_core::ObjectName;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use std::{env, fs, io};
use supervised::ProcessSettings;

/// A program in any language that a supervisor starts, watches, restarts and stops.
///
/// [`child`](Self::child) makes it a component for a node or a supervisor. It is at work when the
/// program says `READY=1` by systemd's protocol `sd_notify`, and fails when the program ends,
/// misses its [watchdog](Self::watchdog) or exceeds its [memory limit](Self::memory_limit). To stop
/// it, its process group gets SIGTERM; what is left shortly before
/// [`shutdown_within`](ChildSpec::shutdown_within) has passed gets SIGKILL. Nothing that it has
/// started outlives it, or the node.
///
/// ```no_run
/// use blastema::prelude::*;
/// use blastema::ProcessSpec;
/// use std::time::Duration;
///
/// #[blastema::main] // elsewhere `main` begins with `blastema::launch_processes()`
/// async fn main() -> Result<(), Box<dyn std::error::Error>> {
///     let vision = ProcessSpec::new("vision", "python3")
///         .arguments(["-u", "vision.py"])
///         .watchdog(Duration::from_secs(2))
///         .memory_limit(512 << 20);
///     let node = Node::builder("module1")
///         .child(vision.child().shutdown_within(Duration::from_secs(1)))
///         .start()
///         .await?;
///     node.run_until_signal().await?;
///     Ok(())
/// }
/// ```
#[must_use = "a process spec does nothing until its child is given to a node or a supervisor"]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProcessSpec {
    call: ProgramCall,
    watchdog: Option<Duration>,
    memory_limit: Option<u64>,
    ready_at_start: bool,
}

impl ProcessSpec {
    /// A process of this program: a path if it contains `/`, else a command that is looked for in
    /// `PATH`, as a shell does.
    pub fn new(name: &str, program: impl Into<PathBuf>) -> Self {
        let call = ProgramCall {
            name: name.to_owned(),
            program: program.into(),
            arguments: Vec::new(),
            variables: Vec::new(),
            folder: None,
        };
        ProcessSpec { call, watchdog: None, memory_limit: None, ready_at_start: false }
    }

    /// The program as it was given: a path, or a command to look for in `PATH`.
    pub fn program(&self) -> &Path {
        &self.call.program
    }

    /// Adds arguments. Each is one, also if it has spaces.
    pub fn arguments(mut self, arguments: impl IntoIterator<Item: Into<OsString>>) -> Self {
        self.call.arguments.extend(arguments.into_iter().map(Into::into));
        self
    }

    /// Sets a variable of its environment, which is else that of the node.
    pub fn variable(mut self, name: &str, value: impl Into<OsString>) -> Self {
        self.call.variables.push((name.into(), value.into()));
        self
    }

    /// Sets the folder in which it runs, and at which a relative path of the program begins; else
    /// it is that of the node.
    pub fn folder(mut self, folder: impl Into<PathBuf>) -> Self {
        self.call.folder = Some(folder.into());
        self
    }

    /// Sets how far apart two `WATCHDOG=1` may be, 10 ms to an hour; the program finds it in
    /// `WATCHDOG_USEC`. It counts from `READY=1` on. A shorter one finds a hang sooner, and blames
    /// a program that was merely slow.
    pub fn watchdog(mut self, watchdog: Duration) -> Self {
        self.watchdog = Some(watchdog);
        self
    }

    /// Sets how many bytes of memory the program and all that it has started may have resident, at
    /// least a mebibyte. It is sampled once a second. What they share counts for each of them.
    pub fn memory_limit(mut self, bytes: u64) -> Self {
        self.memory_limit = Some(bytes);
        self
    }

    /// Takes it for ready when it was started: for a program that does not say `READY=1`.
    pub fn ready_at_start(mut self) -> Self {
        self.ready_at_start = true;
        self
    }

    /// The component, for [`NodeBuilder::child`](crate::NodeBuilder::child) or a supervisor. What
    /// is wrong with the spec, such as a program that does not exist, is an error when the node
    /// starts.
    pub fn child(self) -> ChildSpec<SupervisedProcess> {
        let name = self.call.name.clone();
        let declared = self.clone();
        let settings = Arc::new(ProcessSettings { spec: self, latest: Mutex::default() });
        let factory = move || SupervisedProcess::new(settings.clone());
        ChildSpec::new(&name, factory).with_ports(move |ports| {
            ports.feature::<ProcessDeclaration>().0 = Some(declared);
        })
    }

    /// Why the program cannot be started as it stands, and what to do.
    fn problem(&self) -> Option<(&'static str, String)> {
        let ProgramCall { program, folder, .. } = &self.call;
        if let Some(folder) = folder.as_ref().filter(|folder| !folder.is_dir()) {
            let why =
                format!("there is no folder {}: make it, or correct `folder`", folder.display());
            return Some(("folder", why));
        }
        let mut names = self.call.variables.iter().map(|(name, _)| name.to_string_lossy());
        let own = ["NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", STAGE];
        let is_wrong = |name: &str| name.is_empty() || name.contains('=') || own.contains(&name);
        if let Some(name) = names.find(|name| is_wrong(name)) {
            let why = format!("`{name}` is no variable that can be set: write another name");
            return Some(("variable", why));
        }
        let place = |path: &Path| folder.as_ref().map_or(path.to_owned(), |at| at.join(path));
        let check = |path: &Path| check_program(path, &program.display());
        let found = if program.components().count() > 1 || program.is_absolute() {
            check(&place(program))
        } else {
            let paths = env::var_os("PATH").unwrap_or_default();
            let mut found = env::split_paths(&paths).map(|path| check(&path.join(program)));
            found.find(Result::is_ok).unwrap_or_else(|| {
                let name = program.display();
                Err(match check(&place(program)) {
                    Ok(()) => format!("there is no `{name}` in PATH: write `./{name}`"),
                    Err(_) => format!(
                        "there is no `{name}` in PATH: install it, or write the path of the program"
                    ),
                })
            })
        };
        found.err().map(|why| ("program", why))
    }
}

/// Finds out whether a path is a program's.
fn check_program(path: &Path, shown: &dyn fmt::Display) -> Result<(), String> {
    match fs::metadata(path) {
        Ok(about) if about.is_dir() => Err(format!("{shown} is a folder: name the program in it")),
        Ok(about) if about.permissions().mode() & 0o111 == 0 => {
            Err(format!("{shown} is not executable: allow it by `chmod +x {shown}`"))
        }
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            Err(format!("there is no program {shown}: build it, or correct `program`"))
        }
        Err(error) => Err(format!("{shown} cannot be read: {error}")),
    }
}

/// What a node checks of a process before it starts.
#[derive(Default)]
struct ProcessDeclaration(Option<ProcessSpec>);

impl Declarations<SupervisedProcess> for ProcessDeclaration {
    fn check(&self, _: &ObjectName, _: &BTreeSet<&'static str>) -> Result<(), SpecError> {
        Ok(())
    }

    fn refused(&self, name: &ObjectName, _: &ComponentLimits) -> Vec<SpecError> {
        let Some(spec) = &self.0 else { return Vec::new() };
        let settings = [
            spec.watchdog.and_then(|watchdog| WATCHDOG.check(watchdog).err()),
            spec.memory_limit.and_then(|limit| MEMORY_LIMIT.check(limit).err()),
        ];
        let settings = settings.into_iter().flatten();
        let settings = settings.map(|error| SpecError::setting(name.as_str(), error));
        let launcher = launcher().is_none().then(|| {
            let why = "this program launches no processes: write `blastema::launch_processes();` \
                       as the first line of `main`";
            ("launcher", why.to_owned())
        });
        let problems = launcher.into_iter().chain(spec.problem());
        let problems = problems.map(|(setting, why)| {
            let name = name.clone();
            SpecError::Process { name, setting, why }
        });
        settings.chain(problems).collect()
    }

    fn bind(self: Box<Self>, _: &Arc<ComponentCell<SupervisedProcess>>) -> Result<(), SpecError> {
        Ok(())
    }
}
