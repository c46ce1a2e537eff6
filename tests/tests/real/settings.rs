//! What a description says that cannot be meant is refused at start, with the wrong part and what
//! to write.

use blastema::core::detection::Push;
use blastema::core::recovery::{Backoff, RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{
    ActuatorSpec, ClaimPolicy, Hold, IsolateError, Link, MemoryMedium, Network, NodeBuilder,
    RecoveryStrategy, SpecError, StartError, StrategyContext,
};
use blastema_tests::MS;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

struct Lamp;
impl Component for Lamp {}

fn lamp() -> ChildSpec<Lamp> {
    ChildSpec::new("lamp", || Lamp)
}

fn node() -> NodeBuilder {
    Node::builder("module1")
}

/// The node does not start, and says these words.
async fn refused(builder: NodeBuilder, words: &[&str]) {
    let told = match builder.start().await {
        Ok(node) => {
            node.shutdown().await;
            panic!("it is taken, and should say {words:?}");
        }
        Err(error) => error.to_string(),
    };
    for word in words {
        assert!(told.contains(word), "{word:?} is not said in {told:?}");
    }
}

/// It starts, and ends.
async fn taken(builder: NodeBuilder) {
    let node = builder.start().await.unwrap_or_else(|error| panic!("it is right: {error}"));
    node.shutdown().await;
}

#[test]
fn numbers_of_the_node_that_make_no_sense_are_refused() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let threads = "work_threads of the node is";
        refused(node().work_threads(0), &[threads, "write 1 to 1024"]).await;
        refused(node().work_threads(usize::MAX), &[threads, "1024"]).await;
        refused(node().grace(Duration::MAX), &["grace of the node is", "an hour at most"]).await;
        taken(node().work_threads(1).grace(Duration::ZERO).child(lamp())).await;
        let session = ["session_timeout of the node is", "200 ms to an hour"];
        refused(node().session_timeout(199 * MS), &session).await;
        refused(node().session_timeout(Duration::MAX), &session).await;
        taken(node().session_timeout(200 * MS).child(lamp())).await;

        let storm = node().intensity(3, Duration::ZERO);
        refused(storm, &["period of root is 0ns", "1 ms at least for each"]).await;
        refused(node().intensity(u32::MAX, MS), &["intensity of root", "1000 at most"]).await;
        refused(node().intensity(1000, 999 * MS), &["period of root is 999ms"]).await;
        taken(node().intensity(1000, 1000 * MS).child(lamp())).await;
        let below = SupervisorSpec::new("drive", Strategy::OneForOne).intensity(3, Duration::ZERO);
        refused(node().supervisor(below), &["of drive"]).await;
        taken(node().intensity(0, Duration::MAX).child(lamp())).await;
        taken(node().intensity(0, Duration::ZERO).child(lamp())).await;
    });
}

#[test]
fn spans_of_a_component_that_are_never_or_always_over_are_refused() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let refused = |spec: ChildSpec<Lamp>, words: &'static [&'static str]| {
            refused(node().child(spec), words)
        };
        refused(lamp().max_block(Duration::ZERO), &["max_block of lamp is 0ns", "10 ms"]).await;
        refused(lamp().max_block(5 * MS), &["max_block of lamp is 5ms"]).await;
        refused(lamp().max_wait(Duration::ZERO), &["max_wait of lamp"]).await;
        refused(lamp().ready_within(Duration::ZERO), &["ready_within of lamp"]).await;

        let interval = &["liveness.interval of lamp is", "the model guard"];
        refused(lamp().liveness(Liveness::push(Duration::ZERO, 3)), interval).await;
        refused(lamp().liveness(Liveness::push(Duration::MAX, 3)), interval).await;
        refused(lamp().liveness(Liveness::pull(Duration::ZERO, MS)), interval).await;
        refused(lamp().liveness(Liveness::push(MS, 0)), &["liveness.tolerance of lamp is 0"]).await;
        refused(lamp().liveness(Liveness::push(MS, u32::MAX)), &["1 to 1000"]).await;
        refused(lamp().liveness(Liveness::pull(MS, Duration::ZERO)), &["within of lamp"]).await;
        refused(lamp().max_delay(Duration::ZERO), &["max_delay of lamp"]).await;
        refused(lamp().max_missed_rounds(0), &["max_missed_rounds of lamp"]).await;
        refused(lamp().max_missed_rounds(101), &["max_missed_rounds of lamp"]).await;
        let rare = lamp().rate_hz(1.0).liveness(Liveness::push(100 * MS, 3));
        refused(rare, &["liveness.interval of lamp", "every 1s", "a higher rate"]).await;
        refused(lamp().rate_hz(501.0), &["rate_hz of lamp is 501", "on_own_thread"]).await;
        let own = lamp().on_own_thread().rate_hz(10_001.0);
        refused(own, &["rate_hz of lamp is 10001", "up to 10000 Hz"]).await;
        refused(lamp().priority(10), &["priority of lamp is 10 on a shared", "on_own_thread"])
            .await;
        refused(lamp().cpu(0), &["cpu of lamp is 0 on a shared", "on_own_thread"]).await;
        let own = lamp().on_own_thread().priority(100).cpu(1024);
        refused(own, &["priority of lamp is 100", "1 to 99"]).await;
        let none = lamp().on_own_thread().cpu(1023);
        refused(none, &["cpu of lamp is 1023, which failed", "taskset"]).await;
        let start_up = Push { start_up: Duration::ZERO, ..Push::default() };
        refused(lamp().liveness(Liveness::Push(start_up)), &["start_up of lamp"]).await;

        let max = Duration::MAX;
        let for_ever = lamp().max_block(max).max_wait(max).ready_within(max).shutdown_within(max);
        taken(node().child(for_ever)).await;
        taken(node().child(lamp().shutdown_within(Duration::ZERO))).await;
        let often = lamp().rate_hz(10.0).liveness(Liveness::push(50 * MS, 3));
        taken(node().child(often)).await;
        taken(node().child(lamp().rate_hz(500.0))).await;
        taken(node().child(lamp().on_own_thread().rate_hz(10_000.0))).await;
    });
}

#[test]
fn names_are_given_once_also_those_of_supervisors_and_of_the_middleware() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let called = |name: &str| ChildSpec::new(name, || Lamp);
        let group = |name: &str| SupervisorSpec::new(name, Strategy::OneForOne);
        let same = "names are given once";
        refused(node().child(called("root")), &["root is taken by a supervisor", same]).await;
        for reserved in ["leases", "net/directory", "net/stack", "chain/of/my/own"] {
            let error = node().child(called(reserved)).start().await.unwrap_err();
            assert!(matches!(error, StartError::Spec(SpecError::Reserved { .. })), "{error}");
            let error = node().supervisor(group(reserved)).start().await.unwrap_err();
            assert!(matches!(error, StartError::Spec(SpecError::Reserved { .. })), "{error}");
        }
        taken(node().child(called("net"))).await;
        refused(node().supervisor(group("root")), &["root", same]).await;
        refused(node().supervisor(group("a")).supervisor(group("a")), &["a", same]).await;
        refused(node().child(lamp()).supervisor(group("lamp")), &["lamp", same]).await;
        let within = group("a").child(called("a"));
        refused(node().supervisor(within), &["the name a", same]).await;
        refused(node().supervisor(group("-a")), &["the name of a supervisor", "\"-a\""]).await;

        let node = node().child(lamp()).supervisor(group("a")).start().await.unwrap();
        for name in ["root", "a", "lamp"] {
            let error = node.add_child(called(name)).await.expect_err(name);
            assert!(matches!(error, SpecError::Taken(_)), "{name}: {error}");
        }
        node.add_child(called("b")).await.expect("the name is free");
        node.shutdown().await;
    });
}

#[test]
fn a_name_that_would_be_a_path_or_an_option_is_refused_wherever_it_stands() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for name in [".", "..", "-h"] {
            refused(Node::builder(name), &["the name of the node", "begin it with a letter"]).await;
            let child = ChildSpec::new(name, || Lamp);
            refused(node().child(child), &["the name of a component", "begin it"]).await;
            let peer = Network::new("memory", "memory://settings").peer(name, "other");
            refused(node().network(peer), &["a neighbour on network memory"]).await;
            refused(node().network(Network::new(name, "memory://settings")), &["begin it"]).await;
        }
    });
}

#[derive(Clone, Debug, Event)]
#[contract(name = "settings/drive")]
struct Drive;

/// Of the same name, and another structure.
#[derive(Clone, Debug, Event)]
#[contract(name = "settings/drive")]
struct OtherDrive;

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "settings/speed")]
struct Speed {
    m_per_s: f32,
}

/// Declares its ports as it was told.
struct Told<const PORTS: u8>;

impl<const PORTS: u8> Component for Told<PORTS> {
    fn ports(ports: &mut Ports<Self>) {
        let spec = || ActuatorSpec::new(Drive, Hold);
        let speed = |m_per_s| {
            let most = |speed: &Speed| match speed.m_per_s {
                ..=1.0 => Ok(()),
                _ => Err("faster than it can stop".to_owned()),
            };
            VariableSpec::new(Speed { m_per_s }).check(most)
        };
        let _ = match PORTS {
            0 => ports.accept::<Drive>().accept::<Drive>(),
            1 => ports.accept::<Drive>().accept::<OtherDrive>(),
            2 => ports.accept::<Drive>().actuator(spec()),
            3 => ports.actuator(spec()).actuator(spec()),
            4 => ports.variable(speed(0.0)).variable(speed(1.0)),
            5 => ports.variable(speed(2.0)),
            6 => ports.actuator(spec().lease(MS)),
            7 => ports.actuator(spec().lease(Duration::MAX)),
            8 => ports.actuator(ActuatorSpec::new(Drive, MS)),
            _ => ports.actuator(spec().lease(20 * MS)).variable(speed(0.5)),
        };
    }
}

impl<const PORTS: u8> Handle<Drive> for Told<PORTS> {
    async fn handle(&mut self, _: Drive, _: &mut Context<Self>) {}
}

impl<const PORTS: u8> Handle<OtherDrive> for Told<PORTS> {
    async fn handle(&mut self, _: OtherDrive, _: &mut Context<Self>) {}
}

fn told<const PORTS: u8>() -> NodeBuilder {
    node().child(ChildSpec::new("wheel", || Told::<PORTS>))
}

#[test]
fn ports_of_which_one_could_not_be_reached_or_held_are_refused() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let twice = "wheel has two ports for \"settings/drive\"";
        refused(told::<0>(), &[twice, "leave one of them out"]).await;
        refused(told::<1>(), &[twice]).await;
        refused(told::<2>(), &[twice, "one for every sender", "the commander"]).await;
        refused(told::<3>(), &[twice, "both by actuator"]).await;
        refused(told::<4>(), &["two ports for \"settings/speed\"", "both by variable"]).await;
        refused(told::<5>(), &["a variable of wheel", "faster than it can stop"]).await;
        refused(told::<6>(), &["actuator.lease of wheel is 1ms", "20 ms to 60 s"]).await;
        refused(told::<7>(), &["actuator.lease of wheel"]).await;
        refused(told::<8>(), &["actuator.command_timeout of wheel is 1ms", "or hold for"]).await;
        taken(told::<9>()).await;
        let claims = lamp().claim("light", ClaimPolicy::Refuse).claim("light", ClaimPolicy::Refuse);
        refused(node().child(claims), &["a claim of lamp is light twice"]).await;
    });
}

#[test]
fn our_own_address_is_nobody_elses_and_a_neighbours_is_one_of_the_medium() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = |text: &str| text.parse::<SocketAddr>().unwrap();
        for everybodys in ["224.0.0.1:7400", "239.255.0.1:7400", "255.255.255.255:7400"] {
            let own = &["network eth", everybodys, "^^^"];
            refused(node().network(Network::tcp("eth", at(everybodys))), own).await;
            for medium in ["udp", "tcp"] {
                let network = || Network::new("eth", &format!("{medium}://127.0.0.1:0"));
                refused(node().network(network().peer("b", everybodys)), &[everybodys, "^^^"])
                    .await;
            }
        }
        let own = || Network::new("eth", "udp://127.0.0.1:7400");
        for (network, words) in [
            (own().peer("module1", "127.0.0.1:7401"), ["module1 is this node", "network eth"]),
            (own().peer("b", "127.0.0.1:7400"), ["our own address", "^^^"]),
            (own().peer("b", "127.0.0.1:0"), ["no address of one neighbour", "network eth"]),
            (own().peer("b 2", "127.0.0.1:1"), ["neighbour on network eth", "' '"]),
        ] {
            refused(node().network(network), &words).await;
        }
        let reserved = Network::new("eth", "udp://224.0.0.1:7400");
        refused(node().network(reserved), &["224.0.0.1:7400", "^^^", "239.255.0.1"]).await;
        let network = Network::new("eth", "udp://127.0.0.1:0");
        let beacons = network.discover_all("224.0.0.1:7399");
        refused(node().network(beacons), &["own protocols"]).await;

        let serial = Network::new("cable", "serial:///dev/ttyS99").peer("b", "10.0.0.1:1");
        refused(node().network(serial), &["needs no address", "^^^"]).await;
        let memory = || Network::memory("mem", &MemoryMedium::default(), "a");
        refused(node().network(memory().peer("b", "a")), &["our own address"]).await;
        refused(node().network(memory().peer("b", "")), &["write the name of its end"]).await;
        let nameless = Network::memory("mem", &MemoryMedium::default(), "");
        refused(node().network(nameless), &["own end of the memory medium has no name"]).await;
    });
}

#[test]
fn a_node_that_cannot_be_away_is_refused_with_a_reason() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let with = |peer: &str| {
            let network = Network::memory("mem", &MemoryMedium::default(), "module1");
            node().network(network.peer("laptop", "laptop")).may_be_away(peer)
        };
        for (builder, why) in [
            (with("module1"), "module1 may be away, as is described: it is this node"),
            (with("a b"), "the name of a node that may be away"),
            (node().may_be_away("laptop"), "laptop may be away, as is described: this node has no"),
        ] {
            let refused = builder.check();
            assert!(refused.len() == 1 && refused[0].to_string().contains(why), "{refused:?}");
        }
        assert!(with("laptop").check().is_empty());
    });
}

#[test]
fn links_of_which_one_would_be_taken_for_another_or_cost_nothing_are_refused() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let network = |name: &'static str| {
            let medium = MemoryMedium::default();
            move |link: Link| Network::memory(name, &medium, "a").link(link)
        };
        let link = || Link::to("b", "b");
        let one = |link: Link| node().network(network("mem")(link));
        refused(one(link().cost(0)), &["cost of the link to b is 0", "1 at least"]).await;
        refused(one(link().named("")), &["an empty name"]).await;
        refused(one(link().hello_every(Duration::ZERO)), &["1 ms to 15 s"]).await;
        refused(one(link().hello_every(20_000 * MS)), &["1 ms to 15 s"]).await;
        refused(one(link().expected_within(Duration::ZERO)), &["the time of some hellos"]).await;
        refused(one(link().hello_every(MS * 500).expected_within(100 * MS)), &["500ms"]).await;
        taken(one(link().expected_within(Duration::MAX).cost(1))).await;

        let twice = network("mem")(link()).link(Link::to("c", "b"));
        refused(node().network(twice), &["two links of network mem lead to b"]).await;
        let both = one(link()).network(network("other")(link().named("mem")));
        refused(both, &["two links are called mem", "on mem and on other", "Link::named"]).await;
        let medium = MemoryMedium::default();
        let many = |count| (0..count).map(|n| format!("n{n}"));
        let crowd = |count| {
            many(count).fold(Network::memory("mem", &medium, "a"), |all, n| all.peer(&n, &n))
        };
        refused(node().network(crowd(65)), &["65 neighbours", "64 at most", "blastema-zenoh"])
            .await;
        taken(node().network(crowd(64))).await;

        let same = one(link()).network(network("mem")(link()));
        refused(same, &["two networks are called mem"]).await;
    });
}

#[test]
fn strategies_plans_and_codes_that_cannot_be_meant_are_refused() {
    let _turn = blastema_doubles::turn();
    struct Homing;
    impl RecoveryStrategy for Homing {
        async fn carry_out(
            &self,
            _: &RecoveryOrder,
            _: &StrategyContext,
        ) -> Result<RecoveryDone, RecoveryFailed> {
            Err("it is at home".into())
        }
    }
    blastema::run(async {
        let twice = node().recovery("homing", || Homing).recovery("homing", || Homing);
        refused(twice, &["recovery of the node is \"homing\" twice"]).await;
        refused(node().fault_kind("B01"), &["\"B01\"", "a built-in kind has it"]).await;
        refused(node().fault_kind(""), &["give it one"]).await;
        let rung = Ladder::first(RecoveryAction::Restart).within(Duration::ZERO);
        refused(node().plan(Plan::default().on(FaultKind::Panic, rung)), &["give it some"]).await;
        let still = Backoff { factor: 0, ..Backoff::default() };
        let rung = Ladder::first(RecoveryAction::Restart).backoff(still);
        refused(node().plan(Plan::default().on(FaultKind::Panic, rung)), &["equal ones"]).await;
    });
}

#[test]
fn variables_are_kept_in_a_file_of_ours_and_nothing_else_is_moved_for_it() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let precious = folder.path().join("precious");
        std::fs::create_dir(&precious).unwrap();

        let here = std::env::current_dir().unwrap().join("module1.variables");
        let absolute = here.to_str().unwrap();
        refused(node().keep_variables("module1.variables"), &["absolute path", absolute]).await;
        refused(node().keep_variables(""), &["absolute path"]).await;
        refused(node().keep_variables(&precious), &["of a folder", "a file in it"]).await;
        for wrong in ["module1.toml", precious.to_str().unwrap()] {
            let error = node().parameters_from(wrong).start().await.unwrap_err();
            let file = Some(PathBuf::from(wrong));
            assert!(
                matches!(&error, StartError::Parameters { file: named, .. } if *named == file),
                "{error}"
            );
        }

        assert!(precious.is_dir(), "it was not set aside");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    });
}

#[test]
fn who_has_no_network_can_isolate_nobody_and_is_told_so() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let node = node().start().await.unwrap();
        let unknown = node.isolate("module2").expect_err("it is on no network");
        assert!(unknown.to_string().ends_with("it knows none"), "{unknown}");
        let oneself = node.isolate("module1").expect_err("it is itself");
        assert!(matches!(oneself, IsolateError::Oneself { .. }), "{oneself}");
        node.shutdown().await;
    });
}
