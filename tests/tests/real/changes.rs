//! Trees that change beside a component that keeps its thread busy.

use blastema::prelude::*;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::SeqCst;
use std::time::{Duration, Instant};

/// No test waits longer for what must come.
const LONG: Duration = Duration::from_secs(60);
const ROUNDS: u64 = 30;

#[derive(Clone, Event)]
struct Work;

/// Burns five milliseconds of its thread for each piece of work.
struct Mill(Arc<AtomicU64>);

impl Component for Mill {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Work>();
    }
}

impl Handle<Work> for Mill {
    async fn handle(&mut self, _: Work, _: &mut Context<Self>) {
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_millis(5) {
            std::hint::spin_loop();
        }
        self.0.fetch_add(1, SeqCst);
    }
}

#[test]
fn supervisors_come_and_go_beside_a_handler_that_burns_its_thread() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (served, own) = (Arc::<AtomicU64>::default(), Arc::<AtomicU64>::default());
        let mill = |name: &str, served: &Arc<AtomicU64>| {
            let served = served.clone();
            ChildSpec::new(name, move || Mill(served.clone())).max_delay(LONG)
        };
        // One thread for all: what is added stands behind the mill.
        let builder = Node::builder("module1").work_threads(1).child(mill("mill", &served));
        let node = builder.start().await.unwrap();
        let rows = node.table().await.len();
        let work = node.sender::<Work>("mill").unwrap();

        let rounds = async {
            for _ in 0..ROUNDS {
                for _ in 0..4 {
                    work.tell(Work).expect("there is room");
                }
                let group = SupervisorSpec::new("group", Strategy::RestForOne)
                    .child(mill("group/first", &own))
                    .child(mill("group/second", &own).depends_on(["group/first"]).on_own_thread());
                node.add(None, group).await.expect("it starts");
                node.sender::<Work>("group/second").unwrap().tell(Work).unwrap();
                node.remove_child("group").await.expect("it is there");
            }
            while served.load(SeqCst) < 4 * ROUNDS {
                blastema::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(LONG, rounds).await.expect("they end");

        assert_eq!(served.load(SeqCst), 4 * ROUNDS, "the mill has lost nothing");
        let lost = node.dead_letters().total();
        assert_eq!(own.load(SeqCst) + lost, ROUNDS, "work is done, or its loss is counted");
        assert_eq!(node.table().await.len(), rows);
        assert_eq!(node.tree().await.unwrap().children.len(), 1);
        assert_eq!((node.abandoned_threads(), node.state()), (0, NodeState::Running));
        node.shutdown().await;
    });
}
