//! Messages, replies, deadlines.

use super::{Add, Slow, Stage, acc};
use crate::liveness::sampler::AliveSource;
use crate::{DeliveryError, Sender, WhenFull};
use blastema_contract::child::ChildOrder;
use blastema_core::Lifecycle;
use blastema_doubles::{advance, paused, settle};
use std::time::Duration;
use tokio::task::spawn_local;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_handler_borrows_across_an_await_while_messages_wait_and_control_does_not() {
    let stage = Stage::new();
    let (_child, acc) = stage.start(acc("acc").0).await;
    let slow = spawn_local({
        let acc = acc.clone();
        async move { acc.ask(Slow(50)).await }
    });
    settle().await;
    let add = spawn_local({
        let acc = acc.clone();
        async move { acc.ask(Add(1)).await }
    });
    advance(Duration::from_millis(20)).await;
    assert!(!add.is_finished());

    let queue = acc.0.queue();

    assert_eq!((acc.state(), queue.queued), (Lifecycle::Active, 1));
    assert!(queue.oldest >= Duration::from_millis(10), "{queue:?}");
    assert_eq!((slow.await.unwrap(), add.await.unwrap()), (Ok(1000), Ok(1001)));
}

#[test]
fn a_deadline_holds_on_a_thread_without_a_beat() {
    paused(async {
        let stage = Stage::new();
        let (_child, acc) = stage.start(acc("acc").0).await;
        let sender: Sender<Slow> = acc.sender();

        let far = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .start_paused(true)
                .build()
                .unwrap();
            runtime.block_on(sender.ask(Slow(3_600_000))).unwrap_err().kind
        });

        // Its clock jumps on its own; ours need not turn for it.
        assert_eq!(far.join().unwrap(), DeliveryError::DeadlinePassed);
    });
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_that_floods_itself_starves_nobody() {
    use crate::{Component, Context, Event, Handle};

    #[derive(Clone, Event)]
    struct Again(u64);
    struct Flood;
    impl Component for Flood {}
    impl Handle<Again> for Flood {
        async fn handle(&mut self, Again(n): Again, cx: &mut Context<Self>) {
            cx.me().tell(Again(n + 1)).unwrap();
        }
    }

    let stage = Stage::new();
    let spec = crate::ChildSpec::new("flood", || Flood).queue(8, WhenFull::Refuse);
    let (mut child, flood) = stage.start(spec).await;
    flood.tell(Again(0)).unwrap();
    let (_other, acc) = stage.start(acc("acc").0).await;

    assert_eq!(acc.ask(Add(1)).await, Ok(1));
    child.order(ChildOrder::Stop { again: false });
    settle().await;

    assert_eq!(flood.tell(Again(0)).unwrap_err().kind, DeliveryError::Stopped);
}
