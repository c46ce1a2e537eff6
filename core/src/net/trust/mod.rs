//! Keys of nodes, the signed list of a robot's nodes, and what each of them may do: the texts and
//! the rules, without IO.
//!
//! ```text
//! ranger.robot       signs the list of nodes; never on the robot     RobotFile
//! base.key           one node's secret, and who signs                KeyFile
//! base.incarnation   which incarnation of the node was the last      IncarnationFile
//! ranger.roster      the signed list: nodes, keys, roles, policy     NodeRoster
//! ```
//!
//! | file | concept |
//! | --- | --- |
//! | `crypto` | the only one that knows cryptographic libraries: seeds, public keys, signatures |
//! | `text` | lines of words, keys in base64url, errors with line numbers |
//! | `key_file` | the two files that hold a secret |
//! | `roster` | the list, its canonical text, its signature, its serial number |
//! | `incarnation_file` | which incarnation of a node was the last |
//! | `beacon` | who is at which port, with a code for each other node of the roster |
//! | `policy` | roles, verbs, patterns, and the decision whether a peer may do something |
//! | `access` | the rights of a roster's nodes at one of them, and what they were refused |
//!
//! A node reads its key and the roster when it starts, and seals its networks with them. The peer
//! protocol, actuators, variables and names of the robot ask `access`. What this module does not
//! do: it reads no file and no clock, and takes randomness as an argument.

pub mod access;
pub mod beacon;
pub mod crypto;
pub mod incarnation_file;
pub mod key_file;
pub mod policy;
pub mod roster;
pub mod text;

#[cfg(test)]
mod tests;
