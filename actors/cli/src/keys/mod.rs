//! `blastema keys`: makes the keys of a robot's nodes, and changes the signed list of them.
//!
//! What nodes do with them: `blastema::manual::security`.

mod check;
mod edit;
mod files;
mod push;
mod show;

use self::files::{Existing, PUBLIC, SECRET, check_absent, write};
use self::push::RosterPush;
use crate::args::{KeysJob, ListedNodes, PushOptions, RobotOption};
use crate::print;
use blastema::core::NodeName;
use blastema::core::net::trust::crypto::Seed;
use blastema::core::net::trust::key_file::{KeyFile, RobotFile};
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, ROSTER_BYTES, RosterNode, RosterOrder};
use blastema::keys::{folder_of, random_bytes, read_public, read_secret};
use std::fs;
use std::path::{Path, PathBuf};
use zeroize::Zeroizing;

/// Does what the command line says, and returns whether all of it was done.
///
/// # Errors
/// What is wrong, with the file, the line, and what to do.
pub(crate) fn run(job: &KeysJob) -> Result<bool, String> {
    match job {
        KeysJob::New { robot, nodes, out, roles } => new(robot, nodes, out, roles).map(|()| true),
        KeysJob::Show { files } => show::run(files).map(|()| true),
        KeysJob::Check(options) => check::run(options),
        KeysJob::Add { listed: ListedNodes { nodes, robot, push }, roles } => {
            Signer::open(robot)?.change(push, |signer| signer.add(nodes, roles))
        }
        KeysJob::Revoke(ListedNodes { nodes, robot, push }) => {
            Signer::open(robot)?.change(push, |signer| signer.revoke(nodes))
        }
        KeysJob::Replace(ListedNodes { nodes, robot, push }) => {
            Signer::open(robot)?.change(push, |signer| signer.replace(nodes))
        }
        KeysJob::Edit { robot, push, text } => {
            let signer = Signer::open(robot)?;
            let own = signer.path.with_extension("edited");
            let edited = edit::edited(&signer.robot.roster, &own, text.as_deref())?;
            let is_done = signer.change(push, |signer| {
                signer.robot.roster = edited;
                Ok(Vec::new())
            })?;
            // Until the list is written, the user's text is nowhere else.
            if text.as_ref().is_none_or(|from| *from == own) {
                fs::remove_file(&own).map_err(|error| format!("{}: {error}", own.display()))?;
            }
            Ok(is_done)
        }
    }
}

fn new(robot: &str, nodes: &[String], out: &Path, roles: &[String]) -> Result<(), String> {
    let name = name(robot)?;
    let path = out.join(format!("{robot}.robot"));
    check_absent(&path)?;
    check_absent(&roster_path(&path, &name))?;
    let roster = NodeRoster::new(name, []).expect("it lists no node");
    let mut signer = Signer { path, robot: RobotFile { seed: random_seed()?, roster } };
    let keys = signer.add(nodes, roles)?;
    write(&signer.path, &signer.robot.to_text(), SECRET, Existing::Keep)?;
    print(&format!(
        "{}: keep it off the robot, and a copy in a safe place\n",
        signer.path.display()
    ))?;
    write_keys(&keys)?;
    let (path, _) = signer.write_roster(Existing::Keep)?;
    let (path, count) = (path.display(), nodes.len());
    print(&format!("{path}: serial 1, {count} nodes: copy it beside each node's key\n"))?;
    print(&format!(
        "in each node's program write its key, with {robot}.roster beside it: .keys(\"{}.key\")\n",
        nodes[0]
    ))
}

/// The file that signs the list of nodes.
struct Signer {
    path: PathBuf,
    robot: RobotFile,
}

/// Files of keys that are to be written.
type NewKeys = Vec<(PathBuf, Zeroizing<String>)>;

impl Signer {
    fn open(option: &RobotOption) -> Result<Self, String> {
        let path = match &option.file {
            Some(path) => path.clone(),
            None => only_robot()?,
        };
        let text = read_secret(&path)?;
        let robot = RobotFile::parse(&text);
        let robot = robot.map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(Signer { path, robot })
    }

    /// Changes the list, signs it with the next serial number, and writes everything: keys first,
    /// so that no node is listed whose key was lost. Then it is handed over, if that is wanted;
    /// returns whether this was done.
    fn change(
        mut self,
        push: &PushOptions,
        change: impl FnOnce(&mut Self) -> Result<NewKeys, String>,
    ) -> Result<bool, String> {
        self.check_newest()?;
        let push = RosterPush::of(push)?;
        let before = self.robot.roster.clone();
        let keys = change(&mut self)?;
        if self.robot.roster == before {
            print("nothing was changed\n")?;
            return Ok(true);
        }
        let serial = self.robot.roster.serial.checked_add(1);
        self.robot.roster.serial = serial.ok_or("the serial number has reached its end")?;
        if self.robot.roster.to_text().len() > ROSTER_BYTES {
            return Err(format!("the list has more than {ROSTER_BYTES} bytes: shorten the policy"));
        }
        write_keys(&keys)?;
        write(&self.path, &self.robot.to_text(), SECRET, Existing::Replace)?;
        let (path, text) = self.write_roster(Existing::Replace)?;
        match push {
            Some(push) => push.hand_over(&self.robot.roster, &path, &text),
            None => {
                let NodeRoster { serial, .. } = &self.robot.roster;
                let (path, nodes) = (path.display(), self.robot.roster.nodes().len());
                print(&format!(
                    "{path}: serial {serial}, {nodes} nodes: copy it beside the key of one node that \
                     runs, which gives it to the others, or use --push\n"
                ))?;
                Ok(true)
            }
        }
    }

    /// Refuses to go on from an old copy of the robot's file: there would be two lists of one
    /// serial number.
    fn check_newest(&self) -> Result<(), String> {
        let path = roster_path(&self.path, &self.robot.roster.robot);
        if fs::symlink_metadata(&path).is_err() {
            return Ok(());
        }
        let text = read_public(&path)?;
        let listed = NodeRoster::parse_signed(&text, &self.robot.seed.signer());
        let listed = listed.map_err(|error| format!("{}: {error}", path.display()))?;
        match self.robot.roster.order_of(&listed) {
            RosterOrder::Same | RosterOrder::Older => Ok(()),
            RosterOrder::Newer | RosterOrder::Conflicting => Err(format!(
                "{} has serial {}, and {} has serial {} and another list: it is an old copy; use the \
                 newest one",
                path.display(),
                listed.serial,
                self.path.display(),
                self.robot.roster.serial
            )),
        }
    }

    fn add(&mut self, nodes: &[String], roles: &[String]) -> Result<NewKeys, String> {
        let roles = roles.iter().map(|text| role(text)).collect::<Result<Vec<_>, _>>()?;
        if let Some((node, _)) = roles.iter().find(|(node, _)| !nodes.contains(node)) {
            return Err(format!(
                "--role {node}=…: {node} is none of the nodes that are named here"
            ));
        }
        let mut keys = NewKeys::new();
        for text in nodes {
            let seed = random_seed()?;
            let role =
                roles.iter().find(|(node, _)| node == text).map_or(Role::Node, |(_, role)| *role);
            let node = RosterNode { name: name(text)?, keys: seed.public_keys(), role };
            self.robot.roster.add(node).map_err(|problem| format!("{text}: {problem}"))?;
            keys.push(self.key_file(name(text)?, seed)?);
        }
        Ok(keys)
    }

    fn replace(&mut self, nodes: &[String]) -> Result<NewKeys, String> {
        let mut keys = NewKeys::new();
        for text in nodes {
            let (node, seed) = (name(text)?, random_seed()?);
            if !self.robot.roster.replace_keys(&node, seed.public_keys()) {
                return Err(self.unlisted(text));
            }
            keys.push(self.key_file(node, seed)?);
        }
        Ok(keys)
    }

    fn revoke(&mut self, nodes: &[String]) -> Result<NewKeys, String> {
        for text in nodes {
            match self.robot.roster.remove(&name(text)?) {
                Ok(Some(_)) => {}
                Ok(None) => return Err(self.unlisted(text)),
                Err(line) => {
                    return Err(format!(
                        "line {line} of the policy names {text} alone, and without it all nodes could \
                         do what it closes: change or remove the line by `blastema keys edit` first"
                    ));
                }
            }
        }
        Ok(NewKeys::new())
    }

    fn unlisted(&self, text: &str) -> String {
        let names: Vec<&str> = self.robot.roster.nodes().iter().map(|n| n.name.as_str()).collect();
        format!("{text} is not listed: the nodes are {}", names.join(", "))
    }

    fn key_file(&self, node: NodeName, seed: Seed) -> Result<(PathBuf, Zeroizing<String>), String> {
        let path = folder_of(&self.path).join(format!("{node}.key"));
        check_absent(&path)?;
        let RobotFile { seed: robot_seed, roster } = &self.robot;
        let (robot, signer) = (roster.robot.clone(), robot_seed.signer());
        Ok((path, KeyFile { robot, node, seed, signer }.to_text()))
    }

    /// Writes the signed list. Returns its file and text.
    fn write_roster(&self, existing: Existing) -> Result<(PathBuf, String), String> {
        let RobotFile { seed, roster } = &self.robot;
        let (path, text) = (roster_path(&self.path, &roster.robot), roster.sign(seed));
        write(&path, &text, PUBLIC, existing)?;
        Ok((path, text))
    }
}

fn write_keys(keys: &NewKeys) -> Result<(), String> {
    for (path, text) in keys {
        write(path, text, SECRET, Existing::Keep)?;
        print(&format!(
            "{}: copy it to the node's computer, for its user alone\n",
            path.display()
        ))?;
    }
    Ok(())
}

fn roster_path(robot_file: &Path, robot: &NodeName) -> PathBuf {
    folder_of(robot_file).join(format!("{robot}.roster"))
}

/// The only robot's file in this folder.
fn only_robot() -> Result<PathBuf, String> {
    let mut robots = show::files_here()?;
    robots.retain(|path| path.extension().is_some_and(|kind| kind == "robot"));
    match robots.as_slice() {
        [robot] => Ok(robot.clone()),
        [] => Err("no file here ends in .robot: name the robot's file by --robot".to_owned()),
        _ => Err("several files here end in .robot: name one of them by --robot".to_owned()),
    }
}

fn name(text: &str) -> Result<NodeName, String> {
    NodeName::new(text).map_err(|error| error.to_string())
}

fn role(text: &str) -> Result<(String, Role), String> {
    let wrong = || format!("--role {text}: write NODE=ROLE, as in laptop=operator");
    let (node, role) = text.split_once('=').ok_or_else(wrong)?;
    let role = Role::parse(role).map_err(|problem| format!("--role {text}: {problem}"))?;
    Ok((node.to_owned(), role))
}

fn random_seed() -> Result<Seed, String> {
    let bytes = random_bytes().map_err(|error| {
        format!("the system gives no random numbers (getrandom: {error}): no key can be made")
    })?;
    Ok(Seed::new(*bytes))
}
