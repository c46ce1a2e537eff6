//! Children that follow the script of a test, and the neighbours of a supervisor.

use crate::fault_chain::supervisor::directory::SupervisorDirectory;
use crate::fault_chain::supervisor::{
    SupervisorActor, SupervisorChild, SupervisorNeighbours, SupervisorSetup,
};
use crate::runtime::guardian::Guardian;
use actix::prelude::*;
use blastema_contract::child::{Child, ChildEvent, ChildOrder, ChildReport};
use blastema_contract::monitor::IsolationReported;
use blastema_contract::reports::{Exited, FaultDeclared, StateReported};
use blastema_core::recovery::{ChildRules, SupervisorRules};
use blastema_core::sorted::SortedMap;
use blastema_core::{Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant, ObjectName};
use blastema_doubles::Probe;
use std::sync::{Arc, Mutex, MutexGuard};

/// How a child answers one call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ScriptedReply {
    Works,
    Hangs,
    Panics,
}

/// What all scripted children of a test share: what was done to them, and how they are to answer.
#[derive(Clone, Default)]
pub(crate) struct Script(Arc<Mutex<Pages>>);

#[derive(Default)]
struct Pages {
    done: Vec<String>,
    /// By call, as `start laser`. An answer other than `Works` is used up by its first use.
    answers: SortedMap<String, Vec<ScriptedReply>>,
    alive: SortedMap<ObjectName, Incarnation>,
}

impl Script {
    /// The next calls of this kind are answered so, then all work again.
    pub(crate) fn answer(&self, call: &str, answers: &[ScriptedReply]) {
        self.pages().answers.insert(call.into(), answers.iter().rev().copied().collect());
    }

    /// What was done to the children since last asked.
    pub(crate) fn done(&self) -> Vec<String> {
        std::mem::take(&mut self.pages().done)
    }

    /// This child's incarnation has ended by itself.
    pub(crate) fn dies(&self, name: &str) {
        self.pages().alive.remove(&object(name));
    }

    pub(crate) fn child(&self, name: &str) -> Box<dyn Child> {
        let name = object(name);
        Box::new(Scripted { name, script: self.clone(), report: None, incarnation: Incarnation(0) })
    }

    fn pages(&self) -> MutexGuard<'_, Pages> {
        self.0.lock().expect("no test panics while it holds the script")
    }
}

struct Scripted {
    name: ObjectName,
    script: Script,
    report: Option<Arc<Recipient<ChildReport>>>,
    incarnation: Incarnation,
}

impl Scripted {
    fn call(&self, call: &str) -> ScriptedReply {
        let call = format!("{call} {}", self.name);
        let answer = {
            let mut pages = self.script.pages();
            pages.done.push(call.clone());
            pages.answers.get_mut(&call).and_then(Vec::pop).unwrap_or(ScriptedReply::Works)
        };
        assert!(answer != ScriptedReply::Panics, "{call} panics, as it was told");
        answer
    }

    fn tell(&self, event: ChildEvent) {
        if let Some(report) = &self.report {
            let (object, incarnation) = (self.name.clone(), self.incarnation);
            report.do_send(ChildReport { object, incarnation, event });
        }
    }
}

impl Child for Scripted {
    fn name(&self) -> &ObjectName {
        &self.name
    }

    fn start(
        &mut self,
        incarnation: Incarnation,
        report: Arc<Recipient<ChildReport>>,
    ) -> Incarnation {
        self.report = Some(report);
        self.incarnation = incarnation;
        if self.call("start") == ScriptedReply::Works {
            let earlier = self.script.pages().alive.insert(self.name.clone(), incarnation);
            assert_eq!(earlier, None, "{} lives twice", self.name);
            self.tell(ChildEvent::Started);
        }
        incarnation
    }

    fn order(&mut self, order: ChildOrder) -> bool {
        match order {
            ChildOrder::Stop { .. } => {
                if self.call("stop") == ScriptedReply::Works {
                    self.script.pages().alive.remove(&self.name);
                    self.tell(ChildEvent::Stopped);
                }
            }
            ChildOrder::Abandon | ChildOrder::CutOff => {
                self.call("abandon");
                self.script.pages().alive.remove(&self.name);
            }
            ChildOrder::Reset => {
                if self.call("reset") == ScriptedReply::Works {
                    self.tell(ChildEvent::Reset);
                }
            }
            ChildOrder::Isolate(isolated) => {
                self.call(if isolated { "isolate" } else { "admit" });
            }
            ChildOrder::GrantRestart(granted) => {
                self.call(if granted { "order" } else { "withdraw" });
            }
            ChildOrder::ExpectEnd | ChildOrder::Retire => {}
        }
        false
    }
}

/// The neighbours of the supervisors in a test.
pub(crate) struct Bench {
    pub(crate) script: Script,
    pub(crate) directory: SupervisorDirectory,
    pub(crate) guardian: Guardian,
    pub(crate) deaths: Probe<Exited>,
    pub(crate) faults: Probe<FaultDeclared>,
    pub(crate) states: Probe<StateReported>,
    pub(crate) isolation: Probe<IsolationReported>,
    /// In the node's place, above the root.
    pub(crate) above: Probe<ChildReport>,
}

impl Bench {
    pub(crate) fn new() -> Self {
        let deaths = Probe::start();
        Bench {
            script: Script::default(),
            directory: SupervisorDirectory::default(),
            guardian: Guardian::reporting_to(deaths.recipient()),
            deaths,
            faults: Probe::start(),
            states: Probe::start(),
            isolation: Probe::start(),
            above: Probe::start(),
        }
    }

    pub(crate) fn supervisor(
        &self,
        name: &str,
        rules: SupervisorRules,
        children: Vec<(Box<dyn Child>, ChildRules)>,
    ) -> SupervisorChild {
        let setup = SupervisorSetup {
            name: object(name),
            rules,
            children,
            neighbours: SupervisorNeighbours {
                monitor: self.faults.recipient(),
                states: self.states.recipient(),
                isolation: self.isolation.recipient(),
                directory: self.directory.clone(),
            },
            reserved: None,
        };
        SupervisorActor::start(&self.guardian, None, setup)
    }

    /// A supervisor at work over children of these names.
    pub(crate) async fn serving(&self, rules: SupervisorRules, names: &[&str]) -> SupervisorChild {
        let children = names.iter().map(|name| (self.script.child(name), ChildRules::default()));
        let mut root = self.supervisor("root", rules, children.collect());
        root.start(Incarnation::FIRST, self.above.recipient().into());
        assert_eq!(self.above.expect().await.event, ChildEvent::Started);
        self.script.done();
        root
    }
}

pub(crate) fn object(name: &str) -> ObjectName {
    ObjectName::new(name).expect("a good name")
}

/// A fault of `here:<name>`.
pub(crate) fn fault(id: u64, kind: FaultKind, name: &str, incarnation: u64) -> Fault {
    Fault {
        id: FaultId(id),
        severity: kind.severity(),
        kind,
        location: FaultLocation::Object(format!("here:{name}").parse().expect("a good name")),
        incarnation: Incarnation(incarnation),
        detail: String::new(),
        found_at: Instant::ORIGIN,
        symptom_of: None,
        count: 1,
    }
}
