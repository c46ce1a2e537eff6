//! What every medium is held to.

use super::*;

/// Never takes a message from its mailbox.
struct Hung;

impl Actor for Hung {
    type Context = Context<Self>;

    #[expect(clippy::disallowed_methods, reason = "it is to hang")]
    fn started(&mut self, context: &mut Context<Self>) {
        context.wait(actix::fut::wrap_future(std::future::pending()));
    }
}

impl Handler<Received> for Hung {
    type Result = ();
    fn handle(&mut self, _: Received, _: &mut Context<Self>) {}
}

pub(crate) async fn frames_arrive_whole<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, _)) = (a.opened().await, b.opened().await);

    for length in [1, 100, 1_000, 10_000, 60_000] {
        let frame: Bytes = (0..length).map(|i| (i % 251) as u8).collect();
        a.send(&at_b, frame.clone());
        b.expect(at_a.clone(), frame.clone()).await;
        b.send(&at_a, frame.clone());
        a.expect(at_b.clone(), frame).await;
    }
    let TransportCounters { sent, received, dropped, refused, .. } = a.counters().await;
    assert_eq!((sent, received, dropped, refused), (5, 5, 0, 0));
}

pub(crate) async fn the_empty_and_the_largest_frame_arrive<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((_, mtu), (at_b, _)) = (a.opened().await, b.opened().await);

    for length in [0, mtu, 0] {
        a.send(&at_b, vec![7; length]);
        assert_eq!(b.frames.expect().await.frame, vec![7; length]);
    }
}

pub(crate) async fn a_frame_that_is_too_large_is_refused_and_counted<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((_, mtu), (at_b, _)) = (a.opened().await, b.opened().await);

    a.send(&at_b, vec![7; mtu + 1]);
    a.send(&at_b, "small");

    assert_eq!(b.frames.expect().await.frame, "small");
    a.counted(|counters| (counters.refused, counters.sent) == (1, 1)).await;
}

pub(crate) async fn an_address_of_another_medium_is_refused_and_counted<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at_a, _) = a.opened().await;

    a.send(
        &match at_a {
            MediumAddress::Memory(_) => MediumAddress::Ip(([127, 0, 0, 1], 9).into()),
            _ => MediumAddress::Memory("nowhere".into()),
        },
        "lost",
    );

    a.counted(|counters| counters.refused == 1).await;
}

pub(crate) async fn many_frames_keep_their_order_and_none_is_doubled<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);

    // In bursts that every medium can hold.
    for burst in 0..20_u32 {
        for number in burst * 100..(burst + 1) * 100 {
            a.send(&at_b, number.to_be_bytes().to_vec());
        }
        for number in burst * 100..(burst + 1) * 100 {
            assert_eq!(b.frames.expect().await.frame, number.to_be_bytes()[..]);
        }
    }
    assert_eq!(b.frames.len(), 0);
}

pub(crate) async fn attaching_replaces_who_was_attached_and_tells_the_present_state<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, mtu)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "to the first");
    assert_eq!(b.frames.expect().await.frame, "to the first");

    let (frames, reports) = attach(&b.transport);
    let opened = TransportReport::Opened { local: at_b.clone(), mtu, is_probed: false };
    assert_eq!(reports.expect().await, opened);
    a.send(&at_b, "to the second");

    assert_eq!(frames.expect().await.frame, "to the second");
    assert_eq!(b.frames.len(), 0);
}

pub(crate) async fn a_peer_that_is_gone_and_back_is_reached_again<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    b.transport.close.do_send(Close);
    b.ended().await;
    if M::CONNECTS {
        assert_eq!(a.reports.expect().await, TransportReport::PeerLost { peer: at_b.clone() });
    }
    (0..100).for_each(|_| a.send(&at_b, "into the void"));
    a.counters().await;

    let b = End::new(medium.open(Some(at_b.clone())));
    b.opened().await;
    let stale = a.reaches(&b, at_b.clone(), "after").await;
    assert!(M::KEEPS || !stale, "what was sent into the void arrived");
    assert_eq!(a.events(), []);
}

pub(crate) async fn closing_releases_the_port<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at, _) = a.opened().await;

    a.transport.close.do_send(Close);
    a.ended().await;
    let b = End::new(medium.open(Some(at.clone())));

    assert_eq!(b.opened().await.0, at);
}

pub(crate) async fn a_port_that_is_taken_is_reported_and_opened_when_it_is_free<M: Medium>() {
    let medium = M::default();
    let a = End::new(medium.open(None));
    let (at, _) = a.opened().await;

    let b = End::new(medium.open(Some(at.clone())));
    let reason = b.closed().await;
    assert!(reason.contains("or choose another"), "{reason}");
    let (_, reports) = attach(&b.transport);
    assert_eq!(reports.expect().await, TransportReport::Closed { reason });

    a.transport.close.do_send(Close);
    let opened = reports.expect().await;
    assert!(matches!(opened, TransportReport::Opened { local, .. } if local == at));
}

pub(crate) async fn garbage_on_the_wire_harms_nobody<M: Medium>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, _)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    for _ in 0..10 {
        medium.garbage(&at_b);
        a.send(&at_b, "after");
        let from_a = |received: &Received| received.from == at_a;
        assert_eq!(b.frames.wait(from_a).await.frame, "after");
    }

    let lost = |report: &TransportReport| !matches!(report, TransportReport::PeerLost { peer } if *peer != at_a);
    assert!(!b.events().iter().any(lost));
    assert_eq!(a.events(), []);
}

pub(crate) async fn a_flood_before_a_receiver_that_hangs_stays_bounded<M: Medium>() {
    const FLOOD: u64 = 20_000;
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let (_, (at_b, _)) = (a.opened().await, b.opened().await);
    let reports = Probe::start();
    let hung = Attach::new(Hung.start().recipient(), reports.recipient());
    b.transport.attach.do_send(hung);
    reports.expect().await;

    for _ in 0..FLOOD / 100 {
        (0..100).for_each(|_| a.send(&at_b, vec![7; 1000]));
        tokio::task::yield_now().await;
    }
    b.counted(|counters| counters.received >= 256).await;
    // All the while it takes orders: a hundred of them later it has not taken more.
    for _ in 0..100 {
        b.counters().await;
        tokio::task::yield_now().await;
    }
    let held = b.taken().await;
    assert!(held <= M::HELD, "{held} frames are held");

    // A receiver that takes frames gets those that come from now on.
    let (frames, _) = attach(&b.transport);
    let fresh = async {
        loop {
            a.send(&at_b, "fresh");
            b.counters().await;
            tokio::task::yield_now().await;
            if frames.drain().iter().any(|received| received.frame == "fresh") {
                break;
            }
        }
    };
    assert!(tokio::time::timeout(PATIENCE, fresh).await.is_ok(), "{:?}", b.counters().await);
}

pub(crate) async fn the_next_incarnation_after_a_panic_opens_at_the_same_address_for_the_same_receiver<
    M: Medium,
>() {
    let medium = M::default();
    let (a, b) = (End::new(medium.open(None)), End::new(medium.open(None)));
    let ((at_a, _), (at_b, mtu)) = (a.opened().await, b.opened().await);
    a.send(&at_b, "before");
    assert_eq!(b.frames.expect().await.frame, "before");

    b.panic.set(true);
    b.counters().await;

    assert_eq!(b.opened().await, (at_b.clone(), mtu));
    a.reaches(&b, at_b.clone(), "after").await;
    b.reaches(&a, at_a.clone(), "back").await;
    assert!(b.counters().await.received >= 2, "counters outlive the panic");
}
