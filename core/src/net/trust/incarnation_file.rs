//! The file that keeps which incarnation of a node was the last.
//!
//! ```text
//! blastema incarnation 1
//! node         base
//! incarnation  1795489200000
//! ```
//!
//! A node numbers its incarnations by the wall clock, and never below the number in its file: a
//! clock that was set back makes no incarnation look older than the one before it.

use super::text::{Lines, TrustError, TrustProblem};
use crate::net::wire::advertisement::INCARNATION_MAX;
use crate::{Incarnation, NodeName};

/// The longest such file, in bytes.
const FILE_BYTES: usize = 1024;
const TITLE: &str = "blastema incarnation 1";

/// The last incarnation of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IncarnationFile {
    /// The node that the file belongs to.
    pub node: NodeName,
    /// Its last incarnation.
    pub incarnation: Incarnation,
}

impl IncarnationFile {
    /// Parses the text of a node's file.
    ///
    /// # Errors
    /// The line that is wrong, and what must stand there.
    pub fn parse(text: &str, node: &NodeName) -> Result<Self, TrustError> {
        let mut lines = Lines::new(text, FILE_BYTES)?;
        lines.title(TITLE)?;
        let (line, found) = lines.value("node")?;
        if found != node.as_str() {
            return Err(TrustProblem::expected(format!("`node {node}`")).at(line));
        }
        let (line, number) = lines.value("incarnation")?;
        let number = number.parse().ok().filter(|number| *number < INCARNATION_MAX.0);
        let number = number.ok_or_else(|| TrustProblem::NotIncarnation.at(line))?;
        lines.finish()?;
        Ok(IncarnationFile { node: node.clone(), incarnation: Incarnation(number) })
    }

    /// The text of the file.
    pub fn to_text(&self) -> String {
        format!("{TITLE}\nnode         {}\nincarnation  {}\n", self.node, self.incarnation.0)
    }
}

/// The incarnation of a node that starts when the clock gives this number, after this one.
pub fn following(last: Option<Incarnation>, clock: Incarnation) -> Incarnation {
    last.map_or(clock, |last| last.next().max(clock))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn base() -> NodeName {
        NodeName::new("base").expect("a name")
    }

    #[test]
    fn a_file_reads_as_it_was_written_and_any_other_text_is_refused_with_what_to_write() {
        let file = IncarnationFile { node: base(), incarnation: Incarnation(1_795_489_200_000) };
        let text = file.to_text();
        assert_eq!(IncarnationFile::parse(&text, &base()), Ok(file));

        let refused = |text: &str, words: &str| {
            let error = IncarnationFile::parse(text, &base()).expect_err(words).to_string();
            assert!(error.contains(words), "{text:?}: {error}");
        };
        refused("", "line 1: the file does not begin with `blastema incarnation 1`");
        refused(&text.replace("base", "arm"), "line 2: this line begins otherwise");
        refused(&text[..text.len() / 2], "line 2");
        for number in ["", "-1", "many", "8796093022207", "18446744073709551616"] {
            refused(&text.replace("1795489200000", number), "line 3");
        }
        refused(&format!("{text}more\n"), "line 4: nothing follows here");
        refused(&"x".repeat(2000), "more than 1024 bytes");
    }

    #[test]
    fn an_incarnation_is_above_the_one_before_it_whatever_the_clock_says() {
        let next =
            |last: Option<u64>, clock| following(last.map(Incarnation), Incarnation(clock)).0;
        assert_eq!(next(None, 500), 500);
        assert_eq!(next(Some(400), 500), 500);
        assert_eq!(next(Some(500), 500), 501, "two starts within one millisecond");
        assert_eq!(next(Some(900), 500), 901, "the clock was set back");
    }
}
