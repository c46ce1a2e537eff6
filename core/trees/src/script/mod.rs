//! The scripts of `Script`, `ScriptCondition`, `Precondition` and of the conditions of nodes.
//!
//! The grammar is that of BehaviorTree.CPP 4.10: statements, of which the last one is the value.
//! From loose to tight: assignment; `? :`; `||`; `&&`; comparisons, which chain; `|` and `^`; `&`;
//! `+`, `-`, `..`; `*` and `/`; `-`, `~`, `!` before an operand.

mod eval;
mod parse;
mod token;

pub(crate) use eval::{equal, truth};
pub(crate) use parse::parse;

use crate::blackboard::KeyId;
use crate::value::Value;

/// A script whose keys are resolved.
/// An empty one does nothing.
#[derive(Debug, Default)]
pub(crate) struct Script {
    statements: Vec<Expr>,
}

#[derive(Debug)]
enum Expr {
    Literal(Value),
    Key(KeyId),
    /// `-`, `~`, `!`.
    Unary(&'static str, Box<Expr>),
    Binary(Box<Expr>, &'static str, Box<Expr>),
    /// `a < b <= c`: both must hold.
    Comparison(Box<Expr>, Vec<(&'static str, Expr)>),
    Choice(Box<[Expr; 3]>),
    Assignment(KeyId, &'static str, Box<Expr>),
}
