//! Known answers, and what a handshake must refuse.

use super::*;

fn bytes<const N: usize>(hex: &str) -> [u8; N] {
    unhex(hex).try_into().expect("so many bytes")
}

fn unhex(hex: &str) -> Vec<u8> {
    let digit = |at: usize| u8::from_str_radix(&hex[at..at + 2], 16).unwrap();
    (0..hex.len()).step_by(2).map(digit).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// `01`, then 31 times this byte.
fn key(byte: u8) -> [u8; 32] {
    let mut key = [byte; 32];
    key[0] = 1;
    key
}

const SUITES: [CipherSuite; 2] = [CipherSuite::AesGcm, CipherSuite::ChaChaPoly];

struct Ends {
    initiator: NoiseCrypto,
    responder: NoiseCrypto,
    publics: [[u8; 32]; 2],
}

impl Ends {
    fn new() -> Self {
        let (initiator, responder) = (NoiseCrypto::new(key(0x11)), NoiseCrypto::new(key(0x22)));
        let publics = [initiator.public_key(), responder.public_key()];
        Ends { initiator, responder, publics }
    }

    fn terms(&self, peer: usize, suite: CipherSuite) -> HandshakeTerms<'_> {
        HandshakeTerms { suite, prologue: b"blastema link 2", peer: &self.publics[peer] }
    }

    fn shake(&self, suite: CipherSuite, seeds: [u8; 2]) -> ([[u8; 60]; 2], [ChannelKeys; 2]) {
        let [there, back] = [*b"hello from i", *b"hello from r"];
        let terms = self.terms(1, suite);
        let (mut ours, init) = self.initiator.write_init(terms, [seeds[0]; 32], &there).unwrap();
        let terms = self.terms(0, suite);
        let (theirs, read) = self.responder.read_init(terms, [seeds[1]; 32], &init).unwrap();
        assert_eq!(read, there);
        let (answer, responders) = self.responder.write_answer(theirs, &back).unwrap();
        let (read, initiators) = self.initiator.read_answer(&mut ours, &answer).unwrap();
        assert_eq!(read, back);
        ([init, answer], [initiators, responders])
    }
}

/// Calculated by three implementations of Noise, snow, noiseprotocol and dissononce, which agree.
#[test]
fn the_handshake_is_the_one_that_three_implementations_of_noise_calculate() {
    let ends = Ends::new();
    let keys = [[key(0x11), key(0x33)], [key(0x22), key(0x44)]];
    let build = |own: usize| {
        let resolver = Box::new(SeededResolver(Zeroizing::new([0; 32])));
        let params = "Noise_KK_25519_AESGCM_SHA256".parse().unwrap();
        let builder = Builder::with_resolver(params, resolver)
            .local_private_key(&keys[own][0])
            .unwrap()
            .fixed_ephemeral_key_for_testing_only(&keys[own][1])
            .remote_public_key(&ends.publics[1 - own])
            .unwrap()
            .prologue(b"blastema link 2")
            .unwrap();
        if own == 0 { builder.build_initiator() } else { builder.build_responder() }.unwrap()
    };
    let (mut initiator, mut responder) = (build(0), build(1));

    let init = written(&mut initiator, b"hello from i").unwrap();
    assert_eq!(&read(&mut responder, &init).unwrap(), b"hello from i");
    let answer = written(&mut responder, b"hello from r").unwrap();
    assert_eq!(&read(&mut initiator, &answer).unwrap(), b"hello from r");

    assert_eq!(
        hex(&init),
        "f175b32330a7d9c689c4759556db6b53b7a9d49f50b04faebcbdb3ae24e2ff4b\
         577f42c2db6ece890d80ecd81ec4137a60f98662d307313a831ad2f4"
    );
    assert_eq!(
        hex(&answer),
        "3f259f665aa61cf11233539b19144b996fdc74f357f9d56e875776eff4238102\
         ffe898dbf2c088d9597396df752e27e27c24999c70bd3790c770a765"
    );
    let hash = "befdffafacf0135cbb3765bd7d4b66f5ac2b7e5acbd2c5ce02220b4c9b53f9db";
    assert_eq!(
        [initiator.get_handshake_hash(), responder.get_handshake_hash()].map(hex),
        [hash; 2]
    );

    // Our own cipher seals what snow's transport would.
    let (seal, open) = initiator.dangerously_get_raw_split();
    let mut ours = AeadCipher::new(CipherSuite::AesGcm, &ChannelKeys { seal, open });
    let transport = responder.into_stateless_transport_mode().unwrap();
    for nonce in [0, 1, 7, 4_000_000_000, 3 << 62] {
        let mut frame = BytesMut::from("header, text");
        ours.seal(nonce, &mut frame, 8);
        let mut opened = [0; 64];
        let length = transport.read_message(nonce, &frame[8..], &mut opened).unwrap();
        assert_eq!(&opened[..length], b"text");
        let length = transport.write_message(nonce, b"back", &mut opened).unwrap();
        assert_eq!(ours.open(nonce, &mut opened[..length]), Some(4));
        assert_eq!(&opened[..4], b"back");
    }
}

#[test]
fn both_ends_have_the_same_keys_and_each_seed_gives_its_own() {
    let ends = Ends::new();
    for suite in SUITES {
        let (messages, [ours, theirs]) = ends.shake(suite, [1, 2]);
        assert_eq!((ours.seal, ours.open), (theirs.open, theirs.seal));

        assert_eq!(ends.shake(suite, [1, 2]).0, messages, "one seed gives one handshake");
        let (others, [other, _]) = ends.shake(suite, [3, 2]);
        assert_ne!(others[0], messages[0]);
        assert_ne!((other.seal, other.open), (ours.seal, ours.open));
        assert_ne!(ends.shake(suite, [1, 3]).1[0].seal, ours.seal);
    }
}

#[test]
fn a_handshake_refuses_every_changed_bit_other_terms_and_other_keys() {
    let ends = Ends::new();
    let suite = CipherSuite::AesGcm;
    let terms = |peer| ends.terms(peer, suite);
    let (mut ours, init) = ends.initiator.write_init(terms(1), [1; 32], &[7; 12]).unwrap();
    let (theirs, _) = ends.responder.read_init(terms(0), [2; 32], &init).unwrap();
    let (answer, _) = ends.responder.write_answer(theirs, &[8; 12]).unwrap();

    for byte in (0..NOISE_MESSAGE).step_by(7) {
        let changed = |message: &[u8; 60]| {
            let mut changed = *message;
            changed[byte] ^= 1 << (byte % 8);
            changed
        };
        assert!(ends.responder.read_init(terms(0), [2; 32], &changed(&init)).is_none());
        assert!(ends.initiator.read_answer(&mut ours, &changed(&answer)).is_none());
    }
    let others = HandshakeTerms { prologue: b"blastema path 2", ..terms(0) };
    assert!(ends.responder.read_init(others, [2; 32], &init).is_none());
    let others = HandshakeTerms { suite: CipherSuite::ChaChaPoly, ..terms(0) };
    assert!(ends.responder.read_init(others, [2; 32], &init).is_none());
    assert!(ends.responder.read_init(terms(1), [2; 32], &init).is_none(), "of another node");
    assert!(NoiseCrypto::new(key(9)).read_init(terms(0), [2; 32], &init).is_none(), "to another");

    assert!(ends.initiator.read_answer(&mut ours, &answer).is_some(), "it is as it was");
}

#[test]
fn a_public_key_of_low_order_is_refused() {
    let ends = Ends::new();
    let mut one = [0; 32];
    one[0] = 1;
    for peer in [[0; 32], one] {
        let terms = HandshakeTerms { peer: &peer, ..ends.terms(1, CipherSuite::AesGcm) };
        assert!(ends.initiator.pair_secret(&peer).is_none());
        assert!(ends.initiator.write_init(terms, [1; 32], &[0; 12]).is_none());
    }
    let [ours, theirs] = [&ends.initiator, &ends.responder];
    assert_eq!(ours.pair_secret(&ends.publics[1]), theirs.pair_secret(&ends.publics[0]));
}

#[test]
fn what_is_sealed_opens_under_its_nonce_and_no_other_and_not_once_a_bit_is_changed() {
    for suite in SUITES {
        let keys = ChannelKeys { seal: [1; 32], open: [1; 32] };
        let mut cipher = AeadCipher::new(suite, &keys);
        let mut frame = BytesMut::from("plain");
        cipher.seal(5, &mut frame, 0);
        assert_eq!(frame.len(), 5 + 16);

        let mut copy = frame.to_vec();
        assert_eq!(cipher.open(5, &mut copy), Some(5));
        assert_eq!(&copy[..5], b"plain");
        assert_eq!(cipher.open(6, &mut frame.to_vec()), None);
        for bit in 0..frame.len() * 8 {
            let mut changed = frame.to_vec();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(cipher.open(5, &mut changed), None);
        }
        for length in 0..frame.len() {
            assert_eq!(cipher.open(5, &mut frame[..length].to_vec()), None);
        }
    }
}

/// RFC 4231, test cases 1, 2 and 6.
#[test]
fn hmac_gives_the_answers_of_rfc_4231() {
    let check = |key: &[u8], data: &[u8], expected: &str| {
        let (front, back) = data.split_at(data.len() / 2);
        let key = MacKey::new(key);
        assert_eq!(hex(&key.mac(&[front, back])), expected);
        let short = key.short_mac(&[data]);
        assert_eq!(hex(&short), expected[..16]);
        assert!(key.verify_short(&[data], &short));
        assert!(!key.verify_short(&[data], &short[..7]) && !key.verify_short(&[data], &[]));
        for bit in 0..64 {
            let mut changed = short;
            changed[bit / 8] ^= 1 << (bit % 8);
            assert!(!key.verify_short(&[data], &changed));
        }
    };
    check(
        &[0x0b; 20],
        b"Hi There",
        "b0344c61d8db38535ca8afceaf0bf12b881dc200c9833da726e9376c2e32cff7",
    );
    check(
        b"Jefe",
        b"what do ya want for nothing?",
        "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843",
    );
    check(
        &[0xaa; 131],
        b"Test Using Larger Than Block-Size Key - Hash Key First",
        "60e431591ee0b67f0d8a26aacbf5b77f8e0bc6213728c5140546040f0ee37f54",
    );
}

/// RFC 5869, A.1 to A.3.
#[test]
fn hkdf_gives_the_answers_of_rfc_5869() {
    let check = |secret: &[u8], salt: &[u8], info: &[u8], expected: &str| {
        let mut out = vec![0; expected.len() / 2];
        hkdf_sha256(salt, secret, info, &mut out);
        assert_eq!(hex(&out), expected);
    };
    let counted = |from: u8, to: u8| (from..=to).collect::<Vec<u8>>();
    check(
        &[0x0b; 22],
        &counted(0, 0x0c),
        &counted(0xf0, 0xf9),
        "3cb25f25faacd57a90434f64d0362f2a2d2d0a90cf1a5a4c5db02d56ecc4c5bf34007208d5b887185865",
    );
    check(
        &counted(0, 0x4f),
        &counted(0x60, 0xaf),
        &counted(0xb0, 0xff),
        "b11e398dc80327a1c8e7f78c596a49344f012eda2d4efad8a050cc4c19afa97c59045a99cac7827271cb41c65e\
         590e09da3275600c2f09b8367793a9aca3db71cc30c58179ec3e87c14c01d5c1f3434f1d87",
    );
    check(
        &[0x0b; 22],
        &[],
        &[],
        "8da4e775a563c18f715f802a063c5a31b8a11f5c5ee1879ec3454e5f3c738d2d9d201395faa4b61a96c8",
    );
}

#[test]
fn a_cookie_opens_for_the_message_that_it_answers_only() {
    let cipher = CookieCipher::new(&bytes::<32>(&"ab".repeat(32)));
    let sealed = cipher.seal([1; 12], &[2; 8], [3; 16]);

    assert_eq!(cipher.open([1; 12], &[2; 8], sealed), Some([3; 16]));
    assert_eq!(cipher.open([1; 12], &[9; 8], sealed), None);
    assert_eq!(cipher.open([9; 12], &[2; 8], sealed), None);
    assert_eq!(CookieCipher::new(&[0; 32]).open([1; 12], &[2; 8], sealed), None);
}

#[test]
fn seeds_differ_from_each_other_and_from_those_of_another_seed() {
    let sequence = |seed| {
        let mut generator = SeedGenerator::new(seed);
        [(); 100].map(|()| generator.next_seed())
    };
    let mut all = [sequence([1; 32]), sequence([2; 32])].concat();

    assert_eq!(sequence([1; 32]), all[..100]);
    all.sort();
    all.dedup();
    assert_eq!(all.len(), 200);
}

#[test]
fn secrets_are_not_printed() {
    let ends = Ends::new();
    let printed =
        format!("{:?} {:?}", ends.initiator, ChannelKeys { seal: [1; 32], open: [2; 32] });
    assert_eq!(printed, "NoiseCrypto(…) ChannelKeys(…)");
}
