//! The fault chain, and the process that it lives in, as they are watched from outside: code of the application that
//! blocks, watchdogs that are stroked, programs that end otherwise than in order. On real threads; where a process
//! is to end, this test starts itself again with a role.

use blastema::core::recovery::{Done, Failed, Order};
use blastema::prelude::*;
use blastema::{ActuatorSpec, NodeBuilder, RecoveryStrategy, Tools};
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::net::UnixDatagram;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};
use std::sync::mpsc::{Receiver, Sender as Hold, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);
/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(60);
/// For calls that block.
const LIMIT: Duration = Duration::from_millis(200);

fn oil() -> FaultKind {
    FaultKind::Custom("OIL".into())
}

/// Says in which life it is.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/ask", reply = u64)]
struct Ask;

/// Declares the fault `OIL`.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/leak", reply = ())]
struct Leak;

struct Joint;

impl Component for Joint {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ask>().serve::<Leak>();
    }
}

impl Handle<Ask> for Joint {
    async fn handle(&mut self, _: Ask, cx: &mut Context<Self>) -> u64 {
        cx.incarnation().0
    }
}

impl Handle<Leak> for Joint {
    async fn handle(&mut self, _: Leak, cx: &mut Context<Self>) {
        cx.declare_fault(oil(), "a leak");
    }
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "outside/drive", reply = f32)]
struct Drive(f32);

/// Says on standard output how fast they turn.
struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0)).lease(Duration::from_secs(10)));
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        println!("drive {}", drive.0);
        drive.0
    }
}

fn joint(name: &str) -> ChildSpec<Joint> {
    ChildSpec::new(name, || Joint)
}

fn robot(ladder: Ladder) -> NodeBuilder {
    Node::builder("module1")
        .fault_kind("OIL")
        .callback_limit(LIMIT)
        .plan(Plan::default().on(oil(), ladder))
        .child(joint("joint1"))
        .child(joint("joint2"))
}

/// Waits until this is so.
async fn until<T>(mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let wait = async {
        loop {
            match look().await {
                Some(seen) => return seen,
                None => blastema::sleep(5 * MS).await,
            }
        }
    };
    tokio::time::timeout(PATIENCE, wait).await.expect("it comes to be")
}

async fn leak(node: &Node, joint: &str) {
    node.sender::<Leak>(joint).unwrap().ask(Leak).await.unwrap();
}

async fn life(node: &Node, joint: &str) -> Option<u64> {
    node.sender::<Ask>(joint).unwrap().ask(Ask).await.ok()
}

/// What stands of `place` in the record of faults: that it was found, and whether it has ended.
async fn fault_of(node: &Node, place: &str) -> Option<(FaultKind, String, bool)> {
    let entries = node.faults().await.entries;
    let place = format!("module1:{place}");
    let entry = entries.into_iter().rev().find(|entry| entry.fault.place.to_string() == place)?;
    Some((entry.fault.kind, entry.fault.detail, entry.ended.is_some()))
}

/// Blocks its caller until the other end is dropped.
#[derive(Clone)]
struct Block(Arc<Mutex<Option<Receiver<()>>>>);

impl Block {
    fn new() -> (Hold<()>, Block) {
        let (hold, held) = channel();
        (hold, Block(Arc::new(Mutex::new(Some(held)))))
    }

    /// The first time; afterwards it does nothing.
    fn block(&self) {
        let held = self.0.lock().unwrap().take();
        if let Some(held) = held {
            let _ = held.recv();
        }
    }
}

/// Blocks at joint1, the first time; restarts every other.
struct Oil(Block);

impl RecoveryStrategy for Oil {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        if order.fault.place.to_string().ends_with("joint1") {
            self.0.block();
        }
        tools.restart(&order.fault).await
    }
}

#[test]
fn a_strategy_that_blocks_is_named_and_the_fault_chain_goes_on_without_it() {
    blastema::run(async {
        let (hold, block) = Block::new();
        let ladder = Ladder::first(Measure::Custom("oil".into())).then(Measure::Restart);
        let builder = robot(ladder).recovery("oil", move || Oil(block.clone()));
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;
        leak(&node, "joint2").await;

        until(async || (life(&node, "joint1").await == Some(2)).then_some(())).await;
        until(async || (life(&node, "joint2").await == Some(2)).then_some(())).await;
        let named = until(async || fault_of(&node, "chain/strategy/oil").await).await;
        assert_eq!((named.0, named.2), (FaultKind::CheckFailed, false), "{}", named.1);
        assert!(named.1.contains("oil") && named.1.contains("200ms"), "{}", named.1);
        assert_eq!(node.abandoned_threads(), 1);
        assert!(
            node.table().await.iter().any(|row| row.place.to_string().ends_with("strategy/oil"))
        );

        drop(hold);
        until(async || fault_of(&node, "chain/strategy/oil").await.filter(|fault| fault.2)).await;
        assert_eq!(node.abandoned_threads(), 0);
        leak(&node, "joint1").await;
        until(async || (life(&node, "joint1").await == Some(3)).then_some(())).await;
        node.shutdown().await;
    });
}

#[test]
fn a_node_is_shut_down_while_its_strategies_and_safe_outputs_block() {
    blastema::run(async {
        let ((hold, block), (hold_outputs, outputs)) = (Block::new(), Block::new());
        let ladder = Ladder::first(Measure::Custom("oil".into())).then(Measure::SafeStop);
        let builder = robot(ladder)
            .safe_outputs(move |_| outputs.block())
            .recovery("oil", move || Oil(block.clone()));
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;

        let named = until(async || fault_of(&node, "safe-outputs").await).await;
        assert_eq!((named.0, named.2), (FaultKind::CheckFailed, false), "{}", named.1);
        let rests = async || node.sender::<Ask>("joint1").unwrap().ask(Ask).await.is_err();
        until(async || rests().await.then_some(())).await;
        assert_eq!(life(&node, "joint2").await, Some(1));
        assert_eq!(node.abandoned_threads(), 2);
        tokio::time::timeout(PATIENCE, node.shutdown()).await.expect("it ends");
        drop((hold, hold_outputs));
    });
}

#[test]
fn a_node_comes_to_rest_although_its_safe_outputs_block() {
    blastema::run(async {
        let (hold, outputs) = Block::new();
        let builder = Node::builder("module1").child(joint("joint1")).callback_limit(LIMIT);
        let builder = builder
            .fault_kind("OIL")
            .plan(Plan::default().on(oil(), Ladder::first(Measure::Restart)))
            .intensity(0, Duration::from_secs(60))
            .safe_outputs(move |_| outputs.block());
        let node = builder.start().await.unwrap();

        leak(&node, "joint1").await;

        let state = tokio::time::timeout(PATIENCE, node.ended()).await.expect("it comes to rest");
        assert!(matches!(state, NodeState::AtRest { .. }), "{state:?}");
        until(async || fault_of(&node, "safe-outputs").await).await;
        drop(hold);
        node.shutdown().await;
    });
}

/// An actuator whose cut-off blocks.
struct Gripper(Block);

impl Component for Gripper {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0)).cut_off(|| CUT.lock().unwrap().block()));
    }
}

/// The ports of a component are those of its type.
static CUT: std::sync::LazyLock<Mutex<Block>> =
    std::sync::LazyLock::new(|| Mutex::new(Block::new().1));

impl Handle<Drive> for Gripper {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        let _ = &self.0;
        drive.0
    }
}

#[test]
fn a_cut_off_that_blocks_is_a_fault_of_its_component_and_the_actuator_comes_to_rest() {
    blastema::run(async {
        let (hold, block) = Block::new();
        let kept = block.clone();
        let gripper = ChildSpec::new("gripper", move || Gripper(kept.clone()));
        let node = Node::builder("module1").callback_limit(LIMIT).child(gripper);
        let node = node.start().await.unwrap();
        let held = block.0.lock().unwrap().take();
        *CUT.lock().unwrap() = Block(Arc::new(Mutex::new(held)));
        let commander = node.commander::<Drive>("gripper", "console").unwrap();
        commander.claim().await.unwrap();
        commander.release().await.unwrap();

        let named = until(async || fault_of(&node, "gripper").await).await;

        assert_eq!(named.0, FaultKind::CheckFailed);
        assert!(named.1.contains("cut-off"), "{}", named.1);
        commander.claim().await.expect("its safe command was carried out");
        assert_eq!(commander.command(Drive(2.0)).await, Ok(2.0));
        drop(hold);
        node.shutdown().await;
    });
}

#[test]
fn a_callback_limit_that_makes_no_sense_is_refused_and_so_are_two_strategies_of_a_name() {
    blastema::run(async {
        for limit in [MS, Duration::from_secs(61)] {
            let refused = Node::builder("n").callback_limit(limit).start().await.unwrap_err();
            assert!(matches!(refused, StartError::Setting { setting: "callback_limit", .. }));
        }
        let (_, block) = Block::new();
        let (first, second) = (block.clone(), block);
        let twice = Node::builder("n").recovery("oil", move || Oil(first.clone()));
        let refused = twice.recovery("oil", move || Oil(second.clone())).start().await;
        let refused = refused.unwrap_err().to_string();
        assert!(refused.contains("\"oil\" twice"), "{refused}");
    });
}

#[test]
fn a_watchdog_that_cannot_be_used_is_refused_with_what_to_do() {
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("watchdog");
        let refused = Node::builder("n").watchdog_device(&missing).start().await.unwrap_err();
        assert!(matches!(refused, StartError::ProcessWatchdog(_)), "{refused:?}");
        let text = refused.to_string();
        assert!(
            text.contains(&missing.display().to_string()) && text.contains("modprobe"),
            "{text}"
        );
        let refused = Node::builder("n").watchdog_device("watchdog").start().await.unwrap_err();
        assert!(refused.to_string().contains("absolute"), "{refused}");
        let here = Node::builder("n").service_manager().on_this_thread().start().await;
        assert!(here.unwrap_err().to_string().contains("on_this_thread"));
    });
}

/// The role of a process that was started by a test.
const ROLE: &str = "BLASTEMA_TEST_ROLE";
/// Where it has its watchdog.
const DEVICE: &str = "BLASTEMA_TEST_DEVICE";

/// A process that plays a role, and is killed at the latest when the test ends.
struct Process {
    child: Child,
    lines: std::io::Lines<BufReader<ChildStdout>>,
}

impl Process {
    fn start(role: &str, environment: &[(&str, String)]) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let mut child = Command::new(program)
            .args(["--exact", "a_process_plays_its_role", "--nocapture"])
            .env(ROLE, role)
            .envs(environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the test can be started again");
        let lines = BufReader::new(child.stdout.take().expect("it was asked for")).lines();
        Process { child, lines }
    }

    /// Reads until this line.
    fn await_line(&mut self, wanted: &str) {
        let mut before = Vec::new();
        for line in &mut self.lines {
            let line = line.unwrap();
            if line == wanted {
                return;
            }
            before.push(line);
        }
        panic!("{wanted:?} is missing after {before:?}");
    }

    fn signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        let status = Command::new("kill").args([signal, &pid]).status().expect("there is kill");
        assert!(status.success());
    }

    /// How it ends, what else it has printed, and what is on its standard error.
    fn end(mut self) -> (Option<i32>, Vec<String>, String) {
        let lines = (&mut self.lines).map(Result::unwrap).collect();
        let mut errors = String::new();
        let stderr = self.child.stderr.as_mut().expect("it was asked for");
        stderr.read_to_string(&mut errors).unwrap();
        (self.child.wait().unwrap().code(), lines, errors)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_process_plays_its_role() {
    let Ok(role) = std::env::var(ROLE) else { return };
    blastema::platform::end_with_parent(std::os::unix::process::parent_id()).unwrap();
    // The test harness does not end its line.
    println!();
    let played: Result<(), Box<dyn std::error::Error>> = blastema::run(async {
        match role.as_str() {
            "watched" => stay_until_signal().await,
            "stuck" => get_stuck().await,
            role => drive_and(role).await,
        }
    });
    played.expect("main returned an error");
}

/// Wheels turn when a program ends in this way.
async fn drive_and(role: &str) -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1")
        .child(ChildSpec::new("wheels", || Wheels))
        .safe_outputs(|_| println!("safe outputs"))
        .start()
        .await?;
    let wheels = node.commander::<Drive>("wheels", "console")?;
    wheels.claim().await?;
    wheels.command(Drive(1.0)).await?;
    match role {
        "drop" => drop(node),
        "error" => Err("the map is missing")?,
        "panic" => panic!("the map is upside down"),
        "signal" => std::future::pending().await,
        "blocked" => loop {
            std::thread::park();
        },
        "shutdown" => node.shutdown().await,
        other => panic!("there is no role {other}"),
    }
    Ok(())
}

#[test]
fn a_program_that_ends_in_whichever_way_leaves_safe_outputs_and_says_so_once() {
    let cases = [
        ("drop", None, Some(0), "was dropped while it ran"),
        ("error", None, Some(101), "was dropped while it ran"),
        ("panic", None, Some(101), "was dropped while it ran"),
        ("signal", Some("-TERM"), Some(143), "SIGTERM"),
        ("signal", Some("-INT"), Some(130), "SIGINT"),
        ("blocked", Some("-TERM"), Some(143), "SIGTERM"),
    ];
    for (role, signal, status, cause) in cases {
        let mut process = Process::start(role, &[]);
        process.await_line("drive 1");
        if let Some(signal) = signal {
            process.signal(signal);
        }
        let (code, lines, errors) = process.end();

        assert_eq!(code, status, "{role}: {errors}");
        let done: BTreeSet<&str> = lines.iter().map(String::as_str).collect();
        assert!(done.contains("safe outputs") && done.contains("drive 0"), "{role}: {lines:?}");
        let said: Vec<_> = errors.lines().filter(|line| line.contains("safe outputs")).collect();
        assert!(said.len() == 1 && said[0].contains(cause), "{role}: {errors}");
        assert!(said[0].contains("module1"), "{said:?}");
    }
}

#[test]
fn a_program_that_shuts_its_node_down_has_nothing_more_to_make_safe() {
    let mut process = Process::start("shutdown", &[]);
    process.await_line("drive 1");
    let (code, lines, errors) = process.end();

    assert_eq!(code, Some(0), "{errors}");
    assert!(!lines.iter().any(|line| line == "safe outputs"), "{lines:?}");
    assert!(!errors.contains("safe outputs"), "{errors}");
}

fn watched() -> NodeBuilder {
    Node::builder("module1")
        .fault_kind("OIL")
        .plan(Plan::default().on(oil(), Ladder::first(Measure::Observe)))
        .child(joint("joint1"))
        .service_manager()
        .safe_outputs(|_| println!("safe outputs"))
}

async fn stay_until_signal() -> Result<(), Box<dyn std::error::Error>> {
    let device = std::env::var(DEVICE)?;
    let node = watched().watchdog_device(device).start().await?;
    println!("started");
    node.run_until_signal().await?;
    println!("ended in order");
    Ok(())
}

/// What a service manager hears.
struct Manager {
    socket: UnixDatagram,
    folder: tempfile::TempDir,
}

impl Manager {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        Manager { socket, folder }
    }

    fn environment(&self, watchdog: Duration) -> Vec<(&'static str, String)> {
        let path = self.folder.path().join("notify").display().to_string();
        vec![("NOTIFY_SOCKET", path), ("WATCHDOG_USEC", watchdog.as_micros().to_string())]
    }

    /// The next that comes within this time.
    fn hear(&self, within: Duration) -> Option<String> {
        let mut bytes = [0; 256];
        self.socket.set_read_timeout(Some(within)).unwrap();
        let read = self.socket.recv(&mut bytes).ok()?;
        Some(String::from_utf8(bytes[..read].to_vec()).unwrap())
    }

    fn await_state(&self, wanted: &str) {
        while self.hear(PATIENCE).expect("it is told") != wanted {}
    }
}

#[test]
fn a_watched_process_tells_its_service_manager_and_strokes_the_device_until_it_ends_in_order() {
    let manager = Manager::new();
    let device = manager.folder.path().join("watchdog");
    std::fs::write(&device, "").unwrap();
    let mut environment = manager.environment(200 * MS);
    environment.push((DEVICE, device.display().to_string()));
    let mut process = Process::start("watched", &environment);

    process.await_line("started");
    manager.await_state("READY=1");
    for _ in 0..10 {
        manager.await_state("WATCHDOG=1");
    }
    let stroked = std::fs::read(&device).unwrap();
    assert!(!stroked.is_empty() && !stroked.contains(&b'V'), "{stroked:?}");
    process.signal("-TERM");
    manager.await_state("STOPPING=1");

    process.await_line("ended in order");
    let (code, lines, errors) = process.end();
    assert_eq!(code, Some(0), "{errors}");
    assert!(!lines.iter().any(|line| line == "safe outputs"), "it stopped in order");
    let stroked = std::fs::read(&device).unwrap();
    assert_eq!(stroked.iter().position(|byte| *byte == b'V'), Some(stroked.len() - 1));
}

/// A log that blocks the thread of the fault chain, as one to a pipe does that nobody reads.
#[derive(Default)]
struct StuckLog {
    spans: AtomicUsize,
}

static STUCK: AtomicBool = AtomicBool::new(false);

impl tracing::Subscriber for StuckLog {
    fn enabled(&self, _: &tracing::Metadata<'_>) -> bool {
        true
    }

    fn new_span(&self, _: &tracing::span::Attributes<'_>) -> tracing::span::Id {
        tracing::span::Id::from_u64(1 + self.spans.fetch_add(1, SeqCst) as u64)
    }

    fn record(&self, _: &tracing::span::Id, _: &tracing::span::Record<'_>) {}

    fn record_follows_from(&self, _: &tracing::span::Id, _: &tracing::span::Id) {}

    fn event(&self, event: &tracing::Event<'_>) {
        while STUCK.load(SeqCst) && event.metadata().target().ends_with("chain::detector") {
            std::thread::park();
        }
    }

    fn enter(&self, _: &tracing::span::Id) {}

    fn exit(&self, _: &tracing::span::Id) {}
}

async fn get_stuck() -> Result<(), Box<dyn std::error::Error>> {
    tracing::subscriber::set_global_default(StuckLog::default())?;
    let node = watched().start().await?;
    println!("started");
    blastema::sleep(300 * MS).await;
    STUCK.store(true, SeqCst);
    leak(&node, "joint1").await;
    println!("stuck");
    node.run_until_signal().await?;
    Ok(())
}

#[test]
fn a_process_whose_fault_chain_stands_is_stroked_no_more_and_its_outputs_are_safe() {
    let manager = Manager::new();
    let mut process = Process::start("stuck", &manager.environment(200 * MS));
    process.await_line("started");
    manager.await_state("WATCHDOG=1");
    process.await_line("stuck");
    // What it had sent before.
    while manager.hear(MS).is_some() {}

    assert_eq!(manager.hear(Duration::from_secs(1)), None, "the chain does not answer");
    process.await_line("safe outputs");

    process.signal("-TERM");
    manager.await_state("STOPPING=1");
    let (code, _, errors) = process.end();
    assert_eq!(code, Some(0), "it ends all the same: {errors}");
    assert!(errors.contains("the fault chain has not answered"), "{errors}");
}
