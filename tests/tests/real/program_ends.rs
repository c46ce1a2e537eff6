//! Programs that end otherwise than in order, and the watchdogs of their process. This test starts
//! itself again for them: a process that finds a role in its environment plays it.
#![allow(clippy::print_stdout, reason = "the processes tell the test what they do")]

use blastema::prelude::*;
use blastema::{ActuatorSpec, Hold, Network, NodeBuilder};
use blastema_tests::MS;
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::net::UnixDatagram;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::Ordering::SeqCst;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::time::Duration;

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(60);

fn oil() -> FaultKind {
    FaultKind::Custom("OIL".into())
}

/// Declares the fault `OIL`.
#[derive(Clone, Debug, Request)]
#[contract(name = "ends/leak", reply = ())]
struct Leak;

struct Joint;

impl Component for Joint {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Leak>();
    }
}

impl Handle<Leak> for Joint {
    async fn handle(&mut self, _: Leak, cx: &mut Context<Self>) {
        cx.declare_fault(oil(), "a leak");
    }
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "ends/drive", reply = f32)]
struct Drive(f32);

/// Says on standard output how fast they turn.
struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0), Hold).lease(Duration::from_secs(10)));
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        println!("drive {}", drive.0);
        drive.0
    }
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
    /// As a shell starts it, also where these tests were started by `nohup`.
    fn start(role: &str, environment: &[(&str, String)]) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let mut env = Command::new("env");
        env.arg("--default-signal=HUP").arg(program);
        Process::spawn(env, role, environment)
    }

    /// As `nohup` starts it.
    fn start_without_hangups(role: &str) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let mut shell = Command::new("sh");
        shell.args(["-c", "trap '' HUP; exec \"$0\" \"$@\""]).arg(program);
        Process::spawn(shell, role, &[])
    }

    /// As a user who may open so many files starts it. It is ended when it takes too long.
    fn start_with_files(role: &str, files: usize) -> Self {
        let program = std::env::current_exe().expect("a running program has a path");
        let line = format!("ulimit -n {files}; exec \"$0\" \"$@\"");
        let mut timeout = Command::new("timeout");
        timeout.arg(PATIENCE.as_secs().to_string()).args(["sh", "-c", &line]).arg(program);
        Process::spawn(timeout, role, &[])
    }

    fn spawn(mut command: Command, role: &str, environment: &[(&str, String)]) -> Self {
        let mut child = command
            .args(["--exact", &blastema_tests::role_test(module_path!()), "--nocapture"])
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
            "unsafe" => drop_with_outputs_that_panic().await,
            "plain" => drop_without_outputs().await,
            "asks" => ask_a_joint().await,
            "listens" => listen_for_strangers().await,
            "hangs" | "hangs in main" | "hangs without outputs" | "stops slowly" => {
                stop_with(&role).await
            }
            "lands" => land_beside_a_stuck_log().await,
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
    let _turn = blastema_doubles::turn();
    let cases = [
        ("drop", None, Some(0), "was dropped while it ran"),
        ("error", None, Some(101), "was dropped while it ran"),
        ("panic", None, Some(101), "was dropped by a panic while it ran"),
        ("signal", Some("-TERM"), Some(143), "SIGTERM"),
        ("signal", Some("-INT"), Some(130), "SIGINT"),
        ("signal", Some("-HUP"), Some(129), "SIGHUP"),
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
        let faults: Vec<_> = errors.lines().filter(|line| line.contains("on node")).collect();
        assert!(faults.is_empty(), "{role}: what ends with its node is no fault: {faults:?}");
    }
}

#[test]
fn a_program_that_is_to_outlive_its_terminal_does() {
    let _turn = blastema_doubles::turn();
    let mut process = Process::start_without_hangups("signal");
    process.await_line("drive 1");

    let status = std::fs::read_to_string(format!("/proc/{}/status", process.child.id())).unwrap();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    assert_eq!(u64::from_str_radix(caught.trim(), 16).unwrap() & 1, 0, "SIGHUP is not caught");
    process.signal("-HUP");
    process.signal("-TERM");
    let (code, _, errors) = process.end();

    assert!(code == Some(143) && errors.contains("SIGTERM"), "{code:?}: {errors}");
}

/// Has nothing that could be made safe.
async fn drop_without_outputs() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1").child(ChildSpec::new("joint", || Joint)).start().await?;
    println!("started");
    drop(node);
    Ok(())
}

#[test]
fn a_node_without_outputs_that_is_dropped_says_so_in_one_line_and_no_more() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let mut process = Process::start("plain", &[]);
    process.await_line("started");
    let (code, _, errors) = process.end();

    let lines: Vec<_> = errors.lines().collect();
    assert!(code == Some(0) && lines.len() == 1, "{errors}");
    assert!(lines[0].contains("module1") && lines[0].contains("dropped while it ran"), "{errors}");
}

/// Needs a thread for a component.
async fn ask_a_joint() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1").child(ChildSpec::new("joint", || Joint)).start().await?;
    node.sender::<Leak>("joint")?.ask(Leak).await?;
    println!("asked");
    node.shutdown().await;
    Ok(())
}

/// Has a network on which strangers may connect.
async fn listen_for_strangers() -> Result<(), Box<dyn std::error::Error>> {
    let network = Network::new("cable", "tcp://127.0.0.1:0").peer("module2", "127.0.0.1:9");
    let node = Node::builder("module1").network(network).start().await?;
    println!("started");
    node.shutdown().await;
    Ok(())
}

/// Else they could keep a peer out that comes back.
#[test]
fn a_program_whose_strangers_could_use_up_its_files_is_refused() {
    let _turn = blastema_doubles::turn();
    for (files, starts) in [(32, false), (64, false), (256, true)] {
        let (code, lines, errors) = Process::start_with_files("listens", files).end();
        assert_eq!((lines.iter().any(|line| line == "started"), code == Some(0)), (starts, starts));
        assert!(
            starts || errors.contains("LimitNOFILE=") && errors.contains("strangers"),
            "{errors}"
        );
    }
}

#[test]
fn a_program_that_may_open_too_few_files_says_so_and_does_not_hang() {
    let _turn = blastema_doubles::turn();
    let (mut refused, mut without_thread, mut worked) = (0, 0, 0);
    // What a node needs grows: whatever it is, one of these is a little less than enough.
    for files in (8..64).step_by(3) {
        let (code, lines, errors) = Process::start_with_files("asks", files).end();
        if lines.iter().any(|line| line == "asked") {
            worked += 1;
            continue;
        }
        assert!(code == Some(101) && errors.contains("Too many open files"), "{files}: {errors}");
        without_thread += usize::from(errors.contains("joint: it was given no thread"));
        refused += usize::from(errors.contains("ulimit -n"));
    }
    assert!(refused > without_thread && without_thread > 0, "{refused}, {without_thread}");
    assert!(worked > 0);
}

#[test]
fn a_program_that_shuts_its_node_down_has_nothing_more_to_make_safe() {
    let _turn = blastema_doubles::turn();
    let mut process = Process::start("shutdown", &[]);
    process.await_line("drive 1");
    let (code, lines, errors) = process.end();

    assert_eq!(code, Some(0), "{errors}");
    assert!(!lines.iter().any(|line| line == "safe outputs"), "{lines:?}");
    assert_eq!(errors, "", "an orderly end prints no error");
    assert!(lines.contains(&"drive 0".to_owned()), "the wheels are stopped: {lines:?}");
}

/// Its safe outputs panic when they are called.
async fn drop_with_outputs_that_panic() -> Result<(), Box<dyn std::error::Error>> {
    let builder = Node::builder("module1").child(ChildSpec::new("wheels", || Wheels));
    let node = builder.safe_outputs(|_| panic!("the valve sticks")).start().await?;
    println!("started");
    drop(node);
    Ok(())
}

#[test]
fn safe_outputs_that_panic_are_not_told_as_applied() {
    let _turn = blastema_doubles::turn();
    let mut process = Process::start("unsafe", &[]);
    process.await_line("started");
    let (code, _, errors) = process.end();

    assert_eq!(code, Some(0), "{errors}");
    assert!(!errors.contains("safe outputs applied"), "{errors}");
    assert!(errors.contains("panicked, and may be applied in part"), "{errors}");
}

fn watched() -> NodeBuilder {
    Node::builder("module1")
        .fault_kind("OIL")
        .plan(Plan::default().on(oil(), Ladder::first(RecoveryAction::Observe)))
        .child(ChildSpec::new("joint", || Joint))
        .notify_systemd()
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
struct Listener {
    socket: UnixDatagram,
    folder: tempfile::TempDir,
}

impl Listener {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        Listener { socket, folder }
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
    let _turn = blastema_doubles::turn();
    let manager = Listener::new();
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

/// A log that blocks the thread of the fault chain, as one to a full pipe does.
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
        while STUCK.load(SeqCst) && event.metadata().target() == "blastema::fault" {
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
    node.sender::<Leak>("joint")?.ask(Leak).await?;
    println!("stuck");
    node.run_until_signal().await?;
    Ok(())
}

#[test]
fn a_process_whose_fault_chain_stands_is_stroked_no_more_and_its_outputs_are_safe() {
    let _turn = blastema_doubles::turn();
    let manager = Listener::new();
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
    assert_eq!(code, Some(143), "it ends all the same: {errors}");
    assert!(errors.contains("the fault chain has not answered"), "{errors}");
}

/// Hangs, or stops slowly.
struct Stubborn;

impl Component for Stubborn {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Leak>();
    }

    async fn on_deactivated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        println!("deactivating");
        std::future::pending().await
    }
}

impl Handle<Leak> for Stubborn {
    async fn handle(&mut self, _: Leak, _: &mut Context<Self>) {
        println!("hangs");
        loop {
            std::thread::park();
        }
    }
}

/// Waits for signals, and cannot be stopped in order.
async fn stop_with(role: &str) -> Result<(), Box<dyn std::error::Error>> {
    let within = if role == "stops slowly" { 2 * PATIENCE } else { 500 * MS };
    let stubborn = ChildSpec::new("stubborn", || Stubborn)
        .on_own_thread()
        .max_block(2 * PATIENCE)
        .max_wait(2 * PATIENCE)
        .shutdown_within(within);
    let mut builder = Node::builder("module1")
        .child(ChildSpec::new("wheels", || Wheels).shutdown_within(500 * MS))
        .callback_limit(Duration::from_secs(5));
    if role != "hangs without outputs" {
        builder = builder.safe_outputs(|_| {
            // Longer than the process has after the longest `shutdown_within`.
            std::thread::park_timeout(400 * MS);
            println!("safe outputs");
        });
    }
    if role != "hangs in main" {
        builder = builder.child(stubborn);
    }
    let node = builder.start().await?;
    let wheels = node.commander::<Drive>("wheels", "console")?;
    wheels.claim().await?;
    wheels.command(Drive(1.0)).await?;
    if role.starts_with("hangs") && role != "hangs in main" {
        // It never answers.
        let _ = node.sender::<Leak>("stubborn")?.ask(Leak).await;
    }
    let hangs_in_main = role == "hangs in main";
    actix_rt::spawn(async move {
        blastema::sleep(100 * MS).await;
        println!("waits");
        if hangs_in_main {
            loop {
                std::thread::park();
            }
        }
    });
    node.run_until_signal().await?;
    println!("ended in order");
    Ok(())
}

#[test]
fn a_program_that_cannot_stop_in_order_makes_its_outputs_safe_and_says_so_by_its_status() {
    let _turn = blastema_doubles::turn();
    for role in ["hangs", "hangs in main", "hangs without outputs", "stops slowly"] {
        let mut process = Process::start(role, &[]);
        process.await_line("waits");
        process.signal("-TERM");
        if role == "stops slowly" {
            process.await_line("deactivating");
            process.signal("-TERM");
        }
        let (code, lines, errors) = process.end();

        assert_eq!(code, Some(143), "{role}: {errors}");
        let with_outputs = role != "hangs without outputs";
        let safe = |line: &String| line == if with_outputs { "safe outputs" } else { "drive 0" };
        assert!(lines.iter().any(safe), "{role}: {lines:?}: {errors}");
        assert!(!lines.contains(&"ended in order".to_owned()), "{role}: {lines:?}");
        assert_eq!(errors.contains("safe outputs applied"), with_outputs, "{role}: {errors}");
        assert_eq!(errors.contains("its actuators are at rest"), !with_outputs, "{role}: {errors}");
    }
}

/// Lands in 70 rounds of 100 ms, which is longer than the fault chain may be silent otherwise.
struct Drone(Option<u32>);

impl Component for Drone {
    fn ports(ports: &mut Ports<Self>) {
        let land = Drive(-1.0);
        let drone = ActuatorSpec::new(Drive(0.0), Hold).lease(PATIENCE);
        ports.actuator(drone.on_stop(land).settle_within(PATIENCE / 2));
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0 = self.0.map(|height| height.saturating_sub(1));
        if self.0 == Some(0) {
            println!("landed");
            self.0 = None;
            cx.settled();
        }
        Ok(())
    }
}

impl Handle<Drive> for Drone {
    async fn handle(&mut self, drive: Drive, cx: &mut Context<Self>) -> f32 {
        if drive.0 < 0.0 {
            self.0 = Some(70);
            STUCK.store(true, SeqCst);
            cx.declare_fault(oil(), "a leak");
        }
        println!("drive {}", drive.0);
        drive.0
    }
}

async fn land_beside_a_stuck_log() -> Result<(), Box<dyn std::error::Error>> {
    tracing::subscriber::set_global_default(StuckLog::default())?;
    let drone = ChildSpec::new("drone", || Drone(None)).rate_hz(10.0).shutdown_within(PATIENCE);
    let node = Node::builder("module1")
        .fault_kind("OIL")
        .plan(Plan::default().on(oil(), Ladder::first(RecoveryAction::Observe)))
        .child(drone)
        .safe_outputs(|_| println!("safe outputs"))
        .start()
        .await?;
    let pilot = node.commander::<Drive>("drone", "pilot")?;
    pilot.claim().await?;
    pilot.command(Drive(1.0)).await?;
    node.run_until_signal().await?;
    Ok(())
}

#[test]
fn a_log_that_blocks_does_not_cut_the_outputs_of_a_drone_that_lands() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let mut process = Process::start("lands", &[]);
    process.await_line("drive 1");
    process.signal("-TERM");
    let (code, lines, errors) = process.end();

    assert_eq!(lines[..3], ["drive -1", "landed", "safe outputs"], "{errors}");
    assert_eq!(code, Some(143), "the fault chain did not come to its end: {errors}");
}
