//! Groups and queues, beside two threads that keep the processors.

use super::{BusyThreads, LONG};
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema::{FaultStatus, Incarnation, Outcome, VariableRef};
use blastema_tests::{burn, found, until};
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

/// Answered with the incarnation that serves it.
#[derive(Clone, Debug, Request)]
#[contract(name = "test/who", reply = u64)]
struct Who;

#[derive(Clone, Debug, Event)]
#[contract(name = "test/die")]
struct Die;

/// Keeps the thread of its receiver until the test ends.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/block")]
struct Block;

/// Takes its time to start.
struct Member;

impl Component for Member {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Who>().accept::<Die>().accept::<Block>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        burn(Duration::from_millis(2));
        Ok(())
    }
}

impl Handle<Who> for Member {
    async fn handle(&mut self, _: Who, cx: &mut Context<Self>) -> u64 {
        let Incarnation(incarnation) = cx.incarnation();
        incarnation
    }
}

impl Handle<Block> for Member {
    async fn handle(&mut self, _: Block, _: &mut Context<Self>) {
        std::thread::park();
    }
}

impl Handle<Die> for Member {
    async fn handle(&mut self, _: Die, _: &mut Context<Self>) {
        panic!("struck");
    }
}

#[test]
fn a_group_whose_recoveries_all_work_never_ends_in_the_safe_state() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    for run in 0..32 {
        blastema::run(async move {
            let strategy = [Strategy::OneForAll, Strategy::RestForOne][run % 2];
            let group = SupervisorSpec::new("group", strategy)
                .intensity(1000, Duration::from_secs(10))
                .child(ChildSpec::new("a", || Member).on_own_thread())
                .child(ChildSpec::new("b", || Member));
            let node = Node::builder("module1").supervisor(group).start().await.unwrap();
            let (who, die) = (node.sender::<Who>("a").unwrap(), node.sender::<Die>("a").unwrap());

            for incarnation in 1..=6 {
                // The message of death may reach one incarnation only.
                assert_eq!(who.ask_within(Who, LONG).await.unwrap(), incarnation, "run {run}");
                die.tell(Die).unwrap();
            }

            assert_eq!(who.ask_within(Who, LONG).await.unwrap(), 7, "run {run}");
            let panics = async || {
                let entries = node.faults().await.entries.into_iter();
                entries.filter(|entry| entry.fault.kind == FaultKind::Panic).collect::<Vec<_>>()
            };
            let settled = async || {
                let is_over = |entry: &FaultEntry| entry.status() == FaultStatus::Closed;
                let panics = panics().await;
                let count: u32 = panics.iter().map(|entry| entry.fault.count).sum();
                (count == 6 && panics.iter().all(is_over)).then_some(panics)
            };
            for entry in found(settled, &format!("run {run}: six panics that are over")).await {
                let decided = entry.decided.as_ref().map_or("", |(_, action)| action.as_str());
                assert!(!decided.contains("attempt"), "run {run}: {entry:?}");
            }
            node.shutdown().await;
        });
    }
}

#[test]
fn what_waits_for_a_component_that_is_given_up_because_it_hangs_is_refused() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    blastema::run(async {
        let arm = ChildSpec::new("arm", || Member).max_block(Duration::from_millis(200));
        let node = Node::builder("module1")
            .intensity(0, Duration::from_secs(10))
            .child(arm.on_own_thread())
            .start()
            .await
            .unwrap();
        let (who, die) = (node.sender::<Who>("arm").unwrap(), node.sender::<Die>("arm").unwrap());
        node.sender::<Block>("arm").unwrap().tell(Block).unwrap();
        // Far beyond the end of the test.
        let asks = who.clone();
        let waiting = async move { asks.ask_within(Who, 60 * LONG).await };
        let waiting = tokio::task::spawn_local(tokio::time::timeout(LONG, waiting));
        tokio::task::yield_now().await;
        (0..20).for_each(|_| die.tell(Die).unwrap());

        let refused = waiting.await.unwrap().expect("it does not wait for its deadline");

        let refused = refused.expect_err("none serves it");
        let entries = node.faults().await.entries;
        let hang = entries.iter().find(|entry| entry.fault.kind == FaultKind::Hang);
        let id = hang.expect("it hangs").fault.id;
        let text = refused.kind.to_string();
        assert!(text.starts_with("arm is isolated, or in its safe state: hang: "), "{text}");
        assert!(text.ends_with(&format!(", fault {}", id.0)), "{text}");
        assert_eq!(refused.outcome(), Outcome::NotTaken);
        let arm = "arm".parse().unwrap();
        let all = async || node.dead_letters().count(&arm, DeadReason::Isolated) == 21;
        until(all, "each message is counted").await;
        node.restart_child("arm").await.unwrap();
        assert_eq!(who.ask_within(Who, LONG).await.unwrap(), 2, "it serves what is new");
        node.shutdown().await;
    });
}

#[derive(Clone, Debug, PartialEq, Parameters)]
#[contract(name = "arm/settings")]
struct Settings {
    #[parameter(default = 0)]
    speed: u32,
}

/// Writes down with which speed it runs, and panics now and then.
struct Tuned(Arc<AtomicU32>);

impl Component for Tuned {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<Settings>();
        ports.accept::<Die>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0.store(cx.parameters::<Settings>()?.speed, SeqCst);
        burn(Duration::from_millis(2));
        Ok(())
    }
}

impl Handle<Settings> for Tuned {
    async fn handle(&mut self, settings: Settings, _: &mut Context<Self>) {
        burn(Duration::from_millis(1));
        self.0.store(settings.speed, SeqCst);
    }
}

impl Handle<Die> for Tuned {
    async fn handle(&mut self, _: Die, _: &mut Context<Self>) {
        panic!("struck");
    }
}

#[test]
fn a_component_and_its_variable_agree_on_the_parameters_that_were_set_last() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    blastema::run(async {
        let runs_with = Arc::<AtomicU32>::default();
        let kept = runs_with.clone();
        let arm = ChildSpec::new("arm", move || Tuned(kept.clone())).queue(8, WhenFull::Refuse);
        let node = Node::builder("module1")
            .intensity(1000, Duration::from_secs(10))
            .child(arm.on_own_thread())
            .start()
            .await
            .unwrap();
        let (settings, die) = (node.variable("arm").unwrap(), node.sender::<Die>("arm").unwrap());

        for round in 0..32 {
            // Where the queue is full, enough of them wait.
            let _ = die.tell(Die);
            let set = |speed| {
                let settings: VariableRef<Settings> = settings.clone();
                tokio::task::spawn_local(async move { settings.write(Settings { speed }).await })
            };
            let sets: Vec<_> = (0..20).map(|n| set(round * 20 + n)).collect();
            for set in sets {
                set.await.unwrap().expect("it is in the range");
            }

            let wanted = settings.read().await.unwrap().value.speed;
            let agrees = async || runs_with.load(SeqCst) == wanted;
            until(agrees, &format!("round {round}: it runs with {wanted}")).await;
        }
        node.shutdown().await;
    });
}

/// Of no worth after 50 ms.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/scan", max_age = "50ms")]
struct Scan;

#[derive(Clone, Debug, Event)]
#[contract(name = "test/mode", latched)]
struct Mode(u32);

/// Says how many incarnations have begun, and in which mode it runs. It takes its time to begin.
struct Base(Arc<(AtomicU32, AtomicU32)>);

impl Component for Base {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Scan>().accept::<Die>().queue::<Die>(1, WhenFull::Refuse);
        ports.listen::<Mode>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.1.store(0, SeqCst);
        self.0.0.fetch_add(1, SeqCst);
        burn(Duration::from_millis(20));
        Ok(())
    }
}

impl Handle<Scan> for Base {
    async fn handle(&mut self, _: Scan, _: &mut Context<Self>) {
        burn(Duration::from_millis(1));
    }
}

impl Handle<Mode> for Base {
    async fn handle(&mut self, Mode(mode): Mode, _: &mut Context<Self>) {
        self.0.1.store(mode, SeqCst);
    }
}

impl Handle<Die> for Base {
    async fn handle(&mut self, _: Die, _: &mut Context<Self>) {
        panic!("struck");
    }
}

#[test]
fn a_flood_refuses_nothing_at_another_port_and_costs_no_incarnation_its_mode() {
    let _turn = blastema_doubles::turn();
    let _busy = BusyThreads::start();
    blastema::run(async {
        let runs_in = Arc::<(AtomicU32, AtomicU32)>::default();
        let kept = runs_in.clone();
        let base = ChildSpec::new("base", move || Base(kept.clone())).queue(8, WhenFull::Refuse);
        let node = Node::builder("module1")
            .intensity(1000, Duration::from_secs(10))
            .child(base.on_own_thread())
            .start()
            .await
            .unwrap();
        let (scan, die) =
            (node.sender::<Scan>("base").unwrap(), node.sender::<Die>("base").unwrap());
        let mode = node.publisher::<Mode>("test/mode").unwrap();
        let flood = async {
            loop {
                while scan.tell(Scan).is_ok() {}
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };

        let rounds = async {
            for round in 1..=32 {
                mode.publish(Mode(round)).unwrap();
                die.tell(Die).expect("the flood takes none of its places");
                let is_in_mode =
                    async || [&runs_in.0, &runs_in.1].map(|n| n.load(SeqCst)) == [round + 1, round];
                until(is_in_mode, &format!("it is in the mode of round {round}")).await;
            }
        };
        tokio::select! {
            () = rounds => {}
            () = flood => unreachable!("it has no end"),
        }
        node.shutdown().await;
    });
}
