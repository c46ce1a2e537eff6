//! What differs between two structures, field by field, in words.

use crate::LayoutDescription;
use crate::contract::layout::{Field, Fields, Shape, Text, Variant};
use std::collections::{BTreeSet, VecDeque};
use std::fmt;

/// The most lines that one difference shows; a person reads no more, and the peer may be hostile.
const LINE_LIMIT: usize = 24;
/// The most pairs of types that one comparison looks at. Large real messages need some hundreds.
const PAIR_LIMIT: usize = 20_000;
/// The longest path to a field that is shown, in bytes; of a longer one the end is shown.
const PATH_LIMIT: usize = 200;
/// The longest text for one type, in letters; what is longer ends in dots.
const TYPE_TEXT_LIMIT: usize = 96;

/// What differs between two parties' forms of one contract: at least one line, each about one
/// thing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Difference {
    /// The contract's name on this side.
    pub contract: String,
    /// One line for each thing that differs; "here" is the side that compared.
    pub lines: Vec<String>,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "contract `{}`: {}", self.contract, self.lines.join("\n"))
    }
}

/// Which half of a contract a structure belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ContractPart {
    /// The message itself.
    Message,
    /// What a request is answered with.
    Reply,
}

/// Compares two structures and says what differs, one line for each thing; none when they are the
/// same.
pub fn compare(
    half: ContractPart,
    here: &LayoutDescription,
    there: &LayoutDescription,
) -> Vec<String> {
    let (open, seen, lines) = (VecDeque::new(), BTreeSet::new(), Vec::new());
    let (here, there) = (here.types(), there.types());
    let mut comparison = Comparison { half, here, there, open, seen, lines };
    comparison.open(Pair { here: 0, there: 0, path: String::new(), whole: (0, 0) });
    while comparison.lines.len() <= LINE_LIMIT
        && let Some(pair) = comparison.open.pop_front()
    {
        comparison.compare(&pair);
    }
    let Comparison { mut lines, seen, .. } = comparison;
    let is_cut_short = lines.len() > LINE_LIMIT || seen.len() == PAIR_LIMIT;
    if is_cut_short && !lines.is_empty() {
        lines.truncate(LINE_LIMIT);
        lines.push("and more".into());
    }
    lines
}

/// Two types that stand in the same place of the two structures.
struct Pair {
    here: u32,
    there: u32,
    /// The path to the field that they belong to; empty for the whole message.
    path: String,
    /// The whole types of that field, to show them when a part differs.
    whole: (u32, u32),
}

struct Comparison<'a> {
    half: ContractPart,
    here: &'a [Shape<u32>],
    there: &'a [Shape<u32>],
    open: VecDeque<Pair>,
    /// What is or was open: types with a name once, others once for each path.
    seen: BTreeSet<(String, u32, u32)>,
    lines: Vec<String>,
}

impl Comparison<'_> {
    fn open(&mut self, pair: Pair) {
        let is_named = matches!(self.here[pair.here as usize], Shape::Struct(..) | Shape::Enum(..));
        let path = if is_named { String::new() } else { pair.path.clone() };
        if self.seen.len() < PAIR_LIMIT && self.seen.insert((path, pair.here, pair.there)) {
            self.open.push_back(pair);
        }
    }

    fn compare(&mut self, pair: &Pair) {
        let (here, there) = (self.here, self.there);
        let (here, there) = (&here[pair.here as usize], &there[pair.there as usize]);
        let path = &pair.path;
        match (here, there) {
            (Shape::Struct(m, a), Shape::Struct(n, b)) if m == n => self.compare_fields(path, a, b),
            (Shape::Enum(m, a), Shape::Enum(n, b)) if m == n => {
                let names = |all: &[Variant<u32>]| all.iter().map(|v| v.name.clone()).collect();
                self.compare_names("variant", "::", path, names(a), names(b));
                for a in a.iter() {
                    if let Some(b) = b.iter().find(|b| b.name == a.name) {
                        self.compare_fields(&join(path, "::", &a.name), &a.fields, &b.fields);
                    }
                }
            }
            // The same but for the types inside.
            _ if here.map(|_| ()) == there.map(|_| ()) => {
                for (here, there) in here.parts().into_iter().zip(there.parts()) {
                    self.open(Pair { here, there, path: path.clone(), whole: pair.whole });
                }
            }
            _ => {
                let texts =
                    |of: (u32, u32)| (type_text(self.here, of.0), type_text(self.there, of.1));
                let (mut here, mut there) = texts(pair.whole);
                if here == there {
                    // The difference is deeper in than the shortened texts go.
                    (here, there) = texts((pair.here, pair.there));
                }
                self.tell(format!("{}: {here} here, {there} there", self.name(path)));
            }
        }
    }

    fn compare_fields(&mut self, path: &str, here: &Fields<u32>, there: &Fields<u32>) {
        if std::mem::discriminant(here) != std::mem::discriminant(there) {
            let line = format!("{}: {} here, {} there", self.name(path), kind(here), kind(there));
            return self.tell(line);
        }
        let (here, there) = (here.as_slice(), there.as_slice());
        let names = |all: &[Field<u32>]| all.iter().map(|field| field.name.clone()).collect();
        self.compare_names("field", ".", path, names(here), names(there));
        for a in here {
            let Some(b) = there.iter().find(|b| b.name == a.name) else { continue };
            let path = join(path, ".", &a.name);
            for (what, here, there) in [("unit", &a.unit, &b.unit), ("frame", &a.frame, &b.frame)] {
                if here != there {
                    let [here, there] = [here, there].map(|text| {
                        text.as_ref().map_or("none".to_owned(), |text| format!("`{text}`"))
                    });
                    let name = self.name(&path);
                    self.tell(format!("{name}: {what} {here} here, {there} there"));
                }
            }
            self.open(Pair { here: a.of, there: b.of, path, whole: (a.of, b.of) });
        }
    }

    /// Tells which names stand on one side only, and whether the others stand in another order.
    fn compare_names(
        &mut self,
        kind: &str,
        separator: &str,
        path: &str,
        here: Vec<Text>,
        there: Vec<Text>,
    ) {
        let of_reply = self.of_reply();
        for (own, other, side) in [(&here, &there, "here"), (&there, &here, "there")] {
            for name in own.iter().filter(|name| !other.contains(name)) {
                let name = join(path, separator, name);
                self.tell(format!("{kind} `{name}`{of_reply}: only {side}"));
            }
        }
        let both = |own: &[Text], other: &[Text]| -> Vec<Text> {
            own.iter().filter(|name| other.contains(name)).cloned().collect()
        };
        let (here, there) = (both(&here, &there), both(&there, &here));
        if here != there {
            let owner = match path {
                "" => self.name(path),
                path => format!("`{path}`{of_reply}"),
            };
            let (here, there) = (here.join(", "), there.join(", "));
            self.tell(format!(
                "the {kind}s of {owner} stand in another order: {here} here; {there} there"
            ));
        }
    }

    fn tell(&mut self, line: String) {
        if self.lines.len() <= LINE_LIMIT && self.lines.last() != Some(&line) {
            self.lines.push(line);
        }
    }

    fn name(&self, path: &str) -> String {
        match self.half {
            _ if !path.is_empty() => format!("field `{path}`{}", self.of_reply()),
            ContractPart::Message => "the message".into(),
            ContractPart::Reply => "the reply".into(),
        }
    }

    fn of_reply(&self) -> &'static str {
        match self.half {
            ContractPart::Message => "",
            ContractPart::Reply => " of the reply",
        }
    }
}

fn join(path: &str, separator: &str, name: &str) -> String {
    if path.is_empty() {
        return name.into();
    }
    let surplus = path.len().saturating_sub(PATH_LIMIT);
    match path.char_indices().find(|&(at, _)| at >= surplus) {
        Some((at, _)) if at > 0 => format!("…{}{separator}{name}", &path[at..]),
        _ => format!("{path}{separator}{name}"),
    }
}

fn kind(fields: &Fields<u32>) -> &'static str {
    match fields {
        Fields::Unit => "no fields",
        Fields::Tuple(_) => "fields without names",
        Fields::Named(_) => "fields with names",
    }
}

/// A type in words, cut short where it is long.
pub(super) fn type_text(types: &[Shape<u32>], index: u32) -> String {
    let mut text = String::new();
    write_type(types, index, &mut text);
    if text.chars().count() > TYPE_TEXT_LIMIT {
        text = text.chars().take(TYPE_TEXT_LIMIT).chain(['…']).collect();
    }
    text
}

// Each level of nesting writes something and none begins once the text is full, so that neither
// depth nor breadth of a hostile description costs more than the text's length.
fn write_type(types: &[Shape<u32>], index: u32, text: &mut String) {
    if text.len() > TYPE_TEXT_LIMIT {
        return;
    }
    let prefixed = |prefix: &str, of: u32, text: &mut String| {
        text.push_str(prefix);
        write_type(types, of, text);
    };
    match &types[index as usize] {
        Shape::Leaf(leaf) => text.push_str(leaf.name()),
        Shape::Optional(of) => prefixed("optional ", *of, text),
        Shape::Sequence(of) => prefixed("sequence of ", *of, text),
        Shape::Set(of) => prefixed("set of ", *of, text),
        Shape::Array(of, length) => prefixed(&format!("array of {length} "), *of, text),
        Shape::Map(key, value) => {
            prefixed("map from ", *key, text);
            prefixed(" to ", *value, text);
        }
        Shape::AtMost(of, bound) => prefixed(&format!("at most {bound} in a "), *of, text),
        Shape::Tuple(parts) => {
            let mut separator = "(";
            for &part in parts.iter() {
                if text.len() > TYPE_TEXT_LIMIT {
                    return;
                }
                prefixed(separator, part, text);
                separator = ", ";
            }
            text.push(')');
        }
        Shape::Struct(name, _) => text.push_str(if name.is_empty() { "structure" } else { name }),
        Shape::Enum(name, _) if name.is_empty() => text.push_str("enumeration"),
        Shape::Enum(name, _) => text.push_str(&format!("enumeration {name}")),
    }
}
