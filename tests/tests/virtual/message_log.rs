//! The log of messages.

use blastema::prelude::*;
use blastema_testkit::TestNode;
use blastema_tests::{LogLine, LogLines, MS, accepts};
use tracing::Level;

/// The steps since the last look in order, with what is reported beside.
fn steps(log: &LogLines) -> Vec<String> {
    let told = |line: LogLine| {
        let fields = ["from", "reason"].into_iter().filter_map(|field| {
            let text = line.get(field).filter(|text| !text.is_empty())?;
            Some(format!(", {field} {text}"))
        });
        format!("{} {}{}", line["step"], line["to"], fields.collect::<String>())
    };
    log.lines.take().into_iter().map(told).collect()
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

#[blastema_testkit::test]
async fn a_message_is_logged_where_it_is_sent_where_it_is_served_and_where_it_is_lost() {
    let log = LogLines::of(|metadata| {
        metadata.target() == "blastema::message" && *metadata.level() <= Level::DEBUG
    });
    let _kept = tracing::subscriber::set_default(log.clone());
    let sum = ChildSpec::new("sum", || Sum(0));
    let caller = accepts("caller", (), |_, _: Go, cx| {
        cx.sender("sum").unwrap().tell(Add(1)).unwrap();
    });
    let builder = Node::builder("module1").child(sum).child(caller);
    let node = TestNode::start(builder).await;
    let sum = node.sender::<Add>("sum").unwrap();
    steps(&log);

    sum.ask(Add(1)).await.unwrap();
    assert_eq!(steps(&log), ["sent sum", "begun sum"]);

    node.sender("caller").unwrap().tell(Go).unwrap();
    node.advance(MS).await;
    let way = ["sent caller", "begun caller", "sent sum, from caller", "begun sum"];
    assert_eq!(steps(&log), way);

    node.publisher("test/note").unwrap().publish(Note(1)).unwrap();
    node.advance(MS).await;
    assert_eq!(steps(&log), ["sent test/note, from module1", "begun sum"]);

    sum.ask(Add(100)).await.unwrap_err();
    assert_eq!(steps(&log), ["sent sum", "begun sum", "dead letter sum, reason receiver died"]);

    node.shutdown().await;
    let stopped = sum.tell(Add(1)).unwrap_err().kind;
    assert_eq!(steps(&log), ["sent sum".to_owned(), format!("refused sum, reason {stopped}")]);
}
