//! Outages between two processes on real sockets: what watchers and callers learn once the nodes
//! are connected again.

use blastema::core::detection::Opinion;
use blastema::prelude::*;
use blastema::{Direction, Down, DownReason, FaultLocation, Link, Network, NodeBuilder};
use blastema_tests::{MS, Notes, Process, addresses, free_addresses, role, until};
use std::net::SocketAddr;
use std::sync::OnceLock;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(60);

/// Replies with the present incarnation, which ends so soon: at once, or never with 0 times; so
/// many incarnations after it end, too.
#[derive(Clone, Debug, Request)]
#[contract(name = "outage/end", reply = u64)]
struct End {
    after_ms: u64,
    times: u64,
}

/// Has the node of the receiver shut itself down.
#[derive(Clone, Debug, Event)]
#[contract(name = "outage/leave")]
struct Leave;

/// Has a number, and is published by the base.
#[derive(Clone, Debug, Event)]
#[contract(name = "outage/tick")]
struct Tick(u64);

/// Replies with how many ticks have arrived at this node, served or not.
#[derive(Clone, Debug, Request)]
#[contract(name = "outage/ticks", reply = u64)]
struct Ticks;

/// Counts the ticks that arrive at this node.
#[derive(Default)]
struct Clock(u64);

impl Component for Clock {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ticks>();
        ports.listen::<Tick>();
    }
}

impl Handle<Tick> for Clock {
    async fn handle(&mut self, _: Tick, _: &mut Context<Self>) {
        self.0 += 1;
    }
}

impl Handle<Ticks> for Clock {
    async fn handle(&mut self, _: Ticks, _: &mut Context<Self>) -> u64 {
        let letters = ARM.get().map_or_else(Vec::new, |arm| arm.dead_letters().counts());
        let lost = letters.iter().filter(|letter| letter.contract == "outage/tick");
        self.0 + lost.map(|letter| letter.count).sum::<u64>()
    }
}

/// The node of this process, in the role of the arm.
static ARM: OnceLock<Node> = OnceLock::new();

/// How many incarnations are still to end by themselves.
static TO_END: AtomicU64 = AtomicU64::new(0);

/// Takes so long to start.
struct Grip(Duration);

impl Component for Grip {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<End>().accept::<Leave>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        blastema::sleep(self.0).await;
        self.0 = Duration::ZERO;
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        if TO_END.fetch_update(SeqCst, SeqCst, |left| left.checked_sub(1)).is_ok() {
            cx.after(MS, |_, cx| cx.stop());
        }
        Ok(())
    }
}

impl Handle<End> for Grip {
    async fn handle(&mut self, End { after_ms, times }: End, cx: &mut Context<Self>) -> u64 {
        if times > 0 {
            TO_END.store(times - 1, SeqCst);
            cx.after(MS * after_ms as u32, |_, cx| cx.stop());
        }
        cx.incarnation().0
    }
}

impl Handle<Leave> for Grip {
    async fn handle(&mut self, _: Leave, _: &mut Context<Self>) {
        drop(actix_rt::spawn(async {
            while ARM.get().is_none() {
                blastema::sleep(MS).await;
            }
            ARM.get().expect("it is there").shutdown().await;
        }));
    }
}

/// Remembers what it is told of the grip.
struct Guard(Notes<Down>);

impl Component for Guard {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        Ok(cx.watch("arm:grip")?)
    }
}

impl Handle<Down> for Guard {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        self.0.note(down);
    }
}

fn node(own: usize, at: &[SocketAddr]) -> NodeBuilder {
    let (names, other) = (["base", "arm"], 1 - own);
    let link = Link::new(names[other], at[other]);
    let network = Network::new("lan", &format!("udp://{}", at[own])).link(link).with_faults(7);
    Node::builder(names[own]).network(network).intensity(1000, Duration::from_secs(1))
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    let slow = MS * role.parse().expect("how long the grip takes to start");
    blastema::run(async {
        let first = AtomicU64::new(1);
        let grip = ChildSpec::new("grip", move || Grip(slow * first.swap(0, SeqCst) as u32));
        let clock = ChildSpec::new("clock", Clock::default);
        let arm = node(1, &addresses()).child(grip).child(clock).start().await.unwrap();
        ARM.get_or_init(|| arm).run_until_signal().await.unwrap();
    });
}

/// The base, and where the process of the arm is to be.
struct Base {
    node: Node,
    at: Vec<SocketAddr>,
    told: Notes<Down>,
}

impl Base {
    async fn start(describe: impl FnOnce(NodeBuilder) -> NodeBuilder) -> Self {
        let (at, told) = (free_addresses(2), Notes::<Down>::default());
        let kept = told.clone();
        let guard = ChildSpec::new("guard", move || Guard(kept.clone()));
        let node = describe(node(0, &at)).child(guard).start().await.unwrap();
        Base { node, at, told }
    }

    fn arm(&self, slow_ms: u64) -> Process {
        Process::start(module_path!(), &slow_ms.to_string(), &self.at)
    }

    async fn connected(&self) {
        assert!(self.node.connected("arm", PATIENCE).await);
    }

    async fn end(&self, after_ms: u64, times: u64) -> u64 {
        let grip = self.node.sender::<End>("arm:grip").unwrap();
        loop {
            match grip.ask_within(End { after_ms, times }, PATIENCE).await {
                Ok(incarnation) => return incarnation,
                // It is between two incarnations.
                Err(error) if error.kind == DeliveryError::Restarting => {}
                Err(error) if matches!(error.kind, DeliveryError::PeerDied { .. }) => {}
                Err(error) => panic!("{}", error.kind),
            }
            blastema::sleep(MS).await;
        }
    }

    /// What the guard was told, once that is right.
    async fn told(&self, is_right: impl Fn(&[Down]) -> bool) -> Vec<Down> {
        until(async || is_right(&self.told.lock()), "the guard is told what is right").await;
        self.told.take()
    }
}

fn is_lost(down: &Down) -> bool {
    matches!(down.ending, DownReason::NodeLost { .. })
}

/// The incarnations whose end was told.
fn ended(told: &[Down]) -> Vec<u64> {
    let returned = told.iter().filter(|down| down.ending == DownReason::Returned);
    returned.map(|down| down.incarnation.0).collect()
}

#[test]
fn ends_in_an_outage_and_right_after_it_are_told_to_the_watcher_of_another_process() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node).await;
        let arm = base.arm(0);
        base.connected().await;
        let cable = base.node.cable("lan").unwrap();
        for (is_stopped, times) in [(false, 1), (false, 20), (true, 1), (true, 20)] {
            let first = base.end(300, times).await;
            match is_stopped {
                true => arm.signal("-STOP"),
                false => cable.cut(Direction::Both, false),
            }
            base.told(|told| told.iter().any(is_lost)).await;
            match is_stopped {
                true => arm.signal("-CONT"),
                false => cable.restore(),
            }
            base.connected().await;

            let told =
                base.told(|told| ended(told).last().is_some_and(|n| *n == first + times - 1));
            let told = told.await;
            assert!(ended(&told).is_sorted_by(|one, next| one < next), "{told:?}");

            cable.cut(Direction::Both, false);
            base.told(|told| told.iter().any(is_lost)).await;
            cable.restore();
            base.connected().await;
            let last = base.end(0, 1).await;
            assert_eq!(last, first + times);
            let told = base.told(|told| ended(told) == [last]).await;
            assert!(!told.iter().any(is_lost), "{told:?}");
        }
        base.node.shutdown().await;
    });
}

#[test]
fn a_process_that_is_started_again_is_connected_when_its_objects_answer() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node).await;
        let mut arm = base.arm(300);
        for _ in 0..3 {
            base.connected().await;
            let grip = base.node.sender::<End>("arm:grip").unwrap();
            let asked = (0..20).map(|_| grip.ask_within(End { after_ms: 0, times: 0 }, PATIENCE));
            for asked in asked {
                assert_eq!(asked.await.map_err(|error| error.kind), Ok(1));
            }

            base.told.take();
            arm.kill();
            base.told(|told| told.iter().any(is_lost)).await;
            arm = base.arm(300);
        }
        base.node.shutdown().await;
    });
}

#[test]
fn a_process_that_may_be_away_ends_and_dies_without_a_fault_and_each_is_told_once() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node.may_be_away("arm")).await;
        let row = async || {
            let rows = base.node.table().await;
            let arm = FaultLocation::Node("arm".parse().unwrap());
            let row = rows.into_iter().find(|row| row.location == arm).expect("it has a row");
            (row.opinion, row.note.unwrap_or_default())
        };
        let (opinion, note) = row().await;
        assert_eq!(opinion, Opinion::Stopped, "{note}");
        assert!(note.contains("it may be away, and is"), "{note}");
        for in_order in [true, false, true] {
            let mut arm = base.arm(0);
            base.connected().await;
            base.end(0, 0).await;
            assert_eq!(row().await, (Opinion::Trusted, String::new()));
            base.told.take();

            match in_order {
                true => {
                    arm.signal("-TERM");
                    assert!(arm.succeeds());
                }
                false => arm.kill(),
            }
            let is_away =
                async || row().await.0 == Opinion::Stopped && base.node.routes().await.is_empty();
            until(is_away, "it is away").await;
            let told = base.told(|told| !told.is_empty()).await;
            // Another one would follow when the session is over.
            while base.node.sessions().await.iter().any(|row| row.status.incarnation.is_some()) {
                blastema::sleep(MS).await;
            }
            blastema::sleep(100 * MS).await;
            let more = base.told.take();
            assert_eq!((told.len(), more), (1, vec![]), "{in_order}: {told:?}");
        }
        let faults = base.node.faults().await.entries;
        assert!(faults.is_empty(), "{faults:?}");
        base.node.shutdown().await;
    });
}

#[test]
fn a_node_that_a_component_of_its_own_shuts_down_leaves_in_order_before_its_program_ends() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node).await;
        for _ in 0..5 {
            let mut arm = base.arm(0);
            base.connected().await;
            base.told.take();

            base.node.sender::<Leave>("arm:grip").unwrap().tell(Leave).unwrap();

            assert!(arm.succeeds());
            let told = base.told(|told| told.iter().any(is_lost)).await;
            let [Down { ending: DownReason::NodeLost { reason }, .. }] = &told[..] else {
                panic!("{told:?}");
            };
            assert_eq!(reason, "node arm has left in order");
        }
        let faults = base.node.faults().await.entries;
        assert!(faults.is_empty(), "{faults:?}");
        base.node.shutdown().await;
    });
}

#[test]
fn what_is_published_until_a_listener_is_back_arrives_or_is_counted_as_lost_to_its_node() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node).await;
        let ticks = base.node.publisher("outage/tick").unwrap();
        let mut arm = base.arm(0);
        base.connected().await;
        ticks.matched_at_least(1).await;
        let cable = base.node.cable("lan").unwrap();
        let mut next = 0;
        // Until so many listeners have been there so many times.
        let mut publish = async |listeners: usize, mut times: u32| {
            while times > 0 {
                ticks.publish(Tick(next)).unwrap();
                next += 1;
                times -= u32::from(ticks.matched() == listeners);
                blastema::sleep(2 * MS).await;
            }
            next
        };
        let lost = || {
            let letters = base.node.dead_letters().counts().into_iter();
            let lost = letters.filter(|letter| letter.contract == "outage/tick");
            lost.map(|letter| letter.count).sum::<u64>()
        };
        let clock = base.node.sender::<Ticks>("arm:clock").unwrap();
        // How many ticks the present process counts, once the session holds none.
        let arrived = async || {
            loop {
                let arrived = clock.ask_within(Ticks, PATIENCE).await.unwrap();
                let rows = base.node.sessions().await;
                if rows.iter().all(|row| row.status.unacknowledged == 0) {
                    return arrived;
                }
            }
        };

        let mut before = [0; 3];
        for ending in ["stop", "cut", "kill", "cut", "kill"] {
            match ending {
                "stop" => arm.signal("-STOP"),
                "cut" => cable.cut(Direction::Both, false),
                _ => arm.kill(),
            }
            publish(0, 500).await;
            match ending {
                "stop" => arm.signal("-CONT"),
                "cut" => cable.restore(),
                _ => (arm, before[1]) = (base.arm(0), 0),
            }
            let published = publish(1, 100).await;

            let count = async || [published, arrived().await, lost()];
            let is_balanced = |counts: [u64; 3]| {
                let [published, arrived, lost] = [0, 1, 2].map(|at| counts[at] - before[at]);
                assert!(arrived + lost <= published, "{ending}: {arrived} + {lost} of {published}");
                arrived + lost == published
            };
            until(async || is_balanced(count().await), &format!("{ending}, after {before:?}"))
                .await;
            // No loss is counted late.
            blastema::sleep(500 * MS).await;
            let counts = count().await;
            assert!(is_balanced(counts) && counts[2] - before[2] >= 500, "{ending}: {counts:?}");
            before = counts;
        }
        base.node.shutdown().await;
    });
}
