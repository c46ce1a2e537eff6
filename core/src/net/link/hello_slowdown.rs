//! A node that is run late sends its hellos less often.

use crate::{Instant, SlidingWindow};
use std::time::Duration;

/// Hellos of a node that is run late again and again are sent less often, and silence of its
/// neighbours counts later by as much. It is doubled for each [`COUNT`](Self::COUNT) timers that
/// fired later than a hello interval within [`PERIOD`](Self::PERIOD), and halved after a period in
/// which none was later than half an interval.
#[derive(Clone, Debug)]
pub(super) struct HelloSlowdown {
    doublings: u32,
    late: SlidingWindow,
    calm_since: Instant,
}

impl Default for HelloSlowdown {
    fn default() -> Self {
        let late = SlidingWindow::new(Self::COUNT, Self::PERIOD);
        HelloSlowdown { doublings: 0, late, calm_since: Instant::ORIGIN }
    }
}

impl HelloSlowdown {
    const COUNT: u32 = 3;
    const PERIOD: Duration = Duration::from_secs(10);
    /// Hellos are not sent less often than this for lateness.
    const INTERVAL_MAX: Duration = Duration::from_secs(1);

    /// The interval instead of `usual`.
    pub(super) fn interval(&self, usual: Duration) -> Duration {
        (usual * (1 << self.doublings)).min(usual.max(Self::INTERVAL_MAX))
    }

    /// A timer has fired so late. Returns whether the interval is another one now.
    pub(super) fn handle_late(&mut self, late: Duration, interval: Duration, now: Instant) -> bool {
        if late > interval / 2 {
            self.calm_since = now;
            let again = late > interval && self.late.push((), now);
            if !again || interval >= Self::INTERVAL_MAX {
                return false;
            }
            self.late.clear();
            self.doublings += 1;
            return true;
        }
        let is_calm = self.doublings > 0 && now - self.calm_since > Self::PERIOD;
        if is_calm {
            self.calm_since = now;
            self.doublings -= 1;
        }
        is_calm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::link::link_set::{LinkSet, LinkSetOutput};
    use crate::net::link::{Link, LinkConfig, LinkOutput, LinkState};
    use crate::net::wire::link_id::LinkId;
    use crate::{Incarnation, Machine, NodeName};

    const LINK: LinkId = LinkId(1);

    fn set(node: &str) -> LinkSet {
        let mut set = LinkSet::default();
        let config = LinkConfig::new(NodeName::new(node).unwrap(), Incarnation(1));
        set.insert(LINK, Link::new(config, Instant::ORIGIN));
        set
    }

    /// Runs the left one every so many milliseconds, the right one in time. Returns how often the
    /// right one took its link down meanwhile.
    fn run(sets: &mut [LinkSet; 2], span: std::ops::Range<u64>, every: u64) -> u32 {
        let (mut unread, mut downs) = ([Vec::new(), Vec::new()], 0);
        for now in span.map(Instant::from_millis) {
            for end in 0..2 {
                if end == 0 && now.as_nanos() / 1_000_000 % every != 0 {
                    continue;
                }
                if sets[end].poll_timeout().is_some_and(|due| due <= now) {
                    sets[end].handle_timeout(now);
                }
                for frame in std::mem::take(&mut unread[end]) {
                    sets[end].get_mut(LINK).unwrap().handle_frame(frame, now);
                }
                while let Some(output) = sets[end].poll_output() {
                    let LinkSetOutput::Of(_, output) = output else { continue };
                    match output {
                        LinkOutput::Transmit(frame) => unread[1 - end].push(frame.into_bytes()),
                        LinkOutput::Changed { state: LinkState::Down, .. } => downs += end as u32,
                        _ => {}
                    }
                }
            }
        }
        downs
    }

    fn interval(set: &LinkSet) -> u128 {
        set.get(LINK).unwrap().hello_interval().as_millis()
    }

    #[test]
    fn a_node_that_is_run_late_again_and_again_is_soon_lost_no_more() {
        let mut sets = [set("left"), set("right")];
        run(&mut sets, 0..5_000, 1);
        assert_eq!([interval(&sets[0]), interval(&sets[1])], [50, 50]);

        let at_first = run(&mut sets, 5_000..15_000, 470);
        assert!(at_first > 0, "it is silent for 470 ms at a time");
        assert_eq!(interval(&sets[0]), 400);

        assert_eq!(run(&mut sets, 15_000..65_000, 470), 0);
        assert_eq!(sets[1].get(LINK).unwrap().state(), LinkState::Up);
        assert_eq!(interval(&sets[1]), 50, "it is in time");

        assert_eq!(run(&mut sets, 65_000..110_000, 1), 0);
        assert_eq!(interval(&sets[0]), 50, "it was in time for four periods");
    }

    #[test]
    fn a_node_that_stands_still_now_and_then_keeps_its_interval() {
        let mut slowdown = HelloSlowdown::default();
        for second in 0..100 {
            let (late, now) = (Duration::from_secs(2), Instant::from_millis(6_000 * second));
            assert!(!slowdown.handle_late(late, Duration::from_millis(50), now));
        }
    }

    #[test]
    fn hellos_are_not_sent_less_often_than_once_a_second_for_it() {
        let mut slowdown = HelloSlowdown::default();
        let usual = Duration::from_millis(50);
        for second in 0..100 {
            let (late, now) = (Duration::from_secs(5), Instant::from_millis(1_000 * second));
            slowdown.handle_late(late, slowdown.interval(usual), now);
        }
        assert_eq!(slowdown.interval(usual), Duration::from_secs(1));
        assert_eq!(slowdown.interval(Duration::from_secs(15)), Duration::from_secs(15));
    }
}
