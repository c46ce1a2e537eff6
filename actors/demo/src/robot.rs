//! The names of the robot's parts, as its file `robot.xml` has them.

use std::fmt;

/// One of the robot's computers, here a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Module {
    /// In the middle: planner and safety; everything passes through it.
    Module1,
    /// The sensor head: laser and operator panel.
    Module2,
    /// The base: motors and odometry.
    Module3,
}

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
}

impl fmt::Display for Module {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A cable between module1 and another module. It is a network of its own, so that it can be cut
/// alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct DemoCable {
    /// The name of the network, and of the link in both modules.
    pub(crate) name: &'static str,
    /// The module at its other end.
    pub(crate) far: Module,
}

impl DemoCable {
    /// The modules that it joins.
    pub(crate) const fn ends(self) -> [Module; 2] {
        [Module::Module1, self.far]
    }
}

pub(crate) const CABLES: [DemoCable; 4] = [
    DemoCable { name: "ethernet", far: Module::Module2 },
    DemoCable { name: "ieee1394-b", far: Module::Module2 },
    DemoCable { name: "ieee1394", far: Module::Module3 },
    DemoCable { name: "ethernet-b", far: Module::Module3 },
];

/// A flow of numbered reliable messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Flow {
    /// The name of the object that sends.
    pub(crate) name: &'static str,
    /// Where it begins.
    pub(crate) from: Module,
    /// Where it ends.
    pub(crate) to: Module,
}

impl Flow {
    /// Whether its messages pass through this module.
    pub(crate) fn passes(&self, module: Module) -> bool {
        [Module::Module1, self.from, self.to].contains(&module)
    }
}

/// Every flow. Each pair of modules has one, and one ends at the object that panics.
pub(crate) const FLOWS: [Flow; 4] = [
    Flow { name: "flow/2-3", from: Module::Module2, to: Module::Module3 },
    Flow { name: "flow/3-2", from: Module::Module3, to: Module::Module2 },
    Flow { name: "flow/2-1", from: Module::Module2, to: Module::Module1 },
    Flow { name: "flow/1-3", from: Module::Module1, to: Module::Module3 },
];
