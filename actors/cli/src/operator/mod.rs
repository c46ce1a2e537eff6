//! The operator's own session with a robot: a node of the roster that connects to one of the
//! others, and ends when its command has.

pub(crate) mod component;
mod isolation;

pub(crate) use self::isolation::run;

use crate::args::{NodeAddress, OperatorOptions};
use blastema::core::net::trust::key_file::KeyFile;
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, RosterNode};
use blastema::keys::{folder_of, read_public, read_secret};
use blastema::prelude::*;
use blastema::{Fault, Network, NodeName};
use std::env;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tracing::subscriber::{NoSubscriber, set_global_default};

/// Names the file of the operator's key where the command line names none.
const KEYS_VARIABLE: &str = "BLASTEMA_KEYS";
/// How long the robot's other nodes may take once the first one is connected: a round trip for
/// each hop, and a handshake.
const OTHERS_WITHIN: Duration = Duration::from_secs(3);

/// The key of the operator, and the roster beside it.
pub(crate) struct OperatorKey {
    pub(crate) file: PathBuf,
    own: NodeName,
    /// The list of nodes.
    pub(crate) roster: NodeRoster,
}

impl OperatorKey {
    /// Reads the file that is named here, or by the environment, and the roster beside it.
    ///
    /// # Errors
    /// What is wrong, in which file, and what to do.
    pub(crate) fn of(options: &OperatorOptions) -> Result<Self, String> {
        let of_environment = || env::var_os(KEYS_VARIABLE).filter(|path| !path.is_empty());
        let file = options.keys.clone().or_else(|| of_environment().map(PathBuf::from));
        let file = file.ok_or_else(|| {
            format!("no key of an operator is named: name it by --keys FILE, or by {KEYS_VARIABLE}")
        })?;
        let key = KeyFile::parse(&read_secret(&file)?);
        let key = key.map_err(|error| format!("{}: {error}", file.display()))?;
        let path = roster_beside(&file, &key.robot);
        let text = read_public(&path).map_err(|error| {
            format!("{error}: copy {}.roster beside {}", key.robot, file.display())
        })?;
        let roster = NodeRoster::parse_signed(&text, &key.signer);
        let roster = roster.map_err(|error| format!("{}: {error}", path.display()))?;
        Ok(OperatorKey { file, own: key.node, roster })
    }

    /// All nodes but the operator's own.
    pub(crate) fn others(&self) -> impl Iterator<Item = &RosterNode> {
        self.roster.nodes().iter().filter(|node| node.name != self.own)
    }

    /// Whether one of these has this name.
    ///
    /// # Errors
    /// It names those that there are.
    pub(crate) fn check_listed(&self, name: &str) -> Result<(), String> {
        let names: Vec<_> = self.others().map(|node| node.name.as_str()).collect();
        match names.contains(&name) {
            true => Ok(()),
            false => Err(format!("{name} is not in the roster, which lists {}", names.join(", "))),
        }
    }
}

/// The roster of a robot beside a key.
pub(crate) fn roster_beside(key: &Path, robot: &NodeName) -> PathBuf {
    folder_of(key).join(format!("{robot}.roster"))
}

/// A session with one node of the robot, and by way of it with the others.
pub(crate) struct OperatorSession {
    /// The operator's node.
    pub(crate) node: Node,
    until: Instant,
    /// How long an answer may take.
    pub(crate) within: Duration,
}

impl OperatorSession {
    /// Connects to the node, does this, and ends in order: no node misses the operator.
    ///
    /// # Errors
    /// Why it did not connect, and what to do; or that of the work.
    pub(crate) fn run<T>(
        key: &OperatorKey,
        to: &NodeAddress,
        options: &OperatorOptions,
        work: impl AsyncFnOnce(&Self) -> Result<T, String>,
    ) -> Result<T, String> {
        blastema::run(async {
            let session = Self::open(key, to, options).await?;
            let done = work(&session).await;
            session.node.shutdown().await;
            done
        })
    }

    async fn open(
        key: &OperatorKey,
        to: &NodeAddress,
        options: &OperatorOptions,
    ) -> Result<Self, String> {
        // What this node finds is said by the command itself. Fails where it was set before.
        let _ = set_global_default(NoSubscriber::default());
        let NodeAddress { node: via, address } = to;
        key.check_listed(via)?;
        let any = if address.starts_with('[') { "udp://[::]:0" } else { "udp://0.0.0.0:0" };
        let own = options.from.as_deref().unwrap_or(any);
        let network = Network::new("operator", own).peer(via, address);
        let node = Node::builder(key.own.as_str()).keys(&key.file).network(network).start().await;
        let node = node.map_err(|error| error.to_string())?;
        if node.connected(via, options.within).await {
            let until = Instant::now() + OTHERS_WITHIN.min(options.within);
            return Ok(OperatorSession { node, until, within: options.within });
        }
        let reason = why_not(&node, key, to, options).await;
        node.shutdown().await;
        Err(reason)
    }

    /// Whether the node is connected, which it is within seconds after the first one.
    pub(crate) async fn reaches(&self, node: &NodeName) -> bool {
        let left = self.until.saturating_duration_since(Instant::now());
        // One that is there already needs no time.
        self.node.connected(node.as_str(), left.max(Duration::from_millis(10))).await
    }
}

/// Why there is no session, as far as it is known here.
async fn why_not(
    node: &Node,
    key: &OperatorKey,
    NodeAddress { node: via, address }: &NodeAddress,
    options: &OperatorOptions,
) -> String {
    let within = options.within.as_secs_f64();
    let head = format!("{via} has not answered at {address} within {within} s");
    let own = &key.own;
    let role = key.roster.node(own).map(|node| node.role);
    if role != Some(Role::Operator) && options.from.is_none() {
        return format!(
            "{head}: {own} is no operator in roster {}, and only operators connect to a node that does \
             not describe them: write `role operator` at its line by `blastema keys edit`",
            key.roster.serial
        );
    }
    let faults = node.faults().await.entries.into_iter();
    let faults = faults.filter(|entry| entry.stands()).map(|entry| entry.fault);
    let mut faults = faults.filter(|fault: &Fault| fault.kind == FaultKind::LinkDown);
    let found = faults.next().map_or(String::new(), |fault| format!(" ({})", fault.detail));
    format!(
        "{head}: check the address, that {via} runs, and that its roster lists {own} as operator with \
         this key{found}"
    )
}
