//! The test of a component that the manual shows, word for word from the first `use` on.

use blastema::prelude::*;
use blastema_testkit::Harness;
use std::time::Duration;

#[derive(Clone, Debug, Event)]
struct Bumper;

#[derive(Clone, Debug, Event)]
struct Stop;

/// Stops the robot for as long as it hears nothing of the bumper.
struct Safety {
    heard: bool,
}

impl Component for Safety {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        if !std::mem::take(&mut self.heard) {
            cx.publish(Stop);
        }
        Ok(())
    }
}

impl Handle<Bumper> for Safety {
    async fn handle(&mut self, _: Bumper, _: &mut Context<Self>) {
        self.heard = true;
    }
}

#[blastema_testkit::test]
async fn a_silent_bumper_stops_the_robot() {
    let spec = ChildSpec::new("safety", || Safety { heard: true }).rate_hz(10.0);
    let mut safety = Harness::start(spec).await;
    let stops = safety.listen::<Stop>().await;

    safety.tell(Bumper).unwrap();
    stops.expect_none_for(Duration::from_millis(150)).await;

    safety.advance(Duration::from_secs(60)).await; // A minute, in no time.
    assert_eq!(stops.drain().len(), 600);
    safety.expect_no_faults().await;
}
