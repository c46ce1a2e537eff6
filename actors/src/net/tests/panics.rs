//! Panics of the network's own actors.

use super::*;
use crate::net::gateway_messages::SendToPeer;
use crate::net::stack::StackOutput;
use crate::registry::ReplyTo;
use blastema_core::net::{NodeId, Router, RouterConfig, RouterOutput, SessionOutput};
use blastema_core::{ContractIdentity, Machine, ObjectAddress, TrafficClass};

fn named(node: &str) -> NodeName {
    NodeName::new(node).unwrap()
}

/// A message to `acc` of that node, for the stack itself.
fn sent<M: Contract>(by: &Module, node: &str, reply_to: Option<ReplyTo>) -> SendToPeer {
    let credits = by.net.stubs.send_state(&named("right"));
    let credit = credits.credits().sender(Some(TrafficClass::Request)).take(1).unwrap();
    let to = ObjectAddress { node: named(node), object: ObjectName::new("acc").unwrap() };
    let (contract, sent, payload) =
        (ContractIdentity::of::<M>(), platform::now(), Vec::new().into());
    SendToPeer { to, contract, id: None, sent, until: None, payload, reply_to, credit }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_panic_in_any_actor_of_the_network_is_survived_and_every_promise_resolved() {
    let (_robot, left, right) = pair().await;
    let count = left.net.victims().len();
    assert_eq!(count, 3);
    for victim in 0..=count {
        for module in [&left, &right] {
            let asked: Vec<_> = (0..10)
                .map(|_| {
                    let sender = left.sender::<Add>("right:acc");
                    actix_rt::spawn(async move { sender.ask_within(Add(1), 60_000 * MS).await })
                })
                .collect();
            match module.net.victims().get(victim) {
                Some(actor) => actor.do_send(InjectPanic),
                None => module.net.panic_sessions(),
            }
            let reported = platform::now();
            for asked in asked {
                // The reply, or why there is none: never nothing.
                let _ = asked.await.unwrap();
            }
            assert!(platform::now() - reported < 3000 * MS, "{victim}");
            advance(2000 * MS).await;

            let reply = left.sender::<Add>("right:acc").ask(Add(0)).await;
            assert!(reply.is_ok(), "{victim}: {reply:?}");
            right.log.take();
            left.publisher().publish(Note(7)).unwrap();
            advance(50 * MS).await;
            assert_eq!(right.log.take(), [7], "{victim}");
        }
    }
    assert_eq!(left.exits.drain().len(), count + 1);
    let lost = left.nodes.drain().into_iter().chain(right.nodes.drain());
    let lost = lost.filter(|report| matches!(report.condition, NodeCondition::Lost { .. }));
    assert_eq!(lost.count(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn any_panic_of_the_stack_builds_its_router_again() {
    let (_robot, left, _right) = pair().await;

    left.net.on_stack(|stack| {
        // A machine that knows of no link, as after changes that a panic has lost.
        let config = RouterConfig::new(named("left"), Incarnation(1));
        stack.floors.router.machine = Router::new(config, platform::now());
        panic!("the sessions panic on purpose");
    });
    advance(2000 * MS).await;

    assert_eq!(left.sender::<Add>("right:acc").ask(Add(1)).await.unwrap(), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_request_is_resolved_whose_resolution_a_panic_has_lost() {
    let (_robot, left, _right) = pair().await;
    let (result, results) = std::sync::mpsc::channel();
    let reply_to: ReplyTo = Box::new(move |reply| drop(result.send(reply)));
    let request = sent::<Add>(&left, "nowhere", Some(reply_to));

    left.net.on_stack(|stack| {
        stack.floors.gateway.handle_send(request);
        let output = stack.floors.gateway.protocol.poll_output();
        panic!("{output:?} panics on purpose");
    });
    settle().await;

    let why = results.try_recv().unwrap().unwrap_err();
    assert!(matches!(why, DeliveryError::OutcomeUnknown { .. }), "{why}");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn several_outputs_that_panic_cost_one_restart() {
    let (_robot, left, _right) = pair().await;
    let requests = [(); 3].map(|()| {
        let reply_to: ReplyTo = Box::new(|_| panic!("the caller panics on purpose"));
        sent::<Add>(&left, "nowhere", Some(reply_to))
    });

    left.net.on_stack(|stack| {
        requests.into_iter().for_each(|request| stack.floors.gateway.handle_send(request));
    });
    advance(1000 * MS).await;

    assert_eq!(left.exits.drain().len(), 1);
    assert_eq!(left.sender::<Add>("right:acc").ask(Add(1)).await.unwrap(), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_node_leaves_in_order_although_its_stack_panics_meanwhile() {
    for waits in [true, false] {
        let (_robot, left, right) = pair().await;
        if waits {
            let message = sent::<Fresh>(&left, "right", None);
            left.net.on_stack(|stack| {
                stack.floors.gateway.handle_send(message);
                // The peer is not asked, and does not agree to the contract.
                while stack.floors.gateway.protocol.poll_output().is_some() {}
            });
        }

        left.net.leave();
        match waits {
            true => left.net.panics().do_send(InjectPanic),
            false => left.net.panic_sessions(),
        }
        advance(1000 * MS).await;

        let why = right.sender::<Add>("left:acc").ask(Add(1)).await.unwrap_err().kind;
        assert_eq!(why, DeliveryError::Left { node: "left".into() }, "it waits: {waits}");
        let reported = right.nodes.drain().into_iter().map(|report| report.condition);
        let reported: Vec<_> = reported.collect();
        use NodeCondition::{InSession, Left, Reachable};
        assert_eq!(reported, [Reachable, InSession, Left], "it waits: {waits}");
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_a_session_does_about_segments_comes_before_a_path_that_is_lost_later() {
    let (_robot, left, _right) = pair().await;
    let (output, outputs) = std::sync::mpsc::channel();

    left.net.on_stack(move |stack| {
        let (floors, right, now) = (&mut stack.floors, named("right"), platform::now());
        let id = NodeId::of(&right);
        floors.gateway.protocol.peers.get_mut(id).unwrap().session.handle_restart(now);
        floors.router.machine.handle_isolation(&right, true, now);
        floors.router.machine.verdict(id, now);
        while let Some(next) = floors.poll_output() {
            let _ = match next {
                StackOutput::Session(_, SessionOutput::Ended { .. }) => output.send("ended"),
                StackOutput::Router(RouterOutput::Lost { .. }) => output.send("lost"),
                _ => Ok(()),
            };
        }
    });
    settle().await;

    assert_eq!(outputs.try_iter().collect::<Vec<_>>(), ["ended", "lost"]);
}
