//! Runs a script.
//!
//! All arithmetic is done in real numbers, and both sides of `&&` and `||` are always evaluated.

use super::{Expr, Script};
use crate::blackboard::{Blackboard, KeyId};
use crate::value::{PortValue, Value};

type Evaluated = Result<Value, String>;

/// The bytes of a joined text. A script of twenty statements can double one a million times.
const MAX_TEXT: usize = 64 << 10;

impl Script {
    /// The value of the last statement.
    pub(crate) fn run(&self, board: &mut Blackboard) -> Evaluated {
        let mut last = Value::Int(0);
        for statement in &self.statements {
            last = board.eval(statement)?;
        }
        Ok(last)
    }
}

/// Whether a value holds. A text is neither true nor false.
pub(crate) fn truth(value: &Value) -> Option<bool> {
    if matches!(value, Value::Text(_)) { None } else { bool::from_value(value) }
}

/// Numbers that differ by less are equal: the precision of a `float`.
pub(crate) fn equal(a: f64, b: f64) -> bool {
    a == b || (a - b).abs() <= f64::from(f32::EPSILON)
}

impl Blackboard {
    fn eval(&mut self, expr: &Expr) -> Evaluated {
        match expr {
            Expr::Literal(value) => Ok(value.clone()),
            Expr::Key(key) => self.read(*key),
            Expr::Unary(operator, operand) => {
                let operand = self.eval(operand)?;
                let real = number(operator, &operand)?;
                Ok(Value::Real(match *operator {
                    "-" => -real,
                    "~" => {
                        let int = Value::Real(real.trunc()).as_int();
                        !int.ok_or_else(|| not_taken(operator, &operand))? as f64
                    }
                    _ => flag(real == 0.0),
                }))
            }
            Expr::Binary(left, operator, right) => {
                let (left, right) = (self.eval(left)?, self.eval(right)?);
                binary(&left, operator, &right)
            }
            Expr::Comparison(first, chain) => {
                let mut left = self.eval(first)?;
                for (operator, right) in chain {
                    let right = self.eval(right)?;
                    if !compare(&left, operator, &right)? {
                        return Ok(Value::Real(0.0));
                    }
                    left = right;
                }
                Ok(Value::Real(1.0))
            }
            Expr::Choice(parts) => {
                let condition = self.eval(&parts[0])?;
                let holds = condition.as_real().ok_or_else(|| not_taken("?", &condition))? != 0.0;
                self.eval(&parts[if holds { 1 } else { 2 }])
            }
            Expr::Assignment(key, operator, value) => self.assign_by(*key, operator, value),
        }
    }

    fn read(&self, key: KeyId) -> Evaluated {
        let value = self.value(key).cloned();
        value.ok_or_else(|| format!("the entry `{}` has no value", self.name(key)))
    }

    fn assign_by(&mut self, key: KeyId, operator: &'static str, value: &Expr) -> Evaluated {
        if operator != ":=" && !self.exists(key) {
            let entry = self.name(key);
            return Err(format!("the entry `{entry}` does not exist; `:=` creates it"));
        }
        let mut value = self.eval(value)?;
        if operator != ":=" && operator != "=" {
            let old = self.read(key)?;
            value = binary(&old, &operator[..1], &value)?;
        } else if matches!(value, Value::Text(_))
            && self.kind(key).is_none()
            && matches!(self.value(key), Some(Value::Int(_) | Value::Real(_)))
        {
            value = Value::Real(comparable(&value)?);
        }
        self.assign(key, value.clone()).map_err(|kind| {
            let entry = self.name(key);
            format!("the entry `{entry}` keeps {kind}, to which `{value}` does not convert")
        })?;
        self.read(key)
    }
}

fn compare(a: &Value, operator: &str, b: &Value) -> Result<bool, String> {
    let (less, same, greater) = match (a, b) {
        (Value::Text(a), Value::Text(b)) => (a < b, a == b, a > b),
        _ => {
            let (a, b) = (comparable(a)?, comparable(b)?);
            (a < b, equal(a, b), a > b)
        }
    };
    Ok(match operator {
        "==" => same,
        "!=" => !same,
        "<" => less,
        ">" => greater,
        "<=" => !greater,
        _ => !less,
    })
}

/// The number that a value is compared as: `true` and `false` are numbers too.
fn comparable(value: &Value) -> Result<f64, String> {
    let number = match value {
        Value::Text(text) if **text == *"true" => Some(1.0),
        Value::Text(text) if **text == *"false" => Some(0.0),
        _ => value.as_real(),
    };
    number.ok_or_else(|| not_taken("==", value))
}

fn flag(holds: bool) -> f64 {
    f64::from(u8::from(holds))
}

/// The number that an operand is. A text is none.
fn number(operator: &'static str, value: &Value) -> Result<f64, String> {
    let number = match value {
        Value::Int(int) => Some(*int as f64),
        Value::Real(real) => Some(*real),
        _ => None,
    };
    number.ok_or_else(|| not_taken(operator, value))
}

fn not_taken(operator: &str, operand: &Value) -> String {
    format!("`{operator}` does not take `{operand}`")
}

fn binary(left: &Value, operator: &'static str, right: &Value) -> Evaluated {
    let is_text = |value: &Value| matches!(value, Value::Text(_));
    let joins = match operator {
        "+" => is_text(left) && is_text(right),
        // Of two numbers it makes nothing.
        ".." => is_text(left) || is_text(right),
        _ => false,
    };
    if joins {
        let joined = format!("{left}{right}");
        let fits = joined.len() <= MAX_TEXT;
        let too_long = || "the joined text has more than 64 KiB".to_owned();
        return fits.then(|| Value::text(joined)).ok_or_else(too_long);
    }
    let error = |operand: &Value| not_taken(operator, operand);
    let (a, b) = (number(operator, left)?, number(operator, right)?);
    let int = |value: &Value| value.as_int().ok_or_else(|| error(value));
    let bool = |value: &Value| truth(value).ok_or_else(|| error(value));
    Ok(Value::Real(match operator {
        "+" => a + b,
        "-" => a - b,
        "*" => a * b,
        "/" => a / b,
        "&" => (int(left)? & int(right)?) as f64,
        "|" => (int(left)? | int(right)?) as f64,
        "^" => (int(left)? ^ int(right)?) as f64,
        "&&" => flag(bool(left)? & bool(right)?),
        "||" => flag(bool(left)? | bool(right)?),
        _ => return Err(error(left)),
    }))
}
