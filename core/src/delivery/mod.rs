//! How a message travels, and what can become of it.

pub mod credit;
pub mod dead_letters;
pub mod quarantine;
pub mod retry;
pub mod traffic_class;

use self::traffic_class::TrafficClass;
use crate::Incarnation;
use serde::{Deserialize, Serialize};
use std::fmt;

/// How messages of a contract travel between nodes. Declared with
/// `#[contract(delivery = "..")]`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Delivery {
    /// Each once and in order; what is lost on the way is repeated.
    #[default]
    Reliable,
    /// Each at most once, and none after a newer one; what is lost on the way is not repeated. For
    /// readings of which only the newest counts.
    Newest,
    /// Each once and in order, and copies over every direct link and the alternate path: while one
    /// of them carries, nothing is late. For what must not wait until a failed cable has been
    /// noticed.
    Redundant,
}

impl fmt::Display for Delivery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Delivery::Reliable => "reliable",
            Delivery::Newest => "newest",
            Delivery::Redundant => "redundant",
        })
    }
}

/// Why a message was not delivered, or a request not answered.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[non_exhaustive]
pub enum DeliveryError {
    /// The receiver's queue is full. Slow down, raise its capacity, or choose another policy.
    #[error("the receiver's queue is full")]
    Full,
    /// The receiver is between two incarnations. Try again shortly.
    #[error("the receiver is restarting")]
    Restarting,
    /// The receiver was stopped, or has ended for good. If its whole node is in the safe state, the
    /// fault list shows it. Or the sender's own node ends, or has ended, and accepts no message for
    /// other nodes.
    #[error("the receiver is stopped")]
    Stopped,
    /// The answer did not come in time. Whether the request took effect is not known.
    #[error("the deadline passed")]
    DeadlinePassed,
    /// The receiver died while it served this message.
    #[error("the receiver died in its incarnation {incarnation} while it served this message")]
    PeerDied {
        /// The incarnation that ended.
        incarnation: Incarnation,
    },
    /// The two parties hold different contracts; the text shows what differs, field by field.
    #[error("the contract differs: {difference}")]
    ContractDiffers {
        /// One line for each difference.
        difference: String,
    },
    /// This message killed several incarnations of the receiver and is not let in again.
    #[error("this message is quarantined: it killed {kills} incarnations of the receiver")]
    Quarantined {
        /// How many incarnations it ended.
        kills: u32,
    },
    /// The sender's incarnation was abandoned and replaced; its messages are refused.
    #[error("the sender has been fenced off")]
    Fenced,
    /// The receiver, or its whole node, may neither send nor receive: it was isolated, or put into
    /// its safe state, also because its recovery was given up.
    #[error("{object} is isolated, or in its safe state: {reason}")]
    Isolated {
        /// The object, or the node.
        object: String,
        /// The fault for which it is so, with its number; or where to look it up.
        reason: String,
    },
    /// The message, or the data that a command was made from, was older than its contract allows;
    /// or a safe command has taken the place of a command that waited.
    #[error("the message is older than its contract allows")]
    Expired,
    /// No object of this name is known.
    #[error("no object is called `{name}`")]
    Unknown {
        /// The name that was looked for.
        name: String,
    },
    /// No path leads to the receiver's node, or it has fallen silent. See its links, and those of
    /// the nodes in between.
    #[error("node {node} cannot be reached: no path leads there, or it has fallen silent")]
    Unreachable {
        /// The node that was to be reached.
        node: String,
    },
    /// The message is larger than its contract allows.
    #[error("the message is larger than the {limit} bytes that its contract allows")]
    TooLarge {
        /// The contract's limit in bytes.
        limit: usize,
    },
    /// The bytes are not a message of this contract, or its reply could not be made or read.
    #[error("undecodable: {reason}")]
    Undecodable {
        /// What the codec said, or where a conversion panicked.
        reason: String,
    },
    /// The receiver's node has ended in order; what is sent to it arrives nowhere until it is back.
    #[error("node {node} has left in order")]
    Left {
        /// The node that was to be reached.
        node: String,
    },
    /// The request was sent, and the way to its answer was lost. Whether it took effect is not
    /// known: ask the receiver, or send it again under the same identity, or declare its contract
    /// idempotent.
    #[error("it is not known whether the request took effect: {reason}")]
    OutcomeUnknown {
        /// Why the path to the answer is lost.
        reason: String,
    },
    /// What became of the variable's value when its owner's incarnation ended awaits a decision.
    /// Decide by `VariableRef::decide`.
    #[error("{variable} awaits a decision: restore it, take its default, or give it a value")]
    Undecided {
        /// The variable and its owner, such as `target of arm`.
        variable: String,
    },
    /// The variable is not what the writer took it for. Read it again.
    #[error("{variable} has changed: its revision is {revision}")]
    Changed {
        /// The variable and its owner, such as `target of arm`.
        variable: String,
        /// Of which change its value is now.
        revision: u64,
    },
    /// A check of the receiver's refused the value.
    #[error("refused by a check: {reason}")]
    CheckFailed {
        /// What the check said.
        reason: String,
    },
    /// Another commander holds the actuator. Claim it when that lease has ended.
    #[error("{actuator} is commanded by {by}")]
    Held {
        /// The name of the actuator.
        actuator: String,
        /// The commander that holds it, with its incarnation.
        by: String,
    },
    /// The commander has not claimed the actuator, or its lease has ended. Claim it, again.
    #[error("the commander holds no lease of {actuator}, or no more: claim it")]
    LeaseEnded {
        /// The name of the actuator.
        actuator: String,
    },
    /// Another commander or primary has taken over: messages of an older epoch are refused.
    #[error("superseded: epoch {epoch} holds now")]
    Superseded {
        /// The epoch that holds.
        epoch: u64,
    },
    /// The value is set, and could not be kept for the node's next process. Make room on the disk,
    /// and write again.
    #[error("the value is set, but not kept over a restart of its node: {reason}")]
    NotKept {
        /// What the file system said.
        reason: String,
    },
    /// A node on the path returned packets to the receiver's node, and no reply arrived by another
    /// path.
    #[error("node {node} cannot be reached: what is sent there comes back, since {reason}")]
    Undelivered {
        /// The node that was to be reached.
        node: String,
        /// Why it came back, and what helps.
        reason: String,
    },
    /// No component holds this name of the whole robot now. Try again when it is claimed.
    #[error("the name {name} has no holder")]
    Unclaimed {
        /// The name that has no holder.
        name: String,
    },
    /// The message is larger than what a session carries to another node, whatever its contract
    /// allows. It was not sent: send it in parts.
    #[error(
        "the message is larger than the {limit} bytes that go to another node at once, whatever its \
         contract allows: send it in parts"
    )]
    TooLargeForSession {
        /// The session's limit in bytes.
        limit: usize,
    },
    /// The request took effect, and its reply is larger than its contract allows, or than a session
    /// carries to another node. Asking again changes nothing: answer in parts, or raise `max_size`.
    #[error(
        "the request took effect, but its reply is larger than the {limit} bytes that its contract, \
         or the way to another node, allows"
    )]
    ReplyTooLarge {
        /// The limit in bytes.
        limit: usize,
    },
    /// The request took effect, and its reply could not be written for the caller: its conversion
    /// to the caller's version panicked, or it cannot be encoded.
    #[error("the request took effect, but its reply cannot be sent: {reason}")]
    ReplyUnsent {
        /// Why the reply cannot be sent.
        reason: String,
    },
    /// As much of this class is in flight to the receiver's node as this sender's share allows:
    /// `deliver` waits. Contracts of large messages declare `#[contract(bulk)]`, a class with
    /// capacity of its own.
    #[error("the way to node {node} is full of {class}")]
    WayFull {
        /// The node that the message is for.
        node: String,
        /// The class of the message.
        class: TrafficClass,
    },
    /// The object is there, and does not serve this contract. Declare it in the object's `ports`,
    /// or send to another object.
    #[error("{}", not_served(.object, .contract, .served))]
    NotServed {
        /// The name of the object.
        object: String,
        /// The contract that it does not serve.
        contract: String,
        /// The contracts that it serves.
        served: Vec<String>,
    },
    /// No object of this name is known, and one of a similar name is.
    #[error("no object is called `{name}`: did you mean `{nearest}`?")]
    Misspelt {
        /// The name that was looked for.
        name: String,
        /// The known name that is spelt most like it.
        nearest: String,
    },
    /// The text is no name. Names take letters, digits, `_`, `-` and `.`, in parts between slashes.
    #[error("{reason}")]
    InvalidName {
        /// Which name, and what is wrong with it.
        reason: String,
    },
    /// The object is a component of another type than the one that was asked for.
    #[error("`{name}` is a `{found}`, and not a `{wanted}`")]
    OtherType {
        /// The name of the object.
        name: String,
        /// The type of the component that has the name.
        found: String,
        /// The type that was asked for.
        wanted: String,
    },
    /// The object has no such variable. Declare it in the object's `ports`, or ask another one.
    #[error(
        "{object} has no variable `{variable}`: {}; write `ports.variable(…)`, or \
         `ports.parameters::<…>()` for parameters, in its `fn ports`",
        listed("has", .known)
    )]
    NoVariable {
        /// The name of the object.
        object: String,
        /// The contract of the variable that it has not.
        variable: String,
        /// The variables that it has.
        known: Vec<String>,
    },
    /// The sender's own node was shut down.
    #[error("node {node} was shut down")]
    ShutDown {
        /// The name of the node.
        node: String,
    },
    /// The sender itself is isolated, or in its safe state: nothing that it sends gets out.
    #[error("the sender is isolated, or in its safe state: the fault list says why")]
    SenderIsolated,
    /// The sender's node does not have the right to do this: the receiver's node holds a roster
    /// that gives it to others. Change the roles or the policy by `blastema keys edit`.
    #[error(
        "node {node} may not {verb} on {object}, by roster {serial} of the receiver's node: change roles or \
         policy by `blastema keys edit`"
    )]
    Forbidden {
        /// The node that was refused.
        node: String,
        /// What it wanted to do: a verb of policy lines.
        verb: String,
        /// At which object, topic or name, as policy lines name it.
        object: String,
        /// The serial number of the roster.
        serial: u64,
    },
    /// The contract of the command has a `max_age`, and the commander has not said how old the data
    /// is that the command was made from.
    #[error(
        "`{contract}` has a max_age: write `commander.command_from(cx.captured_at(), command)`, with when \
         the data was captured that the command is made from"
    )]
    AgeUnknown {
        /// The contract of the command.
        contract: String,
    },
    /// The port of the sender's component is not connected.
    #[error(
        "the port {port} is not connected: write `.connect(\"{port}\", \"COMPONENT#PORT\")` at its node"
    )]
    Unconnected {
        /// The component and its port, such as `laser#scan`.
        port: String,
    },
}

/// Prints the text of `Display`: a `main` that returns this error, and `unwrap`, print by `Debug`.
impl fmt::Debug for DeliveryError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The contract by which commanders speak with an actuator.
const COMMAND: &str = "blastema/command";

fn not_served(object: &str, contract: &str, served: &[String]) -> String {
    let listed = listed("serves", served);
    if contract == COMMAND {
        return format!("{object} is no actuator: {listed}");
    }
    let cure = match served.iter().any(|served| served == COMMAND) {
        true => "; it is an actuator: command it by `commander`",
        false => "",
    };
    format!("{object} does not serve `{contract}`: {listed}{cure}")
}

/// Contracts, without those of the middleware.
fn listed(verb: &str, known: &[String]) -> String {
    let known = known.iter().filter(|known| !known.starts_with("blastema/"));
    match known.map(|known| format!("`{known}`")).collect::<Vec<_>>().join(", ").as_str() {
        "" => format!("it {verb} none"),
        known => format!("it {verb} {known}"),
    }
}

/// Whether a request without a reply took effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The request did not take effect and never will: it may be sent again.
    NotTaken,
    /// The request may have taken effect, or still may: send it again only if it is idempotent.
    Unknown,
    /// The request took effect; only its reply is missing.
    TookEffect,
}

impl DeliveryError {
    /// The error of an object or a node that is isolated for a reason that only the fault list
    /// knows.
    pub fn isolated(object: impl fmt::Display) -> Self {
        let reason = "the fault list says why".to_owned();
        DeliveryError::Isolated { object: object.to_string(), reason }
    }

    /// Returns whether a request that failed for this reason, and was not returned, took effect.
    pub fn outcome(&self) -> Outcome {
        match self {
            DeliveryError::Full
            | DeliveryError::WayFull { .. }
            | DeliveryError::Restarting
            | DeliveryError::ContractDiffers { .. }
            | DeliveryError::Quarantined { .. }
            | DeliveryError::Expired
            | DeliveryError::Isolated { .. }
            | DeliveryError::Unknown { .. }
            | DeliveryError::Misspelt { .. }
            | DeliveryError::NotServed { .. }
            | DeliveryError::InvalidName { .. }
            | DeliveryError::OtherType { .. }
            | DeliveryError::NoVariable { .. }
            | DeliveryError::ShutDown { .. }
            | DeliveryError::Unreachable { .. }
            | DeliveryError::Undelivered { .. }
            | DeliveryError::TooLarge { .. }
            | DeliveryError::TooLargeForSession { .. }
            | DeliveryError::Left { .. }
            | DeliveryError::Undecided { .. }
            | DeliveryError::Changed { .. }
            | DeliveryError::CheckFailed { .. }
            | DeliveryError::Held { .. }
            | DeliveryError::LeaseEnded { .. }
            | DeliveryError::Superseded { .. }
            | DeliveryError::Unclaimed { .. }
            | DeliveryError::Unconnected { .. }
            | DeliveryError::AgeUnknown { .. }
            | DeliveryError::Forbidden { .. } => Outcome::NotTaken,
            // The callee may have been stopped while it served; and what cannot be decoded may be
            // the reply.
            DeliveryError::Stopped
            | DeliveryError::Fenced
            | DeliveryError::SenderIsolated
            | DeliveryError::Undecodable { .. }
            | DeliveryError::DeadlinePassed
            | DeliveryError::PeerDied { .. }
            | DeliveryError::OutcomeUnknown { .. } => Outcome::Unknown,
            DeliveryError::ReplyTooLarge { .. }
            | DeliveryError::ReplyUnsent { .. }
            | DeliveryError::NotKept { .. } => Outcome::TookEffect,
        }
    }
}
