//! Incarnations that start and end on a cable, and forged hellos.

use super::*;
use crate::net::link::arrival::ArrivalEstimator;

/// What has gone from one end to the other.
pub(super) fn hellos_of(cable: &Cable, from: usize) -> Vec<Bytes> {
    let hello = |frame: &&Bytes| matches!(Frame::decode((*frame).clone()), Ok(Frame::Hello(_)));
    let sent = cable.sent.iter().filter(|(end, _)| *end == from).map(|(_, frame)| frame);
    sent.filter(hello).cloned().collect()
}

fn changes(cable: &Cable) -> usize {
    let changed =
        |outputs: &&(u64, usize, LinkOutput)| matches!(outputs.2, LinkOutput::Changed { .. });
    cable.outputs.iter().filter(changed).count()
}

fn changed(frame: &Bytes, change: impl Fn(&mut Hello)) -> Bytes {
    let Ok(Frame::Hello(mut hello)) = Frame::decode(frame.clone()) else { panic!("no hello") };
    change(&mut hello);
    Frame::Hello(hello).encode()
}

/// The right end's process dies and restarts in this incarnation; returns when both are up again.
fn restarted(cable: &mut Cable, incarnation: u64, dead_for: u64) -> u64 {
    cable.cut[1] = true;
    cable.run_until(cable.now + dead_for);
    cable.cut[1] = false;
    cable.ends[1] = Link::new(config("right", incarnation), at(cable.now));
    let began = cable.now;
    let healed = |cable: &Cable| {
        let incarnation = Some(Incarnation(incarnation));
        cable.states() == [LinkState::Up; 2]
            && cable.ends[0].neighbour().map(|neighbour| neighbour.incarnation) == incarnation
    };
    while !healed(cable) && cable.now < began + 10_000 {
        cable.run_until(cable.now + 1);
    }
    assert!(healed(cable), "{:?}", cable.states());
    cable.now - began
}

#[test]
fn one_changed_bit_anywhere_in_a_hello_takes_nothing_down() {
    let mut cable = running();
    let bits = hellos_of(&cable, 1)[0].len() * 8;
    for bit in 0..bits {
        let mut flipped = hellos_of(&cable, 1).last().unwrap().to_vec();
        flipped[bit / 8] ^= 1 << (bit % 8);
        let before = cable.ends[0].refusals().total();
        cable.ends[0].handle_frame(flipped.into(), at(cable.now));
        let counted = cable.ends[0].refusals().total() > before;
        cable.run_until(cable.now + 40);
        // Another kind; a number that is a little ahead, a longer interval, an echo, a loss, a
        // state: the next hellos put them right.
        let harmless = (8..16).contains(&bit) || bit >= 13 * 8;
        assert!(counted || harmless, "bit {bit} was believed");
        assert_eq!(changes(&cable), 0, "bit {bit}: {:?}", cable.outputs);
    }
    assert_eq!(cable.states(), [LinkState::Up; 2]);
}

#[test]
fn a_hello_of_a_greater_incarnation_that_nobody_lives_cuts_nobody_off_however_often_it_comes() {
    let mut cable = running();
    for _ in 0..100 {
        let last = hellos_of(&cable, 1).last().unwrap().clone();
        let forged = changed(&last, |hello| hello.incarnation = Incarnation(u64::MAX));
        cable.ends[0].handle_frame(forged, at(cable.now));
        cable.run_until(cable.now + 10);
    }

    assert_eq!(changes(&cable), 0, "{:?}", cable.outputs);
    assert!(cable.ends[0].refusals().unexpected >= 99);
    assert_eq!(cable.ends[0].neighbour().unwrap().incarnation, Incarnation(1));
}

#[test]
fn a_number_far_ahead_is_not_believed_and_a_passed_one_is_once_its_end_shows_that_it_hears_us() {
    let mut cable = running();
    let last = hellos_of(&cable, 1).last().unwrap().clone();
    let ahead = changed(&last, |hello| hello.sequence += 1000);
    cable.ends[0].handle_frame(ahead, at(cable.now));
    cable.run_until(cable.now + 100);
    assert_eq!(
        (changes(&cable), cable.ends[0].refusals().unexpected + cable.ends[0].refusals().stale),
        (0, 1)
    );

    // However it came about: the number that the other end has come to was believed to be passed.
    let received = cable.ends[0].neighbour.as_mut().unwrap();
    received.arrivals =
        ArrivalEstimator::new(received.arrivals.interval(), 1_000_000, at(cable.now));
    cable.run_until(cable.now + 200);

    assert_eq!(cable.states(), [LinkState::Up; 2]);
}

#[test]
fn a_neighbour_that_begins_anew_with_a_smaller_number_is_taken_once_the_old_incarnation_is_silent()
{
    let mut cable = Cable::new(config("left", 1), config("right", 1000));
    cable.run_until(100);
    for (incarnation, dead_for) in [(999, 0), (500, 5), (400, 30), (3, 100), (2, 1000), (1, 3000)] {
        // 3.5 intervals until the old incarnation is given up, and the proof of the new one.
        let healed = restarted(&mut cable, incarnation, dead_for);
        assert!(healed <= 110, "incarnation {incarnation} after {healed} ms");
        cable.run_until(cable.now + 300);
    }
}

#[test]
fn two_ends_that_have_both_begun_anew_with_smaller_numbers_find_each_other() {
    let mut cable = Cable::new(config("left", 1000), config("right", 1000));
    cable.run_until(100);
    // Each has been told of an incarnation of the other's that it never had.
    for end in 0..2 {
        let neighbour = cable.ends[end].neighbour.as_mut().unwrap();
        neighbour.neighbour.incarnation = Incarnation(u64::MAX);
    }

    cable.run_until(400);

    assert_eq!(cable.states(), [LinkState::Up; 2]);
    let incarnations = cable.ends.each_ref().map(|end| end.neighbour().unwrap().incarnation);
    assert_eq!(incarnations, [Incarnation(1000); 2]);
}

#[test]
fn what_is_left_on_its_way_of_an_incarnation_that_is_over_is_refused_whatever_its_number() {
    for (old, new) in [(1, 1000), (1000, 1)] {
        let mut cable = Cable::new(config("left", 1), config("right", old));
        cable.run_until(400);
        let late = hellos_of(&cable, 1);
        restarted(&mut cable, new, 0);
        cable.outputs.clear();
        let before = cable.ends[0].refusals().total();

        for hello in &late {
            cable.ends[0].handle_frame(hello.clone(), at(cable.now));
            cable.run_until(cable.now + 10);
        }

        assert_eq!(changes(&cable), 0, "{:?}", cable.outputs);
        assert_eq!(cable.ends[0].refusals().total() - before, late.len() as u64);
        assert_eq!(cable.ends[0].neighbour().unwrap().incarnation, Incarnation(new));
    }
}

#[test]
fn of_two_incarnations_that_both_answer_the_first_has_the_link() {
    for (first, second) in [(1, 2), (2, 1)] {
        let mut cable = Cable::new(config("left", 1), config("right", first));
        cable.run_until(100);
        cable.outputs.clear();
        let mut other = Link::new(config("right", second), at(cable.now));
        for _ in 0..500 {
            let read = cable.sent.len();
            cable.run_until(cable.now + 1);
            // It hears all that the left end says, and speaks when the right end does not.
            for (_, frame) in cable.sent[read..].iter().filter(|(from, _)| *from == 0) {
                other.handle_frame(frame.clone(), at(cable.now));
            }
            if other
                .poll_timeout()
                .is_some_and(|due| due + Duration::from_millis(5) <= at(cable.now))
            {
                other.handle_timeout(at(cable.now));
            }
            while let Some(output) = other.poll_output() {
                if let LinkOutput::Transmit(frame) = output {
                    cable.ends[0].handle_frame(frame.into_bytes(), at(cable.now));
                }
            }
        }

        assert_eq!(changes(&cable), 0, "{:?}", cable.outputs);
        assert_eq!(cable.ends[0].neighbour().unwrap().incarnation, Incarnation(first));
    }
}
