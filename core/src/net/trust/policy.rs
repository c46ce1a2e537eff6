//! Roles, verbs and policy lines, and the decision whether a peer may do something.
//!
//! ```text
//! only PEER…  may VERB…  on OBJECT-PATTERN  [by CONTRACT-PATTERN]
//! ```
//!
//! `*` is one part of a name between slashes, `**` any number of parts, also none. There is no line
//! that denies, and no order: a line closes what was open to all, and opens it to those that it
//! names.

use super::text::{PEERS_END, TrustProblem};
use crate::NodeName;
use std::fmt;

/// An enumeration whose variants are words of a file.
macro_rules! words {
    ($(#[$doc:meta])* $name:ident { $($(#[$what:meta])* $variant:ident = $word:literal),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[non_exhaustive]
        pub enum $name { $($(#[$what])* $variant),* }

        impl $name {
            /// All of them.
            pub const ALL: &[$name] = &[$($name::$variant),*];

            /// Returns the word that stands for it in a file.
            pub fn word(self) -> &'static str {
                match self { $($name::$variant => $word),* }
            }

            /// The one of this word.
            ///
            /// # Errors
            /// The nearest word, or all of them.
            pub fn parse(word: &str) -> Result<Self, TrustProblem> {
                let found = $name::ALL.iter().copied().find(|known| known.word() == word);
                let known = $name::ALL.iter().map(|known| known.word());
                found.ok_or_else(|| TrustProblem::unknown(word, known))
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.word())
            }
        }
    };
}

words! {
    /// What a node is to the robot.
    Role {
        /// Everything but what operators alone may.
        Node = "node",
        /// It operates other nodes as well.
        Operator = "operator",
        /// Nothing that no line gives it.
        Guest = "guest",
    }
}

words! {
    /// What one node may do at another.
    Verb {
        /// Send requests to an object.
        Ask = "ask",
        /// Send messages without reply to an object.
        Tell = "tell",
        /// Receive a topic's events.
        Listen = "listen",
        /// Send events to listeners of a topic.
        Publish = "publish",
        /// Read an object's variables.
        Read = "read",
        /// Write an object's variables.
        Set = "set",
        /// Claim the right to command an actuator.
        Lease = "lease",
        /// Hold a name of the whole robot, or be a member of a service.
        Claim = "claim",
        /// Hand a fault to the node's recoverer.
        Recover = "recover",
        /// Start, stop and restart components, isolate and admit nodes, inject faults.
        Operate = "operate",
    }
}

impl Role {
    /// Whether a peer of this role may do it where no line matches.
    pub(super) fn may(self, verb: Verb) -> bool {
        match verb {
            Verb::Operate => self == Role::Operator,
            _ => self != Role::Guest,
        }
    }
}

/// A pattern of names whose parts are separated by slashes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern(String);

/// The longest pattern, in bytes.
const PATTERN_BYTES: usize = 256;
/// The longest path of names that two `**` are matched against without cost worth a thought.
const PARTS: usize = 32;

impl Pattern {
    pub(super) fn parse(text: &str) -> Result<Self, TrustProblem> {
        let is_name = |part: &str| {
            let is_letter = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
            !part.is_empty() && part.chars().all(is_letter)
        };
        let parts = || text.split('/');
        let is_wide = |(a, b): (&str, &str)| a == "**" && b == "**";
        let well_formed = text.len() <= PATTERN_BYTES
            && parts().count() <= PARTS
            && parts().all(|part| part == "*" || part == "**" || is_name(part))
            && !parts().zip(parts().skip(1)).any(is_wide);
        let why = "a pattern of names, such as arm/**, arm/*/elbow or *: `*` stands for one part, \
                   `**` for any number";
        if well_formed { Ok(Pattern(text.to_owned())) } else { Err(TrustProblem::expected(why)) }
    }

    /// Whether a name is of this pattern.
    pub fn matches(&self, name: &str) -> bool {
        let pattern: Vec<&str> = self.0.split('/').collect();
        let name: Vec<&str> = name.split('/').collect();
        // reached[n]: the parts of the pattern so far match the first n parts of the name.
        let mut reached = vec![false; name.len() + 1];
        reached[0] = true;
        for part in pattern {
            let mut next = vec![false; name.len() + 1];
            for (place, matched) in next.iter_mut().enumerate() {
                *matched = match (part, place.checked_sub(1)) {
                    ("**", _) => reached[..=place].contains(&true),
                    (_, None) => false,
                    ("*", Some(before)) => reached[before],
                    (part, Some(before)) => reached[before] && name[before] == part,
                };
            }
            reached = next;
        }
        reached[name.len()]
    }
}

/// One line of the policy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyLine {
    pub(super) peers: Vec<NodeName>,
    pub(super) verbs: Vec<Verb>,
    object: Pattern,
    contract: Option<Pattern>,
}

impl PolicyLine {
    /// Parses the words of a line.
    ///
    /// # Errors
    /// What is wrong, and what to write.
    pub fn parse(words: &[&str]) -> Result<Self, TrustProblem> {
        const FORM: &str = "`only PEER… may VERB… on OBJECT [by CONTRACT]`, or `end`";
        let form = || TrustProblem::expected(FORM);
        let Some((&"only", rest)) = words.split_first() else { return Err(form()) };
        let may = rest.iter().position(|word| *word == PEERS_END).ok_or_else(form)?;
        let (peers, rest) = (&rest[..may], &rest[may + 1..]);
        let on = rest.iter().position(|word| *word == "on").ok_or_else(form)?;
        let (verbs, contract) = (&rest[..on], rest.get(on + 3));
        let object = match &rest[on + 1..] {
            [object] | [object, "by", _] => object,
            _ => return Err(form()),
        };
        if peers.is_empty() || verbs.is_empty() {
            return Err(form());
        }
        Ok(PolicyLine {
            peers: peers.iter().map(|peer| NodeName::new(peer)).collect::<Result<_, _>>()?,
            verbs: verbs.iter().map(|verb| Verb::parse(verb)).collect::<Result<_, _>>()?,
            object: Pattern::parse(object)?,
            contract: contract.map(|contract| Pattern::parse(contract)).transpose()?,
        })
    }

    fn matches(&self, verb: Verb, object: &str, contract: &str) -> bool {
        self.verbs.contains(&verb)
            && self.object.matches(object)
            && self.contract.as_ref().is_none_or(|pattern| pattern.matches(contract))
    }
}

impl fmt::Display for PolicyLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("only")?;
        self.peers.iter().try_for_each(|peer| write!(f, " {peer}"))?;
        f.write_str(" may")?;
        self.verbs.iter().try_for_each(|verb| write!(f, " {verb}"))?;
        write!(f, " on {}", self.object.0)?;
        self.contract.as_ref().map_or(Ok(()), |contract| write!(f, " by {}", contract.0))
    }
}

/// Whether a peer of this role may do this, by these lines. For all lines that match the verb, the
/// object and the contract, the peer must be named in one. Where no line matches, its role decides.
///
/// # Errors
/// It may not: this line, from 1 on, gives it to others; or its role does not, and no line gives it.
pub(super) fn permission(
    lines: &[PolicyLine],
    peer: &NodeName,
    role: Role,
    verb: Verb,
    object: &str,
    contract: &str,
) -> Result<(), Option<usize>> {
    let mut refused = None;
    for (place, line) in lines.iter().enumerate() {
        if line.matches(verb, object, contract) {
            if line.peers.contains(peer) {
                return Ok(());
            }
            refused.get_or_insert(place + 1);
        }
    }
    match refused {
        None if role.may(verb) => Ok(()),
        refused => Err(refused),
    }
}
