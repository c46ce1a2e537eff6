//! Rounds of components on threads of their own, whose timer is the kernel's. Everything is judged
//! by counts and order: on a busy machine rounds are missed, and missed rounds are counted.
#![cfg(target_os = "linux")]

use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema::{Incarnation, NodeBuilder};
use blastema_testkit::TestNode;
use blastema_tests::{MS, burn, until};
use std::num::NonZero;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// What a loop does in its round of this number, when it was started so often; from 1 on.
type Act = fn(u64, u64) -> Then;

/// What it does after that.
enum Then {
    Return,
    Await(Duration),
    /// This was its last round.
    End,
}

/// How often a loop was started, and when its rounds began since then, and how many have.
#[derive(Default)]
struct LoopRecord {
    starts: AtomicU64,
    rounds: AtomicU64,
    first: Mutex<Option<Instant>>,
    latest: Mutex<[Option<Instant>; 10]>,
    /// How often ten rounds in a row began within three milliseconds.
    fine: AtomicU64,
    /// It has no rounds any more.
    is_over: AtomicBool,
}

struct Loop(Arc<LoopRecord>, Act);

impl Component for Loop {
    async fn on_activated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        *self.0.first.lock().unwrap() = None;
        self.0.rounds.store(0, SeqCst);
        self.0.starts.fetch_add(1, SeqCst);
        Ok(())
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let (record, now) = (&self.0, Instant::now());
        if record.is_over.load(SeqCst) {
            return Ok(());
        }
        record.first.lock().unwrap().get_or_insert(now);
        {
            let mut latest = record.latest.lock().unwrap();
            latest.rotate_left(1);
            latest[9] = Some(now);
            let is_fine = latest[0].is_some_and(|first| now - first < 3 * MS);
            record.fine.fetch_add(is_fine.into(), SeqCst);
        }
        let round = record.rounds.fetch_add(1, SeqCst) + 1;
        match (self.1)(record.starts.load(SeqCst), round) {
            Then::Return => {}
            Then::Await(span) => tokio::time::sleep(span).await,
            Then::End => {
                record.is_over.store(true, SeqCst);
                cx.set_interval(None);
            }
        }
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

#[test]
fn rounds_come_closer_than_the_timers_of_the_runtime_are() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let node = start(motors(&record, 10_000.0, |_, _| Then::Return)).await;

        // The timers of the runtime are a millisecond apart.
        until(async || record.fine.load(SeqCst) > 0, "ten rounds within 3 ms").await;

        node.shutdown().await;
    });
}

#[test]
fn a_loop_that_had_its_processor_is_not_blamed() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let node = start(motors(&record, 1000.0, |_, _| Then::Return).max_block(LONG)).await;

        until(async || record.rounds.load(SeqCst) >= 1000, "a thousand rounds").await;

        let faults = node.faults().await;
        // The computer is overloaded, which it may be wherever tests are run.
        let is_computers = |entry: &FaultEntry| entry.fault.location.to_string() == "m";
        let is_blamed =
            |entry: &&FaultEntry| !is_computers(entry) && entry.fault.symptom_of.is_none();
        assert_eq!(faults.entries.iter().find(is_blamed), None);
        node.shutdown().await;
    });
}

/// The rounds of a loop that has ended, how many it missed, and how late they began at most. All of
/// them are the periods between the first and the last, as far as the lateness of these two, and of
/// the clock's reading in them, leaves that open.
async fn add_up(
    record: &LoopRecord,
    node: &TestNode,
    period: Duration,
    reading: Duration,
) -> (u64, u64, Duration) {
    until(async || record.is_over.load(SeqCst), "its last round").await;
    let row = node.row("motors").await;
    let late = row.round_lateness.expect("it has had rounds").max + reading;
    let first = record.first.lock().unwrap().expect("it has begun");
    let span = record.latest.lock().unwrap()[9].expect("it has begun") - first;
    let (rounds, missed) = (record.rounds.load(SeqCst), row.missed_rounds);
    let periods = u32::try_from(rounds - 1 + missed).expect("a few");
    assert!(
        period * periods <= span + late && period * periods + late >= span,
        "{rounds} rounds and {missed} that were missed, up to {late:?} late, in {span:?}"
    );
    (rounds, missed, late)
}

#[test]
fn rounds_and_those_that_overruns_miss_are_exactly_the_periods_that_have_passed() {
    let _turn = blastema_doubles::turn();
    const PERIOD: Duration = Duration::from_millis(50);
    blastema::run(async {
        let act: Act = |_, round| match round % 8 {
            // It keeps its thread, or awaits something, until the second period after its own.
            2 => {
                burn(PERIOD * 11 / 5);
                Then::Return
            }
            6 => Then::Await(PERIOD * 11 / 5),
            0 if round == 16 => Then::End,
            _ => Then::Return,
        };
        let begun = Instant::now();
        loop {
            let record = Arc::<LoopRecord>::default();
            let node = start(motors(&record, 20.0, act).max_missed_rounds(100)).await;
            let (rounds, missed, late) = add_up(&record, &node, PERIOD, Duration::ZERO).await;
            node.shutdown().await;
            assert!(rounds == 16 && missed >= 4, "{missed}");
            // There was one number of periods only, unless the computer was busy.
            if 2 * late < PERIOD {
                return;
            }
            assert!(begun.elapsed() < LONG, "each time it was late by half a period, {late:?}");
        }
    });
}

#[test]
fn rounds_that_get_no_processor_are_missed_and_counted() {
    let _turn = blastema_doubles::turn();
    const PERIOD: Duration = Duration::from_micros(100);
    let (begun, is_over) = (Instant::now(), AtomicBool::new(false));
    let is_busy = || !is_over.load(SeqCst) && begun.elapsed() < 2 * LONG;
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(2, NonZero::get) {
            scope.spawn(|| while is_busy() {});
        }
        let act: Act = |_, round| if round == 20_000 { Then::End } else { Then::Return };
        let mut counted = 0;
        while counted == 0 && begun.elapsed() < LONG {
            counted = blastema::run(async {
                let record = Arc::<LoopRecord>::default();
                let node = start(motors(&record, 10_000.0, act).max_missed_rounds(100)).await;
                let (_, missed, _) = add_up(&record, &node, PERIOD, 20 * MS).await;
                node.shutdown().await;
                missed
            });
        }
        is_over.store(true, SeqCst);
        assert!(counted > 0, "the loop always got a processor");
    });
}

#[test]
fn a_loop_that_is_restarted_has_rounds_from_then_on_and_has_missed_none_before() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let panics: Act = |start, round| match (start, round) {
            (1, 5) => {
                burn(100 * MS);
                Then::Return
            }
            (1, 10) => panic!("the motors tripped"),
            (_, 300) => Then::End,
            _ => Then::Return,
        };
        let mut node = start(motors(&record, 1000.0, panics).max_missed_rounds(100)).await;

        node.await_fault(FaultKind::Panic, "motors").await;

        add_up(&record, &node, MS, 20 * MS).await;
        assert_eq!(node.row("motors").await.incarnation, Incarnation(2));
        node.shutdown().await;
    });
}

#[test]
fn a_round_that_hangs_is_found_and_the_loop_goes_on_elsewhere() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let record = Arc::<LoopRecord>::default();
        let hangs: Act = |start, round| {
            if (start, round) == (1, 100) {
                loop {
                    std::thread::park();
                }
            }
            Then::Return
        };
        let mut node = start(motors(&record, 1000.0, hangs).max_block(100 * MS)).await;

        let hang = node.await_fault(FaultKind::Hang, "motors").await;
        assert!(hang.detail.contains("on_execute"), "{}", hang.detail);
        let goes_on = || record.starts.load(SeqCst) >= 2 && record.rounds.load(SeqCst) >= 200;
        until(async || goes_on(), "rounds again").await;

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
    let _turn = blastema_doubles::turn();
    const SCHED_FIFO: u32 = 1;
    blastema::run(async {
        let seen = Arc::new(Mutex::new(None));
        let (kept, [cpu, ..]) = (seen.clone(), scheduling());
        let spec = ChildSpec::new("motors", move || ScheduledLoop(kept.clone())).on_own_thread();
        let spec = spec.priority(10).cpu(usize::try_from(cpu).unwrap());
        match Node::builder("m").work_threads(1).child(spec).start().await {
            Ok(node) => {
                until(async || seen.lock().unwrap().is_some(), "it is active").await;
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
