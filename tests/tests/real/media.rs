//! Whole nodes over every medium, on real sockets and ptys, described by endpoint strings.

use blastema::prelude::*;
use blastema::{Link, Network};
use blastema_ptys::{Adapters, Cable};
use blastema_tests::{PATIENCE, found, free_addresses, next_fault, serves, until};
use std::net::{TcpListener, UdpSocket};
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

/// Gives back what it was sent, turned around.
#[derive(Debug, Request)]
#[contract(name = "media/mirror", reply = Vec<u8>)]
struct Turn(Vec<u8>);

/// Goes every way, and waits for nothing that is said one way.
#[derive(Debug, Request)]
#[contract(name = "media/stop", reply = (), delivery = "redundant")]
struct Halt;

/// Two nodes that have found each other.
struct Pair {
    near: Node,
    /// It has a mirror, and brakes.
    far: Node,
}

impl Pair {
    /// Starts them on these networks.
    async fn on(here: Network, there: Network) -> Self {
        let mirror = serves("mirror", (), |_, turn: Turn, _| turn.0.into_iter().rev().collect());
        let far = Node::builder("module2")
            .network(there)
            .child(mirror)
            .child(serves("brakes", (), |_, _: Halt, _| ()))
            .start()
            .await
            .expect("module2 starts");
        let near = Node::builder("module1").network(here).start().await.expect("module1 starts");
        assert!(near.connected("module2", PATIENCE).await, "{:?}", near.links().await);
        Pair { near, far }
    }

    /// At the ends of a serial line.
    async fn on_line(cable: &Cable, baud: u32) -> Self {
        let at = |own: &Path, peer: &str| {
            let endpoint = format!("serial://{}?baud={baud}", own.display());
            Network::new("cable", &endpoint).peer(peer, "").insecure()
        };
        Pair::on(at(&cable.left(), "module2"), at(&cable.right(), "module1")).await
    }

    fn mirror(&self) -> Sender<Turn> {
        self.near.sender("module2:mirror").expect("a name")
    }

    /// Asks the one for what the other has, from small to far above what one frame carries.
    async fn speak(self) {
        let mirror = self.mirror();
        for length in [0, 1, 100, 1_000, 5_000] {
            let bytes: Vec<u8> = (0..length).map(|n| (n % 251) as u8).collect();
            let turned = mirror.ask_within(Turn(bytes.clone()), PATIENCE).await;
            let expected: Vec<u8> = bytes.into_iter().rev().collect();
            assert_eq!(turned.expect("it is answered"), expected, "{length} bytes");
        }
        self.shutdown().await;
    }

    async fn shutdown(self) {
        self.near.shutdown().await;
        self.far.shutdown().await;
    }
}

async fn speak_over(here: Network, there: Network) {
    Pair::on(here, there).await.speak().await;
}

/// Each is at a free address, of which the endpoint is made, and knows the other's.
fn speak_at_addresses(endpoint: impl Fn(&str) -> String) {
    blastema::run(async {
        let [a, b] = free_addresses(2).try_into().expect("two");
        let [a, b] = [a, b].map(|address: std::net::SocketAddr| address.to_string());
        let at = |own: &str, peer: &str, far: &str| {
            Network::new("ethernet", &endpoint(own)).peer(peer, far)
        };
        speak_over(at(&a, "module2", &b), at(&b, "module1", &a)).await;
    });
}

#[test]
fn two_nodes_speak_over_udp_bound_to_an_interface() {
    let _turn = blastema_doubles::turn();
    speak_at_addresses(|own| format!("udp://{own}?interface=lo"));
}

#[test]
fn two_nodes_speak_over_udp_while_they_hear_a_group() {
    let _turn = blastema_doubles::turn();
    speak_at_addresses(|own| format!("udp://239.255.77.3:7400?own={own}"));
}

#[test]
fn two_nodes_speak_over_tcp() {
    let _turn = blastema_doubles::turn();
    speak_at_addresses(|own| format!("tcp://{own}"));
}

#[test]
fn two_nodes_speak_over_unix_sockets() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = TempDir::new().expect("a folder");
        let path = |name: &str| folder.path().join(name).display().to_string();
        let at = |own: &str, peer: &str| {
            Network::new("local", &format!("unix://{}", path(own))).peer(peer, &path(peer))
        };
        speak_over(at("module1", "module2"), at("module2", "module1")).await;
    });
}

#[test]
fn two_nodes_speak_over_a_serial_line() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        Pair::on_line(&cable, 921_600).await.speak().await;
    });
}

#[test]
fn two_nodes_speak_over_a_serial_line_of_9600_bits_a_second() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let cable = Cable::new();
        let pair = Pair::on_line(&cable, 9_600).await;

        let turned = pair.mirror().ask_within(Turn(vec![1, 2, 3]), PATIENCE).await;
        assert_eq!(turned.expect("it is answered"), [3, 2, 1]);
        pair.shutdown().await;
    });
}

#[test]
fn large_messages_on_a_line_of_9600_bits_a_second_take_nothing_down_and_a_stop_goes_before_them() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let cable = Cable::slow(960);
        let pair = Pair::on_line(&cable, 9_600).await;
        let mirror = pair.mirror();
        let brakes: Sender<Halt> = pair.near.sender("module2:brakes").expect("a name");
        // What goes before the first message of a kind has gone.
        mirror.ask_within(Turn(vec![1]), PATIENCE).await.expect("it is answered");
        brakes.ask_within(Halt, PATIENCE).await.expect("it is answered");
        let mut faults = [pair.near.fault_events(), pair.far.fault_events()];

        let mut large = Box::pin(mirror.ask_within(Turn(vec![7; 3_000]), 4 * PATIENCE));
        let mut stops = 0;
        let turned = loop {
            let stop = brakes.ask_within(Halt, PATIENCE);
            tokio::select! {
                turned = &mut large => break turned,
                stopped = stop => stopped.expect("it is answered"),
            }
            stops += 1;
        };

        assert_eq!(turned.expect("it is answered"), vec![7; 3_000]);
        assert!(stops >= 5, "only {stops} stops were answered meanwhile");
        for faults in &mut faults {
            let event = tokio::time::timeout(Duration::ZERO, faults.next()).await;
            assert!(event.is_err(), "{event:?}");
        }
        pair.shutdown().await;
    });
}

#[test]
fn two_nodes_of_one_process_speak_over_memory() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let at = |own: &str, peer: &str| {
            Network::new("memory", &format!("memory://media-test/{own}"))
                .peer(peer, &format!("media-test/{peer}"))
        };
        speak_over(at("module1", "module2"), at("module2", "module1")).await;
    });
}

#[test]
fn a_serial_cable_that_is_pulled_and_plugged_in_again_carries_on() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let cable = Cable::new();
        let pair = Pair::on_line(&cable, 921_600).await;
        let mut faults = pair.near.fault_events();

        cable.inject(&cable.left(), b"\r\nDebian GNU/Linux 12 module2 ttyS0\r\n\0");
        cable.unplug();
        let fault = link_fault(&mut faults).await;
        assert_eq!(fault.location.to_string(), "module1 -cable- module2");
        cable.plug();

        assert!(pair.near.connected("module2", PATIENCE).await, "{:?}", pair.near.links().await);
        let mirror = pair.mirror();
        let turned = async || mirror.ask(Turn(vec![1, 2])).await.ok();
        assert_eq!(found(turned, "the link comes back").await, [2, 1]);
        pair.shutdown().await;
    });
}

/// The next fault of a link.
async fn link_fault(faults: &mut blastema::FaultEvents) -> blastema::Fault {
    next_fault(faults, |fault| fault.kind == FaultKind::LinkDown, "a link fails").await
}

#[test]
fn a_port_that_is_taken_is_a_fault_that_says_what_to_do_and_ends_when_the_port_is_free() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for medium in ["udp", "tcp"] {
            for peers in [0, 1] {
                let tcp = TcpListener::bind("127.0.0.1:0").expect("a free port");
                let taken = tcp.local_addr().expect("it is bound");
                let udp = UdpSocket::bind(taken).expect("the same port of UDP");
                let mut network = Network::new("ethernet", &format!("{medium}://{taken}"));
                if peers == 1 {
                    network = network.peer("module2", "127.0.0.1:9");
                }

                let node = Node::builder("module1").network(network).start().await;
                let node = node.expect("a medium may come later");
                let mut faults = node.fault_events();
                // It may have been found before the events were subscribed to.
                let found = node.faults().await.entries.pop().map(|entry| entry.fault.detail);
                let detail = match found {
                    Some(detail) => detail,
                    None => link_fault(&mut faults).await.detail,
                };
                assert!(detail.contains("choose another port"), "{detail}");
                assert!(detail.contains(&format!("{medium} {taken}")), "{detail}");

                drop((udp, tcp));
                if peers == 0 {
                    let is_open = async || {
                        node.table().await.iter().any(|row| {
                            row.location.to_string().contains("ethernet")
                                && row.opinion == blastema::Opinion::Trusted
                        })
                    };
                    until(is_open, "it opens").await;
                }
                node.shutdown().await;
            }
        }
    });
}

#[test]
fn a_wrong_endpoint_or_address_is_refused_at_start_with_the_wrong_part_underlined() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let start = async |network: Network| {
            let error = Node::builder("module1").network(network).start().await;
            match error.expect_err("it is wrong") {
                StartError::Endpoint { network, error, .. } => {
                    assert_eq!(network, "cable");
                    error
                }
                other => panic!("{other}"),
            }
        };

        let error = start(Network::new("cable", "serial:///dev/ttyUSB0?buad=9600")).await;
        assert_eq!(error.part(), "buad");
        assert_eq!(error.problem(), "serial has no key `buad`: did you mean `baud`?");
        let lines: Vec<String> = error.to_string().lines().map(str::to_owned).collect();
        assert_eq!(lines[0], "serial has no key `buad`: did you mean `baud`?");
        assert_eq!(lines[2].trim(), "^^^^");

        let network = Network::new("cable", "tcp://127.0.0.1:0");
        let error = start(network.link(Link::to("module2", "10.0.0:7400").cost(3))).await;
        assert_eq!(error.part(), "10.0.0:7400");
    });
}

#[test]
fn two_nodes_speak_over_can_adapters_whatever_else_these_say() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let bus = Adapters::new();
        let network = |own: u8, peer: &str, at: &str| {
            bus.plug(own);
            bus.inject(own, b"\x07NOISE\rt1");
            let port = bus.port(own);
            let endpoint =
                format!("slcan://{}?bitrate=1000000&address={own}&insecure", port.display());
            Network::new("bus", &endpoint).peer(peer, at)
        };

        speak_over(network(1, "module2", "2"), network(2, "module1", "1")).await;
    });
}

#[test]
fn two_nodes_with_one_address_on_a_bus_are_a_fault_on_both_that_names_it() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let bus = Adapters::new();
        [1, 2].into_iter().for_each(|number| bus.plug(number));
        let start = async |own: &str, number: u8, peer: &str| {
            let port = bus.port(number);
            let endpoint = format!("slcan://{}?bitrate=1000000&address=1", port.display());
            let network = Network::new("bus", &endpoint).peer(peer, "2").insecure();
            Node::builder(own).network(network).start().await.expect("it starts")
        };
        let first = start("module1", 1, "module2").await;
        let second = start("module2", 2, "module1").await;

        let expected = "another node sends under this node's address 1";
        for node in [&first, &second] {
            let detail = async || {
                let record = node.faults().await;
                let mut faults = record.entries.into_iter().map(|entry| entry.fault.detail);
                faults.find(|detail| detail.contains(expected))
            };
            let detail = found(detail, expected).await;
            assert!(
                detail.contains("slcan ")
                    && detail.contains("give each node an address of its own")
            );
        }
        second.shutdown().await;
        first.shutdown().await;
    });
}
