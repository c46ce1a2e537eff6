//! Reads a script: a Pratt parser.

use super::token::{ParseError, Token, tokens};
use super::{Expr, Script};
use crate::blackboard::KeyId;
use crate::value::Value;
use std::borrow::Cow;

/// Scripts are short; the bounds keep the recursion that reads and runs them shallow.
const MAX_SYMBOLS: usize = 1_000;
const MAX_DEPTH: usize = 64;

/// The tightness of an operator; 0 if it stands between no operands.
fn binding(operator: &str) -> u8 {
    match operator {
        ":=" | "=" | "+=" | "-=" | "*=" | "/=" => ASSIGNMENT,
        "?" => CHOICE,
        "||" => 6,
        "&&" => 8,
        "==" | "!=" | "<" | ">" | "<=" | ">=" => COMPARISON,
        "|" | "^" => 12,
        "&" => 14,
        "+" | "-" | ".." => 16,
        "*" | "/" => 18,
        _ => 0,
    }
}
const ASSIGNMENT: u8 = 2;
const CHOICE: u8 = 4;
const COMPARISON: u8 = 10;
const PREFIX: u8 = 20;

/// Reads a script. `key` resolves the names of entries.
///
/// # Errors
///
/// The text is no script, or an empty one.
pub(crate) fn parse(text: &str, key: &mut dyn FnMut(&str) -> KeyId) -> Result<Script, ParseError> {
    let tokens = tokens(text)?;
    if tokens.len() > MAX_SYMBOLS {
        let what = format!("a script has at most {MAX_SYMBOLS} symbols").into();
        return Err(ParseError { at: tokens[MAX_SYMBOLS].1, what });
    }
    let mut parser = Parser { tokens, next: 0, depth: 0, key };
    let mut statements = Vec::new();
    while parser.peek() != Token::End {
        statements.push(parser.expression(0)?);
        while parser.take_if(";") {}
    }
    if statements.is_empty() {
        return Err(ParseError { at: 0, what: "an empty script".into() });
    }
    Ok(Script { statements })
}

struct Parser<'a> {
    tokens: Vec<(Token<'a>, usize)>,
    next: usize,
    depth: usize,
    key: &'a mut dyn FnMut(&str) -> KeyId,
}

impl<'a> Parser<'a> {
    fn peek(&self) -> Token<'a> {
        self.tokens[self.next].0
    }

    fn take(&mut self) -> Token<'a> {
        let token = self.peek();
        // The end is never passed.
        self.next = (self.next + 1).min(self.tokens.len() - 1);
        token
    }

    fn take_if(&mut self, operator: &str) -> bool {
        let found = matches!(self.peek(), Token::Op(found) if found == operator);
        if found {
            self.take();
        }
        found
    }

    fn error<T>(&self, what: impl Into<Cow<'static, str>>) -> Result<T, ParseError> {
        Err(ParseError { at: self.tokens[self.next].1, what: what.into() })
    }

    fn expect(&mut self, operator: &'static str) -> Result<(), ParseError> {
        if self.take_if(operator) { Ok(()) } else { self.error(format!("expected `{operator}`")) }
    }

    /// An expression of operators that bind at least this tight.
    fn expression(&mut self, least: u8) -> Result<Expr, ParseError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return self.error(format!("nested deeper than {MAX_DEPTH}"));
        }
        let mut left = self.operand()?;
        while let Token::Op(operator) = self.peek() {
            let tightness = binding(operator);
            if tightness == 0 || tightness < least {
                break;
            }
            let at = self.next;
            self.take();
            match tightness {
                ASSIGNMENT => {
                    let Expr::Key(key) = left else {
                        self.next = at;
                        return self.error("only the name of an entry can be assigned to");
                    };
                    left = Expr::Assignment(key, operator, Box::new(self.expression(0)?));
                    break;
                }
                CHOICE => {
                    let then = self.expression(0)?;
                    self.expect(":")?;
                    left = Expr::Choice(Box::new([left, then, self.expression(CHOICE)?]));
                    break;
                }
                COMPARISON => {
                    let mut chain = vec![(operator, self.expression(COMPARISON + 1)?)];
                    while let Token::Op(next) = self.peek()
                        && binding(next) == COMPARISON
                    {
                        self.take();
                        chain.push((next, self.expression(COMPARISON + 1)?));
                    }
                    left = Expr::Comparison(Box::new(left), chain);
                }
                _ => {
                    let right = self.expression(tightness + 1)?;
                    left = Expr::Binary(Box::new(left), operator, Box::new(right));
                }
            }
        }
        self.depth -= 1;
        Ok(left)
    }

    fn operand(&mut self) -> Result<Expr, ParseError> {
        let at = self.next;
        let operand = match self.take() {
            Token::Int(int) => Expr::Literal(Value::Int(int)),
            Token::Real(real) => Expr::Literal(Value::Real(real)),
            Token::Text(text) => Expr::Literal(Value::text(text)),
            Token::Name(name) => Expr::Key((self.key)(name)),
            Token::Op(operator @ ("-" | "~" | "!")) => {
                Expr::Unary(operator, Box::new(self.expression(PREFIX)?))
            }
            Token::Op("(") => {
                let inner = self.expression(0)?;
                self.expect(")")?;
                inner
            }
            _ => {
                self.next = at;
                return self.error("expected a value");
            }
        };
        Ok(operand)
    }
}
