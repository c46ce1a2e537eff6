//! What is done to the cables, and what must hold afterwards.

use crate::bed::{Bed, CABLES, Cable, Kind};
use crate::host::Host;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Far longer than anything takes, also where the machine is busy with other things.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longer than any link takes to go down, also one that has lost many hellos before.
const OUTAGE: Duration = Duration::from_secs(1);
/// A flapping cable is in and out for so long each.
const FLAP: Duration = Duration::from_millis(60);
const FLAPS: u32 = 8;
/// How often nodes say hello here: a link is down after 175 ms, so that a busy machine is no fault.
const HELLO_MS: &str = "50";

/// Three nodes on a bed.
struct Trial {
    bed: Bed,
    hosts: Vec<Host>,
}

/// Runs all trials, or those whose names contain one of the words after the first, which is what
/// the names of namespaces begin with.
pub(crate) fn run(arguments: &[String]) -> Result<(), String> {
    let (prefix, wanted) = arguments.split_first().ok_or("a prefix for namespaces is missing")?;
    let mut failed = Vec::new();
    for kind in [Kind::Veth, Kind::Tap, Kind::Switch] {
        for medium in ["udp", "tcp"] {
            let name = format!("{medium} over {kind:?}").to_lowercase();
            if !wanted.is_empty() && !wanted.iter().any(|word| name.contains(word.as_str())) {
                continue;
            }
            println!("--- {name}");
            let start = Instant::now();
            match trial(kind, medium, prefix) {
                Ok(()) => println!("    ok, {:.1} s", start.elapsed().as_secs_f32()),
                Err(error) => {
                    println!("    FAILED: {error}");
                    failed.push(name);
                }
            }
        }
    }
    if failed.is_empty() { Ok(()) } else { Err(failed.join(", ")) }
}

fn trial(kind: Kind, medium: &str, prefix: &str) -> Result<(), String> {
    let bed = Bed::new(kind, prefix, &CABLES)?;
    let mut hosts = Vec::new();
    for name in ["a", "b", "c"] {
        let mut arguments = vec!["node".into(), name.into(), medium.into(), HELLO_MS.into()];
        arguments.extend(bed.links(name));
        hosts.push(Host::start(name, &bed.namespace(name), &arguments)?);
    }
    let mut trial = Trial { bed, hosts };
    let result = trial.tell_story(kind);
    if result.is_err() || std::env::var("BED_VERBOSE").is_ok() {
        // The report of a failure shows what led to it.
        trial.hosts.iter().for_each(|host| println!("{}", host.last_words(200)));
    }
    result?;
    trial.hosts.into_iter().try_for_each(|host| host.end(PATIENCE))
}

impl Trial {
    fn tell_story(&mut self, kind: Kind) -> Result<(), String> {
        for host in &mut self.hosts {
            let name = host.name.clone();
            for cable in CABLES.iter().filter(|cable| cable.ends.contains(&name.as_str())) {
                host.expect_also(&format!("link {} up", cable.name), PATIENCE)?;
            }
            host.expect("ready", PATIENCE)?;
        }
        let [ab, bc, ca] = CABLES;
        if kind == Kind::Switch {
            for cable in CABLES {
                let how = "pulled at one end of a switch";
                self.injure(how, cable, |bed| bed.pull(cable), |bed| bed.plug(cable))?;
            }
            return self.count();
        }
        self.injure("pulled", ab, |bed| bed.pull(ab), |bed| bed.plug(ab))?;
        self.injure("silenced", bc, |bed| bed.silence(bc), |bed| bed.restore(bc))?;
        let flapping = |bed: &Bed| {
            for _ in 0..FLAPS {
                bed.pull(ca)?;
                std::thread::sleep(FLAP);
                bed.plug(ca)?;
                std::thread::sleep(FLAP);
            }
            bed.pull(ca)
        };
        self.injure("flapping", ca, flapping, |bed| bed.plug(ca))?;
        self.count()
    }

    /// Breaks a cable, waits until both ends have named the fault, restores it, and waits until
    /// both have it back.
    fn injure(
        &mut self,
        how: &str,
        cable: Cable,
        harm: impl FnOnce(&Bed) -> Result<(), String>,
        heal: impl FnOnce(&Bed) -> Result<(), String>,
    ) -> Result<(), String> {
        let Trial { bed, hosts } = self;
        let (name, [left, right]) = (cable.name, cable.ends);
        let mut ends: Vec<(&mut Host, String)> = Vec::new();
        for host in hosts.iter_mut().filter(|host| cable.ends.contains(&host.name.as_str())) {
            let other = if host.name == left { right } else { left };
            let place = format!("{} -{name}- {other}", host.name);
            host.forget();
            ends.push((host, place));
        }
        let context = |error| format!("{name} {how}: {error}");
        let start = Instant::now();
        harm(bed).map_err(context)?;
        for (host, place) in &mut ends {
            let (found, recovered) = (
                format!("fault found link down at {place}"),
                format!("fault recovered link down at {place}"),
            );
            host.expect(&found, PATIENCE).map_err(context)?;
            // The other way was there before: recovered means that it is taken.
            host.expect_also(&recovered, PATIENCE).map_err(context)?;
        }
        let named = start.elapsed();
        std::thread::sleep(OUTAGE);
        for (host, _) in &mut ends {
            host.forget();
        }
        heal(bed).map_err(context)?;
        for (host, _) in &mut ends {
            host.expect(&format!("link {name} up"), PATIENCE).map_err(context)?;
        }
        println!(
            "    {name} {how}: named at both ends and recovered within {} ms, back after {} ms",
            named.as_millis(),
            start.elapsed().as_millis()
        );
        Ok(())
    }

    /// Everything that was sent has arrived, once and in order.
    fn count(&mut self) -> Result<(), String> {
        let mut sent = BTreeMap::new();
        for host in &mut self.hosts {
            host.order("stop")?;
            for line in host.expect("stopped", PATIENCE)? {
                let words: Vec<&str> = line.split(' ').collect();
                match words[..] {
                    ["sent", kind, to, count, "0"] => {
                        let key = (kind.to_owned(), host.name.clone(), to.to_owned());
                        sent.insert(key, count.to_owned());
                    }
                    ["sent", ..] | ["failed", ..] => return Err(format!("{}: {line}", host.name)),
                    _ => {}
                }
            }
        }
        let deadline = Instant::now() + PATIENCE;
        let mut wrong;
        loop {
            let (heard, longest) = self.heard()?;
            wrong = sent
                .iter()
                .filter(|&(key, count)| {
                    let (arrived, lost, doubled) = heard.get(key).cloned().unwrap_or_default();
                    arrived != *count || lost != "0" || doubled != "0"
                })
                .map(|(key, count)| format!("{key:?}: {count} sent, {:?} heard", heard.get(key)))
                .collect::<Vec<_>>();
            if wrong.is_empty() && sent.len() == 12 {
                let all: u64 = sent.values().filter_map(|count| count.parse::<u64>().ok()).sum();
                println!("    {all} messages, none lost, none doubled; longest gap {longest} ms");
                break;
            }
            // What is on its way arrives within a round trip; what came wrong stays so.
            std::thread::sleep(FLAP);
            if Instant::now() > deadline {
                return Err(format!("of {} series: {}", sent.len(), wrong.join("; ")));
            }
        }
        for host in &self.hosts {
            if let Some(given_up) = host.has_said("fault gaveup") {
                return Err(format!("{}: {given_up}", host.name));
            }
        }
        Ok(())
    }

    /// What arrived of each series: how many, lost and doubled; and the longest gap of all.
    fn heard(&mut self) -> Result<(Heard, u64), String> {
        let (mut heard, mut longest) = (Heard::new(), 0);
        for host in &mut self.hosts {
            host.order("tell")?;
            for line in host.expect("told", PATIENCE)? {
                let words: Vec<&str> = line.split(' ').collect();
                let ["heard", kind, from, count, lost, doubled, gap] = words[..] else { continue };
                let key = (kind.to_owned(), from.to_owned(), host.name.clone());
                heard.insert(key, (count.to_owned(), lost.to_owned(), doubled.to_owned()));
                longest = longest.max(gap.parse().unwrap_or(0));
            }
        }
        Ok((heard, longest))
    }
}

/// By kind, sender and receiver: how many arrived, were lost and doubled.
type Heard = BTreeMap<(String, String, String), (String, String, String)>;
