//! A node that is shut down while a handler keeps its thread.

use super::LONG;
use blastema::prelude::*;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Event)]
struct Work;

/// Keeps its thread until it is let go.
struct Stubborn(SyncSender<()>, Arc<Mutex<Receiver<()>>>);

impl Component for Stubborn {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Work>();
    }
}

impl Handle<Work> for Stubborn {
    async fn handle(&mut self, _: Work, _: &mut Context<Self>) {
        self.0.send(()).expect("the test listens");
        let _ = self.1.lock().expect("one incarnation only").recv();
    }
}

#[test]
fn a_handler_that_may_block_for_longer_than_its_component_has_to_stop_holds_no_shutdown_up() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (begun, begins) = sync_channel(1);
        let (let_go, released) = sync_channel(1);
        let released = Arc::new(Mutex::new(released));
        let make = move || Stubborn(begun.clone(), released.clone());
        let stubborn = ChildSpec::new("stubborn", make)
            .max_block(60 * LONG)
            .shutdown_within(Duration::from_millis(100));
        let node = Node::builder("module1").child(stubborn).start().await.unwrap();
        node.sender::<Work>("stubborn").unwrap().tell(Work).unwrap();
        begins.recv_timeout(LONG).expect("it is served");

        tokio::time::timeout(LONG, node.shutdown()).await.expect("it ends in its time");

        assert_eq!(node.state(), NodeState::Stopped);
        let_go.send(()).unwrap();
    });
}
