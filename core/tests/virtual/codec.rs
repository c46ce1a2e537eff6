//! Messages as bytes: what travels, and what is refused.

use blastema_core::contract::codec::{
    decode, decode_bounded, decode_reply, encode, encode_bounded, encode_parcel_reply,
};
use blastema_core::contract::field::DEPTH_LIMIT;
use blastema_core::{Contract, DecodeError, EncodeError};
use blastema_macros::{Event, Request, Structure};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::fmt::{Debug, Write};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(max_size = 64, crate = "crate::facade")]
struct Scan {
    ranges: Vec<f32>,
    raw: Vec<u8>,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(crate = "crate::facade")]
struct Everything {
    numbers: (u8, u16, u32, u64, u128, i8, i16, i32, i64, i128),
    rest: (f32, f64, bool, char),
    text: String,
    raw: Vec<u8>,
    fixed: [u16; 2],
    map: BTreeMap<String, Option<u32>>,
    age: Duration,
    tree: Tree,
    results: Vec<Result<(), u8>>,
}

#[derive(Clone, Debug, PartialEq, Structure)]
#[contract(crate = "crate::facade")]
enum Tree {
    Leaf,
    Value(i32),
    Node { children: Vec<Tree>, best: Option<Box<Tree>> },
}

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = Tree, max_size = 256, crate = "crate::facade")]
struct Plan(Tree);

fn everything() -> Everything {
    Everything {
        numbers: (250, 251, 65_536, 1 << 32, 1 << 64, -1, -300, -70_000, -1 << 40, i128::MIN),
        rest: (1.5, -0.1, true, 'ß'),
        text: "laser".into(),
        raw: vec![0, 128, 255],
        fixed: [1, 300],
        map: BTreeMap::from([("a".into(), None), ("b".into(), Some(7))]),
        age: Duration::from_millis(1500),
        tree: Tree::Node {
            children: vec![Tree::Leaf, Tree::Value(-3)],
            best: Some(Box::new(Tree::Leaf)),
        },
        results: vec![Ok(()), Err(9)],
    }
}

fn bytes_of<M: Contract>(message: &M) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode(message, &mut bytes).unwrap();
    bytes
}

#[test]
fn the_bytes_of_a_message_never_change() {
    let mut text = String::new();
    for byte in bytes_of(&everything()) {
        write!(text, "{byte:02x}").unwrap();
    }

    assert_eq!(text, include_str!("golden/everything.hex").trim_end());
    assert_eq!(decode::<Everything>(&bytes_of(&everything())), Ok(everything()));
}

#[test]
fn bytes_in_one_piece_and_numbers_one_by_one_look_the_same_on_the_wire() {
    #[derive(Debug, PartialEq, Event, Clone)]
    #[contract(crate = "crate::facade")]
    struct OneByOne {
        raw: std::collections::VecDeque<u8>,
    }
    #[derive(Debug, PartialEq, Event, Clone)]
    #[contract(crate = "crate::facade")]
    struct OnePiece {
        raw: Vec<u8>,
    }

    let raw: Vec<u8> = (0..=255).collect();

    let one_by_one = bytes_of(&OneByOne { raw: raw.clone().into() });
    assert_eq!(one_by_one, bytes_of(&OnePiece { raw }));
}

#[test]
fn a_message_is_put_at_the_end_of_the_buffer() {
    let scan = Scan { ranges: vec![1.0], raw: vec![7] };
    let mut buffer = b"header".to_vec();

    encode(&scan, &mut buffer).unwrap();

    assert_eq!(&buffer[..6], b"header");
    assert_eq!(decode(&buffer[6..]), Ok(scan));
}

#[test]
fn a_message_above_its_limit_is_neither_encoded_nor_decoded() {
    let fits = Scan { ranges: vec![], raw: vec![1; 62] };
    let large = Scan { ranges: vec![], raw: vec![1; 63] };
    let mut buffer = b"header".to_vec();

    assert_eq!(bytes_of(&fits).len(), 64);
    assert_eq!(encode(&large, &mut buffer), Err(EncodeError::TooLarge { limit: 64 }));
    assert_eq!(buffer, b"header");

    encode_bounded(&large, 65, &mut buffer).unwrap();
    let refused = decode::<Scan>(&buffer[6..]);
    assert_eq!(refused, Err(DecodeError::TooLarge { size: 65, limit: 64 }));
    assert_eq!(decode_bounded::<Scan, 65>(&buffer[6..]), Ok(large));
}

#[test]
fn a_message_of_full_size_is_read_whatever_its_numbers_take() {
    // One byte on the wire and 16 in the codec's count.
    let numbers = vec![0u128; 4000];
    let mut buffer = Vec::new();

    encode_bounded(&numbers, 4096, &mut buffer).unwrap();

    assert_eq!(decode_bounded::<Vec<u128>, 4096>(&buffer), Ok(numbers));
}

#[test]
fn a_reply_obeys_the_limit_of_its_request() {
    let (small, large) =
        (Tree::Value(1), Tree::Node { children: vec![Tree::Leaf; 300], best: None });

    let refused = encode_parcel_reply::<Plan>(&large).err();
    let sent = encode_parcel_reply::<Plan>(&small).unwrap().into_bytes();

    assert_eq!(refused, Some(EncodeError::TooLarge { limit: 256 }));
    assert_eq!(decode_reply::<Plan>(&sent), Ok(small));
    let refused = decode_reply::<Plan>(&[0; 257]);
    assert_eq!(refused, Err(DecodeError::TooLarge { size: 257, limit: 256 }));
}

#[test]
fn bytes_after_the_message_are_refused() {
    let mut bytes = bytes_of(&Scan { ranges: vec![], raw: vec![] });
    bytes.extend([0; 3]);

    assert_eq!(decode::<Scan>(&bytes), Err(DecodeError::Trailing { count: 3 }));
}

#[test]
fn every_beginning_of_a_message_is_refused_as_cut_short() {
    let bytes = bytes_of(&everything());
    for length in 0..bytes.len() {
        assert_eq!(decode::<Everything>(&bytes[..length]), Err(DecodeError::Truncated), "{length}");
    }
}

#[test]
fn an_absurd_length_is_refused_without_taking_memory_for_it() {
    // 253 announces a number of eight bytes: 2^63 - 1 elements.
    let absurd = [&[253u8][..], &[0xff; 7], &[0x7f]].concat();

    let sequence = decode::<Scan>(&absurd);
    let bytes = decode::<Scan>(&[&[0][..], &absurd].concat());
    let text = decode_bounded::<String, 4096>(&absurd);
    let map = decode_bounded::<BTreeMap<u8, u8>, 4096>(&absurd);

    assert_eq!(sequence, Err(DecodeError::Truncated));
    assert_eq!(bytes, Err(DecodeError::Truncated));
    assert_eq!(text, Err(DecodeError::Truncated));
    assert_eq!(map, Err(DecodeError::Truncated));
}

#[test]
fn bytes_that_mean_no_value_say_what_is_wrong() {
    let wrong = |result: Result<(), DecodeError>| match result {
        Err(DecodeError::Malformed { reason }) => reason,
        other => panic!("{other:?}"),
    };

    let variant = wrong(decode_bounded::<Tree, 64>(&[9]).map(drop));
    let utf8 = wrong(decode_bounded::<String, 64>(&[1, 0xff]).map(drop));
    let boolean = wrong(decode_bounded::<bool, 64>(&[2]).map(drop));
    let nanos = wrong(decode_bounded::<Duration, 64>(&[[253; 9], [253; 9]].concat()).map(drop));

    assert!(variant.contains("variant index 0 <= i < 3"), "{variant}");
    assert!(utf8.contains("Utf8"), "{utf8}");
    assert!(boolean.contains("InvalidBooleanValue(2)"), "{boolean}");
    assert!(!nanos.is_empty());
}

fn nested(depth: u32) -> Tree {
    let node = |child| Tree::Node { children: vec![], best: Some(Box::new(child)) };
    (1..depth).fold(Tree::Leaf, |tree, _| node(tree))
}

#[test]
fn structures_nest_to_a_depth_and_no_deeper_in_either_direction() {
    let (deep, too_deep) = (nested(DEPTH_LIMIT), nested(DEPTH_LIMIT + 1));
    let mut bytes = Vec::new();

    encode_bounded(&deep, 4096, &mut bytes).unwrap();
    assert_eq!(decode_bounded::<Tree, 4096>(&bytes), Ok(deep.clone()));

    let reason = "structures are nested more than 32 deep".to_string();
    let refused = encode_bounded(&too_deep, 4096, &mut Vec::new());
    assert_eq!(refused, Err(EncodeError::Impossible { reason: reason.clone() }));

    // A node without children whose best is a node, and so on: what a hostile peer would send.
    let hostile = [2, 0, 1].repeat(100_000);
    let refused = decode_bounded::<Tree, 1_000_000>(&hostile);
    assert_eq!(refused, Err(DecodeError::Malformed { reason }));

    // A refusal leaves the count as it was.
    assert_eq!(decode_bounded::<Tree, 4096>(&bytes), Ok(deep));
}

#[test]
fn the_deepest_nesting_of_large_structures_fits_half_of_a_usual_stack() {
    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(crate = "crate::facade")]
    struct Large {
        covariance: [f64; 36],
        pose: (f64, f64, f64),
        next: Option<Box<Large>>,
    }

    let check = || {
        let large = |next| Large { covariance: [0.5; 36], pose: (1.0, 2.0, 3.0), next };
        let deep = (1..DEPTH_LIMIT).fold(large(None), |next, _| large(Some(Box::new(next))));
        let bytes = bytes_of(&deep);
        assert_eq!(decode::<Large>(&bytes), Ok(deep));
    };
    std::thread::Builder::new().stack_size(1024 * 1024).spawn(check).unwrap().join().unwrap();
}

fn any_tree() -> impl Strategy<Value = Tree> {
    let leaf = prop_oneof![Just(Tree::Leaf), any::<i32>().prop_map(Tree::Value)];
    leaf.prop_recursive(4, 24, 4, |inner| {
        (prop::collection::vec(inner.clone(), 0..4), prop::option::of(inner.prop_map(Box::new)))
            .prop_map(|(children, best)| Tree::Node { children, best })
    })
}

prop_compose! {
    fn any_everything()(
        numbers in any::<(u8, u16, u32, u64, u128, i8, i16, i32, i64, i128)>(),
        // Not-a-number is no equal of itself; its bits are compared below.
        rest in (-1e9f32..1e9, -1e9f64..1e9, any::<bool>(), any::<char>()),
        text in ".{0,20}",
        raw in any::<Vec<u8>>(),
        fixed in any::<[u16; 2]>(),
        map in any::<BTreeMap<String, Option<u32>>>(),
        age in any::<Duration>(),
        tree in any_tree(),
        results in any::<Vec<Result<(), u8>>>(),
    ) -> Everything {
        Everything { numbers, rest, text, raw, fixed, map, age, tree, results }
    }
}

#[track_caller]
fn check_any_bytes<
    T: crate::facade::serde::de::DeserializeOwned + crate::facade::serde::Serialize + Debug,
>(
    bytes: &[u8],
) {
    if let Ok(value) = decode_bounded::<T, 4096>(bytes) {
        let mut again = Vec::new();
        encode_bounded(&value, 4096, &mut again).unwrap();
        decode_bounded::<T, 4096>(&again).unwrap();
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn whatever_is_encoded_is_decoded_to_the_same(message in any_everything()) {
        let mut bytes = Vec::new();
        encode_bounded(&message, 1 << 20, &mut bytes).unwrap();
        prop_assert_eq!(decode_bounded::<Everything, { 1 << 20 }>(&bytes).unwrap(), message);
    }

    #[test]
    fn floats_keep_their_bits(bits in any::<u64>()) {
        let mut bytes = Vec::new();
        encode_bounded(&f64::from_bits(bits), 8, &mut bytes).unwrap();
        prop_assert_eq!(decode_bounded::<f64, 8>(&bytes).unwrap().to_bits(), bits);
    }

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..512)) {
        check_any_bytes::<Everything>(&bytes);
        check_any_bytes::<Tree>(&bytes);
        check_any_bytes::<Scan>(&bytes);
        check_any_bytes::<blastema_core::PeerIdentity>(&bytes);
        check_any_bytes::<blastema_core::FaultLocation>(&bytes);
    }

    #[test]
    fn a_message_changed_in_one_byte_never_panics(
        message in any_everything(),
        place in any::<prop::sample::Index>(),
        byte in any::<u8>(),
    ) {
        let mut bytes = Vec::new();
        encode_bounded(&message, 4096, &mut bytes).ok();
        if !bytes.is_empty() {
            *place.get_mut(&mut bytes) = byte;
        }
        check_any_bytes::<Everything>(&bytes);
    }
}
