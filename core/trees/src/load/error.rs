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
        let texts: Vec<String> = self.errors.iter().map(TreeError::to_string).collect();
        f.write_str(&texts.join("\n"))
    }
}

/// One error of a file, and its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{file}:{line}:{column}: {problem}{}\n{}", hint(.suggestion), marked(.line, .column, .excerpt))]
#[non_exhaustive]
pub struct TreeError {
    /// The name of the file.
    pub file: String,
    /// The line, from 1.
    pub line: usize,
    /// The column in characters, from 1.
    pub column: usize,
    /// The line's text, of a long line what is near the column.
    pub excerpt: String,
    /// What is wrong.
    pub problem: String,
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
