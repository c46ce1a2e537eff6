//! When two parties bind, and what they are told when they do not.

use blastema_core::contract::codec::{decode_bounded, encode_bounded};
use blastema_core::contract::layout::difference::{ContractPart, compare};
use blastema_core::contract::layout::{Field, Fields, Primitive, Shape};
use blastema_core::{
    ContractIdentity, DecodeError, Described, FaultKind, FaultLocation, LayoutDescription,
    Lifecycle, ObjectAddress, PeerIdentity,
};
use blastema_macros::{Event, Request, Structure};
use std::sync::Arc;
use std::time::Duration;

/// The contract of both sides, of the parts that the module has.
macro_rules! state {
    () => {
        /// A comment does not count.
        #[derive(Clone, Event)]
        #[contract(name = "robot/state", crate = "crate::facade")]
        pub(crate) struct State {
            #[contract(unit = "m", frame = "laser")]
            pub ranges: Vec<f32>,
            pub left: f64,
            pub right: f64,
            pub pose: Pose,
            pub mode: Mode,
            pub plan: Option<Step>,
        }
    };
}

/// The types of one side. The other side's differ in one thing each.
mod here {
    use super::*;

    state! {}

    #[derive(Clone, Structure)]
    #[contract(crate = "crate::facade")]
    pub(crate) struct Pose {
        pub x: f64,
        pub y: f64,
        pub heading: f64,
    }

    #[derive(Clone, Structure)]
    #[contract(crate = "crate::facade")]
    pub(crate) enum Mode {
        Idle,
        Moving { speed: f32 },
        Charging(u8, u8),
    }

    /// A structure that contains itself.
    #[derive(Clone, Structure)]
    #[contract(crate = "crate::facade")]
    pub(crate) struct Step {
        pub then: Vec<Step>,
        pub otherwise: Option<Box<Step>>,
        pub name: String,
    }
}

/// Defines the other side's `State` in a module of its own, with the parts that are not given taken
/// from `here`, and gives the lines of the difference.
macro_rules! lines {
    ($($item:item)*) => {{
        mod there {
            use super::here::*;
            use super::*;
            $($item)*
        }
        lines_between(ContractIdentity::of::<here::State>(), ContractIdentity::of::<there::State>())
    }};
}

fn lines_between(here: ContractIdentity, there: ContractIdentity) -> Vec<String> {
    // The description travels, as it does between nodes.
    let peer = PeerIdentity::decode(&there.full().encode()).unwrap();
    match here.check(&peer) {
        Ok(()) => Vec::new(),
        Err(difference) => difference.lines,
    }
}

#[test]
fn parties_that_mean_the_same_bind_whatever_their_types_are_called_and_commented() {
    let lines = lines! {
        // Another identifier, another comment, another type for the same sequence and text.
        #[derive(Clone, Event)]
        #[contract(name = "robot/state", crate = "crate::facade")]
        pub(crate) struct TheState {
            #[contract(frame = "laser", unit = "m")]
            pub ranges: std::collections::VecDeque<f32>,
            pub left: f64,
            pub right: f64,
            pub pose: Box<Pose>,
            pub mode: Arc<Mode>,
            pub plan: Option<Step>,
        }
        pub(crate) type State = TheState;

        #[derive(Clone, Structure)]
        #[contract(crate = "crate::facade")]
        pub(crate) struct Step {
            pub then: Arc<[Step]>,
            pub otherwise: Box<Option<Step>>,
            pub name: Arc<str>,
        }
    };

    assert_eq!(lines, Vec::<String>::new());
}

#[test]
fn a_field_of_another_type_is_shown_with_both_types() {
    let lines = lines! {
        #[derive(Clone, Event)]
        #[contract(name = "robot/state", crate = "crate::facade")]
        pub(crate) struct State {
            #[contract(unit = "m", frame = "laser")]
            pub ranges: Vec<f64>,
            pub left: f64,
            pub right: [f64; 2],
            pub pose: Vec<Pose>,
            pub mode: Option<(Mode, u8)>,
            pub plan: Option<Step>,
        }
    };

    assert_eq!(
        lines,
        [
            "field `right`: f64 here, array of 2 f64 there",
            "field `pose`: Pose here, sequence of Pose there",
            "field `mode`: enumeration Mode here, optional (enumeration Mode, u8) there",
            "field `ranges`: sequence of f32 here, sequence of f64 there",
        ]
    );
}

#[test]
fn exchanged_renamed_added_and_removed_fields_are_named() {
    let lines = lines! {
        #[derive(Clone, Event)]
        #[contract(name = "robot/state", crate = "crate::facade")]
        pub(crate) struct State {
            #[contract(unit = "m", frame = "laser")]
            pub ranges: Vec<f32>,
            pub right: f64,
            pub left: f64,
            pub pose: Pose,
            pub mode: Mode,
            pub goal: Option<Step>,
        }

        #[derive(Clone, Structure)]
        #[contract(crate = "crate::facade")]
        pub(crate) struct Pose {
            pub y: f64,
            pub x: f64,
            pub z: f64,
        }

        #[derive(Clone, Structure)]
        #[contract(crate = "crate::facade")]
        pub(crate) struct Step {
            pub otherwise: Option<Box<Step>>,
            pub name: String,
            pub then: Vec<Step>,
            pub cost: f32,
        }
    };

    assert_eq!(
        lines,
        [
            "field `plan`: only here",
            "field `goal`: only there",
            "the fields of the message stand in another order: \
             ranges, left, right, pose, mode here; ranges, right, left, pose, mode there",
            "field `pose.heading`: only here",
            "field `pose.z`: only there",
            "the fields of `pose` stand in another order: x, y here; y, x there",
        ]
    );
}

#[test]
fn a_difference_deep_inside_a_recursive_type_is_found_once() {
    let lines = lines! {
        state! {}

        #[derive(Clone, Structure)]
        #[contract(crate = "crate::facade")]
        pub(crate) struct Step {
            pub otherwise: Option<Box<Step>>,
            pub name: String,
            pub then: Vec<Step>,
            pub cost: f32,
        }
    };

    assert_eq!(
        lines,
        [
            "field `plan.cost`: only there",
            "the fields of `plan` stand in another order: then, otherwise, name here; \
             otherwise, name, then there",
        ]
    );
}

#[test]
fn units_and_frames_count() {
    let lines = lines! {
        #[derive(Clone, Event)]
        #[contract(name = "robot/state", crate = "crate::facade")]
        pub(crate) struct State {
            #[contract(unit = "cm")]
            pub ranges: Vec<f32>,
            #[contract(unit = "rad")]
            pub left: f64,
            pub right: f64,
            pub pose: Pose,
            pub mode: Mode,
            pub plan: Option<Step>,
        }
    };

    assert_eq!(
        lines,
        [
            "field `ranges`: unit `m` here, `cm` there",
            "field `ranges`: frame `laser` here, none there",
            "field `left`: unit none here, `rad` there",
        ]
    );
}

#[test]
fn variants_are_compared_by_name_order_and_fields() {
    let lines = lines! {
        state! {}

        #[derive(Clone, Structure)]
        #[contract(crate = "crate::facade")]
        pub(crate) enum Mode {
            Moving { speed: f64 },
            Idle,
            Charging,
            Broken,
        }
    };

    assert_eq!(
        lines,
        [
            "variant `mode::Broken`: only there",
            "the variants of `mode` stand in another order: \
             Idle, Moving, Charging here; Moving, Idle, Charging there",
            "field `mode::Charging`: fields without names here, no fields there",
            "field `mode::Moving.speed`: f32 here, f64 there",
        ]
    );
}

#[derive(Request)]
#[contract(name = "nearest", reply = f32, crate = "crate::facade")]
struct Nearest {
    _within: f32,
}

#[derive(Request)]
#[contract(name = "nearest", version = 2, reply = Option<f32>, crate = "crate::facade")]
struct NewNearest {
    _within: f32,
}

#[test]
fn versions_and_replies_are_compared_too_and_a_difference_reads_as_text() {
    let peer = ContractIdentity::of::<NewNearest>();

    let difference = ContractIdentity::of::<Nearest>().check(&peer.full()).unwrap_err();

    assert_eq!(
        difference.to_string(),
        "contract `nearest`: version 1 here, 2 there\nthe reply: f32 here, optional f32 there"
    );
}

#[test]
fn a_peer_that_sends_no_structure_is_judged_by_its_fingerprint() {
    let identity = ContractIdentity::of::<Nearest>();
    let peer = PeerIdentity { fingerprint: 1, ..identity.brief() };

    assert_eq!(identity.check(&identity.brief()), Ok(()));
    let lines = identity.check(&peer).unwrap_err().lines;
    assert_eq!(lines.len(), 1);
    assert!(lines[0].ends_with("here, 0000000000000001 there"), "{lines:?}");
}

#[test]
fn fingerprints_are_the_same_in_every_build_and_on_every_platform() {
    let fingerprint = |identity: ContractIdentity| format!("{:016x}", identity.fingerprint);
    let found = [
        fingerprint(ContractIdentity::of::<here::State>()),
        fingerprint(ContractIdentity::of::<Nearest>()),
        fingerprint(ContractIdentity::of::<NewNearest>()),
        fingerprint(ContractIdentity::of::<Words>()),
    ];

    let golden = include_str!("golden/fingerprints.txt").lines().collect::<Vec<_>>();
    assert_eq!(found.as_slice(), golden);
}

/// The middleware's own words may stand in contracts.
#[derive(Clone, Event)]
#[contract(crate = "crate::facade")]
struct Words {
    _place: FaultLocation,
    _address: ObjectAddress,
    _kind: FaultKind,
    _state: Lifecycle,
    _since: Duration,
}

#[test]
fn identities_of_the_same_contract_bind_after_travelling() {
    for identity in [ContractIdentity::of::<Words>(), ContractIdentity::of::<here::State>()] {
        let peer = PeerIdentity::decode(&identity.full().encode()).unwrap();

        assert_eq!(peer, identity.full());
        assert!(peer.structure.is_some());
        assert_eq!(identity.check(&peer), Ok(()));
    }
}

#[track_caller]
fn check_refused(types: Vec<Shape<u32>>, expected: &str) {
    assert_eq!(LayoutDescription::try_from(types.clone()), Err(expected.to_owned()));

    let mut bytes = Vec::new();
    encode_bounded(&types, usize::MAX, &mut bytes).unwrap();
    let decoded = decode_bounded::<LayoutDescription, 65536>(&bytes);
    assert_eq!(decoded, Err(DecodeError::Malformed { reason: expected.to_string() }));
}

#[test]
fn an_unsound_description_is_refused() {
    let named = |name: &str| Shape::Struct(name.to_owned().into(), Fields::Unit);

    check_refused(vec![], "the description is empty");
    check_refused(vec![named("A"); 513], "the description holds 513 types; at most 512 are taken");
    check_refused(vec![Shape::Sequence(1)], "the description refers to type 1 of 1");
    let unprintable = "the description holds a name or unit that cannot be shown";
    check_refused(vec![named("red \u{1b}[31m")], unprintable);
    check_refused(vec![named(&"n".repeat(129))], unprintable);
}

#[test]
fn a_description_that_goes_in_circles_is_compared_nevertheless() {
    let circle = LayoutDescription::try_from(vec![Shape::Sequence(0)]).unwrap();
    let pairs = LayoutDescription::try_from(vec![Shape::Tuple(vec![0; 2000].into())]).unwrap();

    assert_eq!(compare(ContractPart::Message, &circle, &circle), Vec::<String>::new());
    assert_eq!(compare(ContractPart::Message, &pairs, &pairs), Vec::<String>::new());
    let lines = compare(ContractPart::Reply, &circle, &pairs);
    assert_eq!(lines.len(), 1);
    assert!(lines[0].starts_with("the reply: sequence of sequence of "), "{lines:?}");
    assert!(lines[0].len() < 250, "{lines:?}");
}

#[test]
fn a_name_that_would_write_over_the_screen_is_refused() {
    let identity = ContractIdentity::of::<Nearest>();
    let peer = PeerIdentity { name: "red \u{1b}[31m".into(), ..identity.brief() };

    let refused = PeerIdentity::decode(&peer.encode());

    assert!(matches!(refused, Err(DecodeError::Malformed { .. })), "{refused:?}");
}

#[test]
fn a_hostile_description_costs_a_bounded_number_of_short_lines() {
    // 500 steps, each another type, that grow apart from ours only at their ends.
    let field =
        |name: &str, of| Field { name: name.to_owned().into(), unit: None, frame: None, of };
    let step = |index: u32, tag: &str| {
        let mut fields = vec![field("then", index), field("otherwise", 2), field("name", 1)];
        fields.extend((0..5).map(|extra| field(&format!("{tag}{index}_{extra}"), 1)));
        Shape::Struct("Step".into(), Fields::Named(fields.into()))
    };
    let mut types = vec![step(3, "a"), Shape::Leaf(Primitive::Text), Shape::Optional(3)];
    types.extend((3..511).map(|index| step(index + 1, "b")));
    types.push(Shape::Sequence(0));
    let hostile = LayoutDescription::try_from(types).unwrap();
    let ours = LayoutDescription::of(here::Step::layout());

    let lines = compare(ContractPart::Message, &ours, &hostile);

    assert!((2..=25).contains(&lines.len()), "{lines:?}");
    assert!(lines.iter().all(|line| line.len() < 1000), "{lines:?}");
}

#[test]
fn an_identity_changed_in_any_byte_is_refused_or_compared() {
    let whole = ContractIdentity::of::<here::State>().full().encode();
    for index in 0..whole.len() {
        for flip in [0x01, 0x1f, 0x80, 0xff] {
            let mut bytes = whole.clone();
            bytes[index] ^= flip;
            if let Ok(peer) = PeerIdentity::decode(&bytes) {
                drop(ContractIdentity::of::<here::State>().check(&peer));
            }
        }
    }
}

/// Two structures of 2^40 leaves, if each were walked through.
mod broad {
    use super::*;

    macro_rules! doubled {
        ($name:ident = $inner:ty $(, $next:ident = $then:ty)* $(,)?) => {
            #[derive(Clone, Structure)]
            #[contract(crate = "crate::facade")]
            pub(crate) struct $name(pub $inner, pub Vec<$inner>);
            $(doubled! { $next = $then })*
        };
    }

    doubled! { A0 = u8 }
    doubled! { A1 = A0, A2 = A1, A3 = A2, A4 = A3, A5 = A4, A6 = A5, A7 = A6, A8 = A7, A9 = A8 }
    doubled! { B0 = A9, B1 = B0, B2 = B1, B3 = B2, B4 = B3, B5 = B4, B6 = B5, B7 = B6, B8 = B7 }
    doubled! { C0 = B8, C1 = C0, C2 = C1, C3 = C2, C4 = C3, C5 = C4, C6 = C5, C7 = C6, C8 = C7 }
    doubled! { D0 = C8, D1 = D0, D2 = D1, D3 = D2, D4 = D3, D5 = D4, D6 = D5, D7 = D6, D8 = D7 }

    #[derive(Clone, Event)]
    #[contract(crate = "crate::facade")]
    pub(crate) struct Broad(pub D8, pub u8);

    #[derive(Clone, Event)]
    #[contract(crate = "crate::facade")]
    pub(crate) struct AlsoBroad(pub D8, pub i8);
}

#[test]
fn a_broad_and_deep_structure_costs_no_more_than_its_types() {
    let (here, there) =
        (ContractIdentity::of::<broad::Broad>(), ContractIdentity::of::<broad::AlsoBroad>());

    let lines = lines_between(here.clone(), there);

    assert_eq!(lines, ["name `Broad` here, `AlsoBroad` there", "field `1`: u8 here, i8 there"]);
    let structure = here.full().structure.unwrap();
    assert_eq!(structure.message.types().len(), 76);
}
