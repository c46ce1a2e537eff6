//! The robot of the demonstration: its modules, cables, objects and flows.
//!
//! ```text
//!             ethernet                 ieee1394
//!   module2 ━━━━━━━━━━━━━━ module1 ━━━━━━━━━━━━━━ module3
//!   laser   ─ ─ ─ ─ ─ ─ ─ ─ planner ─ ─ ─ ─ ─ ─ ─ ─ motors
//!   operator  ieee1394-b    safety    ethernet-b    odometry
//! ```
//!
//! This is Fig. 9 of Baek and Park (2008): module2 and module3 reach each other through module1
//! only. The dashed cables are the second paths.

use blastema::core::{NodeName, ObjectAddress, ObjectName};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::net::Ipv4Addr;
use std::ops::Range;

/// One of the robot's computers, here a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Module {
    /// In the middle: planner and safety; everything passes through it.
    Module1,
    /// The sensor head: laser and operator panel.
    Module2,
    /// The base: motors and odometry.
    Module3,
}

/// Interval at which each small object gives a sign of life, as in the paper's experiment.
pub(crate) const SIGN_OF_LIFE_MILLIS: u64 = 100;

impl Module {
    /// All of them.
    pub(crate) const ALL: [Module; 3] = [Module::Module1, Module::Module2, Module::Module3];

    /// The name of its node.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Module::Module1 => "module1",
            Module::Module2 => "module2",
            Module::Module3 => "module3",
        }
    }

    /// The module of this name.
    pub(crate) fn from_name(name: &str) -> Option<Module> {
        Module::ALL.into_iter().find(|module| module.name() == name)
    }

    /// 1 to 3.
    pub(crate) const fn number(self) -> u8 {
        match self {
            Module::Module1 => 1,
            Module::Module2 => 2,
            Module::Module3 => 3,
        }
    }

    /// The objects that do the robot's work here.
    pub(crate) const fn components(self) -> &'static [&'static str] {
        match self {
            Module::Module1 => &["planner", "safety"],
            Module::Module2 => &["laser", "operator"],
            Module::Module3 => &["motors", "odometry"],
        }
    }

    /// Those of them that are passive in the paper's sense: they are asked whether they live, and
    /// how long messages wait in their queues. All others give signs of life by themselves.
    pub(crate) const fn passive(self) -> &'static [&'static str] {
        match self {
            Module::Module1 => &["planner"],
            Module::Module2 => &["operator"],
            Module::Module3 => &[],
        }
    }

    /// Which of the hundred cells of the robot's skin are here.
    pub(crate) const fn skin(self) -> Range<u32> {
        match self {
            Module::Module1 => 0..34,
            Module::Module2 => 34..67,
            Module::Module3 => 67..100,
        }
    }
}

impl fmt::Display for Module {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The two networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum DemoNetwork {
    /// 127.1.0.x
    Ethernet,
    /// 127.2.0.x
    Ieee1394,
}

impl DemoNetwork {
    /// The network's address of a module.
    pub(crate) const fn address(self, module: Module) -> Ipv4Addr {
        let network = match self {
            DemoNetwork::Ethernet => 1,
            DemoNetwork::Ieee1394 => 2,
        };
        Ipv4Addr::new(127, network, 0, module.number())
    }
}

/// A cable between two modules; its name is the link's name in both.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct DemoCable {
    /// Its name.
    pub(crate) name: &'static str,
    /// The network that it belongs to.
    pub(crate) network: DemoNetwork,
    /// The module at its other end; the first is always module1.
    pub(crate) far: Module,
    /// Taken only while the other cable between the same modules is down.
    pub(crate) second: bool,
}

/// Every cable.
pub(crate) const CABLES: [DemoCable; 4] = [
    DemoCable {
        name: "ethernet",
        network: DemoNetwork::Ethernet,
        far: Module::Module2,
        second: false,
    },
    DemoCable {
        name: "ieee1394-b",
        network: DemoNetwork::Ieee1394,
        far: Module::Module2,
        second: true,
    },
    DemoCable {
        name: "ieee1394",
        network: DemoNetwork::Ieee1394,
        far: Module::Module3,
        second: false,
    },
    DemoCable {
        name: "ethernet-b",
        network: DemoNetwork::Ethernet,
        far: Module::Module3,
        second: true,
    },
];

impl DemoCable {
    /// The modules that it joins.
    pub(crate) const fn ends(&self) -> [Module; 2] {
        [Module::Module1, self.far]
    }

    /// Whether the module has an end of it.
    pub(crate) fn touches(&self, module: Module) -> bool {
        self.ends().contains(&module)
    }
}

/// Sequence-numbered reliable messages at a steady rate, by which loss and doubling are counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flow {
    /// Its name; also that of the object that sends.
    pub(crate) name: &'static str,
    /// Where it begins.
    pub(crate) from: Module,
    /// Where it ends.
    pub(crate) to: Module,
    /// The object that receives.
    pub(crate) sink: &'static str,
    /// Messages in a second.
    pub(crate) rate_hz: u32,
}

/// Every flow. Each pair of modules has one, and the panic of the scenario strikes the receiver of
/// one.
pub(crate) const FLOWS: [Flow; 4] = [
    Flow {
        name: "flow/2-3",
        from: Module::Module2,
        to: Module::Module3,
        sink: "skin/80",
        rate_hz: 100,
    },
    Flow {
        name: "flow/3-2",
        from: Module::Module3,
        to: Module::Module2,
        sink: "skin/40",
        rate_hz: 50,
    },
    Flow {
        name: "flow/2-1",
        from: Module::Module2,
        to: Module::Module1,
        sink: "skin/17",
        rate_hz: 100,
    },
    Flow {
        name: "flow/1-3",
        from: Module::Module1,
        to: Module::Module3,
        sink: "skin/90",
        rate_hz: 50,
    },
];

impl Flow {
    /// The flow of this name.
    pub(crate) fn from_name(name: &str) -> Option<&'static Flow> {
        FLOWS.iter().find(|flow| flow.name == name)
    }

    /// Whether its messages pass between module1 and `far`.
    pub(crate) fn crosses(&self, far: Module) -> bool {
        self.from == far || self.to == far
    }
}

/// The address of an object.
///
/// # Panics
/// If the name is none; names in this program are constants.
pub(crate) fn address(module: Module, object: &str) -> ObjectAddress {
    ObjectAddress::new(
        NodeName::new(module.name()).expect("the modules' names are names"),
        ObjectName::new(object).expect("the objects' names are names"),
    )
}

/// The name of a cell of the skin.
pub(crate) fn skin(cell: u32) -> String {
    format!("skin/{cell:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_cells_are_spread_over_three_modules() {
        let cells: Vec<u32> = Module::ALL.into_iter().flat_map(Module::skin).collect();

        assert_eq!(cells, (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn every_pair_with_a_cable_has_a_second_one_on_the_other_network() {
        for far in [Module::Module2, Module::Module3] {
            let cables: Vec<_> = CABLES.iter().filter(|cable| cable.far == far).collect();
            assert_eq!(cables.len(), 2);
            assert_ne!(cables[0].network, cables[1].network);
            assert_ne!(cables[0].second, cables[1].second);
        }
    }

    #[test]
    fn every_name_is_a_name_and_every_flow_ends_at_an_object_that_is_there() {
        for module in Module::ALL {
            assert_eq!(Module::from_name(module.name()), Some(module));
            for object in module.components() {
                address(module, object);
            }
        }
        for flow in FLOWS {
            let sinks: Vec<_> = flow.to.skin().map(skin).collect();
            assert!(sinks.iter().any(|name| name == flow.sink), "{}", flow.name);
            assert_eq!(Flow::from_name(flow.name), Some(&flow));
        }
    }
}
