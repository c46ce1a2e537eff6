//! Robots by chance: trees, rates, panics, hangs, floods and conditions, in virtual time and on
//! real threads, judged by a small model of what must hold.
//!
//! Each rule fails in virtual time where the product is broken on purpose:
//!
//! | rule | how the product was broken |
//! | --- | --- |
//! | start: an error names its cause | its reason is left out |
//! | start: ports that panic are refused | the panic is ignored |
//! | shutdown: nothing acts afterwards | it, or a failed start, does not wait for components |
//! | shutdown: it ends | it is not answered |
//! | commands: each has an outcome | a supervisor does not say that it gave up |
//! | commands: a refusal has a reason | the root refuses late children |
//! | requests: served once | a request is sent again when its receiver dies |
//! | requests: in time | deadlines are swept 100 ms late, or never |
//! | requests: the outcome is true | death is told of another incarnation, as *restarting*, or not |
//! | incarnations: one number each | a guard begins the next one under the same number |
//! | incarnations: an ended one is idle | an abandoned one is not fenced |
//! | events: once, in order, as wanted | given twice, in reverse, or against the condition |
//! | events: the lost are counted | one for a busy listener is dropped |
//! | deaths: each panic is told once | a guard does not tell that it restarted, or counts twice |
//! | deaths: panics in `Drop` are told | they are only logged |
//! | notices: each end once | told twice, or not where an incarnation is abandoned |
//! | roots: a fault has a cause | each third start declares one |
//! | ends: no fault stays open | that the second incarnation works is not reported |
//! | pictures: all views agree | the same; the table is not told who is added, or removed |
//! | pictures: who rests has a reason | a child that dies in its third incarnation is not restarted |
//! | pictures: isolation is shown | a restart closes the fault, or it is not cut off |
//! | isolation: nothing is taken | it is not cut off |
//! | rounds: as many as the rate says | a period is 5 % too long, or 10 % too short |
//! | bystanders: they are left alone | `one_for_one` restarts all |

mod answers;
mod commands;
mod ledger;
mod model;
mod part;
mod plan;
mod requests;
mod run;
mod story;

use plan::{Clock, Robot};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

/// What is wrong with the run of this plan.
fn breaches(robot: &Arc<Robot>) -> Vec<String> {
    match catch_unwind(AssertUnwindSafe(|| run::carry_out(robot))) {
        Ok(Ok(evidence)) => model::breaches(&evidence),
        Ok(Err(refusal)) => commands::breaches_of_start(&refusal),
        Err(payload) => {
            let text = payload.downcast_ref::<String>().cloned();
            vec![format!("the run itself panicked: {}", text.unwrap_or_default())]
        }
    }
}

/// Which rule it is that does not hold.
fn kind(breach: &str) -> &str {
    breach.split(':').next().unwrap_or_default()
}

/// So many smaller plans are tried before the smallest that was found is shown: seconds.
const RUNS: usize = 100;

/// Leaves out components, steps and answers of the plan for as long as the first breach stays the
/// same kind.
fn shrunk(robot: Arc<Robot>, breach: &str) -> Arc<Robot> {
    let wanted = kind(breach);
    let fails = |robot: &Arc<Robot>| breaches(robot).iter().any(|breach| kind(breach) == wanted);
    let (mut least, mut runs) = (robot, 0);
    loop {
        let fewer_parts = (0..least.parts.len()).filter_map(|index| least.without_part(index));
        let fewer_steps = (0..least.steps.len()).map(|index| {
            let mut less = (*least).clone();
            less.steps.remove(index);
            less
        });
        let fewer_answers = (0..least.answers.len()).map(|index| {
            let mut less = (*least).clone();
            less.answers.remove(index);
            less
        });
        let fewer = fewer_parts.chain(fewer_steps).chain(fewer_answers);
        let mut candidates = fewer.map(Arc::new).take(RUNS - runs);
        let smaller = candidates.find(|less| {
            runs += 1;
            fails(less)
        });
        match smaller {
            Some(less) => least = less,
            None => return least,
        }
    }
}

fn number(variable: &str, default: u64) -> u64 {
    let text = std::env::var(variable).ok();
    text.map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{variable} is a number")))
}

/// Runs so many seeds, and says how the first that fails is repeated.
fn run_seeds(test: &str, count: &str, default: u64, workers: usize, clock: fn(u64) -> Clock) {
    // Faults of the plans are no news for who reads the output of the tests.
    let _ = tracing::subscriber::set_global_default(tracing::subscriber::NoSubscriber::default());
    let default = if std::env::var("BLASTEMA_SEED").is_ok() { 1 } else { default };
    let (first, seeds) = (number("BLASTEMA_SEED", 1), number(count, default));
    let (next, failed) = (AtomicU64::new(first), Mutex::new(Vec::new()));
    thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Relaxed);
                    if seed >= first + seeds {
                        return;
                    }
                    let robot = Arc::new(Robot::of_seed(seed, clock(seed)));
                    let breaches = breaches(&robot);
                    if !breaches.is_empty() {
                        failed.lock().unwrap().push((seed, robot, breaches));
                    }
                }
            });
        }
    });
    let mut failed = failed.into_inner().unwrap();
    failed.sort_by_key(|(seed, ..)| *seed);
    let Some((seed, robot, breaches)) = failed.first() else { return };
    let failure = |(seed, _, breaches): &(u64, Arc<Robot>, Vec<String>)| {
        format!("{seed} ({})", kind(&breaches[0]))
    };
    let failures: Vec<String> = failed.iter().map(failure).collect();
    let least = match robot.clock {
        Clock::Virtual => shrunk(robot.clone(), &breaches[0]),
        Clock::Real { .. } => robot.clone(),
    };
    let again = self::breaches(&least);
    panic!(
        "{} of {seeds} seeds failed: {}\n\
         again with: BLASTEMA_SEED={seed} cargo test -p blastema-tests --test virtual {test}\n\n\
         {}\n\nthe smallest plan that fails likewise:\n{least}\n{}",
        failed.len(),
        failures.join(", "),
        breaches.join("\n"),
        again.join("\n"),
    );
}

#[test]
fn robots_by_chance_keep_their_promises_in_virtual_time() {
    let workers = thread::available_parallelism().map_or(1, usize::from);
    let test = "robots_by_chance_keep_their_promises_in_virtual_time";
    run_seeds(test, "BLASTEMA_SEEDS", 20, workers, |_| Clock::Virtual);
}

/// Robots that showed defects which few others show.
#[test]
fn robots_that_have_shown_defects_keep_their_promises() {
    let shown = [711_617, 712_785, 712_908, 714_159, 800_148];
    for seed in shown {
        let breaches = breaches(&Arc::new(Robot::of_seed(seed, Clock::Virtual)));
        assert!(breaches.is_empty(), "seed {seed}: {}", breaches.join("\n"));
    }
}

/// On real threads.
mod real {
    use super::*;

    const COUNT: &str = "BLASTEMA_REAL_SEEDS";

    #[test]
    fn robots_by_chance_keep_their_promises_on_real_threads() {
        // Each robot lives for some seconds.
        let _turn =
            blastema_doubles::turn_within(Duration::from_secs(300 + 10 * number(COUNT, 10)));
        let test = "robots_by_chance_keep_their_promises_on_real_threads";
        let clock = |seed| Clock::Real { threads: 1 + u8::try_from(seed % 3).expect("below 3") };
        run_seeds(test, COUNT, 10, 1, clock);
    }
}
