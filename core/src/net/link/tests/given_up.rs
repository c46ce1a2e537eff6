//! What the neighbour says by another way.

use super::*;

/// The cable is pulled between the left end and a switch, and the left end knows.
fn pull(cable: &mut Cable) {
    cable.ends[0].handle_no_carrier("pulled", at(cable.now));
    cable.cut = [true; 2];
}

#[test]
fn a_link_that_the_neighbour_gave_up_is_suspect_at_once_and_down_when_hellos_are_missing() {
    let mut cable = running();
    pull(&mut cable);
    cable.run_until(102);
    assert_eq!(cable.states(), [LinkState::Down, LinkState::Up]);

    cable.ends[1].handle_given_up(at(102));

    assert_eq!((cable.ends[1].state(), cable.ends[1].is_given_up()), (LinkState::Suspect, true));
    cable.run_until(140);
    assert_eq!((cable.ends[1].state(), cable.ends[1].is_given_up()), (LinkState::Down, false));
}

#[test]
fn one_hello_may_have_been_on_its_way_and_two_show_that_it_is_not_so() {
    let mut cable = running();

    cable.ends[1].handle_given_up(at(100));
    cable.run_until(109);
    assert!(cable.ends[1].is_given_up());
    cable.run_until(125);

    assert_eq!((cable.ends[1].state(), cable.ends[1].is_given_up()), (LinkState::Up, false));
    assert_eq!(cable.ends[0].state(), LinkState::Up, "the neighbour noticed nothing");
    // Such reports do not count for a while.
    cable.ends[1].handle_given_up(at(126));
    assert_eq!(cable.ends[1].state(), LinkState::Up);
    cable.run_until(10_200);
    cable.ends[1].handle_given_up(at(10_200));
    assert_eq!(cable.ends[1].state(), LinkState::Suspect);
}

#[test]
fn of_a_link_that_is_not_used_the_word_says_nothing() {
    let mut cable = Cable::new(config("left", 1), config("right", 1));
    cable.ends[1].handle_given_up(at(0));

    cable.run_until(60);

    assert_eq!(cable.states(), [LinkState::Up; 2]);
    assert!(cable.outputs.iter().all(|(_, _, outputs)| {
        !matches!(outputs, LinkOutput::Changed { state: LinkState::Suspect, .. })
    }));
}
