//! Nodes of different releases: the newer one converts, at the receiver.

use super::*;
use crate::topic::Topics;

/// The first release.
mod one {
    use crate::{Event, Request};

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "speed")]
    pub(super) struct Speed {
        pub(super) mm_per_s: u32,
    }

    #[derive(Clone, Debug, PartialEq, Request)]
    #[contract(name = "limit", reply = u32)]
    pub(super) struct Limit(pub(super) u32);
}

/// The second.
mod two {
    use super::one;
    use crate::{Event, Request, Structure};

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "speed", version = 2, from = one::Speed)]
    pub(super) struct Speed {
        #[contract(unit = "m/s")]
        pub(super) forward: f64,
    }

    impl From<one::Speed> for Speed {
        fn from(old: one::Speed) -> Self {
            Speed { forward: f64::from(old.mm_per_s) / 1000.0 }
        }
    }

    #[derive(Clone, Debug, PartialEq, Structure)]
    pub(super) struct Granted {
        pub(super) mm_per_s: u32,
        pub(super) reason: String,
    }

    #[derive(Clone, Debug, PartialEq, Request)]
    #[contract(name = "limit", version = 2, from = one::Limit, reply = Granted)]
    pub(super) struct Limit {
        pub(super) wanted: u32,
        pub(super) urgent: bool,
    }

    impl From<one::Limit> for Limit {
        fn from(one::Limit(wanted): one::Limit) -> Self {
            Limit { wanted, urgent: false }
        }
    }

    impl From<Granted> for u32 {
        fn from(granted: Granted) -> Self {
            granted.mm_per_s
        }
    }
}

/// The third.
mod three {
    use super::two;
    use crate::Event;

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "speed", version = 3, from = two::Speed)]
    pub(super) struct Speed {
        #[contract(unit = "m/s")]
        pub(super) forward: f64,
        #[contract(unit = "m/s")]
        pub(super) sideways: f64,
    }

    impl From<two::Speed> for Speed {
        fn from(old: two::Speed) -> Self {
            Speed { forward: old.forward, sideways: 0.0 }
        }
    }
}

/// Holds speeds in millimetres per second.
struct Wheels(Log);

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<two::Limit>().accept::<three::Speed>();
        let _ = ports.listen::<three::Speed>();
    }
}

impl Handle<three::Speed> for Wheels {
    async fn handle(&mut self, speed: three::Speed, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push((speed.forward * 1000.0 + speed.sideways) as u64);
    }
}

impl Handle<two::Limit> for Wheels {
    async fn handle(&mut self, limit: two::Limit, _: &mut Context<Self>) -> two::Granted {
        let mm_per_s = if limit.urgent { 0 } else { limit.wanted / 2 };
        two::Granted { mm_per_s, reason: "half of it".into() }
    }
}

/// Listens by the first release's contract.
struct Old(Log);

impl Component for Old {
    fn ports(ports: &mut Ports<Self>) {
        let _ = ports.accept::<one::Speed>().listen::<one::Speed>();
    }
}

impl Handle<one::Speed> for Old {
    async fn handle(&mut self, speed: one::Speed, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(speed.mm_per_s.into());
    }
}

async fn live<C: Component>(
    module: &Module,
    name: &str,
    make: impl Fn(Log) -> C + Send + Sync + 'static,
) -> (Box<dyn Child>, Log) {
    let begun = module.begin(name, make, ChildSpec::<C>::QUEUE, WhenFull::Refuse).await;
    advance(50 * MS).await;
    begun
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn messages_requests_and_events_of_earlier_releases_are_converted_by_the_receiver() {
    let (_robot, left, right) = pair().await;
    let (_wheels, log) = live(&right, "wheels", Wheels).await;

    let granted = left.sender::<one::Limit>("right:wheels").ask(one::Limit(700)).await;
    assert_eq!(granted.unwrap(), 350, "there and back");

    left.sender("right:wheels").tell(one::Speed { mm_per_s: 1 }).unwrap();
    left.sender("right:wheels").tell(two::Speed { forward: 0.002 }).unwrap();
    let now = three::Speed { forward: 0.0, sideways: 3.0 };
    left.sender("right:wheels").tell(now).unwrap();
    advance(50 * MS).await;
    assert_eq!(log.take(), [1, 2, 3]);

    let old = left.host.feature::<Topics>().publisher::<one::Speed>("speed").unwrap();
    old.publish(one::Speed { mm_per_s: 4 }).unwrap();
    old.publish(one::Speed { mm_per_s: 5 }).unwrap();
    advance(50 * MS).await;
    assert_eq!(log.take(), [4, 5]);
    assert_eq!(left.declared.drain().len() + right.declared.drain().len(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_topic_that_is_known_before_anybody_listens_is_settled_at_once() {
    let (_robot, left, right) = pair().await;
    let old = left.host.feature::<Topics>().publisher::<one::Speed>("speed").unwrap();
    let (_wheels, log) = live(&right, "wheels", Wheels).await;

    old.publish(one::Speed { mm_per_s: 4 }).unwrap();
    advance(50 * MS).await;

    assert_eq!(log.take(), [4]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_is_older_than_the_sender_is_refused_with_the_difference_on_both_sides() {
    let (_robot, left, right) = pair().await;
    let (_old, log) = live(&right, "old", Old).await;

    let new = left.host.feature::<Topics>().publisher::<two::Speed>("speed").unwrap();
    for _ in 0..3 {
        new.publish(two::Speed { forward: 1.0 }).unwrap();
    }
    left.sender("right:old").tell(two::Speed { forward: 1.0 }).unwrap();
    advance(50 * MS).await;

    assert_eq!(log.take(), [0; 0]);
    for module in [&left, &right] {
        let declared = module.declared.drain();
        assert!(declared.len() >= 2, "{declared:?}");
        for fault in declared {
            assert_eq!(fault.kind, FaultKind::ContractMismatch);
            let detail = fault.detail;
            assert!(detail.contains("version") && detail.contains("forward"), "{detail}");
        }
    }
    let speed = ObjectName::new("speed").unwrap();
    let lost = left.host.dead_letters.count(&speed, DeadReason::ContractDiffers);
    assert_eq!((lost, new.matched()), (0, 0), "it is no listener, and misses nothing");
}

/// The first release of what cannot convert thirteen.
mod frail_one {
    use crate::{Event, Request};

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "frail")]
    pub(super) struct Frail(pub(super) u32);

    #[derive(Clone, Debug, PartialEq, Request)]
    #[contract(name = "brittle", reply = u32)]
    pub(super) struct Brittle(pub(super) u32);
}

/// The second.
mod frail_two {
    use super::frail_one;
    use crate::{Event, Request, Structure};

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "frail", version = 2, from = frail_one::Frail)]
    pub(super) struct Frail {
        pub(super) n: u64,
    }

    impl From<frail_one::Frail> for Frail {
        fn from(frail_one::Frail(n): frail_one::Frail) -> Self {
            assert!(n != 13, "thirteen has no like");
            Frail { n: n.into() }
        }
    }

    #[derive(Clone, Debug, PartialEq, Structure)]
    pub(super) struct Splinter {
        pub(super) n: u32,
    }

    #[derive(Clone, Debug, PartialEq, Request)]
    #[contract(name = "brittle", version = 2, from = frail_one::Brittle, reply = Splinter)]
    pub(super) struct Brittle {
        pub(super) n: u32,
    }

    impl From<frail_one::Brittle> for Brittle {
        fn from(frail_one::Brittle(n): frail_one::Brittle) -> Self {
            assert!(n != 13, "thirteen has no like");
            Brittle { n }
        }
    }

    impl From<Splinter> for u32 {
        fn from(splinter: Splinter) -> Self {
            assert!(splinter.n != 14, "nor has fourteen");
            splinter.n
        }
    }
}

struct Glass(Log);

impl Component for Glass {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<frail_two::Frail>().serve::<frail_two::Brittle>();
        let _ = ports.listen::<frail_two::Frail>();
    }
}

impl Handle<frail_two::Frail> for Glass {
    async fn handle(&mut self, frail: frail_two::Frail, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(frail.n);
    }
}

impl Handle<frail_two::Brittle> for Glass {
    async fn handle(
        &mut self,
        frail_two::Brittle { n }: frail_two::Brittle,
        _: &mut Context<Self>,
    ) -> frail_two::Splinter {
        frail_two::Splinter { n }
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_conversion_that_panics_is_the_receivers_fault_and_costs_that_message_alone() {
    let (_robot, left, right) = pair().await;
    let (_glass, log) = live(&right, "glass", Glass).await;
    let glass = left.sender::<frail_one::Frail>("right:glass");
    let brittle = left.sender::<frail_one::Brittle>("right:glass");
    let topic = left.host.feature::<Topics>().publisher::<frail_one::Frail>("frail").unwrap();

    [1, 13, 2].into_iter().for_each(|n| glass.tell(frail_one::Frail(n)).unwrap());
    advance(50 * MS).await;
    [3, 13, 4].into_iter().for_each(|n| topic.publish(frail_one::Frail(n)).unwrap());
    advance(50 * MS).await;
    assert_eq!(log.take(), [1, 2, 3, 4]);
    // Often enough for a fault of the sender's node, if it were its mistake.
    for _ in 0..6 {
        let refused = brittle.ask(frail_one::Brittle(13)).await.unwrap_err().kind;
        let DeliveryError::CheckFailed { reason } = &refused else { panic!("{refused}") };
        assert!(reason.contains("versions.rs"), "{reason}");
    }
    let refused = brittle.ask(frail_one::Brittle(14)).await.unwrap_err().kind;
    let text = refused.to_string();
    for part in [
        "the request took effect, but its reply cannot be sent: the conversion of a reply to brittle panicked at",
        "versions.rs",
    ] {
        assert!(text.contains(part), "{text}");
    }
    assert_eq!(refused.outcome(), blastema_core::Outcome::TookEffect);
    assert_eq!(brittle.ask(frail_one::Brittle(5)).await, Ok(5));

    assert!(right.exits.drain().is_empty(), "nothing of the middleware died");
    let declared = right.declared.drain();
    assert_eq!(declared.len(), 8, "{declared:?}");
    let blamed = |report: &NodeReported| {
        matches!(report.condition, NodeCondition::Offends { .. }).then(|| report.node.clone())
    };
    assert_eq!(right.nodes.drain().iter().filter_map(blamed).next(), None);
    for fault in declared {
        assert_eq!(fault.object.as_str(), "glass");
        assert_eq!(fault.kind, FaultKind::CheckFailed);
    }
    let count = |name| {
        let name = ObjectName::new(name).unwrap();
        right.host.dead_letters.count(&name, DeadReason::Refused)
    };
    assert_eq!((count("glass"), count("frail")), (7, 1));
}
