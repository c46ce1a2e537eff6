//! The rules of what a robot does when it loses a commander.

use super::RobotChecker;
use crate::description::{
    ChildDescription, ComponentDescription, ElementOrigin, LostCommunicationDescription,
    NeedDescription, NodeDescription, RungAction, RungDescription,
};
use crate::finding::ElementPart;
use crate::types::network_of;
use crate::value::ValueError;
use blastema::PolicyPart;
use blastema::core::port::{ConnectionRole, PortConnection};
use blastema::recovery::Restart;
use std::collections::BTreeMap;

const CODE: &str = "robot::lost";

impl<'a> RobotChecker<'a> {
    /// Finds what the policies of a node name and is not there, and steps that lack what they need.
    pub(super) fn lost_communication(
        &mut self,
        node: &'a NodeDescription,
        groups: &BTreeMap<&str, usize>,
    ) {
        let nodes = self.robot.nodes.iter().map(|node| node.name.as_str());
        for policy in &node.lost_communication {
            if let Some(commander) = &policy.commander {
                let at = (policy.origin, "commander");
                self.known(CODE, "node", commander, nodes.clone(), at);
                if groups.contains_key(commander.as_str()) {
                    self.reach(groups, commander, &node.name, at);
                }
            }
            for need in &policy.needs {
                let at = (need.origin, need.kind);
                if need.kind == "link" {
                    let ends = node.endpoints.iter();
                    let networks = ends.filter_map(|end| network_of(self.robot, node, end).ok());
                    let links: Vec<_> =
                        networks.flat_map(|of| of.link_names().collect::<Vec<_>>()).collect();
                    let links = links.iter().map(String::as_str);
                    self.known(CODE, "link", &need.name, links, at);
                } else if need.kind != "heartbeat" {
                    self.known(CODE, "node", &need.name, nodes.clone(), at);
                }
            }
            policy.rungs.iter().for_each(|rung| self.rung(node, rung));
        }
    }

    /// `return` and `continue` run a component. It stands directly in the node, which adds it when
    /// it is wanted.
    fn rung(&mut self, node: &'a NodeDescription, rung: &RungDescription) {
        for command in &rung.commands {
            let port = self.types.port(self.robot, &command.actuator, false);
            if let Err(ValueError { sentence, help, label }) = port {
                self.find(CODE, sentence, (command.origin, "actuator"), help, &label);
            }
        }
        let runs = matches!(rung.action, RungAction::Return | RungAction::Continue);
        let Some(run) = rung.run.as_ref().filter(|_| runs) else {
            if runs || rung.run.is_some() {
                let sentence = "`return` and `continue` run a component, and other steps do not";
                let help = "add `run=\"…\"`, with a component or a tree of this node, or delete it";
                self.find(CODE, sentence, (rung.origin, "do"), help, "here");
            }
            return;
        };
        let below = node.root.children.iter().filter_map(|child| match child {
            ChildDescription::Component(component) => Some(&**component),
            ChildDescription::Supervisor(_) => None,
        });
        let names = below.clone().map(|known| known.name.as_str());
        self.known(CODE, "component directly in the node called", run, names, (rung.origin, "run"));
        let is_unusual = |component: &&ComponentDescription| {
            let ComponentDescription { restart, essential, plan, .. } = component;
            *restart != Restart::Permanent || *essential || !plan.is_empty()
        };
        if let Some(component) = below.clone().find(|of| of.name == *run).filter(is_unusual) {
            let sentence = format!("`{run}`, which a rung runs, is not restarted by rules");
            let help = "delete its `restart`, `essential` and `on`";
            self.find(CODE, sentence, (component.origin, "name"), help, "run by a rung");
        }
    }

    /// Finds an actuator that another node commands, and that no policy brings to rest.
    pub(super) fn commanded(
        &mut self,
        ports: &PortConnection,
        from: &str,
        to: &str,
        origin: ElementOrigin,
    ) {
        let port = self.types.port(self.robot, &ports.to, false).unwrap_or_default();
        let policies = self.robot.node(to).into_iter().flat_map(|node| &node.lost_communication);
        let mut commands = policies
            .filter(|policy| policy.commander.as_ref().is_none_or(|node| node == from))
            .flat_map(|policy| policy.rungs.iter().flat_map(|rung| &rung.commands));
        // A process ends with its node, and its leases end with their commanders.
        if self.robot.whole_of(from) != self.robot.whole_of(to)
            && port.is_some_and(|port| port.role == ConnectionRole::Commanded)
            && !commands.any(|command| command.actuator == ports.to)
        {
            let sentence =
                format!("node {to} does nothing with `{}` when it loses node {from}", ports.to);
            let help = format!(
                "add `<lost-communication name=\"…\" commander=\"{from}\">` to node {to}, with a \
                 rung that commands it"
            );
            self.find(CODE, sentence, (origin, "to"), help, "commanded from another node");
        }
    }
}

/// The element and the attribute of a part of a policy.
pub(super) fn place_of(
    policy: &LostCommunicationDescription,
    part: &PolicyPart,
) -> (ElementOrigin, ElementPart) {
    match part {
        PolicyPart::Commander => (policy.origin, "commander".into()),
        PolicyPart::AtLeast => (policy.origin, "at-least".into()),
        PolicyPart::Need(place, setting) => {
            let NeedDescription { kind, origin, .. } = &policy.needs[*place];
            (*origin, ElementPart::of_setting(if setting.is_empty() { kind } else { setting }))
        }
        PolicyPart::RungTime(rung) => (policy.rungs[*rung].origin, "time".into()),
        PolicyPart::Rung(rung) => (policy.rungs[*rung].origin, "do".into()),
        PolicyPart::Command { rung, command, field } => {
            let command = &policy.rungs[*rung].commands[*command];
            let field = field.as_ref().map(|of| ElementPart::below("field", "name", of, "value"));
            (command.origin, field.unwrap_or_else(|| "actuator".into()))
        }
        _ => (policy.origin, "name".into()),
    }
}
