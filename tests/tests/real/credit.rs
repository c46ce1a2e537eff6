//! A stream of messages as fast as they are taken, and requests of another component to the same
//! node, over real sockets: none of the requests is refused.

use blastema::Blob;
use blastema::prelude::*;
use blastema_tests::{
    PATIENCE, Process, accepts, addresses, free_addresses, pair_network, role, serves,
};
use std::cell::Cell;
use std::rc::Rc;
use std::time::Duration;

const REQUESTS: u64 = 300;
/// The bytes of a message: many small ones, and few that are large.
const SIZES: [usize; 2] = [8, 200_000];

#[derive(Clone, Debug, Event)]
#[contract(name = "credit/piece", max_size = 300_000)]
struct Piece(Blob);

#[derive(Clone, Debug, Request)]
#[contract(name = "credit/question", reply = u64)]
struct Question(u64);

#[test]
fn a_process_plays_its_role() {
    let Some(scheme) = role() else { return };
    blastema::run(async {
        let sink = accepts("sink", (), |_, _: Piece, _| {}).queue(1024, WhenFull::Refuse);
        let oracle = serves("oracle", (), |_, Question(number), _| number);
        let builder = Node::builder("right").child(sink).child(oracle);
        let _node = builder.network(pair_network(&scheme, 1, &addresses())).start().await;
        std::future::pending::<()>().await;
    });
}

async fn ask_beside_a_stream(scheme: &'static str, size: usize) {
    let at = free_addresses(2);
    let node = Node::builder("left").network(pair_network(scheme, 0, &at)).start().await;
    let node = node.expect("it starts");
    let _right = Process::start(module_path!(), scheme, &at);
    assert!(node.connected("right", PATIENCE).await);
    let oracle = node.sender::<Question>("right:oracle").expect("a name");
    assert_eq!(oracle.ask_within(Question(0), PATIENCE).await.expect("it is served"), 0);

    let (sent, is_over) = (Rc::new(Cell::new(0_u64)), Rc::new(Cell::new(false)));
    let (count, over) = (sent.clone(), is_over.clone());
    let pieces = node.sender::<Piece>("right:sink").expect("a name");
    let stream = actix_rt::spawn(async move {
        while !over.get() {
            pieces.deliver(Piece(Blob::from(vec![7; size]))).await.expect("the node is there");
            count.set(count.get() + 1);
            if count.get().is_multiple_of(256) {
                tokio::task::yield_now().await;
            }
        }
    });
    let mut refused = Vec::new();
    for number in 1..=REQUESTS {
        let before = sent.get();
        match oracle.ask_within(Question(number), PATIENCE).await {
            Ok(answer) => assert_eq!(answer, number),
            Err(why) => refused.push(why.to_string()),
        }
        // The stream has its turn between any two.
        while sent.get() == before {
            sleep(Duration::from_millis(1)).await;
        }
    }
    is_over.set(true);
    stream.await.expect("it ends");
    assert!(refused.is_empty(), "{scheme}, {size}: {} refused: {}", refused.len(), refused[0]);
    node.shutdown().await;
}

#[test]
fn a_stream_of_messages_refuses_no_request_of_another_component() {
    let _turn = blastema_doubles::turn_within(3 * PATIENCE);
    for scheme in ["udp", "tcp"] {
        for size in SIZES {
            blastema::run(ask_beside_a_stream(scheme, size));
        }
    }
}
