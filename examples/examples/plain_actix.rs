//! Code that is written for actix takes part: a plain actor is sent to by components, and sends to
//! them. The guarantees for components do not hold for it: it is neither restarted nor watched.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use actix::prelude::{Actor, Handler, Recipient};
use blastema::plain::{self, Deliver, ServeRequest};
use blastema::prelude::*;

/// Something touches the robot.
#[derive(Debug, Request)]
#[contract(name = "bumper/touch", reply = bool)]
struct Touch {
    #[contract(unit = "N")]
    force: f32,
}

/// Says something aloud.
#[derive(Clone, Debug, Event)]
#[contract(name = "speaker/say")]
struct Say {
    text: String,
}

/// A component that warns through a plain actor, and says whether it has.
struct Bumper {
    speaker: Sender<Say>,
}

impl Component for Bumper {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Touch>();
    }
}

impl Handle<Touch> for Bumper {
    async fn handle(&mut self, touch: Touch, _: &mut Context<Self>) -> bool {
        let text = format!("I was touched with {} N", touch.force);
        touch.force > 1.0 && self.speaker.tell(Say { text }).is_ok()
    }
}

/// A plain actix actor: it takes a contract as the actix message `ServeRequest`.
struct Speaker;

impl Actor for Speaker {
    type Context = actix::Context<Self>;
}

impl Handler<ServeRequest<Say>> for Speaker {
    type Result = ();

    fn handle(&mut self, ServeRequest(say): ServeRequest<Say>, _: &mut Self::Context) {
        println!("{}", say.text);
    }
}

/// Answers when all that came before has been said.
#[derive(actix::Message)]
#[rtype(result = "()")]
struct Said;

impl Handler<Said> for Speaker {
    type Result = ();

    fn handle(&mut self, _: Said, _: &mut Self::Context) {}
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let speaker = Speaker.start();
    let say: Sender<Say> = plain::sender(speaker.clone().recipient());
    let node = Node::builder("module1")
        .child(ChildSpec::new("bumper", move || Bumper { speaker: say.clone() }))
        .start()
        .await?;

    // What a plain actor would hold to send to a component.
    let bumper: Recipient<Deliver<Touch>> = plain::recipient(&node.sender("bumper")?);
    for force in [0.1, 3.5] {
        let warned = bumper.send(Deliver(Touch { force })).await??;
        println!("{force} N: warned: {warned}");
    }
    node.shutdown().await;
    speaker.send(Said).await?;
    Ok(())
}
