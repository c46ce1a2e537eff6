//! Nodes that are processes of their own, and are killed without a word.
//!
//! This test starts itself again for them: a process that finds a role in its environment plays it,
//! and is killed when its part is over.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, Hold, Link, Network, RestoreDecision, RestorePolicy, Role, ServiceSpec,
    StandbyKind, Stateful, Transaction,
};
use blastema_tests::{Process, addresses, answers, found, free_addresses, moves, role, until};
use std::net::SocketAddr;
use std::time::Duration;

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(300);
/// A link is down after three and a half of them. With sixty processes that are ready to run on two
/// processors, each of them waits for a tenth of a second now and then.
const HELLO: Duration = Duration::from_millis(100);

fn start(role: &str, addresses: &[SocketAddr]) -> Process {
    start_with(role, addresses, &[])
}

fn start_with(role: &str, addresses: &[SocketAddr], more: &[(&str, &String)]) -> Process {
    Process::start_with(module_path!(), role, addresses, more)
}

/// The network of node `own` of these, with a link to every other.
fn ethernet(addresses: &[SocketAddr], own: usize) -> Network {
    let mut network = Network::udp("ethernet", addresses[own]);
    for (number, address) in addresses.iter().enumerate().filter(|(number, _)| *number != own) {
        let link = Link::new(&format!("module{number}"), *address);
        network = network.link(link.hello_every(HELLO));
    }
    network
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    blastema::run(async {
        match role.as_str() {
            "commander" => command_wheels().await,
            "carrier1" => carry_counter(1).await,
            "carrier2" => carry_counter(2).await,
            "carrier3" => carry_counter(3).await,
            "keeper" => keep_books().await,
            "bystander" => stand_by().await,
            other => panic!("there is no role {other}"),
        }
    });
}

async fn stand_by() {
    let _node = Node::builder("module1").network(ethernet(&addresses(), 1)).start().await.unwrap();
    std::future::pending::<()>().await;
}

#[test]
fn a_node_that_is_killed_and_started_over_and_over_is_one_fault_that_stands() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let addresses = free_addresses(2);
    blastema::run(async {
        let node = Node::builder("module0").network(ethernet(&addresses, 0)).start().await.unwrap();
        let of_kind = async |kind: FaultKind| {
            let record = node.faults().await;
            record.entries.into_iter().filter(|e| e.fault.kind == kind).collect::<Vec<_>>()
        };
        for restarts in 0..5 {
            let mut process = start("bystander", &addresses);
            let seen = async || {
                node.table().await.iter().any(|row| {
                    let here = row.location.to_string() == "module1";
                    here && row.restarts == restarts && row.incarnation.0 > 0
                })
            };
            until(seen, "it is seen each time").await;
            process.kill();
        }

        let found = of_kind(FaultKind::CrashLoop).await;
        assert_eq!(found.len(), 1, "{found:?}");
        assert!(found[0].stands(), "{found:?}");
        assert_eq!(
            (found[0].fault.count, found[0].fault.location.to_string().as_str()),
            (2, "module1")
        );
        node.shutdown().await;
    });
}

/// Turns the wheels; answers how fast they turn now.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(f32);

async fn command_wheels() {
    let node = Node::builder("module1").network(ethernet(&addresses(), 1)).start().await.unwrap();
    assert!(node.connected("module0", PATIENCE).await);
    let wheels = node.commander::<Drive>("module0:wheels", "console").unwrap();
    wheels.claim().await.unwrap();
    wheels.command(Drive(1.0)).await.unwrap();
    std::future::pending::<()>().await;
}

#[test]
fn wheels_stop_by_themselves_when_their_commanders_process_is_killed() {
    let _turn = blastema_doubles::turn();
    let addresses = free_addresses(2);
    let (turned, turns) = std::sync::mpsc::sync_channel(16);
    let mut commander = start("commander", &addresses);

    blastema::run(async {
        let safe = ActuatorSpec::new(Drive(0.0), Hold).lease(Duration::from_secs(2));
        let wheels = moves("wheels", safe, turned, |turned, Drive(speed), _| {
            turned.send(speed).expect("the test listens");
            speed
        });
        let node = Node::builder("module0").network(ethernet(&addresses, 0)).child(wheels);
        let node = node.start().await.unwrap();

        assert_eq!(turns.recv_timeout(PATIENCE), Ok(1.0));
        assert!(turns.try_recv().is_err(), "while the commander lives nothing stops");
        commander.kill();
        assert_eq!(turns.recv_timeout(PATIENCE), Ok(0.0));

        let next = node.commander::<Drive>("wheels", "next").unwrap();
        while next.claim().await.is_err() {
            tokio::task::yield_now().await;
        }
        assert_eq!(next.command(Drive(0.5)).await, Ok(0.5));
        node.shutdown().await;
    });
}

/// Adds one, and answers the sum.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "counter/add", reply = u64)]
struct Add;

#[derive(Default)]
struct Counter(u64);

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Counter {
    async fn handle(&mut self, _: Add, _: &mut Context<Self>) -> u64 {
        self.0 += 1;
        self.0
    }
}

impl Stateful for Counter {
    fn save(&self) -> Vec<u8> {
        self.0.to_le_bytes().into()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        let bytes = state.try_into().map_err(|_| Failure::from("a sum has eight bytes"))?;
        self.0 = u64::from_le_bytes(bytes);
        Ok(())
    }
}

async fn carry_counter(number: usize) {
    let members = ["module1", "module2", "module3"];
    let kind = match std::env::var("BLASTEMA_TEST_KIND").as_deref() {
        Ok("hot") => StandbyKind::Hot,
        _ => StandbyKind::Warm,
    };
    let counter = ServiceSpec::new("counter", members, Counter::default).standby(kind);
    let (in_step, told) = tokio::sync::watch::channel(false);
    let node = Node::builder(&format!("module{number}"))
        .network(ethernet(&addresses(), number))
        .child(answers::<Ready>("witness", told))
        .service(counter);
    let node = node.start().await.unwrap();
    loop {
        let able = match node.service_role("counter") {
            Some(Role::Primary { .. }) => true,
            Some(Role::Standby { in_step, .. }) => in_step,
            None => false,
        };
        in_step.send_replace(able);
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

/// Whether this node serves, or could.
#[derive(Clone, Debug, Request)]
#[contract(name = "counter/ready", reply = bool)]
struct Ready;

#[test]
fn a_service_goes_on_counting_when_the_processes_that_serve_it_are_killed() {
    let _turn = blastema_doubles::turn();
    let addresses = free_addresses(4);
    let start = |number: usize| start(&format!("carrier{number}"), &addresses);
    let mut carriers = [start(1), start(2), start(3)];

    blastema::run(async {
        let node = Node::builder("module0").network(ethernet(&addresses, 0)).start().await.unwrap();
        let counter = node.service::<Add>("counter").unwrap();
        let mut sum = 0;
        for round in 0..3 {
            for _ in 0..20 {
                sum += 1;
                let counted = counter.ask_within(Add, PATIENCE).await;
                assert_eq!(counted, Ok(sum), "round {round}");
            }
            // The primary is killed while a request is in flight.
            let asking = counter.clone();
            let asked =
                tokio::task::spawn_local(async move { asking.ask_within(Add, PATIENCE).await });
            tokio::task::yield_now().await;
            let primary = primary(&counter).await;
            carriers[primary - 1].kill();
            sum += 1;
            assert_eq!(asked.await.unwrap(), Ok(sum), "round {round}, across the kill");
            carriers[primary - 1] = start(primary);
            // It is in step again when a majority could do without either of the others.
            while node.neighbourhood().len() < 3 {
                tokio::task::yield_now().await;
            }
        }
        node.shutdown().await;
    });
}

/// The number of the node that serves.
async fn primary(counter: &blastema::ServiceRef<Add>) -> usize {
    loop {
        if let Some(node) = counter.primary() {
            return node.as_str()["module".len()..].parse().expect("a number");
        }
        tokio::task::yield_now().await;
    }
}

/// How much came in, and how much is there: always the same, since they are written together.
#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "books/income")]
struct Income(u64);

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "books/balance")]
struct Balance(u64);

/// What may not be used after a restart until it was decided upon.
#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "books/plan")]
struct Intention(u64);

struct Books;

impl Component for Books {
    fn ports(ports: &mut Ports<Self>) {
        let plan = VariableSpec::new(Intention(0)).after_restart(RestorePolicy::AskFirst);
        let refused = |balance: &Balance| match balance.0 {
            0..1_000_000 => Ok(()),
            _ => Err("there is not so much".to_owned()),
        };
        let balance = VariableSpec::new(Balance(0)).check(refused);
        ports.variable(VariableSpec::new(Income(0))).variable(balance).variable(plan);
    }
}

fn books(number: usize, addresses: &[SocketAddr], file: &str) -> blastema::NodeBuilder {
    Node::builder(&format!("module{number}"))
        .network(ethernet(addresses, number))
        .child(ChildSpec::new("books", || Books))
        .keep_variables(file)
}

async fn keep_books() {
    let file = std::env::var("BLASTEMA_TEST_FILE").expect("a file is given with the role");
    let _node = books(1, &addresses(), &file).start().await.unwrap();
    std::future::pending::<()>().await;
}

#[test]
fn values_that_were_written_are_there_after_the_process_was_killed_in_the_middle_of_writing() {
    let _turn = blastema_doubles::turn();
    let addresses = free_addresses(2);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("variables").display().to_string();
    let start = || start_with("keeper", &addresses, &[("BLASTEMA_TEST_FILE", &file)]);
    let mut keeper = start();

    blastema::run(async {
        let node = Node::builder("module0").network(ethernet(&addresses, 0)).start().await.unwrap();
        let income = node.variable::<Income>("module1:books").unwrap();
        let balance = node.variable::<Balance>("module1:books").unwrap();
        let plan = node.variable::<Intention>("module1:books").unwrap();
        let mut acknowledged = 0;
        for round in 0..8 {
            let left = loop {
                match income.read().await {
                    Ok(reading) => break reading.value.0,
                    Err(_) => tokio::task::yield_now().await,
                }
            };
            assert_eq!(balance.read().await.unwrap().value.0, left, "round {round}: together");
            assert!(left == acknowledged || left == acknowledged + 1, "round {round}: {left}");
            if round == 0 {
                let second = Node::builder("module2").keep_variables(&file).start().await;
                let refused = second.expect_err("two nodes do not share a file").to_string();
                assert!(refused.contains("another process uses the file (node module1, process "));
            }
            if round > 0 {
                let undecided = plan.read().await;
                assert!(matches!(undecided, Err(DeliveryError::Undecided { .. })), "{undecided:?}");
                plan.decide(RestoreDecision::Restore).await.unwrap();
                assert_eq!(plan.read().await.unwrap().value, Intention(7));
            }
            plan.write(Intention(7)).await.unwrap();
            acknowledged = left;
            let write = async |sum: u64| {
                let both = Transaction::new().write(&income, Income(sum));
                both.write(&balance, Balance(sum)).commit().await
            };
            for _ in 0..=round {
                // Whatever became of an attempt, the next one writes the same.
                until(async || write(acknowledged + 1).await.is_ok(), "the keeper lives").await;
                acknowledged += 1;
            }
            // Killed while one more is under way, at another moment each time.
            let a_while = async {
                for _ in 0..round * 3 {
                    tokio::task::yield_now().await;
                }
            };
            tokio::select! {
                biased;
                written = write(acknowledged + 1) => acknowledged += u64::from(written.is_ok()),
                () = a_while => {}
            }
            keeper.kill();
            keeper = start();
        }
        node.shutdown().await;
    });
}

#[test]
fn a_file_of_variables_that_is_damaged_is_set_aside_and_a_fault() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    let addresses = free_addresses(2);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("variables");
    let file = path.display().to_string();

    blastema::run(async {
        let node = books(1, &addresses, &file).start().await.unwrap();
        let income = node.variable::<Income>("books").unwrap();
        income.write(Income(5)).await.unwrap();
        node.shutdown().await;
        drop(node);
        let mut bytes = std::fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&path, bytes).unwrap();

        let node = books(1, &addresses, &file).start().await.unwrap();
        let income = node.variable::<Income>("books").unwrap();
        assert_eq!(income.read().await.unwrap().value, Income(0), "not what may be wrong");
        let told = async || {
            let mut entries = node.faults().await.entries.into_iter();
            let told = entries.find(|entry| entry.fault.detail.contains("set aside"))?;
            Some(told.fault.detail)
        };
        let detail = found(told, "the fault list tells").await;
        assert!(detail.contains("checksum"), "{detail}");
        assert!(folder.path().join("variables.damaged").exists());
        income.write(Income(6)).await.unwrap();
        assert!(path.exists(), "and it is kept again");
        node.shutdown().await;
    });
}
