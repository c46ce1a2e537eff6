//! The conditions that come with every tree: connections, components and faults.

use super::host::TreeHost;
use crate::condition::Connected;
use blastema_core::NodeName;
use blastema_core::{Lifecycle, ObjectName};
use blastema_trees::{Factory, LeafContext, LeafResult, Port, PortError, Status, Value};
use std::ops::RangeInclusive;
use std::time::Duration;

/// The condition that a tree with this leaf needs the record of faults for.
pub(super) const FAULT_CONDITION: &str = "IsFaultPresent";

const TOPIC: Port = Port::input::<String>("topic_name")
    .only("name of a topic", |value| ObjectName::new(&topic(&value.to_string())).is_ok())
    .about("the topic of the heartbeats");
const TIMEOUT: Port = Port::input::<f64>("timeout_sec")
    .or("3.0")
    .only("timeout from 0.01 to 3600 s", |value| is_within(value, 0.01..=3600.0))
    .about("longest silence, in s");

/// A condition over heartbeats with a limit, as a port, and how that is set.
type Limited = (&'static str, Port, fn(Connected, f64) -> Connected);
/// Silence within the timeout changes no quality.
const LIMITS: [Limited; 3] = [
    (
        "IsCommsQualityAcceptable",
        span("max_latency_sec").or("0.5").about("one way, in s"),
        |needs, limit| needs.max_latency(Duration::from_secs_f64(limit)),
    ),
    ("IsCommsJitterAcceptable", span("max_jitter_sec").or("0.1").about("in s"), |needs, limit| {
        needs.max_jitter(Duration::from_secs_f64(limit))
    }),
    (
        "IsCommsLossAcceptable",
        Port::input::<f64>("max_loss")
            .or("0.1")
            .only("share from 0.0 to 1.0", |value| is_within(value, 0.0..=1.0))
            .about("from 0.0 to 1.0"),
        Connected::max_loss,
    ),
];
/// The states that a tree can name.
const STATES: [Lifecycle; 3] = [Lifecycle::Initialized, Lifecycle::Active, Lifecycle::Error];

/// A port for a time that a program can wait.
pub(super) const fn span(name: &'static str) -> Port {
    // Ten years.
    let is_span = |value: &Value| is_within(value, 0.0..=3.2e8);
    Port::input::<f64>(name).only("time of 0 s or more", is_span)
}

fn is_within(value: &Value, range: RangeInclusive<f64>) -> bool {
    value.as_real().is_some_and(|real| range.contains(&real))
}

fn is_state(value: &Value) -> bool {
    STATES.iter().any(|known| known.to_string() == value.to_string())
}

/// Registers them. Names and ports of the first three are those of the source's nodes.
pub(super) fn register(factory: &mut Factory) {
    factory.condition("IsCommsConnected", [TOPIC, TIMEOUT], |cx| {
        heard(cx, 0, &topic(&cx.input::<String>("topic_name")?))
    });
    let are_topics = |value: &Value| {
        let text = value.to_string();
        topics(&text).count() > 0 && topics(&text).all(|topic| ObjectName::new(&topic).is_ok())
    };
    let port = Port::input::<String>("heartbeat_topics").only("list of topics", are_topics);
    let port = port.about("topics, separated by `;`");
    factory.condition("AreAllCommsConnected", [port, TIMEOUT], |cx| {
        let (text, mut all) = (cx.input::<String>("heartbeat_topics")?, true);
        // Each is declared in the first tick, also behind one that is silent.
        for (number, topic) in topics(&text).enumerate() {
            all &= heard(cx, number, &topic)? == Status::Success;
        }
        Ok(Status::from(all))
    });
    for (name, limit, set) in LIMITS {
        let port = limit.name();
        factory.condition(name, [TOPIC, limit], move |cx| {
            let topic = topic(&cx.input::<String>("topic_name")?);
            let limit: f64 = cx.input(port)?;
            let needs = set(Connected::heartbeat(&topic), limit);
            let name = format!("{topic}/{port}-{limit}");
            Ok(Status::from(TreeHost::condition(cx, 0, &name, || needs)?.is_acceptable()))
        });
    }
    {
        let is_name = |value: &Value| NodeName::new(&value.to_string()).is_ok();
        let node = Port::input::<String>("node").only("name of a node", is_name);
        let node = node.about("the name of another node");
        factory.condition("IsNodeConnected", [node, TIMEOUT], |cx| {
            let (node, timeout) = (cx.input::<String>("node")?, timeout(cx)?);
            let name = format!("{node}/there-within-{timeout:?}");
            let there = || Connected::node(&node).timeout(timeout);
            Ok(Status::from(TreeHost::condition(cx, 0, &name, there)?.is_connected()))
        });
    }
    let component = Port::input::<String>("component").about("a component of this node");
    let state = Port::input::<String>("state").or("active");
    let state = state.only("state of a component: initialized, active or error", is_state);
    let state = state.about("such as active or error");
    factory.condition("IsComponentInState", [component, state], |cx| {
        let (component, state) = (cx.input::<String>("component")?, cx.input::<String>("state")?);
        let component = TreeHost::of(cx)?.environment.registry.watchable(&component)?;
        let now = component.life_cycle().map(|(_, state)| state);
        Ok(Status::from(now.is_some_and(|now| now.to_string() == state)))
    });
    let code = Port::input::<String>("code").about("such as B27, or of the application's list");
    let object = Port::input::<String>("object").optional().about("where it was found");
    factory.condition(FAULT_CONDITION, [code, object], |cx| {
        let (code, object) = (cx.input::<String>("code")?, cx.optional_input::<String>("object")?);
        Ok(Status::from(TreeHost::of(cx)?.has_fault(&code, object.as_deref())))
    });
}

/// A topic's name. Those of ROS begin with a slash.
fn topic(text: &str) -> String {
    text.trim().trim_start_matches('/').to_owned()
}

fn topics(text: &str) -> impl Iterator<Item = String> {
    text.split(';').map(topic).filter(|topic| !topic.is_empty())
}

fn timeout(cx: &LeafContext<'_>) -> Result<Duration, PortError> {
    cx.input("timeout_sec").map(Duration::from_secs_f64)
}

/// Heartbeats arrive within the leaf's timeout. What was never heard does not.
fn heard(cx: &LeafContext<'_>, number: usize, topic: &str) -> LeafResult {
    let timeout = timeout(cx)?;
    let name = format!("{topic}/heard-within-{timeout:?}");
    let heard = || Connected::heartbeat(topic).timeout(timeout);
    Ok(Status::from(TreeHost::condition(cx, number, &name, heard)?.is_connected()))
}
