//! Keys of a robot that runs once.

use super::files::{Existing, PUBLIC, SECRET, write};
use super::{Signer, name, random_seed, roster_path};
use blastema::core::net::trust::key_file::RobotFile;
use blastema::core::net::trust::roster::NodeRoster;
use std::path::{Path, PathBuf};
use zeroize::Zeroizing;

/// A key for each node, and their signed list, in memory. What signs is forgotten: the list cannot
/// be changed.
pub(crate) struct RunKeys {
    keys: Vec<(PathBuf, Zeroizing<String>)>,
    roster: (PathBuf, String),
}

impl RunKeys {
    /// Makes keys for these nodes.
    ///
    /// # Errors
    /// A name is none, or the system gives no random numbers.
    pub(crate) fn new(robot: &str, nodes: &[&str]) -> Result<RunKeys, String> {
        let roster = NodeRoster::new(name(robot)?, []).expect("it lists no node");
        let path = PathBuf::from(format!("{robot}.robot"));
        let mut signer = Signer { path, robot: RobotFile { seed: random_seed()?, roster } };
        let nodes: Vec<String> = nodes.iter().map(|node| (*node).to_owned()).collect();
        let keys = signer.add(&nodes, &[])?;
        let RobotFile { seed, roster } = &signer.robot;
        let roster = (roster_path(&signer.path, &roster.robot), roster.sign(seed));
        Ok(RunKeys { keys, roster })
    }

    /// Writes all of them into this folder.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub(crate) fn write(&self, folder: &Path) -> Result<(), String> {
        for (file, text) in &self.keys {
            let file = file.file_name().expect("it was made from a node's name");
            write(&folder.join(file), text, SECRET, Existing::Keep)?;
        }
        let (file, text) = &self.roster;
        let file = file.file_name().expect("it was made from the robot's name");
        write(&folder.join(file), text, PUBLIC, Existing::Keep)
    }

    /// The file of a node's key, once all are written into this folder.
    pub(crate) fn file_of(folder: &Path, node: &str) -> PathBuf {
        folder.join(format!("{node}.key"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema::Network;
    use blastema::prelude::*;

    #[test]
    fn nodes_start_with_keys_of_one_run_in_whichever_folder_they_are_written_to() {
        let keys = RunKeys::new("robot", &["left", "right"]).expect("there is chance");
        let folders = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));

        for folder in &folders {
            keys.write(folder.path()).expect("it can be written to");
            assert!(!folder.path().join("robot.robot").exists(), "what signs is not written");
        }

        let start = |of: &str| {
            let file = RunKeys::file_of(folders[1].path(), of);
            let network = Network::new("lan", "udp://127.0.0.1:0").peer("right", "127.0.0.1:9");
            let node = Node::builder("left").keys(file).network(network);
            blastema::run(async move {
                match node.start().await {
                    Ok(node) => {
                        let sealed = node.networks()[0].sealed;
                        node.shutdown().await;
                        Ok(sealed)
                    }
                    Err(error) => Err(error.to_string()),
                }
            })
        };
        assert_eq!(start("left"), Ok(true), "its network is sealed");
        let refused = start("right").expect_err("it is another node's");
        assert!(refused.contains("is the key of right"), "{refused}");
        let same = |name: &str| {
            let [one, other] = &folders;
            let text = |folder: &Path| std::fs::read(folder.join(name)).expect("it is written");
            text(one.path()) == text(other.path())
        };
        assert!(same("left.key") && same("robot.roster"));
    }
}
