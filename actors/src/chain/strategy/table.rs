//! How to make each strategy when it is needed.

use super::host::StrategyHost;
use super::isolate::Isolate;
use super::move_to_own_thread::MoveToOwnThread;
use super::reroute::Reroute;
use super::reset::Reset;
use super::restart::Restart;
use super::safe_stop::SafeStop;
use super::{RecoveryStrategy, Tools};
use crate::guardian::Guardian;
use crate::panics;
use actix::prelude::*;
use blastema_contract::strategy::CarryOut;
use blastema_core::ObjectName;
use blastema_core::recovery::{Failed, Measure};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

type Make = Arc<dyn Fn(&Guardian, ObjectName, Tools) -> Recipient<CarryOut> + Send + Sync>;

/// The strategies that this node has: the built-in ones and the application's own.
#[derive(Clone)]
pub(crate) struct StrategyTable(BTreeMap<Measure, Make>);

impl Default for StrategyTable {
    fn default() -> Self {
        let mut table = StrategyTable(BTreeMap::new());
        table.insert(Measure::Reset, || Reset);
        table.insert(Measure::Restart, || Restart);
        table.insert(Measure::MoveToOwnThread, || MoveToOwnThread);
        table.insert(Measure::Reroute, || Reroute);
        table.insert(Measure::Isolate, || Isolate);
        table.insert(Measure::SafeStop, || SafeStop);
        table
    }
}

impl StrategyTable {
    /// Takes in a strategy of the application's own.
    pub(crate) fn hand_over<S: RecoveryStrategy>(
        &mut self,
        name: &str,
        make: impl Fn() -> S + Send + Sync + 'static,
    ) {
        self.insert(Measure::Custom(name.into()), make);
    }

    /// The names of the application's own strategies.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().filter_map(|measure| match measure {
            Measure::Custom(name) => Some(name.as_ref()),
            _ => None,
        })
    }

    /// Makes the strategy that carries `measure` out, on this arbiter.
    ///
    /// # Errors
    /// There is none, or making it panicked.
    pub(crate) fn make(
        &self,
        measure: &Measure,
        guardian: &Guardian,
        tools: Tools,
    ) -> Result<Recipient<CarryOut>, Failed> {
        let make =
            self.0.get(measure).ok_or_else(|| format!("there is no strategy {measure:?}"))?;
        let plain: String = measure
            .name()
            .chars()
            .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
            .collect();
        let name = ObjectName::new(&format!("chain/strategy/{plain}"))
            .or_else(|_| ObjectName::new("chain/strategy/custom"))
            .expect("this name is well formed");
        let _guarded = panics::Guarded::enter();
        catch_unwind(AssertUnwindSafe(|| make(guardian, name, tools))).map_err(|payload| {
            let (text, place) = (panics::text_of(payload), panics::take_place());
            format!("making the strategy {measure} panicked at {place}: {text}").into()
        })
    }

    fn insert<S: RecoveryStrategy>(
        &mut self,
        measure: Measure,
        make: impl Fn() -> S + Send + Sync + 'static,
    ) {
        let make = Arc::new(make);
        let start = move |guardian: &Guardian, name: ObjectName, tools: Tools| {
            let make = make.clone();
            let host = move |_: &mut Context<StrategyHost<S>>| StrategyHost::new(make(), tools);
            guardian.start(name, None, host).recipient()
        };
        self.0.insert(measure, Arc::new(start));
    }
}
