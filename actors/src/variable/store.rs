//! The variables of a node: drives the machine in the core.

use super::RestoreDecision;
use super::access::{VariableRequest, VariableSelector, WriteEntry};
use super::kept_file::{self, LoadError, PersistenceFile, WriteDone};
use crate::messaging::reply::Responder;
use crate::platform::file_lock::FileLock;
use crate::platform::{self, lock, panics};
use crate::registry::ContractPort;
use crate::registry::access::{AccessControl, MessageOrigin};
use crate::registry::encoding::{RequestRefusal, encoded, named_contract};
use crate::runtime::reports::FaultReports;
use blastema_core::contract::codec;
use blastema_core::net::trust::policy::Verb;
use blastema_core::sorted::SortedMap;
use blastema_core::variables::{
    PersistedValue, RestorePolicy, ValueReport, ValueState, ValueWrite, VariableDeclaration,
    VariableKey, Variables,
};
use blastema_core::{Blob, ContractIdentity, DeliveryError, ObjectName, PeerIdentity, Variable};
use bytes::Bytes;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

/// Under which name the file of the variables is an object of its node.
pub(crate) const KEPT_VARIABLES: &str = "variables";
/// In which object it is a fault that values from before are not what they were.
pub(crate) const RESTORED_VARIABLES: &str = "variables/restored";

/// Says whether bytes are a value that the owner takes.
type Check = Arc<dyn Fn(&[u8]) -> Result<(), DeliveryError> + Send + Sync>;
/// Told that there is a new value.
pub(crate) type ValueObserver = Arc<dyn Fn() + Send + Sync>;
/// Says whether the caller may still have the value.
type Permit = Box<dyn Fn() -> Result<(), DeliveryError> + Send>;

/// A caller that waits for a change. Its right is checked again when there is one: another roster
/// may have taken it away.
struct WaitingWatch {
    permit: Permit,
    reply: Responder<VariableRequest>,
}

/// The name of a variable's contract, and the variable as a component declares it, without its
/// type.
pub(crate) type DeclaredVariable =
    (&'static str, Result<VariableDeclaration<VariableFacts>, DeliveryError>);

/// A variable for which `check` has a reason to refuse some values. The observer is called after
/// each write, on the writer's thread.
pub(crate) fn declared<V: Variable>(
    default: &V,
    policy: RestorePolicy,
    check: impl Fn(&V) -> Result<(), String> + Send + Sync + 'static,
    observer: Option<ValueObserver>,
) -> DeclaredVariable {
    let check = move |bytes: &[u8]| {
        let value = codec::decode::<V>(bytes)?;
        let checked = panics::caught(|| check(&value)).map_err(|why| format!("it {why}"));
        checked.flatten().map_err(|reason| DeliveryError::CheckFailed { reason })
    };
    let default = encoded(default).and_then(|bytes| check(&bytes).map(|()| bytes.into()));
    let facts =
        VariableFacts { identity: ContractIdentity::of::<V>(), check: Arc::new(check), observer };
    (V::NAME, default.map(|default| VariableDeclaration { default, policy, facts }))
}

/// What is known of a variable beside its value.
#[derive(Clone)]
pub(crate) struct VariableFacts {
    identity: ContractIdentity,
    check: Check,
    observer: Option<ValueObserver>,
}

struct Inner {
    machine: Variables<VariableFacts, WaitingWatch>,
    /// Values of an earlier process whose owner is not there yet, or not any more.
    kept: SortedMap<VariableKey, PersistedValue>,
    file: Option<PersistenceFile>,
    /// Faults of values that could not be restored, until they can be reported.
    complaints: Vec<String>,
}

impl Inner {
    /// The object has no such variable, but perhaps others.
    fn no_variable(&self, (object, variable): &VariableKey) -> DeliveryError {
        let of_object = self.machine.keys().filter(|(owner, _)| owner == object);
        let known = of_object.map(|(_, known)| known.clone()).collect();
        let (object, variable) = (object.to_string(), variable.clone());
        DeliveryError::NoVariable { object, variable, known }
    }

    /// A value from before, if it is what the contract and the owner's check take.
    fn restored(&mut self, variable: &VariableKey, facts: &VariableFacts) -> Option<Bytes> {
        let kept = self.kept.remove(variable)?;
        let refused = match kept.fingerprint == facts.identity.fingerprint {
            true => (facts.check)(&kept.value).err().map(|why| why.to_string()),
            false => Some("its contract has changed since".to_owned()),
        };
        match refused {
            None => Some(kept.value.into()),
            Some(why) => {
                let (object, name) = variable;
                self.complaints.push(format!(
                    "{name} of {object} begins with its default, since its kept value is refused: {why}"
                ));
                None
            }
        }
    }

    /// All that the next process is to find.
    fn worth_keeping(&self) -> Vec<PersistedValue> {
        let present = self.machine.kept().map(|(variable, facts, value)| {
            let (variable, fingerprint) = (variable.clone(), facts.identity.fingerprint);
            PersistedValue { variable, fingerprint, value: value.to_vec() }
        });
        present.chain(self.kept.values().cloned()).collect()
    }
}

/// Whether a message may do what it wants with all variables that it names.
fn may(
    rights: &AccessControl,
    from: MessageOrigin,
    access: &VariableRequest,
) -> Result<(), DeliveryError> {
    let check = |verb, VariableSelector { object, identity }: &VariableSelector| {
        rights.check(from, verb, object, || {
            // What cannot be read is refused as such when it is served.
            PeerIdentity::decode(identity).map_or_else(|_| String::new(), |identity| identity.name)
        })
    };
    match access {
        VariableRequest::Read { variable } | VariableRequest::Watch { variable, .. } => {
            check(Verb::Read, variable)
        }
        VariableRequest::Write { writes, .. } => {
            writes.iter().try_for_each(|write| check(Verb::Set, &write.variable))
        }
    }
}

/// The variables of a node. Clones share them.
#[derive(Clone)]
pub(crate) struct VariableStore(Arc<Mutex<Inner>>);

impl Default for VariableStore {
    fn default() -> Self {
        // Above every revision of any earlier process, as long as fewer than a million changes come
        // in one millisecond.
        let machine = Variables::new(platform::node_incarnation().0 << 20);
        VariableStore(Arc::new(Mutex::new(Inner {
            machine,
            kept: SortedMap::new(),
            file: None,
            complaints: Vec::new(),
        })))
    }
}

impl VariableStore {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        lock(&self.0)
    }

    /// Takes values from this file, and keeps them there from now on; called before anything is
    /// declared.
    pub(crate) fn keep_in(
        &self,
        path: PathBuf,
        lock: Option<FileLock>,
        changed: impl Fn(Result<(), String>) + Send + 'static,
    ) -> io::Result<()> {
        let mut inner = self.lock();
        match kept_file::load(&path) {
            Ok(values) => {
                let values = values.into_iter().map(|kept| (kept.variable.clone(), kept));
                inner.kept = values.collect();
            }
            // It may be whole, and is not ours to move.
            Err(LoadError::Unreadable(error)) => return Err(error),
            Err(error) => {
                let aside = kept_file::set_aside(&path)?;
                inner.complaints.push(format!(
                    "variables begin with their defaults, since {} is refused: {error}. It is set aside \
                     as {}: see what has damaged it",
                    path.display(),
                    aside.display()
                ));
            }
        }
        inner.file = Some(PersistenceFile::start(path, lock, changed)?);
        Ok(())
    }

    /// The node has ended: nothing is written any more, and another node may have the file.
    pub(crate) fn close_file(&self) {
        self.lock().file.iter().for_each(PersistenceFile::close);
    }

    /// Reports what was wrong with the values that were to be restored.
    pub(crate) fn report_complaints(&self, reports: &FaultReports) {
        let complaints = std::mem::take(&mut self.lock().complaints);
        complaints.into_iter().for_each(|detail| reports.declare(RESTORED_VARIABLES, detail));
    }

    /// The object has these variables from now on; the port is where they are asked for.
    pub(crate) fn declare(
        &self,
        object: &ObjectName,
        declared: Vec<DeclaredVariable>,
        is_isolated: impl Fn() -> bool + Send + Sync + 'static,
        rights: AccessControl,
    ) -> Result<ContractPort, DeliveryError> {
        let mut inner = self.lock();
        for (name, declaration) in declared {
            let (key, declaration) = ((object.clone(), name.to_owned()), declaration?);
            let kept = inner.restored(&key, &declaration.facts);
            inner.machine.handle_declared(key, declaration, kept, platform::now());
        }
        drop(inner);
        let store = self.clone();
        let isolated = DeliveryError::isolated(object);
        let serve = move |access: VariableRequest,
                          from: MessageOrigin,
                          reply: Responder<VariableRequest>| {
            let permitted = match is_isolated() {
                true => Err(isolated.clone()),
                false => may(&rights, from, &access),
            };
            if let Err(why) = permitted {
                return reply.refuse(why, None);
            }
            let (rights, asked) = (rights.clone(), access.clone());
            store.serve(access, Box::new(move || may(&rights, from, &asked)), reply);
        };
        Ok(ContractPort::served_by(serve))
    }

    /// An incarnation of the object has ended: applies the policies.
    pub(crate) fn end_incarnation(&self, object: &ObjectName) {
        let mut inner = self.lock();
        inner.machine.handle_owner_ended(object, platform::now());
        tell_watchers(inner);
    }

    /// The object is gone.
    pub(crate) fn withdraw(&self, object: &ObjectName) {
        let mut inner = self.lock();
        if inner.file.is_some() {
            // It may be there again in the next process.
            let left = inner.worth_keeping().into_iter().filter(|kept| kept.variable.0 == *object);
            let left: Vec<_> = left.map(|kept| (kept.variable.clone(), kept)).collect();
            inner.kept.extend(left);
        }
        inner.machine.handle_withdrawn(object);
        tell_watchers(inner);
    }

    fn serve(&self, access: VariableRequest, permit: Permit, reply: Responder<VariableRequest>) {
        match access {
            VariableRequest::Read { variable } => {
                let read = |(key, _)| Ok(self.lock().machine.read(&key, platform::now())?);
                reply.settle(self.find(&variable).and_then(read));
            }
            VariableRequest::Watch { variable, after } => match self.find(&variable) {
                Ok((key, _)) => self.watch(key, after, WaitingWatch { permit, reply }),
                Err(refusal) => reply.settle(Err(refusal)),
            },
            VariableRequest::Write { writes, decides } => match self.checked(writes) {
                Ok(writes) => self.write(writes, decides, reply),
                Err(refusal) => reply.settle(Err(refusal)),
            },
        }
    }

    fn watch(&self, variable: VariableKey, after: u64, waiting: WaitingWatch) {
        let mut inner = self.lock();
        // Those whose incarnation has ended went without a word.
        inner.machine.retain_watchers(|waiting| waiting.reply.is_wanted());
        inner.machine.handle_watch(waiting, variable, after, platform::now());
        tell_watchers(inner);
    }

    /// How many wait for a change.
    #[cfg(test)]
    pub(crate) fn watchers(&self) -> usize {
        self.lock().machine.watchers()
    }

    /// Writes values. With a file, the caller is answered when they are on the disk.
    fn write(&self, writes: Vec<ValueWrite>, decides: bool, reply: Responder<VariableRequest>) {
        let (mut inner, now) = (self.lock(), platform::now());
        let declared = |write: &ValueWrite| inner.machine.declaration(&write.variable);
        let observers = writes.iter().filter_map(|write| declared(write)?.facts.observer.clone());
        let observers: Vec<_> = observers.collect();
        let has_space = inner.file.as_ref().map_or(Ok(()), PersistenceFile::check);
        let written = has_space.and_then(|()| inner.machine.handle_write(writes, decides, now));
        let revision = match written {
            Ok(revision) => revision,
            Err(why) => {
                drop(inner);
                return reply.refuse(why, None);
            }
        };
        let (state, age) = (ValueState::Current, Duration::ZERO);
        let report = ValueReport { value: Blob::default(), revision, state, age };
        let done: WriteDone = Box::new(move |kept| match kept {
            Ok(()) => reply.give(Ok(report)),
            Err(reason) => reply.refuse(DeliveryError::NotKept { reason }, None),
        });
        let done = match &inner.file {
            // Under the lock: a later file has all that an earlier one has.
            Some(file) => {
                file.keep(inner.worth_keeping(), done);
                None
            }
            None => Some(done),
        };
        tell_watchers(inner);
        observers.into_iter().for_each(|observer| observer());
        done.into_iter().for_each(|done| done(Ok(())));
    }

    /// The value of a variable of this object, as it is now.
    pub(crate) fn value(&self, object: &ObjectName, name: &str) -> Result<Bytes, DeliveryError> {
        let key = (object.clone(), name.to_owned());
        let inner = self.lock();
        if inner.machine.declaration(&key).is_none() {
            return Err(inner.no_variable(&key));
        }
        inner.machine.read(&key, platform::now()).map(|report| report.value.into())
    }

    fn checked(&self, writes: Vec<WriteEntry>) -> Result<Vec<ValueWrite>, RequestRefusal> {
        let mut checked = Vec::new();
        for WriteEntry { variable, value, if_revision } in writes {
            let (variable, VariableDeclaration { facts, default, .. }) = self.find(&variable)?;
            let value = match value {
                RestoreDecision::Restore => None,
                RestoreDecision::Default => Some(default),
                RestoreDecision::Value(value) => {
                    (facts.check)(&value)?;
                    Some(value.into())
                }
            };
            checked.push(ValueWrite { variable, value, if_revision });
        }
        Ok(checked)
    }

    /// The variable, if it is what the asker takes it for.
    fn find(
        &self,
        wanted: &VariableSelector,
    ) -> Result<(VariableKey, VariableDeclaration<VariableFacts>), RequestRefusal> {
        let theirs = named_contract(&wanted.identity)?;
        let key = (wanted.object.clone(), theirs.name.clone());
        let inner = self.lock();
        let known = inner.machine.declaration(&key).cloned();
        let known = known.ok_or_else(|| inner.no_variable(&key))?;
        drop(inner);
        RequestRefusal::check(&known.facts.identity, &theirs)?;
        Ok((key, known))
    }
}

/// Tells the watchers what the machine wants them told, outside of the lock.
fn tell_watchers(mut inner: MutexGuard<'_, Inner>) {
    let reports: Vec<_> = std::iter::from_fn(|| inner.machine.poll_output()).collect();
    drop(inner);
    for (WaitingWatch { permit, reply }, result) in reports {
        reply.settle(permit().and(result).map_err(RequestRefusal::Why));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::MessageMetadata;
    use blastema_core::Contract;
    use blastema_core::NodeName;
    use blastema_core::net::NodeId;
    use blastema_core::net::trust::access::AccessPolicy;
    use blastema_core::net::trust::crypto::Seed;
    use blastema_core::net::trust::policy::Role;
    use blastema_core::net::trust::roster::{NodeRoster, RosterNode};

    #[derive(Clone, Debug, PartialEq, blastema_macros::Variable)]
    #[contract(crate = "crate")]
    struct Limit(u32);

    fn node(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    /// The rights at `base`, where these alone may read the limit.
    fn only(readers: &str) -> AccessPolicy {
        let listed = ["base", "arm"].iter().zip(1..).map(|(name, seed)| RosterNode {
            name: node(name),
            keys: Seed::new([seed; 32]).public_keys(),
            role: Role::Node,
        });
        let roster = NodeRoster::new(node("ranger"), listed).unwrap();
        let lines = format!("policy\nonly {readers} may read on base/wheels\nend");
        let roster = NodeRoster::parse(&roster.to_text().replace("end", &lines)).unwrap();
        AccessPolicy::new(node("base"), &roster)
    }

    #[test]
    fn a_watch_that_waits_when_the_roster_closes_the_variable_gets_no_value_any_more() {
        let (store, rights) = (VariableStore::default(), AccessControl::default());
        let wheels = ObjectName::new("wheels").unwrap();
        let limit = declared(&Limit(1), RestorePolicy::Restore, |_| Ok(()), None);
        let port = store.declare(&wheels, vec![limit], || false, rights.clone()).unwrap();
        let skeleton = port.into_skeleton();
        let identity = ContractIdentity::of::<Limit>().brief().encode();
        let variable = VariableSelector { object: wheels.clone(), identity };
        let watch = |after| {
            let answered = Arc::new(Mutex::new(None));
            let keep = answered.clone();
            let access = VariableRequest::Watch { variable: variable.clone(), after };
            let mut bytes = Vec::new();
            codec::encode(&access, &mut bytes).unwrap();
            let from = Some(NodeId::of(&node("arm")));
            let metadata = MessageMetadata { from, ..MessageMetadata::default() };
            let reply_to = Box::new(move |reply| *keep.lock().unwrap() = Some(reply));
            skeleton.deliver(&bytes.into(), metadata, Some(reply_to)).unwrap();
            move || {
                let reply: Option<Result<blastema_core::GatherBuffer, DeliveryError>> =
                    answered.lock().unwrap().take();
                let bytes = reply.expect("it is answered")?.into_bytes();
                Ok(codec::decode_reply::<VariableRequest>(&bytes).unwrap().unwrap().revision)
            }
        };
        let write = |value| {
            let variable = (wheels.clone(), Limit::NAME.to_owned());
            let value = encoded(&Limit(value)).unwrap().into();
            let mut inner = store.lock();
            let write = ValueWrite { variable, value: Some(value), if_revision: None };
            inner.machine.handle_write(vec![write], false, platform::now()).unwrap();
            tell_watchers(inner);
        };
        rights.replace(only("arm"));
        let revision = watch(0)().unwrap();

        let answer = watch(revision);
        write(2);
        let revision = answer().unwrap();

        let answer = watch(revision);
        rights.replace(only("base"));
        write(3);
        assert!(matches!(answer(), Err(DeliveryError::Forbidden { .. })));
        assert_eq!(rights.refusals().len(), 1);
    }
}
