//! The types of leaves that an application has.

use crate::model::{BUILTINS, LeafKind, Port, PortDirection, is_port, key_of, may_be_name};
use crate::status::Status;
use crate::tree::{Leaf, LeafContext, LeafModel, LeafResult, MakeLeaf};
use crate::value::Value;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

/// Knows the leaves of an application, and loads trees; `BehaviorTreeFactory` of BehaviorTree.CPP.
#[derive(Clone, Default)]
pub struct Factory {
    pub(crate) leaves: BTreeMap<String, Arc<LeafModel>>,
}

impl Factory {
    /// Knows only the types of nodes that need no application.
    pub fn new() -> Factory {
        Factory::default()
    }

    /// Registers a condition: a function that is called in each tick.
    ///
    /// # Panics
    ///
    /// The name or a port's name is taken or none that XML files can have, or a default value does
    /// not convert: a mistake in the program.
    pub fn condition(
        &mut self,
        name: &str,
        ports: impl Into<Vec<Port>>,
        function: impl Fn(&mut LeafContext<'_>) -> LeafResult + Send + Sync + 'static,
    ) {
        self.register(name, LeafKind::Condition, ports.into(), functions(function));
    }

    /// Registers an action that is done at once: a function that does not answer RUNNING.
    ///
    /// # Panics
    ///
    /// As [`Factory::condition`].
    pub fn action(
        &mut self,
        name: &str,
        ports: impl Into<Vec<Port>>,
        function: impl Fn(&mut LeafContext<'_>) -> LeafResult + Send + Sync + 'static,
    ) {
        self.register(name, LeafKind::SyncAction, ports.into(), functions(function));
    }

    /// Registers an action that its driver carries out: RUNNING from its start until the driver
    /// [completes](crate::Tree::complete) it, or it is halted.
    ///
    /// # Panics
    ///
    /// As [`Factory::condition`].
    pub fn driven(&mut self, name: &str, ports: impl Into<Vec<Port>>) {
        let make = functions(|_| Ok(Status::Running));
        self.register(name, LeafKind::Action, ports.into(), make);
    }

    /// The names of the leaves.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.leaves.keys().map(String::as_str)
    }

    /// Registers a leaf that keeps something; `make` makes one for each place in a tree.
    ///
    /// # Panics
    ///
    /// As [`Factory::condition`].
    pub fn leaf<L: Leaf>(&mut self, name: &str, make: impl Fn() -> L + Send + Sync + 'static) {
        self.register(name, L::kind(), L::ports(), Box::new(move || Box::new(make())));
    }

    fn register(&mut self, name: &str, kind: LeafKind, ports: Vec<Port>, make: MakeLeaf) {
        assert!(may_be_name(name), "`{name}` cannot be the name of a leaf");
        let taken = BUILTINS.iter().any(|(known, ..)| *known == name);
        assert!(!taken && !self.leaves.contains_key(name), "the name `{name}` is taken");
        for (index, port) in ports.iter().enumerate() {
            let port_name = port.name;
            let free = ports[..index].iter().all(|other| other.name != port_name);
            assert!(
                free && may_be_name(port_name) && is_port(port_name),
                "{name} cannot have a port `{port_name}`"
            );
            let fits = |text: &str| {
                let value = port.kind.admit(&Value::text(text));
                value.is_some_and(|value| port.refuses(&value).is_none())
            };
            let right = port.default.is_none_or(|text| key_of("", text).is_some() || fits(text));
            assert!(right, "the default of `{port_name}` of {name} is no {}", port.kind.name());
        }
        let model = LeafModel { name: name.to_owned(), kind, ports, make };
        self.leaves.insert(name.to_owned(), Arc::new(model));
    }

    /// The `TreeNodesModel` of the application's leaves, as a file that Groot2 loads.
    pub fn model(&self) -> String {
        let mut xml = String::from("<root BTCPP_format=\"4\">\n  <TreeNodesModel>\n");
        for (name, leaf) in &self.leaves {
            let category = match leaf.kind {
                LeafKind::Condition => "Condition",
                LeafKind::SyncAction | LeafKind::Action => "Action",
            };
            // Writing into a String cannot fail.
            let _ = writeln!(xml, "    <{category} ID=\"{}\">", escaped(name));
            for port in &leaf.ports {
                let element = match port.direction {
                    PortDirection::Input => "input_port",
                    PortDirection::Output => "output_port",
                    PortDirection::InOut => "inout_port",
                };
                let (name, kind) = (escaped(port.name), escaped(port.kind.name()));
                let _ = write!(xml, "      <{element} name=\"{name}\" type=\"{kind}\"");
                if let Some(default) = port.default {
                    let _ = write!(xml, " default=\"{}\"", escaped(default));
                }
                let _ = writeln!(xml, ">{}</{element}>", escaped(port.about));
            }
            let _ = writeln!(xml, "    </{category}>");
        }
        xml + "  </TreeNodesModel>\n</root>\n"
    }
}

/// Makes leaves of a function.
fn functions(
    function: impl Fn(&mut LeafContext<'_>) -> LeafResult + Send + Sync + 'static,
) -> MakeLeaf {
    let function = Arc::new(function);
    Box::new(move || {
        let function = function.clone();
        Box::new(move |cx: &mut LeafContext<'_>| function(cx))
    })
}

fn escaped(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;");
    text.replace('>', "&gt;").replace('"', "&quot;")
}
