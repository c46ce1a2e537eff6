//! Variables: values that an object owns, and that any node may read, write and watch.
//!
//! ```text
//!  VariableRef ─ read, write, watch ─► the owner's node: Store ─ checks, policies ─► value
//! ```
//!
//! They are kept by the node, not by the component: a value outlives the incarnations of its owner,
//! as its policy says, and can be read while the owner hangs.

mod access;
mod kept_file;
pub(crate) mod ports;
mod store;

pub use blastema_core::variables::{RestorePolicy, ValueState};

pub(crate) use store::{DeclaredVariable, VariableStore, declared};

use crate::messaging::sender::Sender;
use crate::registry::Registry;
use crate::registry::encoding::encoded;
use access::{VariableRequest, VariableWish, WATCH_WITHIN};
use blastema_core::contract::codec;
use blastema_core::variables::ValueReport;
use blastema_core::{ContractIdentity, DeliveryError, ObjectAddress, ObjectName, Variable};
use std::fmt;
use std::marker::PhantomData;
use std::time::Duration;

/// Says why a value is refused.
type ValueCheck<V> = Box<dyn Fn(&V) -> Result<(), String> + Send + Sync>;

/// How a component owns a variable; given to [`Ports::variable`](crate::Ports::variable).
pub struct VariableSpec<V: Variable> {
    default: V,
    policy: RestorePolicy,
    check: ValueCheck<V>,
}

impl<V: Variable> VariableSpec<V> {
    /// A variable with this value until it is written. It keeps its value over its owner's
    /// restarts.
    pub fn new(default: V) -> Self {
        let check = Box::new(|_: &V| Ok(()));
        VariableSpec { default, policy: RestorePolicy::Restore, check }
    }

    /// Sets what happens to the value when an incarnation of its owner ends.
    #[must_use]
    pub fn after_restart(mut self, policy: RestorePolicy) -> Self {
        self.policy = policy;
        self
    }

    /// Refuses values for which this returns a reason, also as default. It runs on the thread of
    /// the writer, and must not block.
    #[must_use]
    pub fn check(
        mut self,
        check: impl Fn(&V) -> Result<(), String> + Send + Sync + 'static,
    ) -> Self {
        self.check = Box::new(check);
        self
    }

    pub(crate) fn declared(self) -> DeclaredVariable {
        declared(&self.default, self.policy, self.check, None)
    }
}

impl<V: Variable> fmt::Debug for VariableSpec<V> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "VariableSpec of {}, {:?}", V::NAME, self.policy)
    }
}

/// A value, and how it stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading<V> {
    /// The value at the time of the reading.
    pub value: V,
    /// Of which change. It rises with every change, also over restarts of the owner and its node.
    pub revision: u64,
    /// How far the value can be relied on.
    pub state: ValueState,
    /// For how long it had stood so when it was read, on the owner's clock.
    pub age: Duration,
}

/// A variable of an object, here or on another node alike. It outlives restarts of both.
#[derive(Clone)]
pub struct VariableRef<V: Variable> {
    sender: Sender<VariableRequest>,
    object: ObjectName,
    value: PhantomData<fn() -> V>,
}

impl<V: Variable> fmt::Debug for VariableRef<V> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {}", V::NAME, self.object)
    }
}

/// An object without variables does not serve what they are asked for by.
fn none_at_all<V: Variable>(why: DeliveryError) -> DeliveryError {
    match why {
        DeliveryError::NotServed { object, contract, .. }
            if contract == <VariableRequest as blastema_core::Contract>::NAME =>
        {
            let (variable, known) = (V::NAME.to_owned(), Vec::new());
            DeliveryError::NoVariable { object, variable, known }
        }
        why => why,
    }
}

/// The variable `V` of the object of this name.
pub(crate) fn find<V: Variable>(
    registry: &Registry,
    name: &str,
) -> Result<VariableRef<V>, DeliveryError> {
    let unknown = |_| DeliveryError::Unknown { name: name.to_owned() };
    let sender = registry.sender::<VariableRequest>(name).map_err(none_at_all::<V>)?;
    let object = match name.contains(':') {
        true => name.parse::<ObjectAddress>().map_err(unknown)?.object,
        false => ObjectName::new(name).map_err(unknown)?,
    };
    Ok(VariableRef { sender, object, value: PhantomData })
}

impl<V: Variable> VariableRef<V> {
    async fn ask(&self, wish: VariableWish) -> Result<ValueReport, DeliveryError> {
        let identity = ContractIdentity::of::<V>().brief().encode();
        let request = VariableRequest { object: self.object.clone(), identity, wish };
        let asked = self.sender.ask_within(request, WATCH_WITHIN).await;
        asked
            .map_err(|error| none_at_all::<V>(error.kind))?
            .map_err(|other| other.difference::<V>("owner"))
    }

    async fn ask_for_value(&self, wish: VariableWish) -> Result<Reading<V>, DeliveryError> {
        let ValueReport { value, revision, state, age } = self.ask(wish).await?;
        let value = codec::decode::<V>(&value)
            .map_err(|error| DeliveryError::Undecodable { reason: error.to_string() })?;
        Ok(Reading { value, revision, state, age })
    }

    async fn ask_to_write(
        &self,
        value: &V,
        if_revision: Option<u64>,
    ) -> Result<u64, DeliveryError> {
        let wish = VariableWish::Write { value: encoded(value)?, if_revision };
        self.ask(wish).await.map(|report| report.revision)
    }

    /// Returns the value.
    ///
    /// # Errors
    /// [`DeliveryError::NoVariable`] where the object has no such variable,
    /// [`DeliveryError::ContractDiffers`] where it is another one; from other nodes, also the errors
    /// of any request.
    pub async fn read(&self) -> Result<Reading<V>, DeliveryError> {
        self.ask_for_value(VariableWish::Read).await
    }

    /// Writes a value. Returns its revision.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`DeliveryError::CheckFailed`] where the owner's check refuses
    /// the value.
    pub async fn write(&self, value: V) -> Result<u64, DeliveryError> {
        self.ask_to_write(&value, None).await
    }

    /// Writes a value if the variable's revision is still this one.
    ///
    /// # Errors
    /// As [`write`](Self::write), and [`DeliveryError::Changed`] where it is another.
    pub async fn write_if(&self, value: V, revision: u64) -> Result<u64, DeliveryError> {
        self.ask_to_write(&value, Some(revision)).await
    }

    /// Follows the variable: first its present value, then every change. Of several changes in one
    /// round trip only the newest is reported.
    pub fn watch(&self) -> VariableWatch<V> {
        VariableWatch { variable: self.clone(), seen: 0 }
    }
}

/// Follows one variable. From [`VariableRef::watch`].
#[derive(Debug)]
pub struct VariableWatch<V: Variable> {
    variable: VariableRef<V>,
    /// No change has this revision.
    seen: u64,
}

impl<V: Variable> VariableWatch<V> {
    /// Waits for the next change. While the owner or its node is absent, the watch waits, and then
    /// misses nothing that is still true.
    ///
    /// # Errors
    /// What waiting does not help against: [`DeliveryError::NoVariable`],
    /// [`DeliveryError::ContractDiffers`], [`DeliveryError::Forbidden`]; an unknown object, unless
    /// it has been read before; and that this node ends.
    pub async fn next(&mut self) -> Result<Reading<V>, DeliveryError> {
        let mut retry = FIRST_RETRY;
        loop {
            match self.variable.ask_for_value(VariableWish::Watch { after: self.seen }).await {
                // Nothing has changed: we are still here.
                Err(DeliveryError::DeadlinePassed) => {}
                Ok(reading) => {
                    self.seen = reading.revision;
                    return Ok(reading);
                }
                Err(why) if self.is_absence(&why) => {
                    tokio::time::sleep(retry).await;
                    retry = (retry * 2).min(LAST_RETRY);
                }
                Err(why) => return Err(why),
            }
        }
    }

    /// Whether the owner may be back later.
    fn is_absence(&self, why: &DeliveryError) -> bool {
        match why {
            DeliveryError::Full
            | DeliveryError::WayFull { .. }
            | DeliveryError::Restarting
            | DeliveryError::Unreachable { .. }
            | DeliveryError::Undelivered { .. }
            | DeliveryError::OutcomeUnknown { .. }
            | DeliveryError::PeerDied { .. }
            | DeliveryError::Left { .. }
            | DeliveryError::Isolated { .. } => true,
            // Its node is there again, and the owner not yet.
            DeliveryError::Unknown { .. }
            | DeliveryError::Misspelt { .. }
            | DeliveryError::NotServed { .. }
            | DeliveryError::NoVariable { .. } => self.seen != 0,
            _ => false,
        }
    }
}

/// After how long a watch asks again for the first time, and at most.
const FIRST_RETRY: Duration = Duration::from_millis(50);
const LAST_RETRY: Duration = Duration::from_secs(1);
