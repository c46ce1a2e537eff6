//! The errors of files, and their text.

use std::fmt;

/// All errors of a tree's files.
#[derive(Debug, thiserror::Error)]
pub struct TreeErrors {
    pub(super) errors: Vec<TreeError>,
}

impl TreeErrors {
    /// Each of them, in the order of the files.
    pub fn iter(&self) -> std::slice::Iter<'_, TreeError> {
        self.errors.iter()
    }
}

impl fmt::Display for TreeErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, error) in self.errors.iter().enumerate() {
            let end = if index == 0 { "" } else { "\n" };
            write!(f, "{end}{error}")?;
        }
        Ok(())
    }
}

/// One error of a file, and its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{file}:{line}:{column}: {problem}{}\n{}", hint(.suggestion), marked(.line, .column, .excerpt))]
#[non_exhaustive]
pub struct TreeError {
    /// The file.
    pub file: String,
    /// The line, from 1.
    pub line: usize,
    /// The column in characters, from 1.
    pub column: usize,
    /// The line's text, of a long line what is near the column.
    pub excerpt: String,
    /// The error.
    pub problem: Problem,
    /// The nearest right spelling.
    pub suggestion: Option<String>,
}

fn hint(suggestion: &Option<String>) -> String {
    suggestion.as_ref().map(|right| format!("; did you mean `{right}`?")).unwrap_or_default()
}

/// The number of characters before the excerpt of a line.
pub(super) fn skipped(column: usize) -> usize {
    column.saturating_sub(41)
}

/// The excerpt with a mark below the column.
fn marked(line: &usize, column: &usize, excerpt: &str) -> String {
    let number = line.to_string();
    let blanks = " ".repeat(number.len());
    let mark = " ".repeat(column - 1 - skipped(*column));
    format!("  {number} | {excerpt}\n  {blanks} | {mark}^")
}

/// An error of a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Problem {
    /// The file is no XML.
    #[error("no XML: {0}")]
    Xml(String),
    /// An element that has no meaning at this place.
    #[error("<{0}> has no meaning here")]
    Element(String),
    /// An element without an attribute that it needs.
    #[error("<{element}> needs the attribute `{attribute}`")]
    Attribute {
        /// The element.
        element: String,
        /// The attribute.
        attribute: &'static str,
    },
    /// A name that is empty, reserved, or has characters that names may not have.
    #[error("`{0}` cannot be the name of a tree")]
    Name(String),
    /// A tree that is called like a type of node or another tree, or a subtree with the path of
    /// another one.
    #[error("the name `{0}` is taken")]
    Taken(String),
    /// An included file that cannot be read.
    #[error("cannot include `{path}`: {reason}")]
    Include {
        /// The file.
        path: String,
        /// The reason.
        reason: String,
    },
    /// Files that include each other, or trees that contain each other.
    #[error("a circle: {}", .0.join(" -> "))]
    Circle(Vec<String>),
    /// No type of node has this name.
    #[error("no type of node is called `{0}`")]
    UnknownNode(String),
    /// No tree has this name.
    #[error("no tree is called `{0}`")]
    UnknownTree(String),
    /// The type of node has no such port.
    #[error("`{node}` has no port `{port}`")]
    UnknownPort {
        /// The node's type.
        node: String,
        /// The port.
        port: String,
    },
    /// A port that must be given is not.
    #[error("`{node}` needs the port `{port}`")]
    MissingPort {
        /// The node's type, or the subtree.
        node: String,
        /// The port.
        port: String,
    },
    /// An attribute that is ignored, and almost the name of a condition.
    #[error("`{0}` is no condition of a node")]
    UnknownCondition(String),
    /// A value that does not convert.
    #[error("`{value}` is no {kind}")]
    Value {
        /// The value.
        value: String,
        /// The type of the port.
        kind: &'static str,
    },
    /// A script that cannot be read.
    #[error("{0}")]
    Script(String),
    /// Too few children, or too many.
    #[error("`{node}` has {found} children instead of {expected}")]
    Children {
        /// The node's type.
        node: String,
        /// The number that it has.
        found: usize,
        /// The numbers that it may have.
        expected: String,
    },
    /// More than one child can be interrupted between its children.
    #[error("a ReactiveSequence has at most one AsyncSequence as its child")]
    AsyncChildren,
    /// A threshold that the number of children cannot reach.
    #[error("a threshold of {threshold} with {children} children")]
    Threshold {
        /// The number of children that are to succeed or to fail.
        threshold: i64,
        /// The number of children.
        children: usize,
    },
    /// Two ports of different types use one entry.
    #[error("the entry `{key}` is of type {known} already, and not {kind}")]
    EntryType {
        /// The entry's key.
        key: String,
        /// The type of the port that was met first.
        known: &'static str,
        /// The type of this port.
        kind: &'static str,
    },
    /// Nested too deep, too many nodes, or too large a file.
    #[error("more than {0}")]
    Limit(&'static str),
}
