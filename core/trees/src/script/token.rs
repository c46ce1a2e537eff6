//! The symbols of a script.

use std::borrow::Cow;

/// The error of a text that is no script.
#[derive(Debug)]
pub(crate) struct ParseError {
    /// The byte of the text.
    pub(crate) at: usize,
    pub(crate) what: Cow<'static, str>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Token<'a> {
    Int(i64),
    Real(f64),
    Text(&'a str),
    Name(&'a str),
    Op(&'static str),
    End,
}

/// The longer ones first.
const OPERATORS: [&str; 29] = [
    "..", "&&", "||", "==", "!=", "<=", ">=", ":=", "+=", "-=", "*=", "/=", "+", "-", "*", "/",
    "&", "|", "^", "~", "!", "<", ">", "=", "?", ":", "(", ")", ";",
];

/// The symbols with their places; the last one is `End`.
pub(super) fn tokens(text: &str) -> Result<Vec<(Token<'_>, usize)>, ParseError> {
    let mut tokens = Vec::new();
    let mut at = 0;
    while let Some(first) = text[at..].chars().next() {
        let rest = &text[at..];
        let error = |what: &'static str| ParseError { at, what: what.into() };
        let (token, length) = match first {
            ' ' | '\t' | '\n' | '\r' => {
                at += 1;
                continue;
            }
            '\'' => {
                let end = rest[1..].find('\'').ok_or_else(|| error("a text without its end"))?;
                (Token::Text(&rest[1..=end]), end + 2)
            }
            '0'..='9' => number(rest).map_err(|what| ParseError { at, what })?,
            'a'..='z' | 'A'..='Z' | '_' | '@' => {
                let end = rest[1..].find(|c| !is_word(c)).map_or(rest.len(), |end| end + 1);
                let token = match &rest[..end] {
                    "true" => Token::Real(1.0),
                    "false" => Token::Real(0.0),
                    name => Token::Name(name),
                };
                (token, end)
            }
            _ => {
                let operator = OPERATORS.into_iter().find(|operator| rest.starts_with(operator));
                let operator = operator.ok_or_else(|| error("no symbol of a script"))?;
                (Token::Op(operator), operator.len())
            }
        };
        tokens.push((token, at));
        at += length;
    }
    tokens.push((Token::End, at));
    Ok(tokens)
}

fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || c == '_'
}

/// A number at the beginning of the text, and how long it is.
fn number(text: &str) -> Result<(Token<'_>, usize), Cow<'static, str>> {
    let hex = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    let bytes = text.as_bytes();
    let belongs = |at: usize| match bytes[at] {
        // `1..'a'` joins a number and a text.
        b'.' => bytes.get(at + 1) != Some(&b'.') && bytes[at - 1] != b'.',
        b'+' | b'-' => hex.is_none() && matches!(bytes[at - 1], b'e' | b'E'),
        other => other == b'@' || is_word(other.into()),
    };
    let end = (1..bytes.len()).find(|at| !belongs(*at)).unwrap_or(bytes.len());
    let word = &text[..end];
    let token = if hex.is_some() {
        i64::from_str_radix(&word[2..], 16).ok().map(Token::Int)
    } else if word.bytes().all(|byte| byte.is_ascii_digit()) {
        word.parse().ok().map(Token::Int)
    } else {
        // Digits stand on both sides of the point.
        let fraction = word.split_once('.').map_or("0", |(_, fraction)| fraction);
        let digits = fraction.starts_with(|c: char| c.is_ascii_digit());
        word.parse().ok().filter(|_| digits).map(Token::Real)
    };
    token.map(|token| (token, end)).ok_or_else(|| format!("`{word}` is no number").into())
}
