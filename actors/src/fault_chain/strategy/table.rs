//! How to make each strategy when it is needed.

use super::host::StrategyHost;
use super::{RecoveryStrategy, StrategyContext};
use crate::arbiter::pool::ArbiterPool;
use crate::platform::own_arbiter;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_contract::strategy::ExecuteAction;
use blastema_core::ObjectName;
use blastema_core::recovery::RecoveryFailed;
use blastema_core::sorted::SortedMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::SeqCst;
use std::time::Duration;

/// Starts a strategy here, or on the thread that it has for itself.
type Make = Arc<
    dyn Fn(StrategyContext, Option<(&ArbiterHandle, StrategyThread)>) -> Recipient<ExecuteAction>
        + Send
        + Sync,
>;

/// Where the threads of strategies are counted that are given up, and what is reported of them.
#[derive(Clone)]
pub(crate) struct StrategyThreads {
    pub(crate) arbiters: ArbiterPool,
    pub(crate) reports: FaultReports,
}

/// The thread that a strategy has for itself.
#[derive(Clone)]
pub(super) struct StrategyThread {
    object: ObjectName,
    threads: StrategyThreads,
    given_up: Arc<AtomicBool>,
}

impl StrategyThread {
    pub(super) fn is_given_up(&self) -> bool {
        self.given_up.load(SeqCst)
    }

    /// The strategy keeps its thread for longer than its order may take.
    fn give_up(&self, within: Duration) {
        let StrategyThreads { arbiters, reports } = &self.threads;
        arbiters.note_abandoned(&self.object);
        let name = self.object.as_str().rsplit('/').next().unwrap_or_default();
        let detail = format!(
            "the recovery strategy {name} has blocked its thread for {within:?}: the thread is abandoned"
        );
        reports.declare(self.object.as_str(), detail);
        self.given_up.store(true, SeqCst);
    }

    /// The thread ends; one that was given up has come back.
    pub(super) fn end(&self) {
        if self.is_given_up() {
            self.threads.arbiters.note_returned(&self.object);
            self.threads.reports.clear(self.object.as_str());
        }
    }
}

/// A strategy that carries orders out at present. Dropped, it ends with its thread.
pub(crate) struct EngagedStrategy {
    pub(crate) orders: Recipient<ExecuteAction>,
    own: Option<(ArbiterHandle, StrategyThread)>,
}

impl EngagedStrategy {
    /// It has not answered an order in its time, and its thread keeps it from saying so: another
    /// instance takes its place.
    pub(crate) fn give_up(self, within: Duration) {
        if let Some((_, thread)) = &self.own {
            thread.give_up(within);
        }
    }
}

impl Drop for EngagedStrategy {
    fn drop(&mut self) {
        if let Some((arbiter, _)) = &self.own {
            arbiter.stop();
        }
    }
}

/// The name under which a strategy is watched.
pub(crate) fn object_of(strategy: &str) -> ObjectName {
    let plain: String =
        strategy.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    ObjectName::new(&format!("chain/strategy/{plain}"))
        .or_else(|_| ObjectName::new("chain/strategy/custom"))
        .expect("this name is well formed")
}

/// The application's own strategies.
#[derive(Clone, Default)]
pub(crate) struct StrategyTable(SortedMap<Arc<str>, Make>);

impl StrategyTable {
    /// Takes in a strategy of the application's own.
    pub(crate) fn hand_over<S: RecoveryStrategy>(
        &mut self,
        name: &str,
        make: impl Fn() -> S + Send + Sync + 'static,
    ) {
        let make: Arc<dyn Fn() -> S + Send + Sync> = Arc::new(make);
        let start: Make = Arc::new(move |context, place| {
            let make = make.clone();
            match place {
                None => StrategyHost::new(make, context, None).start().recipient(),
                Some((arbiter, thread)) => StrategyHost::start_in_arbiter(arbiter, |_| {
                    StrategyHost::new(make, context, Some(thread))
                })
                .recipient(),
            }
        });
        self.0.insert(name.into(), start);
    }

    /// The names of the application's own strategies.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(|name| &**name)
    }

    /// Makes the strategy of this name, on a thread that it has for itself, unless all of the node
    /// runs on one.
    ///
    /// # Errors
    /// There is none, it keeps its share of threads already, or no thread is left for it.
    pub(crate) fn make(
        &self,
        name: &str,
        context: StrategyContext,
        threads: Option<&StrategyThreads>,
    ) -> Result<EngagedStrategy, RecoveryFailed> {
        let make = self.0.get(name).ok_or_else(|| format!("there is no strategy {name:?}"))?;
        let Some(threads) = threads.cloned() else {
            return Ok(EngagedStrategy { orders: make(context, None), own: None });
        };
        let object = object_of(name);
        let arbiter = threads
            .arbiters
            .check_share(&object)
            .and_then(|()| own_arbiter())
            .map_err(|error| format!("there is no thread for the strategy {name}: {error}"))?;
        let thread = StrategyThread { object, threads, given_up: Arc::default() };
        let orders = make(context, Some((&arbiter, thread.clone())));
        Ok(EngagedStrategy { orders, own: Some((arbiter, thread)) })
    }
}
