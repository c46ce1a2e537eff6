//! New keys for old, and the end of keys.

use super::*;

#[test]
fn keys_are_renewed_after_an_hour_by_the_initiator_and_nothing_is_lost_meanwhile() {
    let mut medium = Medium::open(0);
    medium.now = 3_599_990;
    let mut sent = [0; 2];
    for n in 0..200 {
        for (from, sent) in sent.iter_mut().enumerate() {
            *sent += usize::from(medium.send(from, &n.to_string()).is_some());
        }
        medium.run_until(medium.now + 1);
    }
    medium.run_until(medium.now + 10);

    assert_eq!((sent, medium.opened.len()), ([200; 2], 400));
    assert_eq!(medium.events, [(1, peer_open(LEFT, 11, true)), (0, peer_open(RIGHT, 22, true))]);
    let inits = medium.sent.iter().filter(|(_, frame)| frame.len() == 89).count();
    assert_eq!(inits, 2, "the first, and this one");
    assert!(medium.ends[0].poll_timeout() < Some(at(3_603_000)), "former keys are dropped");
    medium.run_until(3_603_000);
    assert!(medium.ends[0].poll_timeout() > Some(at(7_190_000)));
}

#[test]
fn the_responder_knocks_for_new_keys_when_it_has_sealed_many_frames() {
    let limits = KeyLimits { renew_after_frames: 100, ..KeyLimits::default() };
    let right = SealerConfig { limits, ..config(RIGHT, 22) };
    let mut medium = Medium::new(config(LEFT, 11), right);
    medium.connect(0);
    medium.run_until(600);
    medium.events.clear();
    for n in 0..150 {
        assert!(medium.send(1, &n.to_string()).is_some());
        medium.run_until(medium.now + 1);
    }
    medium.run_until(medium.now + 10);

    assert_eq!(medium.opened.len(), 150);
    assert_eq!(medium.events, [(1, peer_open(LEFT, 11, true)), (0, peer_open(RIGHT, 22, true))]);
}

#[test]
fn keys_that_cannot_be_renewed_are_worn_out_after_two_hours() {
    let mut medium = Medium::open(0);
    medium.loses = Box::new(|_, _, _| true);
    for minutes in (60..120).step_by(5) {
        medium.now = minutes * 60_000;
        medium.run_until(medium.now + 2);
        assert_eq!(medium.open_ends(), [true; 2], "the old keys go on");
    }
    assert_eq!(medium.events, []);
    medium.now = 7_200_100;
    medium.run_until(medium.now + 5);

    let worn_out = |end: usize| (end, SealerOutput::KeyWornOut { peer: peer_of(end) });
    assert_eq!(medium.events, [worn_out(0), worn_out(1)]);
    assert_eq!(medium.open_ends(), [false; 2]);
    assert!(medium.send(0, "text").is_none());

    medium.loses = Box::new(|_, _, _| false);
    medium.run_until(medium.now + 2_000);
    medium.assert_talks();
}

#[test]
fn a_key_seals_no_frame_beyond_its_limit() {
    let limits = KeyLimits { renew_after_frames: 10, frames_max: 20, ..KeyLimits::default() };
    let mut medium = Medium::new(SealerConfig { limits, ..config(LEFT, 11) }, config(RIGHT, 22));
    medium.connect(0);
    medium.run_until(50);
    medium.loses = Box::new(|_, _, _| true);
    // One of them was the empty one that has opened the channel.
    let sealed = (0..100).filter(|n| medium.send(0, &n.to_string()).is_some()).count();
    medium.run_until(medium.now + 1);

    assert_eq!(sealed, 19);
    assert!(medium.events.contains(&(0, SealerOutput::KeyWornOut { peer: RIGHT })));
}

#[test]
fn a_peer_that_is_removed_is_neither_sealed_for_nor_opened_and_can_come_back() {
    let mut medium = Medium::open(0);
    let frame = medium.send(0, "text").unwrap();
    medium.ends[1].remove_peer(LEFT);

    assert_eq!(medium.deliver(0, frame), Err(OpenError::Unknown));
    assert!(medium.send(1, "text").is_none());
    assert_eq!(medium.ends[1].poll_timeout(), None);
    medium.connect(0);
    medium.run_until(1_000);
    assert!(!medium.open_ends()[1]);

    let public = NoiseCrypto::new(secret(LEFT)).public_key();
    medium.ends[1].add_peer(LEFT, &public).unwrap();
    medium.run_until(3_000);
    medium.assert_talks();
}

#[test]
fn another_key_for_a_known_peer_ends_the_channel_and_the_same_one_does_not() {
    let mut medium = Medium::open(0);
    let public = NoiseCrypto::new(secret(LEFT)).public_key();
    medium.ends[1].add_peer(LEFT, &public).unwrap();
    medium.assert_talks();

    let other = NoiseCrypto::new([9; 32]).public_key();
    medium.ends[1].add_peer(LEFT, &other).unwrap();
    assert!(medium.send(1, "text").is_none());
    medium.connect(0);
    medium.run_until(1_000);
    assert!(!medium.open_ends()[1] && medium.ends[1].refusals().filtered > 0);
}

#[test]
fn keys_that_are_none_and_a_nodes_own_number_are_refused() {
    let mut left = end(config(LEFT, 1), at(0), 1);
    assert_eq!(left.add_peer(NodeId(9), &[0; 32]), Err(PeerKeyError::LowOrder(NodeId(9))));
    assert_eq!(left.add_peer(LEFT, &[5; 32]), Err(PeerKeyError::Ourselves(LEFT)));
}
