//! The folder of a run: the robot's file, the modules' keys, and the sockets of the director's
//! network.

use crate::robot::Module;
use blastema::core::NodeName;
use blastema::core::net::trust::crypto::Seed;
use blastema::core::net::trust::key_file::KeyFile;
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, RosterNode};
use blastema::{Network, platform};
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// The node of the director.
pub(crate) const DIRECTOR: &str = "director";
/// The object in every module that does what the director asks for.
pub(crate) const AGENT: &str = "agent";
/// The robot's file.
pub(crate) const ROBOT_FILE: &str = "robot.xml";
/// It is locked as long as the director runs.
const LOCK: &str = "lock";

/// The folder while the director runs. It is this user's alone, and goes with the director; if that
/// is killed, with the last of its modules.
#[derive(Debug)]
pub(crate) struct RunFolder {
    folder: TempDir,
    // Unlocked when it is dropped.
    _lock: File,
}

impl RunFolder {
    /// Makes the folder with all that the modules need.
    ///
    /// # Errors
    /// It cannot be made or written to, or there are no random numbers for keys.
    pub(crate) fn make() -> io::Result<RunFolder> {
        let private = Permissions::from_mode(0o700);
        let mut builder = tempfile::Builder::new();
        let folder = builder.prefix("blastema-demo-").permissions(private).tempdir()?;
        let lock = File::create_new(folder.path().join(LOCK))?;
        lock.lock()?;
        write_keys(folder.path())?;
        fs::write(folder.path().join(ROBOT_FILE), include_str!("../robot.xml"))?;
        Ok(RunFolder { folder, _lock: lock })
    }

    /// Returns its path.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// Makes a key for each module, and their signed list. The key that signs is dropped: the list
/// cannot be changed.
fn write_keys(folder: &Path) -> io::Result<()> {
    let seed = || platform::random_bytes().map(|bytes| Seed::new(*bytes));
    let (signing, robot) = (seed()?, node_name("demonstration"));
    let mut roster = NodeRoster::new(robot.clone(), []).map_err(io::Error::other)?;
    for module in Module::ALL {
        let (node, seed) = (node_name(module.name()), seed()?);
        let listed = RosterNode { name: node.clone(), keys: seed.public_keys(), role: Role::Node };
        roster.add(listed).map_err(io::Error::other)?;
        let key = KeyFile { robot: robot.clone(), node, seed, signer: signing.signer() };
        write_privately(&folder.join(format!("{module}.key")), &key.to_text())?;
    }
    write_privately(&folder.join(format!("{robot}.roster")), &roster.sign(&signing))
}

fn node_name(text: &str) -> NodeName {
    NodeName::new(text).expect("the names of the demonstration are names")
}

fn write_privately(path: &Path, text: &str) -> io::Result<()> {
    let mut options = OpenOptions::new();
    options.write(true).create_new(true).mode(0o600);
    options.open(path)?.write_all(text.as_bytes())
}

/// Returns the file in which a module that cannot start says why.
pub(crate) fn reason_of(folder: &Path, module: &str) -> PathBuf {
    folder.join(format!("{module}.reason"))
}

/// Removes the folder if its director has ended without doing so.
pub(crate) fn remove_orphan(folder: &Path) {
    if File::open(folder.join(LOCK)).is_ok_and(|lock| lock.try_lock().is_ok()) {
        // Another module may do the same.
        let _ = fs::remove_dir_all(folder);
    }
}

/// Returns the end of a node of the director's network, which is never cut: Unix sockets in the
/// folder.
pub(crate) fn control_network(folder: &Path, own: &str) -> Network {
    let socket = |name: &str| folder.join(name).display().to_string();
    let network = Network::new("control", &format!("unix://{}", socket(own)));
    match own {
        DIRECTOR => Module::ALL
            .iter()
            .fold(network, |network, module| network.peer(module.name(), &socket(module.name()))),
        _ => network.peer(DIRECTOR, &socket(DIRECTOR)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_is_private_and_outlives_its_director_until_a_module_ends() {
        let run = RunFolder::make().expect("it can be made");
        let path = run.path().to_owned();
        let mode = fs::metadata(&path).expect("it exists").permissions().mode();
        remove_orphan(&path);
        assert_eq!((mode & 0o777, path.exists()), (0o700, true));

        // A director that was killed unlocks, and removes nothing.
        let RunFolder { folder, _lock } = run;
        let (path, ()) = (folder.keep(), drop(_lock));
        remove_orphan(&path);

        assert!(!path.exists());
    }
}
