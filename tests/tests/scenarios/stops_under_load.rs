//! Robots that stop, on real threads beside two that are busy. Nothing here measures time.

use blastema::prelude::*;
use blastema::{ActuatorSpec, Lifecycle};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// As long as a test may take on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Two threads that are busy until this is dropped.
struct BusyThreads(Arc<AtomicBool>);

impl BusyThreads {
    fn start() -> Self {
        let ends = Arc::new(AtomicBool::new(false));
        for _ in 0..2 {
            let ends = ends.clone();
            std::thread::spawn(move || {
                while !ends.load(Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        BusyThreads(ends)
    }
}

impl Drop for BusyThreads {
    fn drop(&mut self) {
        self.0.store(true, Relaxed);
    }
}

fn burn(span: Duration) {
    let start = Instant::now();
    while start.elapsed() < span {
        std::hint::spin_loop();
    }
}

/// Waits until this holds.
async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let reached = async {
        while !holds() {
            blastema::sleep(Duration::from_millis(5)).await;
        }
    };
    assert!(tokio::time::timeout(LONG, reached).await.is_ok(), "{what}: never");
}

#[derive(Clone, Debug, Request)]
#[contract(name = "stops/turn", reply = ())]
struct Turn(u32);

/// Takes 5 ms of its receiver's thread.
#[derive(Clone, Debug, Event)]
struct Load;

type Log = Arc<Mutex<Vec<String>>>;

struct Wheels(Log);

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Load>();
        ports.actuator(ActuatorSpec::new(Turn(0)).lease(LONG));
    }

    async fn on_deactivated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.lock().unwrap().push("deactivated".into());
        Ok(())
    }
}

impl Handle<Turn> for Wheels {
    async fn handle(&mut self, turn: Turn, _: &mut Context<Self>) {
        burn(Duration::from_millis(2));
        self.0.lock().unwrap().push(format!("turn {}", turn.0));
    }
}

impl Handle<Load> for Wheels {
    async fn handle(&mut self, _: Load, _: &mut Context<Self>) {
        burn(Duration::from_millis(5));
    }
}

#[test]
fn wheels_are_stopped_before_each_deactivation_however_busy_the_computer_is() {
    const TIMES: usize = 10;
    let _busy = BusyThreads::start();
    let log = Log::default();
    let kept = log.clone();
    blastema::run(async {
        let wheels = ChildSpec::new("wheels", move || Wheels(kept.clone()))
            .queue(4, WhenFull::DropOldest)
            .shutdown_within(LONG)
            .max_delay(LONG);
        let node = Node::builder("module1").child(wheels).start().await.unwrap();
        let commander = node.commander::<Turn>("wheels", "console").unwrap();
        let load = node.sender::<Load>("wheels").unwrap();
        let deactivations = || {
            let log = log.lock().unwrap();
            log.iter().filter(|what| *what == "deactivated").count()
        };
        for n in 0..TIMES {
            commander.claim_within(LONG).await.unwrap();
            commander.command(Turn(1)).await.unwrap();
            (0..4).for_each(|_| load.tell(Load).unwrap());
            match n % 2 {
                0 => drop(node.restart_child("wheels").await.unwrap()),
                _ => {
                    let actor = node.actor::<Wheels>("wheels").unwrap();
                    actor.deactivate();
                    until("it is deactivated", || deactivations() == n + 1).await;
                    until("it is active", || {
                        actor.activate();
                        actor.state() == Lifecycle::Active
                    })
                    .await;
                }
            }
        }
        node.shutdown().await;
        assert_eq!(node.faults().await.entries, [], "it ended in order");
    });
    let turns = ["turn 1", "turn 0", "deactivated"];
    let mut wanted: Vec<_> = turns.iter().cycle().take(3 * TIMES).copied().collect();
    wanted.push("deactivated"); // By the shutdown: nothing moved any more.
    assert_eq!(*log.lock().unwrap(), wanted);
}
