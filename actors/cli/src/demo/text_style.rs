//! Lines with colours, cut to a width before they are coloured.

use std::fmt::Write;

/// What a piece of text means; its colour follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TextStyle {
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
pub(crate) struct StyledLine(Vec<(TextStyle, String)>);

impl StyledLine {
    /// Of one piece.
    pub(crate) fn of(style: TextStyle, text: impl Into<String>) -> StyledLine {
        StyledLine(vec![(style, text.into())])
    }

    /// Adds a piece.
    #[must_use]
    pub(crate) fn and(mut self, style: TextStyle, text: impl Into<String>) -> StyledLine {
        self.0.push((style, text.into()));
        self
    }

    /// Adds all pieces of another.
    pub(crate) fn append(&mut self, other: StyledLine) {
        self.0.extend(other.0);
    }

    /// How many columns it takes: every character that is used here takes one.
    pub(crate) fn width(&self) -> usize {
        self.0.iter().map(|(_, text)| text.chars().count()).sum()
    }

    /// Exactly so wide: cut, or filled up with spaces.
    #[must_use]
    pub(crate) fn exactly(self, width: usize) -> StyledLine {
        let mut line = self.at_most(width);
        let missing = width - line.width();
        line.0.push((TextStyle::Plain, " ".repeat(missing)));
        line
    }

    /// Cut to the width.
    #[must_use]
    pub(crate) fn at_most(self, width: usize) -> StyledLine {
        let mut left = width;
        let cut = |(style, text): (TextStyle, String)| {
            let part: String = text.chars().filter(|c| !c.is_control()).take(left).collect();
            left -= part.chars().count();
            (style, part)
        };
        StyledLine(self.0.into_iter().map(cut).collect())
    }

    /// The text, with or without colours, without spaces at its end.
    pub(crate) fn paint(&self, palette: Palette) -> String {
        let mut text = String::new();
        for (style, piece) in self.0.iter().filter(|(_, piece)| !piece.is_empty()) {
            match (palette, style.code()) {
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

impl TextStyle {
    fn code(self) -> Option<&'static str> {
        match self {
            TextStyle::Plain => None,
            TextStyle::Good => Some("32"),
            TextStyle::Warning => Some("33"),
            TextStyle::Bad => Some("1;31"),
            TextStyle::Faint => Some("2"),
            TextStyle::Strong => Some("1"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_cut_by_characters_and_never_within_a_colour() {
        let line = StyledLine::of(TextStyle::Good, "●●●").and(TextStyle::Bad, "✗✗");

        assert_eq!(line.width(), 5);
        assert_eq!(line.clone().at_most(4).paint(Palette::Plain), "●●●✗");
        assert_eq!(line.clone().at_most(2).paint(Palette::Colours), "\x1b[32m●●\x1b[0m");
        assert_eq!(line.exactly(7).width(), 7);
    }

    #[test]
    fn what_a_module_says_cannot_move_the_cursor() {
        let line = StyledLine::of(TextStyle::Plain, "a\x1b[2Jb\nc").at_most(80);

        assert_eq!(line.paint(Palette::Plain), "a[2Jbc");
    }
}
