//! What a node without a key, or with a recording, can do.

use super::admission::REPEATS_MAX;
use super::channel::{Channel, PeerChannels};
use super::handshake::{ASKING_MAX, OFFERS_MAX};
use super::noise::AeadCipher;
use super::*;
use crate::random::Random;

fn inits(medium: &Medium) -> Vec<Bytes> {
    let of_left = medium.sent.iter().filter(|(from, frame)| *from == 0 && frame.len() == 89);
    of_left.map(|(_, frame)| frame.clone()).collect()
}

/// What the end transmits next, without delivering it.
fn transmitted(end: &mut End) -> Vec<Bytes> {
    let mut frames = Vec::new();
    while let Some(output) = end.poll_output() {
        if let SealerOutput::Transmit { frame, .. } = output {
            frames.push(frame);
        }
    }
    frames
}

#[test]
fn every_changed_bit_of_a_handshake_is_refused_before_any_arithmetic() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(0);
    medium.ends[0].handle_turn(at(0));
    let init = transmitted(&mut medium.ends[0]).remove(0);

    // Its last eight bytes are the cookie's code, which is looked at under load only.
    for bit in 0..81 * 8 {
        let mut changed = init.to_vec();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert!(medium.deliver(0, changed.into()).is_err(), "{bit}");
        assert!(!medium.ends[1].has_handshake_step());
    }
    assert_eq!(medium.ends[1].refused_of(LEFT), 0, "a forged frame is not the peer's fault");
    medium.deliver(0, init).unwrap();
    medium.ends[1].handle_turn(at(0));
    let answer = transmitted(&mut medium.ends[1]).remove(0);
    for bit in 0..76 * 8 {
        let mut changed = answer.to_vec();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert!(medium.deliver(1, changed.into()).is_err(), "{bit}");
        assert!(!medium.ends[0].has_handshake_step());
    }
    medium.deliver(1, answer).unwrap();
    medium.run_until(20);
    medium.assert_talks();
}

#[test]
fn a_repeated_init_is_answered_as_before_and_changes_nothing() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(0);
    medium.ends[0].handle_turn(at(0));
    let init = transmitted(&mut medium.ends[0]).remove(0);
    medium.deliver(0, init.clone()).unwrap();
    medium.ends[1].handle_turn(at(0));
    let answer = transmitted(&mut medium.ends[1]).remove(0);

    for _ in 0..100 {
        assert_eq!(medium.deliver(0, init.clone()), Err(OpenError::Repeated));
        assert!(!medium.ends[1].has_handshake_step());
        assert_eq!(transmitted(&mut medium.ends[1]), std::slice::from_ref(&answer));
    }
    medium.deliver(1, answer).unwrap();
    medium.run_until(20);
    medium.assert_talks();
    assert_eq!(medium.deliver(0, init), Err(OpenError::Repeated));
    assert_eq!(transmitted(&mut medium.ends[1]), Vec::<Bytes>::new(), "the offer was accepted");
    medium.assert_talks();
}

#[test]
fn a_recorded_init_that_is_not_remembered_makes_an_offer_and_leaves_the_channel() {
    let mut medium = Medium::open(0);
    let recorded = inits(&medium).remove(0);
    // The responder was rebuilt since, and the peer is open again.
    medium.restart(1, 22);
    medium.connect(1);
    medium.run_until(100);
    medium.events.clear();

    medium.deliver(0, recorded).unwrap();
    medium.run_until(200);

    medium.assert_talks();
    assert_eq!(medium.events, []);
    let forged = medium.ends[0].refusals().forged + medium.ends[1].refusals().forged;
    assert_eq!(forged, 0);
}

#[test]
fn a_recorded_init_of_an_earlier_incarnation_makes_an_offer_and_accuses_no_peer() {
    let mut medium = Medium::open(0);
    let recorded = inits(&medium).remove(0);
    medium.run_until(300);
    for (which, incarnation) in [(0, 12), (1, 22)] {
        medium.restart(which, incarnation);
        medium.connect(0);
        medium.run_until(medium.now + 300);
    }
    medium.assert_talks();
    medium.events.clear();

    medium.deliver(0, recorded.clone()).unwrap();
    medium.ends[1].handle_turn(at(medium.now));
    let answers = transmitted(&mut medium.ends[1]);
    assert!(answers.len() == 1 && answers[0].len() < recorded.len());
    medium.assert_talks();
    assert_eq!(medium.events, [], "who repeats a recording accuses no peer");
}

#[test]
fn a_second_node_with_the_peers_key_is_refused_and_reported_while_the_peer_is_heard() {
    for copied in [0, 1] {
        let mut medium = Medium::open(0);
        let mut copy = end(config(peer_of(1 - copied), 99), at(0), 77);
        medium.assert_talks();
        let victim = 1 - copied;
        // As initiator it asks; as responder it knocks, and is asked.
        copy.connect(peer_of(copied), 0, at(medium.now));
        copy.handle_turn(at(medium.now));
        for _ in 0..4 {
            for frame in transmitted(&mut copy) {
                let _ = medium.ends[victim].handle_frame(frame, &5, at(medium.now));
            }
            medium.ends[victim].handle_turn(at(medium.now));
            while let Some(output) = medium.ends[victim].poll_output() {
                match output {
                    SealerOutput::Transmit { frame, .. } => {
                        let _ = copy.handle_frame(frame, &0, at(medium.now));
                    }
                    event => medium.events.push((victim, event)),
                }
            }
            copy.handle_turn(at(medium.now));
        }
        let (open, refused) = (Incarnation([11, 22][copied]), Incarnation(99));
        let peer = peer_of(victim);
        let in_use = SealerOutput::KeyInUse { peer, address: 5, open, refused };
        assert_eq!(medium.events.first(), Some(&(victim, in_use.clone())));
        assert!(medium.events.iter().all(|event| *event == (victim, in_use.clone())));
        medium.assert_talks();
        assert_eq!(medium.opened[0].1.incarnation, Incarnation(11));
    }
}

#[test]
fn a_recorded_knock_is_heard_once_and_knocks_twice_a_second_at_most() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.loses = Box::new(|_, _, _| true);
    medium.connect(1);
    medium.run_until(2_000);
    let knocks: Vec<_> = medium.sent.drain(..).map(|(_, knock)| knock).collect();
    assert!(knocks.len() >= 4);
    medium.ends[1].stop_asking(LEFT);
    let mut knock = |n: usize, now: u64| {
        medium.now = now;
        let heard = medium.deliver(1, knocks[n].clone());
        medium.ends[0].handle_turn(at(now));
        assert_eq!(transmitted(&mut medium.ends[0]).len(), usize::from(heard.is_ok()));
        heard
    };

    assert_eq!(knock(0, 3_000), Ok(()));
    assert_eq!(knock(0, 3_000), Err(OpenError::Repeated));
    assert_eq!(knock(1, 3_499), Ok(()), "the same init, for what may have been lost");
    assert_eq!(knock(1, 9_000), Err(OpenError::Repeated));
    let elsewhere = medium.ends[0].handle_frame(knocks[2].clone(), &77, at(3_499));
    assert_eq!(elsewhere, Err(OpenError::Limited));
}

#[test]
fn an_address_that_only_a_knock_has_named_gets_one_init() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.loses = Box::new(|_, _, _| true);
    medium.connect(1);
    medium.ends[1].stop_asking(LEFT);
    let knock = transmitted(&mut medium.ends[1]).remove(0);

    medium.ends[0].handle_frame(knock, &77, at(0)).unwrap();
    medium.run_until(3_000);

    assert_eq!(medium.lengths(), [(0, 89)]);
}

#[test]
fn the_address_of_a_frame_does_not_replace_the_one_that_was_given() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(1);
    // The initiator's first sealed frame comes by way of another address.
    while medium.in_flight.iter().all(|(_, _, frame)| frame.len() != 24) {
        medium.run_until(medium.now + 1);
    }
    let first = medium.in_flight.drain(..).find(|(_, _, frame)| frame.len() == 24).unwrap().2;
    medium.ends[1].handle_frame(first, &77, at(medium.now)).unwrap();
    while medium.ends[1].poll_output().is_some() {}

    medium.ends[1].begin(LEFT, at(medium.now));
    let knock = medium.ends[1].poll_output();
    assert!(matches!(knock, Some(SealerOutput::Transmit { to: 0, .. })), "{knock:?}");
}

#[test]
fn an_init_that_is_repeated_from_elsewhere_first_does_not_lead_the_responder_there() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    medium.connect(0);
    medium.ends[0].handle_turn(at(0));
    let init = transmitted(&mut medium.ends[0]).remove(0);
    medium.ends[1].handle_frame(init.clone(), &77, at(0)).unwrap();
    medium.ends[1].handle_turn(at(0));
    assert_eq!(transmitted(&mut medium.ends[1]).len(), 1);
    assert_eq!(medium.deliver(0, init), Err(OpenError::Repeated));
    let answer = transmitted(&mut medium.ends[1]).remove(0);
    medium.deliver(1, answer).unwrap();
    medium.run_until(20);
    medium.assert_talks();

    medium.ends[1].begin(LEFT, at(20));
    let knock = medium.ends[1].poll_output();
    assert!(matches!(knock, Some(SealerOutput::Transmit { to: 0, .. })), "{knock:?}");
}

/// Takes the budget of the responder by inits with the right key, from changing ephemeral keys.
fn exhaust(right: &mut End, now: u64) {
    let mut spent = 0;
    for seed in 0..80 {
        let mut left = end(config(LEFT, 5), at(now), 150 + seed);
        left.connect(RIGHT, 0, at(now));
        left.handle_turn(at(now));
        for init in transmitted(&mut left) {
            spent += usize::from(right.handle_frame(init, &9, at(now)).is_ok());
            right.handle_turn(at(now));
        }
    }
    assert_eq!(spent, 64);
}

#[test]
fn beyond_the_budget_an_init_needs_a_cookie_which_only_its_address_receives() {
    let mut medium = Medium::new(config(LEFT, 11), config(RIGHT, 22));
    exhaust(&mut medium.ends[1], 0);
    let replies = transmitted(&mut medium.ends[1]);
    let cookies: Vec<_> = replies.iter().filter(|frame| frame.len() == 49).collect();
    assert_eq!((cookies.len(), replies.len()), (16, 80), "an answer or a cookie for each");

    medium.connect(0);
    // What leaves the window is taken by another flood as well.
    for _ in 0..200 {
        medium.run_until(medium.now + 1);
        while medium.ends[1].budget.add((), at(medium.now)) {}
    }

    assert!(medium.sent.iter().any(|(from, frame)| *from == 1 && frame.len() == 49));
    let proven = inits(&medium).into_iter().filter(|init| init[81..] != [0; 8]).count();
    assert!(proven >= 1);
    medium.assert_talks();
}

#[test]
fn beyond_the_budget_a_medium_whose_addresses_are_true_refuses() {
    let right = SealerConfig { forgeable_addresses: false, ..config(RIGHT, 22) };
    let mut right = end(right, at(0), 2);
    exhaust(&mut right, 0);
    assert_eq!(transmitted(&mut right).len(), 64);
    assert_eq!(right.refusals().limited, 16);
}

#[test]
fn bytes_to_an_address_are_no_more_than_bytes_from_there() {
    let mut right = end(config(RIGHT, 22), at(0), 2);
    let (mut received, mut sent) = (0, 0);
    let mut random = Random::new(3);
    for seed in 0..150 {
        let mut left = end(config(LEFT, 5), at(0), seed);
        left.connect(RIGHT, 0, at(0));
        left.handle_turn(at(0));
        let init = transmitted(&mut left).remove(0);
        for _ in 0..=random.below(3) {
            received += init.len();
            let _ = right.handle_frame(init.clone(), &9, at(0));
            right.handle_turn(at(0));
            sent += transmitted(&mut right).iter().map(Bytes::len).sum::<usize>();
            assert!(sent <= received);
        }
    }
    assert!(sent > 0);
}

#[test]
fn what_is_kept_before_authentication_takes_less_than_64_kib() {
    // What snow keeps for a handshake, by the study, with its boxes.
    let asking = 1_300 + 200;
    let offer = size_of::<PeerChannels>() / 3 + size_of::<AeadCipher>() + 100;
    let steps = 32 * size_of::<HandshakeStep<u64>>();
    let repeats = REPEATS_MAX * 16;

    assert!(size_of::<Channel>() < offer);
    let sum = ASKING_MAX * asking + OFFERS_MAX * offer + steps + repeats;
    assert!(sum <= 64 * 1024, "{sum}");
}

#[test]
fn the_seventeenth_offer_withdraws_the_first() {
    let far = NodeId(1_000);
    let mut right = end(config(far, 22), at(0), 2);
    for node in 10..27 {
        let node = NodeId(node);
        let public = NoiseCrypto::new(secret(node)).public_key();
        right.add_peer(node, &public).unwrap();
        let mut left = Sealer::new(config(node, 1), NoiseCrypto::new(secret(node)), [3; 32], at(0));
        let public = NoiseCrypto::new(secret(far)).public_key();
        left.add_peer(far, &public).unwrap();
        left.connect(far, 0, at(0));
        left.handle_turn(at(0));
        right.handle_frame(transmitted(&mut left).remove(0), &node.0, at(node.0.into())).unwrap();
        right.handle_turn(at(node.0.into()));
    }
    let offered = |node: u32| right.peers[&NodeId(node)].channels.offered.is_some();
    assert_eq!((10..27).filter(|node| offered(*node)).count(), OFFERS_MAX);
    assert!(!offered(10) && offered(26));
}
