//! Requests to other nodes: deadlines, identities, and what is said where nothing can be known.

use super::*;
use crate::Outcome;

/// Counts how often it takes effect, slowly.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64)]
struct Book(u64);

/// The same, and it may take effect twice.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64, idempotent)]
struct SetTo(u64);

/// Replies with so many bytes, within its own limit or beyond.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = Vec<u8>)]
struct Grow(u32);

/// The same, and no session carries as much as its contract allows. The rest is ballast.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = Vec<u8>, max_size = 16_000_000)]
struct GrowMuch(u32, Vec<u8>);

const SERVICE: Duration = Duration::from_millis(100);

/// Takes 100 ms for each request, and writes down what took effect.
struct Desk(Log);

impl Component for Desk {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Book>().serve::<SetTo>().serve::<Grow>().serve::<GrowMuch>();
    }
}

impl Desk {
    async fn serve(&mut self, n: u64) -> u64 {
        tokio::time::sleep(SERVICE).await;
        self.0.0.lock().unwrap().push(n);
        n
    }
}

impl Handle<Book> for Desk {
    async fn handle(&mut self, Book(n): Book, _: &mut Context<Self>) -> u64 {
        self.serve(n).await
    }
}

impl Handle<SetTo> for Desk {
    async fn handle(&mut self, SetTo(n): SetTo, _: &mut Context<Self>) -> u64 {
        self.serve(n).await
    }
}

impl Handle<Grow> for Desk {
    async fn handle(&mut self, Grow(bytes): Grow, _: &mut Context<Self>) -> Vec<u8> {
        self.serve(bytes.into()).await;
        vec![7; bytes as usize]
    }
}

impl Handle<GrowMuch> for Desk {
    async fn handle(&mut self, message: GrowMuch, _: &mut Context<Self>) -> Vec<u8> {
        self.serve(message.0.into()).await;
        vec![7; message.0 as usize]
    }
}

/// A component at this module, and what took effect there.
async fn service_fn(module: &Module) -> (Box<dyn Child>, Log) {
    module.begin("desk", Desk, 100, WhenFull::Refuse).await
}

fn asking<M: crate::Request>(
    sender: Sender<M>,
    message: M,
    within: Duration,
) -> actix_rt::task::JoinHandle<Result<M::Reply, DeliveryError>> {
    actix_rt::spawn(
        async move { sender.ask_within(message, within).await.map_err(|error| error.kind) },
    )
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_request_that_was_late_on_the_way_is_not_begun() {
    let (robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;
    let sender = left.sender::<Book>("right:desk");
    assert_eq!(sender.ask(Book(0)).await.unwrap(), 0);

    robot.part("left");
    let late = asking(sender.clone(), Book(1), 300 * MS);
    let in_time = asking(sender.clone(), Book(2), 10_000 * MS);
    advance(1000 * MS).await;
    robot.unite("left");
    advance(2000 * MS).await;

    assert_eq!(late.await.unwrap(), Err(DeliveryError::DeadlinePassed));
    assert_eq!(in_time.await.unwrap(), Ok(2));
    assert_eq!(log.take(), [0, 2]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn where_the_way_was_lost_after_the_request_was_sent_the_outcome_is_not_known() {
    let (robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;
    let sender = left.sender::<Book>("right:desk");
    assert_eq!(sender.ask(Book(0)).await.unwrap(), 0);

    let sent = asking(sender.clone(), Book(1), 60_000 * MS);
    advance(20 * MS).await;
    robot.part("left");
    advance(500 * MS).await;
    // No way is known any more: this one does not leave the node.
    let kept = asking(sender.clone(), Book(2), 60_000 * MS);
    advance(5000 * MS).await;

    let why = sent.await.unwrap().unwrap_err();
    assert!(matches!(why, DeliveryError::OutcomeUnknown { .. }), "{why}");
    let why = kept.await.unwrap().unwrap_err();
    assert_eq!(why, DeliveryError::Unreachable { node: "right".into() });
    assert_eq!(log.take(), [0, 1], "it did take effect, which the caller could not know");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_idempotent_request_is_asked_again_by_itself_and_takes_effect_once() {
    let (robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;
    let sender = left.sender::<SetTo>("right:desk");
    assert_eq!(sender.ask(SetTo(0)).await.unwrap(), 0);

    let asked = asking(sender.clone(), SetTo(1), 20_000 * MS);
    let late = asking(sender.clone(), SetTo(2), 3000 * MS);
    advance(20 * MS).await;
    robot.part("left");
    advance(5000 * MS).await;
    assert_eq!(late.await.unwrap(), Err(DeliveryError::DeadlinePassed));
    robot.unite("left");
    advance(5000 * MS).await;

    assert_eq!(asked.await.unwrap(), Ok(1));
    // Sent in two sessions, and served in the first.
    assert_eq!(log.take(), [0, 1, 2]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_idempotent_request_is_asked_again_after_a_panic_of_the_stack() {
    let (_robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;
    let sender = left.sender::<SetTo>("right:desk");
    assert_eq!(sender.ask(SetTo(0)).await.unwrap(), 0);

    let asked = asking(sender, SetTo(1), 20_000 * MS);
    advance(20 * MS).await;
    left.net.panic_sessions();

    assert_eq!(asked.await.unwrap(), Ok(1));
    assert_eq!(log.take(), [0, 1]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_idempotent_request_goes_on_to_the_next_incarnation_of_the_callees_node() {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
    let right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
    let (dying, log) = service_fn(&right).await;
    advance(500 * MS).await;
    let sender = left.sender::<SetTo>("right:desk");
    assert_eq!(sender.ask(SetTo(0)).await.unwrap(), 0);

    let again = asking(sender.clone(), SetTo(1), 20_000 * MS);
    let once = asking(left.sender::<Book>("right:desk"), Book(2), 20_000 * MS);
    advance(20 * MS).await;
    robot.kill("ethernet/right");
    drop((right, dying));
    let right = robot.module("right", 2, &[("ethernet", &["left"])]).await;
    let (_service_fn, _) = service_fn(&right).await;
    advance(3000 * MS).await;

    assert_eq!(again.await.unwrap(), Ok(1));
    assert_eq!(once.await.unwrap(), Err(DeliveryError::PeerDied { incarnation: Incarnation(1) }));
    drop(log);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_request_that_is_sent_again_under_its_identity_takes_effect_once() {
    let (robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;
    let sender = left.sender::<Book>("right:desk");
    assert_eq!(sender.ask(Book(0)).await.unwrap(), 0);
    let repeatable = sender.repeatable(Book(1));

    let first = {
        let sender = sender.repeatable(Book(9));
        assert_ne!(sender.id(), repeatable.id());
        let asked = actix_rt::spawn(async move {
            let result = repeatable.ask_within(10_000 * MS).await;
            (repeatable, result.map_err(|error| error.kind))
        });
        advance(20 * MS).await;
        robot.part("left");
        advance(5000 * MS).await;
        asked
    };
    let (repeatable, result) = first.await.unwrap();
    assert!(matches!(result, Err(DeliveryError::OutcomeUnknown { .. })), "{result:?}");
    robot.unite("left");
    advance(5000 * MS).await;

    assert_eq!(repeatable.ask().await.unwrap(), 1);
    assert_eq!(repeatable.ask().await.unwrap(), 1);
    assert_eq!(log.take(), [0, 1]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_tell_by_another_contract_is_a_dead_letter_and_a_fault_of_the_sender() {
    let (_robot, left, right) = pair().await;
    let sender = left.sender::<super::other::Add>("right:acc");

    sender.tell(super::other::Add { summand: 1.0 }).unwrap();
    advance(50 * MS).await;

    let acc = ObjectName::new("acc").unwrap();
    assert_eq!(left.host.dead_letters.count(&acc, DeadReason::ContractDiffers), 1);
    let declared = left.declared.expect().await;
    assert_eq!(declared.kind, FaultKind::ContractMismatch);
    assert!(declared.detail.contains("with node right"), "{}", declared.detail);
    assert_eq!(right.declared.expect().await.object, acc);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_reply_that_is_too_large_says_that_the_request_took_effect_and_whose_limit_it_is() {
    let (_robot, left, right) = pair().await;
    let (_service_fn, log) = service_fn(&right).await;

    let error = left.sender::<Grow>("right:desk").ask(Grow(70_000)).await.unwrap_err();
    assert_eq!(error.outcome(), Outcome::TookEffect);
    assert_eq!((error.kind, error.message), (DeliveryError::ReplyTooLarge { limit: 65_536 }, None));
    assert_eq!(log.take(), [70_000]);

    let much = left.sender::<GrowMuch>("right:desk");
    let error = much.ask(GrowMuch(2_000_000, vec![])).await.unwrap_err();
    assert_eq!(error.outcome(), Outcome::TookEffect);
    let DeliveryError::ReplyTooLarge { limit } = error.kind else { panic!("{error}") };
    assert_eq!(limit >> 10, 1028);
    assert_eq!(log.take(), [2_000_000]);

    let error = much.ask(GrowMuch(1, vec![7; 2_000_000])).await.unwrap_err();
    assert_eq!(error.outcome(), Outcome::NotTaken);
    assert!(matches!(error.kind, DeliveryError::TooLargeForSession { .. }), "{error}");
    assert!(error.to_string().contains("whatever its contract allows"), "{error}");
    assert_eq!(error.message.map(|message| message.0), Some(1));
    assert_eq!(much.ask(GrowMuch(3, vec![7; 1 << 20])).await.unwrap(), [7; 3]);
    assert_eq!(log.take(), [3]);
}
