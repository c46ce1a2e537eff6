//! A component that gets more than it can serve, beside one that has to keep its rounds.

use blastema::prelude::*;
use blastema_tests::{accepts, burn};
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    Round,
    Work,
}

type Steps = Arc<Mutex<Vec<Step>>>;

/// Needs 30 ms of its receiver's thread.
#[derive(Clone, Event)]
struct Load;

struct Safety(Steps);
impl Component for Safety {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.lock().unwrap().push(Step::Round);
        Ok(())
    }
}

#[test]
fn a_safety_component_has_its_round_between_any_two_messages_of_an_overloaded_neighbour() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let steps = Steps::default();
        let (worked, rounds) = (steps.clone(), steps.clone());
        let busy = accepts("busy", worked, |steps, _: Load, _| {
            burn(Duration::from_millis(30));
            steps.lock().unwrap().push(Step::Work);
        });
        let safety = ChildSpec::new("safety", move || Safety(rounds.clone()));
        let node = Node::builder("module1")
            .work_threads(1)
            .child(busy.queue(64, WhenFull::DropOldest))
            .child(safety.rate_hz(50.0))
            .start()
            .await
            .unwrap();
        let load = node.sender::<Load>("busy").unwrap();
        let work = || steps.lock().unwrap().iter().filter(|step| **step == Step::Work).count();

        (0..10).for_each(|_| load.tell(Load).unwrap());
        while work() < 40 {
            load.tell(Load).unwrap();
            tokio::time::sleep(Duration::from_millis(25)).await; // 40 a second
        }
        let seen = steps.lock().unwrap().clone();
        let before = seen.len();
        node.shutdown().await;

        let first = seen.iter().position(|step| *step == Step::Round).unwrap();
        let most = seen[first..].split(|step| *step == Step::Round).map(<[Step]>::len).max();
        assert!(most <= Some(1), "{seen:?}");
        let after = steps.lock().unwrap()[before..].to_vec();
        let further = after.iter().filter(|step| **step == Step::Work).count();
        assert!(further < 10, "its queue was not served to the end: {after:?}");
    });
}
