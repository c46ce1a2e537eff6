//! The links over one transport, as one machine.

use super::hello_slowdown::HelloSlowdown;
use super::path_mtu::{FrameSize, PathMtu};
use super::{Link, LinkOutput};
use crate::machine_set::MachineSet;
use crate::net::wire::link_id::LinkId;
use crate::{Instant, Machine};
use std::time::Duration;

/// The machine of all links over one transport.
#[derive(Debug, Default)]
pub struct LinkSet {
    machines: MachineSet<LinkId, Link>,
    bytes_per_second: Option<u64>,
    /// What links begin with.
    frame_size: FrameSize,
    stalled: Option<Duration>,
    /// What a seal adds to each frame, in bytes.
    overhead: usize,
    slowdown: HelloSlowdown,
}

/// What a link set wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkSetOutput {
    /// What one of its links wants done.
    Of(LinkId, LinkOutput),
    /// This node was not run for so long: a timer fired so late. Links suffer from it.
    Stalled(Duration),
}

impl LinkSet {
    /// With more links than this, a node sends no more than one hello in 5 ms, and receives as
    /// many: all hellos among `n` nodes that are linked to each other then take `200 * n` frames a
    /// second, not `20 * n * n`.
    const LINKS_AT_ANY_PACE: u64 = 10;
    const PACE_OF_MANY: Duration = Duration::from_millis(5);
    /// From this lateness on, neighbours with the usual hello interval of 50 ms find two hellos
    /// missing.
    const STALL: Duration = Duration::from_millis(100);

    /// No links yet. A seal adds so many bytes to each frame of theirs.
    pub fn with_overhead(bytes: usize) -> Self {
        LinkSet { overhead: bytes, ..LinkSet::default() }
    }

    /// Adds a link, or replaces it.
    pub fn insert(&mut self, number: LinkId, mut link: Link) {
        link.frame_size = self.frame_size.clone();
        self.machines.insert(number, link);
        self.pace();
    }

    /// Takes a link out.
    pub fn remove(&mut self, number: LinkId) {
        self.machines.remove(number);
        self.pace();
    }

    /// Returns a link; `None` for an unknown number.
    pub fn get(&self, number: LinkId) -> Option<&Link> {
        self.machines.get(number)
    }

    /// A link that is to be given an input; its outputs are polled next.
    pub fn get_mut(&mut self, number: LinkId) -> Option<&mut Link> {
        self.machines.get_mut(number)
    }

    /// All links, in the order of their numbers.
    pub fn iter(&self) -> impl Iterator<Item = (LinkId, &Link)> {
        self.machines.iter()
    }

    /// The medium carries so many bytes in a second. The hellos of all nodes together take a tenth
    /// of that at most, if each has as many links there as this one.
    pub fn handle_rate(&mut self, bytes_per_second: u64) {
        self.bytes_per_second = Some(bytes_per_second);
        self.pace();
    }

    /// The largest frame has so many bytes. Where paths may drop it, each link finds by probes what
    /// passes. On a slow medium the hello interval is at least its duration, so that a hello which
    /// waits for it is not late by an interval.
    pub fn handle_mtu(&mut self, mtu: usize, is_probed: bool) {
        let path = is_probed.then(|| PathMtu::new(mtu, self.overhead));
        let frame_size = FrameSize { medium: mtu, path };
        self.each(|link| link.frame_size = frame_size.clone());
        self.frame_size = frame_size;
        self.pace();
    }

    fn each(&mut self, mut what: impl FnMut(&mut Link)) {
        let numbers: Vec<_> = self.machines.iter().map(|(number, _)| number).collect();
        for number in numbers {
            self.machines.get_mut(number).into_iter().for_each(&mut what);
        }
    }

    /// Sets the hello interval as configured, or as long as the medium and the number of links
    /// need.
    fn pace(&mut self) {
        let slowdown = self.slowdown.clone();
        let slow = |link: &Link, least| slowdown.interval(link.config.hello_interval.max(least));
        let links = self.machines.iter().count() as u64;
        let many = match links > Self::LINKS_AT_ANY_PACE {
            true => Self::PACE_OF_MANY * links as u32,
            false => Duration::ZERO,
        };
        let Some(rate) = self.bytes_per_second else {
            return self.each(|link| link.set_interval(slow(link, many)));
        };
        // As many pairs of nodes share the medium, if all have as many links as this one.
        let (share, overhead) = (2 * rate / (links * (links + 1)).max(1), self.overhead as u64);
        // The rate is that of both directions together.
        let bytes = 2 * (self.frame_size.medium as u64 + overhead + 2 * Link::FRAMING);
        let whole = Duration::from_nanos(bytes.saturating_mul(1_000_000_000) / rate.max(1));
        let least = many.max(whole);
        self.each(|link| {
            link.set_interval(slow(link, link.interval_at(share, overhead).max(least)));
        });
    }
}

impl Machine for LinkSet {
    type Output = LinkSetOutput;

    fn poll_output(&mut self) -> Option<LinkSetOutput> {
        if let Some(late) = self.stalled.take() {
            return Some(LinkSetOutput::Stalled(late));
        }
        let (number, output) = self.machines.poll_output()?;
        Some(LinkSetOutput::Of(number, output))
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.machines.poll_timeout()
    }

    fn handle_timeout(&mut self, now: Instant) {
        let late = self.poll_timeout().map_or(Duration::ZERO, |due| now - due);
        self.stalled = (late >= Self::STALL).then_some(late);
        let interval = self.machines.iter().map(|(_, link)| link.hello_interval()).max();
        if self.slowdown.handle_late(late, interval.unwrap_or_default(), now) {
            self.pace();
        }
        self.machines.handle_timeout(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::link::LinkConfig;
    use crate::testing::at;
    use crate::{Incarnation, NodeName};

    fn name(number: u16) -> NodeName {
        NodeName::new(&format!("m{number}")).unwrap()
    }

    #[test]
    fn each_link_says_its_own_hello() {
        let mut links = LinkSet::default();
        for number in 1..=2 {
            let config = LinkConfig::new(name(0), Incarnation(1));
            links.insert(LinkId(number), Link::new(config, at(0)));
        }

        while links.poll_output().is_some() {}
        links.handle_timeout(at(0));

        let outputs: Vec<_> = std::iter::from_fn(|| links.poll_output()).collect();
        assert!(matches!(
            &outputs[..],
            [
                LinkSetOutput::Of(LinkId(1), LinkOutput::Transmit(_)),
                LinkSetOutput::Of(LinkId(2), LinkOutput::Transmit(_)),
            ]
        ));
    }

    #[test]
    fn with_more_than_ten_links_each_sends_its_hellos_less_often() {
        let check = |links: u16, configured: u64, expected: u64| {
            let mut set = LinkSet::default();
            for number in 1..=links {
                let hello_interval = Duration::from_millis(configured);
                let config =
                    LinkConfig { hello_interval, ..LinkConfig::new(name(0), Incarnation(1)) };
                set.insert(LinkId(number), Link::new(config, at(0)));
            }
            let intervals: Vec<_> = set.iter().map(|(_, link)| link.hello_interval()).collect();
            let expected = Duration::from_millis(expected);
            assert_eq!(intervals, vec![expected; links.into()], "{links} links");
        };
        check(10, 50, 50);
        check(10, 1, 1);
        check(11, 50, 55);
        check(11, 500, 500);
        check(19, 50, 95);
        check(64, 50, 320);
    }

    #[test]
    fn the_hellos_of_all_nodes_of_a_bus_take_a_tenth_of_it() {
        // In milliseconds, as the manual has them.
        let check = |nodes: u16, rate, overhead, expected| {
            let mut set = LinkSet::with_overhead(overhead);
            set.handle_rate(rate);
            set.handle_mtu(1_024 - overhead, false);
            for number in 1..nodes {
                let node = NodeName::new("module0").unwrap();
                let config = LinkConfig::new(node, Incarnation(1));
                set.insert(LinkId(number), Link::new(config, at(0)));
            }
            let interval = set.get(LinkId(1)).unwrap().hello_interval();
            assert_eq!(interval.as_millis(), expected, "{nodes} nodes, {rate}, {overhead}");
        };
        // Classic CAN and CAN FD of 500 kbit/s; a compact seal.
        for (nodes, classic, sealed, fd) in
            [(2, 85, 85, 50), (4, 261, 320, 128), (8, 1221, 1497, 599)]
        {
            check(nodes, 24_305, 0, classic);
            check(nodes, 24_305, 12, sealed);
            check(nodes, 49_528, 0, fd);
        }
    }

    #[test]
    fn links_that_are_taken_out_leave_their_share_of_the_hellos_to_the_others() {
        let mut set = LinkSet::default();
        for number in 1..=64 {
            let config = LinkConfig::new(name(0), Incarnation(1));
            set.insert(LinkId(number), Link::new(config, at(0)));
        }
        let interval = |set: &LinkSet| set.get(LinkId(1)).unwrap().hello_interval().as_millis();
        assert_eq!(interval(&set), 320);

        (20..=64).for_each(|number| set.remove(LinkId(number)));
        assert_eq!(interval(&set), 95);
        (2..=19).for_each(|number| set.remove(LinkId(number)));
        assert_eq!(interval(&set), 50);
    }

    #[test]
    fn a_timer_that_fires_late_shows_that_this_node_was_not_run() {
        let mut links = LinkSet::default();
        let config = LinkConfig::new(name(0), Incarnation(1));
        links.insert(LinkId(1), Link::new(config, at(0)));
        let mut stalls = Vec::new();
        for now in [0, 50, 149, 250, 350, 400] {
            links.handle_timeout(at(now));
            let outputs = std::iter::from_fn(|| links.poll_output());
            stalls.extend(outputs.filter_map(|output| match output {
                LinkSetOutput::Stalled(late) => Some((now, late.as_millis())),
                _ => None,
            }));
        }
        assert_eq!(stalls, [(250, 100)]);
    }
}
