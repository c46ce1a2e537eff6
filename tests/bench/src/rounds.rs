//! Rounds of a component on a thread of its own, beside a bare loop of `clock_nanosleep`.
//!
//! How many of the periods had a round, and how late the rounds began: of those that are due, the
//! latest is run, in both. The percentiles of a component are those of the monitor's table, up to a
//! quarter above the true value. Where the system permits it, the component is run with a priority
//! too, which shows what other programs of the computer cost. `SECONDS=n` sets how long each takes.

use blastema::prelude::*;
use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

struct Empty(Arc<AtomicU64>);

impl Component for Empty {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.fetch_add(1, Relaxed);
        Ok(())
    }
}

pub(crate) async fn run() {
    let seconds = std::env::var("SECONDS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
    let span = Duration::from_secs(seconds);
    println!("\n## rounds of an empty component and a bare loop, {seconds} s each");
    println!("share of the periods that had a round; how late rounds began, in microseconds");
    for rate_hz in [1000, 10_000] {
        let bare = std::thread::spawn(move || bare_loop(rate_hz, span));
        bare.join().expect("the bare loop ends");
        component(rate_hz, span, None).await;
        component(rate_hz, span, Some(50)).await;
    }
}

fn print(row: &str, (run, missed): (u64, u64), lateness: [Duration; 3]) {
    let share = run as f64 / (run + missed).max(1) as f64 * 100.0;
    let [p50, p99, max] = lateness.map(|late| late.as_secs_f64() * 1e6);
    println!("{row:<40} {share:>7.3} %  p50 {p50:>6.1}  p99 {p99:>8.1}  max {max:>8.1}");
}

fn bare_loop(rate_hz: u32, span: Duration) {
    let now = || {
        let Timespec { tv_sec, tv_nsec } = clock_gettime(ClockId::Monotonic);
        (tv_sec * 1_000_000_000 + tv_nsec).cast_unsigned()
    };
    let period = 1_000_000_000 / u64::from(rate_hz);
    let (start, span) = (now(), span.as_nanos() as u64);
    let (mut due, mut missed, mut late) = (start, 0, Vec::new());
    while due < start + span {
        let at = Timespec {
            tv_sec: (due / 1_000_000_000).cast_signed(),
            tv_nsec: (due % 1_000_000_000).cast_signed(),
        };
        clock_nanosleep_absolute(ClockId::Monotonic, &at).expect("no signal comes");
        let behind = now() - due;
        (missed, due) = (missed + behind / period, due + behind / period * period);
        late.push(behind % period);
        due += period;
    }
    late.sort_unstable();
    let at = |percent: usize| Duration::from_nanos(late[(late.len() - 1) * percent / 100]);
    let row = format!("{rate_hz} Hz, clock_nanosleep");
    print(&row, (late.len() as u64, missed), [at(50), at(99), at(100)]);
}

async fn component(rate_hz: u32, span: Duration, priority: Option<u8>) {
    let rounds = Arc::new(AtomicU64::new(0));
    let counted = rounds.clone();
    let spec = ChildSpec::new("empty", move || Empty(counted.clone()));
    let spec = spec.rate_hz(rate_hz.into()).on_own_thread().max_missed_rounds(100);
    let spec = priority.into_iter().fold(spec, ChildSpec::priority);
    let builder = Node::builder("rounds").work_threads(1).child(spec);
    let row = match priority {
        None => format!("{rate_hz} Hz, component"),
        Some(priority) => format!("{rate_hz} Hz, component of priority {priority}"),
    };
    let node = match builder.start().await {
        Ok(node) => node,
        Err(error) => return println!("{row}: {error}"),
    };
    tokio::time::sleep(span).await;
    let (run, table) = (rounds.load(Relaxed), node.table().await);
    let rows = table.iter().find(|row| row.location.to_string() == "rounds:empty");
    let Some((missed, late)) = rows.and_then(|row| Some((row.missed_rounds, row.round_lateness?)))
    else {
        return println!("{row}: it had no round");
    };
    print(&row, (run, missed), [late.p50, late.p99, late.max]);
    node.shutdown().await;
}
