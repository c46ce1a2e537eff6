//! What the derives make of right uses. Wrong uses stand in `tests/derives`.

use blastema_core::contract::codec::{decode, encode};
use blastema_core::contract::packed::{pack, size, unpack};
use blastema_core::{Contract, ContractIdentity, Described, EncodeError, LayoutDescription};
use blastema_macros::{Event, Request, Structure};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

/// One sweep of the laser.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "laser/scan", version = 3, max_age = "100ms", max_size = 4 * 1024)]
#[contract(crate = "crate::facade")]
struct Scan {
    #[contract(unit = "m", frame = "laser")]
    ranges: Vec<f32>,
    raw: Vec<u8>,
    covariance: [f64; 36],
}

#[derive(Debug, PartialEq, Request)]
#[contract(reply = Option<f32>, crate = "crate::facade")]
struct Nearest {
    #[contract(unit = "rad")]
    within: f32,
}

/// A contract with bounds, and the same without.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "arm/plan", crate = "crate::facade")]
struct Plan {
    #[contract(at_most = 8)]
    title: String,
    #[contract(at_most = 2, unit = "rad")]
    steps: Vec<u16>,
    #[contract(at_most = 3)]
    raw: Vec<u8>,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "arm/plan", crate = "crate::facade")]
struct EndlessPlan {
    title: String,
    #[contract(unit = "rad")]
    steps: Vec<u16>,
    raw: Vec<u8>,
}

#[test]
fn a_bound_is_checked_on_both_sides_is_part_of_the_structure_and_gives_a_packed_form() {
    let plan = |title: &str, steps: &[u16]| EndlessPlan {
        title: title.to_owned(),
        steps: steps.to_vec(),
        raw: vec![1],
    };
    let bounded = |EndlessPlan { title, steps, raw }: EndlessPlan| Plan { title, steps, raw };
    fn encoded<M: Contract>(message: &M) -> Result<Vec<u8>, EncodeError> {
        let mut bytes = Vec::new();
        encode(message, &mut bytes).map(|()| bytes)
    }
    let right = plan("lift", &[7, 9]);
    let bytes = encoded(&right).expect("it is encoded");
    assert_eq!(encoded(&bounded(right.clone())), Ok(bytes.clone()), "no byte more");
    assert_eq!(decode::<Plan>(&bytes), Ok(bounded(right.clone())));
    for (wrong, text) in [
        (plan("lift it up", &[]), "10 where at most 8 may be"),
        (plan("lift", &[1, 2, 3]), "3 where at most 2 may be"),
    ] {
        let bytes = encoded(&wrong).expect("it has no bound");
        let error = decode::<Plan>(&bytes).expect_err("the receiver has one").to_string();
        assert!(error.contains(text), "{error}");
        let error = encoded(&bounded(wrong)).expect_err("the sender has one").to_string();
        assert!(error.contains(text), "{error}");
    }
    let (ours, theirs) = (ContractIdentity::of::<Plan>(), ContractIdentity::of::<EndlessPlan>());
    assert_ne!(ours.fingerprint, theirs.fingerprint);

    let right = bounded(right);
    let packed_form = pack(&right).expect("it has a packed form");
    assert_eq!(packed_form, [&b"\x04lift\0\0\0\0"[..], &[2, 7, 0, 9, 0], &[1, 1, 0, 0]].concat());
    assert_eq!(unpack::<Plan>(&packed_form), Ok(right));
    for (at, byte) in [(0, 9), (5, 1), (9, 3), (17, 1)] {
        let mut wrong = packed_form.clone();
        wrong[at] = byte;
        assert!(unpack::<Plan>(&wrong).is_err(), "byte {at}");
    }
}

#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate::facade")]
struct Step {
    #[contract(at_most = 2)]
    parts: Vec<Step>,
}

#[test]
fn a_bounded_type_that_contains_itself_has_no_packed_form() {
    let step = Step { parts: Vec::new() };
    assert!(step.parts.is_empty() && size(Step::layout).is_err());
}

#[derive(Clone, Debug, PartialEq, Structure)]
#[contract(crate = "crate::facade")]
enum Tree {
    Leaf,
    Pair(Box<Tree>, Box<Tree>),
    Many { children: Vec<Tree>, r#type: String },
}

#[derive(Clone, Debug, PartialEq, Structure)]
#[contract(crate = "crate::facade")]
struct Stamped<T, const N: usize = 2>
where
    T: Copy,
{
    at: Duration,
    values: [T; N],
    earlier: Option<Box<Stamped<T, N>>>,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "pair", crate = "crate::facade")]
struct Pair<A, B>(A, B);

#[derive(Clone, Debug, PartialEq, Structure)]
#[contract(crate = "crate::facade")]
struct Nothing;

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(crate = "crate::facade")]
struct Everything {
    small: (u8, i8, u16, i16, u32, i32, bool, char),
    large: (u64, i64, u128, i128, f32, f64),
    text: String,
    shared_text: (Arc<str>, Box<str>),
    shared: (Arc<[u16]>, Box<[i16]>, Arc<u8>),
    nothing: (),
    also_nothing: Nothing,
    map: BTreeMap<String, BTreeSet<u32>>,
    queue: VecDeque<Result<u8, String>>,
    tree: Tree,
    stamped: Stamped<f32, 3>,
    long: [[u8; 4]; 40],
    bytes: Option<Vec<u8>>,
    _private: Duration,
}

fn everything() -> Everything {
    Everything {
        small: (1, -1, 2, -2, 3, -3, true, 'ß'),
        large: (u64::MAX, i64::MIN, u128::MAX, i128::MIN, 0.5, -0.25),
        text: "text".into(),
        shared_text: ("a".into(), "b".into()),
        shared: ([1, 2].into(), [-1].into(), Arc::new(7)),
        nothing: (),
        also_nothing: Nothing,
        map: BTreeMap::from([("odd".into(), BTreeSet::from([1, 3]))]),
        queue: VecDeque::from([Ok(1), Err("no".into())]),
        tree: Tree::Pair(
            Tree::Leaf.into(),
            Box::new(Tree::Many { children: vec![Tree::Leaf], r#type: "t".into() }),
        ),
        stamped: Stamped {
            at: Duration::new(1, 2),
            values: [1.0, 2.0, 3.0],
            earlier: Some(Box::new(Stamped {
                at: Duration::ZERO,
                values: [0.0; 3],
                earlier: None,
            })),
        },
        long: [[9; 4]; 40],
        bytes: Some(vec![1, 2, 3]),
        _private: Duration::from_millis(5),
    }
}

#[track_caller]
fn check_round_trip<M: Contract + PartialEq + std::fmt::Debug>(message: &M) {
    let mut bytes = Vec::new();
    encode(message, &mut bytes).unwrap();
    assert_eq!(decode::<M>(&bytes).unwrap(), *message);
}

#[test]
fn every_kind_of_type_comes_out_as_it_went_in() {
    check_round_trip(&everything());
    check_round_trip(&Scan { ranges: vec![1.5], raw: vec![0, 255], covariance: [0.5; 36] });
    check_round_trip(&Nearest { within: 0.1 });
    check_round_trip(&Pair(1u8, vec![Tree::Leaf]));
    check_round_trip(&Pair(Nothing, ()));
}

#[test]
fn the_attributes_become_the_contract() {
    assert_eq!(Scan::NAME, "laser/scan");
    assert_eq!(Scan::VERSION, 3);
    assert_eq!(Scan::MAX_SIZE, 4096);
    assert_eq!(Scan::MAX_AGE, Some(Duration::from_millis(100)));

    assert_eq!((Nearest::NAME, Nearest::VERSION), ("Nearest", 1));
    assert_eq!(Nearest::MAX_AGE, None);
    let reply: <Nearest as Contract>::Reply = Some(1.0f32);
    assert_eq!(reply, Some(1.0));
}

#[test]
fn the_forms_of_a_generic_contract_are_told_apart_by_their_structure() {
    let (a, b) = (ContractIdentity::of::<Pair<u8, u8>>(), ContractIdentity::of::<Pair<u8, i8>>());

    let difference = a.check(&b.full()).unwrap_err();

    assert_eq!(difference.lines, ["field `1`: u8 here, i8 there"]);
}

#[test]
fn a_type_that_takes_no_bytes_knows_it() {
    let empty = [
        Nothing::EMPTY,
        Pair::<Nothing, ()>::EMPTY,
        <[(); 9]>::EMPTY,
        <[u8; 0]>::EMPTY,
        <((), Nothing)>::EMPTY,
        Box::<()>::EMPTY,
    ];
    let full = [Pair::<Nothing, u8>::EMPTY, Option::<()>::EMPTY, Tree::EMPTY, Vec::<u8>::EMPTY];

    assert_eq!(empty, [true; 6]);
    assert_eq!(full, [false; 4]);
}

#[test]
fn a_recursive_type_has_a_finite_description() {
    let description = LayoutDescription::of(Tree::layout());

    // The tree, its pointer-like parts, the sequence and the text.
    assert_eq!(description.types().len(), 3);
}
