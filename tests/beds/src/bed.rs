//! Namespaces as hosts, and cables between them that can be broken.
//!
//! ```text
//!         a
//!     ab / \ ca        a cable is a veth pair, or two taps and a relay between them
//!       b───c
//!        bc        (or a bridge in a host of its own, which is a switch)
//! ```

use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStderr, Command, Stdio};
use std::sync::mpsc::sync_channel;
use std::time::Duration;

/// What cables are made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A pair of virtual interfaces: the kernel tells of each change at once.
    Veth,
    /// Two taps with a relay in user space: like real Ethernet, the kernel tells of a second change
    /// within a second only when that is over.
    Tap,
    /// Each end has a cable to a switch of its own, so that the one that is pulled at its first end
    /// keeps its carrier at the other.
    Switch,
}

/// A cable by its place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cable {
    pub(crate) name: &'static str,
    pub(crate) ends: [&'static str; 2],
    net: u8,
}

/// The host that has the switches.
const SWITCHES: &str = "s";
const HOSTS: [&str; 4] = ["a", "b", "c", SWITCHES];

/// The cables of the trials.
pub(crate) const CABLES: [Cable; 3] = [
    Cable { name: "ab", ends: ["a", "b"], net: 1 },
    Cable { name: "bc", ends: ["b", "c"], net: 2 },
    Cable { name: "ca", ends: ["c", "a"], net: 3 },
];

/// Four cables between two hosts, for the figures: one that was cut has time to prove itself again.
pub(crate) const PARALLEL: [Cable; 4] = [
    Cable { name: "ab1", ends: ["a", "b"], net: 1 },
    Cable { name: "ab2", ends: ["a", "b"], net: 2 },
    Cable { name: "ab3", ends: ["a", "b"], net: 3 },
    Cable { name: "ab4", ends: ["a", "b"], net: 4 },
];

impl Cable {
    fn address(&self, end: usize) -> String {
        format!("10.77.{}.{}", self.net, end + 1)
    }
}

/// The hosts and their cables. All of it is gone when this is dropped.
pub(crate) struct Bed {
    kind: Kind,
    /// What all its namespaces begin with: two beds at a time do not meet.
    prefix: String,
    cables: &'static [Cable],
    relays: Vec<(&'static str, Child)>,
}

/// Waits until socat says that it carries; what else it says of errors is shown, now and later.
fn is_relaying(words: ChildStderr) -> bool {
    let (carries, told) = sync_channel(1);
    std::thread::spawn(move || {
        for line in BufReader::new(words).lines().map_while(Result::ok) {
            if line.contains("starting data transfer loop") {
                let _ = carries.try_send(());
            } else if line.contains("] E ") {
                println!("    {line}");
            }
        }
    });
    told.recv_timeout(Duration::from_secs(5)).is_ok()
}

/// Runs a command, with its words as arguments.
fn command(line: &str) -> Result<(), String> {
    let mut words = line.split_whitespace();
    let program = words.next().unwrap_or_default();
    let output = Command::new(program)
        .args(words)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| format!("{line}: {error}"))?;
    if output.status.success() {
        return Ok(());
    }
    Err(format!("{line}: {}", String::from_utf8_lossy(&output.stderr).trim()))
}

impl Bed {
    /// Makes hosts and lays cables.
    pub(crate) fn new(kind: Kind, prefix: &str, cables: &'static [Cable]) -> Result<Bed, String> {
        let mut bed = Bed { kind, prefix: prefix.into(), cables, relays: Vec::new() };
        for host in HOSTS {
            let host = bed.namespace(host);
            command(&format!("ip netns add {host}"))?;
            command(&format!("ip -n {host} link set lo up"))?;
        }
        for cable in cables {
            bed.lay(*cable)?;
        }
        Ok(bed)
    }

    /// The namespace of a host.
    pub(crate) fn namespace(&self, host: &str) -> String {
        format!("{}{host}", self.prefix)
    }

    fn lay(&mut self, cable: Cable) -> Result<(), String> {
        let Cable { name, ends, .. } = cable;
        let [left, right] = ends.map(|end| self.namespace(end));
        match self.kind {
            Kind::Veth => command(&format!(
                "ip -n {left} link add {name} type veth peer name {name} netns {right}"
            ))?,
            Kind::Tap => self.relay(cable)?,
            Kind::Switch => {
                let switches = self.namespace(SWITCHES);
                command(&format!("ip -n {switches} link add {name} type bridge"))?;
                command(&format!("ip -n {switches} link set {name} up"))?;
                for (port, end) in [left.as_str(), &right].into_iter().enumerate() {
                    let port = format!("{name}{port}");
                    command(&format!(
                        "ip -n {end} link add {name} type veth peer name {port} netns {switches}"
                    ))?;
                    command(&format!("ip -n {switches} link set {port} master {name} up"))?;
                }
            }
        }
        for (at, end) in [left, right].iter().enumerate() {
            command(&format!("ip -n {end} addr add {}/24 dev {name}", cable.address(at)))?;
            command(&format!("ip -n {end} link set {name} up"))?;
        }
        Ok(())
    }

    /// Two taps that are opened in one place and then moved to their hosts; the relay keeps them.
    fn relay(&mut self, cable: Cable) -> Result<(), String> {
        let Cable { name, ends, .. } = cable;
        let taps = [0, 1].map(|end| format!("{}{name}{end}", self.prefix));
        let open = |tap: &String| format!("TUN,tun-type=tap,tun-name={tap},iff-no-pi");
        let mut relay = Command::new("socat")
            .args(["-d", "-d"])
            .args(taps.iter().map(open))
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| format!("socat: {error}"))?;
        let words = relay.stderr.take().expect("it was asked for");
        self.relays.push((name, relay));
        // A tap that is moved while a process opens it is lost to that process.
        if !is_relaying(words) {
            return Err(format!("socat did not open {}", taps.join(" and ")));
        }
        for (tap, end) in taps.iter().zip(ends) {
            let host = self.namespace(end);
            command(&format!("ip link set {tap} netns {host}"))?;
            command(&format!("ip -n {host} link set {tap} name {name}"))?;
        }
        Ok(())
    }

    /// A node's links, as its program takes them.
    pub(crate) fn links(&self, host: &str) -> Vec<String> {
        let mut words = Vec::new();
        for cable in self.cables {
            let Some(own) = cable.ends.iter().position(|end| *end == host) else { continue };
            let address = |end| format!("{}:7400", cable.address(end));
            words.push(cable.name.into());
            words.push(address(own));
            words.push(cable.ends[1 - own].into());
            words.push(address(1 - own));
        }
        words
    }

    /// The cable is pulled, and both ends can know it.
    pub(crate) fn pull(&self, cable: Cable) -> Result<(), String> {
        self.set_carrier(cable, false)
    }

    /// It is plugged in again.
    pub(crate) fn plug(&self, cable: Cable) -> Result<(), String> {
        self.set_carrier(cable, true)
    }

    fn set_carrier(&self, cable: Cable, present: bool) -> Result<(), String> {
        let name = cable.name;
        let [left, right] = cable.ends.map(|end| self.namespace(end));
        match self.kind {
            // The other end of the pair loses its carrier with it: of a switch, its port.
            Kind::Veth | Kind::Switch => {
                let state = if present { "up" } else { "down" };
                command(&format!("ip -n {left} link set {name} {state}"))
            }
            Kind::Tap => {
                let state = if present { "on" } else { "off" };
                command(&format!("ip -n {left} link set {name} carrier {state}"))?;
                command(&format!("ip -n {right} link set {name} carrier {state}"))
            }
        }
    }

    /// The cable carries nothing any more, and neither end gets a report.
    pub(crate) fn silence(&self, cable: Cable) -> Result<(), String> {
        let name = cable.name;
        if self.kind == Kind::Tap {
            return self.signal_relay(name, Signal::STOP);
        }
        for end in cable.ends {
            let nft = format!("ip netns exec {} nft", self.namespace(end));
            command(&format!("{nft} add table netdev bed"))?;
            command(&format!(
                "{nft} add chain netdev bed {name} {{ type filter hook egress device {name} \
                 priority 0 ; policy drop ; }}"
            ))?;
        }
        Ok(())
    }

    /// It carries again.
    pub(crate) fn restore(&self, cable: Cable) -> Result<(), String> {
        if self.kind == Kind::Tap {
            return self.signal_relay(cable.name, Signal::CONT);
        }
        for end in cable.ends {
            let host = self.namespace(end);
            command(&format!("ip netns exec {host} nft delete table netdev bed"))?;
        }
        Ok(())
    }

    fn signal_relay(&self, cable: &str, signal: Signal) -> Result<(), String> {
        let relay = self.relays.iter().find(|(name, _)| *name == cable);
        let (_, relay) = relay.ok_or_else(|| format!("{cable} has no relay"))?;
        kill_process(Pid::from_child(relay), signal)
            .map_err(|error| format!("{signal:?} to the relay of {cable}: {error}"))
    }
}

impl Drop for Bed {
    fn drop(&mut self) {
        for (_, relay) in &mut self.relays {
            // Its taps go with it. It may have ended by itself.
            let _ = relay.kill();
            let _ = relay.wait();
        }
        for host in HOSTS {
            // What was not made cannot be deleted; `tests/beds/run` looks for what is left.
            let _ = command(&format!("ip netns del {}", self.namespace(host)));
        }
    }
}
