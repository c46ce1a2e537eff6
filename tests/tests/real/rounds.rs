//! Rounds of components on threads of their own, whose timer is the kernel's. Everything is judged
//! by counts and order: on a busy machine rounds are missed, and missed rounds are counted.
#![cfg(target_os = "linux")]

use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema::{Incarnation, NodeBuilder};
use blastema_testkit::TestNode;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const MS: Duration = Duration::from_millis(1);
/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// What a loop does in its round of this number, counted over all its incarnations.
type Act = fn(u64);

/// When the latest rounds of a loop began, and how many have.
#[derive(Default)]
struct LoopRecord {
    rounds: AtomicU64,
    first: Mutex<Option<Instant>>,
    latest: Mutex<[Option<Instant>; 10]>,
    /// Ten rounds in a row began within three milliseconds.
    is_fine: AtomicU64,
}

struct Loop(Arc<LoopRecord>, Act);

impl Component for Loop {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        let (record, now) = (&self.0, Instant::now());
        record.first.lock().unwrap().get_or_insert(now);
        {
            let mut latest = record.latest.lock().unwrap();
            latest.rotate_left(1);
            latest[9] = Some(now);
            if latest[0].is_some_and(|first| now - first < 3 * MS) {
                record.is_fine.fetch_add(1, SeqCst);
            }
        }
        (self.1)(record.rounds.fetch_add(1, SeqCst) + 1);
        Ok(())
    }
}

fn motors(record: &Arc<LoopRecord>, rate_hz: f64, act: Act) -> ChildSpec<Loop> {
    let record = record.clone();
    let motors = ChildSpec::new("motors", move || Loop(record.clone(), act));
    motors.rate_hz(rate_hz).on_own_thread().ready_within(LONG)
}

async fn start(motors: ChildSpec<Loop>) -> TestNode {
    let node: NodeBuilder = Node::builder("m").work_threads(1).child(motors);
    TestNode::of(node.start().await.expect("the node starts")).await
}

async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < LONG, "{what}: never");
        tokio::time::sleep(5 * MS).await;
    }
}

#[test]
fn rounds_come_closer_than_the_timers_of_the_runtime_are() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let node = start(motors(&record, 10_000.0, |_| ())).await;

        // The timers of the runtime are a millisecond apart.
        until("ten rounds within 3 ms", async || record.is_fine.load(SeqCst) > 0).await;

        node.shutdown().await;
    });
}

#[test]
fn a_loop_that_had_its_processor_is_not_blamed() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let node = start(motors(&record, 1000.0, |_| ()).max_block(LONG)).await;

        until("a thousand rounds", async || record.rounds.load(SeqCst) >= 1000).await;

        let faults = node.faults().await;
        // The computer is overloaded, which it may be wherever tests are run.
        let is_computers = |entry: &FaultEntry| entry.fault.location.to_string() == "m";
        let is_blamed =
            |entry: &&FaultEntry| !is_computers(entry) && entry.fault.symptom_of.is_none();
        assert_eq!(faults.entries.iter().find(is_blamed), None);
        node.shutdown().await;
    });
}

#[test]
fn rounds_that_overrun_miss_others_and_all_are_no_more_than_the_periods_that_have_passed() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let overrun: Act = |round| {
            if round % 10 == 0 {
                let begun = Instant::now();
                while begun.elapsed() < 5 * MS {
                    std::hint::spin_loop();
                }
            }
        };
        let node = start(motors(&record, 1000.0, overrun).max_missed_rounds(100)).await;

        until("some rounds", async || record.rounds.load(SeqCst) >= 200).await;

        until("fifty are missed", async || {
            let missed = node.row("motors").await.missed_rounds;
            let rounds = record.rounds.load(SeqCst);
            let first = record.first.lock().unwrap().expect("it has begun");
            let periods = u64::try_from(first.elapsed().as_millis()).unwrap();
            // On a busy computer the sum may stay behind the periods.
            missed >= 50 && rounds + missed <= periods + 200
        })
        .await;
        node.shutdown().await;
    });
}

#[test]
fn a_loop_is_restarted_and_its_rounds_come_again() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let panics: Act = |round| assert_ne!(round, 100, "the motors tripped");
        let mut node = start(motors(&record, 1000.0, panics)).await;

        node.await_fault(FaultKind::Panic, "motors").await;
        until("rounds again", async || record.rounds.load(SeqCst) >= 300).await;

        assert_eq!(node.row("motors").await.incarnation, Incarnation(2));
        node.shutdown().await;
    });
}

#[test]
fn a_round_that_hangs_is_found_and_the_loop_goes_on_elsewhere() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let hangs: Act = |round| {
            while round == 100 {
                std::thread::park();
            }
        };
        let mut node = start(motors(&record, 1000.0, hangs).max_block(100 * MS)).await;

        let hang = node.await_fault(FaultKind::Hang, "motors").await;
        assert!(hang.detail.contains("on_execute"), "{}", hang.detail);
        until("rounds again", async || record.rounds.load(SeqCst) >= 300).await;

        node.shutdown().await;
    });
}

/// The processor, priority and policy of this thread: fields 39 to 41 of proc_pid_stat(5).
fn scheduling() -> [u32; 3] {
    let stat = std::fs::read_to_string("/proc/thread-self/stat").expect("it is there");
    let (_, after_the_name) = stat.rsplit_once(") ").expect("a name in parentheses");
    let fields: Vec<&str> = after_the_name.split(' ').collect();
    [36, 37, 38].map(|at| fields[at].parse().expect("a number"))
}

struct ScheduledLoop(Arc<Mutex<Option<[u32; 3]>>>);

impl Component for ScheduledLoop {
    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        *self.0.lock().unwrap() = Some(scheduling());
        Ok(())
    }
}

#[test]
fn a_thread_has_its_priority_and_processor_or_the_start_is_refused_with_what_to_do() {
    const SCHED_FIFO: u32 = 1;
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let seen = Arc::new(Mutex::new(None));
        let (kept, [cpu, ..]) = (seen.clone(), scheduling());
        let spec = ChildSpec::new("motors", move || ScheduledLoop(kept.clone())).on_own_thread();
        let spec = spec.priority(10).cpu(usize::try_from(cpu).unwrap());
        match Node::builder("m").work_threads(1).child(spec).start().await {
            Ok(node) => {
                until("it is active", async || seen.lock().unwrap().is_some()).await;
                assert_eq!(*seen.lock().unwrap(), Some([cpu, 10, SCHED_FIFO]));
                node.shutdown().await;
            }
            Err(refused) => {
                let refused = refused.to_string();
                let words = ["priority of motors is 10, which failed", "rtprio", "CAP_SYS_NICE"];
                assert!(words.iter().all(|word| refused.contains(word)), "{refused}");
            }
        }
    });
}
