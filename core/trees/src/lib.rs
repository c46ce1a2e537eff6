//! Behaviour trees in the format of BehaviorTree.CPP 4, as a pure machine.
//!
//! A [`Factory`] knows the leaves of an application and loads XML files. A [`Tree`] is ticked by
//! its driver, which gives the time. Nothing here reads a clock, a file or a socket, or starts a
//! thread; a tick of a loaded tree allocates nothing unless a leaf or a text of a script does.
//!
//! ```
//! use blastema_trees::{Factory, Port, Status};
//! use std::time::Duration;
//!
//! let mut factory = Factory::new();
//! factory.condition("IsCharged", [Port::input::<f64>("at_least").or("0.2")], |cx| {
//!     let charge = cx.input::<f64>("charge").unwrap_or(0.5);
//!     Ok(Status::from(charge >= cx.input("at_least")?))
//! });
//! factory.action("Explore", [], |_| Ok(Status::Success));
//!
//! let mut tree = factory.load(
//!     "main.xml",
//!     r#"<root BTCPP_format="4">
//!          <BehaviorTree ID="Main">
//!            <Sequence>
//!              <IsCharged at_least="0.4"/>
//!              <Explore/>
//!            </Sequence>
//!          </BehaviorTree>
//!        </root>"#,
//! )?;
//! assert_eq!(tree.tick(Duration::ZERO)?, Status::Success);
//!
//! let errors = factory.load("main.xml", "<root>\n <BehaviorTree><Squence/></BehaviorTree></root>");
//! assert_eq!(
//!     errors.err().map(|errors| errors.to_string()).as_deref(),
//!     Some(
//!         "main.xml:2:16: no type of node is called `Squence`; did you mean `Sequence`?\n\
//!          \x20  2 |  <BehaviorTree><Squence/></BehaviorTree></root>\n\
//!          \x20    |                ^"
//!     )
//! );
//! # Ok::<(), Box<dyn std::error::Error>>(())
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
pub use load::{Problem, TreeError, TreeErrors};
pub use model::{LeafKind, Port};
pub use script::ScriptError;
pub use status::Status;
pub use tree::{
    Halt, Leaf, LeafContext, LeafError, LeafResult, LeafRun, NodeView, PortError, StatusChange,
    TickError, TickProblem, Tree, TreeNodeId,
};
pub use value::{PortType, PortValue, Value};
