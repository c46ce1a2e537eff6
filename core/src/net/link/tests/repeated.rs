//! Recorded frames that are replayed prove nothing.

use super::incarnations::hellos_of;
use super::*;
use crate::random::Random;

/// Runs until both ends are up, for ten seconds at most, while the left end hears `again` each
/// millisecond. Answers how long it took.
fn healed(cable: &mut Cable, mut again: impl FnMut() -> Option<Bytes>) -> u64 {
    let began = cable.now;
    while cable.states() != [LinkState::Up; 2] && cable.now < began + 10_000 {
        cable.run_until(cable.now + 1);
        if let Some(frame) = again() {
            cable.ends[0].handle_frame(frame, at(cable.now));
        }
    }
    cable.now - began
}

fn downs(cable: &Cable) -> usize {
    let down = |outputs: &&(u64, usize, LinkOutput)| {
        matches!(outputs.2, LinkOutput::Changed { state: LinkState::Down, .. })
    };
    cable.outputs.iter().filter(down).count()
}

/// The right end wants far more proof than the left one.
fn wary_on_the_right() -> Cable {
    let mut cable = running();
    cable.ends[1].damping.handle_failure(48, at(cable.now));
    cable.ends[1].handle_loss(at(cable.now));
    cable.run_until(cable.now + 15);
    cable.outputs.clear();
    cable
}

#[test]
fn traffic_of_the_past_neither_brings_a_link_up_nor_keeps_it_down() {
    let calm = healed(&mut wary_on_the_right(), || None);
    let packet = || Some(Frame::Data(Bytes::from_static(b"packet").into()).encode());
    let routing = || Some(Frame::Routing(Bytes::from_static(b"routing")).encode());
    for again in [packet, routing] {
        let mut cable = wary_on_the_right();

        assert_eq!(healed(&mut cable, again), calm);

        assert_eq!(downs(&cable), 0, "{:?}", cable.outputs);
    }
}

/// A cable that has run for so long that most of what was said is long past, and what its right end
/// said.
fn recorded() -> (Cable, Vec<Bytes>) {
    let mut cable = running();
    cable.run_until(20_000);
    let sent = hellos_of(&cable, 1);
    cable.outputs.clear();
    (cable, sent)
}

#[test]
fn hellos_of_the_past_take_nothing_down_in_whichever_order_they_come() {
    for seed in 0..5 {
        let (mut cable, sent) = recorded();
        let mut random = Random::new(seed);
        for n in 0..5_000 {
            let one = match seed {
                0 => n % sent.len(),
                _ => random.below(sent.len() as u64) as usize,
            };
            cable.ends[0].handle_frame(sent[one].clone(), at(cable.now));
            cable.run_until(cable.now + 1);
        }
        assert_eq!(cable.outputs, [], "seed {seed}");
    }
}
