//! Ports and their connections, on one node and over two, in virtual time.

use blastema::core::port::{ConnectionRole, PortAddress, TypeDescription};
use blastema::prelude::*;
use blastema::{ActuatorSpec, Commander, ConnectError, Hold, MemoryMedium};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Notes, on_ethernet};

/// One sweep of a laser.
#[derive(Clone, Debug, Event)]
#[contract(name = "laser/scan")]
struct Scan {
    #[contract(unit = "m", frame = "laser")]
    nearest: u32,
}

/// Another contract that takes the name of the first.
#[derive(Clone, Debug, Event)]
#[contract(name = "laser/scan")]
struct OldScan {
    #[contract(unit = "mm", frame = "laser")]
    nearest: u32,
    beams: u16,
}

#[derive(Clone, Debug, Event)]
#[contract(latched)]
struct Map(u32);

#[derive(Clone, Debug, Request)]
#[contract(name = "drive", reply = f32)]
struct Drive {
    #[contract(unit = "m/s")]
    speed: f32,
}

#[derive(Clone, Debug, Request)]
#[contract(reply = u32)]
struct Nearest;

/// Has a laser or a pilot use one of its ports.
#[derive(Clone, Debug, Request)]
#[contract(reply = String)]
enum Use {
    Scan(u32),
    Map(u32),
    Drive(f32),
    Nearest,
    /// Ports that it does not have.
    Wrong,
}

/// Publishes what it is told to.
struct Laser;

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Scan>("scan").publishes::<Map>("map").serve::<Use>();
    }
}

impl Handle<Use> for Laser {
    async fn handle(&mut self, wanted: Use, cx: &mut Context<Self>) -> String {
        let published = match wanted {
            Use::Scan(nearest) => {
                let port: Publisher<Scan> = cx.port("scan").expect("it is declared");
                port.publish(Scan { nearest }).map_err(|refused| refused.to_string())
            }
            Use::Map(map) => {
                let port: Publisher<Map> = cx.port("map").expect("it is declared");
                port.publish(Map(map)).map_err(|refused| refused.to_string())
            }
            Use::Wrong => Err([
                cx.port::<Publisher<Scan>>("scna").expect_err("misspelt").to_string(),
                cx.port::<Publisher<Scan>>("laser scan").expect_err("no name").to_string(),
                cx.port::<Sender<Scan>>("scan").expect_err("no sender").to_string(),
                cx.port::<Publisher<Map>>("scan").expect_err("no map").to_string(),
                cx.port::<Publisher<OldScan>>("scan").expect_err("an old contract").to_string(),
            ]
            .join("\n")),
            other => Err(format!("{other:?} is not for a laser")),
        };
        published.err().unwrap_or_default()
    }
}

/// What listeners, actuators and servers received.
type Track = Notes<String>;

/// Listens to scans that are near, and to maps.
struct Planner(Track);

impl Component for Planner {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Map>();
        ports.listen::<Scan>().only_if(|scan| scan.nearest < 100).named("scan");
    }
}

impl Handle<Scan> for Planner {
    async fn handle(&mut self, scan: Scan, cx: &mut Context<Self>) {
        self.0.note(format!("{} {}", cx.name(), scan.nearest));
    }
}

impl Handle<Map> for Planner {
    async fn handle(&mut self, Map(map): Map, cx: &mut Context<Self>) {
        self.0.note(format!("{} map {map}", cx.name()));
    }
}

struct OldPlanner;

impl Component for OldPlanner {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<OldScan>().on("old/scan").named("scan");
    }
}

impl Handle<OldScan> for OldPlanner {
    async fn handle(&mut self, _: OldScan, _: &mut Context<Self>) {}
}

/// Commands and asks what it is connected to.
struct Pilot;

impl Component for Pilot {
    fn ports(ports: &mut Ports<Self>) {
        ports.commands::<Drive>("drive").asks::<Nearest>("nearest").serve::<Use>();
    }
}

impl Handle<Use> for Pilot {
    async fn handle(&mut self, wanted: Use, cx: &mut Context<Self>) -> String {
        match wanted {
            Use::Drive(speed) => {
                let port: Commander<Drive> = cx.port("drive").expect("it is declared");
                if !port.holds()
                    && let Err(error) = port.claim().await
                {
                    return error.to_string();
                }
                match port.command(Drive { speed }).await {
                    Ok(speed) => format!("{speed}"),
                    Err(error) => error.to_string(),
                }
            }
            Use::Nearest => {
                let port: Sender<Nearest> = cx.port("nearest").expect("it is declared");
                match port.ask(Nearest).await {
                    Ok(nearest) => format!("{nearest}"),
                    Err(error) => error.kind.to_string(),
                }
            }
            other => format!("{other:?} is not for a pilot"),
        }
    }
}

/// Drives, and knows what is nearest.
struct Base(Track, u32);

impl Component for Base {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive { speed: 0.0 }, Hold));
        ports.serve::<Nearest>().named("nearest");
    }
}

impl Handle<Drive> for Base {
    async fn handle(&mut self, drive: Drive, cx: &mut Context<Self>) -> f32 {
        self.0.note(format!("{} {}", cx.name(), drive.speed));
        drive.speed
    }
}

impl Handle<Nearest> for Base {
    async fn handle(&mut self, _: Nearest, _: &mut Context<Self>) -> u32 {
        self.1
    }
}

async fn tell(node: &TestNode, component: &str, wanted: Use) -> String {
    let done = node.sender::<Use>(component).unwrap().ask(wanted).await.expect("it answers");
    node.settle().await;
    done
}

/// Ends the present incarnation of a component, and waits for the next one.
async fn kill(node: &mut TestNode, component: &str) {
    node.kill(component);
    node.await_recovered(FaultKind::Panic, component).await;
}

fn planner(name: &str, track: &Track) -> ChildSpec<Planner> {
    let track = track.clone();
    ChildSpec::new(name, move || Planner(track.clone()))
}

fn base(name: &str, track: &Track, nearest: u32) -> ChildSpec<Base> {
    let track = track.clone();
    ChildSpec::new(name, move || Base(track.clone(), nearest))
}

fn connected(node: &TestNode) -> Vec<String> {
    node.connections().iter().map(ToString::to_string).collect()
}

#[blastema_testkit::test]
async fn a_listener_gets_the_events_of_the_ports_that_it_is_connected_to_across_restarts() {
    let track = Track::default();
    let builder = Node::builder("base")
        .child(planner("near", &track))
        .child(planner("far", &track))
        .child(ChildSpec::new("left", || Laser))
        .child(ChildSpec::new("right", || Laser))
        .connect("left#scan", "base:near#scan");
    let mut node = TestNode::start(builder).await;

    assert_eq!(tell(&node, "left", Use::Scan(1)).await, "");
    assert_eq!(tell(&node, "left", Use::Scan(100)).await, "", "the condition holds here too");
    assert_eq!(tell(&node, "right", Use::Scan(2)).await, "", "it reaches no listener");
    assert_eq!(track.take(), ["near 1"]);

    node.connect("left#scan", "far#scan").unwrap();
    node.connect("right#scan", "near#scan").unwrap();
    node.settle().await;
    assert_eq!(
        connected(&node),
        ["left#scan -> far#scan", "left#scan -> near#scan", "right#scan -> near#scan"]
    );
    for killed in ["near", "left", "far"] {
        tell(&node, "left", Use::Scan(3)).await;
        tell(&node, "right", Use::Scan(4)).await;
        assert_eq!(track.take(), ["near 3", "far 3", "near 4"], "before {killed} is killed");
        kill(&mut node, killed).await;
    }

    node.disconnect("left#scan", "near#scan").unwrap();
    assert_eq!(node.disconnect("left#scan", "near#scan"), Err(ConnectError::NotConnected));
    tell(&node, "left", Use::Scan(5)).await;
    tell(&node, "right", Use::Scan(6)).await;
    assert_eq!(track.take(), ["far 5", "near 6"]);

    // A listener that is connected later gets the event that the topic keeps, once.
    tell(&node, "left", Use::Map(7)).await;
    node.connect("left#map", "near#Map").unwrap();
    node.settle().await;
    assert_eq!(track.take(), ["near map 7"]);
    // With the component that makes it, its connections end.
    node.remove_child("near").await.unwrap();
    assert_eq!(connected(&node), ["left#scan -> far#scan"]);
}

#[blastema_testkit::test]
async fn a_sending_port_leads_to_what_it_is_connected_to_and_says_where_it_is_not() {
    let track = Track::default();
    let builder = Node::builder("base")
        .child(base("one", &track, 1))
        .child(base("two", &track, 2))
        .child(ChildSpec::new("pilot", || Pilot));
    let mut node = TestNode::start(builder).await;

    for (wanted, port) in [(Use::Nearest, "pilot#nearest"), (Use::Drive(1.0), "pilot#drive")] {
        let unconnected = DeliveryError::Unconnected { port: port.to_owned() };
        assert_eq!(tell(&node, "pilot", wanted).await, unconnected.to_string());
    }
    node.connect("pilot#nearest", "one#nearest").unwrap();
    node.connect("pilot#drive", "one#drive").unwrap();
    for killed in ["one", "pilot"] {
        assert_eq!(tell(&node, "pilot", Use::Nearest).await, "1");
        assert_eq!(tell(&node, "pilot", Use::Drive(0.5)).await, "0.5");
        kill(&mut node, killed).await;
        // The lease of the incarnation that is gone has ended.
        node.advance(300 * MS).await;
    }
    let driven = track.take();
    assert_eq!(driven.iter().filter(|line| *line == "one 0.5").count(), 2, "{driven:?}");

    let taken = node.connect("pilot#drive", "two#drive").unwrap_err();
    assert_eq!(taken, ConnectError::Taken { to: "one#drive".parse().unwrap() });
    for port in ["drive", "nearest"] {
        node.disconnect(&format!("pilot#{port}"), &format!("one#{port}")).unwrap();
        node.connect(&format!("pilot#{port}"), &format!("two#{port}")).unwrap();
    }
    assert_eq!(tell(&node, "pilot", Use::Nearest).await, "2");
    assert_eq!(tell(&node, "pilot", Use::Drive(0.2)).await, "0.2");
    // One that is removed and comes back is the same to its users.
    node.remove_child("two").await.unwrap();
    assert!(tell(&node, "pilot", Use::Nearest).await.contains("no object is called `two`"));
    node.add_child(base("two", &track, 3)).await.unwrap();
    node.settle().await;
    assert_eq!(tell(&node, "pilot", Use::Nearest).await, "3");
}

#[blastema_testkit::test]
async fn ports_are_connected_over_nodes_by_the_end_that_listens_commands_or_asks() {
    let (track, medium) = (Track::default(), MemoryMedium::default());
    let first = on_ethernet("arm", "base", &medium)
        .child(ChildSpec::new("pilot", || Pilot))
        .child(planner("planner", &track))
        .connect("base:laser#scan", "planner#scan")
        .connect("arm:pilot#drive", "base:wheels#drive")
        .connect("pilot#nearest", "base:wheels#nearest");
    let second = on_ethernet("base", "arm", &medium)
        .child(base("wheels", &track, 4))
        .child(ChildSpec::new("laser", || Laser));
    let arm = TestNode::start(first).await;
    let mut base = TestNode::start(second).await;
    base.advance(2000 * MS).await;

    for killed in ["laser", "wheels"] {
        assert_eq!(tell(&base, "laser", Use::Scan(9)).await, "");
        base.advance(10 * MS).await;
        assert_eq!(tell(&arm, "pilot", Use::Drive(0.5)).await, "0.5");
        assert_eq!(tell(&arm, "pilot", Use::Nearest).await, "4");
        assert_eq!(track.take(), ["planner 9", "wheels 0.5"]);
        kill(&mut base, killed).await;
        base.advance(1000 * MS).await;
        track.take();
    }

    let elsewhere = |refused: Result<(), ConnectError>| {
        let Err(ConnectError::Elsewhere { node, .. }) = refused else { panic!("{refused:?}") };
        node.expect("one node is meant").to_string()
    };
    assert_eq!(elsewhere(base.connect("laser#scan", "arm:planner#scan")), "arm");
    assert_eq!(elsewhere(base.connect("arm:pilot#nearest", "wheels#nearest")), "arm");
    assert_eq!(elsewhere(arm.connect("base:laser#scan", "base:planner#scan")), "base");
    arm.disconnect("base:laser#scan", "planner#scan").unwrap();
    base.advance(10 * MS).await;
    tell(&base, "laser", Use::Scan(8)).await;
    base.advance(10 * MS).await;
    assert_eq!(track.take(), [""; 0]);
}

#[blastema_testkit::test]
async fn what_cannot_be_connected_is_refused_and_the_text_says_what_to_write() {
    let track = Track::default();
    let builder = || {
        Node::builder("base")
            .child(ChildSpec::new("laser", || Laser))
            .child(ChildSpec::new("pilot", || Pilot))
            .child(planner("planner", &track))
            .child(ChildSpec::new("old", || OldPlanner))
            .child(base("wheels", &track, 1))
    };
    let node = TestNode::start(builder().connect("laser#scan", "planner#scan")).await;
    let refused = |from: &str, to: &str| node.connect(from, to).expect_err(to).to_string();
    let check = |from: &str, to: &str, parts: &[&str]| {
        let text = refused(from, to);
        assert!(parts.iter().all(|part| text.contains(part)), "{from} -> {to}: {text}");
    };

    check("laser.scan", "planner#scan", &["write `COMPONENT#PORT`"]);
    check("lasr#scan", "planner#scan", &["no object is called `lasr`", "did you mean `laser`?"]);
    check("laser#scna", "planner#scan", &["did you mean `scan`?", "it gives `scan`, `map`"]);
    check("planner#scan", "planner#scan", &["planner gives no port `scan`", "it declares none"]);
    check("laser#scan", "planner#path", &["takes no port `path`", "`Map`, `scan`"]);
    check("laser#scan", "pilot#Use", &["publishes", "serves", "leads to a port that listens"]);
    check("laser#map", "planner#scan", &["name `Map` here, `laser/scan` there"]);
    let fields = ["field `nearest`: unit `m` here, `mm` there", "field `beams`: only there"];
    check("laser#scan", "old#scan", &fields);
    check("laser#scan", "planner#scan", &["is connected to planner#scan"]);
    assert_eq!(node.connections().len(), 1);

    let wrong = builder().connect("laser#scan", "old#scan");
    let wrong = TestNode::try_start(wrong).await.err().expect("they do not fit").to_string();
    assert!(wrong.starts_with("laser#scan cannot be connected to old#scan: "), "{wrong}");
    let said = tell(&node, "laser", Use::Wrong).await;
    let lines: Vec<&str> = said.lines().collect();
    assert!(
        lines[0]
            .contains("laser gives no port `scna`: it gives `scan`, `map`; did you mean `scan`?"),
        "{said}"
    );
    assert!(lines[1].contains("holds ' '"), "{said}");
    assert!(
        lines[2].contains("laser#scan publishes what it sends, and is not one that asks"),
        "{said}"
    );
    assert!(lines[3].contains("name `laser/scan` here, `Map` there"), "{said}");
    assert!(said.contains("contract `laser/scan`: field `beams`: only there"), "{said}");
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn ports_whose_names_cannot_be_are_refused_at_the_start() {
    type Declare = fn(&mut Ports<Pilot>);
    let declare: [(Declare, &str); 3] = [
        (
            |ports| _ = ports.asks::<Scan>("drive"),
            "the port `drive` of pilot: another port has this name",
        ),
        (|ports| _ = ports.asks::<Scan>("a scan"), "holds ' ' at byte 1"),
        (
            |ports| _ = ports.publishes::<Scan>(&"s".repeat(128)),
            "a name of this kind has at most 128",
        ),
    ];
    for (declare, expected) in declare {
        let spec = ChildSpec::new("pilot", || Pilot).with_ports(declare);
        let refused = TestNode::try_start(Node::builder("base").child(spec)).await;
        let text = refused.err().expect("the port cannot be").to_string();
        assert!(text.contains(expected), "{text}");
    }
}

#[test]
fn a_type_is_described_with_its_parameters_and_ports_and_nothing_starts() {
    #[derive(Clone, Debug, Parameters)]
    struct Settings {
        #[parameter(default = 0.5, range = 0.0..=2.0, unit = "m")]
        margin: f64,
        #[parameter(default = 3)]
        tries: u8,
    }
    #[derive(Default)]
    struct Guard;
    impl Component for Guard {
        fn ports(ports: &mut Ports<Self>) {
            ports.parameters::<Settings>().publishes::<Scan>("scan").asks::<Nearest>("near");
            ports.actuator(ActuatorSpec::new(Drive { speed: 0.0 }, Hold)).named("wheels");
        }
    }
    impl Handle<Settings> for Guard {
        async fn handle(&mut self, _: Settings, _: &mut Context<Self>) {}
    }
    impl Handle<Drive> for Guard {
        async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
            drive.speed
        }
    }

    let guard = blastema::describe::<Guard>().unwrap();
    let json = serde_json::to_value(&guard).unwrap();
    assert_eq!(serde_json::from_value::<TypeDescription>(json.clone()).unwrap(), guard);
    assert_eq!(
        json["parameters"],
        serde_json::json!([
            {
                "name": "margin", "takes": "a number",
                "unit": "m", "range": "0.0..=2.0", "default": 0.5
            },
            {
                "name": "tries", "takes": "a whole number from 0 to 255",
                "unit": null, "range": null, "default": 3
            },
        ])
    );
    let field = |name, takes, unit, frame| {
        let field =
            [("name", Some(name)), ("takes", Some(takes)), ("unit", unit), ("frame", frame)];
        serde_json::json!([std::collections::BTreeMap::<&str, Option<&str>>::from(field)])
    };
    let scan = &json["gives"][0];
    assert_eq!((&scan["name"], &scan["role"]), (&"scan".into(), &"publishes".into()));
    assert_eq!(scan["fields"], field("nearest", "u32", Some("m"), Some("laser")));
    assert_eq!(json["gives"][1]["reply"], field("", "u32", None, None));
    let wheels = &json["takes"][0];
    assert_eq!((&wheels["name"], &wheels["role"]), (&"wheels".into(), &"commanded".into()));
    assert_eq!(wheels["fields"], field("speed", "f32", Some("m/s"), None));

    // One that declares nothing of what it gives says so.
    let silent = blastema::describe::<OldPlanner>().unwrap();
    assert_eq!(silent.gives, None);
    let scan: PortAddress = "old#scan".parse().unwrap();
    assert_eq!(silent.port(&scan, false).unwrap().role, ConnectionRole::Listens);
}
