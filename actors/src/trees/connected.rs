//! The conditions that come with every tree: connections, components and faults.

use super::host::TreeHost;
use crate::condition::{Condition, Connected};
use blastema_core::Lifecycle;
use blastema_trees::{Factory, LeafContext, LeafError, LeafResult, Port, Status};
use std::time::Duration;

/// The condition that a tree with this leaf needs the record of faults for.
pub(super) const FAULT_CONDITION: &str = "IsFaultPresent";

const TOPIC: Port = Port::input::<String>("topic_name").about("the topic of the heartbeats");
const TIMEOUT: Port = Port::input::<f64>("timeout_sec").or("3.0").about("longest silence, in s");

/// Registers them. Names and ports of the first three are those of the source's nodes.
pub(super) fn register(factory: &mut Factory) {
    factory.condition("IsCommsConnected", [TOPIC, TIMEOUT], |cx| {
        heard(cx, &topic(&cx.input::<String>("topic_name")?))
    });
    let topics = Port::input::<String>("heartbeat_topics").about("topics, separated by `;`");
    factory.condition("AreAllCommsConnected", [topics, TIMEOUT], |cx| {
        let topics: String = cx.input("heartbeat_topics")?;
        let topics = topics.split(';').map(topic).filter(|topic| !topic.is_empty());
        let mut all = None;
        // Each is declared in the first tick, also behind one that is silent.
        for topic in topics {
            let one = heard(cx, &topic)? == Status::Success;
            all = Some(all.unwrap_or(true) && one);
        }
        Ok(Status::from(all.ok_or("`heartbeat_topics` names no topic")?))
    });
    let limit = Port::input::<f64>("max_latency_sec").or("0.5").about("one way, in s");
    factory.condition("IsCommsQualityAcceptable", [TOPIC, limit], |cx| {
        let limit = seconds(cx, "max_latency_sec")?;
        let suffix = format!("latency-{}ms", limit.as_millis());
        acceptable(cx, &suffix, |needs| needs.max_latency(limit))
    });
    let limit = Port::input::<f64>("max_jitter_sec").or("0.1").about("in s");
    factory.condition("IsCommsJitterAcceptable", [TOPIC, limit], |cx| {
        let limit = seconds(cx, "max_jitter_sec")?;
        let suffix = format!("jitter-{}ms", limit.as_millis());
        acceptable(cx, &suffix, |needs| needs.max_jitter(limit))
    });
    let limit = Port::input::<f64>("max_loss").or("0.1").about("from 0.0 to 1.0");
    factory.condition("IsCommsLossAcceptable", [TOPIC, limit], |cx| {
        let limit: f64 = cx.input("max_loss")?;
        acceptable(cx, &format!("loss-{limit}"), |needs| needs.max_loss(limit))
    });
    #[cfg(feature = "network")]
    {
        let node = Port::input::<String>("node").about("the name of another node");
        factory.condition("IsNodeConnected", [node, TIMEOUT], |cx| {
            let (node, timeout) = (cx.input::<String>("node")?, seconds(cx, "timeout_sec")?);
            let name = format!("{node}/there-within-{}ms", timeout.as_millis());
            let there = || Connected::node(&node).timeout(timeout);
            Ok(Status::from(TreeHost::of(cx)?.condition(name, there)?.is_connected()))
        });
    }
    let component = Port::input::<String>("component").about("a component of this node");
    let state = Port::input::<String>("state").or("active").about("such as active or error");
    factory.condition("IsComponentInState", [component, state], |cx| {
        let (component, state) = (cx.input::<String>("component")?, cx.input::<String>("state")?);
        let now = TreeHost::of(cx)?.environment.registry.state(&component)?;
        let states = [
            Lifecycle::Created,
            Lifecycle::Initialized,
            Lifecycle::Active,
            Lifecycle::Error,
            Lifecycle::Fatal,
            Lifecycle::Finalized,
        ];
        let wanted = states.into_iter().find(|known| known.to_string() == state);
        let wanted = wanted.ok_or_else(|| {
            let known = states.map(|known| known.to_string()).join(", ");
            format!("`{state}` is no state of a component: write one of {known}")
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
fn heard(cx: &LeafContext<'_>, topic: &str) -> LeafResult {
    let timeout = seconds(cx, "timeout_sec")?;
    let name = format!("{topic}/heard-within-{}ms", timeout.as_millis());
    let heard = || Connected::heartbeat(topic).timeout(timeout);
    Ok(Status::from(TreeHost::of(cx)?.condition(name, heard)?.is_connected()))
}

/// Heartbeats arrive, and well enough. Silence within the timeout changes no quality.
fn acceptable(
    cx: &LeafContext<'_>,
    suffix: &str,
    limit: impl FnOnce(Connected) -> Connected,
) -> LeafResult {
    let topic = topic(&cx.input::<String>("topic_name")?);
    let needs = || limit(Connected::heartbeat(&topic));
    let condition = TreeHost::of(cx)?.condition(format!("{topic}/{suffix}"), needs)?;
    Ok(Status::from(Condition::is_acceptable(&condition)))
}
