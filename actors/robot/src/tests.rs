//! The reader and the schema say the same.

use crate::reader::{AskedNames, read};
use roxmltree::{Document, Node};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

type Names = BTreeSet<String>;

/// The attributes and children that the schema gives each element.
fn of_schema() -> BTreeMap<String, [Names; 2]> {
    let document = Document::parse(crate::XSD).expect("it is XML");
    let named = |kind: &str, name: &str| {
        let is_it = |node: &Node<'_, '_>| {
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
    let set = |names: &[&'static str]| names.iter().map(|name| (*name).to_owned()).collect();
    let reading = read(Path::new("tests/right/whole.robot.xml"), &[]).expect("it can be read");
    assert!(reading.findings.is_empty(), "{:?}", reading.findings);
    let asked: AskedNames = reading.asked;
    let of_reader: BTreeMap<String, [Names; 2]> = asked
        .iter()
        .map(|(element, lists)| (element.clone(), [0, 1].map(|at| set(&lists[at]))))
        .collect();

    assert_eq!(of_reader, of_schema());
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
