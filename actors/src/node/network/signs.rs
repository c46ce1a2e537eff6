//! The last signs of life of links and of the nodes at their other ends.

use crate::node::snapshot::PART_TIMEOUT;
use blastema_contract::link::LinkRow;
use blastema_core::FaultLocation;
use blastema_core::detection::MonitorRow;

/// The monitor's table, completed: the monitor is told of changes, and the links see every hello.
pub(in crate::node) async fn completed(
    table: impl Future<Output = Option<Vec<MonitorRow>>>,
    links: impl Future<Output = Vec<LinkRow>>,
) -> Option<Vec<MonitorRow>> {
    // A network that hangs is not waited for as long as the picture waits for the table.
    let links = tokio::time::timeout(PART_TIMEOUT / 2, links);
    let (rows, links) = futures_util::future::join(table, links).await;
    let mut rows = rows?;
    show_in(&mut rows, &links.unwrap_or_default());
    Some(rows)
}

/// Completes the rows of links and nodes by when the last hello came. A node without a link to here
/// gives none.
fn show_in(rows: &mut [MonitorRow], links: &[LinkRow]) {
    for row in rows {
        match &row.location {
            FaultLocation::Link { link, .. } => {
                if let Some(seen) = links.iter().find(|seen| seen.link == *link) {
                    row.last_sign = seen.last_sign;
                }
            }
            FaultLocation::Node(node) => {
                let there = |link: &&LinkRow| {
                    link.neighbour.as_ref().is_some_and(|neighbour| neighbour.node == *node)
                };
                let signs = links.iter().filter(there).filter_map(|link| link.last_sign);
                row.last_sign = signs.min();
            }
            FaultLocation::Object(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::detection::ObjectKind;
    use blastema_core::net::{
        ByteRate, LinkId, LinkState, LinkTraffic, Neighbour, Quality, Refusals,
    };
    use blastema_core::{Incarnation, NodeName};
    use std::time::Duration;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn link(name: &str, neighbour: &str, last_sign: Option<u64>) -> LinkRow {
        LinkRow {
            number: LinkId(0),
            network: "net".into(),
            link: name.into(),
            state: LinkState::Up,
            neighbour: Some(Neighbour { node: node(neighbour), incarnation: Incarnation(1) }),
            last_sign: last_sign.map(Duration::from_millis),
            quality: Quality {
                round_trip: None,
                jitter: Duration::ZERO,
                loss_permille: 0,
                degraded: false,
                cost_percent: 100,
            },
            hello_interval: Duration::from_millis(100),
            cost: 1,
            traffic: LinkTraffic::default(),
            rate: ByteRate::default(),
            refusals: Refusals::default(),
            seal: None,
        }
    }

    #[test]
    fn a_link_shows_its_last_hello_and_a_node_the_last_of_all_its_links() {
        let stale = |location, kind| {
            let mut row = MonitorRow::blank(location, kind);
            row.last_sign = Some(Duration::from_secs(300));
            row
        };
        let of_link = |name: &str| {
            let (node, link) = (node("a"), name.into());
            stale(FaultLocation::Link { node, link, neighbour: None }, ObjectKind::Link)
        };
        let of_node = |name: &str| stale(FaultLocation::Node(node(name)), ObjectKind::Node);
        let mut rows =
            [of_link("eth"), of_link("can"), of_node("b"), of_node("behind-b"), of_link("gone")];
        let links = [link("eth", "b", Some(70)), link("can", "b", Some(20))];

        show_in(&mut rows, &links);

        let signs = rows.map(|row| row.last_sign.map(|sign| sign.as_millis()));
        assert_eq!(signs, [Some(70), Some(20), Some(20), None, Some(300_000)]);
    }
}
