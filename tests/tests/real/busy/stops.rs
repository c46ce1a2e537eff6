//! Robots that stop, on real threads beside two that are busy. Nothing here measures time.

use super::{BusyThreads, LONG};
use blastema::prelude::*;
use blastema::{ActuatorSpec, Hold, Lifecycle};
use blastema_tests::{accepts, burn, moves, until};
use std::sync::mpsc;
use std::sync::{Arc, Mutex};
use std::time::Duration;

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
        ports.actuator(ActuatorSpec::new(Turn(0), Hold).lease(LONG));
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
    let _turn = blastema_doubles::turn();
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
                    until(async || deactivations() == n + 1, "it is deactivated").await;
                    let is_active = async || {
                        actor.activate();
                        actor.state() == Lifecycle::Active
                    };
                    until(is_active, "it is active").await;
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

/// Keeps the thread of its receiver until the test goes on.
#[derive(Clone, Debug, Event)]
struct Keep;

#[test]
fn a_neighbour_that_keeps_the_thread_past_the_command_timeout_has_the_actuator_cut_off() {
    let _turn = blastema_doubles::turn();
    let log = Log::default();
    let (kept, cut) = (log.clone(), log.clone());
    let (release, released) = mpsc::channel();
    let released = Arc::new(Mutex::new(released));
    blastema::run(async {
        let neighbour = accepts("neighbour", released, |released, _: Keep, _| {
            // An error: the test has failed.
            let _ = released.lock().unwrap().recv_timeout(LONG);
        });
        let spec = ActuatorSpec::new(Turn(0), Duration::from_secs(2)).lease(LONG);
        let spec = spec.cut_off(move || cut.lock().unwrap().push("cut off".into()));
        // It has its neighbour keep their thread once it turns.
        let cart = moves("cart", spec, kept, |log, Turn(turn), cx| {
            if turn > 0 {
                cx.sender::<Keep>("neighbour").unwrap().tell(Keep).unwrap();
            }
            log.lock().unwrap().push(format!("turn {turn}"));
        });
        let cart = cart.max_wait(Duration::from_millis(200)).max_delay(LONG);
        let node = Node::builder("module1").work_threads(1).child(neighbour.max_block(2 * LONG));
        let node = node.child(cart).start().await.unwrap();
        let commander = node.commander::<Turn>("cart", "console").unwrap();
        commander.claim_within(LONG).await.unwrap();
        commander.command(Turn(1)).await.unwrap();

        until(async || log.lock().unwrap().len() == 2, "it is cut off").await;
        assert_eq!(*log.lock().unwrap(), ["turn 1", "cut off"]);
        release.send(()).unwrap();
        until(async || log.lock().unwrap().len() == 3, "it gets its safe command").await;
        assert_eq!(*log.lock().unwrap(), ["turn 1", "cut off", "turn 0"]);
        node.shutdown().await;
    });
}
