//! The symbols of a script.

use super::parse::ParseError;
use std::borrow::Cow;

/// One symbol.
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
    let digits = |from: usize| {
        from + text[from..].find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len() - from)
    };
    let follows =
        |at: usize, signs: &[u8]| text.as_bytes().get(at).is_some_and(|c| signs.contains(c));
    if let Some(hex) = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        let length = hex.find(|c: char| !is_word(c) && c != '.').unwrap_or(hex.len());
        let value = i64::from_str_radix(&hex[..length], 16);
        let value = value.map_err(|_| format!("{} is no number", &text[..length + 2]))?;
        return Ok((Token::Int(value), length + 2));
    }
    let mut end = digits(0);
    let mut real = false;
    // `1..'a'` joins the number and a text.
    if follows(end, b".") && !follows(end + 1, b".") {
        real = true;
        let fraction = digits(end + 1);
        if fraction == end + 1 {
            return Err("a real number has digits on both sides of its point".into());
        }
        end = fraction;
    }
    if follows(end, b"eE") {
        real = true;
        let sign = end + 1 + usize::from(follows(end + 1, b"+-"));
        let exponent = digits(sign);
        if exponent == sign {
            return Err("an exponent without digits".into());
        }
        end = exponent;
    }
    if text[end..].starts_with(|c| is_word(c) || c == '@') {
        return Err("a number is followed by a letter".into());
    }
    let number = &text[..end];
    let token = if real {
        Token::Real(number.parse().map_err(|_| format!("{number} is no number"))?)
    } else {
        let range = |_| format!("{number} does not fit into an integer of 64 bits");
        Token::Int(number.parse().map_err(range)?)
    };
    Ok((token, end))
}
