//! What is wrong with a robot file: each finding with its places, excerpt, and what to write.

use crate::description::ElementOrigin;
use miette::{
    GraphicalReportHandler, GraphicalTheme, LabeledSpan, MietteDiagnostic, NamedSource, Report,
};
use roxmltree::{Document, Node, NodeId};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

/// A user corrects these first.
const FINDINGS_MAX: usize = 100;
/// The columns of a report.
const WIDTH: usize = 120;

/// A place in one of the robot's files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FilePlace {
    pub(crate) file: usize,
    /// In bytes from the start of the file.
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
    pub(crate) help: String,
    pub(crate) labels: Vec<(FilePlace, String)>,
}

impl RobotFinding {
    /// Findings are shown in the order of their places.
    pub(crate) fn order(&self) -> Option<(usize, usize)> {
        self.labels.first().map(|(place, _)| (place.file, place.range.start))
    }
}

/// A part of an element that a finding is about: an attribute of the element, or of one below it.
#[derive(Clone, Debug)]
pub(crate) struct ElementPart {
    /// The element below, and the attribute by which it is known among several.
    pub(crate) below: Option<(String, Option<(&'static str, String)>)>,
    /// The finding is shown at the name of the element where that has no such attribute.
    pub(crate) attribute: String,
}

impl From<&str> for ElementPart {
    fn from(attribute: &str) -> Self {
        ElementPart { below: None, attribute: attribute.to_owned() }
    }
}

impl ElementPart {
    /// An attribute of the element below whose attribute `key` is `value`.
    pub(crate) fn below(element: &str, key: &'static str, value: &str, attribute: &str) -> Self {
        let below = Some((element.to_owned(), Some((key, value.to_owned()))));
        ElementPart { below, attribute: attribute.to_owned() }
    }

    /// The part that gives a setting its value, as in `max_block`, or `liveness.interval`.
    pub(crate) fn of_setting(setting: &str) -> Self {
        let (below, name) = match setting.split_once('.') {
            Some((element, name)) => (Some((element.to_owned(), None)), name),
            None => (None, setting),
        };
        let name = name.strip_suffix("_hz").unwrap_or(name);
        ElementPart { below, attribute: name.replace('_', "-") }
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

    /// Whether a place is in an element.
    pub(crate) fn holds(&self, origin: ElementOrigin, place: &FilePlace) -> bool {
        let Some((file, at)) = origin.at else { return false };
        let element = self.documents.get(file).zip(self.elements.get(&(file, at)));
        let element = element.and_then(|(document, id)| document.get_node(*id));
        place.file == file && element.is_some_and(|of| of.range().contains(&place.range.start))
    }

    /// The place of a part; `None` for what code describes.
    pub(crate) fn find(&self, origin: ElementOrigin, part: &ElementPart) -> Option<FilePlace> {
        let (file, at) = origin.at?;
        let element = self.documents.get(file)?.get_node(*self.elements.get(&(file, at))?)?;
        let is_it = |node: &Node<'_, '_>| match &part.below {
            None => true,
            Some((name, None)) => node.has_tag_name(name.as_str()),
            Some((name, Some((key, value)))) => {
                node.has_tag_name(name.as_str()) && node.attribute(*key) == Some(value)
            }
        };
        let element = element.descendants().find(is_it).unwrap_or(element);
        Some(FilePlace { file, range: value_place(element, &part.attribute) })
    }
}

/// The bytes of an attribute's value; of the element's name where it has no such attribute.
pub(crate) fn value_place(element: Node<'_, '_>, attribute: &str) -> Range<usize> {
    let attribute = element.attribute_node(attribute);
    attribute.map_or_else(|| tag_name(element), |attribute| attribute.range_value())
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
        // Writing to a text does not fail.
        let _ = handler.render_report(&mut text, &*shown(finding, sources));
        text.push('\n');
    }
    match findings.len().saturating_sub(FINDINGS_MAX) {
        0 => {}
        more => text.push_str(&format!("and {more} more\n")),
    }
    text
}

/// A finding as miette renders it. An excerpt is of one file: the help names places in others.
fn shown(finding: &RobotFinding, sources: &RobotSources) -> Report {
    let file = finding.labels.first().map(|(place, _)| place.file);
    let (here, elsewhere): (Vec<_>, Vec<_>) =
        finding.labels.iter().partition(|(place, _)| Some(place.file) == file);
    let labels = here
        .into_iter()
        .map(|(place, label)| LabeledSpan::new_with_span(Some(label.clone()), place.range.clone()));
    let elsewhere =
        elsewhere.into_iter().map(|(place, label)| format!("{label}: {}", sources.name(place)));
    let help = std::iter::once(finding.help.clone()).chain(elsewhere);
    let mut shown =
        MietteDiagnostic::new(&finding.sentence).with_code(finding.code).with_labels(labels);
    shown.help = Some(help.collect::<Vec<_>>().join("\n"));
    match file.map(|file| &sources.files[file]) {
        Some((name, text)) => {
            Report::new(shown).with_source_code(NamedSource::new(name, text.clone()))
        }
        None => Report::new(shown),
    }
}
