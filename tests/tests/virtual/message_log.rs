//! One message is followed through the node by its id in the log.

use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::collections::BTreeMap;
use std::fmt::Debug;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Level, Metadata};

const MS: Duration = Duration::from_millis(1);

type Line = BTreeMap<&'static str, String>;

/// Keeps the events about messages.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<Line>>>);

struct Fields(Line);

impl Visit for Fields {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.insert(field.name(), value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.0.insert(field.name(), format!("{value:?}"));
    }
}

impl tracing::Subscriber for Collector {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.target() == "blastema::message" && *metadata.level() <= Level::DEBUG
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &tracing::Event<'_>) {
        let mut fields = Fields(Line::new());
        event.record(&mut fields);
        self.0.lock().unwrap().push(fields.0);
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

impl Collector {
    /// The steps of each message in the order in which they were sent, with what is told of it
    /// beside.
    fn messages(&self) -> Vec<Vec<String>> {
        let mut by_id: BTreeMap<u64, Vec<String>> = BTreeMap::new();
        for line in self.0.lock().unwrap().drain(..) {
            let mut told = format!("{} {}", line["step"], line["to"]);
            for field in ["from", "reason"] {
                let text = line.get(field).filter(|text| !text.is_empty());
                told += &text.map(|text| format!(", {field} {text}")).unwrap_or_default();
            }
            by_id.entry(line["id"].parse().unwrap()).or_default().push(told);
        }
        by_id.into_values().collect()
    }
}

#[derive(Clone, Debug, Request)]
#[contract(name = "test/add", reply = u64)]
struct Add(u64);

#[derive(Clone, Debug, Event)]
#[contract(name = "test/note")]
struct Note(u64);

struct Sum(u64);

impl Component for Sum {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>().listen::<Note>();
    }
}

impl Handle<Add> for Sum {
    async fn handle(&mut self, Add(n): Add, _: &mut Context<Self>) -> u64 {
        assert!(n < 100, "too large");
        self.0 += n;
        self.0
    }
}

impl Handle<Note> for Sum {
    async fn handle(&mut self, _: Note, _: &mut Context<Self>) {}
}

/// Has the sum add.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/go")]
struct Go;

struct Caller;

impl Component for Caller {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Go>();
    }
}

impl Handle<Go> for Caller {
    async fn handle(&mut self, _: Go, cx: &mut Context<Self>) {
        cx.sender("sum").unwrap().tell(Add(1)).unwrap();
    }
}

#[blastema_testkit::test]
async fn a_message_is_followed_by_its_id_from_its_sender_to_its_end() {
    let log = Collector::default();
    let _kept = tracing::subscriber::set_default(log.clone());
    let sum = ChildSpec::new("sum", || Sum(0));
    let builder = Node::builder("module1").child(sum).child(ChildSpec::new("caller", || Caller));
    let node = TestNode::start(builder).await;
    let sum = node.sender::<Add>("sum").unwrap();
    log.messages();

    sum.ask(Add(1)).await.unwrap();
    assert_eq!(log.messages(), [["sent sum", "begun sum", "replied sum"]]);

    node.sender("caller").unwrap().tell(Go).unwrap();
    node.advance(MS).await;
    let go = ["sent caller", "begun caller", "served caller"];
    assert_eq!(log.messages(), [go, ["sent sum, from caller", "begun sum", "served sum"]]);

    node.publisher("test/note").unwrap().publish(Note(1)).unwrap();
    node.advance(MS).await;
    assert_eq!(log.messages(), [["sent test/note, from module1", "begun sum", "served sum"]]);

    let died = sum.ask(Add(100)).await.unwrap_err().kind;
    let lost = format!("dead letter sum, reason {died}");
    assert_eq!(log.messages(), [["sent sum", "begun sum", &*lost]]);

    node.shutdown().await;
    let stopped = sum.tell(Add(1)).unwrap_err().kind;
    let refused = format!("refused sum, reason {stopped}");
    assert_eq!(log.messages(), [["sent sum", &*refused]]);
}
