//! Lines with colours, cut to a width before they are coloured.

use std::fmt::Write;

/// What a piece of text means; its colour follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ink {
    /// Nothing special.
    Plain,
    /// All is well.
    Good,
    /// Look at it.
    Warning,
    /// Broken.
    Bad,
    /// Of little weight, or no longer current.
    Faint,
    /// A heading.
    Strong,
}

/// Whether colours may be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Palette {
    /// Text only.
    Plain,
    /// ANSI colours.
    Colours,
}

/// One line, made of pieces.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Line(Vec<(Ink, String)>);

impl Line {
    /// Of one piece.
    pub(crate) fn of(ink: Ink, text: impl Into<String>) -> Line {
        Line(vec![(ink, text.into())])
    }

    /// Adds a piece.
    #[must_use]
    pub(crate) fn and(mut self, ink: Ink, text: impl Into<String>) -> Line {
        self.0.push((ink, text.into()));
        self
    }

    /// Adds all pieces of another.
    pub(crate) fn append(&mut self, other: Line) {
        self.0.extend(other.0);
    }

    /// How many columns it takes: every character that is used here takes one.
    pub(crate) fn width(&self) -> usize {
        self.0.iter().map(|(_, text)| text.chars().count()).sum()
    }

    /// Exactly so wide: cut, or filled up with spaces.
    #[must_use]
    pub(crate) fn exactly(self, width: usize) -> Line {
        let mut line = self.at_most(width);
        let missing = width - line.width();
        line.0.push((Ink::Plain, " ".repeat(missing)));
        line
    }

    /// Cut to the width.
    #[must_use]
    pub(crate) fn at_most(self, width: usize) -> Line {
        let mut left = width;
        let cut = |(ink, text): (Ink, String)| {
            let part: String = text.chars().filter(|c| !c.is_control()).take(left).collect();
            left -= part.chars().count();
            (ink, part)
        };
        Line(self.0.into_iter().map(cut).collect())
    }

    /// The text, with or without colours, without spaces at its end.
    pub(crate) fn paint(&self, palette: Palette) -> String {
        let mut text = String::new();
        for (ink, piece) in self.0.iter().filter(|(_, piece)| !piece.is_empty()) {
            match (palette, ink.code()) {
                (Palette::Colours, Some(code)) => {
                    // Writing into a string cannot fail.
                    let _ = write!(text, "\x1b[{code}m{piece}\x1b[0m");
                }
                _ => text.push_str(piece),
            }
        }
        text.truncate(text.trim_end().len());
        text
    }
}

impl Ink {
    fn code(self) -> Option<&'static str> {
        match self {
            Ink::Plain => None,
            Ink::Good => Some("32"),
            Ink::Warning => Some("33"),
            Ink::Bad => Some("1;31"),
            Ink::Faint => Some("2"),
            Ink::Strong => Some("1"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_cut_by_characters_and_never_within_a_colour() {
        let line = Line::of(Ink::Good, "●●●").and(Ink::Bad, "✗✗");

        assert_eq!(line.width(), 5);
        assert_eq!(line.clone().at_most(4).paint(Palette::Plain), "●●●✗");
        assert_eq!(line.clone().at_most(2).paint(Palette::Colours), "\x1b[32m●●\x1b[0m");
        assert_eq!(line.exactly(7).width(), 7);
    }

    #[test]
    fn what_a_module_says_cannot_move_the_cursor() {
        let line = Line::of(Ink::Plain, "a\x1b[2Jb\nc").at_most(80);

        assert_eq!(line.paint(Palette::Plain), "a[2Jbc");
    }
}
