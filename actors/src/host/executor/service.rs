//! What an executor has in service.

use crate::component::cell::{Blame, CellCore};
use crate::component::envelope::FutureSlot;
use crate::component::slot::ComponentSlot;
use crate::component::{Component, Failure};
use crate::host::lifecycle::Hook;
use crate::liveness::activity::ActivitySlot;
use crate::liveness::label;
use std::any::TypeId;
use std::pin::Pin;
use std::rc::Rc;

/// Future slots kept at most; a component that takes more contracts than this pays a box for the others.
const SLOTS_MAX: usize = 4;

/// What is in service.
pub(super) enum Service {
    /// Nothing is served.
    Idle,
    /// A message, in the slot of this number. If a followed one brings death, it is blamed by its
    /// identity.
    Message { at: usize, is_followed: bool },
    /// A hook of the component, as its future.
    Hook(Hook, Pin<Box<dyn Future<Output = Result<(), Failure>>>>),
}

pub(super) struct SlotInUse<C: Component> {
    contract: TypeId,
    pub(super) label: u32,
    pub(super) future_slot: Box<dyn FutureSlot<C>>,
}

/// What is in service, the slots that hold the futures of messages, and the record that shows the
/// sampler what the component does.
pub(super) struct CurrentService<C: Component> {
    pub(super) current: Service,
    pub(super) slots_in_use: Vec<SlotInUse<C>>,
    pub(super) slot: ActivitySlot,
}

impl<C: Component> CurrentService<C> {
    /// Nothing is in service, and a slot for the sampler is claimed.
    pub(super) fn new() -> Self {
        let slot = ActivitySlot::claim();
        CurrentService { current: Service::Idle, slots_in_use: Vec::new(), slot }
    }

    #[inline]
    pub(super) fn is_idle(&self) -> bool {
        matches!(self.current, Service::Idle)
    }

    /// The name of what is in service, or was last.
    pub(super) fn name(&self) -> &'static str {
        label::name(self.slot.activity.read().during)
    }

    /// Which slot the futures of a contract have.
    #[inline]
    pub(super) fn slot_for(
        &mut self,
        contract: TypeId,
        name: &'static str,
        make: impl FnOnce() -> Box<dyn FutureSlot<C>>,
    ) -> usize {
        let known = self.slots_in_use.iter().position(|in_use| in_use.contract == contract);
        known.unwrap_or_else(|| {
            let label = label::number(name);
            self.slots_in_use.truncate(SLOTS_MAX - 1);
            self.slots_in_use.push(SlotInUse { contract, label, future_slot: make() });
            self.slots_in_use.len() - 1
        })
    }

    pub(super) fn begin_hook(&mut self, hook: Hook, component: Rc<ComponentSlot<C>>) {
        self.slot.activity.begin(hook.label().number());
        self.current = Service::Hook(hook, Box::pin(run_hook(component, hook)));
    }

    /// Drops what was in service, and what it was kept in.
    pub(super) fn dispose(&mut self, record: &CellCore, blame: Blame) {
        let current = std::mem::replace(&mut self.current, Service::Idle);
        let slots_in_use = std::mem::take(&mut self.slots_in_use);
        record.dispose("what it was serving", current, blame);
        // One by one: a second panic while unwinding from the first would end the process.
        slots_in_use
            .into_iter()
            .for_each(|in_use| record.dispose("what it was serving", in_use, blame));
    }
}

#[expect(
    clippy::await_holding_refcell_ref,
    reason = "messages wait while one is served; the control queue does not borrow"
)]
async fn run_hook<C: Component>(slot: Rc<ComponentSlot<C>>, hook: Hook) -> Result<(), Failure> {
    let mut contents = slot.contents.borrow_mut();
    let (component, cx) = contents.both();
    if let Some(injected) = cx.before() {
        injected.await;
    }
    match hook {
        Hook::Initialize if cx.fails_initialization() => Err("it was told to fail".into()),
        Hook::Initialize => component.on_initialize(cx).await,
        Hook::Startup => component.on_startup(cx).await,
        Hook::Activated => component.on_activated(cx).await,
        Hook::Execute => component.on_execute(cx).await,
        Hook::Deactivated => component.on_deactivated(cx).await,
        Hook::Aborting => component.on_aborting(cx).await,
        Hook::Error => component.on_error(cx).await,
        Hook::Reset => component.on_reset(cx).await,
        Hook::Shutdown => component.on_shutdown(cx).await,
        Hook::Finalize => component.on_finalize(cx).await,
    }
}
