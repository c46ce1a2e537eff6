//! The conditions that come with every tree: connections, components and faults.

use super::host::TreeHost;
use crate::condition::Connected;
use blastema_core::Lifecycle;
use blastema_trees::{Factory, LeafContext, LeafError, LeafResult, Port, Status};
use std::time::Duration;

/// The condition that a tree with this leaf needs the record of faults for.
pub(super) const FAULT_CONDITION: &str = "IsFaultPresent";

const TOPIC: Port = Port::input::<String>("topic_name").about("the topic of the heartbeats");
const TIMEOUT: Port = Port::input::<f64>("timeout_sec").or("3.0").about("longest silence, in s");

/// A condition over heartbeats with a limit, as a port, and how that is set.
type Limited = (&'static str, Port, fn(Connected, f64) -> Result<Connected, LeafError>);
/// Silence within the timeout changes no quality.
const LIMITS: [Limited; 3] = [
    (
        "IsCommsQualityAcceptable",
        Port::input::<f64>("max_latency_sec").or("0.5").about("one way, in s"),
        |needs, limit| Ok(needs.max_latency(Duration::try_from_secs_f64(limit)?)),
    ),
    (
        "IsCommsJitterAcceptable",
        Port::input::<f64>("max_jitter_sec").or("0.1").about("in s"),
        |needs, limit| Ok(needs.max_jitter(Duration::try_from_secs_f64(limit)?)),
    ),
    (
        "IsCommsLossAcceptable",
        Port::input::<f64>("max_loss").or("0.1").about("from 0.0 to 1.0"),
        |needs, limit| Ok(needs.max_loss(limit)),
    ),
];
/// The states that a tree can name.
const STATES: [Lifecycle; 3] = [Lifecycle::Initialized, Lifecycle::Active, Lifecycle::Error];

/// Registers them. Names and ports of the first three are those of the source's nodes.
pub(super) fn register(factory: &mut Factory) {
    factory.condition("IsCommsConnected", [TOPIC, TIMEOUT], |cx| {
        heard(cx, 0, &topic(&cx.input::<String>("topic_name")?))
    });
    let topics = Port::input::<String>("heartbeat_topics").about("topics, separated by `;`");
    factory.condition("AreAllCommsConnected", [topics, TIMEOUT], |cx| {
        let topics: String = cx.input("heartbeat_topics")?;
        let topics = topics.split(';').map(topic).filter(|topic| !topic.is_empty());
        let mut all = None;
        // Each is declared in the first tick, also behind one that is silent.
        for (number, topic) in topics.enumerate() {
            let one = heard(cx, number, &topic)? == Status::Success;
            all = Some(all.unwrap_or(true) && one);
        }
        Ok(Status::from(all.ok_or("`heartbeat_topics` names no topic")?))
    });
    for (name, limit, set) in LIMITS {
        let port = limit.name();
        factory.condition(name, [TOPIC, limit], move |cx| {
            let topic = topic(&cx.input::<String>("topic_name")?);
            let limit: f64 = cx.input(port)?;
            let needs = set(Connected::heartbeat(&topic), limit)?;
            let name = format!("{topic}/{port}-{limit}");
            Ok(Status::from(TreeHost::condition(cx, 0, &name, || needs)?.is_acceptable()))
        });
    }
    #[cfg(feature = "network")]
    {
        let node = Port::input::<String>("node").about("the name of another node");
        factory.condition("IsNodeConnected", [node, TIMEOUT], |cx| {
            let (node, timeout) = (cx.input::<String>("node")?, seconds(cx, "timeout_sec")?);
            let name = format!("{node}/there-within-{timeout:?}");
            let there = || Connected::node(&node).timeout(timeout);
            Ok(Status::from(TreeHost::condition(cx, 0, &name, there)?.is_connected()))
        });
    }
    let component = Port::input::<String>("component").about("a component of this node");
    let state = Port::input::<String>("state").or("active").about("such as active or error");
    factory.condition("IsComponentInState", [component, state], |cx| {
        let (component, state) = (cx.input::<String>("component")?, cx.input::<String>("state")?);
        let component = TreeHost::of(cx)?.environment.registry.watchable(&component)?;
        let now = component.life_cycle().map(|(_, state)| state);
        let wanted = STATES.into_iter().find(|known| known.to_string() == state);
        let wanted = wanted.ok_or_else(|| {
            format!("`{state}` is no state of a component: write initialized, active or error")
        })?;
        Ok(Status::from(now == Some(wanted)))
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

pub(super) fn seconds(cx: &LeafContext<'_>, port: &str) -> Result<Duration, LeafError> {
    let span: f64 = cx.input(port)?;
    Duration::try_from_secs_f64(span).map_err(|error| format!("`{port}` is {span}: {error}").into())
}

/// Heartbeats arrive within the leaf's timeout. What was never heard does not.
fn heard(cx: &LeafContext<'_>, number: usize, topic: &str) -> LeafResult {
    let timeout = seconds(cx, "timeout_sec")?;
    let name = format!("{topic}/heard-within-{timeout:?}");
    let heard = || Connected::heartbeat(topic).timeout(timeout);
    Ok(Status::from(TreeHost::condition(cx, number, &name, heard)?.is_connected()))
}
