//! Handlers that burn 10 to 30 ms on threads that they share, judged by counts and order.

use super::{ChildOrder, Log, Stage, logged};
use crate::arbiter::pool::ArbiterPool;
use crate::topic::Topics;
use crate::{ChildSpec, Component, Context, Event, Failure, Handle, Ports, WhenFull};
use blastema_contract::child::ChildEvent;
use blastema_core::Contract;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// What happened on a thread, in order.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    Round,
    Work,
}

type Steps = Arc<Mutex<Vec<Step>>>;

fn burn(millis: u64) {
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(millis) {
        std::hint::spin_loop();
    }
}

/// Takes 30 ms of the thread.
#[derive(Clone, Event)]
struct Load;

struct Busy(Steps);
impl Component for Busy {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Load>();
        ports.listen::<Load>();
    }
}
impl Handle<Load> for Busy {
    async fn handle(&mut self, _: Load, _: &mut Context<Self>) {
        burn(30);
        self.0.lock().unwrap().push(Step::Work);
    }
}

/// Has rounds of its own, 50 a second.
struct Safety(Steps);
impl Component for Safety {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.lock().unwrap().push(Step::Round);
        Ok(())
    }
}

/// Burns in tasks of its own, of which there are five.
struct Tasked(Steps);
impl Component for Tasked {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        for _ in 0..5 {
            let steps = self.0.clone();
            cx.spawn(async move {
                loop {
                    burn(30);
                    steps.lock().unwrap().push(Step::Work);
                    tokio::task::yield_now().await;
                }
            });
        }
        Ok(())
    }
}

fn busy(name: &str, steps: &Steps) -> ChildSpec<Busy> {
    let steps = steps.clone();
    let make = move || Busy(steps.clone());
    ChildSpec::new(name, make).queue(64, WhenFull::DropNewest)
}

fn safety(steps: &Steps) -> ChildSpec<Safety> {
    let steps = steps.clone();
    ChildSpec::new("safety", move || Safety(steps.clone())).rate_hz(50.0)
}

/// Waits until so much work is done.
async fn worked(steps: &Steps, times: usize) {
    let done = || steps.lock().unwrap().iter().filter(|step| **step == Step::Work).count();
    while done() < times {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// The longest run of work between two rounds. Before the first round nothing is promised.
fn longest(steps: &Steps) -> usize {
    let steps = steps.lock().unwrap().clone();
    let since = steps.iter().position(|step| *step == Step::Round).expect("a round");
    let runs = steps[since..].split(|step| *step == Step::Round);
    runs.map(<[Step]>::len).max().unwrap_or(0)
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn between_two_rounds_of_its_neighbour_a_busy_component_serves_one_message() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let steps = Steps::default();
        let (_safety, _) = stage.start(safety(&steps)).await;
        let (_busy, busy) = stage.start(busy("busy", &steps)).await;
        (0..40).for_each(|_| busy.tell(Load).unwrap());

        worked(&steps, 30).await;

        assert!(longest(&steps) <= 1, "{steps:?}");
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn two_that_send_to_each_other_leave_their_neighbour_its_rounds() {
        struct Player {
            steps: Steps,
            to: &'static str,
        }
        impl Component for Player {
            fn ports(ports: &mut Ports<Self>) {
                ports.accept::<Load>();
            }
        }
        impl Handle<Load> for Player {
            async fn handle(&mut self, _: Load, cx: &mut Context<Self>) {
                burn(30);
                self.steps.lock().unwrap().push(Step::Work);
                let _ = cx.sender::<Load>(self.to).map(|to| to.tell(Load));
            }
        }
        let stage = Stage::on(ArbiterPool::pool(1));
        let steps = Steps::default();
        let player = |name, to| {
            let steps = steps.clone();
            ChildSpec::new(name, move || Player { steps: steps.clone(), to })
        };
        let (_safety, _) = stage.start(safety(&steps)).await;
        let (_ping, ping) = stage.start(player("ping", "pong")).await;
        let (_pong, _) = stage.start(player("pong", "ping")).await;
        ping.tell(Load).unwrap();

        worked(&steps, 30).await;

        assert!(longest(&steps) <= 2, "one of each: {steps:?}");
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn listeners_serve_one_event_each_between_rounds_of_a_neighbour() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let steps = Steps::default();
        let (_safety, _) = stage.start(safety(&steps)).await;
        let (_one, _) = stage.start(busy("one", &steps)).await;
        let (_two, _) = stage.start(busy("two", &steps)).await;
        let publisher =
            stage.environment.feature::<Topics>().publisher::<Load>(Load::NAME).unwrap();
        (0..16).for_each(|_| publisher.publish(Load).unwrap());

        worked(&steps, 32).await;

        assert!(longest(&steps) <= 2, "{steps:?}");
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn between_two_rounds_of_its_neighbour_one_task_of_a_component_runs() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let steps = Steps::default();
        let (_safety, _) = stage.start(safety(&steps)).await;
        let kept = steps.clone();
        let spec = ChildSpec::new("tasked", move || Tasked(kept.clone()));
        let (mut tasked, _) = stage.start(spec).await;

        worked(&steps, 30).await;

        assert!(longest(&steps) <= 1, "{steps:?}");
        tasked.order(ChildOrder::Stop { again: false });
        stage.reports.wait(|report| report.event == ChildEvent::Stopped).await;
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_busy_component_stops_after_one_further_handler() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let steps = Steps::default();
        let (mut child, busy) = stage.start(busy("busy", &steps)).await;
        (0..60).for_each(|_| busy.tell(Load).unwrap());
        worked(&steps, 5).await;

        let before = steps.lock().unwrap().len();
        child.order(ChildOrder::Stop { again: false });
        stage.reports.wait(|report| report.event == ChildEvent::Stopped).await;

        let after = steps.lock().unwrap().len();
        assert!(after - before <= 2, "the one in service, and one more: {before}, {after}");
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_component_whose_rounds_and_tasks_take_all_the_time_still_serves_messages() {
        struct Both(Steps, Log);
        impl Component for Both {
            fn ports(ports: &mut Ports<Self>) {
                ports.accept::<Load>();
            }
            async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
                let steps = self.0.clone();
                cx.spawn(async move {
                    loop {
                        burn(10);
                        steps.lock().unwrap().push(Step::Work);
                        tokio::task::yield_now().await;
                    }
                });
                Ok(())
            }
            async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
                burn(10);
                self.0.lock().unwrap().push(Step::Round);
                Ok(())
            }
        }
        impl Handle<Load> for Both {
            async fn handle(&mut self, _: Load, _: &mut Context<Self>) {
                self.1.lock().unwrap().push(1);
            }
        }
        let stage = Stage::on(ArbiterPool::pool(1));
        let (steps, served) = (Steps::default(), Log::default());
        let (kept, log) = (steps.clone(), served.clone());
        let spec = ChildSpec::new("both", move || Both(kept.clone(), log.clone())).rate_hz(200.0);
        let (_both, both) = stage.start(spec).await;
        (0..5).for_each(|_| both.tell(Load).unwrap());

        worked(&steps, 15).await;

        assert_eq!(logged(&served), [1; 5]);
        assert!(steps.lock().unwrap().contains(&Step::Round));
        stage.environment.arbiters.stop();
    }
}
