//! How to make each strategy when it is needed.

use super::host::{StrategyHost, StrategyThread};
use super::{RecoveryStrategy, StrategyContext};
use crate::platform::own_arbiter;
use crate::runtime::callbacks::Callbacks;
use actix::prelude::*;
use blastema_contract::strategy::ExecuteAction;
use blastema_core::ObjectName;
use blastema_core::recovery::RecoveryFailed;
use blastema_core::sorted::SortedMap;
use std::sync::Arc;
use tokio::sync::watch;

/// Starts a strategy here, or on the thread that it has for itself.
type Make = Arc<
    dyn Fn(StrategyContext, Option<(&ArbiterHandle, StrategyThread)>) -> Recipient<ExecuteAction>
        + Send
        + Sync,
>;

/// A strategy that carries orders out at present. Dropped, it ends with its thread.
pub(crate) struct EngagedStrategy {
    pub(crate) orders: Recipient<ExecuteAction>,
    own: Option<(ArbiterHandle, watch::Receiver<Option<u64>>)>,
}

impl EngagedStrategy {
    /// Whether it can take orders.
    pub(crate) fn is_usable(&self) -> bool {
        let blocked = self.own.as_ref().is_some_and(|(_, blocked)| blocked.borrow().is_some());
        self.orders.connected() && !blocked
    }

    /// Gets the order that blocks its thread, where it has one for itself.
    pub(crate) fn blocked_by(&self) -> Option<watch::Receiver<Option<u64>>> {
        self.own.as_ref().map(|(_, blocked)| blocked.clone())
    }
}

impl Drop for EngagedStrategy {
    fn drop(&mut self) {
        if let Some((thread, _)) = &self.own {
            thread.stop();
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
        callbacks: &Callbacks,
    ) -> Result<EngagedStrategy, RecoveryFailed> {
        let object = object_of(name);
        let make = self.0.get(name).ok_or_else(|| format!("there is no strategy {name:?}"))?;
        if !callbacks.have_threads() {
            return Ok(EngagedStrategy { orders: make(context, None), own: None });
        }
        let arbiter = callbacks
            .check_share(&object)
            .and_then(|()| own_arbiter())
            .map_err(|error| format!("there is no thread for the strategy {name}: {error}"))?;
        let (blocked_by, blocked) = watch::channel(None);
        let (callbacks, blocked_by) = (callbacks.clone(), Arc::new(blocked_by));
        let thread = StrategyThread { object, callbacks, blocked_by };
        let orders = make(context, Some((&arbiter, thread)));
        Ok(EngagedStrategy { orders, own: Some((arbiter, blocked)) })
    }
}
