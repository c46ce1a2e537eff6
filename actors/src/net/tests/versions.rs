//! Nodes whose programs have different forms of one contract, and messages that cannot be read.

use super::*;
use crate::Structure;
use std::cmp::Ordering;
use std::collections::BTreeSet;

/// The first release.
mod one {
    use crate::Event;

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "speed")]
    pub(super) struct Speed {
        pub(super) mm_per_s: u32,
    }
}

/// The second.
mod two {
    use crate::Event;

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "speed", version = 2)]
    pub(super) struct Speed {
        #[contract(unit = "m/s")]
        pub(super) forward: f64,
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

async fn live(module: &Module, spec: ChildSpec<impl Component>) -> Box<dyn Child> {
    let (mut child, _) = spec.into_child(&module.host).unwrap();
    child.start(Incarnation(1), Probe::<ChildReport>::start().recipient().into());
    advance(50 * MS).await;
    child
}

#[test]
fn a_sender_of_another_version_is_refused_with_the_difference_on_both_sides() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let log = Log::default();
        let kept = log.clone();
        let _old = live(&right, ChildSpec::new("old", move || Old(kept.clone()))).await;

        let new = left.host.topics().publisher::<two::Speed>("speed").unwrap();
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
    });
}

/// The sender's form of what the receiver cannot sort.
mod sorted {
    use crate::{Event, Structure};
    use std::collections::BTreeSet;

    #[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Structure)]
    pub(super) struct Part(pub(super) u32);

    #[derive(Clone, Debug, PartialEq, Event)]
    #[contract(name = "frail")]
    pub(super) struct Frail(pub(super) BTreeSet<Part>);
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Structure)]
struct Part(u32);

impl Ord for Part {
    fn cmp(&self, other: &Self) -> Ordering {
        assert!(self.0 != 13 && other.0 != 13, "thirteen has no like");
        self.0.cmp(&other.0)
    }
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "frail")]
struct Frail(BTreeSet<Part>);

struct Glass(Log);

impl Component for Glass {
    fn ports(ports: &mut Ports<Self>) {
        let _ = ports.accept::<Frail>().listen::<Frail>();
    }
}

impl Handle<Frail> for Glass {
    async fn handle(&mut self, Frail(parts): Frail, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(parts.iter().map(|part| u64::from(part.0)).sum());
    }
}

#[test]
fn a_message_whose_reading_panics_is_the_receivers_fault_and_costs_that_message_alone() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let log = Log::default();
        let kept = log.clone();
        let _glass = live(&right, ChildSpec::new("glass", move || Glass(kept.clone()))).await;
        let glass = left.sender::<sorted::Frail>("right:glass");
        let topic = left.host.topics().publisher::<sorted::Frail>("frail").unwrap();
        let frail = |n| sorted::Frail([0, n].map(sorted::Part).into());

        [1, 13, 2].into_iter().for_each(|n| glass.tell(frail(n)).unwrap());
        advance(50 * MS).await;
        [3, 13, 4].into_iter().for_each(|n| topic.publish(frail(n)).unwrap());
        advance(50 * MS).await;

        assert_eq!(log.take(), [1, 2, 3, 4]);
        assert!(right.exits.drain().is_empty(), "nothing of the middleware died");
        let declared = right.declared.drain();
        assert_eq!(declared.len(), 1, "{declared:?}");
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
        assert_eq!((count("glass"), count("frail")), (1, 1));
    });
}
