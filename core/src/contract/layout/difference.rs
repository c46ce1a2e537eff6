//! What differs between two structures, field by field, in words.

use crate::LayoutDescription;
use crate::contract::layout::{Field, Fields, Shape, Text, Variant};
use crate::sorted::SortedSet;
use std::collections::VecDeque;
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
    let mut comparison = Comparison {
        half,
        here: here.types(),
        there: there.types(),
        open: VecDeque::from([Pair {
            here: 0,
            there: 0,
            path: String::new(),
            field: 0,
            whole: (0, 0),
        }]),
        seen: SortedSet::new(),
        pairs: 0,
        lines: Vec::new(),
    };
    comparison.run();
    comparison.lines
}

/// Two types that stand in the same place of the two structures.
struct Pair {
    here: u32,
    there: u32,
    /// The path to the field that they belong to; empty for the whole message.
    path: String,
    /// The number of that field in the order of comparison.
    field: usize,
    /// The whole types of that field, to show them when a part differs.
    whole: (u32, u32),
}

struct Comparison<'a> {
    half: ContractPart,
    here: &'a [Shape<u32>],
    there: &'a [Shape<u32>],
    open: VecDeque<Pair>,
    /// What was compared: types with a name once, others once for each field.
    seen: SortedSet<(usize, u32, u32)>,
    pairs: usize,
    lines: Vec<String>,
}

impl Comparison<'_> {
    fn run(&mut self) {
        while self.lines.len() <= LINE_LIMIT
            && let Some(pair) = self.open.pop_front()
        {
            self.compare(pair);
        }
        let cut_short = self.lines.len() > LINE_LIMIT || self.pairs > PAIR_LIMIT;
        if cut_short && !self.lines.is_empty() {
            self.lines.truncate(LINE_LIMIT);
            self.lines.push("and more".into());
        }
    }

    fn compare(&mut self, pair: Pair) {
        let (here, there) = (self.here, self.there);
        let (here, there) = (&here[pair.here as usize], &there[pair.there as usize]);
        let named = matches!(here, Shape::Struct(..) | Shape::Enum(..));
        let field = if named { 0 } else { pair.field };
        if !self.seen.insert((field, pair.here, pair.there)) {
            return;
        }
        match (here, there) {
            (Shape::Leaf(a), Shape::Leaf(b)) if a == b => {}
            (Shape::Optional(a), Shape::Optional(b))
            | (Shape::Sequence(a), Shape::Sequence(b))
            | (Shape::Set(a), Shape::Set(b)) => self.go_on(&pair, *a, *b),
            (Shape::Array(a, m), Shape::Array(b, n)) if m == n => self.go_on(&pair, *a, *b),
            (Shape::AtMost(a, m), Shape::AtMost(b, n)) if m == n => self.go_on(&pair, *a, *b),
            (Shape::Map(a, c), Shape::Map(b, d)) => {
                self.go_on(&pair, *a, *b);
                self.go_on(&pair, *c, *d);
            }
            (Shape::Tuple(a), Shape::Tuple(b)) if a.len() == b.len() => {
                for (a, b) in a.iter().zip(b.iter()) {
                    self.go_on(&pair, *a, *b);
                }
            }
            (Shape::Struct(m, a), Shape::Struct(n, b)) if m == n => {
                self.compare_fields(&self.name(&pair.path), &pair.path, a, b);
            }
            (Shape::Enum(m, a), Shape::Enum(n, b)) if m == n => {
                self.compare_variants(&pair.path, a, b);
            }
            _ => self.tell_types(&pair),
        }
    }

    /// Compares a part of a type that has no name of its own.
    fn go_on(&mut self, pair: &Pair, here: u32, there: u32) {
        let Pair { ref path, field, whole, .. } = *pair;
        self.open(Pair { here, there, path: path.clone(), field, whole });
    }

    fn open(&mut self, pair: Pair) {
        self.pairs += 1;
        if self.pairs <= PAIR_LIMIT {
            self.open.push_back(pair);
        }
    }

    fn compare_fields(&mut self, owner: &str, path: &str, here: &Fields<u32>, there: &Fields<u32>) {
        if std::mem::discriminant(here) != std::mem::discriminant(there) {
            return self.tell(format!("{owner}: {} here, {} there", kind(here), kind(there)));
        }
        let (here, there) = (here.as_slice(), there.as_slice());
        self.compare_names("field", path, &names(here, field_name), &names(there, field_name));
        for a in here {
            let Some(b) = there.iter().find(|b| b.name == a.name) else { continue };
            let path = join(path, ".", &a.name);
            self.compare_declared(&path, "unit", a.unit.as_ref(), b.unit.as_ref());
            self.compare_declared(&path, "frame", a.frame.as_ref(), b.frame.as_ref());
            let (here, there, field) = (a.of, b.of, self.pairs + 1);
            self.open(Pair { here, there, path, field, whole: (here, there) });
        }
    }

    fn compare_variants(&mut self, path: &str, here: &[Variant<u32>], there: &[Variant<u32>]) {
        self.compare_names("variant", path, &names(here, |v| &v.name), &names(there, |v| &v.name));
        for a in here {
            if let Some(b) = there.iter().find(|b| b.name == a.name) {
                let path = join(path, "::", &a.name);
                let owner = format!("variant `{path}`{}", self.of_reply());
                self.compare_fields(&owner, &path, &a.fields, &b.fields);
            }
        }
    }

    /// Tells which names stand on one side only, and whether the others stand in another order.
    fn compare_names(&mut self, kind: &str, path: &str, here: &[&str], there: &[&str]) {
        let separator = if kind == "variant" { "::" } else { "." };
        let full = |name: &str| join(path, separator, name);
        let of_reply = self.of_reply();
        let only_here: Vec<&str> = without(here, there);
        let only_there: Vec<&str> = without(there, here);
        match (&only_here[..], &only_there[..]) {
            ([a], [b]) if place(here, a) == place(there, b) => {
                let line =
                    format!("{kind} `{}`{of_reply} here is called `{}` there", full(a), full(b));
                self.tell(line);
            }
            _ => {
                for name in only_here {
                    self.tell(format!("{kind} `{}`{of_reply}: only here", full(name)));
                }
                for name in only_there {
                    self.tell(format!("{kind} `{}`{of_reply}: only there", full(name)));
                }
            }
        }

        let both_here: Vec<&str> = here.iter().copied().filter(|n| there.contains(n)).collect();
        let both_there: Vec<&str> = there.iter().copied().filter(|n| here.contains(n)).collect();
        let moved: Vec<&str> =
            both_here.iter().zip(&both_there).filter(|(a, b)| a != b).map(|(a, _)| *a).collect();
        match moved[..] {
            [] => {}
            [a, b] => {
                let (a, b) = (full(a), full(b));
                self.tell(format!("{kind}s `{a}` and `{b}`{of_reply} have changed places"));
            }
            _ => {
                let owner = if path.is_empty() { self.name("") } else { format!("`{path}`") };
                let (here, there) = (both_here.join(", "), both_there.join(", "));
                self.tell(format!(
                    "the {kind}s of {owner}{of_reply} stand in another order: {here} here; {there} there"
                ));
            }
        }
    }

    fn compare_declared(
        &mut self,
        path: &str,
        what: &str,
        here: Option<&Text>,
        there: Option<&Text>,
    ) {
        if here != there {
            let text = |value: Option<&Text>| value.map_or("none".into(), |v| format!("`{v}`"));
            let (here, there) = (text(here), text(there));
            self.tell(format!("{}: {what} {here} here, {there} there", self.name(path)));
        }
    }

    fn tell_types(&mut self, pair: &Pair) {
        let here = type_text(self.here, pair.whole.0);
        let there = type_text(self.there, pair.whole.1);
        if here == there {
            // The difference is deeper in than the shortened texts go.
            let (here, there) =
                (type_text(self.here, pair.here), type_text(self.there, pair.there));
            return self
                .tell(format!("inside {}: {here} here, {there} there", self.name(&pair.path)));
        }
        self.tell(format!("{}: {here} here, {there} there", self.name(&pair.path)));
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

fn names<T>(items: &[T], name: impl Fn(&T) -> &Text) -> Vec<&str> {
    items.iter().map(|item| name(item).as_ref()).collect()
}

fn without<'a>(names: &[&'a str], others: &[&str]) -> Vec<&'a str> {
    names.iter().copied().filter(|name| !others.contains(name)).collect()
}

fn place(names: &[&str], name: &str) -> Option<usize> {
    names.iter().position(|other| *other == name)
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

fn field_name(field: &Field<u32>) -> &Text {
    &field.name
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
