//! Lines of words, keys in letters, and errors that say which line is wrong and what to write.

use super::crypto::{KEY_BYTES, PublicKey};
use crate::net::wire::advertisement::INCARNATION_MAX;
use crate::suggestion::nearest;
use crate::{NameError, NodeName};
use std::fmt;
use zeroize::Zeroize;

/// The word of a policy line that ends its peers: no node has this name.
pub(super) const PEERS_END: &str = "may";

/// What is wrong with a file, and in which line. A word of the file is never repeated where it
/// could be a secret.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct TrustError {
    /// The line, from 1 on.
    pub line: usize,
    /// What is wrong there.
    pub problem: TrustProblem,
}

/// What is wrong with one line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TrustProblem {
    /// The file is longer than it may be.
    #[error("the file has more than {most} bytes: it is no such file")]
    TooLong {
        /// So many it may have.
        most: usize,
    },
    /// The line begins with a word that is unknown there, or the file ends too early.
    #[error("this line begins otherwise than it must: write {expected}")]
    Expected {
        /// What must stand there.
        expected: String,
    },
    /// A word is none of those that are known there.
    #[error("a word is unknown: {0}")]
    UnknownWord(String),
    /// The first line is that of no such file, or of a file of another kind.
    #[error(
        "the file does not begin with `{title}`: it is empty, or another kind of file; copy it again"
    )]
    OtherFile {
        /// The first line that it must have.
        title: &'static str,
    },
    /// What is there after the end.
    #[error("nothing follows here: remove this line and those after it")]
    Excess,
    /// A name cannot be one.
    #[error(transparent)]
    Name(#[from] NameError),
    /// A key is not 32 bytes in base64url.
    #[error("a key has 43 letters (base64url of 32 bytes): copy the line again from its source")]
    NotKey,
    /// A serial number is none.
    #[error("a serial number is a whole number from 1 on")]
    NotSerial,
    /// The number of an incarnation is none.
    #[error("an incarnation is a whole number below {}", INCARNATION_MAX.0)]
    NotIncarnation,
    /// There are more nodes than a roster may list.
    #[error("a roster lists {most} nodes at most: remove nodes that are gone")]
    TooManyNodes {
        /// So many it may list.
        most: usize,
    },
    /// A node is listed twice.
    #[error("node {0} is listed twice: remove one of the lines")]
    NodeTwice(NodeName),
    /// Two nodes have one key.
    #[error("the key of this node is also that of {0}: make a new one by `blastema keys replace`")]
    KeyTwice(NodeName),
    /// The names of two nodes give one number.
    #[error(
        "the name of this node has the number {number}, as {other} has, and packets name a node by \
         its number: give the node another name"
    )]
    NumberTaken {
        /// The number that both names give.
        number: crate::net::NodeId,
        /// The node that has the number already.
        other: NodeName,
    },
    /// The name of a node is the word that ends the peers of a policy line.
    #[error("no node is called `{PEERS_END}`: the word ends the peers of a policy line")]
    ReservedName,
    /// A signed text differs from how it would be written.
    #[error("the text is not as the signer writes it: copy the file again")]
    NotCanonical,
    /// The signature is missing or wrong.
    #[error(
        "the signature is not by this robot's key: the list is of another robot, or was changed; \
         copy the file again"
    )]
    NotSigned,
}

impl TrustProblem {
    /// This problem in a line.
    pub(super) fn at(self, line: usize) -> TrustError {
        TrustError { line, problem: self }
    }

    pub(super) fn expected(what: impl fmt::Display) -> Self {
        TrustProblem::Expected { expected: what.to_string() }
    }

    /// `found` is none of these. It is not repeated: it may be a secret that stands in a wrong
    /// place.
    pub(super) fn unknown<'a>(found: &str, known: impl Iterator<Item = &'a str> + Clone) -> Self {
        TrustProblem::UnknownWord(match nearest(found, known.clone()) {
            Some(word) => format!("did you mean `{word}`?"),
            None => format!("write one of {}", known.collect::<Vec<_>>().join(", ")),
        })
    }
}

/// The lines of a text, each with its number and its words.
pub(super) struct Lines<'a> {
    lines: std::str::Lines<'a>,
    number: usize,
}

impl<'a> Lines<'a> {
    pub(super) fn new(text: &'a str, most: usize) -> Result<Self, TrustError> {
        match text.len() > most {
            true => Err(TrustProblem::TooLong { most }.at(1)),
            false => Ok(Lines { lines: text.lines(), number: 0 }),
        }
    }

    /// The next line's number and words. After the end there are no words.
    pub(super) fn next(&mut self) -> (usize, Vec<&'a str>) {
        self.number += 1;
        (self.number, self.lines.next().unwrap_or_default().split_whitespace().collect())
    }

    /// The only other word of a line that begins so.
    pub(super) fn value(&mut self, word: &str) -> Result<(usize, &'a str), TrustError> {
        match self.next() {
            (line, words) if words.len() == 2 && words[0] == word => Ok((line, words[1])),
            (line, _) => Err(TrustProblem::expected(format!("`{word}` and one word")).at(line)),
        }
    }

    /// The first line, by which a kind of file is known.
    pub(super) fn title(&mut self, title: &'static str) -> Result<(), TrustError> {
        match self.next() {
            (_, words) if words.join(" ") == title => Ok(()),
            (line, _) => Err(TrustProblem::OtherFile { title }.at(line)),
        }
    }

    /// Refuses further lines.
    pub(super) fn finish(mut self) -> Result<(), TrustError> {
        match self.lines.next() {
            None => Ok(()),
            Some(_) => Err(TrustProblem::Excess.at(self.number + 1)),
        }
    }
}

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// Base64url without padding (RFC 4648, section 5).
pub(super) fn encode(bytes: &[u8]) -> String {
    let mut letters = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for part in bytes.chunks(3) {
        let bits = part.iter().fold(0, |bits, byte| bits << 8 | u32::from(*byte));
        let bits = bits << (8 * (3 - part.len()));
        for place in 0..=part.len() {
            letters.push(ALPHABET[(bits >> (18 - 6 * place) & 63) as usize].into());
        }
    }
    letters
}

/// The same back. Only what [`encode`] writes is taken: one text for each key.
pub(super) fn decode<const N: usize>(letters: &str) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    if letters.len() != (N * 4).div_ceil(3) {
        return None;
    }
    for (part, into) in letters.as_bytes().chunks(4).zip(bytes.chunks_mut(3)) {
        let mut bits = 0;
        for letter in part {
            bits = bits << 6 | ALPHABET.iter().position(|known| known == letter)? as u32;
        }
        let bits = bits << (6 * (4 - part.len()));
        into.copy_from_slice(&bits.to_be_bytes()[1..=into.len()]);
    }
    let mut again = encode(&bytes);
    let is_canonical = again == letters;
    again.zeroize();
    is_canonical.then_some(bytes)
}

pub(super) fn public_key(letters: &str) -> Result<PublicKey, TrustProblem> {
    decode::<KEY_BYTES>(letters).map(PublicKey).ok_or(TrustProblem::NotKey)
}

impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&encode(&self.0))
    }
}
