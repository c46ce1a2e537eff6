//! A node on a computer whose processors are kept by other processes.

use blastema::Incarnation;
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema_tests::{MS, Part, accepts, until};
use rustix::time::{ClockId, clock_gettime};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// As long as anything here may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);
/// The limit of all handlers that are not to hang by chance.
const MAX_BLOCK: Duration = Duration::from_millis(500);

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
    let _turn = blastema_doubles::turn();
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

        until(async || node.faults().await.entries.iter().any(is_computers), "an overload").await;
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

/// Keeps the thread of its receiver until that is released.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "busy_computer/keep")]
struct Keep;

/// How a handler keeps its thread.
#[derive(Clone, Copy, Debug)]
enum Way {
    Computes,
    Waits,
}

/// What a handler that keeps its thread shares with the test.
#[derive(Default)]
struct Grip {
    is_released: Mutex<bool>,
    released: Condvar,
    /// How much of a processor's time it has had, in microseconds.
    used: AtomicU64,
}

fn stuck(way: Way, grip: &Arc<Grip>) -> ChildSpec<Part<(Way, Arc<Grip>), Keep>> {
    accepts("stuck", (way, grip.clone()), |(way, grip), _, _| {
        let before = used();
        if let Way::Waits = way {
            let is_released = grip.is_released.lock().unwrap();
            drop(grip.released.wait_while(is_released, |is_released| !*is_released).unwrap());
        }
        while !*grip.is_released.lock().unwrap() {
            let micros = (used() - before).as_micros();
            grip.used.store(u64::try_from(micros).expect("it fits"), SeqCst);
        }
    })
}

fn is_hang(entry: &FaultEntry) -> bool {
    entry.fault.kind == FaultKind::Hang && entry.fault.location.to_string() == "m:stuck"
}

/// A component keeps its thread. One works on the same thread, two on others, of which one has
/// handlers of half of the limit: that one is found, and no other. Answers how much of a
/// processor's time the handler has had until then.
fn is_found_alone(way: Way) -> Duration {
    blastema::run(async move {
        let load = BusyComputer::start(4);
        let grip = Arc::new(Grip::default());
        let busy = |name, time, rate| {
            let spec = ChildSpec::new(name, move || Busy(time)).rate_hz(rate);
            spec.ready_within(LONG).max_block(MAX_BLOCK)
        };
        let builder = Node::builder("m")
            .work_threads(1)
            .child(stuck(way, &grip).ready_within(LONG).max_block(MAX_BLOCK))
            .child(busy("beside", MS, 50.0))
            .child(busy("apart", MS, 50.0).on_own_thread())
            .child(busy("slow", MAX_BLOCK / 2, 1.0).on_own_thread());
        let node = builder.start().await.expect("the node starts");

        node.sender("stuck").expect("it is there").tell(Keep).expect("there is room");
        until(async || node.faults().await.entries.iter().any(is_hang), "a hang").await;
        let used = Duration::from_micros(grip.used.load(SeqCst));

        let row = |name: &str| format!("m:{name}");
        let unharmed = [row("apart"), row("slow")];
        let table = node.table().await;
        let rows = table.iter().filter(|row| unharmed.contains(&row.location.to_string()));
        assert!(rows.clone().count() == 2, "{table:#?}");
        assert!(rows.clone().all(|row| row.incarnation == Incarnation(1)), "{table:#?}");
        let record = node.faults().await;
        let is_own = |entry: &&FaultEntry| entry.fault.symptom_of.is_none();
        let mut places = record.entries.iter().filter(is_own).map(|e| e.fault.location.to_string());
        assert!(places.all(|place| place == "m" || place == "m:stuck"), "{record:#?}");
        *grip.is_released.lock().unwrap() = true;
        grip.released.notify_all();
        drop(load);
        node.shutdown().await;
        used
    })
}

#[test]
fn a_handler_that_computes_hangs_once_it_was_given_the_processor_for_its_limit() {
    let _turn = blastema_doubles::turn();
    let used = is_found_alone(Way::Computes);
    // The kernel counts in ticks. What it computes until its hang is reported comes on top.
    assert!(used >= MAX_BLOCK - 20 * MS && used < 2 * MAX_BLOCK, "{used:?}");
}

#[test]
fn a_handler_that_waits_hangs_though_it_uses_no_processor() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let used = is_found_alone(Way::Waits);
    assert!(used < MAX_BLOCK / 2, "{used:?}");
}
