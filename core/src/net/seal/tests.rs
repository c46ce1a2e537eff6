//! Two nodes and what an attacker on their medium does, with the product's cryptography.

use super::*;
use crate::testing::at;

mod attacks;
mod keys;

const LEFT: NodeId = NodeId(1);
const RIGHT: NodeId = NodeId(2);

type End = Sealer<NoiseCrypto, u32>;

fn secret(node: NodeId) -> [u8; 32] {
    [node.0 as u8 + 0x10; 32]
}

fn config(node: NodeId, incarnation: u64) -> SealerConfig {
    SealerConfig::new(node, Incarnation(incarnation), "ranger")
}

/// A node that knows the other by its key. No two that are made have the same seed.
fn end(config: SealerConfig, now: Instant, seed: u8) -> End {
    let (node, crypto) = (config.node, NoiseCrypto::new(secret(config.node)));
    let mut end = Sealer::new(config, crypto, [seed; 32], now);
    for peer in [LEFT, RIGHT] {
        if peer != node {
            let public = NoiseCrypto::new(secret(peer)).public_key();
            end.add_peer(peer, &public).unwrap();
        }
    }
    end
}

/// Whether a frame is lost: when, from which end, and the frame.
type Loss = Box<dyn FnMut(u64, usize, &Bytes) -> bool>;

/// Two ends, whose addresses are their places, on a medium that takes a millisecond.
struct Medium {
    ends: [End; 2],
    now: u64,
    loses: Loss,
    in_flight: Vec<(u64, usize, Bytes)>,
    /// All that was sent, from which end.
    sent: Vec<(usize, Bytes)>,
    opened: Vec<(usize, OpenedFrame)>,
    events: Vec<(usize, SealerOutput<u32>)>,
}

impl Medium {
    fn new(left: SealerConfig, right: SealerConfig) -> Self {
        Medium {
            ends: [end(left, at(0), 1), end(right, at(0), 2)],
            now: 0,
            loses: Box::new(|_, _, _| false),
            in_flight: vec![],
            sent: vec![],
            opened: vec![],
            events: vec![],
        }
    }

    /// After the handshake that this end has asked for.
    fn open(by: usize) -> Self {
        let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
        medium.connect(by);
        medium.run_until(20);
        assert_eq!(medium.open_ends(), [true; 2]);
        medium.events.clear();
        medium
    }

    fn connect(&mut self, by: usize) {
        let (peer, now) = (peer_of(by), at(self.now));
        self.ends[by].connect(peer, 1 - by as u32, now);
    }

    fn send(&mut self, from: usize, text: &str) -> Option<Bytes> {
        let (peer, now) = (peer_of(from), at(self.now));
        let frame = self.ends[from].seal(peer, FrameLane::Usual, &[text.as_bytes()], now)?;
        self.put(from, frame.clone());
        Some(frame)
    }

    fn put(&mut self, from: usize, frame: Bytes) {
        if !(self.loses)(self.now, from, &frame) {
            self.in_flight.push((self.now + 1, from, frame.clone()));
        }
        self.sent.push((from, frame));
    }

    fn deliver(&mut self, from: usize, frame: Bytes) -> Result<(), OpenError> {
        let to = 1 - from;
        let opened = self.ends[to].handle_frame(frame, &(from as u32), at(self.now))?;
        self.opened.extend(opened.map(|frame| (to, frame)));
        Ok(())
    }

    fn run_until(&mut self, end: u64) {
        while self.now < end {
            let arrived: Vec<_> = self.in_flight.extract_if(.., |f| f.0 <= self.now).collect();
            for (_, from, frame) in arrived {
                let _ = self.deliver(from, frame);
            }
            for from in 0..2 {
                let end = &mut self.ends[from];
                if end.poll_timeout().is_some_and(|due| due <= at(self.now)) {
                    end.handle_timeout(at(self.now));
                }
                end.handle_turn(at(self.now));
                while let Some(output) = self.ends[from].poll_output() {
                    match output {
                        SealerOutput::Transmit { frame, .. } => self.put(from, frame),
                        event => self.events.push((from, event)),
                    }
                }
            }
            self.now += 1;
        }
    }

    fn open_ends(&self) -> [bool; 2] {
        [0, 1].map(|end| self.ends[end].channel(peer_of(end)).is_some())
    }

    /// Text goes both ways. Returns nothing, and fails if it does not.
    #[track_caller]
    fn assert_talks(&mut self) {
        self.opened.clear();
        let frames = [self.send(0, "there"), self.send(1, "back")];
        assert!(frames.iter().all(Option::is_some), "{:?}", self.ends);
        self.run_until(self.now + 3);
        let texts: Vec<_> = self.opened.iter().map(|(to, f)| (*to, &f.plain[..])).collect();
        assert_eq!(texts, [(1, &b"there"[..]), (0, b"back")]);
    }

    fn lengths(&self) -> Vec<(usize, usize)> {
        self.sent.iter().map(|(from, frame)| (*from, frame.len())).collect()
    }

    /// The node's process ends, and is started once more.
    fn restart(&mut self, which: usize, incarnation: u64) {
        let node = peer_of(1 - which);
        let seed = 100 + incarnation as u8;
        self.ends[which] = end(config(node, incarnation), at(self.now), seed);
    }
}

fn peer_of(end: usize) -> NodeId {
    [RIGHT, LEFT][end]
}

fn peer_open(peer: NodeId, incarnation: u64, renewed: bool) -> SealerOutput<u32> {
    let incarnation = Incarnation(incarnation);
    // Addresses are the ends' places.
    SealerOutput::PeerOpen { peer, address: peer.0 - 1, incarnation, renewed }
}

#[test]
fn two_frames_each_way_open_a_channel_on_both_sides() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(0);
    assert!(medium.ends[0].has_handshake_step() && medium.send(0, "early").is_none());
    medium.run_until(50);

    // Init and answer, then an empty sealed frame each.
    assert_eq!(medium.lengths(), [(0, 89), (1, 76), (0, 24), (1, 24)]);
    assert_eq!(medium.events, [(1, peer_open(LEFT, 11, false)), (0, peer_open(RIGHT, 22, false))]);
    medium.assert_talks();
    let status = medium.ends[0].channel(RIGHT).unwrap();
    assert_eq!(status.suite, CipherSuite::AesGcm);
    assert_eq!(medium.opened[0].1.peer, LEFT);
    assert_eq!(medium.opened[0].1.incarnation, Incarnation(11));
}

#[test]
fn the_other_end_knocks_and_is_asked_at_the_address_it_has_knocked_from() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(1);
    medium.run_until(50);

    assert_eq!(medium.lengths(), [(1, 89), (0, 89), (1, 76), (0, 24), (1, 24)]);
    medium.assert_talks();
}

#[test]
fn the_arithmetic_of_each_message_waits_for_a_turn_of_its_own() {
    let mut left = end(config(LEFT, 1), at(0), 1);
    for node in 3..10 {
        let public = NoiseCrypto::new(secret(NodeId(node))).public_key();
        left.add_peer(NodeId(node), &public).unwrap();
        left.connect(NodeId(node), node, at(0));
    }
    for _ in 3..10 {
        assert!(left.has_handshake_step());
        assert_eq!(left.poll_output(), None);
        left.handle_turn(at(0));
        assert!(matches!(left.poll_output(), Some(SealerOutput::Transmit { .. })));
    }
    assert!(!left.has_handshake_step());
}

#[test]
fn whatever_frames_of_the_first_half_second_are_lost_a_channel_is_open_a_second_later() {
    for by in [0, 1] {
        for lost in 0..1u32 << 8 {
            let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
            let mut count = 0;
            medium.loses = Box::new(move |_, _, _| {
                count += 1;
                lost.checked_shr(count - 1).unwrap_or(0) & 1 == 1
            });
            medium.connect(by);
            // Eight lost in a row are the first four seconds.
            let patience = if lost.count_ones() > 4 { 6_000 } else { 3_000 };
            medium.run_until(patience);
            assert_eq!(medium.open_ends(), [true; 2], "{by} {lost:08b}");
            medium.loses = Box::new(|_, _, _| false);
            medium.assert_talks();
        }
    }
}

#[test]
fn an_init_is_repeated_as_it_is_for_half_a_second_and_then_with_a_new_ephemeral_key() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.loses = Box::new(|_, _, _| true);
    medium.connect(0);
    medium.run_until(10_000);

    let inits: Vec<_> = medium.sent.iter().map(|(_, frame)| frame.slice(12..44)).collect();
    // At 0, 50, 150, 350, 750, 1550, and then once a second.
    assert!((12..=16).contains(&inits.len()), "{}", inits.len());
    assert!(inits[..4].iter().all(|init| *init == inits[0]));
    assert!(inits[4..].windows(2).all(|pair| pair[0] != pair[1]) && inits[4] != inits[0]);

    medium.ends[0].stop_asking(RIGHT);
    let sent = medium.sent.len();
    medium.run_until(20_000);
    assert_eq!((medium.sent.len(), medium.ends[0].poll_timeout()), (sent, None));
}

#[test]
fn a_slow_medium_is_given_three_times_what_init_and_answer_take() {
    let exchange_time = Duration::from_millis(172);
    let slow = |node, n| SealerConfig { exchange_time, ..config(node, n) };
    let mut medium = Medium::new(slow(LEFT, 11), slow(RIGHT, 22));
    medium.loses = Box::new(|_, _, _| true);
    medium.connect(0);
    medium.run_until(460);
    assert_eq!(medium.sent.len(), 1);
    medium.run_until(600);
    assert_eq!(medium.sent.len(), 2);
}

#[test]
fn a_restarted_node_is_open_in_its_new_incarnation_whichever_end_it_is() {
    for which in [0, 1] {
        let mut medium = Medium::open(0);
        let late = medium.ends[which].seal(peer_of(which), FrameLane::Usual, &[b"late"], at(20));
        medium.run_until(300);
        medium.restart(which, 33);
        medium.connect(which);
        medium.run_until(400);

        let opened = (1 - which, peer_open(peer_of(1 - which), 33, false));
        assert!(medium.events.contains(&opened), "{:?}", medium.events);
        medium.assert_talks();
        let refused = medium.deliver(which, late.unwrap());
        assert_eq!(refused, Err(OpenError::Unknown), "of the earlier incarnation");
    }
}

#[test]
fn a_rebuilt_link_in_the_same_incarnation_gets_new_keys_at_once() {
    for which in [0, 1] {
        let mut medium = Medium::open(0);
        medium.restart(which, [11, 22][which]);
        medium.connect(which);
        medium.run_until(60);
        medium.assert_talks();
        let renewed = (1 - which, peer_open(peer_of(1 - which), [11, 22][which], true));
        assert!(medium.events.contains(&renewed), "{:?}", medium.events);
    }
}

#[test]
fn processors_without_instructions_for_aes_agree_on_chacha_whichever_end_they_are() {
    let slow = |node| SealerConfig { fast_aes: false, ..config(node, 1) };
    for (left, right) in
        [(slow(LEFT), config(RIGHT, 1)), (config(LEFT, 1), slow(RIGHT)), (slow(LEFT), slow(RIGHT))]
    {
        let mut medium = Medium::new(left, right);
        medium.connect(0);
        medium.run_until(50);
        let suite = medium.ends[1].channel(LEFT).map(|status| status.suite);
        assert_eq!(suite, Some(CipherSuite::ChaChaPoly));
        medium.assert_talks();
    }
}

#[test]
fn a_compact_network_sends_readable_frames_with_tags() {
    let compact = |node| SealerConfig { profile: SealProfile::Compact, ..config(node, 1) };
    let mut medium = Medium::new(compact(LEFT), compact(RIGHT));
    medium.connect(0);
    medium.run_until(50);
    medium.assert_talks();
    let readable = |frame: &Bytes| frame.len() == 17 && frame[4..9] == *b"there";
    assert!(medium.sent.iter().any(|(_, frame)| readable(frame)));
}

#[test]
fn nodes_that_differ_in_robot_purpose_or_profile_do_not_understand_each_other() {
    let others = [
        SealerConfig { robot: "other".into(), ..config(RIGHT, 1) },
        SealerConfig { purpose: ChannelPurpose::Path, ..config(RIGHT, 1) },
        SealerConfig { profile: SealProfile::Compact, ..config(RIGHT, 1) },
    ];
    for other in others {
        let is_of_paths = other.purpose == ChannelPurpose::Path;
        let mut medium = Medium::new(config(LEFT, 1), other);
        medium.connect(0);
        medium.run_until(2_000);
        assert_eq!(medium.open_ends(), [false; 2]);
        // It has the pair's key, and yet says something else: only for the same purpose that is
        // held against it. A relay can put a handshake of a path on a link.
        let right = &medium.ends[1];
        assert_eq!(right.refused_of(LEFT) > 0, !is_of_paths);
        assert_eq!(right.refusals().filtered > 0, is_of_paths);
    }
}

#[test]
fn a_frame_in_a_buffer_of_its_own_is_opened_there_and_sealing_allocates_one_buffer() {
    let mut medium = Medium::open(0);
    let frame = medium.send(0, "text").unwrap();
    assert_eq!(frame.len(), 28);
    medium.in_flight.clear();
    medium.sent.clear();

    let place = frame.as_ptr();
    let opened = medium.ends[1].handle_frame(frame, &0, at(medium.now)).unwrap().unwrap();
    assert_eq!(opened.plain, "text");
    assert_eq!(opened.plain.as_ptr(), place.wrapping_add(8));
}

#[test]
fn a_node_whose_clock_was_set_back_opens_a_channel_as_any_other() {
    for which in 0..2 {
        let mut medium = Medium::open(0);
        // Until then the later incarnation counts as heard.
        medium.run_until(medium.now + 300);

        medium.restart(which, 5);
        medium.connect(which);
        medium.run_until(medium.now + 1_000);

        medium.assert_talks();
        let open = medium.ends[1 - which].channel(peer_of(1 - which)).unwrap();
        assert_eq!(open.incarnation, Incarnation(5));
    }
}
