//! The log of messages.

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
    /// The steps in order, with what is reported beside.
    fn steps(&self) -> Vec<String> {
        let told = |line: Line| {
            let fields = ["from", "reason"].into_iter().filter_map(|field| {
                let text = line.get(field).filter(|text| !text.is_empty())?;
                Some(format!(", {field} {text}"))
            });
            format!("{} {}{}", line["step"], line["to"], fields.collect::<String>())
        };
        self.0.lock().unwrap().drain(..).map(told).collect()
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
async fn a_message_is_logged_where_it_is_sent_where_it_is_served_and_where_it_is_lost() {
    let log = Collector::default();
    let _kept = tracing::subscriber::set_default(log.clone());
    let sum = ChildSpec::new("sum", || Sum(0));
    let builder = Node::builder("module1").child(sum).child(ChildSpec::new("caller", || Caller));
    let node = TestNode::start(builder).await;
    let sum = node.sender::<Add>("sum").unwrap();
    log.steps();

    sum.ask(Add(1)).await.unwrap();
    assert_eq!(log.steps(), ["sent sum", "begun sum"]);

    node.sender("caller").unwrap().tell(Go).unwrap();
    node.advance(MS).await;
    let way = ["sent caller", "begun caller", "sent sum, from caller", "begun sum"];
    assert_eq!(log.steps(), way);

    node.publisher("test/note").unwrap().publish(Note(1)).unwrap();
    node.advance(MS).await;
    assert_eq!(log.steps(), ["sent test/note, from module1", "begun sum"]);

    sum.ask(Add(100)).await.unwrap_err();
    assert_eq!(log.steps(), ["sent sum", "begun sum", "dead letter sum, reason receiver died"]);

    node.shutdown().await;
    let stopped = sum.tell(Add(1)).unwrap_err().kind;
    assert_eq!(log.steps(), ["sent sum".to_owned(), format!("refused sum, reason {stopped}")]);
}
