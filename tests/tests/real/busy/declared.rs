//! Faults that a component declares of itself, beside two busy threads.

use super::{BusyThreads, LONG};
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema_tests::{burn, until};
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
        let one_check = async |is_right: fn(&FaultEntry) -> bool, what| {
            let is_so = async || {
                let mut entries = node.faults().await.entries;
                entries.retain(|entry| entry.fault.kind == FaultKind::CheckFailed);
                matches!(&entries[..], [check] if is_right(check))
            };
            until(is_so, what).await;
        };

        oil.store(false, Relaxed);
        one_check(|check| check.stands() && check.fault.count > 2, "one that stands").await;
        oil.store(true, Relaxed);
        one_check(|check| !check.stands(), "one that is over").await;
        node.shutdown().await;
    });
}
