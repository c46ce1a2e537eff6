//! The test that the manual's page on testing shows, word for word from the first `use` on.

use blastema::prelude::*;
use blastema_testkit::TestNode;

struct Arm;

impl Component for Arm {}

#[blastema_testkit::test]
async fn an_arm_that_dies_is_restarted() {
    let builder = Node::builder("module1").child(ChildSpec::new("arm", || Arm));
    let mut node = TestNode::start(builder).await;

    node.kill("arm");

    let fault = node.await_fault(FaultKind::Panic, "arm").await;
    node.await_recovered(FaultKind::Panic, "arm").await;
    assert_eq!(fault.count, 1);
    assert_eq!(node.row("arm").await.restarts, 1);
}
