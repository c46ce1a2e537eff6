//! Groups, beside two threads that keep the processors.

use super::{BusyThreads, LONG};
use blastema::core::detection::FaultEntry;
use blastema::prelude::*;
use blastema::{FaultStatus, Incarnation, VariableRef};
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

/// Takes its time to start.
struct Member;

impl Component for Member {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Who>().accept::<Die>();
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
