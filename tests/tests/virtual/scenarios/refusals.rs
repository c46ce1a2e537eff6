//! What is refused before a node starts, and what is said about it.

use blastema::prelude::*;
use blastema::{Link, Network};
use std::time::Duration;

/// What a node of this description is refused with.
async fn refusal(networks: Vec<Network>) -> String {
    let builder = networks.into_iter().fold(Node::builder("module1"), |b, n| b.network(n));
    match builder.start().await {
        Ok(_) => panic!("it started"),
        Err(error) => error.to_string(),
    }
}

#[blastema_testkit::test]
async fn what_cannot_be_right_about_a_network_is_refused_with_the_wrong_part() {
    let own = "127.0.0.1:7400";
    let udp = |name: &str| Network::new(name, &format!("udp://{own}"));
    let check = async |network: Network, words: &[&str]| {
        let text = refusal(vec![network]).await;
        assert!(words.iter().all(|word| text.contains(word)), "{words:?} in {text}");
    };

    check(udp("lan").peer("module1", "127.0.0.1:7401"), &["network lan", "module1 is this node"])
        .await;
    check(udp("lan").peer("module2", own), &["network lan", "our own address", "^^^"]).await;
    check(udp("lan").peer("module2", "127.0.0.1:0"), &["network lan", "port 0"]).await;
    check(udp("lan").peer("mod 2", "127.0.0.1:1"), &["neighbour on network lan", "' '"]).await;
    let written = Link::new("module2", own.parse().unwrap());
    check(udp("lan").link(written), &["network lan", "module2", "our own address"]).await;
    for millis in [0, 20_000] {
        let link = Link::to("module2", "127.0.0.1:7401").hello_every(Duration::from_millis(millis));
        check(udp("lan").link(link), &["network lan", "module2", "1 ms to 15 s"]).await;
    }
    let twins = refusal(vec![udp("lan"), udp("lan")]).await;
    assert!(twins.contains("two networks are called lan"), "{twins}");
}

#[blastema_testkit::test]
async fn a_wrong_name_says_whose_it_is() {
    let Err(error) = Node::builder("module 1").start().await else { panic!("it started") };

    assert!(error.to_string().starts_with("the name of the node: "), "{error}");
}
