//! A node that ends in order is no fault to the others, and its return an ordinary join.

use blastema::core::detection::{FaultRecord, Opinion};
use blastema::prelude::*;
use blastema::{MemoryMedium, NodeBuilder};
use blastema_testkit::TestNode;
use blastema_tests::{MS, Part, next_fault, on_ethernet, serves};
use std::time::Duration;

/// For what does not wait.
const PATIENCE: Duration = Duration::from_secs(30);

/// Adds to a sum, and answers it.
#[derive(Debug, Request)]
#[contract(name = "sum/add", reply = u32)]
struct Add(u32);

fn sum() -> ChildSpec<Part<u32, Add>> {
    serves("sum", 0, |sum, Add(number), _| {
        *sum += number;
        *sum
    })
}

fn module(medium: &MemoryMedium, own: &str, far: &str) -> NodeBuilder {
    on_ethernet(own, far, medium).child(sum())
}

/// Two nodes with a session between them.
async fn met(medium: &MemoryMedium, there: NodeBuilder) -> (TestNode, TestNode) {
    let here = TestNode::start(module(medium, "here", "there")).await;
    let there = TestNode::start(there).await;
    here.advance(2000 * MS).await;
    (here, there)
}

#[blastema_testkit::test]
async fn a_node_that_leaves_in_order_is_no_fault_and_its_return_no_recovery() {
    let medium = MemoryMedium::default();
    let (here, there) = met(&medium, module(&medium, "there", "here")).await;
    let sum: Sender<Add> = here.sender("there:sum").unwrap();
    assert_eq!(sum.ask(Add(1)).await.unwrap(), 1);

    there.shutdown().await;
    assert!(there.faults().await.entries.is_empty(), "nor finds it any");
    drop(there);
    here.advance(5000 * MS).await;

    let why = sum.ask(Add(1)).await.unwrap_err().kind;
    assert_eq!(why, DeliveryError::Left { node: "there".into() });
    here.expect_no_faults().await;
    assert_eq!(here.row("there").await.opinion, Opinion::Stopped);

    let there = TestNode::start(module(&medium, "there", "here")).await;
    here.advance(5000 * MS).await;

    assert_eq!(sum.ask(Add(1)).await.unwrap(), 1, "a new incarnation");
    let row = here.row("there").await;
    assert_eq!((row.opinion, row.restarts), (Opinion::Trusted, 0));
    here.expect_no_faults().await;
    there.expect_no_faults().await;
}

/// Takes one message, and is busy with it for good.
struct Stuck;

impl Component for Stuck {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Stuck {
    async fn handle(&mut self, _: Add, _: &mut Context<Self>) -> u32 {
        std::future::pending().await
    }
}

#[blastema_testkit::test]
async fn whoever_sends_from_a_node_that_has_ended_is_told_so_at_once() {
    let medium = MemoryMedium::default();
    let (here, _there) = met(&medium, module(&medium, "there", "here")).await;
    let far: Sender<Add> = here.sender("there:sum").unwrap();
    let near: Sender<Add> = here.sender("sum").unwrap();
    assert_eq!(far.ask(Add(1)).await.unwrap(), 1);

    here.shutdown().await;

    for sum in [near, far] {
        assert_eq!(sum.tell(Add(2)).unwrap_err().kind, DeliveryError::Stopped);
        let asked = sum.ask(Add(2)).await.unwrap_err();
        assert_eq!((asked.kind, asked.message.is_some()), (DeliveryError::Stopped, true));
        let delivered = tokio::time::timeout(PATIENCE, sum.deliver(Add(2))).await;
        assert_eq!(delivered.expect("it does not wait").unwrap_err().kind, DeliveryError::Stopped);
    }
}

#[blastema_testkit::test]
async fn what_a_node_that_ends_still_accepts_arrives() {
    let medium = MemoryMedium::default();
    let (here, there) = met(&medium, module(&medium, "there", "here")).await;
    let sum: Sender<Add> = here.sender("there:sum").unwrap();

    let sending = async {
        let mut accepted = 0;
        loop {
            match sum.deliver(Add(1)).await {
                Ok(()) => accepted += 1,
                Err(refused) => return (accepted, refused.kind),
            }
            tokio::time::sleep(MS).await;
        }
    };
    let sending = tokio::time::timeout(PATIENCE, sending);
    let (sent, ()) = tokio::join!(sending, here.shutdown());

    let (accepted, why) = sent.expect("it does not wait");
    assert_eq!(why, DeliveryError::Stopped);
    let sum: Sender<Add> = there.sender("sum").unwrap();
    assert_eq!(sum.ask(Add(0)).await.unwrap(), accepted);
}

#[blastema_testkit::test]
async fn whoever_waits_for_room_elsewhere_is_told_when_its_own_node_ends() {
    let medium = MemoryMedium::default();
    let stuck = ChildSpec::new("stuck", || Stuck).queue(1, WhenFull::Refuse);
    let (here, _there) = met(&medium, module(&medium, "there", "here").child(stuck)).await;
    let stuck: Sender<Add> = here.sender("there:stuck").unwrap();
    while stuck.tell(Add(1)).is_ok() {
        here.advance(MS).await;
    }

    let waiting = tokio::time::timeout(PATIENCE, stuck.deliver(Add(2)));
    let (waited, ()) = tokio::join!(waiting, here.shutdown());

    assert_eq!(
        waited.expect("it does not wait for ever").unwrap_err().kind,
        DeliveryError::Stopped
    );
}

/// Declares a fault when it comes to work.
struct Worn;

impl Component for Worn {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.declare_fault(FaultKind::Custom("WORN".into()), "4 mm of 5 mm");
        Ok(())
    }
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn a_node_that_was_shut_down_still_says_which_faults_stood() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let worn = FaultKind::Custom("WORN".into());
            let mut builder = Node::builder("here")
                .fault_kind("WORN")
                .plan(Plan::default().on(worn.clone(), Ladder::first(RecoveryAction::Observe)))
                .child(ChildSpec::new("worn", || Worn));
            let mut faults = builder.fault_events();
            let node = builder.start().await.expect("it starts");
            next_fault(&mut faults, |fault| fault.kind == worn, "it is found").await;

            node.shutdown().await;

            let kinds = |record: FaultRecord| {
                record.entries.into_iter().map(|entry| entry.fault.kind).collect::<Vec<_>>()
            };
            for time in ["once", "and as often as it is asked"] {
                assert_eq!(kinds(node.faults().await), std::slice::from_ref(&worn), "{time}");
            }
        });
    }
}
