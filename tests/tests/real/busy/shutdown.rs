//! A node that is shut down while a handler keeps its thread.

use super::LONG;
use blastema::prelude::*;
use blastema_tests::accepts;
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Event)]
struct Work;

#[test]
fn a_handler_that_may_block_for_longer_than_its_component_has_to_stop_holds_no_shutdown_up() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (begun, begins) = sync_channel(1);
        let (let_go, released) = sync_channel(1);
        let released = Arc::new(Mutex::new(released));
        // It keeps its thread until it is let go.
        let stubborn = accepts("stubborn", (begun, released), |(begun, released), _: Work, _| {
            begun.send(()).expect("the test listens");
            let _ = released.lock().expect("one incarnation only").recv();
        });
        let stubborn = stubborn.max_block(60 * LONG).shutdown_within(Duration::from_millis(100));
        let node = Node::builder("module1").child(stubborn).start().await.unwrap();
        node.sender::<Work>("stubborn").unwrap().tell(Work).unwrap();
        begins.recv_timeout(LONG).expect("it is served");

        tokio::time::timeout(LONG, node.shutdown()).await.expect("it ends in its time");

        assert_eq!(node.state(), NodeState::Stopped);
        let_go.send(()).unwrap();
    });
}
