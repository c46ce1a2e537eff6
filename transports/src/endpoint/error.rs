//! What is wrong with an endpoint string, and where.

use std::fmt;
use std::ops::Range;

/// Why a text is no endpoint. It shows the text with the wrong part underlined:
///
/// ```text
/// serial has no key `buad`: did you mean `baud`?
///   serial:///dev/ttyUSB0?buad=9600
///                         ^^^^
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EndpointError {
    text: String,
    at: Range<usize>,
    // An error that is passed on through every call is better small.
    problem: Box<EndpointProblem>,
}

/// What is wrong with the part that an [`EndpointError`] points at.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EndpointProblem {
    /// Nothing says which medium is meant.
    #[error("an endpoint begins with its medium, as in udp://0.0.0.0:7400")]
    NoMedium,
    /// No medium has this name.
    #[error("no medium is called `{found}`: {}", suggest(.nearest.as_ref(), .known))]
    UnknownMedium {
        /// What stands there.
        found: String,
        /// What may have been meant.
        nearest: Option<String>,
        /// All that there are.
        known: Vec<String>,
    },
    /// This program was built without the medium.
    #[error(
        "this program was built without `{medium}`: add the feature `{feature}` to the dependency \
         on blastema"
    )]
    NotCompiled {
        /// The medium.
        medium: &'static str,
        /// The feature of the package `blastema` that it needs.
        feature: &'static str,
    },
    /// There is no IP address where one must stand. The name of a host may stand there for a node,
    /// which looks it up when it starts; here it must be one in numbers.
    #[error(
        "`{found}` is no IP address: write it in numbers, as in 10.0.0.1:7400 or [fd00::1]:7400"
    )]
    NotIp {
        /// What stands there.
        found: String,
    },
    /// An IP address stands there without a port.
    #[error("the port is missing: write {example}")]
    NoPort {
        /// The address with a port.
        example: String,
    },
    /// An IPv6 address stands there without brackets, so that its end and the port run into each
    /// other.
    #[error("an IPv6 address stands in brackets: write {example}")]
    NoBrackets {
        /// What may have been meant.
        example: String,
    },
    /// The address is the broadcast address, so that no socket can be bound to it.
    #[error(
        "`{found}` is the address of all on a network, and no computer's own: write 0.0.0.0 or one of \
         this computer's"
    )]
    Broadcast {
        /// What stands there.
        found: String,
    },
    /// The group belongs to the protocols of the network itself, and every computer there is in it
    /// or may be (RFC 5771, RFC 4291). Those that begin with 239 are for private use (RFC 2365).
    #[error(
        "`{found}` is a group of the network's own protocols: write one for your own use, as in \
         239.255.0.1 or ff15::1"
    )]
    ReservedGroup {
        /// What stands there.
        found: String,
    },
    /// What stands where a port must is none.
    #[error("`{found}` is no port: ports are 0 (any) to 65535")]
    NotPort {
        /// What stands there.
        found: String,
    },
    /// The path is relative, or there is none: who starts the program, and where, must not matter.
    #[error("a path begins with a slash, as in {example}")]
    NoPath {
        /// A right one.
        example: &'static str,
    },
    /// The path spells what no path of a file is.
    #[error("{why}")]
    BadPath {
        /// What it is, and what to write.
        why: &'static str,
    },
    /// The path of a Unix-domain socket is longer than the system takes.
    #[error(
        "the path has {length} bytes, and a socket's has at most {limit}: choose a shorter one"
    )]
    LongPath {
        /// How long it is.
        length: usize,
        /// The longest that is taken.
        limit: usize,
    },
    /// A `%` is not followed by two hexadecimal digits.
    #[error("after % there are two hexadecimal digits, as in %20 for a space")]
    BadEscape,
    /// There is nothing where a name must stand.
    #[error("the name of {what} is missing, as in {example}")]
    NoName {
        /// Of what.
        what: &'static str,
        /// A right one.
        example: &'static str,
    },
    /// The medium has no such setting.
    #[error("{medium} has no key `{key}`: {}", suggest(.nearest.as_ref(), .known))]
    UnknownKey {
        /// The medium.
        medium: &'static str,
        /// What stands there.
        key: String,
        /// What may have been meant.
        nearest: Option<String>,
        /// All that there are.
        known: Vec<String>,
    },
    /// A setting stands there twice: which one holds?
    #[error("`{key}` is said twice: leave one of them out")]
    Twice {
        /// The key.
        key: String,
    },
    /// A key stands there without `=` and a value.
    #[error("`{key}` has no value: write {key}=…")]
    NoValue {
        /// The key.
        key: String,
    },
    /// A value is not among those that the setting takes.
    #[error("`{key}` cannot be `{found}`: it takes {expected}")]
    BadValue {
        /// The key.
        key: String,
        /// What stands there.
        found: String,
        /// What may stand there.
        expected: String,
    },
    /// Two settings exclude each other, or one needs another.
    #[error("{why}")]
    Contradiction {
        /// What goes with what.
        why: &'static str,
    },
    /// The address of a peer is none on this medium.
    #[error("`{found}` is no peer on {medium}: {expected}")]
    NotPeer {
        /// The medium.
        medium: &'static str,
        /// What stands there.
        found: String,
        /// What may stand there.
        expected: &'static str,
    },
}

fn suggest(nearest: Option<&String>, known: &[String]) -> String {
    match nearest {
        Some(nearest) => format!("did you mean `{nearest}`?"),
        None if known.len() == 1 => format!("there is {} alone", known[0]),
        None => format!("there are {}", known.join(", ")),
    }
}

impl EndpointError {
    pub(super) fn new(text: &str, at: Range<usize>, problem: EndpointProblem) -> Self {
        EndpointError { text: text.to_owned(), at, problem: Box::new(problem) }
    }

    /// The error as one of a text in which each place stands elsewhere.
    pub(super) fn shown_in(self, text: &str, place: impl Fn(usize) -> usize) -> Self {
        let at = place(self.at.start)..place(self.at.end);
        EndpointError { text: text.to_owned(), at, ..self }
    }

    /// What is wrong.
    pub fn problem(&self) -> &EndpointProblem {
        &self.problem
    }

    /// The wrong part, as it stands in the text; empty where something is missing.
    pub fn part(&self) -> &str {
        &self.text[self.at.clone()]
    }

    /// Where the wrong part stands in the text, in bytes.
    pub fn at(&self) -> Range<usize> {
        self.at.clone()
    }
}

impl fmt::Display for EndpointError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // One line stays one line, whatever stands in the text, and every letter one column.
        let shown = |text: &str| text.replace(char::is_control, "\u{FFFD}");
        let before = self.text[..self.at.start].chars().count();
        let width = self.part().chars().count().max(1);
        writeln!(f, "{}", shown(&self.problem.to_string()))?;
        writeln!(f, "  {}", shown(&self.text))?;
        write!(f, "  {:before$}{}", "", "^".repeat(width))
    }
}

impl std::error::Error for EndpointError {}
