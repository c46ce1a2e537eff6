//! What files of keys hold, without any secret.

use crate::print;
use blastema::core::NodeName;
use blastema::core::net::trust::crypto::PublicKey;
use blastema::core::net::trust::key_file::{KeyFile, RobotFile};
use blastema::core::net::trust::roster::NodeRoster;
use blastema::keys::{read_public, read_secret};
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

/// How files of keys are named.
const KINDS: [&str; 3] = ["robot", "key", "roster"];

/// Shows these files, or those in this folder.
pub(super) fn run(named: &[PathBuf]) -> Result<(), String> {
    let files = if named.is_empty() { files_here()? } else { named.to_vec() };
    if files.is_empty() {
        return Err("no file here ends in .robot, .key or .roster: name the files".to_owned());
    }
    let (mut text, mut signers) = (String::new(), Vec::new());
    let mut rosters = Vec::new();
    for path in &files {
        let of_file = |error| format!("{}: {error}", path.display());
        match kind_of(path) {
            Some("robot") => {
                let robot = RobotFile::parse(&read_secret(path)?).map_err(of_file)?;
                let signer = robot.seed.signer();
                let _ =
                    writeln!(text, "{}: signs for robot {}", path.display(), robot.roster.robot);
                let _ = writeln!(text, "  signer {}", signer.fingerprint());
                list(&mut text, &robot.roster);
                signers.push((robot.roster.robot, signer));
            }
            Some("key") => {
                let key = KeyFile::parse(&read_secret(path)?).map_err(of_file)?;
                let _ = writeln!(
                    text,
                    "{}: node {} of robot {}\n  fingerprint {}\n  signer {}",
                    path.display(),
                    key.node,
                    key.robot,
                    key.seed.public_keys().fingerprint(),
                    key.signer.fingerprint()
                );
                signers.push((key.robot, key.signer));
            }
            Some("roster") => rosters.push(path),
            _ => {
                let path = path.display();
                return Err(format!("{path} ends in none of .robot, .key and .roster: rename it"));
            }
        }
    }
    for path in rosters {
        roster(&mut text, path, &signers)?;
    }
    print(&text)
}

fn roster(text: &mut String, path: &Path, signers: &[(NodeName, PublicKey)]) -> Result<(), String> {
    let of_file = |error| format!("{}: {error}", path.display());
    let signed = read_public(path)?;
    let body = signed.rfind("signed").map_or("", |at| &signed[..at]);
    let unchecked = NodeRoster::parse(body).map_err(of_file)?;
    let signer = signers.iter().find(|(robot, _)| *robot == unchecked.robot);
    let _ = writeln!(text, "{}: the nodes of robot {}", path.display(), unchecked.robot);
    match signer {
        Some((_, signer)) => {
            NodeRoster::parse_signed(&signed, signer).map_err(of_file)?;
            let _ = writeln!(text, "  signed by {}", signer.fingerprint());
        }
        None => text.push_str("  the signature is not checked: name a key file of the robot too\n"),
    }
    list(text, &unchecked);
    Ok(())
}

fn list(text: &mut String, roster: &NodeRoster) {
    let _ = writeln!(text, "  serial {}", roster.serial);
    let widest = roster.nodes().iter().map(|node| node.name.as_str().len()).max().unwrap_or(0);
    for node in roster.nodes() {
        let (name, role) = (node.name.as_str(), node.role.word());
        let _ = writeln!(text, "  {name:widest$}  {role:8}  {}", node.keys.fingerprint());
    }
    for (place, line) in roster.policy().iter().enumerate() {
        let _ = writeln!(text, "  policy {}: {line}", place + 1);
    }
}

fn kind_of(path: &Path) -> Option<&str> {
    path.extension()?.to_str().filter(|kind| KINDS.contains(kind))
}

/// The files of keys in this folder, in the order of their names.
pub(super) fn files_here() -> Result<Vec<PathBuf>, String> {
    let failed = |error| format!("this folder cannot be read: {error}");
    let names = fs::read_dir(".").map_err(failed)?.map(|entry| entry.map(|of| of.file_name()));
    let names: Vec<_> = names.collect::<Result<_, _>>().map_err(failed)?;
    let mut paths: Vec<_> = names.into_iter().map(PathBuf::from).collect();
    paths.retain(|path| kind_of(path).is_some());
    paths.sort();
    Ok(paths)
}
