//! `blastema component` and `blastema acknowledge`.

use super::{OperatorKey, OperatorSession};
use crate::args::{ComponentJob, NodeAddress, OrderOptions};
use crate::monitor::client::{ask, no_node};
use crate::monitor::tables::table;
use crate::print;
use blastema::core::NodeName;
use blastema::{ComponentOrder, OrderReply, OrderVerb};
use std::path::Path;
use std::time::{Duration, Instant};

/// Gives the order, and prints what is so then.
///
/// # Errors
/// Why it was not done, and what to do.
pub(crate) fn run(job: &ComponentJob) -> Result<(), String> {
    let (verb, options) = match job {
        ComponentJob::List { name, to, json } => {
            let reply = give(OrderVerb::List, name.as_deref(), to)?;
            let rows = serde_json::to_value(&reply.rows).map_err(|error| error.to_string())?;
            return print(&match (json, rows.as_array()) {
                (false, Some(rows)) => {
                    table("name, kind, incarnation, state, note", rows, usize::MAX)
                }
                _ => format!("{rows}\n"),
            });
        }
        ComponentJob::Activate(options) => (OrderVerb::Activate, options),
        ComponentJob::Deactivate(options) => (OrderVerb::Deactivate, options),
        ComponentJob::Reset(options) => (OrderVerb::Reset, options),
        ComponentJob::Restart(options) => (OrderVerb::Restart, options),
    };
    report(give(verb, Some(&options.name), &options.to)?, &options.name)
}

/// Acknowledges that communication is back.
///
/// # Errors
/// Why it was not done, and what to do.
pub(crate) fn acknowledge(policy: Option<&str>, to: &OrderOptions) -> Result<(), String> {
    report(give(OrderVerb::Acknowledge, policy, to)?, "it")
}

fn report(reply: OrderReply, name: &str) -> Result<(), String> {
    let lines = reply.rows.iter().map(|row| match row.kind.as_str() {
        "policy" => format!("{}: {}\n", row.name, row.state),
        _ => format!("{}: {} in incarnation {}\n", row.name, row.state, row.incarnation),
    });
    let text: String = lines.collect();
    print(if text.is_empty() { format!("{name}: done\n") } else { text }.as_str())
}

fn give(verb: OrderVerb, name: Option<&str>, to: &OrderOptions) -> Result<OrderReply, String> {
    let order = ComponentOrder { verb, name: name.map(str::to_owned) };
    let reply = match (&to.socket, &to.via) {
        (Some(socket), _) => blastema::run(by_socket(socket, &order, to.operator.within))?,
        (None, Some(via)) => by_network(via, order, to)?,
        (None, None) => return Err("name the node by --socket or --via".to_owned()),
    };
    match (&reply.refused, name) {
        (None, _) => Ok(reply),
        (Some(why), Some(name)) => Err(format!("{name}: {why}")),
        (Some(why), None) => Err(why.clone()),
    }
}

async fn by_socket(
    path: &Path,
    order: &ComponentOrder,
    within: Duration,
) -> Result<OrderReply, String> {
    let line = serde_json::to_string(order).map_err(|error| error.to_string())? + "\n";
    let until = Instant::now() + within;
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let bytes = ask(path, &line, left).await?;
        if bytes.is_empty() {
            return Err("the node has ended, or has closed the connection before its answer: \
                        whether the order is carried out is unknown"
                .to_owned());
        }
        match serde_json::from_slice(&bytes) {
            Ok(reply) => return Ok(reply),
            // A node that the line reaches too late shows itself, and has not read it.
            Err(_) if is_snapshot(&bytes) && until > Instant::now() => {}
            Err(_) => return Err(no_node(path, "what is no answer to an order")),
        }
    }
}

fn is_snapshot(bytes: &[u8]) -> bool {
    serde_json::from_slice(bytes).is_ok_and(|json: serde_json::Value| json.get("node").is_some())
}

fn by_network(
    via: &NodeAddress,
    order: ComponentOrder,
    to: &OrderOptions,
) -> Result<OrderReply, String> {
    let node = to.node.as_ref().unwrap_or(&via.node);
    OperatorSession::run(&OperatorKey::of(&to.operator)?, via, &to.operator, async |session| {
        let name = NodeName::new(node).map_err(|error| error.to_string())?;
        if !session.reaches(&name).await {
            return Err(format!("{node} is not reached by way of {}", via.node));
        }
        let reply = session.node.order_at(node, order, session.within).await;
        reply.map_err(|error| format!("{node}: {error}"))
    })
}
