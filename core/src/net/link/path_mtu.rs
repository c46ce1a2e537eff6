//! The largest frame that a path carries, where it may drop large ones and say nothing, as a VPN
//! does: packetization-layer path MTU discovery for datagrams (DPLPMTUD, RFC 8899).
//!
//! ```text
//! frames of 1,200 ─ probe of the configured size ─ answered ──────────► found
//!                          │ refused                                     ▲ │
//!                          ▼                                             │ │ a probe each second;
//!                   probe of 1,200, if it is not known, then of half     │ │ refused: a black hole,
//!                   of what is open between answered and refused ────────┘ │ frames of 1,200 again
//!                          ▲                                               │
//!                          └───────────────────────────────────────────────┘
//! ```
//!
//! A size is refused when so many probes of it have no answer although later hellos have: a
//! neighbour that stands still, or a path that carries nothing, refuses no size. Where 1,200 is
//! refused, frames have 548 bytes until the search ends. Ten minutes after a search the configured
//! size is tried again.
//!
//! What is in flight when the limit falls is no business of the link: sessions send it again, in
//! pieces that fit.

use crate::Instant;
use std::time::Duration;

/// What a datagram carries over nearly every path (RFC 8899, BASE_PLPMTU; RFC 9000, 14).
const BASE: usize = 1_200;
/// What every host of IPv4 takes: 576 bytes (RFC 1122, 3.3.2), less the headers of IP and UDP.
const FLOOR: usize = 548;
/// A search ends when no more is open than this: a smaller step costs more probes than it gains.
const STEP: usize = 16;
/// How often the size that was found is probed: with three probes after it, a path that becomes
/// smaller is found before a session of the usual timeout, 2 s, ends.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// When a larger size is tried again (RFC 8899, PMTU_RAISE_TIMER).
const RAISE_INTERVAL: Duration = Duration::from_secs(600);

/// The largest frame of a link.
#[derive(Clone, Debug, Default)]
pub(super) struct FrameSize {
    /// The medium's; 0 while it is not known.
    pub(super) medium: usize,
    /// What passes of that, where the path may drop large frames.
    pub(super) path: Option<PathMtu>,
}

impl FrameSize {
    pub(super) fn limit(&self) -> usize {
        self.path.as_ref().map_or(self.medium, PathMtu::limit)
    }

    pub(super) fn shortfall(&self) -> Option<(usize, usize)> {
        self.path.as_ref().and_then(PathMtu::shortfall)
    }
}

/// The search for the largest frame that a path carries. All sizes are those of frames without
/// their seal.
#[derive(Clone, Debug)]
pub(super) struct PathMtu {
    configured: usize,
    base: usize,
    floor: usize,
    /// Frames are no larger at present.
    limit: usize,
    /// What the last search found; the configured size before the first has ended.
    found: usize,
    /// The largest size that was answered, or is taken to pass.
    answered: usize,
    /// The smallest size that was refused.
    refused: usize,
    /// The probe on its way: its size, and when it was sent.
    probe: Option<(usize, Instant)>,
    /// So many probes before it had no answer.
    unanswered: u32,
    check_at: Instant,
    raise_at: Instant,
}

impl PathMtu {
    /// For frames of so many bytes, to which a seal adds `overhead`.
    pub(super) fn new(configured: usize, overhead: usize) -> Self {
        let configured = configured.min(u16::MAX.into());
        let [base, floor] = [BASE, FLOOR].map(|size| configured.min(size - overhead));
        PathMtu {
            configured,
            base,
            floor,
            limit: base,
            found: configured,
            answered: floor,
            refused: configured + 1,
            probe: None,
            unanswered: 0,
            check_at: Instant::ORIGIN,
            raise_at: Instant::ORIGIN,
        }
    }

    /// The largest frame at present.
    pub(super) fn limit(&self) -> usize {
        self.limit
    }

    /// What the last search found, where that is less than what is configured.
    pub(super) fn shortfall(&self) -> Option<(usize, usize)> {
        (self.found < self.configured).then_some((self.found, self.configured))
    }

    /// The neighbour has answered a hello that was sent at `heard`. Returns the size of the probe
    /// to send now. A size is refused after `tries` probes.
    pub(super) fn poll_probe(&mut self, heard: Instant, tries: u32, now: Instant) -> Option<u16> {
        if let Some((size, sent)) = self.probe {
            if heard <= sent {
                return None;
            }
            self.probe = None;
            self.unanswered += 1;
            if self.unanswered >= tries {
                self.refuse(size, now);
            }
        }
        let size = self.search().or_else(|| self.check(now))?;
        self.probe = Some((size, now));
        Some(size as u16)
    }

    /// The neighbour has received a probe of this size.
    pub(super) fn handle_answer(&mut self, size: u16, now: Instant) {
        let Some((size, _)) = self.probe.take_if(|(probed, _)| *probed == usize::from(size)) else {
            return;
        };
        self.unanswered = 0;
        self.check_at = now + CHECK_INTERVAL;
        if size > self.answered {
            self.answered = size;
            self.settle(now);
        }
    }

    /// The size that the search tries next; `None` where it has ended.
    fn search(&self) -> Option<usize> {
        let PathMtu { configured, base, answered, refused, .. } = *self;
        if answered >= configured {
            None
        } else if refused > configured {
            Some(configured)
        } else if (answered + 1..refused).contains(&base) {
            Some(base)
        } else {
            (refused - answered > STEP).then_some(answered.midpoint(refused))
        }
    }

    /// The size that is tried after the search has ended: a larger one, or whether what was found
    /// still passes.
    fn check(&mut self, now: Instant) -> Option<usize> {
        if self.answered < self.configured && now >= self.raise_at {
            self.refused = self.configured + 1;
            return Some(self.configured);
        }
        (self.answered > self.floor && now >= self.check_at).then_some(self.answered)
    }

    fn refuse(&mut self, size: usize, now: Instant) {
        (self.unanswered, self.refused) = (0, size);
        if size <= self.answered {
            self.answered = self.floor;
        }
        if size <= self.limit {
            self.limit = if size > self.base { self.base } else { self.floor };
        }
        self.settle(now);
    }

    fn settle(&mut self, now: Instant) {
        if self.search().is_none() {
            (self.limit, self.found) = (self.answered, self.answered);
            self.raise_at = now + RAISE_INTERVAL;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRIES: u32 = 3;
    /// Between two hellos.
    const HELLO: Duration = Duration::from_millis(50);

    /// A path that carries frames of so many bytes, and one that carries hellos.
    struct Path {
        mtu: PathMtu,
        carries: usize,
        now: Instant,
        /// The sizes that were probed.
        probed: Vec<u16>,
    }

    impl Path {
        fn new(configured: usize, carries: usize) -> Self {
            let now = Instant::from_millis(1_000);
            Path { mtu: PathMtu::new(configured, 0), carries, now, probed: vec![] }
        }

        /// A hello is sent, and the last one was answered.
        fn hello(&mut self) {
            let heard = self.now;
            self.now = self.now + HELLO;
            let Some(size) = self.mtu.poll_probe(heard, TRIES, self.now) else { return };
            self.probed.push(size);
            if usize::from(size) <= self.carries {
                self.mtu.handle_answer(size, self.now);
            }
        }

        fn run(&mut self, span: Duration) {
            let end = self.now + span;
            while self.now < end {
                self.hello();
            }
        }
    }

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_path_that_carries_the_configured_size_is_found_by_the_first_probe_and_checked_each_second()
    {
        let mut path = Path::new(1_472, 1_472);
        assert_eq!(path.mtu.limit(), 1_200);

        path.hello();
        assert_eq!((path.mtu.limit(), path.mtu.shortfall()), (1_472, None));

        path.run(seconds(10));
        assert_eq!(path.probed, [1_472; 11]);
    }

    #[test]
    fn a_search_ends_at_most_a_step_below_what_the_path_carries() {
        for configured in [400, 548, 549, 900, 1_200, 1_210, 1_472, 8_972, 65_507] {
            for carries in (548..=configured).step_by(1 + configured / 90) {
                let mut path = Path::new(configured, carries);

                path.run(seconds(30));

                let limit = path.mtu.limit();
                assert!(
                    (carries.saturating_sub(STEP)..=carries).contains(&limit),
                    "{limit} {carries}"
                );
                let shortfall = (limit < configured).then_some((limit, configured));
                assert_eq!(path.mtu.shortfall(), shortfall, "{carries}");
            }
        }
    }

    #[test]
    fn a_refused_size_costs_three_probes_and_frames_stay_as_they_are_until_the_search_ends() {
        let mut path = Path::new(1_472, 1_300);
        let mut limits = vec![];
        while path.mtu.shortfall().is_none() {
            path.hello();
            limits.push(path.mtu.limit());
        }

        let between = [1_336, 1_336, 1_336, 1_268, 1_302, 1_302, 1_302, 1_285, 1_293];
        assert_eq!(path.probed, [[1_472, 1_472, 1_472, 1_200].as_slice(), &between].concat());
        assert_eq!(limits.pop(), Some(1_293));
        assert!(limits.iter().all(|limit| *limit == 1_200), "{limits:?}");
    }

    #[test]
    fn a_path_that_carries_less_than_the_base_has_the_smallest_frames_until_the_search_ends() {
        let mut path = Path::new(1_472, 1_000);

        (0..13).for_each(|_| path.hello());
        assert_eq!((path.mtu.limit(), path.mtu.shortfall()), (548, None));

        path.run(seconds(3));
        assert_eq!(path.mtu.shortfall(), Some((996, 1_472)));
    }

    #[test]
    fn a_path_that_becomes_smaller_is_found_by_three_probes_and_searched_below_that() {
        let mut path = Path::new(1_472, 1_472);
        path.run(seconds(5));
        (path.carries, path.probed) = (1_300, vec![]);

        // A second, and two hellos for each probe.
        let found = (0..26).any(|_| {
            path.hello();
            path.mtu.limit() < 1_472
        });
        assert!(found);
        assert_eq!((path.mtu.limit(), path.mtu.shortfall()), (1_200, None));
        path.run(seconds(2));

        assert_eq!(path.probed[..5], [1_472, 1_472, 1_472, 1_200, 1_336]);
        assert_eq!(path.mtu.shortfall(), Some((1_293, 1_472)));
        path.carries = 700;
        path.run(seconds(4));
        assert_eq!(path.mtu.shortfall(), Some((700, 1_472)));
    }

    #[test]
    fn a_path_that_becomes_larger_is_used_as_such_after_ten_minutes() {
        let mut path = Path::new(1_472, 1_300);
        path.run(seconds(5));
        path.carries = 1_472;

        path.run(seconds(590));
        assert_eq!(path.mtu.shortfall(), Some((1_293, 1_472)));
        path.run(seconds(10));

        assert_eq!((path.mtu.limit(), path.mtu.shortfall()), (1_472, None));
    }

    #[test]
    fn a_larger_size_that_is_refused_again_changes_nothing() {
        let mut path = Path::new(1_472, 1_300);
        path.run(seconds(5));
        path.probed.clear();

        for _ in 0..650 * 20 {
            path.hello();
            assert_eq!((path.mtu.limit(), path.mtu.shortfall()), (1_293, Some((1_293, 1_472))));
        }

        let tried = path.probed.iter().filter(|size| **size == 1_472).count();
        assert_eq!(tried, 3);
    }

    #[test]
    fn no_size_is_refused_while_hellos_have_no_answer_and_none_by_an_answer_to_another_size() {
        let mut mtu = PathMtu::new(1_472, 24);
        let (heard, mut now) = (Instant::from_millis(10), Instant::from_millis(10));
        assert_eq!((mtu.limit(), mtu.poll_probe(heard, TRIES, now)), (1_176, Some(1_472)));

        for _ in 0..100 {
            now = now + HELLO;
            assert_eq!(mtu.poll_probe(heard, TRIES, now), None);
        }
        mtu.handle_answer(1_471, now);

        assert_eq!((mtu.limit(), mtu.shortfall()), (1_176, None));
        mtu.handle_answer(1_472, now);
        assert_eq!(mtu.limit(), 1_472);
    }
}
