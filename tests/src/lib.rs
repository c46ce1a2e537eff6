//! Whole systems under test.

mod log;
mod parts;

pub use log::{LogLine, LogLines};
pub use parts::{
    Act, Notes, Part, State, accepts, listens, meshed, moves, on_ethernet, part, plug_cable,
    pull_cable, serves,
};

use blastema::core::NodeName;
use blastema::core::net::trust::crypto::Seed;
use blastema::core::net::trust::key_file::KeyFile;
use blastema::core::net::trust::policy::Role;
use blastema::core::net::trust::roster::{NodeRoster, RosterNode};
use blastema::{ChildSpec, Fault, FaultEvents, Link, Network, Request};
use std::fmt::Display;
use std::fs::{self, File, Permissions};
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::str::FromStr;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// One millisecond: tests write a time as `20 * MS`.
pub const MS: Duration = Duration::from_millis(1);
/// How long real nodes may take for what they do, on a computer that is busy with other tests.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// What was looked for, once it is there. The look is repeated until then.
///
/// # Panics
/// After [`PATIENCE`], with what was looked for.
pub async fn found<T>(mut look: impl AsyncFnMut() -> Option<T>, what: &str) -> T {
    let looking = async {
        loop {
            if let Some(found) = look().await {
                return found;
            }
            blastema::sleep(2 * MS).await;
        }
    };
    let found = tokio::time::timeout(PATIENCE, looking).await;
    found.unwrap_or_else(|_| panic!("{what}: not within {} s", PATIENCE.as_secs()))
}

/// Waits until it is so.
///
/// # Panics
/// After [`PATIENCE`], with what it should have been.
pub async fn until(mut is_so: impl AsyncFnMut() -> bool, what: &str) {
    found(async || is_so().await.then_some(()), what).await;
}

/// The next fault of which this is so.
///
/// # Panics
/// After [`PATIENCE`], with what was looked for.
pub async fn next_fault(
    events: &mut FaultEvents,
    is_it: impl Fn(&Fault) -> bool,
    what: &str,
) -> Fault {
    let next = async || events.next().await.map(|event| event.fault).filter(&is_it);
    found(next, what).await
}

/// Keeps its thread for so long.
pub fn burn(span: Duration) {
    let begun = Instant::now();
    while begun.elapsed() < span {
        std::hint::spin_loop();
    }
}

/// The role of a process that was started by a test.
const ROLE: &str = "BLASTEMA_TEST_ROLE";
/// The addresses of all nodes, by number.
const ADDRESSES: &str = "BLASTEMA_TEST_ADDRESSES";

/// A process that runs this test program in a role. Dropping it kills it.
///
/// The module that starts it, `module_path!()`, has a test called `a_process_plays_its_role`, which plays
/// the [`role`] it finds.
pub struct Process(Child);

impl Process {
    /// Starts the role with the addresses of all nodes.
    pub fn start(module: &str, role: &str, addresses: &[impl Display]) -> Self {
        Process::start_with(module, role, addresses, &[])
    }

    /// The same, with more variables of the environment.
    pub fn start_with(
        module: &str,
        role: &str,
        addresses: &[impl Display],
        more: &[(&str, &String)],
    ) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        Process::spawn(Command::new(program), module, role, addresses, more)
    }

    /// The same, with its standard error in a file.
    pub fn start_into(errors: File, module: &str, role: &str, addresses: &[impl Display]) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let mut program = Command::new(program);
        program.stderr(errors);
        Process::spawn(program, module, role, addresses, &[])
    }

    /// The same, as another user, who runs a copy of this program in `folder`. Needs root.
    pub fn start_as(
        user: u32,
        folder: &Path,
        module: &str,
        role: &str,
        addresses: &[impl Display],
        more: &[(&str, &String)],
    ) -> Self {
        let own = std::env::current_exe().expect("a running program has a path");
        let mut program = Command::new(blastema_doubles::program_in(folder, &own));
        program.uid(user);
        Process::spawn(program, module, role, addresses, more)
    }

    fn spawn(
        mut program: Command,
        module: &str,
        role: &str,
        addresses: &[impl Display],
        more: &[(&str, &String)],
    ) -> Self {
        let addresses: Vec<String> = addresses.iter().map(ToString::to_string).collect();
        let child = program
            .args(["--exact", &role_test(module), "--nocapture"])
            .env(ROLE, role)
            .env(ADDRESSES, addresses.join(","))
            .envs(more.iter().copied())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn();
        Process(child.expect("the test can be started again"))
    }

    /// Sends it a signal, such as `-STOP`.
    pub fn signal(&self, signal: &str) {
        let status = Command::new("kill").args([signal, &self.0.id().to_string()]).status();
        assert!(status.expect("there is kill").success());
    }

    /// Waits until it ends by itself, and returns whether it succeeded.
    pub fn succeeds(&mut self) -> bool {
        self.0.wait().expect("it was started here").success()
    }

    /// The status with which it has ended by itself; `None` while it runs.
    pub fn exit_status(&mut self) -> Option<i32> {
        self.0.try_wait().expect("it was started here").map(|status| status.code().unwrap_or(-1))
    }

    /// As `kill -9` does.
    pub fn kill(&mut self) {
        self.0.kill().expect("it still runs");
        self.0.wait().expect("it was started here");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have been killed already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The keys of a robot called `ranger`, as `blastema keys new` writes them, in one folder.
pub struct RobotKeys(PathBuf);

impl RobotKeys {
    /// Makes keys for these nodes. Each `seed` makes another robot.
    pub fn new(folder: &Path, nodes: &[&str], seed: u8) -> Self {
        let keys = RobotKeys(folder.to_owned());
        let roster = RobotKeys::roster(nodes, seed, 1);
        let list = folder.join("ranger.roster");
        fs::write(&list, roster).expect("a folder");
        fs::set_permissions(&list, Permissions::from_mode(0o644)).expect("it is ours");
        for node in nodes {
            let (robot, signer) = (name("ranger"), Seed::new([seed; 32]).signer());
            let key = KeyFile { robot, node: name(node), seed: seed_of(node, seed), signer };
            let file = keys.of(node);
            fs::write(&file, key.to_text().as_bytes()).expect("a folder");
            fs::set_permissions(&file, Permissions::from_mode(0o600)).expect("it is ours");
        }
        keys
    }

    /// The keys that are in this folder.
    pub fn there(folder: &Path) -> Self {
        RobotKeys(folder.to_owned())
    }

    /// The signed text of a roster of that robot.
    pub fn roster(nodes: &[&str], seed: u8, serial: u64) -> String {
        let nodes: Vec<_> = nodes.iter().map(|node| (*node, Role::Node)).collect();
        RobotKeys::roster_with(&nodes, &[], seed, serial)
    }

    /// The same with these lines of a policy, and the roles of some nodes.
    pub fn roster_with(nodes: &[(&str, Role)], policy: &[&str], seed: u8, serial: u64) -> String {
        let listed = nodes.iter().map(|(node, role)| RosterNode {
            name: name(node),
            keys: seed_of(node, seed).public_keys(),
            role: *role,
        });
        let mut roster = NodeRoster::new(name("ranger"), listed).expect("different names");
        roster.serial = serial;
        let lines: String = policy.iter().map(|line| format!("{line}\n")).collect();
        let text = roster.to_text().replace("end", &format!("policy\n{lines}end"));
        let roster =
            if policy.is_empty() { roster } else { NodeRoster::parse(&text).expect("lines") };
        roster.sign(&Seed::new([seed; 32]))
    }

    /// The file of a node's key.
    pub fn of(&self, node: &str) -> PathBuf {
        self.0.join(format!("{node}.key"))
    }
}

fn name(text: &str) -> NodeName {
    NodeName::new(text).expect("a name")
}

/// The secret of a node: its name, and the robot's number.
fn seed_of(node: &str, robot: u8) -> Seed {
    let mut bytes = [robot; 32];
    let own = node.len().min(31);
    bytes[..own].copy_from_slice(&node.as_bytes()[..own]);
    Seed::new(bytes)
}

/// A component that answers `R` with what a channel holds.
pub fn answers<R: Request>(
    name: &str,
    answer: watch::Receiver<R::Reply>,
) -> ChildSpec<Part<watch::Receiver<R::Reply>, R>>
where
    R::Reply: Clone + Sync,
{
    serves(name, answer, |answer, _: R, _| answer.borrow().clone())
}

/// The name of the test that plays the roles of a module, which is `module_path!()` there.
pub fn role_test(module: &str) -> String {
    let (_, within) = module.split_once("::").expect("a module of a test program");
    format!("{within}::a_process_plays_its_role")
}

/// The role that this process was started for, if it was. It ends with the process of the test.
pub fn role() -> Option<String> {
    let role = std::env::var(ROLE).ok()?;
    let parent = std::os::unix::process::parent_id();
    blastema::platform::end_with_parent(parent).expect("it may be told of its parent's end");
    Some(role)
}

/// The addresses of all nodes, in a process with a role.
pub fn addresses<A: FromStr>() -> Vec<A> {
    let text = std::env::var(ADDRESSES).expect("a process with a role has addresses");
    let address = |text: &str| text.parse().ok().expect("it was an address when it was started");
    text.split(',').map(address).collect()
}

/// Free addresses of this computer, for UDP and for TCP.
pub fn free_addresses(count: usize) -> Vec<SocketAddr> {
    let hold = || loop {
        let tcp = TcpListener::bind("127.0.0.1:0").expect("the loopback interface has free ports");
        let address = tcp.local_addr().expect("it is bound");
        if let Ok(udp) = UdpSocket::bind(address) {
            return (tcp, udp, address);
        }
    };
    let held: Vec<_> = (0..count).map(|_| hold()).collect();
    held.iter().map(|(.., address)| *address).collect()
}

/// The network of `left` (0) and `right` (1), as the one of them describes it whose number is `own`.
pub fn pair_network(scheme: &str, own: usize, at: &[SocketAddr]) -> Network {
    let other = 1 - own;
    let link = Link::new(["left", "right"][other], at[other]);
    Network::new("lan", &format!("{scheme}://{}", at[own])).link(link)
}
