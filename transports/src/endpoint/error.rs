//! What is wrong with an endpoint string, and where.

use blastema_core::suggestion::nearest;
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
    problem: String,
}

/// The wrong part of a text that is being read, and what is wrong with it.
#[derive(Debug)]
pub(super) struct Wrong<'a>(pub &'a str, pub String);

/// The known word that may have been meant, or all of them.
pub(super) fn suggest(wrong: &str, known: &[&str]) -> String {
    match (nearest(wrong, known.iter().copied()), known) {
        (Some(known), _) => format!("did you mean `{known}`?"),
        (None, [only]) => format!("there is {only} alone"),
        (None, _) => format!("there are {}", known.join(", ")),
    }
}

impl EndpointError {
    /// The wrong part is a piece of the text.
    pub(super) fn new(text: &str, Wrong(part, problem): Wrong<'_>) -> Self {
        let start = part.as_ptr() as usize - text.as_ptr() as usize;
        EndpointError { text: text.to_owned(), at: start..start + part.len(), problem }
    }

    /// What is wrong with the part, and what to write.
    pub fn problem(&self) -> &str {
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
        writeln!(f, "{}", shown(&self.problem))?;
        writeln!(f, "  {}", shown(&self.text))?;
        write!(f, "  {:before$}{}", "", "^".repeat(width))
    }
}

impl std::error::Error for EndpointError {}
