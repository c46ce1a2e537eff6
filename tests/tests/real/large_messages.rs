//! Messages of a mebibyte between two nodes, on real sockets.

use blastema::prelude::*;
use blastema::{Blob, Link, Network};
use blastema_tests::{PATIENCE, free_addresses, serves, until};
use std::net::SocketAddr;

const MEBIBYTE: usize = 1 << 20;
/// Many times what a session holds.
const IMAGES: u32 = 40;

/// Bytes that are shared, behind which nothing stands.
#[derive(Clone, Debug, Event)]
#[contract(name = "large/image", max_size = 2 << 20, bulk)]
struct Image {
    number: u32,
    pixels: Blob,
}

/// How many images have come.
#[derive(Clone, Debug, Request)]
#[contract(name = "large/count", reply = u32)]
struct Count;

#[derive(Default)]
struct Screen(u32);

/// An order, to another component than the images.
#[derive(Clone, Debug, Request)]
#[contract(name = "large/order", reply = u32)]
struct Order(u32);

impl Component for Screen {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Image>().serve::<Count>();
    }
}

impl Handle<Image> for Screen {
    async fn handle(&mut self, image: Image, _: &mut Context<Self>) {
        assert_eq!(image.number, self.0, "none is lost, doubled or overtaken");
        assert!(image.pixels == pixels(image.number), "it is whole");
        self.0 += 1;
    }
}

impl Handle<Count> for Screen {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u32 {
        self.0
    }
}

/// Every byte of it has another neighbour than in the next image.
fn pixels(number: u32) -> Blob {
    (0..MEBIBYTE).map(|at| (at / 7 + number as usize) as u8).collect()
}

/// All of them are given to the sender before the other node has heard of any; and orders are asked
/// beside them.
fn images_arrive_over(medium: fn(&'static str, SocketAddr) -> Network) {
    blastema::run(async {
        let [here, there] = free_addresses(2).try_into().expect("two");
        let motor = serves("motor", 0, |next, Order(number), _| {
            assert_eq!(number, *next, "none is lost, doubled or overtaken");
            *next += 1;
            *next
        });
        let far = Node::builder("module2")
            .network(medium("net0", there).link(Link::new("module1", here)))
            .child(ChildSpec::new("screen", Screen::default).queue(4, WhenFull::Wait))
            .child(motor)
            .start()
            .await
            .expect("module2 starts");
        let near = Node::builder("module1")
            .network(medium("net0", here).link(Link::new("module2", there)))
            .start()
            .await
            .expect("module1 starts");
        assert!(near.connected("module2", PATIENCE).await, "{:?}", near.links().await);

        let burst: Vec<_> =
            (0..IMAGES).map(|number| Image { number, pixels: pixels(number) }).collect();
        let images: Sender<Image> = near.sender("module2:screen").expect("a name");
        let burst = async {
            for image in burst {
                images.deliver(image).await.expect("it is taken");
            }
        };
        let orders: Sender<Order> = near.sender("module2:motor").expect("a name");
        let orders = async {
            for number in 0.. {
                let asked = orders.ask_within(Order(number), PATIENCE).await;
                assert_eq!(asked.ok(), Some(number + 1), "what is small finds room beside bulk");
            }
        };
        tokio::select! {
            () = burst => {}
            () = orders => {}
        }

        let count: Sender<Count> = near.sender("module2:screen").expect("a name");
        let all_have_come = async || count.ask(Count).await.ok() == Some(IMAGES);
        until(all_have_come, "what was taken arrives").await;
        near.shutdown().await;
        far.shutdown().await;
    });
}

#[test]
fn a_burst_of_the_first_images_to_a_node_arrives_whole_over_udp() {
    let _turn = blastema_doubles::turn();
    images_arrive_over(Network::udp);
}

#[test]
fn a_burst_of_the_first_images_to_a_node_arrives_whole_over_tcp() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    images_arrive_over(Network::tcp);
}
