//! Keys of a robot that runs once.

use blastema::core::NodeName;
use blastema::core::net::trust::crypto::Seed;
use blastema::core::net::trust::key_file::KeyFile;
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, RosterNode};
use blastema::keys::random_bytes;
use std::fs::OpenOptions;
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use zeroize::Zeroizing;

/// A key for each node, and their signed list, in memory. The key that signs is dropped: the list
/// cannot be changed.
pub(crate) struct RunKeys {
    keys: Vec<(String, Zeroizing<String>)>,
    roster: (String, String),
}

impl RunKeys {
    /// Makes keys for these nodes.
    ///
    /// # Errors
    /// A name is invalid, or the system gives no random numbers.
    pub(crate) fn new(robot: &str, nodes: &[&str]) -> Result<RunKeys, String> {
        let signing = random_seed()?;
        let robot = name(robot)?;
        let mut roster = NodeRoster::new(robot.clone(), []).expect("it lists no node");
        let mut keys = Vec::new();
        for text in nodes {
            let (node, seed) = (name(text)?, random_seed()?);
            let listed =
                RosterNode { name: node.clone(), keys: seed.public_keys(), role: Role::Node };
            roster.add(listed).map_err(|problem| format!("{text}: {problem}"))?;
            let key = KeyFile { robot: robot.clone(), node, seed, signer: signing.signer() };
            keys.push((format!("{text}.key"), key.to_text()));
        }
        let roster = (format!("{robot}.roster"), roster.sign(&signing));
        Ok(RunKeys { keys, roster })
    }

    /// Writes all of them into this folder, for this user alone.
    ///
    /// # Errors
    /// A file cannot be written.
    pub(crate) fn write(&self, folder: &Path) -> io::Result<()> {
        let (file, text) = &self.roster;
        let roster = (file, text.as_str());
        let keys = self.keys.iter().map(|(file, text)| (file, text.as_str()));
        for (file, text) in keys.chain([roster]) {
            let mut options = OpenOptions::new();
            options.write(true).create_new(true).mode(0o600);
            options.open(folder.join(file))?.write_all(text.as_bytes())?;
        }
        Ok(())
    }

    /// The file of a node's key, once all are written into this folder.
    pub(crate) fn file_of(folder: &Path, node: &str) -> PathBuf {
        folder.join(format!("{node}.key"))
    }
}

fn name(text: &str) -> Result<NodeName, String> {
    NodeName::new(text).map_err(|error| error.to_string())
}

fn random_seed() -> Result<Seed, String> {
    let bytes =
        random_bytes().map_err(|error| format!("the system gives no random numbers: {error}"))?;
    Ok(Seed::new(*bytes))
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
