//! Microcontrollers as components: real firmware in C, as processes on ptys and on UDP.
//!
//! With `BLASTEMA_CHIP=cortex-m3` the firmware on ptys runs on that chip, in QEMU, and with
//! `atmega328p` in simavr; `tests/devices/run` does both.

use blastema::prelude::*;
use blastema::{
    ActorRef, ComponentOrder, DeliveryError, DeviceDescription, DeviceProxy, DeviceSpec, Lifecycle,
    Network, NodeBuilder, OrderVerb, VariableSpec,
};
use blastema_ptys::Cable;
use blastema_tests::Process;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Clone, Debug, PartialEq, Structure)]
enum Mode {
    Idle,
    Turn(i16),
}

/// A value with a field of each kind.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "devices/value")]
struct Value {
    number: i32,
    #[contract(unit = "m")]
    level: f64,
    mode: Mode,
    note: Option<char>,
    #[contract(at_most = 5)]
    trace: Vec<u8>,
}

fn value(number: i32) -> Value {
    let mode = if number % 2 == 0 { Mode::Idle } else { Mode::Turn(-7) };
    Value { number, level: 0.5, mode, note: Some('ä'), trace: vec![0, 1, 2, 3] }
}

#[derive(Debug, Request)]
#[contract(name = "devices/add", reply = Total)]
struct Add {
    amount: u32,
}

#[derive(Clone, Debug, PartialEq, Structure)]
struct Total {
    total: u32,
    calls: u32,
    /// The variable as the chip has it.
    limit: u16,
    boots: u16,
}

#[derive(Clone, Debug, Variable)]
#[contract(name = "devices/limit")]
struct Limit {
    max: u16,
}

/// What firmware of another edition has in place of [`Add`].
#[derive(Debug, Request)]
#[contract(name = "devices/add", reply = Total)]
struct WideAdd {
    amount: u64,
}

const A: u32 = 0xa;
const B: u32 = 0xb;

fn spec<Sum: Request>(
    endpoint: &str,
    name: &str,
    device_type: u32,
    topics: [&str; 2],
) -> DeviceSpec {
    // An emulated chip has a processor to itself only now and then.
    let interval = if chip().is_some() { 100 } else { 20 };
    DeviceSpec::new(name, endpoint, device_type)
        .interval(Duration::from_millis(interval))
        .listens::<Value>(0, topics[0])
        .publishes::<Value>(0, topics[1])
        .serves::<Sum>(0)
        .variable(0, VariableSpec::new(Limit { max: 5 }))
}

/// The emulated chip that the firmware runs on, if any.
fn chip() -> Option<String> {
    std::env::var("BLASTEMA_CHIP").ok()
}

fn compile(program: &str, arguments: &[&str], include: [&Path; 3], sources: &[PathBuf], to: &Path) {
    let mut command = Command::new(program);
    command.args(["-Os", "-Wall", "-Wextra", "-Werror"]).args(arguments);
    command.args(include.iter().flat_map(|folder| [Path::new("-I"), folder]));
    // Libraries come after what needs them.
    let libraries = arguments.contains(&"-DSIMAVR").then_some(["-lsimavr", "-lelf"]);
    command.args(sources).arg("-o").arg(to).args(libraries.iter().flatten());
    let output = command.output().unwrap_or_else(|error| panic!("{program} is needed: {error}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// A device and its line.
struct Chip {
    folder: TempDir,
    program: PathBuf,
    /// What runs the program, if it is not this computer.
    emulator: Option<PathBuf>,
    /// The end of its line, or its UDP port.
    port: PathBuf,
    process: Option<Child>,
}

impl Chip {
    /// Compiles the firmware with the header of this device and switches it on.
    fn new<Sum: Request>(device_type: u32, port: &Path, flags: &[&str]) -> Chip {
        let folder = TempDir::new().expect("a folder for the firmware");
        let header = spec::<Sum>("serial:///dev/null", "chip", device_type, ["in", "out"]).header();
        let header = header.expect("the spec is right");
        std::fs::write(folder.path().join("chip.h"), header).expect("a header");
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let (library, here) = (root.join("../core/lite/c"), root.join("devices"));
        let boards = library.join("boards");
        let [program, emulator] = ["firmware", "emulator"].map(|name| folder.path().join(name));
        let is_serial = !flags.contains(&"-DBL_DATAGRAM");
        let kind = chip().filter(|_| is_serial);
        let script = format!("-Wl,-T,{}", boards.join("mps2_an385.ld").display());
        let (compiler, board, of_chip, of_emulator) = match kind.as_deref() {
            None => ("cc", "linux.c", vec!["-std=c99"], None),
            Some("cortex-m3") => {
                let chip = vec!["-mcpu=cortex-m3", "-mthumb", "-nostartfiles", &script];
                let chip = [chip, vec!["-Wl,--gc-sections", "-ffunction-sections"]].concat();
                ("arm-none-eabi-gcc", "mps2_an385.c", chip, Some("-DQEMU"))
            }
            Some("atmega328p") => {
                let chip = vec!["-mmcu=atmega328p", "-DF_CPU=16000000UL", "-mcall-prologues"];
                ("avr-gcc", "atmega328p.c", chip, Some("-DSIMAVR"))
            }
            Some(other) => panic!("BLASTEMA_CHIP={other}: it is cortex-m3 or atmega328p"),
        };
        let sources =
            [boards.join(board), here.join("firmware.c"), library.join("blastema_lite.c")];
        let own = ["-Wconversion", "-DBL_CONFIG=\"chip.h\""];
        let include = [folder.path(), &boards, &library];
        compile(compiler, &[&of_chip[..], &own, flags].concat(), include, &sources, &program);
        if let (Some(kind), Ok(folder)) = (&kind, std::env::var("BLASTEMA_FIRMWARE")) {
            std::fs::copy(&program, Path::new(&folder).join(kind)).expect("a folder");
        }
        let emulator = of_emulator.map(|which| {
            compile("cc", &[which], include, &[here.join("emulator.c")], &emulator);
            emulator
        });
        let mut chip = Chip { folder, program, emulator, port: port.to_owned(), process: None };
        chip.switch_on();
        chip
    }

    fn switch_on(&mut self) {
        let boots = self.folder.path().join("boots");
        let mut command = Command::new(self.emulator.as_ref().unwrap_or(&self.program));
        command.arg(&self.port).arg(boots);
        command.args(self.emulator.is_some().then_some(&self.program));
        self.process = Some(command.spawn().expect("the firmware starts"));
    }

    fn cut_power(&mut self) {
        if let Some(mut process) = self.process.take() {
            process.kill().expect("it runs");
            process.wait().expect("it has ended");
        }
    }

    fn signal(&self, signal: &str) {
        let id = self.process.as_ref().expect("it is on").id().to_string();
        let status = Command::new("kill").args([signal, &id]).status().expect("kill runs");
        assert!(status.success());
    }
}

impl Drop for Chip {
    fn drop(&mut self) {
        self.cut_power();
    }
}

fn at(path: &Path) -> String {
    format!("serial://{}?baud=115200", path.display())
}

/// Collects what comes back.
struct Console(Arc<Mutex<Vec<Value>>>);

impl Component for Console {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Value>().on("back");
    }
}

impl Handle<Value> for Console {
    async fn handle(&mut self, value: Value, _: &mut Context<Self>) {
        self.0.lock().expect("no one panics with it").push(value);
    }
}

/// Waits until it holds.
async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let waits = async {
        while !holds().await {
            blastema::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(PATIENCE, waits).await.unwrap_or_else(|_| panic!("{what}: never"));
}

async fn add(node: &Node, name: &str, amount: u32) -> Result<Total, DeliveryError> {
    let sender: Sender<Add> = node.sender(name)?;
    sender.ask_within(Add { amount }, PATIENCE).await.map_err(|error| error.kind)
}

fn proxy(node: &Node, name: &str) -> ActorRef<DeviceProxy> {
    node.actor(name).expect("a device")
}

async fn faults(node: &Node) -> String {
    format!("{:?}", node.faults().await)
}

async fn is_active(node: &Node, name: &str) -> bool {
    proxy(node, name).state() == Lifecycle::Active
}

fn robot() -> NodeBuilder {
    Node::builder("robot").intensity(1000, Duration::from_secs(60))
}

/// The device `a` at this end of its line.
fn one(cable: &Cable) -> ChildSpec<DeviceProxy> {
    spec::<Add>(&at(&cable.left()), "a", A, ["in", "out"]).child()
}

/// Starts the node and waits until its device `a` works.
async fn working(node: NodeBuilder) -> Node {
    let node = node.start().await.expect("the node starts");
    until("it works", async || is_active(&node, "a").await).await;
    node
}

/// The experiment of RTComponent-Lite (Suzuki et al. 2007, figures 5 and 6), and what follows.
#[test]
fn values_go_from_a_console_through_two_devices_and_back_and_each_is_recovered_by_itself() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cables = [Cable::new(), Cable::new()];
        let mut a = Chip::new::<Add>(A, &cables[0].right(), &[]);
        let _b = Chip::new::<Add>(B, &cables[1].right(), &[]);
        let received = Arc::new(Mutex::new(Vec::new()));
        let (got, there) = (received.clone(), format!("memory://devices/{}", std::process::id()));
        let node = robot()
            .network(Network::new("memory", &there).insecure())
            .child(spec::<Add>(&at(&cables[0].left()), "a", A, ["forth", "between"]).child())
            .child(spec::<Add>(&at(&cables[1].left()), "b", B, ["between", "back"]).child())
            .child(ChildSpec::new("console", move || Console(got.clone())))
            .start()
            .await
            .expect("the node starts");
        for name in ["a", "b"] {
            until("both work", async || is_active(&node, name).await).await;
        }
        let forth = node.publisher::<Value>("forth").expect("the topic");
        let mut sent = 0;
        let mut round_trip = async || {
            sent += 1;
            let expected = Value { trace: vec![2, 1, 2, 3], ..value(sent) };
            // A device samples its in port: the next value waits for this one.
            forth.publish(value(sent)).expect("it is published");
            until("the value comes back", async || {
                received.lock().expect("no one panics with it").last() == Some(&expected)
            })
            .await;
        };
        for _ in 0..20 {
            round_trip().await;
        }
        let limit = node.variable::<Limit>("a").expect("it has the variable");
        limit.write(Limit { max: 77 }).await.expect("it is written");
        until("the device has it", async || {
            add(&node, "a", 1).await.is_ok_and(|it| it.limit == 77)
        })
        .await;
        let before = [proxy(&node, "a").incarnation(), proxy(&node, "b").incarnation()];

        a.cut_power();
        until("the loss is found", async || !is_active(&node, "a").await).await;

        let beside = add(&node, "b", 1).await.expect("b works beside it");
        assert_eq!((beside.calls, beside.boots), (1, 1));
        until("it is told", async || faults(&node).await.contains("the device is lost")).await;
        a.switch_on();
        until("a is back", async || is_active(&node, "a").await).await;
        let total = add(&node, "a", 3).await.expect("a works");
        assert_eq!(total, Total { total: 3, calls: 1, limit: 77, boots: 2 }, "restored");
        round_trip().await;
        assert!(proxy(&node, "a").incarnation() > before[0]);
        assert_eq!(proxy(&node, "b").incarnation(), before[1]);

        // A hang, after which the chip goes on as if nothing had been.
        a.signal("-STOP");
        until("the silence is found", async || !is_active(&node, "a").await).await;
        a.signal("-CONT");
        until("a is back", async || is_active(&node, "a").await).await;
        assert_eq!(add(&node, "a", 3).await.map(|it| (it.total, it.boots)), Ok((6, 2)));

        // The cable, and the port with it.
        let name = || std::fs::read_link(cables[0].left()).expect("a link to the port");
        let before_it = name();
        cables[0].unplug();
        until("the end of the port is found", async || !is_active(&node, "a").await).await;
        // Another adapter has the name that was free: this one comes back under the next.
        let _other = Cable::new();
        cables[0].plug();
        assert_ne!(name(), before_it);
        until("a is back", async || is_active(&node, "a").await).await;
        assert_eq!(add(&node, "a", 3).await.map(|it| (it.total, it.boots)), Ok((9, 2)));
        assert_eq!(proxy(&node, "b").incarnation(), before[1]);
        node.shutdown().await;

        // Another process of the node finds the devices as they are.
        let node = working(
            robot()
                .child(spec::<Add>(&at(&cables[0].left()), "a", A, ["forth", "between"]).child()),
        )
        .await;
        let total = add(&node, "a", 1).await.expect("a works");
        assert_eq!((total.total, total.boots), (10, 2), "nothing twice, no reset");
        assert_eq!(total.limit, 5, "the new node's own");
        node.shutdown().await;
    });
}

#[test]
fn each_of_two_thousand_commands_is_carried_out_once_also_with_bit_errors_and_garbage() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::noisy(10_000);
        let _chip = Chip::new::<Add>(A, &cable.right(), &[]);
        let network = |own: &str, peer: &str, name: &str| {
            let id = std::process::id();
            let (own, peer) = (format!("memory://{own}-{id}"), format!("{peer}-{id}"));
            Network::new("memory", &own).peer(name, &peer)
        };
        let node = robot()
            .network(network("near", "far", "desk"))
            // What is damaged is repeated soon.
            .child(
                spec::<Add>(&at(&cable.left()), "a", A, ["in", "out"])
                    .turnaround(Duration::from_millis(5))
                    .tries(20)
                    .child(),
            )
            .start()
            .await
            .expect("the node starts");
        let desk = Node::builder("desk").network(network("far", "near", "robot")).start().await;
        let desk = desk.expect("the other node starts");
        assert!(desk.connected("robot", PATIENCE).await);
        until("it works", async || is_active(&node, "a").await).await;

        for count in 1..=2000 {
            if count % 100 == 0 {
                // A frame that is cut, and noise in both directions.
                cable.inject(&cable.left(), &[5, 0x7f, 0xff, 1, 0, 9, 9]);
                cable.inject(&cable.right(), &[0x40, 0x59, 1, 0x10, 0x8a]);
            }
            let total = match count % 10 {
                0 => add(&desk, "robot:a", 2).await,
                _ => add(&node, "a", 2).await,
            };
            let expected = Total { total: 2 * count, calls: count, limit: 5, boots: 1 };
            assert_eq!(total, Ok(expected));
        }
        desk.shutdown().await;
        node.shutdown().await;
    });
}

#[test]
fn a_command_across_a_reset_has_an_unknown_outcome_and_an_error_of_the_device_is_told_and_reset() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let _chip = Chip::new::<Add>(A, &cable.right(), &[]);
        let node = working(robot().child(one(&cable))).await;
        let first = proxy(&node, "a").incarnation();

        let refused = add(&node, "a", 666).await;
        assert!(matches!(refused, Err(DeliveryError::CheckFailed { .. })), "{refused:?}");
        let across = add(&node, "a", 667).await;

        assert!(matches!(across, Err(DeliveryError::OutcomeUnknown { .. })), "{across:?}");
        until("it is a new incarnation", async || proxy(&node, "a").incarnation() > first).await;
        let total = add(&node, "a", 1).await.expect("it works again");
        assert_eq!((total.calls, total.boots), (1, 2), "the command was not repeated");

        let second = proxy(&node, "a").incarnation();
        let values = node.publisher::<Value>("in").expect("the topic");
        values.publish(value(666)).expect("it is published");
        let text = "object 1 of the device is in error, code 7: over travel";
        until("its own error is told", async || faults(&node).await.contains(text)).await;
        until("it works again", async || is_active(&node, "a").await).await;
        assert_eq!(proxy(&node, "a").incarnation(), second, "a reset is enough");
        assert_eq!(add(&node, "a", 1).await.map(|it| it.boots), Ok(2));
        node.shutdown().await;
    });
}

#[test]
fn a_person_orders_a_device_through_its_proxy_as_any_component() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let _chip = Chip::new::<Add>(A, &cable.right(), &[]);
        let waits =
            Plan::default().on(FaultKind::ErrorState, Ladder::first(RecoveryAction::Observe));
        let received = Arc::new(Mutex::new(Vec::new()));
        let got = received.clone();
        let node = working(
            robot()
                .plan(waits)
                .child(spec::<Add>(&at(&cable.left()), "a", A, ["in", "back"]).child())
                .child(ChildSpec::new("console", move || Console(got.clone()))),
        )
        .await;
        let order = async |verb| {
            let reply = node.order(&ComponentOrder { verb, name: Some("a".to_owned()) }).await;
            let row = reply.rows.first().expect("it is there");
            (reply.refused, row.state.clone(), row.incarnation)
        };
        let first = proxy(&node, "a").incarnation().0;
        let values = node.publisher::<Value>("in").expect("the topic");
        let last = || received.lock().expect("no one panics with it").last().map(|it| it.number);

        let done = order(OrderVerb::Deactivate).await;
        assert_eq!(done, (None, "initialized".to_owned(), first));
        values.publish(value(1)).expect("it is published");
        assert_eq!(last(), None);
        assert_eq!(order(OrderVerb::Activate).await, (None, "active".to_owned(), first));
        until("what has waited comes back", async || last() == Some(1)).await;

        values.publish(value(666)).expect("it is published");
        until("its own error is told", async || proxy(&node, "a").state() == Lifecycle::Error)
            .await;
        let (refused, ..) = order(OrderVerb::Activate).await;
        assert_eq!(refused.as_deref(), Some("it is in error: reset it"));
        assert_eq!(order(OrderVerb::Reset).await, (None, "active".to_owned(), first));
        assert_eq!(order(OrderVerb::Restart).await, (None, "active".to_owned(), first + 1));
        assert_eq!(add(&node, "a", 1).await.map(|it| it.boots), Ok(1), "the chip was not reset");
        node.shutdown().await;
    });
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = blastema_tests::role() else { return };
    assert_eq!(role, "counting node");
    let [port, counted] = ["PORT", "COUNTED"].map(|key| std::env::var(key).expect("it is given"));
    blastema::run(async {
        let device = spec::<Add>(&at(Path::new(&port)), "a", A, ["in", "out"]);
        let node = robot().child(device.child()).start().await.expect("the node starts");
        let mut calls = 0;
        loop {
            if add(&node, "a", 1).await.is_ok() {
                calls += 1;
                // Whole, or not at all: the process may be killed meanwhile.
                let next = format!("{counted}.next");
                std::fs::write(&next, calls.to_string()).expect("a file");
                std::fs::rename(&next, &counted).expect("it is there");
            }
        }
    });
}

#[test]
fn a_node_that_is_killed_finds_its_device_as_it_is_and_no_command_is_carried_out_twice() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let chip = Chip::new::<Add>(A, &cable.right(), &[]);
        let counted = chip.folder.path().join("counted");
        let port = cable.left().display().to_string();
        let more = [("PORT", &port), ("COUNTED", &counted.display().to_string())];
        let (mut replied, kills) = (0, 3);
        for _ in 0..kills {
            let mut process = Process::start_with(module_path!(), "counting node", &[""; 0], &more);
            let count = || -> u32 {
                let text = std::fs::read_to_string(&counted).unwrap_or_default();
                text.parse().unwrap_or(0)
            };
            until("it has asked the device", async || count() >= 20).await;
            process.kill();
            replied += count();
            std::fs::remove_file(&counted).expect("it was counted");
        }

        let node = working(robot().child(one(&cable))).await;
        let total = add(&node, "a", 1).await.expect("the device works");

        assert_eq!((total.total, total.boots), (total.calls, 1), "no reset");
        // A reply, or the note of it, may be lost with each process.
        let others = total.calls - 1;
        assert!((replied..=replied + kills).contains(&others), "{replied} replies, {others} calls");
        node.shutdown().await;
    });
}

#[test]
fn a_port_that_takes_no_bytes_is_told_and_is_used_again_when_it_does() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let _chip = Chip::new::<Add>(A, &cable.right(), &[]);
        let node = working(robot().child(one(&cable))).await;

        cable.hold_left(true);
        let text = "the port takes no bytes";
        until(text, async || faults(&node).await.contains(text)).await;
        assert!(!is_active(&node, "a").await);
        cable.hold_left(false);

        until("it works again", async || is_active(&node, "a").await).await;
        assert_eq!(add(&node, "a", 1).await.map(|it| (it.calls, it.boots)), Ok((1, 1)));
        node.shutdown().await;
    });
}

#[test]
fn devices_that_were_swapped_and_firmware_of_another_contract_are_refused_by_name() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cables = [Cable::new(), Cable::new()];
        let folder = TempDir::new().expect("a folder for ports");
        let ports = ["a", "b"].map(|name| folder.path().join(name));
        let plug = |order: [usize; 2]| {
            for (port, cable) in ports.iter().zip(order) {
                let _ = std::fs::remove_file(port);
                symlink(cables[cable].left(), port).expect("a port of that name");
            }
            // The system gives the adapters these names when they are plugged in.
            cables.iter().for_each(Cable::unplug);
            cables.iter().for_each(Cable::plug);
        };
        let _a = Chip::new::<Add>(A, &cables[0].right(), &[]);
        let b = Chip::new::<Add>(B, &cables[1].right(), &[]);
        plug([1, 0]);
        let node = robot()
            .child(spec::<Add>(&at(&ports[0]), "a", A, ["in", "out"]).child())
            .child(spec::<Add>(&at(&ports[1]), "b", B, ["in", "out"]).child())
            .start()
            .await
            .expect("the node starts");

        let swapped = ["type 0x0000000b answers, and 0x0000000a", "type 0x0000000a answers"];
        for text in swapped {
            until(text, async || faults(&node).await.contains(text)).await;
        }
        assert!(!is_active(&node, "a").await && !is_active(&node, "b").await);
        plug([0, 1]);
        for name in ["a", "b"] {
            until("both work in their places", async || is_active(&node, name).await).await;
        }

        drop(b);
        let _wide = Chip::new::<WideAdd>(B, &cables[1].right(), &[]);
        let texts =
            ["`devices/add` has 4 bytes and fingerprint", "the field `amount` is u64 there"];
        for text in texts {
            until(text, async || faults(&node).await.contains(text)).await;
        }
        assert!(!is_active(&node, "b").await);
        assert!(add(&node, "a", 1).await.is_ok());
        node.shutdown().await;
    });
}

#[test]
fn a_device_that_is_absent_does_not_delay_the_others_of_its_line() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let _chip = Chip::new::<Add>(A, &cable.right(), &["-DBL_ADDRESS=7"]);
        let device = |name: &str, address| {
            spec::<Add>(&at(&cable.left()), name, A, ["in", name])
                .address(address)
                .interval(Duration::from_millis(100))
                .turnaround(Duration::from_millis(5))
                .child()
        };
        let node = robot().child(device("a", 7)).child(device("b", 8)).start().await;
        let node = node.expect("the node starts");
        until("a works", async || is_active(&node, "a").await).await;

        for count in 1..=100 {
            assert_eq!(add(&node, "a", 1).await.map(|it| it.calls), Ok(count));
        }

        assert!(!is_active(&node, "b").await);
        node.shutdown().await;
    });
}

#[test]
fn a_device_on_udp_is_a_component_as_on_a_serial_line() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").expect("a free port");
        let address = socket.local_addr().expect("it is bound");
        drop(socket);
        let port = PathBuf::from(address.port().to_string());
        let mut chip = Chip::new::<Add>(A, &port, &["-DBL_DATAGRAM"]);
        let endpoint = format!("udp://{address}");
        let node = robot()
            .child(spec::<Add>(&endpoint, "a", A, ["in", "out"]).child())
            .start()
            .await
            .expect("the node starts");
        for boots in 1..=2 {
            until("it works", async || is_active(&node, "a").await).await;
            for calls in 1..=100 {
                let total = add(&node, "a", 1).await.map(|it| (it.calls, it.boots));
                assert_eq!(total, Ok((calls, boots)));
            }
            chip.cut_power();
            until("the loss is found", async || !is_active(&node, "a").await).await;
            chip.switch_on();
        }
        node.shutdown().await;
    });
}

#[test]
fn the_example_that_is_generated_for_a_firmware_compiles_and_takes_part() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let device = spec::<Add>("serial:///dev/null", "chip", A, ["in", "out"]).describe();
        let device = device.expect("the spec is right");
        let read = DeviceDescription::from_json(&device.to_json());
        assert_eq!(read.as_ref(), Ok(&device));
        assert!(DeviceDescription::from_json("{\"name\":\"a\"}").is_err());
        let (cable, folder) = (Cable::new(), TempDir::new().expect("a folder"));
        let [source, program] = ["main.c", "main"].map(|name| folder.path().join(name));
        std::fs::write(folder.path().join("chip.h"), device.header()).expect("a header");
        std::fs::write(&source, device.firmware()).expect("a source");
        let library = Path::new(env!("CARGO_MANIFEST_DIR")).join("../core/lite/c");
        let boards = library.join("boards");
        let strict = ["-std=c99", "-pedantic", "-DBL_CONFIG=\"chip.h\""];
        let sources = [source, boards.join("linux.c"), library.join("blastema_lite.c")];
        compile("cc", &strict, [folder.path(), &boards, &library], &sources, &program);
        let (port, emulator) = (cable.right(), None);
        let mut chip = Chip { folder, program, emulator, port, process: None };
        chip.switch_on();
        let node = working(robot().child(one(&cable))).await;
        let refused = add(&node, "a", 1).await;
        assert!(matches!(refused, Err(DeliveryError::CheckFailed { .. })), "{refused:?}");
        node.shutdown().await;
    });
}

#[test]
fn a_device_that_is_declared_wrongly_keeps_the_node_from_starting() {
    let _turn = blastema_doubles::turn();
    let refused = |spec: DeviceSpec, text: &str| {
        blastema::run(async {
            let error = Node::builder("robot").child(spec.child()).start().await;
            let error = error.expect_err("it is wrong").to_string();
            assert!(error.contains(text), "{error}");
        });
    };
    let device = |endpoint: &str| DeviceSpec::new("a", endpoint, A);
    refused(device("can://can0"), "devices are reached over `serial` or `udp`");
    refused(device("serial:///dev/x?buad=9600"), "did you mean `baud`?");
    refused(device("udp://10.0.0.7:9000"), "write `?insecure`");
    refused(device("serial:///dev/x").accepts::<Value>(32), "ports count from 0 to 31");
    refused(
        device("serial:///dev/x").accepts::<Value>(0).listens::<Value>(1, "t"),
        "is declared twice",
    );
    refused(device("serial:///dev/x").address(248), "1 to 247");
    // One that is not started takes no address.
    let _other = device("serial:///dev/x").child();
    let pair = |own: [Option<u8>; 2], text: &str| {
        blastema::run(async {
            let of = |name: &str, address: Option<u8>| {
                let device = DeviceSpec::new(name, "serial:///dev/x", A);
                address.into_iter().fold(device, DeviceSpec::address).child()
            };
            let node = || Node::builder("robot").child(of("a", own[0])).child(of("b", own[1]));
            assert!(node().check()[0].to_string().contains(text));
            let error = node().start().await;
            let error = error.expect_err("it is wrong").to_string();
            assert!(error.contains(text), "{error}");
        });
    };
    pair([Some(7), Some(7)], "another device of its line has the address 7");
    pair([None, Some(7)], "several devices of a line have an address each");
}
