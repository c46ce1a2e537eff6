//! The manual: how to build a robot with this crate, and what it guarantees.
//!
//! Each page begins with the shortest working example, and then states guarantees and limits. The
//! examples run as tests, but for those of the test kit, which depends on this crate. Whole
//! programs, one lesson a file, are in the folder `examples`; run them by
//! `cargo run -p blastema-examples --example hello`.
//!
//! | page | answers |
//! | --- | --- |
//! | [start] | a first component, a first node and a first fault |
//! | [robot_file] | a robot from one file: its elements, its program, its checks |
//! | [contracts] | types of messages: what they may contain, versions, and when two parties agree |
//! | [components] | the life cycle of a component: hooks, ports, timers, tasks, checks |
//! | [sending] | tell, deliver, ask; what every error means and what to do |
//! | [events] | publish and subscribe: conditions and topics |
//! | [variables] | values that outlive restarts: read, written and watched from any node |
//! | [parameters] | settings with defaults, units and ranges: from a file, and set while a component runs |
//! | [commanding] | actuators that become safe by themselves when their commander is gone |
//! | [conditions] | whether an operator, a node or a topic is still connected, and what the robot does alone |
//! | [trees] | behaviour trees: files, leaves, and what becomes of a leaf that fails |
//! | [devices] | microcontrollers as components: firmware, lines, faults, what a restart restores |
//! | [processes] | programs in any language as children of a supervisor: readiness, watchdog, memory, output |
//! | [services] | services that a standby on another node takes over |
//! | [supervision] | which components are restarted together, how often, and the safe state |
//! | [faults] | the list of faults, roots and symptoms |
//! | [monitoring] | what a node knows of itself: objects, threads, sessions; `blastema monitor` |
//! | [recovery] | which recovery action answers which fault; strategies of one's own |
//! | [placement] | threads, handlers that hang, and what cannot be recovered |
//! | [networks] | several nodes: links, routes, sessions, and cables that are cut |
//! | [security] | keys that seal networks; who can speak to a node, and what `insecure` means |
//! | [names] | names of the whole robot: addresses without a node |
//! | [media] | what a network can be made of, written as one string; media of one's own |
//! | [guarantees] | order, loss, restarts, and the times until faults are found |
//! | [limits] | every bound, its reason, and how to change it |
//! | [testing] | components and whole nodes in virtual time |
//! | [glossary] | the words, one for each concept |

#[doc = include_str!("start.md")]
pub mod start {}

#[doc = include_str!("robot_file.md")]
pub mod robot_file {}

#[doc = include_str!("contracts.md")]
pub mod contracts {}

#[doc = include_str!("components.md")]
pub mod components {}

#[doc = include_str!("sending.md")]
pub mod sending {}

#[doc = include_str!("events.md")]
pub mod events {}

#[doc = include_str!("variables.md")]
pub mod variables {}

#[doc = include_str!("parameters.md")]
pub mod parameters {}

#[doc = include_str!("commanding.md")]
pub mod commanding {}

#[doc = include_str!("conditions.md")]
pub mod conditions {}

#[doc = include_str!("trees.md")]
pub mod trees {}

#[doc = include_str!("devices.md")]
pub mod devices {}

#[doc = include_str!("processes.md")]
pub mod processes {}

#[doc = include_str!("services.md")]
pub mod services {}

#[doc = include_str!("supervision.md")]
pub mod supervision {}

#[doc = include_str!("faults.md")]
pub mod faults {}

#[doc = include_str!("monitoring.md")]
pub mod monitoring {}

#[doc = include_str!("recovery.md")]
pub mod recovery {}

#[doc = include_str!("placement.md")]
pub mod placement {}

#[doc = include_str!("networks.md")]
pub mod networks {}

#[doc = include_str!("security.md")]
pub mod security {}

#[doc = include_str!("names.md")]
pub mod names {}

#[doc = include_str!("media.md")]
pub mod media {}

#[doc = include_str!("guarantees.md")]
pub mod guarantees {}

#[doc = include_str!("limits.md")]
pub mod limits {}

#[doc = include_str!("testing.md")]
pub mod testing {}

#[doc = include_str!("glossary.md")]
pub mod glossary {}
