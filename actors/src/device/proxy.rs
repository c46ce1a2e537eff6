//! The proxy: a component whose life cycle, ports and faults are those of its device.
//!
//! ```text
//! on_initialize   attaches to the line; contract compared; variables set, rate set
//! on_activated    ACTIVATE                 silence, reset    the incarnation ends as fatal
//! on_deactivated  DEACTIVATE               own error         the component is in error
//! on_reset        RESET                    absent            unavailable, tried again
//! ```

use super::line::{DeviceLine, LineClaim};
use super::link::{DeviceLink, DeviceOrder, DevicePhase};
use super::port::{DevicePort, PortUse};
use crate::component::context::Context;
use crate::component::envelope::refuse;
use crate::component::incarnation::TimerId;
use crate::component::{Component, Failure, Handle};
use crate::platform;
use blastema_core::contract::packed;
use blastema_core::{Contract, DeliveryError, FaultKind};
use blastema_lite::{
    CommandOutcome, DeviceState, HostConfig, LifecycleChange, Mismatch, Port, Status,
};
use std::any::TypeId;
use std::sync::Arc;
use std::time::Duration;

/// How long `on_initialize` waits for the device before it says that it is not there.
const ANSWER: Duration = Duration::from_secs(1);

/// What all incarnations of a proxy share.
pub(super) struct ProxySettings {
    pub(super) line: Arc<DeviceLine>,
    pub(super) claim: Arc<LineClaim>,
    pub(super) host: HostConfig<Vec<Port>>,
    pub(super) ports: Vec<DevicePort<DeviceProxy>>,
    /// The period of the device's context in milliseconds, unless its own.
    pub(super) period_ms: Option<u16>,
}

impl ProxySettings {
    /// Says why the device is refused.
    fn explain(&self, mismatch: Mismatch) -> String {
        let named = |of: &DevicePort<DeviceProxy>| {
            let (object, id, contract) = (of.port.object(), of.port.id(), of.contract);
            format!("port {id:#04x} of object {object}, `{contract}`")
        };
        match mismatch {
            Mismatch::Type(other) => format!(
                "a device of type {other:#010x} answers, and {:#010x} is expected: another device \
                 is connected, or another firmware runs on it",
                self.host.device_type
            ),
            Mismatch::Missing(at) => format!(
                "the device has no {}: build its firmware with the header of this robot",
                named(&self.ports[at])
            ),
            Mismatch::Port(at, theirs) => {
                let ours = &self.ports[at];
                let same = |known: &&DevicePort<DeviceProxy>| {
                    known.port.fingerprint() == theirs.fingerprint()
                };
                let known = self.ports.iter().find(same);
                let meant = known.map(|known| format!(", which is `{}`", known.contract));
                let differs = (ours.difference)(theirs.fingerprint());
                let differs = meant.or_else(|| differs.map(|what| format!(": {what}")));
                format!(
                    "{} has {} bytes and fingerprint {:#010x} here, {} bytes and {:#010x} on the \
                     device{}; build its firmware with the header of this robot",
                    named(ours),
                    ours.port.size(),
                    ours.port.fingerprint(),
                    theirs.size(),
                    theirs.fingerprint(),
                    differs.unwrap_or_default()
                )
            }
        }
    }
}

/// The component that stands for a device on its node; see [`DeviceSpec`](crate::DeviceSpec).
pub struct DeviceProxy {
    settings: Arc<ProxySettings>,
    link: Option<Arc<DeviceLink>>,
    timer: Option<TimerId>,
}

impl Drop for DeviceProxy {
    fn drop(&mut self) {
        if let Some(link) = &self.link {
            link.release();
            self.settings.claim.release();
        }
    }
}

impl DeviceProxy {
    pub(super) fn new(settings: Arc<ProxySettings>) -> Self {
        DeviceProxy { settings, link: None, timer: None }
    }

    /// The link, once `on_initialize` has made it.
    fn link(&self) -> Result<&Arc<DeviceLink>, Failure> {
        self.link.as_ref().ok_or_else(|| Failure::fatal("the device has no line yet"))
    }

    fn attach(&mut self, cx: &Context<Self>) -> Result<Arc<DeviceLink>, Failure> {
        if let Some(link) = &self.link {
            return Ok(link.clone());
        }
        let settings = &self.settings;
        let receivers = settings.ports.iter().map(|port| match &port.used {
            PortUse::Out { topic, make } => make(cx, topic).map(Some),
            _ => Ok(None),
        });
        let receivers = receivers.collect::<Result<Vec<_>, _>>()?;
        // Sessions of a new incarnation differ from those of the one before.
        let session = platform::random_seed() as u16;
        let config = HostConfig { session, ..settings.host.clone() };
        let changed = settings.line.changed.clone();
        let link = Arc::new(DeviceLink::new(config, receivers, changed));
        settings.line.attach(link.clone(), &settings.claim)?;
        self.link = Some(link.clone());
        Ok(link)
    }

    fn objects(&self) -> impl Iterator<Item = u8> + use<> {
        1..=self.settings.ports.iter().map(|port| port.port.object()).max().unwrap_or(1)
    }

    /// Has each object in the state that the change leads to.
    async fn change(&self, change: LifecycleChange) -> Result<(), Failure> {
        let wanted = match change {
            LifecycleChange::Activate => DeviceState::Active,
            LifecycleChange::Deactivate | LifecycleChange::Reset => DeviceState::Inactive,
            LifecycleChange::Finalize => DeviceState::Finalized,
        };
        let link = self.link()?;
        for object in self.objects() {
            let (outcome, payload) = link.outcome(DeviceOrder::Change(object, change)).await;
            let state = payload.first().copied().and_then(DeviceState::from_byte);
            match outcome {
                CommandOutcome::Replied(Status::Well) => {}
                CommandOutcome::Replied(Status::WrongState) if state == Some(wanted) => {}
                // Another object may have failed while this one works.
                CommandOutcome::Replied(Status::WrongState)
                    if change == LifecycleChange::Reset && state == Some(DeviceState::Active) => {}
                CommandOutcome::Replied(status) => {
                    let state = state.map(|state| format!(", {state:?}")).unwrap_or_default();
                    let what = format!("{change:?} of object {object}: {status:?}{state}");
                    return Err(format!("the device has refused {what}").into());
                }
                CommandOutcome::NotSent | CommandOutcome::Unknown => {
                    return Err(Failure::fatal(self.absence()));
                }
            }
        }
        Ok(())
    }

    /// Why the device cannot be used.
    fn absence(&self) -> String {
        let phase = self.link.as_ref().map(|link| link.status.borrow().phase.clone());
        match phase {
            Some(DevicePhase::Absent(why)) => format!("the device is lost: {why}"),
            Some(DevicePhase::Refused(mismatch)) => self.settings.explain(mismatch),
            Some(DevicePhase::Released) => "the line serves another incarnation".to_owned(),
            Some(DevicePhase::Serving) | None => "the device was lost for a moment".to_owned(),
        }
    }

    /// Looks at what the line has found, while the component is active.
    fn look(&mut self, cx: &mut Context<Self>) {
        let Some(link) = self.link.clone() else { return };
        link.served();
        let status = link.status.borrow().clone();
        if status.phase != DevicePhase::Serving {
            cx.fail(Failure::fatal(self.absence()));
        } else if status.resets.0 > 0 {
            cx.fail(Failure::fatal(format!("the device was reset: {}", status.resets.1)));
        } else if let Some(fault) = status.fault {
            cx.fail(fault.as_str());
        }
    }

    async fn deliver<M: Contract>(&self, message: &M) -> Result<M::Reply, DeliveryError> {
        let ports = self.settings.ports.iter().enumerate();
        let mut taken = ports.filter(|(_, port)| port.of == TypeId::of::<M>());
        let taken = taken.find(|(_, port)| !matches!(port.used, PortUse::Out { .. }));
        let (Some((at, port)), Some(link)) = (taken, &self.link) else {
            return Err(DeliveryError::Stopped);
        };
        let undecodable = |reason| DeliveryError::Undecodable { reason };
        let bytes = packed::pack(message).map_err(|error| undecodable(error.to_string()))?;
        let payload = match &port.used {
            PortUse::In { newest: true } => {
                link.publish(at, bytes);
                Vec::new()
            }
            PortUse::Call => link.order(DeviceOrder::Call(at, bytes)).await?,
            _ => link.order(DeviceOrder::Write(at, bytes)).await?,
        };
        packed::unpack(&payload).map_err(|error| undecodable(error.to_string()))
    }
}

impl Component for DeviceProxy {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let link = self.attach(cx)?;
        let mut status = link.status.subscribe();
        let serves = status.wait_for(|status| status.phase == DevicePhase::Serving);
        if tokio::time::timeout(ANSWER, serves).await.is_err() {
            let is_refused = matches!(link.status.borrow().phase, DevicePhase::Refused(_));
            if is_refused {
                cx.declare_fault(FaultKind::ContractMismatch, self.absence());
            }
            return Err(Failure::unavailable(self.absence()));
        }
        cx.cell.record.clear(FaultKind::ContractMismatch);
        // It is known from here on: a reset from now on ends the incarnation.
        let unavailable = |error: DeliveryError| Failure::unavailable(error.to_string());
        for object in self.objects() {
            if let Some(period_ms) = self.settings.period_ms {
                link.order(DeviceOrder::Rate(object, period_ms)).await.map_err(unavailable)?;
            }
        }
        for (at, port) in self.settings.ports.iter().enumerate() {
            if let PortUse::Variable { read, .. } = port.used {
                let value = read(cx).await.map_err(unavailable)?;
                link.order(DeviceOrder::Write(at, value)).await.map_err(unavailable)?;
            }
        }
        Ok(())
    }

    async fn on_startup(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let link = self.link()?.clone();
        for (at, port) in self.settings.ports.iter().enumerate() {
            if let PortUse::Variable { follow, .. } = port.used {
                let following = follow(cx, link.clone(), at);
                cx.spawn(following);
            }
        }
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let link = self.link()?.clone();
        link.clear_fault();
        // A device whose dead-man has expired, or that has failed unseen, is in error.
        self.change(LifecycleChange::Reset).await?;
        link.set_active(true);
        self.change(LifecycleChange::Activate).await?;
        self.timer.take().into_iter().for_each(|timer| cx.cancel(timer));
        // A loss is found by the line, and by the proxy half an interval later at most.
        self.timer = Some(cx.every(self.settings.host.interval / 2, DeviceProxy::look));
        Ok(())
    }

    async fn on_deactivated(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.link()?.set_active(false);
        self.change(LifecycleChange::Deactivate).await
    }

    async fn on_aborting(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        if let Some(link) = &self.link {
            link.set_active(false);
            if link.status.borrow().phase == DevicePhase::Serving {
                for object in self.objects() {
                    // Objects in error refuse it: they have made themselves safe.
                    link.outcome(DeviceOrder::Change(object, LifecycleChange::Deactivate)).await;
                }
            }
        }
        Ok(())
    }

    async fn on_reset(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.link()?.clear_fault();
        self.change(LifecycleChange::Reset).await
    }
}

/// Every contract goes to the port that was declared for it.
impl<M: Contract> Handle<M> for DeviceProxy {
    async fn handle(&mut self, message: M, cx: &mut Context<Self>) -> M::Reply {
        match self.deliver(&message).await {
            Ok(reply) => reply,
            Err(why) => {
                if TypeId::of::<M::Reply>() == TypeId::of::<()>() {
                    cx.cell.record.record_dead_letter(M::NAME, &why);
                }
                refuse(why).await
            }
        }
    }
}
