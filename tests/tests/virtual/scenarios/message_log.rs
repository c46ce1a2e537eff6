//! The log of messages.

use crate::scenarios::puppet::{Deed, Do, News, Strings, ask};
use blastema_tests::{LogLine, LogLines};
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

#[blastema_testkit::test]
async fn a_message_is_logged_where_it_is_sent_where_it_is_served_and_where_it_is_lost() {
    let log = LogLines::of(|metadata| {
        metadata.target() == "blastema::message" && *metadata.level() <= Level::DEBUG
    });
    // Beside a single subscriber, tracing asks that of the thread which comes to an event first.
    let _second = tracing::Dispatch::new(log.clone());
    let _kept = tracing::subscriber::set_default(log.clone());
    let (strings, node) = Strings::robot(["arm"]).await;
    let arm = node.sender::<Do>("arm").unwrap();
    steps(&log);

    arm.ask(Do(Deed::Nothing)).await.unwrap();
    assert_eq!(steps(&log), ["sent arm", "begun arm"]);

    node.publisher("test/news").unwrap().publish(News(1)).unwrap();
    node.settle().await;
    assert_eq!(steps(&log), ["sent test/news, from module1", "begun arm"]);

    node.add_child(strings.spec("caller")).await.unwrap();
    ask(&node, "caller", Deed::Consult("arm".into())).await.unwrap();
    let way = ["sent caller", "begun caller", "sent arm, from caller", "begun arm"];
    assert_eq!(steps(&log), way);

    arm.ask(Do(Deed::Panic("struck".into()))).await.unwrap_err();
    assert_eq!(steps(&log), ["sent arm", "begun arm", "dead letter arm, reason receiver died"]);

    node.shutdown().await;
    let stopped = arm.tell(Do(Deed::Nothing)).unwrap_err().kind;
    assert_eq!(steps(&log), ["sent arm".to_owned(), format!("refused arm, reason {stopped}")]);
}
