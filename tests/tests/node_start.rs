//! What a node that cannot start says, and what it leaves behind. One test at a time counts
//! threads, so they stand in one function.

use blastema::prelude::*;
use std::time::{Duration, Instant};

struct Lamp;
impl Component for Lamp {}

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").expect("Linux lists a process's threads").count()
}

/// Waits for threads that have been told to end; says how many are left.
async fn settled(at_most: usize) -> usize {
    let patience = Instant::now() + Duration::from_secs(10);
    while threads() > at_most && Instant::now() < patience {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    threads()
}

#[test]
fn a_node_that_cannot_start_says_why_and_leaves_no_thread() {
    blastema::run(async {
        let before = threads();

        let stranger = ChildSpec::new("lamp", || Lamp).depends_on(["socket"]);
        let error = Node::builder("m").child(stranger).start().await.expect_err("no such object");
        assert!(matches!(error, StartError::Dependency { .. }), "{error}");
        let narcissus = ChildSpec::new("lamp", || Lamp).depends_on(["m:lamp"]);
        let error = Node::builder("m").child(narcissus).start().await.expect_err("itself");
        assert!(error.to_string().contains("lamp -> lamp"), "{error}");
        let needs = |name, other| ChildSpec::new(name, || Lamp).depends_on([other]);
        let ring = Node::builder("m")
            .child(needs("a", "b"))
            .supervisor(SupervisorSpec::new("s", Strategy::OneForOne).child(needs("b", "m:c")))
            .child(needs("c", "a"));
        let error = ring.start().await.expect_err("each waits for the next");
        assert!(error.to_string().contains("a -> b -> c -> a"), "{error}");
        let twice = Node::builder("m")
            .child(ChildSpec::new("lamp", || Lamp))
            .child(ChildSpec::new("lamp", || Lamp));
        assert!(matches!(twice.start().await, Err(StartError::Spec(_))));
        let endless = ChildSpec::new("lamp", || Lamp).queue(usize::MAX, WhenFull::Refuse);
        assert!(matches!(
            Node::builder("m").child(endless).start().await,
            Err(StartError::Spec(_))
        ));
        let unseen = Node::builder("m")
            .child(ChildSpec::new("lamp", || Lamp))
            .inspection_socket("/no/m.window");
        assert!(matches!(unseen.start().await, Err(StartError::Shown(_))));
        assert!(settled(before).await <= before);

        for _ in 0..10 {
            let node = Node::builder("m")
                .child(ChildSpec::new("lamp", || Lamp).on_own_thread())
                .start()
                .await
                .expect("a lamp starts");
            node.shutdown().await;
        }
        assert!(settled(before).await <= before, "{} threads, {before} before", threads());
    });
}
