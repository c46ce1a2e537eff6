//! Names of nodes and objects, parsed once.

use serde::{Deserialize, Serialize};
use std::borrow::Borrow;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// The longest name of a node, in bytes: it travels in every hello.
const NODE_LIMIT: usize = 32;
/// The longest name of an object, in bytes: it travels in every binding.
const OBJECT_LIMIT: usize = 128;

/// Why a text is no name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// There is no text, or nothing between two slashes.
    #[error("a name, or a part of it between slashes, is empty in {text:?}")]
    Empty {
        /// What was to be parsed.
        text: String,
    },
    /// A character that may not stand in a name. Use ASCII letters, digits, `_`, `-` and `.`.
    #[error("{text:?} holds {found:?} at byte {at}: names take letters, digits, '_', '-' and '.'")]
    Character {
        /// What was to be parsed.
        text: String,
        /// The character that no name holds.
        found: char,
        /// Its place, in bytes.
        at: usize,
    },
    /// The text is longer than names may be.
    #[error("{text:?} has {length} bytes; a name of this kind has at most {limit}")]
    TooLong {
        /// The beginning of what was to be parsed.
        text: String,
        /// Its length in bytes.
        length: usize,
        /// The longest that is taken, in bytes.
        limit: usize,
    },
    /// A part that means something else where names become paths of files and words of command
    /// lines. Begin it with a letter, a digit or `_`.
    #[error(
        "{text:?} has the part {part:?} at byte {at}, {why}: begin it with a letter, a digit or '_'"
    )]
    Part {
        /// What was to be parsed.
        text: String,
        /// The part that begins wrongly.
        part: String,
        /// Its place, in bytes.
        at: usize,
        /// For what it would be taken.
        why: &'static str,
    },
}

/// For what a part of a name would be taken where names become paths of files (`.` and `..` are
/// folders) or words of command lines (`-x` is an option).
fn mistaken(part: &str) -> Option<&'static str> {
    match part {
        "." | ".." => Some("which is a folder wherever names become paths"),
        part if part.starts_with('-') => Some("which programs take for an option"),
        _ => None,
    }
}

fn check(text: &str, limit: usize, slashes: bool) -> Result<(), NameError> {
    if text.len() > limit {
        let beginning: String = text.chars().take(24).chain(['…']).collect();
        return Err(NameError::TooLong { text: beginning, length: text.len(), limit });
    }
    if text.is_empty() || (slashes && text.split('/').any(str::is_empty)) {
        return Err(NameError::Empty { text: text.into() });
    }
    let wrong = |c: char| !(c.is_ascii_alphanumeric() || "_-.".contains(c) || slashes && c == '/');
    if let Some((at, found)) = text.char_indices().find(|&(_, c)| wrong(c)) {
        return Err(NameError::Character { text: text.into(), found, at });
    }
    let mut at = 0;
    for part in text.split('/') {
        if let Some(why) = mistaken(part) {
            return Err(NameError::Part { text: text.into(), part: part.into(), at, why });
        }
        at += part.len() + 1;
    }
    Ok(())
}

macro_rules! name {
    ($(#[$doc:meta])* $name:ident, $limit:expr, $slashes:expr) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(Arc<str>);

        impl $name {
            /// Parses a name.
            ///
            /// # Errors
            /// [`NameError`] says which character, or what else, is wrong.
            pub fn new(text: &str) -> Result<Self, NameError> {
                check(text, $limit, $slashes)?;
                Ok($name(text.into()))
            }

            /// The name as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = NameError;
            fn from_str(text: &str) -> Result<Self, NameError> {
                $name::new(text)
            }
        }

        impl TryFrom<String> for $name {
            type Error = NameError;
            fn try_from(text: String) -> Result<Self, NameError> {
                $name::new(&text)
            }
        }

        impl From<$name> for String {
            fn from(name: $name) -> String {
                name.0.as_ref().into()
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }
    };
}

name! {
    /// The name of a node: one process of the robot. At most 32 bytes, neither `.` nor `..`, and
    /// without a `-` at its beginning.
    ///
    /// ```
    /// use blastema_core::NodeName;
    /// assert!(NodeName::new("module1").is_ok());
    /// assert!(NodeName::new("module 1").is_err());
    /// ```
    NodeName, NODE_LIMIT, false
}

name! {
    /// The name of an object within its node, such as `arm/left/elbow`. At most 128 bytes; no part
    /// is `.` or `..`, or begins with `-`.
    ///
    /// ```
    /// use blastema_core::ObjectName;
    /// assert!(ObjectName::new("arm/left/elbow").is_ok());
    /// assert!(ObjectName::new("arm//elbow").is_err());
    /// ```
    ObjectName, OBJECT_LIMIT, true
}

/// Where an object is, whatever the network: `module1:arm/left/elbow`.
///
/// ```
/// use blastema_core::ObjectAddress;
/// let elbow: ObjectAddress = "module1:arm/left/elbow".parse()?;
/// assert_eq!(elbow.node.as_str(), "module1");
/// # Ok::<(), blastema_core::NameError>(())
/// ```
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ObjectAddress {
    /// The node that the object lives in.
    pub node: NodeName,
    /// The object's name there.
    pub object: ObjectName,
}

impl ObjectAddress {
    /// The address of `object` in `node`.
    pub fn new(node: NodeName, object: ObjectName) -> Self {
        ObjectAddress { node, object }
    }
}

impl FromStr for ObjectAddress {
    type Err = NameError;
    fn from_str(text: &str) -> Result<Self, NameError> {
        let (node, object) =
            text.split_once(':').ok_or_else(|| NameError::Empty { text: text.into() })?;
        Ok(ObjectAddress { node: NodeName::new(node)?, object: ObjectName::new(object)? })
    }
}

impl fmt::Display for ObjectAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.node, self.object)
    }
}

impl fmt::Debug for ObjectAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_does_not_parse_says_where() {
        let wrong = ObjectName::new("arm/le ft").unwrap_err();
        assert_eq!(wrong, NameError::Character { text: "arm/le ft".into(), found: ' ', at: 6 });
        assert!(matches!(ObjectName::new("arm//left"), Err(NameError::Empty { .. })));
        assert!(matches!(NodeName::new("arm/left"), Err(NameError::Character { at: 3, .. })));
        let long = NodeName::new(&"n".repeat(33)).unwrap_err().to_string();
        assert!(long.starts_with(&format!("\"{}…\" has 33 bytes", "n".repeat(24))), "{long}");
        assert!(matches!("module1".parse::<ObjectAddress>(), Err(NameError::Empty { .. })));
    }

    #[test]
    fn a_name_is_taken_neither_for_a_folder_nor_for_an_option() {
        let check = |text: &str, wrong: &str, place: usize| match ObjectName::new(text) {
            Err(NameError::Part { part, at, .. }) => {
                assert_eq!((part.as_str(), at), (wrong, place), "{text}");
            }
            other => panic!("{text}: {other:?}"),
        };
        check(".", ".", 0);
        check("..", "..", 0);
        check("arm/../leg", "..", 4);
        check("arm/./leg", ".", 4);
        check("-rf", "-rf", 0);
        check("arm/-v", "-v", 4);
        for node in [".", "..", "-h"] {
            let text = NodeName::new(node).expect_err(node).to_string();
            assert!(text.contains("begin it with a letter"), "{text}");
        }
        for good in ["...", ".arm", "a-b", "a.b", "_-", "arm/left-1", "1"] {
            assert_eq!(ObjectName::new(good).map(|name| name.to_string()), Ok(good.to_owned()));
        }
    }
}
