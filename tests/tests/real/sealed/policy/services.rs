//! Who may ask a service, and who may carry it.

use super::*;

struct Map(u32);

impl Component for Map {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Hello>();
    }
}

impl Handle<Hello> for Map {
    async fn handle(&mut self, Hello(who): Hello, _: &mut Context<Self>) -> Vec<String> {
        self.0 += 1;
        vec![who, self.0.to_string()]
    }
}

impl Stateful for Map {
    fn save(&self) -> Vec<u8> {
        self.0.to_le_bytes().into()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        self.0 = u32::from_le_bytes(state.try_into().map_err(|_| "four bytes")?);
        Ok(())
    }
}

/// A map that has been asked so often already, on one node.
fn map(on: &str, asked: u32) -> ServiceSpec<Map> {
    ServiceSpec::new("map", [on], move || Map(asked))
}

async fn ask(node: &Node) -> Result<u32, DeliveryError> {
    let map = node.service::<Hello>("map").expect("a name");
    let reply = map.ask(Hello(node.name().to_string())).await.map_err(|error| error.kind)?;
    Ok(reply[1].parse().expect("a number"))
}

#[test]
fn a_node_that_may_not_ask_a_service_is_told_so_and_asks_once_it_may() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        let robot = Robot::new(&open, &["only arm may ask on map".to_owned()]);
        let carry =
            |own, node: NodeBuilder| if own == 0 { node.service(map("base", 0)) } else { node };
        let [base, arm, head] = robot.start_all_with(carry).await;
        assert_eq!(ask(&arm).await, Ok(1));
        let refused = ask(&head).await;
        assert!(is_forbidden(&refused, "ask"), "{refused:?}");
        let rows = base.refusals();
        assert!(
            rows.iter().any(|row| row.object == "map" && row.node.as_str() == "head"),
            "{rows:?}"
        );

        robot.put(&open, &[], 2);
        until(async || ask(&head).await.is_ok(), "the head may").await;
        end([base, arm, head]).await;
    });
}

#[test]
fn a_node_that_may_not_claim_a_service_answers_no_caller_and_does_not_stop_it() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        // Of two that may both claim it, the other one would go on.
        let robot = Robot::new(&open, &["only arm may claim on map".to_owned()]);
        let carry = |own, node: NodeBuilder| match own {
            0 => node.service(map("base", 1000)),
            1 => node.service(map("arm", 0)),
            _ => node,
        };
        let [base, arm, head] = robot.start_all_with(carry).await;
        // Long enough for the two to compare what they were told.
        for expected in 1..=40 {
            assert_eq!(ask(&head).await, Ok(expected));
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
        end([base, arm, head]).await;
    });
}

#[test]
fn a_node_that_may_claim_a_service_no_more_does_not_stop_it_any_more() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let open: Vec<_> = NODES.map(|node| (node, Role::Node)).into();
        let robot = Robot::new(&open, &[]);
        // Neither has a majority before the head carries the service.
        let shared = |with| ServiceSpec::new("map", [with, "head"], || Map(0));
        let base = robot.start_with(0, |node| node.service(shared("base"))).await;
        let arm = robot.start_with(1, |node| node.service(shared("arm"))).await;
        let is_stopped = async |node: &Node| {
            let faults = node.faults().await.entries;
            faults.iter().any(|entry| {
                entry.stands()
                    && entry.fault.kind == FaultKind::ContractMismatch
                    && entry.fault.detail.contains("its nodes are")
            })
        };
        until(async || is_stopped(&base).await, "the base has met the arm").await;
        let head = robot.start_with(2, |node| node.service(shared("base"))).await;
        until(async || is_stopped(&head).await, "the head has met the arm").await;
        let refused = ask(&head).await;
        assert!(matches!(refused, Err(DeliveryError::ContractDiffers { .. })), "{refused:?}");

        robot.put(&open, &["only base head may claim on map".to_owned()], 2);
        until(async || ask(&head).await == Ok(1), "there is a primary").await;
        until(async || !is_stopped(&base).await, "nothing is disputed any more").await;
        end([base, arm, head]).await;
    });
}
