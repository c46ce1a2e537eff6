//! What is wrong with a robot file: each finding with its places, excerpt, and what to write.

use crate::description::ElementOrigin;
use miette::{Diagnostic, GraphicalReportHandler, GraphicalTheme, LabeledSpan, NamedSource};
use roxmltree::{Document, Node, NodeId};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;
use std::sync::Arc;

/// A user corrects these first.
pub(crate) const FINDINGS_MAX: usize = 100;
/// The columns of a report.
const WIDTH: usize = 120;

/// A place in one of the robot's files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FilePlace {
    pub(crate) file: usize,
    /// In bytes.
    pub(crate) range: Range<usize>,
}

/// One mistake in a robot file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RobotFinding {
    /// The rule that is broken, as in `robot::value`.
    pub(crate) code: &'static str,
    /// What is wrong.
    pub(crate) sentence: String,
    /// What to write instead.
    pub(crate) help: Option<String>,
    pub(crate) labels: Vec<(FilePlace, String)>,
}

impl RobotFinding {
    /// Findings are shown in the order of their places.
    pub(crate) fn order(&self) -> Option<(usize, usize)> {
        self.labels.first().map(|(place, _)| (place.file, place.range.start))
    }
}

/// A part of an element that a finding is about.
#[derive(Clone, Debug)]
pub(crate) enum ElementPart {
    /// The value of this attribute; the element's name where it has none.
    Value(&'static str),
    /// An attribute of the child element that has this attribute with this value, or with any where
    /// that is empty.
    Child { element: &'static str, key: (&'static str, String), attribute: &'static str },
}

impl ElementPart {
    /// The attribute that it is about.
    pub(crate) fn attribute(&self) -> &'static str {
        match self {
            ElementPart::Value(attribute) | ElementPart::Child { attribute, .. } => attribute,
        }
    }
}

/// The robot's files.
#[derive(Clone, Debug, Default)]
pub(crate) struct RobotSources {
    /// Names and texts, the outermost file first.
    pub(crate) files: Vec<(String, Arc<str>)>,
}

impl RobotSources {
    /// The line and column of a place, counted from 1.
    pub(crate) fn position(&self, place: &FilePlace) -> (usize, usize) {
        let before = &self.files[place.file].1[..place.range.start];
        let start = before.rfind('\n').map_or(0, |end| end + 1);
        (before.matches('\n').count() + 1, before[start..].chars().count() + 1)
    }

    fn name(&self, place: &FilePlace) -> String {
        let (line, column) = self.position(place);
        format!("{}:{line}:{column}", self.files[place.file].0)
    }
}

/// Finds the parts of elements again that descriptions were read from.
pub(crate) struct ElementPlaces<'s> {
    documents: Vec<Document<'s>>,
    /// Elements by file and first byte.
    elements: BTreeMap<(usize, usize), NodeId>,
}

impl<'s> ElementPlaces<'s> {
    /// Reads the files again.
    pub(crate) fn of(sources: &'s RobotSources) -> Self {
        let documents = sources.files.iter().filter_map(|(_, text)| Document::parse(text).ok());
        let documents: Vec<_> = documents.collect();
        let mut elements = BTreeMap::new();
        for (file, document) in documents.iter().enumerate() {
            for node in document.descendants().filter(Node::is_element) {
                elements.insert((file, node.range().start), node.id());
            }
        }
        ElementPlaces { documents, elements }
    }

    /// The place of a part; `None` for what code describes.
    pub(crate) fn find(&self, origin: ElementOrigin, part: &ElementPart) -> Option<FilePlace> {
        let (file, at) = origin.at?;
        let element = self.documents.get(file)?.get_node(*self.elements.get(&(file, at))?)?;
        let value = |element: Node<'_, '_>, name| Some(element.attribute_node(name)?.range_value());
        let range = match part {
            ElementPart::Value(attribute) => value(element, *attribute),
            ElementPart::Child { element: child, key: (key, name), attribute } => {
                let is_it = |node: &Node<'_, '_>| {
                    node.has_tag_name(*child)
                        && (name.is_empty() || node.attribute(*key) == Some(name))
                };
                let found = element.descendants().find(is_it);
                found.map(|child| value(child, *attribute).unwrap_or(tag_name(child)))
            }
        };
        Some(FilePlace { file, range: range.unwrap_or_else(|| tag_name(element)) })
    }
}

/// The bytes of an element's name.
pub(crate) fn tag_name(element: Node<'_, '_>) -> Range<usize> {
    let start = element.range().start + 1;
    let text = &element.document().input_text()[start..];
    let end = text.find(|c: char| c.is_whitespace() || matches!(c, '/' | '>'));
    start..start + end.unwrap_or(0)
}

/// Renders findings in the order of their places.
pub(crate) fn report(findings: &[RobotFinding], sources: &RobotSources) -> String {
    let theme = GraphicalTheme::unicode_nocolor();
    let handler = GraphicalReportHandler::new_themed(theme).with_width(WIDTH);
    let mut text = String::new();
    for finding in findings.iter().take(FINDINGS_MAX) {
        let shown = ShownFinding::of(finding, sources);
        // Writing to a text does not fail.
        let _ = handler.render_report(&mut text, &shown);
        text.push('\n');
    }
    match findings.len().saturating_sub(FINDINGS_MAX) {
        0 => {}
        more => text.push_str(&format!("and {more} more\n")),
    }
    text
}

/// A finding as miette renders it.
#[derive(Debug)]
struct ShownFinding<'a> {
    finding: &'a RobotFinding,
    source: Option<NamedSource<Arc<str>>>,
    labels: Vec<LabeledSpan>,
    help: Option<String>,
}

impl<'a> ShownFinding<'a> {
    fn of(finding: &'a RobotFinding, sources: &RobotSources) -> Self {
        let shown = finding.labels.first().map(|(place, _)| place.file);
        let source = shown.map(|file| {
            let (name, text) = &sources.files[file];
            NamedSource::new(name, text.clone())
        });
        let (here, elsewhere): (Vec<_>, Vec<_>) =
            finding.labels.iter().partition(|(place, _)| Some(place.file) == shown);
        let labels = here.into_iter().map(|(place, label)| {
            LabeledSpan::new_with_span(Some(label.clone()), place.range.clone())
        });
        let elsewhere =
            elsewhere.into_iter().map(|(place, label)| format!("{label}: {}", sources.name(place)));
        let help: Vec<String> = finding.help.iter().cloned().chain(elsewhere).collect();
        let help = (!help.is_empty()).then(|| help.join("\n"));
        ShownFinding { finding, source, labels: labels.collect(), help }
    }
}

impl fmt::Display for ShownFinding<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.finding.sentence)
    }
}

impl std::error::Error for ShownFinding<'_> {}

impl Diagnostic for ShownFinding<'_> {
    fn code<'b>(&'b self) -> Option<Box<dyn fmt::Display + 'b>> {
        Some(Box::new(self.finding.code))
    }

    fn help<'b>(&'b self) -> Option<Box<dyn fmt::Display + 'b>> {
        self.help.as_ref().map(|help| Box::new(help) as Box<dyn fmt::Display>)
    }

    fn source_code(&self) -> Option<&dyn miette::SourceCode> {
        self.source.as_ref().map(|source| source as &dyn miette::SourceCode)
    }

    fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
        Some(Box::new(self.labels.iter().cloned()))
    }
}
