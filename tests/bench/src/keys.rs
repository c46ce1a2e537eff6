//! Keys of a robot that lives as long as a benchmark.

use blastema::core::NodeName;
use blastema::core::net::trust::crypto::Seed;
use blastema::core::net::trust::key_file::KeyFile;
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, RosterNode};
use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use tempfile::TempDir;

/// A key for each node, and their signed list, in a folder that goes with this.
pub(crate) struct BenchKeys(TempDir);

impl BenchKeys {
    /// Makes keys for these nodes. They protect nothing: each run makes the same.
    pub(crate) fn new(nodes: &[&str]) -> Self {
        let name = |text: &str| NodeName::new(text).expect("a name");
        let signer = Seed::new([0; 32]);
        let seeds = (1..).map(|number| Seed::new([number; 32]));
        let keys = BenchKeys(tempfile::tempdir().expect("a folder"));
        let mut listed = Vec::new();
        for (node, seed) in nodes.iter().zip(seeds) {
            listed.push(RosterNode {
                name: name(node),
                keys: seed.public_keys(),
                role: Role::Node,
            });
            let file =
                KeyFile { robot: name("bench"), node: name(node), seed, signer: signer.signer() };
            let path = keys.of(node);
            fs::write(&path, file.to_text().as_bytes()).expect("a folder");
            fs::set_permissions(&path, Permissions::from_mode(0o600)).expect("it is ours");
        }
        let roster = NodeRoster::new(name("bench"), listed).expect("nodes of different names");
        let path = keys.0.path().join("bench.roster");
        fs::write(&path, roster.sign(&signer)).expect("a folder");
        fs::set_permissions(&path, Permissions::from_mode(0o644)).expect("it is ours");
        keys
    }

    /// The file of a node's key.
    pub(crate) fn of(&self, node: &str) -> String {
        self.0.path().join(format!("{node}.key")).display().to_string()
    }
}
