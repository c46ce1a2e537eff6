//! A path of 8 Mbit/s with a FIFO of a second before it, over real sockets: what is large fills it,
//! and nothing else may suffer. Judged by counts and order.
//!
//! ```text
//!   robot ── network ── FIFO of 1 MB, 8 Mbit/s each way ── network ── desk
//!   wheels ◄──────────────────── commands ────────────────────────── stick
//!   camera ───────────────────── images ───────────────────────────► screen
//!   screen ◄──────────────────── maps ─────────────────────────────── desk
//! ```
#![allow(clippy::print_stderr, reason = "a trial shows what it has measured")]

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Blob, Hold, Network, NodeBuilder, ServiceSpec, StandbyKind, Stateful,
};
use blastema_tests::{MS, Notes, Part, RobotKeys, free_addresses, moves, until};
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};
use tokio::net::TcpSocket;

const PATIENCE: Duration = Duration::from_secs(60);
/// Bytes a second.
const RATE: u64 = 1_000_000;
/// What the FIFO holds: a second.
const DEPTH: usize = 1_000_000;
/// An image, and a map.
const IMAGE: usize = 300_000;
/// So long all is sent.
const LASTS: Duration = Duration::from_secs(12);

/// What waits for the wire in one direction, and what has gone over it.
#[derive(Default)]
struct Fifo {
    waiting: Mutex<(VecDeque<Vec<u8>>, usize)>,
    changed: Condvar,
    carried: AtomicU64,
    dropped: AtomicU64,
}

impl Fifo {
    /// Takes a datagram, or drops it.
    fn offer(&self, bytes: &[u8]) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if waiting.1 + bytes.len() > DEPTH {
            self.dropped.fetch_add(1, Relaxed);
            return;
        }
        waiting.1 += bytes.len();
        waiting.0.push_back(bytes.to_vec());
        self.changed.notify_all();
    }

    /// Takes a piece of a stream once there is room.
    fn push(&self, bytes: &[u8]) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        while waiting.1 + bytes.len() > DEPTH {
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        waiting.1 += bytes.len();
        waiting.0.push_back(bytes.to_vec());
        self.changed.notify_all();
    }

    /// Hands over what waits, as fast as the wire is, until `send` refuses.
    fn carry(&self, mut send: impl FnMut(&[u8]) -> bool) {
        let mut free_at = Instant::now();
        loop {
            let next = {
                let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
                while waiting.0.is_empty() {
                    waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
                }
                waiting.0.front().cloned().expect("something waits")
            };
            let length = next.len() as u64;
            free_at =
                free_at.max(Instant::now()) + Duration::from_nanos(length * 1_000_000_000 / RATE);
            while let left = free_at.saturating_duration_since(Instant::now())
                && !left.is_zero()
            {
                thread::park_timeout(left);
            }
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            waiting.0.pop_front();
            waiting.1 -= next.len();
            self.changed.notify_all();
            drop(waiting);
            self.carried.fetch_add(length, Relaxed);
            if !send(&next) {
                return;
            }
        }
    }
}

/// The slow wire: where each end finds the other.
struct SlowWire {
    ends: [SocketAddr; 2],
    fifos: [Arc<Fifo>; 2],
}

impl SlowWire {
    fn udp(nodes: [SocketAddr; 2]) -> Self {
        let sockets = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").expect("a free port"));
        let ends = [0, 1].map(|end: usize| sockets[end].local_addr().expect("it is bound"));
        let fifos = [(); 2].map(|()| Arc::new(Fifo::default()));
        for end in 0..2 {
            let (from, fifo) = (sockets[end].try_clone().expect("a socket"), fifos[end].clone());
            let out = sockets[1 - end].try_clone().expect("a socket");
            let carried = fifo.clone();
            thread::spawn(move || {
                let mut bytes = [0; 65_536];
                while let Ok((length, _)) = from.recv_from(&mut bytes) {
                    fifo.offer(&bytes[..length]);
                }
            });
            thread::spawn(move || {
                carried.carry(|bytes| {
                    let _ = out.send_to(bytes, nodes[1 - end]);
                    true
                });
            });
        }
        SlowWire { ends, fifos }
    }

    /// A node is known by its host and its own port: the wire has a host for each end.
    fn tcp(nodes: [SocketAddr; 2]) -> Self {
        let hosts: [IpAddr; 2] = [[127, 0, 0, 2].into(), [127, 0, 0, 3].into()];
        let ends = [0, 1].map(|end| SocketAddr::new(hosts[end], nodes[1 - end].port()));
        let fifos = [(); 2].map(|()| Arc::new(Fifo::default()));
        for (end, at) in ends.into_iter().enumerate() {
            let listener = TcpListener::bind(at).expect("a free port");
            let fifos = fifos.clone();
            thread::spawn(move || {
                while let Ok((near, _)) = listener.accept() {
                    let far = connect(SocketAddr::new(hosts[1 - end], 0), nodes[1 - end]);
                    let Ok(far) = far else { continue };
                    pump(&near, &far, fifos[end].clone());
                    pump(&far, &near, fifos[1 - end].clone());
                }
            });
        }
        SlowWire { ends, fifos }
    }
}

/// A connection that comes from this address.
fn connect(from: SocketAddr, to: SocketAddr) -> io::Result<TcpStream> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
    let stream = runtime.block_on(async {
        let socket = TcpSocket::new_v4()?;
        socket.bind(from)?;
        socket.connect(to).await?.into_std()
    })?;
    stream.set_nonblocking(false)?;
    Ok(stream)
}

/// Carries what comes from one end of a connection to the other. Connections have a FIFO each, and
/// its counters in common.
fn pump(from: &TcpStream, to: &TcpStream, counters: Arc<Fifo>) {
    let (mut from, mut to) =
        (from.try_clone().expect("a socket"), to.try_clone().expect("a socket"));
    // A wire does not wait for more to carry, as Nagle's algorithm would here.
    to.set_nodelay(true).expect("it is TCP");
    let fifo = Arc::new(Fifo::default());
    let carried = fifo.clone();
    thread::spawn(move || {
        let mut bytes = [0; 4_096];
        while let Ok(length @ 1..) = from.read(&mut bytes) {
            fifo.push(&bytes[..length]);
        }
    });
    thread::spawn(move || {
        carried.carry(|bytes| {
            counters.carried.fetch_add(bytes.len() as u64, Relaxed);
            let is_sent = to.write_all(bytes).is_ok();
            if !is_sent {
                let _ = to.shutdown(Shutdown::Both);
            }
            is_sent
        });
    });
}

#[derive(Clone, Debug, Event)]
#[contract(name = "slow/image", max_size = 1 << 20, bulk)]
struct Image {
    number: u32,
    pixels: Blob,
}

/// An image of which the newest counts.
#[derive(Clone, Debug, Event)]
#[contract(name = "slow/live", delivery = "newest", max_size = 1 << 20)]
struct Live(Image);

#[derive(Clone, Debug, Request)]
#[contract(name = "slow/map", reply = u32, max_size = 1 << 20, bulk)]
struct Map(Blob);

#[derive(Clone, Debug, Request)]
#[contract(name = "slow/drive", reply = f32)]
struct Drive(f32);

fn wheels(name: &str) -> ChildSpec<Part<(), Drive>> {
    moves(name, ActuatorSpec::new(Drive(0.0), Hold), (), |(), Drive(speed), _| speed)
}

struct Screen(Notes<u32>);

impl Component for Screen {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Map>();
        ports.listen::<Image>().on("camera");
        ports.listen::<Live>().on("live");
    }
}

impl Handle<Map> for Screen {
    async fn handle(&mut self, Map(map): Map, _: &mut Context<Self>) -> u32 {
        map.len() as u32
    }
}

impl Handle<Image> for Screen {
    async fn handle(&mut self, image: Image, _: &mut Context<Self>) {
        assert_eq!(image.pixels.len(), IMAGE);
        self.0.note(image.number);
    }
}

impl Handle<Live> for Screen {
    async fn handle(&mut self, Live(image): Live, cx: &mut Context<Self>) {
        Handle::<Image>::handle(self, image, cx).await;
    }
}

/// How images are sent.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Film {
    /// All of them, as fast as they are taken.
    Whole,
    /// Thirty a second: nine times what the wire carries.
    Live,
}

/// How many nodes pass on what the two say, before the slow wire.
#[derive(Clone, Copy)]
enum Relays {
    None,
    One,
}

fn pixels() -> Blob {
    vec![7; IMAGE].into()
}

/// Commands wheels until then: how often, and how long the longest command took.
async fn drive(node: &Node, wheels: &str, ends: Instant) -> (u32, Duration) {
    let stick = node.commander::<Drive>(wheels, "stick").expect("a name");
    stick.claim().await.expect("the wheels are free");
    let (mut driven, mut longest) = (0, Duration::ZERO);
    while Instant::now() < ends {
        let asked = Instant::now();
        // Within the lease, or it is lost.
        let speed = stick.command(Drive(1.0)).await.expect("commands pass what is large");
        assert_eq!(speed, 1.0);
        longest = longest.max(asked.elapsed());
        driven += 1;
        tokio::time::sleep(20 * MS).await;
    }
    (driven, longest)
}

/// A node with the key of its name, on this network.
fn sealed(own: &str, keys: &RobotKeys, network: Network) -> NodeBuilder {
    Node::builder(own).keys(keys.of(own)).network(network)
}

/// Sends images one way and, as fast as they are taken, maps the other, and commands beside them.
fn beside_images(
    film: Film,
    relays: Relays,
    medium: fn(&'static str, SocketAddr) -> Network,
    wire: fn([SocketAddr; 2]) -> SlowWire,
) {
    blastema::run(async {
        let [robot_at, desk_at, fast_at, relay_at]: [SocketAddr; 4] =
            free_addresses(4).try_into().expect("four");
        let wire = wire([robot_at, desk_at]);
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &["robot", "desk", "relay"], 1);
        let seen = Notes::default();
        let shown = seen.clone();
        let near = medium("net0", robot_at).peer("desk", &wire.ends[0].to_string());
        let far = medium("net0", desk_at);
        let (near, far, relay) = match relays {
            Relays::None => (near, far.peer("robot", &wire.ends[1].to_string()), None),
            Relays::One => {
                let fast = |name, at: SocketAddr, peer, to: SocketAddr| {
                    medium(name, at).peer(peer, &to.to_string())
                };
                let relay = sealed("relay", &keys, fast("net1", relay_at, "robot", fast_at));
                let relay = relay.network(near).start().await.expect("it starts");
                let robot = fast("net1", fast_at, "relay", relay_at);
                (robot, far.peer("relay", &wire.ends[1].to_string()), Some(relay))
            }
        };
        let robot = sealed("robot", &keys, near)
            .child(wheels("wheels"))
            .child(ChildSpec::new("screen", || Screen(Notes::default())))
            .start()
            .await
            .expect("it starts");
        let desk = sealed("desk", &keys, far)
            .child(ChildSpec::new("screen", move || Screen(shown.clone())))
            .start()
            .await
            .expect("it starts");
        assert!(desk.connected("robot", PATIENCE).await && robot.connected("desk", PATIENCE).await);

        let ends = Instant::now() + LASTS;
        let camera = async {
            let all = robot.publisher::<Image>("camera").expect("a name");
            let live = robot.publisher::<Live>("live").expect("a name");
            let mut taken = 0;
            while Instant::now() < ends {
                let image = Image { number: taken, pixels: pixels() };
                match film {
                    Film::Whole => all.deliver(image).await.expect("the way has capacity again"),
                    Film::Live => {
                        live.publish(Live(image)).expect("it is encoded");
                        tokio::time::sleep(33 * MS).await;
                    }
                }
                taken += 1;
            }
            taken
        };
        let maps = async |from: Option<&Node>, to: &str| {
            let Some(from) = from else { return 0 };
            let screen = from.sender::<Map>(to).expect("a name");
            let mut shown = 0;
            while Instant::now() < ends {
                let asked = screen.ask_within(Map(pixels()), PATIENCE).await;
                assert_eq!(asked.ok(), Some(IMAGE as u32));
                shown += 1;
            }
            shown
        };
        // A relay has maps of its own, in another session over the same wire.
        let (taken, shown, beside, (driven, longest)) = tokio::join!(
            camera,
            maps(Some(&desk), "robot:screen"),
            maps(relay.as_ref(), "desk:screen"),
            drive(&desk, "robot:wheels", ends)
        );

        let has_come = async || seen.lock().last() == Some(&(taken - 1));
        until(has_come, "the last one arrives").await;
        let seen = seen.all();
        match film {
            Film::Whole => assert_eq!(seen, (0..taken).collect::<Vec<_>>()),
            Film::Live => assert!(seen.is_sorted(), "{seen:?}"),
        }
        for node in [&robot, &desk].into_iter().chain(&relay) {
            let faults = node.faults().await.entries;
            assert!(faults.is_empty(), "nothing is wrong on {}: {faults:?}", node.name());
            assert_eq!(node.dead_letters().counts(), []);
        }
        // What was repeated in vain would be here as well.
        let carried = wire.fifos.each_ref().map(|fifo| fifo.carried.load(Relaxed));
        let payload = [seen.len() as u64 + beside, shown].map(|count| count * IMAGE as u64);
        let totals = format!(
            "{carried:?} for {payload:?}, {beside} of them beside, {driven} commands, the longest {longest:?}"
        );
        eprintln!("{totals}");
        assert!(seen.len() > 10 && shown > 5 && driven > 20, "all went on: {totals}");
        assert!(relay.is_none() || beside > 3, "each session has its share: {totals}");
        assert!(carried.iter().zip(payload).all(|(all, of)| all * 10 < of * 11), "{totals}");
        assert!(wire.fifos.iter().all(|fifo| fifo.dropped.load(Relaxed) == 0));
        for node in [robot, desk].into_iter().chain(relay) {
            node.shutdown().await;
        }
    });
}

#[test]
fn a_slow_wire_over_udp_is_filled_and_nothing_waits_for_what_is_large() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    beside_images(Film::Whole, Relays::None, Network::udp, SlowWire::udp);
    beside_images(Film::Live, Relays::None, Network::udp, SlowWire::udp);
    beside_images(Film::Whole, Relays::One, Network::udp, SlowWire::udp);
}

#[test]
fn a_slow_wire_over_tcp_is_filled_and_nothing_waits_for_what_is_large() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    beside_images(Film::Whole, Relays::One, Network::tcp, SlowWire::tcp);
    beside_images(Film::Live, Relays::None, Network::tcp, SlowWire::tcp);
    beside_images(Film::Whole, Relays::None, Network::tcp, SlowWire::tcp);
}

#[derive(Clone, Debug, Request)]
#[contract(name = "slow/paint", reply = u64)]
struct Paint(u8);

/// A map that each request paints.
struct Atlas {
    colour: u8,
    painted: u64,
}

impl Component for Atlas {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Paint>();
    }
}

impl Handle<Paint> for Atlas {
    async fn handle(&mut self, Paint(colour): Paint, _: &mut Context<Self>) -> u64 {
        self.colour = colour;
        self.painted += 1;
        self.painted
    }
}

impl Stateful for Atlas {
    fn save(&self) -> Vec<u8> {
        let mut state = vec![self.colour; IMAGE];
        state.extend(self.painted.to_le_bytes());
        state
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        let (map, painted) = state.split_at(IMAGE);
        self.colour = map[0];
        self.painted = u64::from_le_bytes(painted.try_into().map_err(|_| Failure::from("no sum"))?);
        Ok(())
    }
}

/// A service replicates a state that takes the wire a third of a second, again and again: it keeps
/// its primary, and commands keep their leases.
fn beside_the_state_of_a_service(
    medium: fn(&'static str, SocketAddr) -> Network,
    wire: fn([SocketAddr; 2]) -> SlowWire,
) {
    blastema::run(async {
        let [robot_at, desk_at]: [SocketAddr; 2] = free_addresses(2).try_into().expect("two");
        let wire = wire([robot_at, desk_at]);
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &["robot", "desk"], 1);
        let atlas = || {
            let begin = || Atlas { colour: 0, painted: 0 };
            // What replicas say goes in order: a lease has to outlast the state on its way.
            let atlas = ServiceSpec::new("atlas", ["robot", "desk"], begin);
            atlas.standby(StandbyKind::Warm).heartbeat_every(300 * MS)
        };
        let near = medium("net0", robot_at).peer("desk", &wire.ends[0].to_string());
        let far = medium("net0", desk_at).peer("robot", &wire.ends[1].to_string());
        let robot = sealed("robot", &keys, near)
            .child(wheels("wheels"))
            .service(atlas())
            .start()
            .await
            .expect("it starts");
        let desk = sealed("desk", &keys, far)
            .child(wheels("levers"))
            .service(atlas())
            .start()
            .await
            .expect("it starts");
        assert!(desk.connected("robot", PATIENCE).await && robot.connected("desk", PATIENCE).await);

        let ends = Instant::now() + LASTS;
        let paint = async {
            let atlas = desk.service::<Paint>("atlas").expect("a name");
            let mut painted = 0;
            while Instant::now() < ends {
                let asked = atlas.ask_within(Paint(painted as u8 + 1), PATIENCE).await;
                painted += 1;
                assert_eq!(asked.ok(), Some(painted));
            }
            painted
        };
        let (painted, there, back) = tokio::join!(
            paint,
            drive(&desk, "robot:wheels", ends),
            drive(&robot, "desk:levers", ends)
        );

        let totals = format!("{painted} states, commands {there:?} and {back:?}");
        eprintln!("{totals}");
        for node in [&robot, &desk] {
            let faults = node.faults().await.entries;
            assert!(faults.is_empty(), "nothing is wrong on {}: {faults:?}", node.name());
        }
        assert!(painted > 5 && there.0 > 20 && back.0 > 20, "all went on: {totals}");
        robot.shutdown().await;
        desk.shutdown().await;
    });
}

#[test]
fn a_service_keeps_its_primary_while_its_state_fills_a_slow_wire() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    beside_the_state_of_a_service(Network::udp, SlowWire::udp);
    beside_the_state_of_a_service(Network::tcp, SlowWire::tcp);
}
