//! Topics as plain keys of Zenoh, over a router that is a process of its own, read and written by a
//! client that knows nothing of Blastema.

use blastema::prelude::*;
use blastema::{DeadReason, Injection, ObjectName};
use blastema_tests::{Process, free_addresses, role};
use blastema_zenoh::ZenohBridge;
use serde_json::{Value, json};
use std::sync::mpsc::{Receiver, Sender as Channel, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use zenoh::{Session, Wait};

const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "bridge/pose", version = 2)]
struct Pose {
    #[contract(unit = "m", frame = "map")]
    x: f64,
    raw: Vec<u8>,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "bridge/mode", latched)]
enum Mode {
    Manual,
    Automatic { speed: f32 },
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "bridge/goal", max_size = 1024)]
struct Goal {
    x: f64,
    hold: Option<u32>,
}

/// Asks for an answer from the thread of all components.
#[derive(Clone, Debug, Request)]
#[contract(name = "bridge/ping", reply = ())]
struct Ping;

#[derive(Clone, Default)]
struct Planner(Arc<Mutex<Vec<Goal>>>);

impl Component for Planner {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Goal>().on("goal");
        ports.serve::<Ping>();
    }
}

impl Handle<Goal> for Planner {
    async fn handle(&mut self, goal: Goal, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(goal);
    }
}

impl Handle<Ping> for Planner {
    async fn handle(&mut self, _: Ping, _: &mut Context<Self>) {}
}

#[test]
fn a_process_plays_its_role() {
    if role().is_some() {
        crate::router::run();
    }
}

/// A client of the router that is no part of a robot. Zenoh is called on threads of its own.
struct Plain(Option<Session>);

impl Drop for Plain {
    fn drop(&mut self) {
        apart(|| drop(self.0.take()));
    }
}

impl Plain {
    fn at(router: &str) -> Plain {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", "\"client\""),
            ("scouting/multicast/enabled", "false"),
            ("connect/endpoints", &format!("[\"tcp/{router}\"]")),
            ("connect/timeout_ms", "60000"),
            ("connect/retry", r#"{"period_init_ms":50,"period_max_ms":200}"#),
        ] {
            config.insert_json5(key, value).unwrap();
        }
        Plain(Some(apart(|| zenoh::open(config).wait().unwrap())))
    }

    fn session(&self) -> &Session {
        self.0.as_ref().expect("it is open")
    }

    fn put(&self, key: &str, text: &str) {
        apart(|| self.session().put(key, text).wait().unwrap());
    }

    fn put_json(&self, key: &str, value: Value) {
        self.put(key, &value.to_string());
    }

    /// The answers to those who ask for a key: key, encoding, text.
    fn get(&self, key: &str) -> Vec<(String, String, String)> {
        let answers = apart(|| {
            let answers = self.session().get(key).timeout(Duration::from_secs(5)).wait().unwrap();
            std::iter::from_fn(|| answers.recv().ok()).collect::<Vec<_>>()
        });
        let samples = answers.into_iter().map(|answer| answer.into_result().expect("a sample"));
        let mut found: Vec<_> = samples.map(|sample| taken(&sample)).collect();
        found.sort();
        found
    }

    fn subscribe(&self, key: &str) -> Receiver<(String, String, String)> {
        let (samples, received): (Channel<_>, _) = channel();
        apart(|| {
            let take = move |sample: zenoh::sample::Sample| drop(samples.send(taken(&sample)));
            self.session().declare_subscriber(key).callback(take).background().wait().unwrap();
        });
        received
    }
}

fn taken(sample: &zenoh::sample::Sample) -> (String, String, String) {
    let text = String::from_utf8(sample.payload().to_bytes().to_vec()).unwrap();
    (sample.key_expr().to_string(), sample.encoding().to_string(), text)
}

fn apart<T: Send>(run: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| scope.spawn(run).join().unwrap())
}

fn address() -> String {
    free_addresses(1)[0].to_string()
}

fn router(at: &str) -> Process {
    Process::start_with(module_path!(), "router", &[at.to_owned()], &[])
}

fn bridge(at: &str) -> ZenohBridge {
    ZenohBridge::new("fleet/ranger")
        .connect(&format!("tcp/{at}"))
        .publish::<Pose>("pose", "pose")
        .publish::<Mode>("mode", "mode")
        .subscribe::<Goal>("goal", "goal")
}

async fn node(at: &str, planner: &Planner) -> Node {
    let planner = planner.clone();
    let builder =
        Node::builder("base").work_threads(1).supervisor(bridge(at).try_into().expect("it can be"));
    let builder = builder.child(ChildSpec::new("planner", move || planner.clone()));
    builder.start().await.expect("it starts")
}

async fn until(mut holds: impl AsyncFnMut() -> bool, what: &str) {
    let held = async {
        while !holds().await {
            sleep(Duration::from_millis(20)).await;
        }
    };
    assert!(tokio::time::timeout(PATIENCE, held).await.is_ok(), "{what}");
}

async fn stands(node: &Node, kind: FaultKind, says: &str) -> bool {
    let entries = node.faults().await.entries;
    entries.iter().any(|entry| {
        entry.fault.kind == kind && entry.fault.detail.contains(says) && entry.repaired_at.is_none()
    })
}

/// Goals are written until one arrives; then those of before have come, too, or never will.
async fn goals_arrive(plain: &Plain, planner: &Planner, x: f64) {
    let arrives = async || {
        plain.put_json("fleet/ranger/goal", json!({ "x": x, "hold": null }));
        planner.0.lock().unwrap().iter().any(|goal| goal.x == x)
    };
    until(arrives, "a goal arrives").await;
}

/// Poses are published until one is seen outside.
async fn poses_are_seen(node: &Node, seen: &Receiver<(String, String, String)>, x: f64) {
    let publisher = node.publisher::<Pose>("pose").expect("a name");
    let text = format!(r#"{{"x":{x:?},"raw":[]}}"#);
    let is_seen = async || {
        publisher.publish(Pose { x, raw: Vec::new() }).expect("the node runs");
        seen.try_iter().any(|(.., found)| found == text)
    };
    until(is_seen, "a pose is seen").await;
}

fn dead(node: &Node, object: &str, reason: DeadReason) -> u64 {
    node.dead_letters().count(&ObjectName::new(object).unwrap(), reason)
}

#[test]
fn topics_are_plain_keys_that_any_client_reads_and_writes() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = address();
        let _router = router(&at);
        let (plain, planner) = (Plain::at(&at), Planner::default());
        let poses = plain.subscribe("fleet/ranger/pose");
        let all = plain.subscribe("fleet/**");
        let node = node(&at, &planner).await;

        // From inside to outside, as JSON with the contract in the encoding.
        poses_are_seen(&node, &poses, 0.0).await;
        let publisher = node.publisher::<Pose>("pose").unwrap();
        publisher.publish(Pose { x: -2.5, raw: vec![0, 255] }).unwrap();
        let mut last = None;
        let is_last = async || {
            last = poses.try_iter().last().or(last.take());
            last.as_ref().is_some_and(|(.., text)| text == r#"{"x":-2.5,"raw":[0,255]}"#)
        };
        until(is_last, "the pose is seen").await;
        let (key, encoding, _) = last.unwrap();
        assert_eq!(key, "fleet/ranger/pose");
        assert_eq!(encoding, "application/json;bridge/pose@2");
        assert!(all.try_iter().all(|(key, ..)| key == "fleet/ranger/pose"));

        // A latched topic answers those who come later.
        assert_eq!(plain.get("fleet/ranger/mode"), []);
        let modes = node.publisher::<Mode>("mode").unwrap();
        modes.publish(Mode::Manual).unwrap();
        modes.publish(Mode::Automatic { speed: 1.5 }).unwrap();
        let text = r#"{"Automatic":{"speed":1.5}}"#;
        let answers =
            async || plain.get("fleet/ranger/mode").iter().any(|(.., found)| found == text);
        until(answers, "the mode is answered").await;

        // From outside to inside, as typed events, in order.
        goals_arrive(&plain, &planner, 0.5).await;
        planner.0.lock().unwrap().clear();
        plain.put_json("fleet/ranger/goal", json!({ "x": 1, "hold": 7 }));
        plain.put_json("fleet/ranger/goal", json!({ "hold": null, "x": 2.5 }));
        // Of the first goal, some may be on their way.
        let new = || {
            let mut goals = planner.0.lock().unwrap().clone();
            goals.retain(|goal| goal.x != 0.5);
            goals
        };
        until(async || new().len() >= 2, "the goals arrive").await;
        let goals = new();
        planner.0.lock().unwrap().clear();
        assert_eq!(goals, [Goal { x: 1.0, hold: Some(7) }, Goal { x: 2.5, hold: None }]);

        // The schemas of all keys, by one question.
        let schemas = plain.get("fleet/ranger/**/@schema");
        let keys: Vec<_> = schemas.iter().map(|(key, ..)| key.as_str()).collect();
        let expected = ["goal", "mode", "pose"].map(|key| format!("fleet/ranger/{key}/@schema"));
        assert_eq!(keys, expected);
        let schema: Value = serde_json::from_str(&schemas[2].2).unwrap();
        assert_eq!(schema["x-contract"]["version"], 2);
        assert_eq!(schema["properties"]["x"]["x-unit"], "m");
        assert!(plain.get("fleet/ranger/*").iter().all(|(key, ..)| key == "fleet/ranger/mode"));

        // What does not fit is refused, counted and named.
        plain.put("fleet/ranger/goal", r#"{"x": "far", "hold": null}"#);
        let is_named = async || stands(&node, FaultKind::CheckFailed, "`x`: invalid type").await;
        until(is_named, "the field is named").await;
        plain.put("fleet/ranger/goal", "{\"x\":1,");
        plain.put_json("fleet/ranger/goal", json!({ "x": 1, "hold": null, "speed": 2 }));
        let object = "zenoh-bridge/in/goal";
        until(async || dead(&node, object, DeadReason::Undecodable) == 3, "all are counted").await;
        let is_named = async || stands(&node, FaultKind::CheckFailed, "`speed` is no field").await;
        until(is_named, "the last one is named").await;
        plain.put("fleet/ranger/goal", &" ".repeat(17_000));
        until(async || dead(&node, object, DeadReason::TooLarge) == 1, "it is too large").await;
        goals_arrive(&plain, &planner, 9.0).await;
        assert!(planner.0.lock().unwrap().iter().all(|goal| goal.x == 9.0));
        node.shutdown().await;
    });
}

#[test]
fn a_router_that_dies_is_a_fault_and_the_bridge_works_again_when_it_is_back() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = address();
        let planner = Planner::default();
        // The node starts before the router.
        let node = node(&at, &planner).await;
        let is_told = async || stands(&node, FaultKind::Unavailable, "is the router running").await;
        until(is_told, "a fault says that no router answers").await;
        let modes = node.publisher::<Mode>("mode").unwrap();
        modes.publish(Mode::Manual).unwrap();

        let mut first = router(&at);
        let plain = Plain::at(&at);
        let poses = plain.subscribe("fleet/ranger/pose");
        let is_over = async || !stands(&node, FaultKind::Unavailable, "").await;
        until(is_over, "the router is found").await;
        poses_are_seen(&node, &poses, 1.0).await;
        goals_arrive(&plain, &planner, 1.0).await;
        assert_eq!(plain.get("fleet/ranger/mode")[0].2, "\"Manual\"");

        first.kill();
        let is_told = async || stands(&node, FaultKind::Unavailable, "connection is lost").await;
        until(is_told, "a fault says that the connection is lost").await;
        let publisher = node.publisher::<Pose>("pose").unwrap();
        publisher.publish(Pose { x: 0.0, raw: Vec::new() }).unwrap();
        let object = "zenoh-bridge/out/pose";
        let is_counted = async || dead(&node, object, DeadReason::Unreachable) > 0;
        until(is_counted, "what cannot be written is counted").await;
        modes.publish(Mode::Automatic { speed: 0.5 }).unwrap();

        let _second = router(&at);
        until(is_over, "the router is found again").await;
        poses_are_seen(&node, &poses, 2.0).await;
        goals_arrive(&plain, &planner, 2.0).await;
        let text = r#"{"Automatic":{"speed":0.5}}"#;
        let answers =
            async || plain.get("fleet/ranger/mode").iter().any(|(.., found)| found == text);
        until(answers, "the mode is answered").await;
        node.shutdown().await;
    });
}

#[test]
fn each_part_of_a_bridge_that_panics_is_restarted_by_its_supervisor() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = address();
        let _router = router(&at);
        let (plain, planner) = (Plain::at(&at), Planner::default());
        let poses = plain.subscribe("fleet/ranger/pose");
        let node = node(&at, &planner).await;
        let parts = ["connection", "out/pose", "in/goal"];
        for (x, part) in (0..).map(f64::from).zip(parts) {
            poses_are_seen(&node, &poses, x).await;
            goals_arrive(&plain, &planner, x).await;
            let name = format!("zenoh-bridge/{part}");
            node.inject(&name, Injection::Panic).unwrap();
            let is_found = async || {
                let entries = node.faults().await.entries;
                let of_it = entries.iter().find(|entry| {
                    entry.fault.kind == FaultKind::Panic
                        && entry.fault.location.to_string().contains(part)
                });
                of_it.is_some_and(|entry| entry.recovered_at.is_some())
            };
            until(is_found, "the panic is found, and recovered from").await;
        }
        poses_are_seen(&node, &poses, 10.0).await;
        goals_arrive(&plain, &planner, 10.0).await;
        assert!(!stands(&node, FaultKind::Unavailable, "").await);
        node.shutdown().await;
    });
}

#[test]
fn a_flood_from_outside_is_bounded_and_other_components_are_served_meanwhile() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = address();
        let _router = router(&at);
        let (plain, planner) = (Plain::at(&at), Planner::default());
        let node = node(&at, &planner).await;
        goals_arrive(&plain, &planner, -1.0).await;
        planner.0.lock().unwrap().clear();

        let flood = {
            let session = plain.session().clone();
            std::thread::spawn(move || {
                let began = Instant::now();
                let mut written = 0_u64;
                while began.elapsed() < Duration::from_secs(2) {
                    for text in [r#"{"x":1,"hold":null}"#, "{}"] {
                        session.put("fleet/ranger/goal", text).wait().unwrap();
                        written += 1;
                    }
                }
                (written, began.elapsed())
            })
        };
        let planner_ref = node.sender::<Ping>("planner").unwrap();
        while !flood.is_finished() {
            planner_ref.ask_within(Ping, Duration::from_secs(5)).await.expect("it is served");
            sleep(Duration::from_millis(5)).await;
        }
        let (written, lasted) = flood.join().unwrap();
        let arrived = planner.0.lock().unwrap().len();
        let object = "zenoh-bridge/in/goal";
        let lost = dead(&node, object, DeadReason::Full);
        let refused = dead(&node, object, DeadReason::Undecodable);
        assert!(refused > 0, "{written} written, {arrived} arrived, {lost} displaced");
        // 64 in 10 ms, and one span more.
        let most = 64 * (lasted.as_millis() / 10 + 50);
        assert!((arrived as u128) < most, "{arrived} in {lasted:?}");
        let entries = node.faults().await.entries;
        let known = |entry: &&_| {
            let entry: &blastema::detection::FaultEntry = entry;
            entry.fault.kind == FaultKind::CheckFailed
        };
        let reported: Vec<_> = entries.iter().filter(known).collect();
        assert_eq!(reported.len(), 1, "one fault that stands: {reported:?}");
        assert!(reported[0].fault.count <= 5, "reported once a second: {reported:?}");
        goals_arrive(&plain, &planner, 3.0).await;
        node.shutdown().await;
    });
}

#[test]
fn a_bridge_that_cannot_be_is_refused() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let refused = async |bridge: ZenohBridge, says: &str| {
            let error = SupervisorSpec::try_from(bridge).expect_err("it is refused");
            assert!(error.to_string().contains(says), "{error}");
        };
        let alone = ZenohBridge::new("ranger").publish::<Pose>("pose", "pose");
        refused(alone, "add `.connect(").await;
        let bridge = || ZenohBridge::new("ranger").connect("tcp/127.0.0.1:7447");
        refused(bridge().publish::<Pose>("pose", "*"), "\"*\" is no key of Zenoh").await;
        let twice = bridge().publish::<Pose>("pose", "pose").subscribe::<Goal>("goal", "pose");
        refused(twice, "the key \"pose\" is used twice").await;
        let spaced = bridge().publish::<Pose>("a pose", "pose").try_into().expect("Zenoh has it");
        let error = Node::builder("base").supervisor(spaced).start().await.map(drop);
        assert!(error.expect_err("it is no name").to_string().contains("a pose"));
    });
}
