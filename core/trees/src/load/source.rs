//! The files of a tree: read, included, and kept as plain elements with their places.

use super::NodeType;
use super::error::{TreeError, skipped};
use std::collections::BTreeMap;

/// Elements nested deeper than this are refused, as by the library; nodes are ticked recursively.
pub(super) const MAX_DEPTH: usize = 256;
/// A hand-written file has a hundred kilobytes at most.
const MAX_FILE: usize = 4 << 20;
/// A user corrects these first.
const MAX_ERRORS: usize = 100;

/// A line may be the whole file: 40 characters before the place and 60 behind it are shown.
const MAX_EXCERPT: usize = 100;

/// A place in a file.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub(super) file: usize,
    /// The offset in the file, in bytes.
    pub(super) at: usize,
}

/// An element of a file.
#[derive(Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) place: Place,
    pub(super) attributes: Vec<Attribute>,
    pub(super) children: Vec<Element>,
}

/// An attribute of an element.
#[derive(Debug)]
pub(super) struct Attribute {
    pub(super) name: String,
    pub(super) value: String,
    pub(super) place: Place,
    /// The place of the value.
    pub(super) value_place: Place,
}

impl Element {
    pub(super) fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|attribute| attribute.name == name)
    }

    pub(super) fn value(&self, name: &str) -> Option<&str> {
        self.attribute(name).map(|attribute| attribute.value.as_str())
    }
}

/// The files, and their errors.
#[derive(Default)]
pub(super) struct Sources {
    /// Names and texts.
    files: Vec<(String, String)>,
    pub(super) errors: Vec<TreeError>,
    /// The elements below `root`, without the includes.
    pub(super) elements: Vec<Element>,
    /// The value of `main_tree_to_execute` in the first file.
    pub(super) main: Option<Attribute>,
}

/// Gives the text of a file that is included.
pub(super) type Include<'a> = &'a mut dyn FnMut(&str) -> Result<String, String>;

impl Sources {
    /// Reads a file and all that it includes, each file once.
    pub(super) fn read(&mut self, name: &str, text: &str, include: Include<'_>) {
        self.read_file(normalized(name), text.to_owned(), &mut Vec::new(), include);
    }

    fn read_file(
        &mut self,
        name: String,
        text: String,
        including: &mut Vec<String>,
        include: Include<'_>,
    ) {
        let file = self.files.len();
        let too_large = text.len() > MAX_FILE;
        self.files.push((name.clone(), text.clone()));
        let start = Place { file, at: 0 };
        if too_large {
            return self.error(start, "more than 4 MiB in one file");
        }
        let document = match roxmltree::Document::parse(&text) {
            Ok(document) => document,
            Err(error) => {
                let roxmltree::TextPos { row, col } = error.pos();
                let at = byte_at(&text, row as usize, col as usize);
                return self.error(Place { file, at }, format!("no XML: {error}"));
            }
        };
        let Some(root) = self.element(file, document.root_element(), 0) else { return };
        if root.name != "root" {
            return self.meaningless(&root, &["root"]);
        }
        if let Some(format) = root.attribute("BTCPP_format").filter(|format| format.value != "4") {
            self.no_value(format.value_place, &format.value, "format that is read here; it is 4");
        }
        including.push(name);
        let (includes, elements): (Vec<_>, Vec<_>) =
            root.children.into_iter().partition(|element| element.name == "include");
        for element in includes {
            self.include(&element, including, include);
        }
        including.pop();
        if file == 0 {
            self.main = root.attributes.into_iter().find(|a| a.name == "main_tree_to_execute");
        }
        self.elements.extend(elements);
    }

    fn include(&mut self, element: &Element, including: &mut Vec<String>, include: Include<'_>) {
        let Some(path) = self.needed(element, "path") else { return };
        let place = path.value_place;
        // An included path is relative to the file that includes it.
        let file = &self.files[element.place.file].0;
        let folder = file.rsplit_once('/').map(|(folder, _)| format!("{folder}/"));
        let absolute = path.value.starts_with('/');
        let folder = folder.filter(|_| !absolute).unwrap_or_default();
        let name = normalized(&format!("{folder}{}", path.value));
        if let Some(first) = including.iter().position(|known| *known == name) {
            let mut circle = including[first..].to_vec();
            circle.push(name);
            return self.error(place, format!("a circle: {}", circle.join(" -> ")));
        }
        if self.files.iter().any(|(known, _)| *known == name) {
            return;
        }
        if self.files.len() >= MAX_DEPTH {
            return self.error(place, "more than 256 files");
        }
        match include(&name) {
            Ok(text) => self.read_file(name, text, including, include),
            Err(reason) => self.error(place, format!("cannot include `{name}`: {reason}")),
        }
    }

    /// The element with those below it, unless they are nested too deep.
    fn element(
        &mut self,
        file: usize,
        node: roxmltree::Node<'_, '_>,
        depth: usize,
    ) -> Option<Element> {
        let place = Place { file, at: node.range().start };
        // Beside the nodes of a tree there are `root` and `BehaviorTree`.
        if depth > MAX_DEPTH + 2 {
            self.error(place, "more than 256 elements that are nested");
            return None;
        }
        let attributes = node.attributes().map(|attribute| Attribute {
            name: attribute.name().to_owned(),
            value: attribute.value().to_owned(),
            place: Place { file, at: attribute.range().start },
            value_place: Place { file, at: attribute.range_value().start },
        });
        let mut element = Element {
            name: node.tag_name().name().to_owned(),
            place,
            attributes: attributes.collect(),
            children: Vec::new(),
        };
        for child in node.children().filter(roxmltree::Node::is_element) {
            element.children.push(self.element(file, child, depth + 1)?);
        }
        Some(element)
    }

    /// An attribute that the element must have.
    pub(super) fn needed<'a>(
        &mut self,
        element: &'a Element,
        attribute: &'static str,
    ) -> Option<&'a Attribute> {
        let found = element.attribute(attribute);
        if found.is_none() {
            let problem = format!("<{}> needs the attribute `{attribute}`", element.name);
            self.error(element.place, problem);
        }
        found
    }

    /// An element that has no meaning at its place, where these have one.
    pub(super) fn meaningless(&mut self, element: &Element, known: &[&str]) {
        let problem = format!("<{}> has no meaning here", element.name);
        self.misspelt(element.place, problem, &element.name, known.iter().copied());
    }

    /// Notes that a text does not convert.
    pub(super) fn no_value(&mut self, place: Place, text: &str, kind: &'static str) {
        self.error(place, format!("`{text}` is no {kind}"));
    }

    /// Notes that a type of node does not have a port.
    pub(super) fn unknown_port(&mut self, node: &NodeType<'_>, place: Place, port: &str) {
        let problem = format!("`{}` has no port `{port}`", node.name);
        self.misspelt(place, problem, port, node.ports.iter().map(|port| port.name));
    }

    pub(super) fn needs_port(&mut self, place: Place, node: &str, port: &str) {
        self.error(place, format!("`{node}` needs the port `{port}`"));
    }

    /// Notes an error.
    pub(super) fn error(&mut self, place: Place, problem: impl Into<String>) {
        self.misspelt(place, problem, "", []);
    }

    /// Notes an error, with the known word that is nearest to the one that was written.
    pub(super) fn misspelt<'a>(
        &mut self,
        place: Place,
        problem: impl Into<String>,
        wrong: &str,
        known: impl IntoIterator<Item = &'a str>,
    ) {
        if self.errors.len() >= MAX_ERRORS {
            return;
        }
        let (file, text) = &self.files[place.file];
        let before = &text[..place.at];
        let start = before.rfind('\n').map_or(0, |end| end + 1);
        let column = before[start..].chars().count() + 1;
        let line = text[start..].lines().next().unwrap_or_default();
        self.errors.push(TreeError {
            file: file.clone(),
            line: before.matches('\n').count() + 1,
            column,
            excerpt: line.chars().skip(skipped(column)).take(MAX_EXCERPT).collect(),
            problem: problem.into(),
            suggestion: nearest(wrong, known).map(str::to_owned),
        });
    }

    /// The place of this byte of an attribute's value. An entity is several bytes long in the file.
    pub(super) fn within(&self, attribute: &Attribute, at: usize) -> Place {
        let Place { file, at: start } = attribute.value_place;
        let (mut decoded, mut entity) = (0, false);
        for (read, c) in self.files[file].1[start..].char_indices() {
            match c {
                '&' if decoded < at => entity = true,
                ';' if entity => (decoded, entity) = (decoded + 1, false),
                _ if entity => {}
                _ if decoded < at => decoded += c.len_utf8(),
                _ => return Place { file, at: start + read },
            }
        }
        attribute.value_place
    }
}

/// Returns the byte of a text at a line and a column, which count from 1, as [`TreeError`] has
/// them; the end where there is none.
pub fn byte_at(text: &str, line: usize, column: usize) -> usize {
    let start: usize = text.split_inclusive('\n').take(line - 1).map(str::len).sum();
    let before = text[start..].chars().take(column - 1);
    start + before.map(char::len_utf8).sum::<usize>()
}

/// The path without `.` and `..`, so that one file has one name.
fn normalized(path: &str) -> String {
    let mut parts: Vec<&str> = Vec::new();
    for part in path.split('/') {
        match part {
            "." => {}
            ".." if parts.last().is_some_and(|last| *last != ".." && !last.is_empty()) => {
                parts.pop();
            }
            _ => parts.push(part),
        }
    }
    parts.join("/")
}

/// The known word that is spelt most like the wrong one, unless none is like it at all.
pub(super) fn nearest<'a>(
    wrong: &str,
    known: impl IntoIterator<Item = &'a str>,
) -> Option<&'a str> {
    // More than a third of the letters differ: that is another word, not a slip.
    let most = 1 + wrong.len() / 3;
    let lower = wrong.to_lowercase();
    let near = |word: &&str| word.len().abs_diff(wrong.len()) <= most;
    let edits = |word: &str| strsim::levenshtein(&lower, &word.to_lowercase());
    let (edits, word) = known.into_iter().filter(near).map(|word| (edits(word), word)).min()?;
    (!wrong.is_empty() && edits <= most).then_some(word)
}

/// Names to things, in the order of the names.
pub(super) type Named<T> = BTreeMap<String, T>;
