//! Paths that drop large frames and carry hellos, as through a VPN.

use super::*;
use blastema_contract::transport::Impair;
use blastema_core::medium::impairment::Impairment;

/// What an Ethernet frame carries.
const CONFIGURED: usize = 1_472;
const BOTH_ENDS: [&str; 2] = ["ethernet/left", "ethernet/right"];

/// From now on the path drops larger frames.
fn drop_above(robot: &Robot, largest: usize) {
    let impairment = Impairment { largest, ..Impairment::default() };
    for end in BOTH_ENDS {
        robot.cable(end).do_send(Impair { direction: Direction::Outgoing, impairment });
    }
}

/// Two nodes on a path of which they know that it may drop large frames; it drops those above
/// `largest`.
async fn pair_over(largest: usize) -> (Robot, Module, Module) {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
    let right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
    drop_above(&robot, largest);
    for (module, end) in [&left, &right].into_iter().zip(BOTH_ENDS) {
        let (local, mtu) = (MediumAddress::Memory(end.into()), CONFIGURED);
        module.net.networks[0].1.do_send(TransportReport::Opened { local, mtu, is_probed: true });
    }
    advance(300 * MS).await;
    (robot, left, right)
}

/// Has requests of so many bytes answered, one after the other. A path that has become smaller is
/// found within two seconds, and a session ends after two.
async fn mirror(left: &Module, bytes: usize, count: usize) {
    let sender = left.sender::<Mirror>("right:acc");
    for _ in 0..count {
        let answer = sender.ask_within(Mirror(vec![7; bytes]), 5_000 * MS).await;
        assert_eq!(answer.map(|mirrored| mirrored.len()), Ok(bytes));
    }
}

/// What the monitor was told last of the link.
fn condition(left: &Module) -> LinkCondition {
    left.links.drain().pop().expect("the link came up").condition
}

fn mtu(left: &[blastema_core::net::Route]) -> u16 {
    left[0].mtu
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_path_that_becomes_smaller_resets_no_session_and_the_fault_ends_when_it_is_as_large_again()
 {
    let (robot, left, right) = pair_over(CONFIGURED).await;
    mirror(&left, 3_000, 5).await;
    assert_eq!(condition(&left), LinkCondition::Up);
    assert_eq!(mtu(&left.net.read_routes().await), 1_472);

    drop_above(&robot, 1_300);
    mirror(&left, 3_000, 5).await;
    mirror(&left, 100_000, 1).await;
    advance(3_000 * MS).await;

    let LinkCondition::Degraded { reason } = condition(&left) else { panic!("no fault") };
    assert!(reason.contains("mtu=1293"), "{reason}");
    for module in [&left, &right] {
        assert_eq!(module.host.dead_letters.counts(), []);
        assert_eq!(module.declared.drain(), []);
    }
    drop_above(&robot, 0);
    advance(590_000 * MS).await;
    assert_eq!(left.links.drain(), []);
    advance(15_000 * MS).await;
    assert_eq!(condition(&left), LinkCondition::Up);
    assert_eq!(mtu(&left.net.read_routes().await), 1_472);
}
