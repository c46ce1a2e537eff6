//! Three nodes that want channels with each other, and the adversary between them.

use blastema_core::net::NodeId;
use blastema_core::net::seal::{
    FrameLane, KeyLimits, SealCrypto, SealProfile, Sealer, SealerConfig, SealerOutput,
};
use blastema_core::random::Random;
use blastema_core::{Incarnation, Instant, Machine};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::time::Duration;

const NODES: u32 = 3;
/// An address of the adversary's own. What is sent there reaches no node.
const ELSEWHERE: u32 = 99;
/// Frames that the adversary has recorded.
const RECORDED_MAX: usize = 400;

/// A frame on its way: who sent it, and to which address.
type InFlight = (u32, u32, Bytes);

pub(crate) struct World<C: SealCrypto, F> {
    random: Random,
    profile: SealProfile,
    crypto: F,
    public: fn(u32) -> [u8; 32],
    nodes: Vec<Sealer<C, u32>>,
    incarnations: Vec<u64>,
    now: Instant,
    in_flight: Vec<InFlight>,
    recorded: Vec<InFlight>,
    /// What nodes have sealed: sender, its incarnation, receiver, and number.
    sealed: u64,
    opened: BTreeSet<u64>,
    /// Bytes from the address elsewhere, and to it.
    from_elsewhere: usize,
    to_elsewhere: usize,
}

impl<C: SealCrypto, F: Fn(u32) -> C> World<C, F> {
    pub(crate) fn new(
        seed: u64,
        profile: SealProfile,
        crypto: F,
        public: fn(u32) -> [u8; 32],
    ) -> Self {
        let mut world = World {
            random: Random::new(seed),
            profile,
            crypto,
            public,
            nodes: Vec::new(),
            incarnations: vec![10; NODES as usize],
            now: Instant::from_millis(1),
            in_flight: Vec::new(),
            recorded: Vec::new(),
            sealed: 0,
            opened: BTreeSet::new(),
            from_elsewhere: 0,
            to_elsewhere: 0,
        };
        for node in 0..NODES {
            let sealer = world.started(node);
            world.nodes.push(sealer);
        }
        (0..NODES).for_each(|node| world.connect_all(node));
        world
    }

    fn started(&mut self, node: u32) -> Sealer<C, u32> {
        let incarnation = Incarnation(self.incarnations[node as usize]);
        // Small, so that keys are renewed all the time.
        let limits = KeyLimits {
            renew_after_frames: 20 + self.random.below(100),
            frames_max: 200,
            renew_after: Duration::from_secs(1 + self.random.below(20)),
            age_max: Duration::from_secs(40),
            ..KeyLimits::default()
        };
        let config = SealerConfig {
            profile: self.profile,
            limits,
            fast_aes: self.random.chance(0.8),
            ..SealerConfig::new(NodeId(node), incarnation, "ranger")
        };
        let mut seed = [0; 32];
        seed[..8].copy_from_slice(&self.random.next().to_be_bytes());
        let mut sealer = Sealer::new(config, (self.crypto)(node), seed, self.now);
        for peer in (0..NODES).filter(|peer| *peer != node) {
            sealer.add_peer(NodeId(peer), &(self.public)(peer)).expect("a good key");
        }
        sealer
    }

    fn connect_all(&mut self, node: u32) {
        for peer in (0..NODES).filter(|peer| *peer != node) {
            self.nodes[node as usize].connect(NodeId(peer), peer, self.now);
        }
        self.drive(node);
    }

    fn any_node(&mut self) -> u32 {
        self.random.below(NODES.into()) as u32
    }

    /// So many steps of the nodes and of the adversary.
    pub(crate) fn attack(&mut self, steps: usize) {
        for _ in 0..steps {
            match self.random.below(400) {
                0..160 => self.deliver(),
                160..220 => self.say(),
                220..285 => self.turn(),
                285..325 => self.pass(20),
                325..333 => drop(self.take()),
                333..365 => self.repeat(),
                365..385 => self.change(),
                385..394 => self.splice(),
                394..396 => self.restart(),
                396 => {
                    let node = self.any_node();
                    self.connect_all(node);
                }
                _ => self.pass(2_000),
            }
            assert!(self.to_elsewhere <= self.from_elsewhere, "no address gets more than it sent");
        }
    }

    /// Takes one of the frames on their way, in any order.
    fn take(&mut self) -> Option<InFlight> {
        let count = self.in_flight.len() as u64;
        let at = (count > 0).then(|| self.random.below(count.min(6)) as usize)?;
        Some(self.in_flight.remove(at))
    }

    fn recorded(&mut self) -> Option<InFlight> {
        let count = self.recorded.len() as u64;
        (count > 0).then(|| self.recorded[self.random.below(count) as usize].clone())
    }

    fn deliver(&mut self) {
        if let Some((from, to, frame)) = self.take() {
            self.receive(to, from, frame);
        }
    }

    /// A recorded frame once more, to its receiver or another, from its address or another.
    fn repeat(&mut self) {
        let Some((from, to, frame)) = self.recorded() else { return };
        let from = if self.random.chance(0.3) { ELSEWHERE } else { from };
        let to = if self.random.chance(0.8) { to } else { self.any_node() };
        self.receive(to, from, frame);
    }

    fn change(&mut self) {
        let Some((from, to, frame)) = self.recorded() else { return };
        let mut frame = frame.to_vec();
        match self.random.below(4) {
            0 => frame.truncate(self.random.below(frame.len() as u64 + 1) as usize),
            1 => frame.push(self.random.next() as u8),
            _ => {
                // The bits of the header first.
                let within = if self.random.chance(0.5) { 12 } else { frame.len() as u64 };
                let at = self.random.below(within.min(frame.len() as u64).max(1)) as usize;
                if let Some(byte) = frame.get_mut(at) {
                    *byte ^= 1 << self.random.below(8);
                }
            }
        }
        self.receive(to, from, frame.into());
    }

    /// The beginning of one frame with the end of another of its length.
    fn splice(&mut self) {
        let (Some(one), Some(_)) = (self.recorded(), self.recorded()) else { return };
        let alike: Vec<_> =
            self.recorded.iter().filter(|other| other.2.len() == one.2.len()).cloned().collect();
        let other = &alike[self.random.below(alike.len() as u64) as usize].2;
        let cut = self.random.below(one.2.len() as u64) as usize;
        let frame = [&one.2[..cut], &other[cut..]].concat();
        self.receive(one.1, one.0, frame.into());
    }

    fn turn(&mut self) {
        let node = self.any_node();
        self.nodes[node as usize].handle_turn(self.now);
        self.drive(node);
    }

    /// Time passes, and timers fire that are due.
    fn pass(&mut self, at_most_ms: u64) {
        self.now = self.now + Duration::from_millis(1 + self.random.below(at_most_ms));
        for node in 0..NODES {
            let sealer = &mut self.nodes[node as usize];
            if sealer.poll_timeout().is_some_and(|due| due <= self.now) {
                sealer.handle_timeout(self.now);
                assert!(sealer.poll_timeout().is_none_or(|due| due > self.now));
            }
            self.drive(node);
        }
    }

    /// A node ends and starts, or its network is built once more in the same incarnation.
    fn restart(&mut self) {
        let node = self.any_node();
        if self.random.chance(0.7) {
            self.incarnations[node as usize] += 1;
        }
        self.nodes[node as usize] = self.started(node);
        self.connect_all(node);
    }

    fn say(&mut self) {
        let (from, to) = (self.any_node(), self.any_node());
        let lane = FrameLane::ALL[self.random.below(3) as usize];
        self.seal(from, to, lane);
    }

    fn seal(&mut self, from: u32, to: u32, lane: FrameLane) -> Option<u64> {
        let incarnation = self.incarnations[from as usize];
        let number = self.sealed;
        let text = [u64::from(from), incarnation, u64::from(to), lane as u64, number];
        let text = text.map(u64::to_be_bytes).concat();
        let sealer = &mut self.nodes[from as usize];
        let frame = sealer.seal(NodeId(to), lane, &[&text[..9], &text[9..]], self.now)?;
        self.sealed += 1;
        self.send(from, to, frame);
        self.drive(from);
        Some(number)
    }

    fn send(&mut self, from: u32, to: u32, frame: Bytes) {
        if to == ELSEWHERE {
            self.to_elsewhere += frame.len();
            return;
        }
        if self.recorded.len() < RECORDED_MAX {
            self.recorded.push((from, to, frame.clone()));
        } else {
            let at = self.random.below(RECORDED_MAX as u64) as usize;
            self.recorded[at] = (from, to, frame.clone());
        }
        self.in_flight.push((from, to, frame));
    }

    fn receive(&mut self, to: u32, from: u32, frame: Bytes) {
        if from == ELSEWHERE {
            self.from_elsewhere += frame.len();
        }
        let opened = self.nodes[to as usize].handle_frame(frame, &from, self.now);
        if let Ok(Some(frame)) = opened {
            let words: Vec<u64> = frame
                .plain
                .chunks(8)
                .map(|word| u64::from_be_bytes(word.try_into().expect("what was sealed")))
                .collect();
            let [sender, incarnation, receiver, lane, number] = words[..] else {
                panic!("what no node has sealed was opened: {words:?}")
            };
            assert_eq!((frame.peer, frame.incarnation.0), (NodeId(sender as u32), incarnation));
            assert_eq!((to, frame.lane as u64), (receiver as u32, lane));
            assert!(self.opened.insert(number), "frame {number} was opened twice");
        }
        self.drive(to);
    }

    fn drive(&mut self, node: u32) {
        while let Some(output) = self.nodes[node as usize].poll_output() {
            match output {
                SealerOutput::Transmit { to, frame } => self.send(node, to, frame),
                SealerOutput::PeerOpen { peer, incarnation, .. } => {
                    let newest = self.incarnations[peer.0 as usize];
                    assert!(incarnation.0 <= newest);
                }
                SealerOutput::KeyInUse { open, refused, .. } => assert_ne!(open, refused),
                SealerOutput::KeyWornOut { .. } => {}
            }
        }
    }

    /// The adversary is gone. Links that are down ask for new channels; within a second all are
    /// open and everything that is sealed arrives.
    pub(crate) fn heal(&mut self) {
        self.in_flight.clear();
        // Nodes that were restarted within a fifth of a second are refused as long as that.
        self.now = self.now + Duration::from_millis(200);
        (0..NODES).for_each(|node| self.connect_all(node));
        for _ in 0..1_000 {
            self.pass(1);
            let arrived = std::mem::take(&mut self.in_flight);
            for (from, to, frame) in arrived {
                self.receive(to, from, frame);
            }
            for node in 0..NODES {
                self.nodes[node as usize].handle_turn(self.now);
                self.drive(node);
            }
        }
        for (from, to) in (0..NODES).flat_map(|a| (0..NODES).map(move |b| (a, b))) {
            if from == to {
                continue;
            }
            let open = self.nodes[from as usize].channel(NodeId(to));
            let open = open.map(|status| status.incarnation.0);
            assert_eq!(open, Some(self.incarnations[to as usize]), "{from} -> {to}");
            let number = self.seal(from, to, FrameLane::Usual).expect("there is a channel");
            for (from, to, frame) in std::mem::take(&mut self.in_flight) {
                self.receive(to, from, frame);
            }
            assert!(self.opened.contains(&number), "{from} -> {to}");
        }
    }

    /// How many frames were opened.
    pub(crate) fn opened(&self) -> usize {
        self.opened.len()
    }

    /// What the adversary has recorded.
    pub(crate) fn frames(self) -> Vec<Bytes> {
        self.recorded.into_iter().map(|(_, _, frame)| frame).collect()
    }
}
