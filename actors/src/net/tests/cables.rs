//! Cables and media that fail, are slow, or were never there.

use super::*;

#[test]
fn a_network_whose_interface_lost_its_carrier_is_given_up_at_once_and_proves_itself_again() {
    paused(async {
        let (robot, left, right) = pair().await;
        let up = |rows: &[LinkRow]| rows.iter().map(|row| row.state).collect::<Vec<_>>();
        left.sender::<Note>("right:acc").tell(Note(0)).unwrap();
        advance(5 * MS).await;
        assert_eq!(right.log.take(), [0]);
        left.links.drain();

        robot.cut("ethernet/left");
        left.net.networks[0].1.do_send(CarrierChanged { present: false });
        left.sender::<Note>("right:acc").tell(Note(1)).unwrap();
        advance(5 * MS).await;

        assert_eq!(right.log.take(), [1], "a hello is not even late");
        let reported = left.links.expect().await;
        let LinkCondition::Down { reason } = reported.condition else { panic!("{reported:?}") };
        assert!(reason.contains("carrier"), "{reason}");
        robot.restore("ethernet/left");
        left.net.networks[0].1.do_send(CarrierChanged { present: true });
        advance(5 * MS).await;
        assert_eq!(up(&left.net.read_links().await), [LinkState::Down, LinkState::Up]);
        advance(1000 * MS).await;
        assert_eq!(up(&left.net.read_links().await), [LinkState::Up; 2]);
    });
}

#[test]
fn a_slow_medium_is_dearer_and_is_spared_hellos() {
    paused(async {
        let (_robot, left, _right) = pair().await;

        left.net.networks[0].1.do_send(TransportReport::Rate { bytes_per_second: 11_520 });
        advance(1000 * MS).await;

        let rows = left.net.read_links().await;
        assert_eq!([rows[0].cost, rows[1].cost], [868, 10]);
        assert!(rows[0].hello_interval > 80 * MS, "{:?}", rows[0].hello_interval);
        assert_eq!(rows[1].hello_interval, 50 * MS);
        assert!(rows.iter().all(|row| row.state == LinkState::Up), "{rows:?}");
        assert_eq!(left.net.read_routes().await.routes[0].next, LinkId(1));
    });
}

#[test]
fn a_medium_that_cannot_be_opened_is_told_as_its_links_being_down() {
    paused(async {
        let (mut robot, left, _right) = pair().await;
        left.links.drain();

        // Its end of the medium is taken.
        let usurper = robot.module("left", 2, &[("ethernet", &["right"])]).await;
        advance(10 * MS).await;

        let reported = usurper.links.expect().await;
        let LinkCondition::Down { reason } = reported.condition else { panic!("{reported:?}") };
        assert!(reason.contains("ethernet/left"), "{reason}");
        assert_eq!(left.links.drain(), []);
    });
}

#[test]
fn two_links_of_one_name_are_refused_before_anything_starts() {
    paused(async {
        let robot = Robot::default();
        let host = with_features(
            ComponentEnvironment::new(ArbiterPool::here(), FaultReports::default()),
            ActuatorTable::default(),
        );
        let exits = Probe::start();
        let memory = Memory::new(&robot.medium, "x").start();
        let link = |to: &str| LinkSpec::new("same", MediumAddress::Memory(to.into()));
        let spec = NetworkSpec {
            name: "ethernet".into(),
            transport: Transport::from(memory),
            interface: None,
            links: vec![link("left"), link("right")],
            discovery: None,
            seal: None,
        };
        let environment = NetEnvironment {
            node: NodeName::new("left").unwrap(),
            incarnation: Incarnation(1),
            guardian: Guardian::reporting_to(exits.recipient()),
            arbiter: None,
            registry: host.registry.clone(),
            topics: host.topics().clone(),
            dead_letters: host.dead_letters.clone(),
            may_be_away: SortedSet::new(),
            recoverer: None,
            links: None,
            stalls: None,
            nodes: None,
            faults: None,
            cleared: None,
            session_timeout: IDLE_TIMEOUT,
            observers: Vec::new(),
            roster_observers: Vec::new(),
            keys: None,
        };

        let refused = start(environment, vec![spec]).err().unwrap();

        assert!(refused.to_string().contains("two links are called same"));
    });
}
