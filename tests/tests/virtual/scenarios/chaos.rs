//! Faults by chance, many at a time; and that nothing is left broken when they end.
//!
//! One seed gives one run. A seed that fails becomes a scenario with a name.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings};
use blastema::core::detection::{FaultEntry, FaultRecord, Opinion};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{Fault, Lifecycle, NodeBuilder};
use blastema_testkit::TestNode;
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);
const NAMES: [&str; 8] = ["alone", "a1", "a2", "a3", "r1", "r2", "r3", "deep"];
const HOOKS: [&str; 11] = [
    "on_initialize",
    "on_startup",
    "on_activated",
    "on_execute",
    "on_deactivated",
    "on_aborting",
    "on_error",
    "on_reset",
    "on_shutdown",
    "on_finalize",
    "drop",
];

/// Marsaglia's xorshift: enough to choose, and the same everywhere.
struct Chance(u64);

impl Chance {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % limit
    }

    fn one_of<T: Copy>(&mut self, things: &[T]) -> T {
        things[usize::try_from(self.below(things.len() as u64)).unwrap()]
    }
}

/// Three kinds of supervisor, one below another. One that is patient never gives up.
fn robot(strings: &Strings, patient: bool) -> NodeBuilder {
    let (times, period) = (if patient { 1000 } else { 3 }, Duration::from_secs(10));
    let often = |spec: SupervisorSpec| spec.intensity(times, period);
    let spec = |name| {
        strings.spec(name).rate_hz(10.0).liveness(Liveness::push(100 * MS, 3)).max_wait(2000 * MS)
    };
    let deep = often(SupervisorSpec::new("deep/group", Strategy::OneForOne)).child(spec("deep"));
    let all = often(SupervisorSpec::new("all", Strategy::OneForAll))
        .child(spec("a1"))
        .child(spec("a2"))
        .supervisor(deep)
        .child(spec("a3").depends_on(["a1"]));
    let rest = often(SupervisorSpec::new("rest", Strategy::RestForOne))
        .child(spec("r1"))
        .child(spec("r2").depends_on(["r1"]))
        .child(spec("r3").depends_on(["r2"]));
    Node::builder("module1")
        .intensity(times, period)
        .child(spec("alone"))
        .supervisor(all)
        .supervisor(rest)
}

fn deed(chance: &mut Chance) -> Deed {
    let text = || "by chance".to_owned();
    match chance.below(12) {
        0 | 1 => Deed::Panic(text()),
        2 => Deed::PanicInTask(text()),
        3 => Deed::PanicInTimer(text()),
        4 | 5 => Deed::Fail(text()),
        6 => Deed::FailFatally(text()),
        7 => Deed::Stop,
        8 => Deed::Await(3_600_000),
        9 => Deed::Await(chance.below(500)),
        10 => Deed::Check(7.5),
        _ => Deed::PublishSoon(u32::try_from(chance.below(20)).unwrap()),
    }
}

fn pull(chance: &mut Chance) -> Pull {
    match chance.below(5) {
        0 => Pull::Fail("by chance"),
        1 => Pull::Fatal("by chance"),
        2 => Pull::Panic("by chance"),
        3 => Pull::Wait(chance.one_of(&[10 * MS, 300 * MS, 3_600_000 * MS])),
        _ => Pull::Wait(20 * MS),
    }
}

async fn run(seed: u64, patient: bool) {
    let strings = Strings::default();
    let mut chance = Chance(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) + 1);
    let node = TestNode::start(robot(&strings, patient)).await;

    let mut asked = Vec::new();
    for _ in 0..90 {
        let name = chance.one_of(&NAMES);
        match chance.below(3) {
            0 => strings.pull(name, chance.one_of(&HOOKS), pull(&mut chance)),
            1 => {
                let Ok(sender) = node.sender::<Note>(name) else { continue };
                let _ = sender.tell(Note(1));
            }
            _ => {
                let deed = deed(&mut chance);
                let Ok(sender) = node.sender::<Do>(name) else { continue };
                asked.push(tokio::task::spawn_local(async move { sender.ask(Do(deed)).await }));
            }
        }
        node.advance(chance.one_of(&[Duration::ZERO, Duration::ZERO, MS, 50 * MS, 700 * MS])).await;
    }
    strings.cut_all();
    node.advance(Duration::from_secs(60)).await;

    for request in asked {
        assert!(request.is_finished(), "seed {seed}: a request has not resolved");
    }
    if matches!(node.state(), NodeState::InSafeState { .. }) && !patient {
        return is_at_rest(seed, &node, &strings).await;
    }
    assert_eq!(node.state(), NodeState::Running, "seed {seed}");
    let record = node.faults().await;
    // What is only observed stands until its place begins a new incarnation.
    let observed =
        |entry: &&FaultEntry| entry.decided.as_ref().is_some_and(|(_, what)| what == "observe");
    let open = record.entries.iter().filter(|entry| entry.status() == blastema::FaultStatus::Open);
    let open: Vec<_> = open.filter(|entry| !observed(entry)).collect();
    assert!(open.is_empty(), "seed {seed}: faults that did not end:\n{}", story(&record));
    let mut leaves = node.tree().await.unwrap().children;
    while let Some(leaf) = leaves.pop() {
        let (name, resting) = (leaf.name.as_str(), leaf.state == ChildState::Resting);
        if resting {
            // And all below it.
            let given_up = was_given_up(&record, name);
            assert!(given_up, "seed {seed}: {name} rests, not given up:\n{}", story(&record));
            continue;
        }
        leaves.extend(leaf.below.into_iter().flat_map(|branch| branch.children));
        assert_eq!(leaf.state, ChildState::Running, "seed {seed}: {name}:\n{}", story(&record));
        let row = node.row(name).await;
        let told = format!("seed {seed}: {name}: {row:?}\n{}", story(&record));
        assert_eq!(row.state, Some(Lifecycle::Active), "{told}");
        assert_eq!(row.opinion, Opinion::Trusted, "{told}");
        if NAMES.contains(&name) {
            let answer = node.sender::<Do>(name).unwrap().ask(Do(Deed::Nothing)).await;
            assert_eq!(answer.expect("it answers"), row.incarnation.0, "seed {seed}: {name}");
            assert_eq!(leaf.incarnation, row.incarnation, "seed {seed}: {name}");
        }
    }
}

/// Nothing lives, no caller is kept waiting, and the node can be ended.
async fn is_at_rest(seed: u64, node: &TestNode, strings: &Strings) {
    strings.diary();
    for name in NAMES {
        let refused = node.sender::<Do>(name).unwrap().ask(Do(Deed::Nothing)).await;
        let why = refused.expect_err("it rests").kind;
        assert!(
            matches!(why, DeliveryError::Stopped | DeliveryError::Isolated { .. }),
            "seed {seed}: {name}: {why}"
        );
    }
    node.advance(Duration::from_secs(60)).await;
    assert_eq!(strings.diary(), [""; 0], "seed {seed}");
    let ended = tokio::time::timeout(Duration::from_secs(60), node.shutdown()).await;
    assert!(ended.is_ok(), "seed {seed}");
}

/// The record as lines, with the seconds since the first fault.
fn story(record: &FaultRecord) -> String {
    let Some(first) = record.entries.first() else { return String::new() };
    let start = first.fault.found_at;
    let line = |entry: &FaultEntry| {
        let Fault { id, kind, location, incarnation, detail, found_at, count, .. } = &entry.fault;
        let after = (*found_at - start).as_secs_f64();
        let decided = entry.decided.as_ref().map(|(_, action)| action.as_str());
        let ended = entry.repaired_at.map(|at| ((at - start).as_secs_f64(), entry.status()));
        format!(
            "{after:8.3} #{} {kind} of {location}{incarnation} ×{count}: {detail}; {decided:?} {ended:?} {:?}",
            id.0, entry.fault.symptom_of
        )
    };
    record.entries.iter().map(line).collect::<Vec<_>>().join("\n")
}

fn was_given_up(record: &FaultRecord, name: &str) -> bool {
    record.entries.iter().any(|entry| {
        let here = entry.fault.location.to_string() == format!("module1:{name}");
        here && entry.given_up.is_some()
    })
}

#[test]
fn whatever_strikes_nothing_stays_broken() {
    let seeds = std::env::var("SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(6);
    let first = std::env::var("SEED").ok().and_then(|text| text.parse().ok()).unwrap_or(0);
    for seed in first..first + seeds {
        blastema_testkit::run(run(seed, true));
        blastema_testkit::run(run(seed, false));
    }
}
