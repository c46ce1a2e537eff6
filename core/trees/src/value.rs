//! Values of the blackboard and of ports, and how one type is read as another.
//!
//! As in BehaviorTree.CPP, a boolean is the integer 0 or 1, and a text is converted each time it is
//! read as something else.

use crate::status::Status;
use std::any::Any;
use std::fmt;
use std::sync::Arc;

/// A value of the blackboard.
#[derive(Clone, Debug)]
pub enum Value {
    /// An integer, or a boolean as 0 or 1.
    Int(i64),
    /// A real number.
    Real(f64),
    /// A string of characters.
    Text(Arc<str>),
    /// Several values, such as the elements of a loop.
    List(Arc<[Value]>),
    /// A type of the application.
    Object(Arc<dyn Any + Send + Sync>),
}

impl Value {
    /// Returns the value that holds this text.
    pub fn text(text: impl Into<Arc<str>>) -> Value {
        Value::Text(text.into())
    }

    /// A value of the application's own type.
    pub fn object<T: Any + Send + Sync>(value: T) -> Value {
        Value::Object(Arc::new(value))
    }

    /// The value of the application's own type, if it is one of this type.
    pub fn as_object<T: Any>(&self) -> Option<&T> {
        match self {
            Value::Object(object) => object.downcast_ref(),
            _ => None,
        }
    }

    /// The integer that the value is, without loss: `2.0` is 2, and so is `"2"`.
    pub fn as_int(&self) -> Option<i64> {
        match self {
            Value::Int(int) => Some(*int),
            // 2^63 is the first real number that does not fit.
            Value::Real(real) => {
                let fits = real.fract() == 0.0 && (-(2f64.powi(63))..2f64.powi(63)).contains(real);
                fits.then_some(*real as i64)
            }
            Value::Text(text) => unsigned_plus(text)?.parse().ok(),
            _ => None,
        }
    }

    /// The real number that the value is, without loss.
    pub fn as_real(&self) -> Option<f64> {
        match self {
            // Up to 2^53 each integer is a real number.
            Value::Int(int) => (int.unsigned_abs() <= 1 << 53).then_some(*int as f64),
            Value::Real(real) => Some(*real),
            Value::Text(text) => unsigned_plus(text)?.parse().ok(),
            _ => None,
        }
    }
}

/// The text, unless it begins with a plus sign, which the format does not have.
fn unsigned_plus(text: &str) -> Option<&str> {
    (!text.starts_with('+')).then_some(text)
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::Int(int) => write!(f, "{int}"),
            // As `std::to_string` of C++ writes it, on which scripts that join texts rely.
            Value::Real(real) => write!(f, "{real:.6}"),
            Value::Text(text) => f.write_str(text),
            Value::List(list) => {
                let texts: Vec<String> = list.iter().map(Value::to_string).collect();
                f.write_str(&texts.join(";"))
            }
            Value::Object(_) => f.write_str("(object)"),
        }
    }
}

/// The type of a port or of a blackboard's entry.
#[derive(Clone, Copy, Debug)]
pub struct PortType {
    name: &'static str,
    /// Converts a value into the form in which an entry of this type keeps it; none: any value.
    admit: Option<fn(&Value) -> Option<Value>>,
}

impl PortType {
    /// Any type; an entry of this type takes the type of the first value.
    pub const ANY: PortType = PortType { name: "BT::AnyTypeAllowed", admit: None };

    /// The type of `T`, under this name in models.
    pub const fn of<T: PortValue>(name: &'static str) -> PortType {
        PortType { name, admit: Some(admit::<T>) }
    }

    /// The name in models, which is that of C++.
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// Whether any value fits.
    pub const fn is_any(&self) -> bool {
        self.admit.is_none()
    }

    /// The value in the form that an entry of this type keeps, unless it does not convert.
    pub fn admit(&self, value: &Value) -> Option<Value> {
        self.admit.map_or_else(|| Some(value.clone()), |admit| admit(value))
    }
}

impl PartialEq for PortType {
    fn eq(&self, other: &PortType) -> bool {
        self.name == other.name
    }
}

fn admit<T: PortValue>(value: &Value) -> Option<Value> {
    T::from_value(value).map(T::into_value)
}

/// A Rust type that ports can have.
///
/// ```
/// use blastema_trees::{PortType, PortValue, Value};
///
/// #[derive(Clone, Debug, PartialEq)]
/// struct Point(f64, f64);
///
/// impl PortValue for Point {
///     const TYPE: PortType = PortType::of::<Point>("Point");
///
///     fn from_value(value: &Value) -> Option<Point> {
///         if let Value::Text(text) = value {
///             let (x, y) = text.split_once(';')?;
///             return Some(Point(x.parse().ok()?, y.parse().ok()?));
///         }
///         value.as_object().cloned()
///     }
///
///     fn into_value(self) -> Value {
///         Value::object(self)
///     }
/// }
///
/// assert_eq!(Point::from_value(&Value::text("1.5;2")), Some(Point(1.5, 2.0)));
/// ```
pub trait PortValue: Sized + 'static {
    /// The type as models name it.
    const TYPE: PortType;
    /// The name of a list of such values in models.
    const LIST: &'static str = "std::vector";

    /// Reads the value, of which a text is to be parsed; none if it does not convert.
    fn from_value(value: &Value) -> Option<Self>;

    /// The value that the blackboard keeps.
    fn into_value(self) -> Value;
}

macro_rules! integers {
    ($($type:ty, $name:literal, $list:literal;)*) => {$(
        impl PortValue for $type {
            const TYPE: PortType = PortType::of::<$type>($name);
            const LIST: &'static str = $list;

            fn from_value(value: &Value) -> Option<$type> {
                value.as_int()?.try_into().ok()
            }

            fn into_value(self) -> Value {
                Value::Int(self.into())
            }
        }
    )*};
}

integers! {
    i32, "int", "std::vector<int>";
    u32, "unsigned int", "std::vector<unsigned int>";
    i64, "int64_t", "std::vector<int64_t>";
}

impl PortValue for f64 {
    const TYPE: PortType = PortType::of::<f64>("double");
    const LIST: &'static str = "std::vector<double>";

    fn from_value(value: &Value) -> Option<f64> {
        value.as_real()
    }

    fn into_value(self) -> Value {
        Value::Real(self)
    }
}

impl PortValue for bool {
    const TYPE: PortType = PortType::of::<bool>("bool");
    const LIST: &'static str = "std::vector<bool>";

    fn from_value(value: &Value) -> Option<bool> {
        match value {
            Value::Text(text) => match &**text {
                "1" | "true" | "True" | "TRUE" => Some(true),
                "0" | "false" | "False" | "FALSE" => Some(false),
                _ => None,
            },
            Value::Int(0) => Some(false),
            Value::Int(1) => Some(true),
            Value::Real(real) => Some(*real != 0.0),
            _ => None,
        }
    }

    fn into_value(self) -> Value {
        Value::Int(self.into())
    }
}

impl PortValue for String {
    // A number is read as a text, but never written over one.
    const TYPE: PortType = PortType {
        name: "std::string",
        admit: Some(|value| matches!(value, Value::Text(_)).then(|| value.clone())),
    };
    const LIST: &'static str = "std::vector<std::string>";

    fn from_value(value: &Value) -> Option<String> {
        (!matches!(value, Value::Object(_))).then(|| value.to_string())
    }

    fn into_value(self) -> Value {
        Value::text(self)
    }
}

/// A value of any type.
impl PortValue for Value {
    const TYPE: PortType = PortType::ANY;

    fn from_value(value: &Value) -> Option<Value> {
        Some(value.clone())
    }

    fn into_value(self) -> Value {
        self
    }
}

impl PortValue for Status {
    const TYPE: PortType = PortType::of::<Status>("BT::NodeStatus");

    fn from_value(value: &Value) -> Option<Status> {
        match value {
            Value::Text(text) => Status::from_name(text),
            _ => None,
        }
    }

    fn into_value(self) -> Value {
        Value::text(self.name())
    }
}

/// A list is `1;2;3` as a text.
impl<T: PortValue> PortValue for Vec<T> {
    const TYPE: PortType = PortType::of::<Vec<T>>(T::LIST);

    fn from_value(value: &Value) -> Option<Vec<T>> {
        match value {
            Value::List(list) => list.iter().map(T::from_value).collect(),
            Value::Text(text) => {
                text.split_terminator(';').map(|part| T::from_value(&Value::text(part))).collect()
            }
            _ => None,
        }
    }

    fn into_value(self) -> Value {
        Value::List(self.into_iter().map(T::into_value).collect())
    }
}
