//! Elements of a robot file, which are read by taking their attributes and children.
//!
//! What was not taken when an element is dropped is unknown. The names that were asked for are the
//! ones that there are, so that the reader is the only list of them.

use crate::description::ElementOrigin;
use crate::finding::{FilePlace, RobotFinding, tag_name, value_place};
use crate::value::{self, ParsedValue, ValueError};
use blastema::core::suggestion::nearest;
use roxmltree::Node;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Elements and attributes that have their place in the format and no meaning yet.
const NOT_YET: &str = "composite export fault-kind link member mode port service variant automatic-shutdown \
    commanders executable max-recovery on-give-up placement priority significant start \
    variants blocking";

/// The values of the arguments that a file declares; those of a copy have `copy` as well.
#[derive(Clone, Debug, Default)]
pub(crate) struct ArgumentValues {
    pub(crate) values: BTreeMap<String, String>,
    /// Declared arguments without a value.
    pub(crate) missing: Vec<String>,
}

/// What the elements of one file share.
pub(crate) struct FileReading<'a> {
    pub(crate) file: usize,
    pub(crate) text: &'a str,
    /// The folder of the outermost file, at which paths begin.
    pub(crate) root: &'a Path,
    pub(crate) findings: &'a RefCell<Vec<RobotFinding>>,
    pub(crate) arguments: RefCell<ArgumentValues>,
    /// How many components have been read.
    pub(crate) components: &'a Cell<usize>,
}

/// An element that is being read.
pub(crate) struct RobotElement<'a> {
    pub(crate) node: Node<'a, 'a>,
    reading: &'a FileReading<'a>,
    copy: Option<&'a str>,
    attributes: RefCell<Vec<&'static str>>,
    children: RefCell<Vec<&'static str>>,
    /// What is not taken is no mistake.
    is_left: Cell<bool>,
}

impl<'a> RobotElement<'a> {
    pub(crate) fn new(
        node: Node<'a, 'a>,
        reading: &'a FileReading<'a>,
        copy: Option<&'a str>,
    ) -> Self {
        let (attributes, children, is_left) = Default::default();
        RobotElement { node, reading, copy, attributes, children, is_left }
    }

    pub(crate) fn name(&self) -> &'a str {
        self.node.tag_name().name()
    }

    pub(crate) fn origin(&self) -> ElementOrigin {
        ElementOrigin { at: Some((self.reading.file, self.node.range().start)) }
    }

    /// The value of an attribute; `None` where it is absent or wrong.
    pub(crate) fn take<T>(
        &self,
        name: &'static str,
        parse: impl Fn(&str) -> ParsedValue<T>,
    ) -> Option<T> {
        self.attributes.borrow_mut().push(name);
        let attribute = self.node.attribute_node(name)?;
        let text = self.substituted(attribute.value(), attribute.range_value())?;
        match parse(&text) {
            Ok(value) => Some(value),
            Err(error) => {
                self.find("robot::value", attribute.range_value(), error);
                None
            }
        }
    }

    /// The value of an attribute that must be there.
    pub(crate) fn need<T>(
        &self,
        name: &'static str,
        parse: impl Fn(&str) -> ParsedValue<T>,
    ) -> Option<T> {
        if self.node.attribute(name).is_none() {
            let sentence = format!("`{}` has no `{name}`", self.name());
            let error = ValueError::new(sentence, "here", format!("add `{name}=\"…\"`"));
            self.find_at("robot::missing", name, error);
        }
        self.take(name, parse)
    }

    /// The folder of the outermost file.
    pub(crate) fn folder(&self) -> &'a Path {
        self.reading.root
    }

    /// The path that is the value of an attribute.
    pub(crate) fn path(&self, name: &'static str) -> Option<PathBuf> {
        self.take(name, |text| Ok(self.reading.root.join(value::filled(text)?)))
    }

    /// The children of these names, which have spaces between them, in the order of the file.
    pub(crate) fn children(&self, names: &'static str) -> Vec<RobotElement<'a>> {
        self.children.borrow_mut().extend(names.split(' '));
        let nodes = self.node.children();
        let wanted = nodes.filter(|node| {
            node.is_element()
                && node.tag_name().namespace().is_none()
                && names.split(' ').any(|name| name == node.tag_name().name())
        });
        wanted.map(|node| RobotElement::new(node, self.reading, self.copy)).collect()
    }

    /// The only child of this name.
    pub(crate) fn child(&self, name: &'static str) -> Option<RobotElement<'a>> {
        let mut children = self.children(name).into_iter();
        let first = children.next()?;
        for again in children {
            let sentence = format!("`{}` has two elements `{name}`", self.name());
            self.twice(sentence, [tag_name(first.node), tag_name(again.node)]);
        }
        Some(first)
    }

    /// The children of this name, each of which has another value of the attribute `key`. One that
    /// has the value of another is a mistake, and is not read.
    pub(crate) fn distinct(&self, name: &'static str, key: &'static str) -> Vec<RobotElement<'a>> {
        let (mut distinct, mut known) = (Vec::new(), BTreeMap::new());
        for child in self.children(name) {
            let attribute = child.node.attribute_node(key);
            let value = attribute.and_then(|it| child.substituted(it.value(), it.range_value()));
            let (Some(attribute), Some(value)) = (attribute, value) else {
                distinct.push(child);
                continue;
            };
            let (of, range) = (self.name(), attribute.range_value());
            let sentence = format!("`{of}` has two elements `{name}` whose `{key}` is `{value}`");
            let first = known.entry(value).or_insert_with(|| range.clone());
            if *first == range {
                distinct.push(child);
            } else {
                self.twice(sentence, [first.clone(), range]);
                child.leave();
            }
        }
        distinct
    }

    fn twice(&self, sentence: String, [first, again]: [Range<usize>; 2]) {
        let at = [(first, "first".to_owned()), (again, "again".to_owned())];
        let file = self.reading.file;
        let labels = at.into_iter().map(|(range, label)| (FilePlace { file, range }, label));
        let (labels, help) = (labels.collect(), "delete one".to_owned());
        self.add(RobotFinding { code: "robot::twice", sentence, help, labels });
    }

    /// Counts components, as many as this element makes. False, and a finding, where the robot has
    /// more than it may.
    pub(crate) fn count_components(&self, made: usize, most: usize) -> bool {
        let before = self.reading.components.replace(self.reading.components.get() + made);
        if before <= most && before + made > most {
            let sentence = format!("the robot has more than {most} components");
            let help = "write fewer, or make one component of many that are alike";
            let error = ValueError::new(sentence, "one too many", help);
            self.find_at("robot::limit", "copies", error);
        }
        before + made <= most
    }

    /// Leaves the rest of the element unread: it cannot be read because of another mistake, or is
    /// read by its copies.
    pub(crate) fn leave(&self) {
        self.is_left.set(true);
    }

    /// The same element once for each copy.
    pub(crate) fn copy(&self, copy: &'a str) -> Self {
        RobotElement::new(self.node, self.reading, Some(copy))
    }

    /// Adds a finding about an attribute; about the element's name where it has no such attribute.
    pub(crate) fn find_at(&self, code: &'static str, attribute: &str, error: ValueError) {
        self.find(code, value_place(self.node, attribute), error);
    }

    /// Adds a finding about a place in this element.
    fn find(&self, code: &'static str, range: Range<usize>, error: ValueError) {
        let ValueError { sentence, label, help } = error;
        let labels = vec![(FilePlace { file: self.reading.file, range }, label)];
        self.add(RobotFinding { code, sentence, help, labels });
    }

    fn add(&self, finding: RobotFinding) {
        let mut findings = self.reading.findings.borrow_mut();
        // A copy has the mistakes of the one before.
        if !findings.contains(&finding) {
            findings.push(finding);
        }
    }

    /// The text with the values of arguments in the places of `${name}`.
    fn substituted(&self, text: &str, range: Range<usize>) -> Option<String> {
        let arguments = self.reading.arguments.borrow();
        let (mut done, mut rest) = (String::new(), text);
        while let Some((before, behind)) = rest.split_once("${") {
            if let Some(before) = before.strip_suffix('$') {
                done += before;
                done += "${";
                rest = behind;
                continue;
            }
            done += before;
            let Some((name, behind)) = behind.split_once('}') else {
                let help =
                    format!("write `${{{behind}}}`; for a plain dollar sign and brace `$${{`");
                let sentence = format!("`${{{behind}` does not end");
                self.find("robot::argument", range, ValueError::new(sentence, "begins here", help));
                return None;
            };
            let copy = self.copy.filter(|_| name == "copy");
            match copy.or(arguments.values.get(name).map(String::as_str)) {
                Some(value) => done += value,
                // That it has no value was found where it is declared.
                None if arguments.missing.iter().any(|missing| missing == name) => return None,
                None => {
                    let known = arguments.values.keys().map(String::as_str);
                    let help = match nearest(name, known.clone()) {
                        Some(near) => format!("write `${{{near}}}`"),
                        None => "declare it by `<argument name=…>`".to_owned(),
                    };
                    let declared = known.collect::<Vec<_>>().join(", ");
                    let declared = if declared.is_empty() { "none" } else { &declared };
                    let help = format!("{help}; declared are {declared}");
                    let sentence = format!("there is no argument `{name}`");
                    self.find("robot::argument", range, ValueError::new(sentence, "unknown", help));
                    return None;
                }
            }
            rest = behind;
        }
        Some(done + rest)
    }

    /// Finds a name that was not asked for.
    fn unknown(&self, what: &str, name: &str, range: Range<usize>, known: &[&'static str]) {
        let of = self.name();
        if NOT_YET.split(' ').any(|known| known == name) {
            let sentence = format!("`{name}` is not known yet");
            let help = format!("delete it: this version does not read the {what} `{name}`");
            let error = ValueError::new(sentence, "not known yet", help);
            return self.find("robot::not-yet", range, error);
        }
        let mut all = known.to_vec();
        all.sort_unstable();
        let help = match (nearest(name, known.iter().copied()), known.is_empty()) {
            (Some(near), _) => format!("write `{near}`"),
            (None, true) => format!("delete it: `{of}` has none"),
            (None, false) => format!("delete it; there are {}", all.join(", ")),
        };
        let sentence = format!("`{name}` is not an {what} of `{of}`");
        self.find("robot::unknown", range, ValueError::new(sentence, "unknown", help));
    }
}

/// What was not taken by now is unknown.
impl Drop for RobotElement<'_> {
    fn drop(&mut self) {
        if self.is_left.get() {
            return;
        }
        let (attributes, children) = (self.attributes.borrow(), self.children.borrow());
        for attribute in self.node.attributes() {
            let xsi = "http://www.w3.org/2001/XMLSchema-instance";
            let is_taken = match attribute.namespace() {
                Some(namespace) => namespace == xsi,
                None => attributes.contains(&attribute.name()),
            };
            if !is_taken {
                let place = attribute.range_qname();
                self.unknown("attribute", attribute.name(), place, &attributes);
            }
        }
        for node in self.node.children() {
            let name = node.tag_name().name();
            if node.is_element() && !children.contains(&name) {
                self.unknown("element", name, tag_name(node), &children);
            } else if node.is_element() && node.tag_name().namespace().is_some() {
                let sentence = format!("`{name}` is of another namespace");
                let help = "delete its `xmlns`: the elements of a robot file have none";
                let error = ValueError::new(sentence, "here", help);
                self.find("robot::unknown", tag_name(node), error);
            } else if node.is_text() && node.text().is_some_and(|text| !text.trim().is_empty()) {
                let range = node.range();
                let text = &self.reading.text[range.clone()];
                let start = range.start + (text.len() - text.trim_start().len());
                let place = start..start + text.trim().len();
                let sentence = format!("`{}` holds no text", self.name());
                let help = "delete it, or make it a comment: `<!-- … -->`";
                self.find("robot::unknown", place, ValueError::new(sentence, "text", help));
            }
        }
        #[cfg(test)]
        crate::tests::note_asked(self.name(), [&attributes, &children]);
    }
}
