//! Channels without handshakes: both ends are given their keys.

use super::super::noise::NoiseCrypto;
use super::*;
use crate::random::Random;
use crate::testing::at;

type Channels = PeerChannels;

const FORMATS: [(SealProfile, CipherSuite); 3] = [
    (SealProfile::Full, CipherSuite::AesGcm),
    (SealProfile::Full, CipherSuite::ChaChaPoly),
    (SealProfile::Compact, CipherSuite::AesGcm),
];

fn limits() -> KeyLimits {
    KeyLimits::default()
}

/// One end of channel `number`, whose keys are that number; the other end has the other side.
fn end(format: (SealProfile, CipherSuite), number: u8, side: u8, incarnation: u64) -> Channel {
    let (profile, suite) = format;
    let peer = Incarnation(incarnation);
    let number_of = |side: u8| u32::from(number * 2 + side);
    let (local, remote) = (number_of(side), number_of(1 - side));
    let terms = ChannelTerms { profile, suite, local, remote, peer };
    let key = |side: u8| [number * 2 + side; 32];
    let keys = ChannelKeys { seal: key(side), open: key(1 - side) };
    Channel::new(terms, &keys, &NoiseCrypto::new([1; 32]), at(0))
}

fn ends(format: (SealProfile, CipherSuite)) -> [Channels; 2] {
    [0, 1].map(|side| {
        let mut channels = Channels::default();
        channels.replace(end(format, 1, side, 7), &limits(), at(0));
        channels
    })
}

fn open(end: &mut Channels, frame: &[u8], now: u64) -> Result<(Opening, Vec<u8>), OpenError> {
    let header = SealHeader::decode(frame).ok_or(OpenError::Unknown)?;
    let mut frame = BytesMut::from(frame);
    let (opening, _) = end.open(&header, &mut frame, &limits(), at(now))?;
    Ok((opening, frame.to_vec()))
}

fn seal(end: &mut Channels, lane: FrameLane, text: &[u8]) -> Bytes {
    end.seal(lane, &[text], &limits()).expect("there is a channel")
}

/// So many frames are repeated and forged, a fifth of them repeated. The nightly run is compiled
/// with more.
fn attempts() -> u64 {
    option_env!("BLASTEMA_FORGERIES").map_or(100_000, |count| count.parse().expect("a number"))
}

#[test]
fn of_frames_that_are_reordered_repeated_and_forged_the_genuine_are_opened_once() {
    for format in FORMATS {
        let [mut left, mut right] = ends(format);
        let mut random = Random::new(1);
        let mut frames: Vec<(u64, Bytes)> = (0..20_000u64)
            .map(|n| {
                let lane = FrameLane::ALL[n as usize % 3];
                (n + random.below(900), seal(&mut left, lane, &n.to_be_bytes()))
            })
            .collect();
        frames.sort_by_key(|(place, _)| *place);
        let mut opened: Vec<Vec<u8>> =
            frames.iter().map(|(_, frame)| open(&mut right, frame, 0).unwrap().1).collect();
        opened.sort();
        assert!(opened.iter().zip(0u64..).all(|(text, n)| text[..] == n.to_be_bytes()));

        let mut accepted = 0;
        for n in 0..attempts() {
            let (_, frame) = &frames[random.below(frames.len() as u64) as usize];
            let mut frame = frame.to_vec();
            let length = frame.len();
            let counters = if format.0 == SealProfile::Full { 4..8 } else { 2..4 };
            match n % 5 {
                // A repeat.
                0 => {}
                // Another counter, near the present ones or far.
                1 => {
                    let low = 6_000 + random.below([2_000, 60_000][n as usize / 5 % 2]);
                    let low = (low as u32).to_be_bytes();
                    frame[counters.clone()].copy_from_slice(&low[4 - counters.len()..]);
                }
                // One bit of what is sealed, or of its lane.
                2 => frame[random.below(length as u64) as usize] ^= 1 << random.below(8),
                3 => frame.truncate(random.below(length as u64) as usize),
                _ => frame[counters.end..].iter_mut().for_each(|b| *b = random.next() as u8),
            }
            accepted += usize::from(open(&mut right, &frame, 0).is_ok());
        }
        assert_eq!(accepted, 0, "{format:?}");

        let genuine = seal(&mut left, FrameLane::Hello, b"still");
        assert_eq!(open(&mut right, &genuine, 0).unwrap().1, b"still");
    }
}

#[test]
fn a_forged_frame_does_not_use_up_the_counter_of_the_genuine_one() {
    for format in FORMATS {
        let [mut left, mut right] = ends(format);
        let genuine = seal(&mut left, FrameLane::Usual, b"text");
        let mut forged = genuine.to_vec();
        *forged.last_mut().unwrap() ^= 1;

        assert_eq!(open(&mut right, &forged, 0), Err(OpenError::Forged));
        assert_eq!(open(&mut right, &genuine, 0).unwrap().1, b"text");
        assert_eq!(open(&mut right, &genuine, 0), Err(OpenError::Stale));
    }
}

#[test]
fn each_lane_counts_by_itself_so_one_may_wait_for_thousands_of_another() {
    let [mut left, mut right] = ends(FORMATS[0]);
    let waiting = seal(&mut left, FrameLane::Usual, b"waited");
    for _ in 0..5_000 {
        let hello = seal(&mut left, FrameLane::Hello, b"");
        assert!(open(&mut right, &hello, 0).is_ok());
    }
    assert_eq!(open(&mut right, &waiting, 0).unwrap().1, b"waited");
}

#[test]
fn sealed_frames_have_the_documented_bytes() {
    let [mut left, _] = ends(FORMATS[0]);
    seal(&mut left, FrameLane::Urgent, b"");
    let frame = left.seal(FrameLane::Urgent, &[b"te", b"", b"xt"], &limits()).unwrap();
    // Channel 3 of the receiver, counter 1; then "text" by AES-256-GCM under 32 times 02 with the
    // nonce 00000000 4000000000000001, by Python's `cryptography`.
    let sealed: [u8; 20] = [
        0x63, 0xd2, 0xd5, 0x0a, 0x3d, 0xeb, 0x70, 0x00, 0x74, 0xb2, 0x3d, 0x8d, 0x46, 0xc3, 0x0b,
        0x64, 0xf5, 0x13, 0x2d, 0x9f,
    ];
    assert_eq!(frame, [&[0xd1, 0, 0, 3, 0, 0, 0, 1], &sealed[..]].concat());

    let [mut left, _] = ends(FORMATS[2]);
    let frame = seal(&mut left, FrameLane::Usual, b"text");
    assert_eq!(frame[..8], *b"\xda\x03\x00\x00text");
    assert_eq!(frame.len(), 16);
}

#[test]
fn an_offer_changes_nothing_until_a_frame_is_opened_under_it() {
    let format = FORMATS[0];
    let [mut left, mut right] = ends(format);
    let channel = end(format, 2, 1, 7);
    right.offered =
        Some(OfferedChannel { channel, since: at(0), ephemeral: 0, answer: Bytes::new() });

    let frame = seal(&mut right, FrameLane::Usual, b"present");
    assert_eq!(open(&mut left, &frame, 0).unwrap(), (Opening::Confirmed, b"present".to_vec()));
    let frame = seal(&mut left, FrameLane::Usual, b"also");
    assert!(open(&mut right, &frame, 0).is_ok());

    let late = seal(&mut left, FrameLane::Usual, b"late");
    left.replace(end(format, 2, 0, 7), &limits(), at(0));
    let mut forged = seal(&mut left, FrameLane::Usual, b"").to_vec();
    forged[10] ^= 1;
    assert_eq!(open(&mut right, &forged, 0), Err(OpenError::Forged));
    assert!(right.offered.is_some(), "a forged frame accepts no offer");
    let first = seal(&mut left, FrameLane::Usual, b"first");
    assert_eq!(open(&mut right, &first, 10).unwrap().0, Opening::Accepted);
    assert_eq!(open(&mut right, &late, 10).unwrap().1, b"late");
    let frame = seal(&mut right, FrameLane::Usual, b"new");
    assert_eq!(open(&mut left, &frame, 10).unwrap(), (Opening::Confirmed, b"new".to_vec()));
}

#[test]
fn a_former_channel_seals_nothing_and_opens_for_two_seconds() {
    let format = FORMATS[0];
    let [mut left, mut right] = ends(format);
    let late = [0, 1].map(|_| seal(&mut left, FrameLane::Usual, b"late"));
    right.replace(end(format, 2, 1, 7), &limits(), at(1000));

    assert_eq!(right.drop_due(&limits()), Some(at(3000)));
    assert!(!right.drop_due_keys(&limits(), at(2999)));
    assert!(open(&mut right, &late[0], 2999).is_ok());
    let header = SealHeader::decode(&seal(&mut right, FrameLane::Usual, b"")).unwrap();
    assert_eq!(header.channel, 4, "sealed for the new channel");

    assert!(!right.drop_due_keys(&limits(), at(3000)));
    assert_eq!(open(&mut right, &late[1], 3000), Err(OpenError::Unknown));
}

#[test]
fn frames_of_an_earlier_incarnation_are_not_opened_once_a_later_one_is_there() {
    let format = FORMATS[0];
    let [mut left, mut right] = ends(format);
    let late = seal(&mut left, FrameLane::Usual, b"late");

    right.replace(end(format, 2, 1, 8), &limits(), at(0));

    assert_eq!(open(&mut right, &late, 0), Err(OpenError::Unknown));
}

#[test]
fn keys_are_renewed_after_many_frames_and_seal_and_open_none_beyond_their_limits() {
    let limits = KeyLimits {
        renew_after_frames: 10,
        frames_max: 12,
        renew_after_forged: 4,
        forged_max: 6,
        ..KeyLimits::default()
    };
    let [mut left, mut right] = ends(FORMATS[0]);
    let mut sealed = Vec::new();
    for n in 0..12 {
        assert_eq!(left.is_worn(&limits), n >= 10);
        sealed.push(left.seal(FrameLane::Usual, &[b"text"], &limits).unwrap());
    }
    assert_eq!(left.seal(FrameLane::Usual, &[b"text"], &limits), None);
    assert!(left.drop_due_keys(&limits, at(0)) && left.present.is_none());

    for (n, frame) in sealed[..6].iter().enumerate() {
        assert_eq!(right.is_worn(&limits), n >= 4);
        let mut forged = BytesMut::from(&frame[..]);
        forged[9] ^= 1;
        let header = SealHeader::decode(&forged).unwrap();
        let opened = right.open(&header, &mut forged, &limits, at(0));
        assert_eq!(opened, Err(OpenError::Forged));
    }
    let mut genuine = BytesMut::from(&sealed[11][..]);
    let header = SealHeader::decode(&genuine).unwrap();
    assert_eq!(right.open(&header, &mut genuine, &limits, at(0)), Err(OpenError::Unknown));
}

#[test]
fn keys_live_two_hours_and_are_dropped_then() {
    let [mut left, _] = ends(FORMATS[0]);
    let age_max = 7_200_000;

    assert_eq!(left.drop_due(&limits()), Some(at(age_max)));
    assert!(!left.drop_due_keys(&limits(), at(age_max - 1)));
    assert!(left.drop_due_keys(&limits(), at(age_max)));
    assert_eq!(left.seal(FrameLane::Usual, &[b"text"], &limits()), None);
}

#[test]
fn a_compact_channel_bridges_thirty_thousand_lost_frames_and_is_worn_before_that() {
    let [mut left, mut right] = ends(FORMATS[2]);
    for n in 0..30_000 {
        assert_eq!(left.is_worn(&limits()), n >= 1 << 14);
        seal(&mut left, FrameLane::Usual, b"lost");
    }
    let frame = seal(&mut left, FrameLane::Usual, b"text");
    assert_eq!(open(&mut right, &frame, 0).unwrap().1, b"text");
    let answer = seal(&mut right, FrameLane::Usual, b"text");
    assert_eq!(open(&mut left, &answer, 0).unwrap().1, b"text");
    assert!(!left.is_worn(&limits()));
}
