//! No two incarnations of one component have one number, in whatever way they begin.

use super::{Add, Boom, ChildOrder, GRANT, Slow, Stage, acc, boom};
use crate::arbiter::pool::ArbiterPool;
use crate::{ChildSpec, Component, Context, DeliveryError, Failure, Handle, Incarnation, Ports};
use blastema_contract::child::ChildEvent;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_order_during_a_restart_by_the_guard_has_its_own_number() {
    let stage = Stage::new();
    let (spec, _) = acc("acc");
    let (mut child, acc) = stage.start(spec).await;
    child.order(GRANT);
    acc.tell(boom("one")).unwrap();
    assert_eq!(
        acc.ask(Slow(0)).await,
        Ok(2000),
        "the second incarnation, which no supervisor knows of"
    );

    // The supervisor still knows the first one, and wants it replaced.
    child.order(ChildOrder::Abandon);
    let begun = child.start(Incarnation(2), stage.reports.recipient().into());

    assert_eq!(begun, Incarnation(3));
    assert_eq!(acc.ask(Slow(0)).await, Ok(3000));
    let started = stage.reports.wait(|report| report.incarnation == begun).await;
    assert_eq!(started.event, ChildEvent::Started);
    assert_eq!(acc.ask(Add(0)).await, Ok(3000), "one incarnation serves");
}

type Incarnations = Arc<Mutex<Vec<Incarnation>>>;

/// Notes each of its incarnations.
struct Census(Incarnations);

impl Component for Census {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Boom>().serve::<Add>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0.lock().unwrap().push(cx.incarnation());
        Ok(())
    }
}

impl Handle<Boom> for Census {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

impl Handle<Add> for Census {
    async fn handle(&mut self, Add(_): Add, cx: &mut Context<Self>) -> u64 {
        cx.incarnation().0
    }
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_panic_and_an_order_at_once_make_no_two_equal_incarnations() {
        let stage = Stage::on(ArbiterPool::pool(2));
        let incarnations = Incarnations::default();
        let kept = incarnations.clone();
        let spec = ChildSpec::new("census", move || Census(kept.clone()))
            .queue(64, crate::WhenFull::Refuse);
        let (mut child, census) = stage.start(spec).await;
        for round in 0..200_u64 {
            child.order(GRANT);
            let _ = census.tell(boom("struck"));
            // Sooner or later than the panic, from round to round.
            (0..20 * (round % 50)).for_each(|_| std::hint::spin_loop());
            child.order(ChildOrder::Abandon);
            // A component whose handlers keep four threads gets no more, and threads that the
            // system does not run just then are kept.
            while stage.environment.arbiters.check_share(child.name()).is_err() {
                std::thread::yield_now();
            }
            let known = Incarnation(1 + round);
            let begun = child.start(known, stage.reports.recipient().into());
            let answered = loop {
                match census.ask_within(Add(0), Duration::from_secs(30)).await {
                    Ok(incarnation) => break Incarnation(incarnation),
                    Err(error)
                        if matches!(
                            error.kind,
                            DeliveryError::PeerDied { .. } | DeliveryError::Restarting
                        ) => {}
                    Err(error) => panic!("{error}"),
                }
            };
            assert!(answered >= begun, "{answered} answers, and {begun} was begun");
        }
        drop(child);
        stage.environment.arbiters.stop();

        let mut begun = incarnations.lock().unwrap().clone();
        let count = begun.len();
        begun.sort_unstable();
        begun.dedup();
        assert_eq!(begun.len(), count, "each incarnation has a number of its own");
    }
}
