//! The links over one transport, as one machine.
//!
//! Links along cables of their own are independent, and each sends its own hellos. On a bus, where
//! every node receives every frame, that would be a hello from each node to each other. There the
//! set sends one [greeting](crate::net::wire::bus_hello) for all its links:
//!
//! ```text
//! link to b ─┐ entry for b (changed: goes first)
//! link to c ─┼─ entry for c ─────────────────► greeting ──► all
//! link to d ─┘ entry for d waits for its turn
//! ```

use super::hello_slowdown::HelloSlowdown;
use super::path_mtu::PathMtu;
use super::{Link, LinkOutput};
use crate::machine_set::MachineSet;
use crate::net::wire::bus_hello::{CompactEcho, NeighbourEntry};
use crate::net::wire::frame::Frame;
use crate::net::wire::hello_state::HelloState;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant, Machine};
use std::collections::VecDeque;
use std::time::Duration;

/// The machine of all links over one transport.
#[derive(Debug, Default)]
pub struct LinkSet {
    machines: MachineSet<LinkId, Link>,
    bytes_per_second: Option<u64>,
    /// The largest frame; 0 while that is not known.
    mtu: usize,
    /// What links begin with, where paths may drop it.
    path: Option<PathMtu>,
    /// The last entry of each link's neighbour; `None` where there is no bus.
    bus: Option<SortedMap<LinkId, SentState>>,
    greetings: VecDeque<GatherBuffer>,
    stalled: Option<Duration>,
    /// What a seal adds to each frame, in bytes.
    overhead: usize,
    /// The links share a medium, and each sends its own hellos.
    shared: bool,
    slowdown: HelloSlowdown,
}

/// The last entry that was sent to a neighbour.
#[derive(Clone, Copy, Debug)]
struct SentState {
    stance: HelloState,
    /// Its number among all entries.
    at: u64,
}

/// What a link set wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkSetOutput {
    /// What one of its links wants done.
    Of(LinkId, LinkOutput),
    /// Give this frame to all nodes of the bus.
    Greet(GatherBuffer),
    /// This node was not run for so long: a timer fired so late. Links suffer from it.
    Stalled(Duration),
}

impl LinkSet {
    /// So many neighbours have an entry in one greeting: with a name of ten letters, eight classic
    /// frames of CAN. More makes every greeting longer; with fewer, a neighbour learns later that
    /// its hellos are not received.
    pub const WORDS: usize = 2;
    /// The greetings of all nodes together may take one part in so many of the bus.
    const SHARE: u64 = 10;
    /// With more links than this, a node sends no more than one hello in 5 ms, and receives as
    /// many: all hellos among `n` nodes that are linked to each other then take `200 * n` frames a
    /// second, not `20 * n * n`.
    const LINKS_AT_ANY_PACE: usize = 10;
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
        if let Some(bus) = &mut self.bus {
            link.join_bus();
            bus.remove(&number);
        }
        link.handle_mtu(self.mtu, self.path.clone());
        self.machines.insert(number, link);
        self.pace();
    }

    /// Takes a link out.
    pub fn remove(&mut self, number: LinkId) {
        self.machines.remove(number);
        if let Some(bus) = &mut self.bus {
            bus.remove(&number);
        }
        self.pace();
    }

    /// A link.
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

    /// Every node of the medium receives every frame: one greeting is sent for all links.
    pub fn handle_bus(&mut self) {
        if self.bus.is_none() {
            self.bus = Some(SortedMap::new());
            self.each(Link::join_bus);
            self.pace();
        }
    }

    /// The links share the medium, and no frame reaches all neighbours: their hellos together take
    /// no more of it than those of one link elsewhere.
    pub fn handle_shared_medium(&mut self) {
        self.shared = true;
        self.pace();
    }

    /// The medium carries so many bytes in a second. Hellos take a twentieth of that at most on
    /// each link, or a tenth together on a bus.
    pub fn handle_rate(&mut self, bytes_per_second: u64) {
        self.bytes_per_second = Some(bytes_per_second);
        self.pace();
    }

    /// The largest frame has so many bytes. Where paths may drop it, each link finds by probes what
    /// passes. On a slow medium the hello interval is at least its duration, so that a hello which
    /// waits for it is not late by an interval.
    pub fn handle_mtu(&mut self, mtu: usize, is_probed: bool) {
        let path = is_probed.then(|| PathMtu::new(mtu, self.overhead));
        (self.mtu, self.path) = (mtu, path.clone());
        self.each(|link| link.handle_mtu(mtu, path.clone()));
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
        let slow = |link: &Link, least| slowdown.interval(link.configured_interval().max(least));
        let links = self.machines.iter().count();
        let many = match &self.bus {
            None if links > Self::LINKS_AT_ANY_PACE => Self::PACE_OF_MANY * links as u32,
            _ => Duration::ZERO,
        };
        match (self.bytes_per_second, &self.bus) {
            (Some(rate), None) => {
                let sharing = if self.shared { links.max(1) } else { 1 };
                let (share, overhead) = (rate / sharing as u64, self.overhead as u64);
                // The rate is that of both directions together.
                let bytes = 2 * (self.mtu as u64 + overhead + 2 * Link::FRAMING);
                let whole = Duration::from_nanos(bytes.saturating_mul(1_000_000_000) / rate.max(1));
                let least = many.max(whole);
                self.each(|link| {
                    link.set_interval(slow(link, link.interval_at(share, overhead).max(least)));
                });
            }
            (rate, Some(_)) => {
                let Some((_, link)) = self.machines.iter().next() else { return };
                let word = NeighbourEntry {
                    to: NodeId(0),
                    stance: HelloState::Ready,
                    loss_permille: 0,
                    echo: Some(CompactEcho { incarnation: 0, sequence: 0, held_us: 0 }),
                };
                let greeting = link.greeting(0, 1, vec![word; links.min(Self::WORDS)]);
                let length = Frame::Greeting(greeting).encode().len() as u64 + Link::FRAMING;
                let bytes = length * (links as u64 + 1) * Self::SHARE;
                let nanos = bytes * 1_000_000_000 / rate.unwrap_or(u64::MAX).max(1);
                // One greeting for all: its interval is the longest that any of the links wants.
                let wanted = self.machines.iter().map(|(_, link)| link.configured_interval());
                let interval = wanted.max().unwrap_or_default().max(Duration::from_nanos(nanos));
                self.each(|link| link.set_interval(interval));
            }
            (None, None) => self.each(|link| link.set_interval(slow(link, many))),
        }
    }

    /// Sends the greeting that is due, if one is.
    fn greet(&mut self, now: Instant) {
        let mut due = None;
        if self.bus.is_some() {
            self.each(|link| due = due.max(link.take_greeting()));
        }
        let (Some(sequence), Some(sent)) = (due, &mut self.bus) else { return };
        let mut words: Vec<(LinkId, bool, u64, NeighbourEntry)> = Vec::new();
        for (number, link) in self.machines.iter() {
            let Some(word) = link.word(now) else { continue };
            let before = sent.get(&number);
            let changed = before.is_none_or(|before| before.stance != word.stance);
            if changed || link.is_received(now) {
                words.push((number, changed, before.map_or(0, |before| before.at), word));
            }
        }
        // Changed entries first, then those that have waited longest.
        words.sort_by_key(|(number, changed, at, _)| (!changed, *at, *number));
        let turn = words.len().div_ceil(Self::WORDS).clamp(1, usize::from(u8::MAX)) as u8;
        words.truncate(Self::WORDS);
        let last = sent.values().map(|sent| sent.at).max().unwrap_or(0);
        for ((number, _, _, word), at) in words.iter().zip(last + 1..) {
            sent.insert(*number, SentState { stance: word.stance, at });
        }
        let Some((_, link)) = self.machines.iter().next() else { return };
        let words = words.into_iter().map(|(_, _, _, word)| word).collect();
        let greeting = link.greeting(sequence, turn, words);
        self.greetings.push_back(Frame::Greeting(greeting).parcel());
    }
}

impl Machine for LinkSet {
    type Output = LinkSetOutput;

    fn poll_output(&mut self) -> Option<LinkSetOutput> {
        if let Some(late) = self.stalled.take() {
            return Some(LinkSetOutput::Stalled(late));
        }
        if let Some(greeting) = self.greetings.pop_front() {
            return Some(LinkSetOutput::Greet(greeting));
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
        self.greet(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::link::LinkConfig;
    use crate::net::wire::bus_hello::BusHello;
    use crate::{Incarnation, NodeName};

    const INTERVAL: u64 = 50;

    fn name(number: u16) -> NodeName {
        NodeName::new(&format!("m{number}")).unwrap()
    }

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    /// A bundle with links to nodes 1 to `links`, on a bus.
    fn bundle(links: u16) -> LinkSet {
        let mut bundle = LinkSet::default();
        for number in 1..=links {
            let config = LinkConfig::new(name(0), Incarnation(1));
            bundle.insert(LinkId(number), Link::new(config, at(0)));
        }
        bundle.handle_bus();
        while bundle.poll_output().is_some() {}
        bundle
    }

    /// All neighbours greet, and what the bundle says next is read.
    fn turn(bundle: &mut LinkSet, number: u32, speakers: &[u16]) -> BusHello {
        let now = at(INTERVAL * u64::from(number));
        for speaker in speakers {
            let greeting = BusHello {
                node: name(*speaker),
                incarnation: Incarnation(7),
                sequence: number,
                interval_us: 50_000,
                turn: 1,
                words: Vec::new(),
            };
            let link = bundle.get_mut(LinkId(*speaker)).unwrap();
            link.handle_frame(Frame::Greeting(greeting).encode(), now);
        }
        bundle.handle_timeout(now);
        let mut outputs = Vec::new();
        while let Some(output) = bundle.poll_output() {
            if let LinkSetOutput::Greet(frame) = output {
                outputs.push(frame);
            }
        }
        assert_eq!(outputs.len(), 1, "one for all");
        match Frame::decode(outputs.remove(0).into_bytes()) {
            Ok(Frame::Greeting(greeting)) => greeting,
            other => panic!("{other:?}"),
        }
    }

    fn addressed(greeting: &BusHello) -> Vec<NodeId> {
        greeting.words.iter().map(|word| word.to).collect()
    }

    #[test]
    fn those_who_are_heard_have_a_word_in_turn_and_nobody_else() {
        let mut bundle = bundle(6);
        let to = |number| NodeId::of(&name(number));

        let first = turn(&mut bundle, 1, &[1, 2, 4, 5, 6]);
        let second = turn(&mut bundle, 2, &[1, 2, 4, 5, 6]);
        let third = turn(&mut bundle, 3, &[1, 2, 4, 5, 6]);

        assert_eq!((first.turn, second.turn, third.turn), (3, 3, 3));
        assert_eq!(addressed(&first), [to(1), to(2)]);
        assert_eq!(addressed(&second), [to(4), to(5)]);
        assert_eq!(addressed(&third), [to(6), to(1)]);
        assert_eq!(third.words[1].echo.map(|echo| echo.sequence), Some(3));
    }

    #[test]
    fn a_neighbour_that_has_left_has_no_word_any_more() {
        let mut bundle = bundle(3);
        for number in 1..5 {
            turn(&mut bundle, number, &[1, 2, 3]);
        }

        for number in 5..10 {
            turn(&mut bundle, number, &[1, 2]);
        }

        let greeting = turn(&mut bundle, 10, &[1, 2]);
        assert_eq!(greeting.turn, 1);
        assert!(!addressed(&greeting).contains(&NodeId::of(&name(3))));
    }

    #[test]
    fn without_a_bus_each_link_says_its_own_hello() {
        let mut bundle = LinkSet::default();
        for number in 1..=2 {
            let config = LinkConfig::new(name(0), Incarnation(1));
            bundle.insert(LinkId(number), Link::new(config, at(0)));
        }

        while bundle.poll_output().is_some() {}
        bundle.handle_timeout(at(0));

        let outputs: Vec<_> = std::iter::from_fn(|| bundle.poll_output()).collect();
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
        let mut bundle = LinkSet::default();
        let config = LinkConfig::new(name(0), Incarnation(1));
        bundle.insert(LinkId(1), Link::new(config, at(0)));
        let mut stalls = Vec::new();
        for now in [0, 50, 149, 250, 350, 400] {
            bundle.handle_timeout(at(now));
            let outputs = std::iter::from_fn(|| bundle.poll_output());
            stalls.extend(outputs.filter_map(|output| match output {
                LinkSetOutput::Stalled(late) => Some((now, late.as_millis())),
                _ => None,
            }));
        }
        assert_eq!(stalls, [(250, 100)]);
    }
}
