//! A node on a computer whose processors are kept by other processes.

use blastema::Incarnation;
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use rustix::time::{ClockId, clock_gettime};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const MS: Duration = Duration::from_millis(1);
/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Processes that keep the processors busy until this is dropped, or the test ends.
struct BusyComputer(Vec<Child>);

impl BusyComputer {
    /// Starts so many for each processor.
    fn start(each: usize) -> Self {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let start = || {
            let mut shell = Command::new("sh");
            shell
                .args(["-c", "while kill -0 $PPID; do :; done"])
                .stderr(Stdio::null())
                .spawn()
                .expect("there is sh")
        };
        BusyComputer((0..processors * each).map(|_| start()).collect())
    }
}

impl Drop for BusyComputer {
    fn drop(&mut self) {
        for child in &mut self.0 {
            // It runs until it is killed.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Has rounds that take so much of a processor's time.
struct Busy(Duration);
impl Component for Busy {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        let end = used() + self.0;
        while used() < end {}
        Ok(())
    }
}

/// What this thread has had of the processors.
fn used() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::try_from(time).expect("it counts from zero")
}

fn is_computers(entry: &FaultEntry) -> bool {
    entry.fault.kind == FaultKind::Overload && entry.fault.location.to_string() == "m"
}

#[test]
fn a_computer_that_has_no_time_is_the_root_of_an_overload_and_no_component_is() {
    blastema::run(async {
        let load = BusyComputer::start(4);
        // Less than half of a processor, and twice what a fair share leaves it.
        let busy = |name, time| {
            let spec = ChildSpec::new(name, move || Busy(time));
            spec.ready_within(LONG).max_block(LONG)
        };
        let safety = busy("safety", 4 * MS).rate_hz(100.0).liveness(Liveness::push(10 * MS, 50));
        let fast = busy("fast", Duration::ZERO).rate_hz(100.0);
        let builder = Node::builder("m").work_threads(1).child(safety).child(fast);
        let node = builder.start().await.expect("the node starts");

        let begun = Instant::now();
        while !node.faults().await.entries.iter().any(is_computers) {
            assert!(begun.elapsed() < LONG, "{:#?}", node.faults().await);
            tokio::time::sleep(20 * MS).await;
        }
        tokio::time::sleep(4000 * MS).await;

        let record = node.faults().await;
        let computers: Vec<_> = record.entries.iter().filter(|e| is_computers(e)).collect();
        assert!(computers.len() == 1 && computers[0].stands(), "{record:#?}");
        assert!(computers[0].fault.detail.contains("waited for a processor"), "{record:#?}");
        let overloads = |entry: &&FaultEntry| entry.fault.kind == FaultKind::Overload;
        let stands = |entry: &&FaultEntry| entry.stands();
        let mut open_faults = record.entries.iter().filter(overloads).filter(stands);
        assert!(open_faults.all(is_computers), "{record:#?}");
        for name in ["safety", "fast"] {
            let table = node.table().await;
            let row = table.iter().find(|row| row.location.to_string() == format!("m:{name}"));
            assert_eq!(row.expect("it is watched").incarnation, Incarnation(1), "{name}");
        }
        drop(load);
        node.shutdown().await;
    });
}
