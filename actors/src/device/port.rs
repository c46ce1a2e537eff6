//! One port or variable of a device, with what the proxy does with its contract.

use super::link::{DeviceLink, DeviceOrder, Receive};
use crate::component::Component;
use crate::component::context::Context;
use crate::variable::VariableRef;
use blastema_core::contract::layout::LayoutOf;
use blastema_core::contract::packed;
use blastema_core::{Contract, Delivery, DeliveryError, Described, Event, Variable};
use blastema_lite::{Port, PortKind};
use std::any::TypeId;
use std::pin::Pin;
use std::sync::Arc;
use tracing::warn;

/// A future of the proxy's own thread.
pub(super) type ProxyFuture<T> = Pin<Box<dyn Future<Output = T>>>;

/// The packed value of a variable.
type ReadVariable<C> = fn(&Context<C>) -> ProxyFuture<Result<Vec<u8>, DeliveryError>>;

/// Sets the variable of the device whenever that of the node changes.
type FollowVariable<C> = fn(&Context<C>, Arc<DeviceLink>, usize) -> ProxyFuture<()>;

/// What the proxy, of type `C`, does with a port.
pub(super) enum PortUse<C: Component> {
    /// It sends messages of the contract to the device; only the newest where that is all that
    /// counts.
    In { newest: bool },
    /// It publishes the device's values on this topic.
    Out { topic: String, make: fn(&Context<C>, &str) -> Result<Receive, DeliveryError> },
    /// It asks the device.
    Call,
    /// It sets the variable of the device to the value that the node has.
    Variable { read: ReadVariable<C>, follow: FollowVariable<C> },
}

/// One port of a device.
pub(super) struct DevicePort<C: Component> {
    pub(super) port: Port,
    pub(super) contract: &'static str,
    pub(super) of: TypeId,
    pub(super) message: LayoutOf,
    pub(super) reply: LayoutOf,
    /// What differs where the device has another fingerprint.
    pub(super) difference: fn(u32) -> Option<String>,
    pub(super) used: PortUse<C>,
}

impl<C: Component> DevicePort<C> {
    /// The port of a contract.
    ///
    /// # Errors
    /// The contract has no packed form, or the number is too large.
    pub(super) fn new<M: Contract>(
        object: u8,
        number: u8,
        kind: PortKind,
        used: PortUse<C>,
    ) -> Result<Self, String> {
        let size = |of| {
            let size = packed::size(of).map_err(|error| format!("`{}`: {error}", M::NAME))?;
            Ok::<_, String>(u8::try_from(size).unwrap_or(u8::MAX))
        };
        let (bytes, fingerprint) = (size(M::layout)?, packed::fingerprint::<M>());
        let limit = if kind == PortKind::Call { 64 } else { 32 };
        if number >= limit {
            return Err(format!(
                "`{}`: port {number}, and ports count from 0 to {}",
                M::NAME,
                limit - 1
            ));
        }
        let port = match kind {
            PortKind::In => Port::input(object, number, bytes, fingerprint),
            PortKind::Out => Port::output(object, number, bytes, fingerprint),
            PortKind::Call => {
                Port::call(object, number, bytes, size(M::Reply::layout)?, fingerprint)
            }
            PortKind::Variable => Port::variable(object, number, bytes, fingerprint),
        };
        let (contract, of) = (M::NAME, TypeId::of::<M>());
        let (message, reply): (LayoutOf, LayoutOf) = (M::layout, M::Reply::layout);
        let difference = packed::difference::<M>;
        Ok(DevicePort { port, contract, of, message, reply, difference, used })
    }
}

impl<C: Component> PortUse<C> {
    pub(super) fn input<M: Contract>(reorders: bool) -> Self {
        // On media that reorder packets an older value would take the place of a newer one.
        PortUse::In { newest: M::DELIVERY == Delivery::Newest && !reorders }
    }

    pub(super) fn output<E: Event>(topic: &str) -> Self {
        PortUse::Out { topic: topic.to_owned(), make: publisher::<E, C> }
    }

    pub(super) fn variable<V: Variable>() -> Self {
        PortUse::Variable { read: read::<V, C>, follow: follow::<V, C> }
    }
}

fn publisher<E: Event, C: Component>(
    cx: &Context<C>,
    topic: &str,
) -> Result<Receive, DeliveryError> {
    let publisher = cx.publisher::<E>(topic)?;
    Ok(Box::new(move |bytes| match packed::unpack::<E>(bytes) {
        Ok(event) => publisher.publish_or_count(event, None),
        Err(error) => warn!("a device has published what is no {}: {error}", E::NAME),
    }))
}

fn own<V: Variable, C: Component>(cx: &Context<C>) -> Result<VariableRef<V>, DeliveryError> {
    cx.variable::<V>(cx.name().as_str())
}

fn packed_value<V: Variable>(value: &V) -> Result<Vec<u8>, DeliveryError> {
    packed::pack(value).map_err(|error| DeliveryError::CheckFailed { reason: error.to_string() })
}

fn read<V: Variable, C: Component>(cx: &Context<C>) -> ProxyFuture<Result<Vec<u8>, DeliveryError>> {
    let variable = own::<V, C>(cx);
    Box::pin(async move { packed_value(&variable?.read().await?.value) })
}

fn follow<V: Variable, C: Component>(
    cx: &Context<C>,
    link: Arc<DeviceLink>,
    port: usize,
) -> ProxyFuture<()> {
    let variable = own::<V, C>(cx);
    Box::pin(async move {
        let Ok(variable) = variable else { return };
        let mut watch = variable.watch();
        while let Ok(reading) = watch.next().await {
            let Ok(bytes) = packed_value(&reading.value) else { continue };
            match link.order(DeviceOrder::Write(port, bytes)).await {
                // What the loss of the device has prevented, the next incarnation does.
                Ok(_) | Err(DeliveryError::Restarting | DeliveryError::OutcomeUnknown { .. }) => {}
                Err(error) => link.set_fault(format!("{} cannot be set: {error}", V::NAME)),
            }
        }
    })
}
