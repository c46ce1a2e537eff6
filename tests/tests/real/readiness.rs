//! What a program waits for before it begins, on real sockets.

use blastema::prelude::*;
use blastema::{ClaimPolicy, Network};
use blastema_tests::{Notes, PATIENCE, free_addresses, until};
use std::time::Duration;

#[derive(Clone, Debug, Event)]
#[contract(name = "ready/news")]
struct News(u32);

#[derive(Clone, Debug, Request)]
#[contract(name = "ready/hello", reply = u32)]
struct Hello(u32);

struct Reader(Notes<u32>);

impl Component for Reader {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Hello>();
        ports.listen::<News>().on("news");
    }
}

impl Handle<Hello> for Reader {
    async fn handle(&mut self, Hello(number): Hello, _: &mut Context<Self>) -> u32 {
        number
    }
}

impl Handle<News> for Reader {
    async fn handle(&mut self, News(number): News, _: &mut Context<Self>) {
        self.0.note(number);
    }
}

#[test]
fn what_is_sent_and_published_once_all_is_ready_arrives_and_what_is_missing_is_named() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = free_addresses(2);
        let network = |own: usize, peer: &str| {
            let network = Network::new("lan", &format!("udp://{}", at[own]));
            network.peer(peer, &at[1 - own].to_string())
        };
        let here = Node::builder("here").network(network(0, "there"));
        let here = here.start().await.expect("it starts");
        let names = ["there:reader", "*:editor", "absent", "there:absent"];
        let missing = here.ready(&names, &["news"], Duration::ZERO).await;
        let missing = missing.expect_err("the other node is off").to_string();
        let expected = "not there in time: there:reader (there is not connected); *:editor (no object \
                        holds this name); absent (this node has no object of this name); \
                        there:absent (there is not connected); topic news (no node listens to this \
                        topic)";
        assert_eq!(missing, expected);

        let seen = Notes::default();
        let read = seen.clone();
        let reader = ChildSpec::new("reader", move || Reader(read.clone()));
        let ready = async {
            here.ready(&names[..2], &["news"], PATIENCE).await.expect("all come");
            let news = here.publisher::<News>("news").expect("a name");
            let (direct, global) = (
                here.sender::<Hello>("there:reader").expect("a name"),
                here.sender::<Hello>("*:editor").expect("a name"),
            );
            for number in 0..5 {
                news.publish(News(number)).expect("the node is there");
                assert_eq!(direct.ask(Hello(number)).await.expect("it is there"), number);
                assert_eq!(global.ask(Hello(number)).await.expect("it is there"), number);
            }
        };
        let there = async {
            let there = Node::builder("there").network(network(1, "here")).child(reader);
            let there = there.start().await.expect("it starts");
            let claim = there.claim_for("editor", "reader", ClaimPolicy::Refuse).await;
            (there, claim.expect("it is free"))
        };
        let ((), (there, _claim)) = tokio::join!(ready, there);
        until(async || seen.lock().len() >= 5, "all are there").await;
        assert_eq!(seen.all(), [0, 1, 2, 3, 4]);
        let missing = here.ready(&["there:absent"], &[], Duration::ZERO).await;
        let missing = missing.expect_err("it is not there").missing;
        assert_eq!(missing[0].1, "there has no object of this name");
        here.shutdown().await;
        there.shutdown().await;
    });
}
