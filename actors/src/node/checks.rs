//! What can be known to be wrong with a description before anything is started.

use super::builder::{ActorPlacement, Configuration, NodeBuilder};
use super::error::StartError;
use super::network::Network;
use super::tree::PreparedTree;
use crate::registry::NameTaken;
use crate::service::Carried;
use crate::settings::{CALLBACK_LIMIT, GRACE, SESSION_TIMEOUT, WORK_THREADS};
use blastema_core::detection::dependencies::{Dependencies, DependencyError, circle};
use blastema_core::net::wire::advertisement::NEIGHBOURS_MAX;
use blastema_core::service::{HELLO_MAX, HELLO_MIN, MEMBERS_MAX};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{NodeName, ObjectName};
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

/// The nodes of a service are others than each other, not too many, and this is one of them; and
/// its hello can be said.
pub(super) fn check_service(carried: &Carried) -> Result<(), StartError> {
    let Carried { name, config, .. } = carried;
    let different: SortedSet<_> = config.members.iter().collect();
    let reason = if !different.contains(&config.own) {
        format!("{} is none of its nodes: add it, or leave the service out here", config.own)
    } else if different.len() < config.members.len() {
        "a node stands twice among its nodes: name each once".to_owned()
    } else if config.members.len() > MEMBERS_MAX {
        let listed = config.members.len();
        format!(
            "{listed} nodes cannot carry it, {MEMBERS_MAX} at most: three or five outlive the failure of one or two"
        )
    } else if !(HELLO_MIN..=HELLO_MAX).contains(&config.hello_interval) {
        format!(
            "its primary cannot say hello every {:?}: give .hello_every(..) from {HELLO_MIN:?} to {HELLO_MAX:?}, such \
             as 50 ms",
            config.hello_interval
        )
    } else {
        return Ok(());
    };
    Err(StartError::Service { name: name.clone(), reason })
}

/// Every number and name that is the node's own makes sense.
pub(super) fn check_settings(builder: &NodeBuilder) -> Result<(), StartError> {
    if let ActorPlacement::Threads { shared } = builder.placement {
        WORK_THREADS.check(shared)?;
    }
    GRACE.check(builder.grace)?;
    CALLBACK_LIMIT.check(builder.callback_limit)?;
    SESSION_TIMEOUT.check(builder.session_timeout)?;
    check_watchdogs(builder)?;
    if let Some(name) = &builder.strategy_twice {
        let (value, cure) = (format!("{name:?} twice"), "hand over one strategy of a name");
        return Err(StartError::Setting { setting: "recovery", value, cure });
    }
    builder.kept_in.as_deref().map_or(Ok(()), check_kept_file)?;
    builder.parameters.iter().try_for_each(check_configuration)?;
    #[cfg(feature = "journal")]
    builder.journal.as_deref().map_or(Ok(()), check_journal)?;
    #[cfg(feature = "unix")]
    builder.shown_at.as_deref().map_or(Ok(()), check_socket)?;
    Ok(())
}

/// The watchdogs of the process can depend on the fault chain, and lie where they are said to lie.
fn check_watchdogs(builder: &NodeBuilder) -> Result<(), StartError> {
    let wrong = |reason: String| Err(StartError::ProcessWatchdog(reason));
    let watchdogs = &builder.process_watchdogs;
    if watchdogs.are_described() && builder.placement == ActorPlacement::Here {
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

fn check_kept_file(file: &Path) -> Result<(), StartError> {
    check_file(file).map_err(|reason| StartError::Variables { file: file.to_owned(), reason })
}

fn check_configuration(configuration: &Configuration) -> Result<(), StartError> {
    let Configuration::File(file) = configuration else { return Ok(()) };
    let wrong = |reason| StartError::Parameters { file: Some(file.clone()), reason };
    check_file(file).map_err(wrong)
}

#[cfg(feature = "journal")]
fn check_journal(file: &Path) -> Result<(), StartError> {
    check_file(file).map_err(|reason| StartError::Journal { file: file.to_owned(), reason })
}

/// Refuses two objects of one name, whether components, supervisors or middleware objects.
pub(super) fn check_names<'a>(
    names: impl IntoIterator<Item = (&'a ObjectName, &'static str)>,
) -> Result<(), NameTaken> {
    let mut known = SortedMap::new();
    for (name, kind) in names {
        if let Some(by) = known.insert(name, kind) {
            return Err(NameTaken { name: name.clone(), by });
        }
    }
    Ok(())
}

#[cfg(feature = "unix")]
fn check_socket(path: &Path) -> Result<(), StartError> {
    check_absolute(path).map_err(StartError::Shown)
}

/// Every network and every neighbour there can be what it is said to be.
pub(super) fn check_networks(networks: &[Network], node: &NodeName) -> Result<(), StartError> {
    let mut names = SortedSet::new();
    for network in networks {
        if !names.insert(network.name()) {
            let text = format!(
                "two networks are called {}: give one of them another name",
                network.name()
            );
            return Err(StartError::Network(text));
        }
        network.check(node)?;
    }
    let neighbours: SortedSet<_> = networks.iter().flat_map(Network::neighbours).collect();
    if neighbours.len() > NEIGHBOURS_MAX {
        let text = format!(
            "{} neighbours are described, and a node tells the others of {NEIGHBOURS_MAX} only: leave out \
             those that are reached over another one",
            neighbours.len()
        );
        return Err(StartError::Network(text));
    }
    let mut links = SortedMap::new();
    for network in networks {
        for link in network.link_names() {
            // Faults and tables know a link by its name alone.
            if let Some(other) = links.insert(link.clone(), network.name()) {
                let text = format!(
                    "two links are called {link}, on {other} and on {}: give one of them another \
                     name, by Link::named",
                    network.name()
                );
                return Err(StartError::Network(text));
            }
        }
    }
    Ok(())
}

/// Of services that wait for each other, none would ever serve. What the services of other nodes
/// wait for is not known here.
pub(super) fn check_service_order(carried: &[Carried]) -> Result<(), StartError> {
    let needs = carried.iter();
    let needs = needs.map(|service| (&service.name, service.depends_on.iter().collect()));
    let Some(way) = circle(&needs.collect()) else { return Ok(()) };
    let (name, reason) = (way[0].clone(), DependencyError::Circle { way }.to_string());
    Err(StartError::Service { name, reason })
}
