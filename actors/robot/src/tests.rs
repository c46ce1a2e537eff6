//! The reader and the schema say the same.

use crate::description::{
    ComponentDescription, NodeDescription, RobotNetwork, SupervisorDescription,
};
use crate::reader::{EXCEEDED, RESTARTS, STRATEGIES, WHEN_FULL, read};
use crate::value::word_of;
use blastema::core::recovery::{Backoff, SupervisorRules, WhenExceeded};
use blastema::prelude::*;
use blastema::{DeviceSpec, LostCommunicationPolicy, NodeBuilder};
use roxmltree::Document;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Duration;

/// The namespace of schemas.
const XS: &str = "http://www.w3.org/2001/XMLSchema";

struct Nothing;

impl Component for Nothing {}

type Names = BTreeSet<String>;

thread_local! {
    /// The names that elements were asked for: of each its attributes and its children.
    static ASKED: RefCell<BTreeMap<String, [Names; 2]>> = RefCell::default();
}

pub(crate) fn note_asked(element: &str, names: [&[&'static str]; 2]) {
    ASKED.with_borrow_mut(|asked| {
        let known = asked.entry(element.to_owned()).or_default();
        for (known, new) in known.iter_mut().zip(names) {
            known.extend(new.iter().map(|name| (*name).to_owned()));
        }
    });
}

/// The attributes and children that the schema gives each element.
fn of_schema() -> BTreeMap<String, [Names; 2]> {
    let document = Document::parse(crate::XSD).expect("it is XML");
    let named = |kind: &str, name: &str| {
        let is_it = |node: &roxmltree::Node<'_, '_>| {
            node.tag_name().name() == kind && node.attribute("name") == Some(name)
        };
        let top = document.root_element().children();
        top.into_iter().find(is_it).unwrap_or_else(|| panic!("{kind} {name}"))
    };
    let of_group = |name: &str| {
        let attributes = named("attributeGroup", name).children();
        attributes.filter_map(|node| node.attribute("name")).map(str::to_owned).collect::<Vec<_>>()
    };
    let elements = document.descendants().filter(|node| node.tag_name().name() == "element");
    let elements = elements.map(|element| {
        let of = |what| element.attribute(what).expect("each element has a name and a type");
        let mut names = [Names::new(), Names::new()];
        for node in named("complexType", of("type")).descendants() {
            match (node.tag_name().name(), node.attribute("name"), node.attribute("ref")) {
                ("attribute", Some(name), _) => drop(names[0].insert(name.to_owned())),
                ("attributeGroup", _, Some(group)) => names[0].extend(of_group(group)),
                ("element", Some(name), _) => drop(names[1].insert(name.to_owned())),
                _ => {}
            }
        }
        (of("name").to_owned(), names)
    });
    elements.collect()
}

#[test]
fn the_schema_has_the_elements_and_attributes_that_the_reader_takes() {
    let reading = read(Path::new("tests/right/whole.robot.xml"), &[]).expect("it can be read");
    assert!(reading.findings.is_empty(), "{:?}", reading.findings);
    let of_reader = ASKED.take();

    assert_eq!(of_reader, of_schema());
}

fn word<T: PartialEq>(words: &[(&'static str, T)], value: T) -> String {
    word_of(words, value).to_owned()
}

#[test]
fn the_schema_has_the_defaults_of_the_code() {
    let document = Document::parse(crate::XSD).expect("it is XML");
    let attributes = document.descendants().filter(|node| node.has_tag_name((XS, "attribute")));
    let of_schema = attributes.filter_map(|attribute| {
        let owners = attribute.ancestors().skip(1);
        let owner = owners.filter_map(|node| node.attribute("name")).next()?;
        let name = format!("{owner} {}", attribute.attribute("name")?);
        Some((name, attribute.attribute("default")?.to_owned()))
    });
    let of_schema: BTreeMap<String, String> = of_schema.collect();

    type Spec = ChildSpec<Nothing>;
    let (rules, backoff) = (SupervisorRules::default(), Backoff::default());
    let (component, network) = (ComponentDescription::default(), RobotNetwork::default());
    let span = |span: Duration| format!("{span:?}");
    let of_code = [
        ("rules strategy", word(&STRATEGIES, rules.strategy)),
        ("rules intensity", rules.intensity.to_string()),
        ("rules period", span(rules.period)),
        ("node when-exceeded", word(&EXCEEDED, rules.when_exceeded)),
        ("supervisor when-exceeded", word(&EXCEEDED, rules.when_exceeded)),
        ("process when-exceeded", word(&EXCEEDED, WhenExceeded::Escalate)),
        ("step times", "1".to_owned()),
        ("step pause", span(backoff.first)),
        ("step pause-factor", backoff.factor.to_string()),
        ("step pause-limit", span(backoff.limit)),
        ("claim policy", "refuse".to_owned()),
        ("ends stable-for", span(LostCommunicationPolicy::STABLE)),
        ("ends acknowledged", "false".to_owned()),
        ("child restart", word(&RESTARTS, component.restart)),
        ("component queue", Spec::QUEUE.to_string()),
        ("component when-full", word(&WHEN_FULL, component.when_full)),
        ("node locked-memory", NodeDescription::default().locked_memory.to_string()),
        ("component thread", if component.own_thread { "own" } else { "shared" }.to_owned()),
        ("child essential", component.essential.to_string()),
        ("component max-block", span(Spec::MAX_BLOCK)),
        ("component max-delay", span(Spec::MAX_DELAY)),
        ("child ready-within", span(Spec::READY_WITHIN)),
        ("child shutdown-within", span(Spec::SHUTDOWN_WITHIN)),
        ("device interval", span(DeviceSpec::INTERVAL)),
        ("device deadman", span(DeviceSpec::DEADMAN)),
        ("device turnaround", span(DeviceSpec::TURNAROUND)),
        ("process ready", "notify".to_owned()),
        ("supervisor essential", SupervisorDescription::default().essential.to_string()),
        ("network insecure", network.insecure.to_string()),
        ("node grace", span(NodeBuilder::GRACE)),
        ("node may-be-away", "false".to_owned()),
        ("argument type", "text".to_owned()),
    ];
    assert_eq!(of_schema, of_code.map(|(name, value)| (name.to_owned(), value)).into());
}

#[test]
fn a_robot_is_drawn_as_text_for_graphviz_and_for_mermaid() {
    use crate::graph::{GraphFormat, graph};
    let reading = read(Path::new("tests/right/whole.robot.xml"), &[]).expect("it can be read");
    for (format, end) in
        [(GraphFormat::Text, "txt"), (GraphFormat::Dot, "dot"), (GraphFormat::Mermaid, "mmd")]
    {
        let (drawn, path) = (graph(&reading.robot, format), format!("tests/right/whole.{end}"));
        if std::env::var_os("BLASTEMA_BLESS").is_some() {
            std::fs::write(&path, &drawn).expect("it can be written");
        }
        assert_eq!(drawn, std::fs::read_to_string(&path).unwrap_or_default(), "{path}");
    }
}
