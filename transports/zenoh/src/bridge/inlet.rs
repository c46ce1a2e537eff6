//! What brings a key of Zenoh in, to a topic.
//!
//! A client that may write to the key may flood it: what is not JSON, does not fit, or is too large
//! is refused on Zenoh's thread; what fits waits in a bounded queue, of which the oldest goes
//! first, and only so many events in each span of time are published.

use super::BridgedContract;
use crate::client::ZenohReader;
use blastema::Publisher;
use blastema::core::contract::codec;
use blastema::prelude::*;
use serde_path_to_error::Track;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::Notify;

/// So many events of one key may wait, and so many bytes of text that they came from; one may
/// always.
const WAITING_MAX: usize = 64;
const WAITING_BYTES_MAX: usize = 4 << 20;
/// So many events are published in each span, so that listeners, and the lists of their threads,
/// which hold 1024, are not filled from outside.
const BATCH: usize = 64;
const SPAN: Duration = Duration::from_millis(10);
/// Refusals are reported so often, and are over so long after the last one.
const REPORT_EVERY: Duration = Duration::from_secs(1);
const OVER_AFTER: Duration = Duration::from_secs(60);

/// The most bytes of JSON for events of so many bytes: numbers take up to four times as much, and
/// small events have the names of their fields.
fn text_limit(max_size: usize) -> usize {
    max_size.saturating_mul(4).clamp(16 << 10, 4 << 20)
}

/// What came from outside and is to be published.
pub(crate) struct InletQueue<E> {
    key: String,
    contract: BridgedContract,
    waiting: Mutex<Incoming<E>>,
    more: Notify,
}

struct Incoming<E> {
    events: VecDeque<(E, usize)>,
    bytes: usize,
    displaced: u64,
    too_large: u64,
    misfits: u64,
    /// Why the last one was refused.
    why: String,
}

impl<E: Event> InletQueue<E> {
    pub(crate) fn new(key: &str, contract: BridgedContract) -> Self {
        let waiting = Incoming {
            events: VecDeque::new(),
            bytes: 0,
            displaced: 0,
            too_large: 0,
            misfits: 0,
            why: String::new(),
        };
        let (key, more) = (key.to_owned(), Notify::new());
        InletQueue { key, contract, waiting: Mutex::new(waiting), more }
    }

    fn lock(&self) -> MutexGuard<'_, Incoming<E>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what waits, and wakes the inlet.
    fn tell(&self, change: impl FnOnce(&mut Incoming<E>)) {
        change(&mut self.lock());
        self.more.notify_one();
    }

    fn read(&self, schema: &str, text: &[u8]) -> Result<E, String> {
        let tag = &self.contract.tag;
        if !schema.is_empty() && schema != tag {
            return Err(format!(
                "its encoding says {:?}, and this key carries {tag:?}",
                short(schema)
            ));
        }
        let event: E = parsed(text)?;
        codec::encode(&event, &mut Vec::new()).map_err(|error| error.to_string())?;
        Ok(event)
    }
}

/// What the text says. An error names the place where it does not fit; unknown fields are errors.
fn parsed<E: Event>(text: &[u8]) -> Result<E, String> {
    let (mut json, mut track) = (serde_json::Deserializer::from_slice(text), Track::new());
    let mut unknown = None;
    let read = serde_ignored::deserialize(
        serde_path_to_error::Deserializer::new(&mut json, &mut track),
        |path| unknown = unknown.take().or_else(|| Some(path.to_string().replace(".?", ""))),
    );
    let event = read.map_err(|error| short(&format!("`{}`: {error}", track.path())))?;
    json.end().map_err(|error| error.to_string())?;
    match unknown {
        None => Ok(event),
        Some(path) => Err(short(&format!("`{path}` is no field of the contract"))),
    }
}

/// A text from outside, for display.
fn short(text: &str) -> String {
    text.chars().filter(|one| !one.is_control()).take(160).collect()
}

impl<E: Event> ZenohReader for InletQueue<E> {
    fn limit(&self) -> usize {
        text_limit(E::MAX_SIZE)
    }

    fn receive(&self, schema: &str, text: &[u8]) {
        // To read it runs what is the user's, on a thread of Zenoh's.
        let read = catch_unwind(AssertUnwindSafe(|| self.read(schema, text)));
        let event = match read.unwrap_or_else(|_| Err("to read it has panicked".into())) {
            Ok(event) => event,
            Err(why) => {
                return self.tell(|waiting| {
                    waiting.misfits += 1;
                    waiting.why = why;
                });
            }
        };
        self.tell(|waiting| {
            waiting.bytes += text.len();
            waiting.events.push_back((event, text.len()));
            while waiting.events.len() > WAITING_MAX
                || waiting.events.len() > 1 && waiting.bytes > WAITING_BYTES_MAX
            {
                waiting.pop();
                waiting.displaced += 1;
            }
        });
    }

    fn refuse(&self, size: Option<usize>) {
        self.tell(|waiting| match size {
            Some(size) => {
                waiting.too_large += 1;
                waiting.why = format!("{size} bytes, where at most {} are taken", self.limit());
            }
            None => {
                waiting.misfits += 1;
                waiting.why = "a deletion, and the key is a topic's".into();
            }
        });
    }
}

impl<E> Incoming<E> {
    fn pop(&mut self) -> Option<E> {
        let (event, bytes) = self.events.pop_front()?;
        self.bytes -= bytes;
        Some(event)
    }
}

/// Publishes what others write to one key.
pub(crate) struct ZenohInlet<E: Event> {
    queue: Arc<InletQueue<E>>,
    topic: String,
    /// When values were refused last, while the fault stands.
    last_refusal: Option<blastema::Instant>,
}

impl<E: Event> ZenohInlet<E> {
    pub(crate) fn new(queue: Arc<InletQueue<E>>, topic: &str) -> Self {
        ZenohInlet { queue, topic: topic.to_owned(), last_refusal: None }
    }

    /// Counts and reports what was refused.
    fn report(&mut self, cx: &mut Context<Self>) {
        let mut waiting = self.queue.lock();
        let Incoming { displaced, too_large, misfits, .. } = &mut *waiting;
        let [displaced, too_large, misfits] = [displaced, too_large, misfits].map(std::mem::take);
        let why = waiting.why.clone();
        drop(waiting);
        let limit = text_limit(E::MAX_SIZE);
        cx.count_undelivered::<E>(&DeliveryError::Full, displaced);
        cx.count_undelivered::<E>(&DeliveryError::TooLarge { limit }, too_large);
        let reason = String::new();
        cx.count_undelivered::<E>(&DeliveryError::Undecodable { reason }, misfits);
        let refused = too_large + misfits;
        if refused > 0 {
            let key = &self.queue.key;
            let detail = format!("{refused} refused of what was written to {key}; the last: {why}");
            cx.declare_fault(FaultKind::CheckFailed, detail);
            self.last_refusal = Some(cx.now());
        } else if self.last_refusal.is_some_and(|last| cx.now() - last >= OVER_AFTER) {
            cx.clear_fault(FaultKind::CheckFailed);
            self.last_refusal = None;
        }
    }
}

impl<E: Event> Component for ZenohInlet<E> {
    async fn on_startup(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let publisher = cx.publisher::<E>(&self.topic)?;
        cx.spawn(publish(self.queue.clone(), publisher));
        cx.every(REPORT_EVERY, Self::report);
        Ok(())
    }
}

/// Publishes what comes, as much as each span allows, for ever.
async fn publish<E: Event>(queue: Arc<InletQueue<E>>, publisher: Publisher<E>) {
    loop {
        let mut published = 0;
        while published < BATCH {
            // The lock is not held while listeners are served.
            let Some(event) = queue.lock().pop() else { break };
            if publisher.publish(event).is_err() {
                queue.lock().displaced += 1;
            }
            published += 1;
        }
        match published {
            0 => queue.more.notified().await,
            _ => blastema::sleep(SPAN).await,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema::{Event, Structure};
    use serde_json::{Value, json};
    use std::collections::BTreeMap;

    #[derive(Clone, Debug, PartialEq, Structure)]
    enum Tool {
        None,
        Gripper { width: f32 },
        Welder(u8, u8),
        Named(String),
    }

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "inlet/arm", version = 3, max_size = 256)]
    struct Arm {
        #[contract(unit = "rad", frame = "base")]
        joints: [f64; 2],
        tool: Tool,
        load: Option<u16>,
        reach: Option<f32>,
        labels: BTreeMap<u8, String>,
        raw: Vec<u8>,
        large: u128,
        after: Duration,
        next: Option<Box<Next>>,
    }

    #[derive(Clone, Debug, PartialEq, Structure)]
    struct Next {
        x: i8,
        then: Option<Box<Next>>,
    }

    fn arm() -> Arm {
        let last = Next { x: -3, then: None };
        Arm {
            joints: [0.5, -1.25],
            tool: Tool::Gripper { width: 0.25 },
            load: Some(7),
            reach: Some(0.1),
            labels: [(3, "three".to_owned())].into(),
            raw: vec![0, 255],
            large: u128::MAX,
            after: Duration::from_millis(1500),
            next: Some(Box::new(Next { x: 127, then: Some(Box::new(last)) })),
        }
    }

    fn queue() -> InletQueue<Arm> {
        InletQueue::new("ranger/arm", BridgedContract::of::<Arm>().unwrap())
    }

    /// The event's JSON with one place changed.
    fn changed(pointer: &str, to: Value) -> String {
        let mut value = serde_json::to_value(Arm { large: 0, ..arm() }).unwrap();
        *value.pointer_mut(pointer).unwrap() = to;
        value.to_string()
    }

    #[test]
    fn what_an_outlet_writes_an_inlet_reads() {
        let queue = queue();
        let mut events = vec![arm()];
        for tool in [Tool::None, Tool::Welder(1, 2), Tool::Named("drill".into())] {
            events.push(Arm { tool, load: None, next: None, ..arm() });
        }
        for event in events {
            let text = serde_json::to_vec(&event).unwrap();
            assert_eq!(queue.read("inlet/arm@3", &text), Ok(event));
        }
    }

    #[test]
    fn what_does_not_fit_is_named_by_its_place() {
        let queue = queue();
        let refused = |text: &str, says: &str| {
            let why = queue.read("", text.as_bytes()).unwrap_err();
            assert!(why.contains(says), "{why}");
        };
        refused("{", "EOF");
        refused("7", "invalid type: integer `7`");
        refused("{} {}", "missing field `joints`");
        refused(&format!("{} {{}}", changed("/load", json!(7))), "trailing characters");
        refused(
            &changed("/joints/1", json!("left")),
            r#"`joints[1]`: invalid type: string "left""#,
        );
        refused(&changed("/joints", json!([1.0])), "`joints`: invalid length 1");
        refused(&changed("/load", json!(70_000)), "`load`: invalid value: integer `70000`");
        refused(&changed("/load", json!(1.5)), "`load`: invalid type: floating point `1.5`");
        refused(&changed("/tool", json!("Griper")), "`tool`: unknown variant `Griper`");
        refused(&changed("/tool", json!("Gripper")), "`tool.Gripper`: invalid type: unit variant");
        refused(&changed("/tool", json!({ "None": 1 })), "`tool.None`: invalid type");
        refused(&changed("/tool/Gripper/width", json!(1e300)), "`tool.Gripper.width`: number out");
        refused(&changed("/reach", json!(1e300)), "`reach`: number out of range");
        refused(
            &changed("/tool", json!({ "Welder": [1, 256] })),
            "`tool.Welder[1]`: invalid value",
        );
        refused(
            &changed("/labels", json!({ "many": "" })),
            "`labels.?`: invalid value: expected key",
        );
        refused(&changed("/raw", json!(1)), "`raw`: invalid type: integer `1`");
        refused(&changed("/load", json!("a".repeat(1000))), "`load`: invalid type: string");
        refused(&changed("/after", json!(1.5)), "`after`: invalid type");
        refused(&changed("/next/then/x", json!(-129)), "`next.then.x`: invalid value");
        refused(&changed("/next", json!({ "then": null })), "`next`: missing field `x`");
        let more = json!({ "x": 1, "then": null, "y": 2 });
        refused(&changed("/next", more), "`next.y` is no field of the contract");
        refused(&changed("/raw", json!(vec![255; 300])), "more than the 256 bytes");
        let deep = "[".repeat(100_000);
        refused(&deep, "`[0][0]`: invalid type: sequence");

        let text = serde_json::to_vec(&arm()).unwrap();
        let why = queue.read("inlet/arm@2", &text).unwrap_err();
        assert!(why.contains("\"inlet/arm@2\", and this key carries \"inlet/arm@3\""), "{why}");
    }

    #[test]
    fn what_waits_is_bounded_and_what_is_refused_is_counted() {
        let queue = queue();
        let text = serde_json::to_vec(&arm()).unwrap();
        for _ in 0..WAITING_MAX + 5 {
            queue.receive("", &text);
        }
        queue.receive("", b"{}");
        queue.refuse(None);
        queue.refuse(Some(1 << 30));
        let waiting = queue.lock();
        assert_eq!((waiting.events.len(), waiting.displaced), (WAITING_MAX, 5));
        assert_eq!(waiting.bytes, WAITING_MAX * text.len());
        assert_eq!((waiting.misfits, waiting.too_large), (2, 1));
        assert_eq!(waiting.why, "1073741824 bytes, where at most 16384 are taken");
    }

    #[test]
    fn what_json_cannot_hold_is_refused_before_it_is_bridged() {
        #[derive(Clone, Debug, Event)]
        #[contract(name = "inlet/keys")]
        struct Keys {
            map: BTreeMap<(u8, u8), u8>,
        }
        #[derive(Clone, Debug, Event)]
        #[contract(name = "inlet/options")]
        struct Options {
            both: Option<Option<u8>>,
        }
        let why = BridgedContract::of::<Keys>().unwrap_err();
        assert!(why.contains("inlet/keys as JSON: a map's keys are texts"), "{why}");
        let why = BridgedContract::of::<Options>().unwrap_err();
        assert!(why.contains("an option of an option"), "{why}");
        let _ = (Keys { map: BTreeMap::new() }.map, Options { both: None }.both);
    }

    #[test]
    fn the_schema_says_what_fits() {
        let schema = BridgedContract::of::<Arm>().unwrap().schema;
        let schema: Value = serde_json::from_slice(&schema).unwrap();
        assert_eq!(schema["x-contract"]["name"], "inlet/arm");
        assert_eq!(schema["x-contract"]["version"], 3);
        assert_eq!(schema["required"].as_array().unwrap().len(), 6);
        assert_eq!(schema["properties"]["joints"]["x-unit"], "rad");
        assert_eq!(schema["properties"]["joints"]["x-frame"], "base");
        let resolved = |of: &Value| {
            let place = of["$ref"].as_str().unwrap().trim_start_matches('#');
            schema.pointer(place).unwrap().clone()
        };
        let joints = resolved(&schema["properties"]["joints"]);
        assert_eq!((&joints["minItems"], &joints["items"]["x-type"]), (&json!(2), &json!("f64")));
        let tool = resolved(&schema["properties"]["tool"]);
        assert_eq!(tool["oneOf"][0], json!({ "const": "None" }));
        assert_eq!(tool["oneOf"][2]["properties"]["Welder"]["maxItems"], 2);
        let load = resolved(&schema["properties"]["load"]);
        assert_eq!(load["anyOf"][0]["maximum"], 65_535);
    }
}
