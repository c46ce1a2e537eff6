//! A leaf of a behaviour tree that keeps its thread.

use blastema::Fault;
use blastema::prelude::*;
use blastema::trees::{BehaviorTree, Status, TreeLeaves};
use blastema_tests::{next_fault, until};
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::sync::mpsc::channel;
use std::time::Duration;

#[test]
fn a_leaf_that_does_not_return_is_named_by_its_path_and_its_tree_begins_again() {
    let _turn = blastema_doubles::turn();
    let (first, (release, held)) = (AtomicBool::new(true), channel::<()>());
    let held = Mutex::new(held);
    let leaves = TreeLeaves::new().action("Grip", [], move |_| {
        if first.swap(false, SeqCst) {
            // Until the test lets it go.
            let _ = held.lock().unwrap().recv();
        }
        Ok(Status::Success)
    });
    let text = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><SubTree ID="Arm" name="left"/></BehaviorTree>
        <BehaviorTree ID="Arm"><Sequence><Grip name="grip"/><Sleep msec="600000"/></Sequence>
        </BehaviorTree></root>"#;
    let tree = BehaviorTree::of_text("tree", &leaves, text).expect("a tree");
    blastema::run(async {
        let mut builder = Node::builder("rover").without_signal_handling();
        let mut faults = builder.fault_events();
        let tree = tree.max_block(Duration::from_millis(200));
        let builder = builder.grace(Duration::from_millis(100)).child(tree);
        let node = builder.start().await.expect("it starts");
        let is_check = |fault: &Fault| fault.kind == FaultKind::CheckFailed;
        let named = next_fault(&mut faults, is_check, "the leaf is named").await;
        assert_eq!(named.detail, "leaf left/grip: it did not return, and kept the tree's thread");
        let goes_on = async || node.trees().iter().any(|row| row.type_name == "Sleep");
        until(goes_on, "the tree goes on").await;
        drop(release);
        node.shutdown().await;
    });
}
