//! What a person orders of a node's components from outside of its program.
//!
//! ```text
//!  blastema component … ─ inspection socket ─────┐
//!  blastema acknowledge ─ the right `operate` ───┴─► Node::order ─► host, supervisor, policy
//! ```

use super::Node;
use crate::net::operator::{ISOLATION, IsolationOrdered, OrderIsolation, operator};
use blastema_contract::supervisor::{ChildAction, ChildRequest};
use blastema_core::{FaultLocation, Lifecycle, ObjectName};
use blastema_macros::{Request, Structure};
use std::sync::Arc;
use std::time::Duration;
use tracing::info;

/// An answer comes by then, also where the component takes longer: a client of the inspection
/// socket has five seconds.
const ANSWER_WITHIN: Duration = Duration::from_secs(4);
/// Under which name operators order.
pub(super) const COMPONENTS: &str = "net/components";

/// What a person orders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
#[non_exhaustive]
pub enum OrderVerb {
    /// Nothing: the rows are wanted.
    List,
    /// An initialized component is to return to work.
    Activate,
    /// An active component is to leave work in order.
    Deactivate,
    /// A component in error, or each that is below a supervisor, is to recover by itself.
    Reset,
    /// A component, or a supervisor with all below it, is to start its next incarnation.
    Restart,
    /// A policy for lost communication is to let others command again; without a name, each whose
    /// communication is back.
    Acknowledge,
}

/// An order of a person, for [`Node::order`].
#[derive(Clone, Debug, PartialEq, Eq, Request)]
#[contract(crate = "crate", name = "blastema/order-component", version = 1, reply = OrderReply)]
pub struct ComponentOrder {
    /// What is ordered.
    pub verb: OrderVerb,
    /// Of which component or policy.
    pub name: Option<String>,
}

/// The answer to a [`ComponentOrder`].
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
#[non_exhaustive]
pub struct OrderReply {
    /// Why it is not done, and what to do.
    pub refused: Option<String>,
    /// The component or policy that was named, as it is now; all of them if none was named.
    pub rows: Vec<OrderRow>,
}

#[cfg(feature = "unix")]
impl OrderReply {
    pub(super) fn refused(why: &str) -> Self {
        OrderReply { refused: Some(why.to_owned()), rows: Vec::new() }
    }
}

/// A component, a device or a policy for lost communication, for a person.
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
#[non_exhaustive]
pub struct OrderRow {
    /// The name of the component, device or policy.
    pub name: String,
    /// The component's type, or `policy`.
    pub kind: String,
    /// The incarnation that began last; 0 for a policy.
    pub incarnation: u64,
    /// The state of the life cycle; of a policy, the rung that is carried out.
    pub state: String,
    /// What it waits for, or why it is so.
    pub note: String,
}

impl ComponentOrder {
    /// Carries the order out, and answers within four seconds.
    pub(super) async fn carry_out(&self, node: &Node) -> OrderReply {
        let ComponentOrder { verb, name } = self;
        let name = name.as_deref();
        let done = async {
            match (verb, name) {
                (OrderVerb::List, None) => Ok(()),
                (OrderVerb::Acknowledge, name) => acknowledge_by_order(node, name).await,
                (_, None) => Err("name the component: `list` shows all".to_owned()),
                (OrderVerb::List, Some(name)) => state_of(node, name).map(drop),
                (OrderVerb::Activate, Some(name)) => {
                    set_active(node, name, Lifecycle::Active).await
                }
                (OrderVerb::Deactivate, Some(name)) => {
                    set_active(node, name, Lifecycle::Initialized).await
                }
                (OrderVerb::Reset, Some(name)) => reset_by_order(node, name).await,
                (OrderVerb::Restart, Some(name)) => {
                    node.restart_child(name).await.map(drop).map_err(|error| error.to_string())
                }
            }
        };
        let late = || {
            let within = ANSWER_WITHIN.as_secs();
            Err(format!("it is not done within {within} s, and goes on: `list` shows its state"))
        };
        let done = tokio::time::timeout(ANSWER_WITHIN, done).await.unwrap_or_else(|_| late());
        OrderReply { refused: done.err(), rows: order_rows(node, name).await }
    }
}

/// Lets operators give orders, where the node has keys.
pub(super) fn serve_operators(node: &Node) {
    let registry = &node.0.environment.registry;
    let (access, own) = (registry.access(), node.0.name.clone());
    if access.policy().is_none() {
        return;
    }
    let shared = Arc::downgrade(&node.0);
    let ordered = move |from| {
        let by = operator(&access, from).unwrap_or_else(|| own.clone());
        shared.upgrade().map(|node| (Node(node), by))
    };
    let isolating = ordered.clone();
    registry.serve_hidden::<ComponentOrder>(COMPONENTS, move |order, from, answer| {
        let Some((node, by)) = ordered(from) else { return };
        let ComponentOrder { verb, name } = &order;
        if *verb != OrderVerb::List {
            info!(target: "blastema::audit", operator = %by, ?name, "it orders: {verb:?}");
        }
        actix_rt::spawn(async move { answer.give(node.order(&order).await) });
    });
    registry.serve_hidden::<OrderIsolation>(ISOLATION, move |order, from, answer| {
        let Some((node, by)) = isolating(from) else { return };
        answer.give(IsolationOrdered { refused: node.isolate_by_order(&order, &by).err() });
    });
}

/// The state of a component.
fn state_of(node: &Node, name: &str) -> Result<Lifecycle, String> {
    let component = node.0.environment.registry.watchable(name);
    let state = component.map_err(|error| error.to_string())?.life_cycle();
    state
        .map(|(_, state)| state)
        .ok_or_else(|| format!("{name} is no component: `list` shows those that there are"))
}

async fn set_active(node: &Node, name: &str, wanted: Lifecycle) -> Result<(), String> {
    match state_of(node, name)? {
        state if state == wanted => return Err(format!("it is {wanted} already")),
        Lifecycle::Created => {
            let why = "it is being initialized, and becomes active by itself: try again then";
            return Err(why.to_owned());
        }
        _ => {}
    }
    let component = node.0.environment.registry.watchable(name);
    component.map_err(|error| error.to_string())?.steer(wanted).await
}

async fn reset_by_order(node: &Node, name: &str) -> Result<(), String> {
    let object = ObjectName::new(name).map_err(|error| error.to_string())?;
    if node.0.chain.directory.supervisor(&object).is_none() {
        return reset_component(node, name).await;
    }
    let is_in_error = |name: &str| state_of(node, name) == Ok(Lifecycle::Error);
    let mut below = node.0.chain.directory.subtree(&object);
    below.retain(|name| is_in_error(name.as_str()));
    if below.is_empty() {
        return Err("no component below it is in error: only such ones can be reset".to_owned());
    }
    for name in below {
        // The reset of one before may have restarted it with its group.
        if is_in_error(name.as_str()) {
            let reset = reset_component(node, name.as_str()).await;
            reset.map_err(|why| format!("{name}: {why}"))?;
        }
    }
    Ok(())
}

async fn reset_component(node: &Node, name: &str) -> Result<(), String> {
    let state = state_of(node, name)?;
    if state != Lifecycle::Error {
        return Err(format!("it is {state}: only a component in error can be reset"));
    }
    let object = ObjectName::new(name).map_err(|error| error.to_string())?;
    let supervisor = node.0.chain.directory.supervisor_of(&object);
    let supervisor = supervisor.ok_or("no supervisor keeps it any more")?;
    let reset = ChildRequest { object, action: ChildAction::Reset };
    match supervisor.send(reset).await {
        Ok(reset) => reset.map(drop).map_err(|gave_up| gave_up.why.to_string()),
        Err(_) => Err("the node was shut down".to_owned()),
    }
}

async fn acknowledge_by_order(node: &Node, name: Option<&str>) -> Result<(), String> {
    let known = node.lost_communication().into_iter();
    let names: Vec<_> = match name {
        Some(name) => vec![name.to_owned()],
        None => known.filter(|row| row.is_back).map(|row| row.name).collect(),
    };
    if names.is_empty() {
        let why = "no policy for lost communication holds a rung that can end: `list` shows \
                   the policies";
        return Err(why.to_owned());
    }
    for name in names {
        node.acknowledge(&name).await.map_err(|error| error.to_string())?;
    }
    Ok(())
}

async fn order_rows(node: &Node, name: Option<&str>) -> Vec<OrderRow> {
    let registry = &node.0.environment.registry;
    let table = node.table().await;
    let components = table.into_iter().filter_map(|row| {
        let FaultLocation::Object(address) = &row.location else { return None };
        // First, for a name that is no object is compared with all that are.
        let kind = registry.component_type(&address.object)?.split('<').next()?;
        let component = registry.watchable(address.object.as_str()).ok()?;
        // The monitor's table follows the component by a message.
        let (incarnation, state) = component.life_cycle()?;
        Some(OrderRow {
            name: address.object.to_string(),
            kind: kind.rsplit("::").next().unwrap_or(kind).to_owned(),
            incarnation: incarnation.0,
            state: state.to_string(),
            note: row.waiting_for.or(row.note).unwrap_or_default(),
        })
    });
    let policies = node.lost_communication().into_iter().map(|row| OrderRow {
        name: row.name,
        kind: "policy".to_owned(),
        incarnation: 0,
        state: row.rung.unwrap_or_else(|| "others command".to_owned()),
        note: if row.is_back { "communication is back: acknowledge" } else { "" }.to_owned(),
    });
    let wanted = |row: &OrderRow| name.is_none_or(|name| row.name == name);
    components.chain(policies).filter(wanted).collect()
}
