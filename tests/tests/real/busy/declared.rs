//! Faults that a component declares of itself, beside two busy threads.

use super::{BusyThreads, LONG, burn};
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Checks its oil in every round, and keeps its thread for a while.
struct Joint {
    oil: Arc<AtomicBool>,
}

impl Component for Joint {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        burn(Duration::from_millis(1));
        cx.check(self.oil.load(Relaxed), "there is oil");
        cx.check(true, "it turns");
        Ok(())
    }
}

#[test]
fn a_check_that_passes_again_ends_its_fault() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    let oil = Arc::new(AtomicBool::new(true));
    let kept = oil.clone();
    blastema::run(async {
        let joint = ChildSpec::new("joint", move || Joint { oil: kept.clone() })
            .rate_hz(50.0)
            .max_delay(LONG);
        let node = Node::builder("module1").child(joint).start().await.unwrap();
        let checks = async |count: usize, is_over: fn(&FaultEntry) -> bool| {
            let reached = async {
                loop {
                    let entries = node.faults().await.entries.into_iter();
                    let mut checks = entries.filter(|e| e.fault.kind == FaultKind::CheckFailed);
                    let (first, rest) = (checks.next(), checks.count());
                    if rest + usize::from(first.is_some()) == count
                        && first.is_some_and(|e| is_over(&e))
                    {
                        return;
                    }
                    blastema::sleep(Duration::from_millis(20)).await;
                }
            };
            assert!(tokio::time::timeout(LONG, reached).await.is_ok(), "{count} faults: never");
        };

        oil.store(false, Relaxed);
        checks(1, |check| check.stands() && check.fault.count > 2).await;
        oil.store(true, Relaxed);
        checks(1, |check| !check.stands()).await;
        node.shutdown().await;
    });
}
