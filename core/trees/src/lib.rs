//! Behaviour trees in the format of BehaviorTree.CPP 4, as a pure machine.
//!
//! A [`Factory`] knows the leaves of an application and loads XML files. A [`Tree`] is ticked by
//! its driver, which gives the time. Nothing here reads a clock, a file or a socket, or starts a
//! thread; a tick allocates nothing unless a leaf does, or a script makes a text.
//!
//! ```
//! use blastema_trees::{Factory, Port, Status};
//! use std::time::Duration;
//!
//! let mut factory = Factory::new();
//! factory.condition("IsCharged", [Port::input::<f64>("charge")], |cx| {
//!     Ok(Status::from(cx.input::<f64>("charge")? > 0.2))
//! });
//! factory.action("Explore", [], |_| Ok(Status::Success));
//!
//! let mut tree = factory.load(
//!     "main.xml",
//!     r#"<root BTCPP_format="4">
//!          <BehaviorTree ID="Main">
//!            <Sequence>
//!              <IsCharged charge="{battery}"/>
//!              <Explore/>
//!            </Sequence>
//!          </BehaviorTree>
//!        </root>"#,
//! )?;
//! tree.set("battery", 0.4)?;
//! assert_eq!(tree.tick(Duration::ZERO)?, Status::Success);
//! tree.set("battery", 0.1)?;
//! assert_eq!(tree.tick(Duration::from_secs(1))?, Status::Failure);
//! assert_eq!(
//!     tree.changes_as_text(),
//!     "IsCharged::2: SUCCESS -> FAILURE\nSequence::1: SUCCESS -> FAILURE\n"
//! );
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! All errors of a file are found when it is loaded:
//!
//! ```
//! # let factory = blastema_trees::Factory::new();
//! let text = "<root>\n <BehaviorTree><Squence/></BehaviorTree>\n</root>";
//! let errors = factory.load("main.xml", text).err().expect("it is misspelt").to_string();
//! assert_eq!(
//!     errors.lines().next(),
//!     Some("main.xml:2:16: no type of node is called `Squence`; did you mean `Sequence`?")
//! );
//! ```

mod blackboard;
mod factory;
mod load;
mod model;
mod script;
mod status;
mod tree;
mod value;

#[doc = include_str!("differences.md")]
pub mod differences {}

pub use factory::Factory;
pub use load::{TreeError, TreeErrors, byte_at};
pub use model::{LeafKind, Port};
pub use status::Status;
pub use tree::{
    CalledLeaf, Halt, Leaf, LeafContext, LeafError, LeafResult, LeafRun, NodeView, PortError,
    StatusChange, TickError, TickProblem, Tree, TreeNodeId,
};
pub use value::{PortType, PortValue, Value};
