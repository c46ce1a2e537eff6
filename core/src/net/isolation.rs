//! Nodes that cannot be recovered: what they send is refused everywhere.
//!
//! Any node may decide so. A verdict has a revision: the newest holds, of equal ones that of the first
//! node by name. It is told to every node that a session is open with, passed on by those for whom it is
//! new, and told again whenever a session begins, so that nobody who was away misses it. What an
//! isolated node says of verdicts is refused like everything else that it says.

use crate::NodeName;
use crate::codec;
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Nodes on which there is a verdict, at most: far more than a robot has.
const VERDICTS_MAX: usize = 1024;
/// The most bytes of one message: all verdicts.
const MESSAGE_MAX: usize = 128 * 1024;

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsolationOutput {
    /// Tell another node.
    Tell {
        /// Whom.
        to: NodeName,
        /// What.
        message: Bytes,
    },
    /// From now on nothing is taken from this node and nothing sent there, or all is well again.
    Isolate {
        /// Which.
        node: NodeName,
        /// Whether it is isolated.
        isolated: bool,
        /// Who decided.
        by: NodeName,
    },
}

/// What was decided of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Verdict {
    node: NodeName,
    isolated: bool,
    revision: u64,
    by: NodeName,
}

/// The verdicts as one node knows them.
#[derive(Debug)]
pub struct Isolation {
    own: NodeName,
    verdicts: BTreeMap<NodeName, Verdict>,
    peers: BTreeSet<NodeName>,
    refused: u64,
    outputs: VecDeque<IsolationOutput>,
}

impl Isolation {
    /// No verdicts yet.
    pub fn new(own: NodeName) -> Self {
        Isolation {
            own,
            verdicts: BTreeMap::new(),
            peers: BTreeSet::new(),
            refused: 0,
            outputs: VecDeque::new(),
        }
    }

    /// The next thing to do, in order.
    pub fn poll_output(&mut self) -> Option<IsolationOutput> {
        self.outputs.pop_front()
    }

    /// Whether nothing is taken from this node.
    pub fn is_isolated(&self, node: &NodeName) -> bool {
        self.verdicts.get(node).is_some_and(|verdict| verdict.isolated)
    }

    /// What was refused: nonsense, too many, and what isolated nodes said.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// This node decides. On itself it has no say.
    pub fn handle_decision(&mut self, node: &NodeName, isolated: bool) {
        if *node == self.own || self.is_isolated(node) == isolated {
            return;
        }
        let revision = self.verdicts.get(node).map_or(1, |verdict| verdict.revision + 1);
        let by = self.own.clone();
        self.take(Verdict { node: node.clone(), isolated, revision, by });
    }

    /// A session with this node has begun.
    pub fn handle_opened(&mut self, node: NodeName) {
        if !self.verdicts.is_empty() && !self.is_isolated(&node) {
            let all: Vec<&Verdict> = self.verdicts.values().collect();
            let message = codec::encode_unbounded(&all).into();
            self.outputs.push_back(IsolationOutput::Tell { to: node.clone(), message });
        }
        self.peers.insert(node);
    }

    /// The session with this node has ended.
    pub fn handle_ended(&mut self, node: &NodeName) {
        self.peers.remove(node);
    }

    /// Another node tells of verdicts.
    pub fn handle_told(&mut self, from: &NodeName, message: &[u8]) {
        let told = codec::decode_bounded::<Vec<Verdict>, MESSAGE_MAX>(message);
        let (Ok(told), false) = (told, self.is_isolated(from)) else {
            self.refused += 1;
            return;
        };
        for verdict in told {
            let known = self.verdicts.get(&verdict.node);
            let newer = known
                .is_none_or(|known| (verdict.revision, &known.by) > (known.revision, &verdict.by));
            if newer && (known.is_some() || self.verdicts.len() < VERDICTS_MAX) {
                self.take(verdict);
            } else if newer {
                self.refused += 1;
            }
        }
    }

    fn take(&mut self, verdict: Verdict) {
        let before = self.is_isolated(&verdict.node);
        let message = Bytes::from(codec::encode_unbounded(&vec![&verdict]));
        let Verdict { node, isolated, by, .. } = verdict.clone();
        self.verdicts.insert(node.clone(), verdict);
        for to in self.peers.iter().filter(|peer| **peer != node) {
            let (to, message) = (to.clone(), message.clone());
            self.outputs.push_back(IsolationOutput::Tell { to, message });
        }
        // Of itself a node learns, but it is for the others to refuse it.
        if before != isolated && node != self.own {
            self.outputs.push_back(IsolationOutput::Isolate { node, isolated, by });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    /// Nodes in a row hear only their neighbours.
    fn row(names: &[&str]) -> BTreeMap<NodeName, Isolation> {
        let mut robot: BTreeMap<_, _> =
            names.iter().map(|name| (node(name), Isolation::new(node(name)))).collect();
        for pair in names.windows(2) {
            robot.get_mut(&node(pair[0])).unwrap().handle_opened(node(pair[1]));
            robot.get_mut(&node(pair[1])).unwrap().handle_opened(node(pair[0]));
        }
        robot
    }

    fn carry(robot: &mut BTreeMap<NodeName, Isolation>) -> Vec<String> {
        let mut told = vec![];
        loop {
            let mut outputs = vec![];
            for (name, isolation) in robot.iter_mut() {
                outputs.extend(isolation.poll_output().map(|output| (name.clone(), output)));
            }
            if outputs.is_empty() {
                return told;
            }
            for (from, output) in outputs {
                match output {
                    IsolationOutput::Tell { to, message } => {
                        if let Some(isolation) = robot.get_mut(&to) {
                            isolation.handle_told(&from, &message);
                        }
                    }
                    IsolationOutput::Isolate { node, isolated, by } => {
                        told.push(format!("{from}: {node} {isolated} by {by}"));
                    }
                }
            }
        }
    }

    #[test]
    fn a_verdict_reaches_everybody_and_can_be_lifted_by_another() {
        let mut robot = row(&["a", "b", "c", "d"]);
        robot.get_mut(&node("a")).unwrap().handle_decision(&node("d"), true);
        let told = carry(&mut robot);
        assert_eq!(told, ["a: d true by a", "b: d true by a", "c: d true by a"]);

        robot.get_mut(&node("c")).unwrap().handle_decision(&node("d"), false);
        assert_eq!(carry(&mut robot).len(), 3);
        assert!(robot.values().all(|isolation| !isolation.is_isolated(&node("d"))));
    }

    #[test]
    fn who_was_away_is_told_when_it_is_back_and_an_isolated_node_is_not_believed() {
        let mut robot = row(&["a", "b"]);
        robot.get_mut(&node("a")).unwrap().handle_decision(&node("d"), true);
        carry(&mut robot);

        robot.insert(node("c"), Isolation::new(node("c")));
        robot.get_mut(&node("b")).unwrap().handle_opened(node("c"));
        assert_eq!(carry(&mut robot), ["c: d true by a"]);

        let mut hostile = Isolation::new(node("d"));
        hostile.handle_opened(node("b"));
        hostile.handle_decision(&node("a"), true);
        let Some(IsolationOutput::Tell { message, .. }) = hostile.poll_output() else { panic!() };
        let victim = robot.get_mut(&node("b")).unwrap();
        victim.handle_told(&node("d"), &message);
        victim.handle_told(&node("a"), b"\xff\xff");
        assert!(!victim.is_isolated(&node("a")));
        assert_eq!(victim.refused(), 2);
    }

    #[test]
    fn two_that_decide_at_once_agree_afterwards() {
        let mut robot = row(&["a", "b", "c"]);
        robot.get_mut(&node("a")).unwrap().handle_decision(&node("d"), true);
        robot.get_mut(&node("c")).unwrap().handle_decision(&node("d"), true);
        carry(&mut robot);
        let by: BTreeSet<_> =
            robot.values().map(|isolation| isolation.verdicts[&node("d")].by.clone()).collect();
        assert_eq!(by, BTreeSet::from([node("a")]));
        robot.get_mut(&node("a")).unwrap().handle_decision(&node("a"), true);
        assert_eq!(carry(&mut robot), Vec::<String>::new(), "on itself a node has no say");
    }
}
