//! Two ends of one cable.

use super::*;
use crate::testing::at;
use crate::{Incarnation, NodeName};

mod incarnations;
mod paths;
mod repeated;

fn config(name: &str, incarnation: u64) -> LinkConfig {
    LinkConfig {
        hello_interval: Duration::from_millis(10),
        ..LinkConfig::new(NodeName::new(name).unwrap(), Incarnation(incarnation))
    }
}

/// Two ends of one cable that takes a millisecond.
struct Cable {
    ends: [Link; 2],
    now: u64,
    cut: [bool; 2],
    /// Larger frames are lost.
    carries: usize,
    /// These ends are not run; what is sent to them waits.
    stopped: [bool; 2],
    in_flight: Vec<(u64, usize, Bytes)>,
    outputs: Vec<(u64, usize, LinkOutput)>,
    /// What the ends have sent.
    sent: Vec<(usize, Bytes)>,
}

impl Cable {
    fn new(left: LinkConfig, right: LinkConfig) -> Self {
        let ends = [Link::new(left, at(0)), Link::new(right, at(0))];
        Cable {
            ends,
            now: 0,
            cut: [false; 2],
            carries: usize::MAX,
            stopped: [false; 2],
            in_flight: vec![],
            outputs: vec![],
            sent: vec![],
        }
    }

    fn run_until(&mut self, end: u64) {
        while self.now < end {
            let (now, stopped) = (self.now, self.stopped);
            let arrives = |f: &mut (u64, usize, Bytes)| f.0 <= now && !stopped[f.1];
            let arrived: Vec<_> = self.in_flight.extract_if(.., arrives).collect();
            for (_, to, frame) in arrived {
                self.ends[to].handle_frame(frame, at(self.now));
            }
            for from in (0..2).filter(|from| !stopped[*from]) {
                if self.ends[from].poll_timeout().is_some_and(|due| due <= at(self.now)) {
                    self.ends[from].handle_timeout(at(self.now));
                }
                while let Some(output) = self.ends[from].poll_output() {
                    match output {
                        LinkOutput::Transmit(_) if self.cut[from] => {}
                        LinkOutput::Transmit(frame) => {
                            let frame = frame.into_bytes();
                            self.sent.push((from, frame.clone()));
                            if frame.len() <= self.carries {
                                self.in_flight.push((self.now + 1, 1 - from, frame));
                            }
                        }
                        other => self.outputs.push((self.now, from, other)),
                    }
                }
            }
            self.now += 1;
        }
    }

    fn run_while(&mut self, holds: impl Fn(&Cable) -> bool) {
        while holds(self) {
            self.run_until(self.now + 1);
        }
    }

    fn states(&self) -> [LinkState; 2] {
        [self.ends[0].state(), self.ends[1].state()]
    }
}

/// The first incarnation of this node says so.
fn hello(node: &str, sequence: u32, state: HelloState) -> Bytes {
    let (node, incarnation) = (NodeName::new(node).unwrap(), Incarnation(1));
    let hello = Hello {
        node,
        incarnation,
        sequence,
        interval_us: 10_000,
        skipped: 0,
        state,
        loss_permille: 0,
        echo: None,
    };
    Frame::Hello(hello).encode()
}

fn running() -> Cable {
    let mut cable = Cable::new(config("left", 1), config("right", 1));
    cable.run_until(100);
    assert_eq!(cable.states(), [LinkState::Up; 2]);
    cable.outputs.clear();
    cable
}

#[test]
fn a_link_is_up_once_both_ends_have_proved_that_they_hear_each_other() {
    let mut cable = Cable::new(config("left", 1), config("right", 1));

    cable.run_until(60);

    assert_eq!(cable.states(), [LinkState::Up; 2]);
    assert_eq!(cable.ends[0].neighbour().unwrap().node.as_str(), "right");
    assert_eq!(cable.ends[0].quality().round_trip, Some(Duration::from_millis(2)));
}

#[test]
fn a_neighbour_that_never_comes_is_told_as_missing_once() {
    let mut cable = Cable::new(config("left", 1), config("right", 1));
    cable.cut = [true, false];

    cable.run_until(5_040);
    assert_eq!(cable.outputs, []);
    cable.run_until(10_000);

    let missing = |at, end, hello_received| (at, end, LinkOutput::Missing { hello_received });
    assert_eq!(cable.outputs, [missing(5_050, 0, true), missing(5_050, 1, false)]);
    cable.cut = [false; 2];
    cable.run_until(10_100);
    assert_eq!(cable.states(), [LinkState::Up; 2]);
}

#[test]
fn a_wrong_neighbour_stays_the_reason_and_is_not_told_as_missing() {
    let arm = Some(NodeName::new("arm").unwrap());
    let left = LinkConfig { expected: arm, ..config("left", 1) };
    let mut cable = Cable::new(left, config("right", 1));

    cable.run_until(10_000);

    let of_left: Vec<_> = cable.outputs.iter().filter(|outputs| outputs.1 == 0).collect();
    let [(at, _, LinkOutput::Refused(PeerRefusal::WrongNeighbour { .. }))] = of_left[..] else {
        panic!("{of_left:?}")
    };
    assert!(*at < 5_000, "before the neighbour was missing");
    let of_right: Vec<_> = cable.outputs.iter().filter(|outputs| outputs.1 == 1).collect();
    assert!(
        matches!(of_right[..], [(_, _, LinkOutput::Missing { hello_received: true })]),
        "{of_right:?}"
    );
}

#[test]
fn who_takes_the_place_of_a_neighbour_is_known_when_the_link_goes_down_and_forgotten_with_it() {
    let mut cable = running();
    cable.cut = [true; 2];
    let hello = Frame::decode(cable.sent.iter().rfind(|sent| sent.0 == 1).unwrap().1.clone());
    let Ok(Frame::Hello(hello)) = hello else { panic!("{hello:?}") };
    let wrong = Frame::Hello(Hello { node: NodeName::new("leg").unwrap(), ..hello }).encode();
    for _ in 0..2 {
        cable.ends[0].handle_frame(wrong.clone(), at(cable.now));
    }

    cable.run_until(200);
    assert_eq!(cable.ends[0].state(), LinkState::Down);
    assert!(matches!(cable.ends[0].refusal(), Some(PeerRefusal::WrongNeighbour { .. })));

    cable.cut = [false; 2];
    cable.run_until(400);
    assert_eq!((cable.ends[0].state(), cable.ends[0].refusal()), (LinkState::Up, None));
}

#[test]
fn a_cut_cable_is_suspect_after_two_intervals_and_down_after_three_and_a_half() {
    let mut cable = running();

    cable.cut = [true; 2];
    cable.run_until(200);

    let of_left: Vec<_> = cable.outputs.iter().filter(|outputs| outputs.1 == 0).collect();
    // The last hello left at 90 and arrived at 91.
    assert!(matches!(of_left[0], (111, _, LinkOutput::Changed { state: LinkState::Suspect, .. })));
    assert!(matches!(of_left[1], (126, _, LinkOutput::Changed { state: LinkState::Down, .. })));
    assert_eq!(of_left.len(), 2);
}

#[test]
fn a_cable_that_carries_one_way_only_is_down_at_both_ends() {
    let mut cable = running();

    cable.cut = [true, false];
    cable.run_until(300);

    assert_eq!(cable.states(), [LinkState::Down; 2]);
}

#[test]
fn data_shows_that_the_neighbour_lives_while_its_hellos_wait_and_not_that_it_receives() {
    let mut cable = running();
    cable.cut = [true; 2];
    let down = (100..300).find(|now| {
        cable.run_until(*now);
        if now % 5 == 0 {
            let frame = Frame::Data(Bytes::from_static(b"data").into()).encode();
            cable.ends[0].handle_frame(frame, at(*now));
        }
        cable.ends[0].state() == LinkState::Down
    });
    // The last echo arrived at 91. Without data it is down at 126.
    assert!(down.is_some_and(|down| (150..170).contains(&down)), "{down:?}");

    let states = cable.outputs.iter().filter_map(|(_, end, output)| match output {
        LinkOutput::Changed { state, .. } if *end == 0 => Some(*state),
        _ => None,
    });
    assert_eq!(states.last(), Some(LinkState::Down));
}

#[test]
fn a_hello_that_waited_while_both_nodes_were_stopped_makes_the_next_one_no_strange_one() {
    let mut cable = running();
    // A hello of the right waits to be read; both nodes are stopped for five seconds.
    cable.run_until(110);
    let waits = cable.ends[1].hello(at(110), 11);
    cable.ends[0].handle_frame(Frame::Hello(waits).encode(), at(5_110));
    cable.now = 5_110;
    cable.in_flight.clear();

    cable.run_until(5_400);

    assert_eq!(cable.states(), [LinkState::Up; 2]);
    let went = |state| {
        cable.outputs.iter().any(
            |(_, _, output)| matches!(output, LinkOutput::Changed { state: s, .. } if *s == state),
        )
    };
    assert!(!went(LinkState::Down), "{:?}", cable.outputs);
}

#[test]
fn a_link_that_was_down_must_prove_itself_longer_each_time() {
    let mut cable = running();
    let mut outages = vec![];
    for _ in 0..3 {
        cable.cut = [true; 2];
        cable.run_until(cable.now + 100);
        cable.cut = [false; 2];
        let back = cable.now;
        cable.run_while(|cable| cable.ends[0].state() != LinkState::Up);
        outages.push(cable.now - back);
    }
    assert!(outages[0] < outages[1] && outages[1] < outages[2], "{outages:?}");
}

/// A cable that has just failed, and whose left end wants more proof than the right one.
fn wary_on_the_left() -> Cable {
    let mut cable = running();
    cable.ends[0].config.up_after_hellos *= 8;
    cable.ends[0].handle_loss(at(cable.now));
    assert_eq!(cable.ends[0].state(), LinkState::Down, "at once");
    cable.run_until(cable.now + 15);
    cable
}

#[test]
fn a_link_is_used_by_both_ends_or_by_neither() {
    let mut cable = wary_on_the_left();
    assert_eq!(cable.states(), [LinkState::Down; 2], "the neighbour is taken along");

    let mut apart = 0;
    while cable.states() != [LinkState::Up; 2] {
        cable.run_until(cable.now + 1);
        apart += u32::from(cable.ends[0].carries() != cable.ends[1].carries());
    }

    assert!(apart <= 12, "not longer than until the next hello: {apart} ms");
}

#[test]
fn what_a_neighbour_sends_that_is_ready_earlier_is_taken_and_brings_nothing_up() {
    let mut cable = wary_on_the_left();
    cable.run_while(|cable| !cable.ends[1].has_proved());
    assert_eq!(cable.ends[1].state(), LinkState::Down);

    let packet = Bytes::from_static(b"packet");
    cable.ends[1].handle_frame(Frame::Data(packet.clone().into()).encode(), at(cable.now));

    assert_eq!(cable.ends[1].poll_output(), Some(LinkOutput::Packet(packet)));
    assert_eq!(cable.ends[1].state(), LinkState::Down, "its hellos say that it is ready");
}

#[test]
fn a_cable_that_flaps_proves_nothing() {
    let mut cable = running();
    for carries in [false, true].repeat(50) {
        cable.cut = [!carries; 2];
        cable.run_until(cable.now + 40);
        cable.outputs.retain(|outputs| matches!(outputs.2, LinkOutput::Changed { .. }));
    }

    let up = |outputs: &&(u64, usize, LinkOutput)| {
        matches!(outputs.2, LinkOutput::Changed { state: LinkState::Up, .. })
    };
    assert!(cable.outputs.iter().filter(up).count() <= 4, "{:?}", cable.outputs);
    cable.cut = [false; 2];
    cable.run_until(cable.now + 1000);
    assert_eq!(cable.states(), [LinkState::Up; 2]);
}

#[test]
fn a_link_that_failed_again_and_again_is_the_last_that_is_used_until_it_has_proved_itself() {
    let mut cable = running();
    for _ in 0..5 {
        cable.cut = [true; 2];
        cable.run_until(cable.now + 100);
        assert_eq!(cable.states(), [LinkState::Down; 2]);
        cable.cut = [false; 2];
        cable.run_until(cable.now + 60);
        assert!(cable.ends.iter().all(Link::carries), "there may be no other way");
    }

    assert!(cable.ends.iter().all(Link::is_proving));
    cable.run_until(cable.now + 300);
    assert!(cable.ends.iter().all(Link::is_proving));
    cable.run_until(cable.now + 300);
    assert_eq!(cable.states(), [LinkState::Up; 2]);
}

#[test]
fn a_link_whose_carrier_comes_and_goes_begins_its_proof_anew_each_time() {
    let mut cable = running();
    for _ in 0..20 {
        cable.ends[0].handle_no_carrier("no carrier", at(cable.now));
        assert_eq!(cable.ends[0].state(), LinkState::Down);
        cable.run_until(cable.now + 45);
        assert_ne!(cable.ends[0].state(), LinkState::Up);
    }
}

#[test]
fn hellos_take_a_twentieth_of_a_slow_medium_and_the_neighbour_keeps_up() {
    // 9600 baud, ten bits a byte: 52 bytes of hello are 54 ms of it.
    let mut cable = running();
    cable.ends.iter_mut().for_each(|end| end.set_interval(end.interval_at(960, 0)));

    let interval = cable.ends[0].hello_interval();
    assert!(interval > Duration::from_millis(1000), "{interval:?}");
    cable.run_until(20_000);
    assert_eq!(cable.states(), [LinkState::Up; 2]);

    let mut fast = Link::new(config("left", 1), at(0));
    fast.set_interval(fast.interval_at(1_000_000, 0));
    assert_eq!(fast.hello_interval(), Duration::from_millis(10));
}

#[test]
fn a_node_that_is_run_late_loses_no_hellos_and_adds_nothing_to_its_round_trips() {
    let mut cable = running();
    for step in 0..4_000 {
        cable.stopped[0] = step % 25 != 0;
        cable.run_until(cable.now + 1);
    }

    let [late, other] = [0, 1].map(|end| cable.ends[end].quality());
    assert_eq!((late.loss_permille, other.loss_permille), (0, 0));
    assert!(late.round_trip < Some(Duration::from_millis(12)), "{late:?}");
}

#[test]
fn an_observer_that_is_a_little_late_first_reads_what_has_come() {
    let mut cable = running();
    let due = cable.ends[0].silent_at(Link::SUSPECT_AFTER_PERCENT).unwrap();

    cable.ends[0].handle_timeout(due + Duration::from_millis(5));

    assert_eq!(cable.ends[0].state(), LinkState::Up);
    // It cannot excuse itself for ever.
    let mut now = due;
    while cable.ends[0].state() == LinkState::Up {
        now = cable.ends[0].poll_timeout().unwrap() + Duration::from_millis(5);
        cable.ends[0].handle_timeout(now);
    }
    assert!(now - due < Duration::from_millis(100), "{:?}", now - due);
}

#[test]
fn a_link_that_is_suspect_over_and_over_is_heard_longer_each_time_before_it_is_trusted() {
    let mut cable = running();
    let mut spans = vec![];
    for _ in 0..4 {
        cable.cut = [true; 2];
        cable.run_while(|cable| cable.ends[0].state() != LinkState::Suspect);
        assert!(!cable.ends[0].is_proving());
        cable.cut = [false; 2];
        let back = cable.now;
        let mut proving = false;
        while cable.ends[0].state() != LinkState::Up {
            cable.run_until(cable.now + 1);
            proving |= cable.ends[0].is_proving();
        }
        spans.push((cable.now - back, proving));
        cable.run_until(cable.now + 200);
    }
    assert!(spans.is_sorted() && !spans[0].1 && spans[3].1 && spans[3].0 > 60, "{spans:?}");
}

#[test]
fn a_restarted_neighbour_is_a_new_incarnation_and_the_old_one_is_never_heard_again() {
    let mut cable = running();
    let old_hello = hello("right", 1000, HelloState::Ready);

    cable.ends[1] = Link::new(config("right", 2), at(cable.now));
    cable.run_until(300);
    cable.ends[0].handle_frame(old_hello, at(300));

    assert_eq!(cable.states(), [LinkState::Up; 2]);
    assert_eq!(cable.ends[0].neighbour().unwrap().incarnation, Incarnation(2));
    assert_eq!(cable.ends[0].refusals().stale, 1);
    let downs = cable.outputs.iter().filter(|outputs| {
        matches!(outputs, (_, 0, LinkOutput::Changed { state: LinkState::Down, .. }))
    });
    assert_eq!(downs.count(), 1);
}

#[test]
fn a_neighbour_that_restarts_over_and_over_is_taken_each_time_as_soon_as_the_first() {
    let mut cable = running();
    let mut outages = Vec::new();
    for incarnation in 2..8 {
        cable.cut = [true; 2];
        cable.run_until(cable.now + 100);
        cable.cut = [false; 2];
        cable.ends[1] = Link::new(config("right", incarnation), at(cable.now));
        let back = cable.now;
        cable.run_while(|cable| cable.states() != [LinkState::Up; 2]);
        outages.push(cable.now - back);
        cable.run_until(cable.now + 50);
    }
    assert!(outages.iter().all(|outage| *outage <= 60), "{outages:?}");
}

#[test]
fn an_observer_that_stood_still_suspects_nobody() {
    let mut cable = running();

    cable.ends[0].handle_timeout(at(5000));

    assert_eq!(cable.ends[0].state(), LinkState::Up);
    assert!(cable.ends[0].poll_timeout().unwrap() > at(5000));
    cable.ends[0].handle_timeout(at(5010));
    cable.ends[0].handle_timeout(at(5020));
    assert_eq!(cable.ends[0].state(), LinkState::Up);
    cable.ends[0].handle_timeout(at(5025));
    assert_eq!(cable.ends[0].state(), LinkState::Down, "silent after the stall, too");
}

#[test]
fn a_link_whose_interface_lost_its_carrier_is_down_at_once_and_hellos_bring_it_back() {
    let mut cable = running();

    cable.ends[0].handle_no_carrier("no carrier", at(100));

    assert_eq!(cable.ends[0].state(), LinkState::Down);
    cable.run_until(300);
    assert_eq!(cable.states(), [LinkState::Up; 2], "a driver may be wrong, and hellos never are");
}

#[test]
fn data_passes_only_while_the_link_carries() {
    let mut cable = Cable::new(config("left", 1), config("right", 1));
    let packet = Frame::Data(Bytes::from_static(b"packet").into()).encode();

    cable.ends[0].handle_packet(Bytes::from_static(b"too early"));
    cable.ends[0].handle_frame(packet.clone(), at(0));
    assert_eq!((cable.ends[0].frames_dropped(), cable.ends[0].refusals().unexpected), (1, 1));

    let mut cable = running();
    cable.ends[0].handle_frame(packet, at(100));
    let packet = LinkOutput::Packet(Bytes::from_static(b"packet"));
    assert_eq!(cable.ends[0].poll_output(), Some(packet));
}

#[test]
fn a_stranger_a_namesake_and_a_foreign_release_are_refused_and_told_once() {
    let mut link = Link::new(
        LinkConfig { expected: Some(NodeName::new("arm").unwrap()), ..config("base", 7) },
        at(0),
    );
    let hello = |name| hello(name, 1, HelloState::Unproved);

    for _ in 0..3 {
        link.handle_frame(hello("leg"), at(1));
    }
    link.handle_frame(hello("base"), at(2));
    link.handle_frame(hello("base"), at(2));
    link.handle_frame(Bytes::from_static(&[0xb9, 0]), at(3));

    let node = |name| NodeName::new(name).unwrap();
    let (expected, found) = (node("arm"), node("leg"));
    let wrong = PeerRefusal::WrongNeighbour { expected, found };
    assert_eq!(link.poll_output(), Some(LinkOutput::Refused(wrong)));
    let namesake = PeerRefusal::NameTaken { node: node("base") };
    assert_eq!(link.poll_output(), Some(LinkOutput::Refused(namesake)));
    assert_eq!(link.poll_output(), None);
    assert_eq!((link.refusals().unexpected, link.refusals().version), (5, 1));
}

#[test]
fn loss_alone_hardly_ever_takes_a_link_down() {
    let mut cable = running();
    // Linear congruences (Numerical Recipes) decide over each frame: 15 % are lost.
    let mut chance = 1u32;
    for _ in 0..10_000 {
        let mut lost = || {
            chance = chance.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            chance >> 16 < 65_536 * 15 / 100
        };
        cable.cut = [lost(), lost()];
        cable.run_until(cable.now + 10);
    }

    let down = |outputs: &&(u64, usize, LinkOutput)| {
        matches!(outputs.2, LinkOutput::Changed { state: LinkState::Down, .. })
    };
    // Both ends together; with three and a half intervals it would be some sixty.
    assert!(cable.outputs.iter().filter(down).count() <= 6);
}

#[test]
fn an_outage_counts_as_no_loss_once_it_is_over() {
    let mut cable = running();
    for _ in 0..3 {
        cable.cut = [true; 2];
        cable.run_until(cable.now + 45);
        cable.cut = [false; 2];
        cable.run_until(cable.now + 1000);
    }
    assert_eq!(cable.states(), [LinkState::Up; 2]);
    assert_eq!(cable.ends[0].quality().loss_permille, 0);
}

#[test]
fn a_link_that_loses_too_much_is_degraded_until_it_is_much_better() {
    let mut cable = running();
    let mut number = 0;
    let mut lossy = |cable: &mut Cable, lost_of_ten: u64, rounds: u64| {
        for _ in 0..rounds * 10 {
            number += 1;
            cable.cut = [false, number % 10 < lost_of_ten];
            cable.run_until(cable.now + 10);
        }
    };

    lossy(&mut cable, 2, 8);
    assert!(cable.ends[0].quality().degraded);
    lossy(&mut cable, 0, 8);

    assert!(!cable.ends[0].quality().degraded);
    let outputs = |end| {
        let of_end = cable.outputs.iter().filter(move |outputs| outputs.1 == end);
        of_end.filter(|outputs| matches!(outputs.2, LinkOutput::Quality(_))).count()
    };
    assert_eq!([outputs(0), outputs(1)], [2, 2], "who loses hellos says so to who sent them");
}
