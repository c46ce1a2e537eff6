//! Paths that drop large frames and carry hellos.

use super::*;
use crate::random::Random;

/// A cable of which each link knows that it may drop its largest frame.
fn probed() -> Cable {
    let mut cable = Cable::new(config("left", 1), config("right", 1));
    for end in &mut cable.ends {
        end.frame_size = FrameSize { medium: 1_472, path: Some(PathMtu::new(1_472, 0)) };
    }
    cable
}

fn limits(cable: &Cable) -> [usize; 2] {
    cable.ends.each_ref().map(Link::frame_limit)
}

/// The outputs of the left end.
fn of_left(cable: &Cable) -> Vec<&LinkOutput> {
    cable.outputs.iter().filter(|(_, end, _)| *end == 0).map(|(.., output)| output).collect()
}

#[test]
fn a_link_whose_path_carries_the_configured_size_comes_up_with_it() {
    let mut cable = probed();

    cable.run_until(10_000);

    let outputs = of_left(&cable);
    let up = LinkState::Up;
    assert!(
        matches!(outputs[..], [LinkOutput::FrameLimit, LinkOutput::Changed { state, .. }] if *state == up),
        "{outputs:?}"
    );
    assert_eq!((limits(&cable), cable.ends[0].shortfall()), ([1_472; 2], None));
    let probes = cable.sent.iter().filter(|(end, frame)| *end == 0 && frame.len() == 1_472).count();
    assert_eq!(probes, 10, "one each second");
}

#[test]
fn a_path_that_drops_large_frames_is_found_while_the_link_stays_up() {
    let mut cable = probed();
    cable.carries = 1_300;

    cable.run_until(100);
    assert_eq!((limits(&cable), cable.states()), ([1_200; 2], [LinkState::Up; 2]));
    cable.run_until(1_000);

    let outputs = of_left(&cable);
    assert!(
        matches!(outputs[..], [LinkOutput::Changed { .. }, LinkOutput::FrameLimit]),
        "{outputs:?}"
    );
    assert_eq!((limits(&cable), cable.ends[0].shortfall()), ([1_293; 2], Some((1_293, 1_472))));
}

#[test]
fn a_path_that_becomes_smaller_lowers_the_limit_and_takes_no_link_down() {
    let mut cable = probed();
    cable.run_until(1_000);
    cable.outputs.clear();
    cable.carries = 1_300;

    while limits(&cable)[0] == 1_472 && cable.now < 3_000 {
        cable.run_until(cable.now + 1);
    }
    assert_eq!((limits(&cable)[0], cable.ends[0].shortfall()), (1_200, None));
    cable.run_until(cable.now + 1_000);

    assert_eq!(of_left(&cable), [&LinkOutput::FrameLimit; 2]);
    assert_eq!(limits(&cable), [1_293; 2]);
}

#[test]
fn an_outage_is_no_reason_to_lower_the_limit() {
    let mut cable = probed();
    cable.run_until(1_000);

    cable.cut = [true; 2];
    cable.run_until(5_000);
    assert_eq!((limits(&cable), cable.states()), ([1_472; 2], [LinkState::Down; 2]));
    cable.cut = [false; 2];
    cable.run_until(8_000);

    assert_eq!((limits(&cable), cable.states()), ([1_472; 2], [LinkState::Up; 2]));
}

#[test]
fn loss_alone_hardly_ever_lowers_the_limit() {
    let mut cable = probed();
    let mut random = Random::new(5);
    cable.run_until(2_000);
    cable.outputs.clear();

    for _ in 0..600_000 {
        cable.run_until(cable.now + 1);
        cable.in_flight.retain(|(at, ..)| *at != cable.now || !random.chance(0.1));
    }

    let lowered = of_left(&cable).into_iter().filter(|output| **output == LinkOutput::FrameLimit);
    assert_eq!((lowered.count(), limits(&cable)), (0, [1_472; 2]));
}

#[test]
fn a_probe_of_an_unknown_sender_has_no_answer() {
    let mut link = Link::new(config("left", 1), at(0));

    link.handle_frame(Frame::Probe(1_000).encode(), at(1));
    link.handle_frame(Frame::ProbeAnswer(1_000).encode(), at(1));

    assert_eq!((link.poll_output(), link.refusals().unexpected), (None, 2));
}
