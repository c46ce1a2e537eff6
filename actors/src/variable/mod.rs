//! Variables: values that an object owns, and that any node may read, write and watch.
//!
//! ```text
//!  VariableRef ─ read, write, watch ─► the owner's node: Store ─ checks, policies ─► value
//!  Transaction ─ several together ───►
//! ```
//!
//! They are kept by the node, not by the component: a value outlives the incarnations of its owner,
//! as its policy says, and can be read while the owner hangs.

mod access;
mod kept_file;
pub(crate) mod ports;
mod store;

pub use blastema_core::variables::{RestorePolicy, ValueState};

pub(crate) use store::{
    DeclaredVariable, KEPT_VARIABLES, RESTORED_VARIABLES, VariableStore, declared,
};

use crate::messaging::sender::Sender;
use crate::registry::Registry;
use crate::registry::encoding::encoded;
use access::{VariableRequest, VariableSelector, WATCH_WITHIN, WriteEntry};
use blastema_core::contract::codec;
use blastema_core::variables::ValueReport;
use blastema_core::{ContractIdentity, DeliveryError, NodeName, ObjectName, Variable};
use blastema_macros::Structure;
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

/// The decision on a variable that awaits one.
#[derive(Clone, Debug, PartialEq, Structure)]
#[contract(crate = "crate")]
pub enum RestoreDecision<V> {
    /// The value from before.
    Restore,
    /// The default of the variable.
    Default,
    /// The given value, in place of both.
    Value(V),
}

/// A variable of an object, here or on another node alike. It outlives restarts of both.
#[derive(Clone)]
pub struct VariableRef<V: Variable> {
    sender: Sender<VariableRequest>,
    node: Option<NodeName>,
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
    let sender = registry.sender::<VariableRequest>(name).map_err(none_at_all::<V>)?;
    let unknown = |_| DeliveryError::Unknown { name: name.to_owned() };
    let (node, object) = registry.parse(name).map_err(unknown)?;
    Ok(VariableRef { sender, node, object, value: PhantomData })
}

impl<V: Variable> VariableRef<V> {
    fn wanted(&self) -> VariableSelector {
        let identity = ContractIdentity::of::<V>().brief().encode();
        VariableSelector { object: self.object.clone(), identity }
    }

    async fn ask(&self, access: VariableRequest) -> Result<ValueReport, DeliveryError> {
        let asked = self.sender.ask_within(access, WATCH_WITHIN).await;
        asked
            .map_err(|error| none_at_all::<V>(error.kind))?
            .map_err(|other| other.difference::<V>("owner"))
    }

    async fn ask_for_value(&self, access: VariableRequest) -> Result<Reading<V>, DeliveryError> {
        let ValueReport { value, revision, state, age } = self.ask(access).await?;
        Ok(Reading { value: codec::decode::<V>(&value)?, revision, state, age })
    }

    /// Returns the value.
    ///
    /// # Errors
    /// [`DeliveryError::NoVariable`] where the object has no such variable,
    /// [`DeliveryError::ContractDiffers`] where it is another one, [`DeliveryError::Undecided`]
    /// while a decision is awaited; from other nodes, also the errors of any request.
    pub async fn read(&self) -> Result<Reading<V>, DeliveryError> {
        self.ask_for_value(VariableRequest::Read { variable: self.wanted() }).await
    }

    /// Writes a value. Returns its revision.
    ///
    /// # Errors
    /// As [`read`](Self::read), and [`DeliveryError::CheckFailed`] where the owner's check refuses
    /// the value.
    pub async fn write(&self, value: V) -> Result<u64, DeliveryError> {
        Transaction::new().write(self, value).commit().await
    }

    /// Writes a value if the variable's revision is still this one.
    ///
    /// # Errors
    /// As [`write`](Self::write), and [`DeliveryError::Changed`] where it is another.
    pub async fn write_if(&self, value: V, revision: u64) -> Result<u64, DeliveryError> {
        Transaction::new().write_if(self, value, revision).commit().await
    }

    /// Decides what becomes of the value after a restart, where the owner's policy is to ask first.
    ///
    /// # Errors
    /// As [`write`](Self::write), and [`DeliveryError::Changed`] where no decision is awaited any
    /// more.
    pub async fn decide(&self, decision: RestoreDecision<V>) -> Result<u64, DeliveryError> {
        let value = match decision {
            RestoreDecision::Restore => RestoreDecision::Restore,
            RestoreDecision::Default => RestoreDecision::Default,
            RestoreDecision::Value(value) => RestoreDecision::Value(encoded(&value)?),
        };
        let writes = vec![WriteEntry { variable: self.wanted(), value, if_revision: None }];
        let access = VariableRequest::Write { writes, decides: true };
        self.ask(access).await.map(|report| report.revision)
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
    /// Waits for the next change. A value that awaits a decision is reported as such, with the
    /// previous value. While the owner or its node is absent, the watch waits, and then misses
    /// nothing that is still true.
    ///
    /// # Errors
    /// What waiting does not help against: [`DeliveryError::NoVariable`],
    /// [`DeliveryError::ContractDiffers`], [`DeliveryError::Forbidden`]; an unknown object, unless
    /// it has been read before; and that this node ends.
    pub async fn next(&mut self) -> Result<Reading<V>, DeliveryError> {
        let mut retry = FIRST_RETRY;
        loop {
            let variable = self.variable.wanted();
            let access = VariableRequest::Watch { variable, after: self.seen };
            match self.variable.ask_for_value(access).await {
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

/// Values that are written together or not at all. All of the variables must be on one node.
#[derive(Debug, Default)]
#[must_use = "nothing is written before commit()"]
pub struct Transaction {
    writes: Vec<WriteEntry>,
    target: Option<(Sender<VariableRequest>, Option<NodeName>)>,
    wrong: Option<DeliveryError>,
}

impl Transaction {
    /// Nothing to be written yet.
    pub fn new() -> Self {
        Transaction::default()
    }

    /// Writes this value.
    pub fn write<V: Variable>(self, variable: &VariableRef<V>, value: V) -> Self {
        self.add(variable, &value, None)
    }

    /// Writes this value if the variable's revision is still this one.
    pub fn write_if<V: Variable>(self, variable: &VariableRef<V>, value: V, revision: u64) -> Self {
        self.add(variable, &value, Some(revision))
    }

    fn add<V: Variable>(
        mut self,
        variable: &VariableRef<V>,
        value: &V,
        if_revision: Option<u64>,
    ) -> Self {
        let node = &variable.node;
        let target = self.target.get_or_insert_with(|| (variable.sender.clone(), node.clone()));
        if target.1 != *node {
            let reason = format!("{variable:?} is on another node: write there separately");
            self.wrong.get_or_insert(DeliveryError::CheckFailed { reason });
        }
        match encoded(value) {
            Ok(value) => {
                let (variable, value) = (variable.wanted(), RestoreDecision::Value(value));
                self.writes.push(WriteEntry { variable, value, if_revision });
            }
            Err(why) => {
                self.wrong.get_or_insert(why);
            }
        }
        self
    }

    /// Writes all values. Returns the new revision.
    ///
    /// # Errors
    /// The first error, as for [`VariableRef::write_if`]; no value is written then. After
    /// [`DeliveryError::DeadlinePassed`], and where the node was lost meanwhile, it is not known
    /// whether everything or nothing was: read one of them.
    pub async fn commit(self) -> Result<u64, DeliveryError> {
        if let Some(why) = self.wrong {
            return Err(why);
        }
        let Some((sender, _)) = self.target else {
            return Err(DeliveryError::CheckFailed { reason: "nothing is to be written".into() });
        };
        let access = VariableRequest::Write { writes: self.writes, decides: false };
        let asked = sender.ask_within(access, WATCH_WITHIN).await;
        let written = asked.map_err(|error| error.kind)?.map_err(|other| {
            let difference = format!("{} is another one there: read it to see how", other.name());
            DeliveryError::ContractDiffers { difference }
        });
        written.map(|report| report.revision)
    }
}
