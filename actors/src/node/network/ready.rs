//! Waiting until all that a program depends on is there.

use crate::node::Node;
use crate::platform;
use blastema_core::directory::DirectoryKey;
use blastema_core::{NodeName, ObjectName};
use std::fmt;
use std::time::Duration;

/// How often it is looked who is there: soon enough for a start, and rare enough to cost nothing.
const LOOK_AGAIN: Duration = Duration::from_millis(10);

/// What was not there in time.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct NotReady {
    /// Each name or topic that is missing, and why.
    pub missing: Vec<(String, String)>,
}

impl fmt::Display for NotReady {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("not there in time: ")?;
        for (place, (name, why)) in self.missing.iter().enumerate() {
            let comma = if place == 0 { "" } else { "; " };
            write!(f, "{comma}{name} ({why})")?;
        }
        Ok(())
    }
}

impl std::error::Error for NotReady {}

/// Readiness; with the feature `network`.
impl Node {
    /// Waits until all of these are there: objects of other nodes (`module2:arm`), of this node
    /// (`arm`) and of the whole robot (`*:map`), and topics with a listener, on any node.
    /// After it, nothing that is sent to them or published there is lost for want of news. A
    /// [service](crate::manual::services) needs no such wait: its callers wait for it.
    ///
    /// # Errors
    /// What is missing after this time, and why.
    pub async fn ready(
        &self,
        names: &[&str],
        topics: &[&str],
        within: Duration,
    ) -> Result<(), NotReady> {
        let until = platform::now() + within;
        loop {
            let missing = self.missing(names, topics);
            if missing.is_empty() {
                return Ok(());
            }
            let left = until - platform::now();
            if left.is_zero() {
                return Err(NotReady { missing });
            }
            platform::sleep(LOOK_AGAIN.min(left)).await;
        }
    }

    fn missing(&self, names: &[&str], topics: &[&str]) -> Vec<(String, String)> {
        let mut missing = Vec::new();
        for name in names {
            if let Some(why) = self.absence(name) {
                missing.push(((*name).to_owned(), why));
            }
        }
        for topic in topics {
            if !self.0.environment.topics().is_heard(topic) {
                let why = "no node listens to this topic".to_owned();
                missing.push((format!("topic {topic}"), why));
            }
        }
        missing
    }

    /// Why a name cannot be sent to now.
    fn absence(&self, name: &str) -> Option<String> {
        let Some((node, object)) = name.split_once(':') else {
            return self.own_absence(name);
        };
        if node == "*" {
            return self.holder(object).is_none().then(|| "no object holds this name".to_owned());
        }
        if node == self.0.name.as_str() {
            return self.own_absence(object);
        }
        let (Ok(node), Ok(object)) = (NodeName::new(node), ObjectName::new(object)) else {
            return Some("this is no name of an object".to_owned());
        };
        let Some(networks) = &self.0.networks else {
            return Some("this node has no network".to_owned());
        };
        if !networks.handle.is_connected(&node) {
            return Some(format!("{node} is not connected"));
        }
        let having = self.0.environment.directory().nodes_with(&DirectoryKey::Object(object));
        let has = having.contains(&node);
        (!has).then(|| format!("{node} has no object of this name"))
    }

    fn own_absence(&self, object: &str) -> Option<String> {
        let known = ObjectName::new(object).ok();
        let known = known.and_then(|object| self.0.environment.registry.kind_of(&object));
        known.is_none().then(|| "this node has no object of this name".to_owned())
    }
}
