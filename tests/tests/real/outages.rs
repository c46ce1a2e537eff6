//! Ends and starts of another process on real sockets: what watchers and callers learn of them.

use blastema::core::detection::Opinion;
use blastema::prelude::*;
use blastema::{Down, DownReason, FaultLocation, Link, Network, NodeBuilder};
use blastema_tests::{MS, Notes, PATIENCE, Process, addresses, free_addresses, role, until};
use std::net::SocketAddr;
use std::sync::OnceLock;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

/// Replies with the present incarnation.
#[derive(Clone, Debug, Request)]
#[contract(name = "outage/present", reply = u64)]
struct Present;

/// Has the node of the receiver shut itself down.
#[derive(Clone, Debug, Event)]
#[contract(name = "outage/leave")]
struct Leave;

/// The node of this process, in the role of the arm.
static ARM: OnceLock<Node> = OnceLock::new();

/// Takes so long to start.
struct Grip(Duration);

impl Component for Grip {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Present>().accept::<Leave>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        blastema::sleep(self.0).await;
        self.0 = Duration::ZERO;
        Ok(())
    }
}

impl Handle<Present> for Grip {
    async fn handle(&mut self, _: Present, cx: &mut Context<Self>) -> u64 {
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
    let network = Network::new("lan", &format!("udp://{}", at[own])).link(link);
    Node::builder(names[own]).network(network)
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    let slow = MS * role.parse().expect("how long the grip takes to start");
    blastema::run(async {
        let first = AtomicU64::new(1);
        let grip = ChildSpec::new("grip", move || Grip(slow * first.swap(0, SeqCst) as u32));
        let arm = node(1, &addresses()).child(grip).start().await.unwrap();
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

    /// What the guard was told, once that is right.
    async fn told(&self, is_right: impl Fn(&[Down]) -> bool) -> Vec<Down> {
        until(async || is_right(&self.told.lock()), "the guard is told what is right").await;
        self.told.take()
    }
}

fn is_lost(down: &Down) -> bool {
    matches!(down.ending, DownReason::NodeLost { .. })
}

#[test]
fn a_process_that_is_started_again_is_connected_when_its_objects_answer() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let base = Base::start(|node| node).await;
        let mut arm = base.arm(300);
        for _ in 0..3 {
            base.connected().await;
            let grip = base.node.sender::<Present>("arm:grip").unwrap();
            let asked = (0..20).map(|_| grip.ask_within(Present, PATIENCE));
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
            let grip = base.node.sender::<Present>("arm:grip").unwrap();
            assert_eq!(grip.ask_within(Present, PATIENCE).await.unwrap(), 1);
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
