//! What can be known to be wrong with a description before anything is started.

use super::builder::{ActorPlacement, Configuration, NodeBuilder};
use super::error::StartError;
use super::tree::PreparedTree;
use super::watchdogs::ProcessWatchdogs;
use crate::settings::{CALLBACK_LIMIT, GRACE, WORK_THREADS};
use blastema_core::NodeName;
use blastema_core::detection::dependencies::Dependencies;
#[cfg(feature = "unix")]
use blastema_transports::endpoint::check_socket_path;
use std::path::Path;

/// Who needs whom of the objects of this node.
pub(super) fn dependencies(node: &NodeName, tree: &PreparedTree) -> Dependencies {
    let mut objects = Dependencies::of(node.clone());
    tree.supervisors.iter().for_each(|(name, _)| objects.enter(name.clone(), &[]));
    for facts in &tree.components {
        objects.enter(facts.name.clone(), &facts.depends_on);
    }
    objects
}

/// Finds every number and name of the node's own that makes no sense.
pub(super) fn check_settings(builder: &NodeBuilder) -> Vec<StartError> {
    let threads = match builder.process.placement {
        ActorPlacement::Threads { shared } => WORK_THREADS.check(shared),
        ActorPlacement::ComponentsHere | ActorPlacement::Here => Ok(()),
    };
    let strategies = builder.faults.strategy_twice.as_ref().map_or(Ok(()), |name| {
        let (value, cure) = (format!("{name:?} twice"), "hand over one strategy of a name".into());
        Err(StartError::Setting { setting: "recovery", value, cure })
    });
    let mut checks = vec![
        threads.map_err(StartError::from),
        GRACE.check(builder.process.grace).map_err(StartError::from),
        CALLBACK_LIMIT.check(builder.faults.callback_limit).map_err(StartError::from),
        check_watchdogs(builder),
        strategies,
        check_path("keep_variables", builder.files.variables.as_deref(), check_file),
    ];
    checks.extend(builder.files.parameters.iter().map(check_configuration));
    #[cfg(feature = "journal")]
    checks.push(check_path("journal", builder.files.journal.as_deref(), check_file));
    #[cfg(feature = "unix")]
    checks.push(check_path(
        "inspection_socket",
        builder.files.inspection_socket.as_deref(),
        check_socket,
    ));
    checks.into_iter().filter_map(Result::err).collect()
}

/// The watchdogs of the process can depend on the fault chain, and lie where they are said to lie.
fn check_watchdogs(builder: &NodeBuilder) -> Result<(), StartError> {
    let wrong = |reason: String| Err(StartError::ProcessWatchdog(reason));
    let watchdogs = &builder.process.watchdogs;
    if *watchdogs != ProcessWatchdogs::default()
        && builder.process.placement == ActorPlacement::Here
    {
        return wrong(
            "a node all of which runs on one thread cannot be watched: leave \
             on_this_thread() or the watchdogs out"
                .into(),
        );
    }
    watchdogs.device.as_deref().map_or(Ok(()), check_absolute).or_else(wrong)
}

/// Refuses a relative path: the file that it names depends on the working directory.
fn check_absolute(path: &Path) -> Result<(), String> {
    if path.is_absolute() {
        return Ok(());
    }
    let here = std::path::absolute(path).unwrap_or_else(|_| Path::new("/").join(path));
    Err(format!(
        "the path {path:?} depends on the folder in which the program is started: give the \
         absolute path, which is {here:?} here"
    ))
}

/// Refuses a path that is relative, or that of a folder.
fn check_file(path: &Path) -> Result<(), String> {
    check_absolute(path)?;
    match path.is_dir() {
        true => Err("the path is that of a folder: give the path of a file in it".to_owned()),
        false => Ok(()),
    }
}

/// Refuses the path that this setting gives, if it gives one.
fn check_path(
    setting: &'static str,
    path: Option<&Path>,
    check: fn(&Path) -> Result<(), String>,
) -> Result<(), StartError> {
    let Some(path) = path else { return Ok(()) };
    check(path).map_err(|reason| StartError::of_path(setting, path, reason))
}

fn check_configuration(configuration: &Configuration) -> Result<(), StartError> {
    let Configuration::File(file) = configuration else { return Ok(()) };
    let wrong = |reason| StartError::Parameters { file: Some(file.clone()), reason };
    check_file(file).map_err(wrong)
}

#[cfg(feature = "unix")]
fn check_socket(path: &Path) -> Result<(), String> {
    check_file(path).and_then(|()| check_socket_path(path.as_os_str().len()))
}
