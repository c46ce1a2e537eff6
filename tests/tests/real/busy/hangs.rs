//! Components that hang behind another, beside two threads that keep the processors.

use super::{BusyThreads, LONG};
use blastema::prelude::*;
use blastema::{Fault, FaultTransition};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;
use tokio::sync::Notify;

/// What the handler of a [`Link`] does.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/act")]
enum Act {
    /// Keeps its thread.
    Block,
    /// Asks the encoder, and waits for its reply.
    Ask,
    /// The same, until the test lets it go on; then keeps its thread.
    AskAndBlock,
}

#[derive(Clone, Debug, Request)]
#[contract(name = "test/angle", reply = f32)]
struct Angle;

/// What the test holds of its components.
#[derive(Clone)]
struct Strings {
    go_on: Arc<Notify>,
    /// Nothing is ever sent: a thread that receives blocks until the sender is dropped.
    blocked: Arc<Mutex<mpsc::Receiver<()>>>,
}

impl Strings {
    fn block(&self) {
        let _ = self.blocked.lock().expect("no thread panics with it").recv();
    }
}

struct Link(Strings);

impl Component for Link {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Act>().serve::<Angle>();
    }
}

impl Handle<Angle> for Link {
    async fn handle(&mut self, _: Angle, _: &mut Context<Self>) -> f32 {
        0.0
    }
}

impl Handle<Act> for Link {
    async fn handle(&mut self, act: Act, cx: &mut Context<Self>) {
        if let Act::Ask | Act::AskAndBlock = act {
            let encoder = cx.sender::<Angle>("encoder").expect("it is there");
            let reply = encoder.ask_within(Angle, 60 * LONG);
            tokio::select! {
                _ = reply => {}
                () = self.0.go_on.notified(), if matches!(act, Act::AskAndBlock) => {}
            }
        }
        if let Act::Block | Act::AskAndBlock = act {
            self.0.block();
        }
    }
}

#[test]
fn what_waits_for_a_hung_component_is_its_symptom_and_what_keeps_its_own_thread_is_a_root() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    blastema::run(async {
        let (hold, blocked) = mpsc::channel();
        let blocked = Arc::new(Mutex::new(blocked));
        let strings = Strings { go_on: Arc::default(), blocked };
        let spec = |name| {
            let strings = strings.clone();
            let limit = Duration::from_millis(200);
            let spec = ChildSpec::new(name, move || Link(strings.clone())).on_own_thread();
            spec.max_block(limit).max_wait(limit)
        };
        let observe = Plan::default().on(FaultKind::Hang, Ladder::first(RecoveryAction::Observe));
        let node = Node::builder("module1").plan(observe).child(spec("encoder"));
        let node = node.child(spec("arm").depends_on(["encoder"]));
        let node = node.child(spec("gripper").depends_on(["encoder"])).start().await.unwrap();
        let mut steps = node.fault_events();
        let mut hang = async |object: &str, turn: FaultTransition| -> Fault {
            let step = async {
                loop {
                    let step = steps.next().await.expect("the node runs");
                    let location = step.fault.location.to_string();
                    if location == format!("module1:{object}") && step.turn == turn {
                        return step.fault;
                    }
                }
            };
            let step = tokio::time::timeout(LONG, step).await;
            step.unwrap_or_else(|_| panic!("{object}: no step {turn:?}"))
        };
        let act = |object: &str, act| node.sender::<Act>(object).unwrap().tell(act).unwrap();

        act("encoder", Act::Block);
        let encoder = hang("encoder", FaultTransition::Found).await;
        act("gripper", Act::Ask);
        let gripper = hang("gripper", FaultTransition::Found).await;
        act("arm", Act::AskAndBlock);
        let waiting = hang("arm", FaultTransition::Found).await;
        strings.go_on.notify_one();
        let blocked = hang("arm", FaultTransition::Explained).await;

        assert_eq!(encoder.symptom_of, None);
        assert_eq!((gripper.symptom_of, waiting.symptom_of), (Some(encoder.id), Some(encoder.id)));
        assert!(waiting.detail.contains("has been waiting"), "{waiting:?}");
        assert_eq!((blocked.id, blocked.symptom_of), (waiting.id, None));
        assert!(blocked.detail.contains("has kept its thread"), "{blocked:?}");
        drop(hold);
        node.shutdown().await;
    });
}
