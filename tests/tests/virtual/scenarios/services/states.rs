//! States that are too large, and components that cannot be built.

use super::*;
use blastema::Outcome;

/// Keeps so many bytes from now on.
#[derive(Clone, Debug, Request)]
#[contract(name = "hoard/keep", reply = u64)]
struct Keep(u64);

struct Hoard(Vec<u8>);

impl Hoard {
    fn of(bytes: usize) -> Self {
        Hoard(vec![1; bytes])
    }
}

impl Component for Hoard {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Keep>();
    }
}

impl Handle<Keep> for Hoard {
    async fn handle(&mut self, keep: Keep, _: &mut Context<Self>) -> u64 {
        let before = self.0.len() as u64;
        self.0.resize(usize::try_from(keep.0).unwrap(), 2);
        before
    }
}

impl Stateful for Hoard {
    fn save(&self) -> Vec<u8> {
        self.0.clone()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        self.0 = state.into();
        Ok(())
    }
}

/// A node that carries a hoard alone.
async fn keeper(bytes: usize) -> TestNode {
    let hoard = ServiceSpec::new("hoard", ["module1"], move || Hoard::of(bytes));
    TestNode::start(Node::builder("module1").service(hoard)).await
}

#[blastema_testkit::test]
async fn a_request_that_makes_a_state_too_large_is_not_taken_however_far_it_goes_beyond() {
    let node = keeper(8).await;
    node.advance(1000 * MS).await;
    let hoard = node.service::<Keep>("hoard").unwrap();
    assert_eq!(hoard.ask(Keep(3_000_000)).await.unwrap(), 8);

    for bytes in [3_500_000, 4_500_000] {
        let failed = hoard.ask(Keep(bytes)).await.unwrap_err();
        assert_eq!(failed.kind, DeliveryError::TooLarge { limit: 3 * 1024 * 1024 }, "{bytes}");
        assert_eq!(failed.outcome(), Outcome::NotTaken);
        assert_eq!(hoard.ask(Keep(3_000_000)).await.unwrap(), 3_000_000, "{bytes} were kept");
    }
    assert!(standing(&node, &FaultKind::CheckFailed).await.is_some());
}

#[blastema_testkit::test]
async fn a_service_whose_first_state_is_too_large_has_a_fault_before_the_first_request() {
    for (bytes, expected) in [(3_000_000, false), (3_500_000, true), (4_500_000, true)] {
        let node = keeper(bytes).await;
        node.advance(1000 * MS).await;

        let fault = standing(&node, &FaultKind::CheckFailed).await;
        assert_eq!(fault.is_some(), expected, "{bytes}: {fault:?}");
        let detail = fault.map(|fault| fault.detail).unwrap_or_default();
        assert!(
            !expected || detail.contains("service hoard: its state cannot be kept"),
            "{detail}"
        );
    }
}

impl Hoard {
    fn broken() -> Self {
        panic!("no map of the cellar")
    }
}

#[blastema_testkit::test]
async fn a_service_whose_component_cannot_be_built_is_refused_at_the_start_and_says_why() {
    let hoard = ServiceSpec::new("hoard", ["module1"], Hoard::broken);
    let refused = TestNode::try_start(Node::builder("module1").service(hoard)).await;
    let Err(StartError::Service { name, reason }) = refused else { panic!("there is nothing") };
    assert_eq!(name, "hoard");
    assert!(reason.contains("no map of the cellar") && reason.contains("states.rs:"), "{reason}");
}
