//! Which ladder of actions answers which kind of fault: fixed when the robot is designed.

use super::{Ladder, LadderStep, RecoveryAction};
use crate::sorted::SortedMap;
use crate::suggestion::nearest;
use crate::{FaultKind, FaultLocation, NodeName, ObjectName};
use std::collections::BTreeSet;
use std::sync::Arc;

/// The robot's answer to every kind of fault, with exceptions for single components.
///
/// The default plan has an answer to every built-in kind. What it does about a fault at a place of
/// another node is to observe it: that node's own recoverer has it in hand.
///
/// ```
/// use blastema_core::recovery::{Ladder, RecoveryAction, Plan};
/// use blastema_core::{FaultKind, ObjectName};
///
/// let laser = ObjectName::new("laser")?;
/// let plan = Plan::default()
///     .on(FaultKind::Custom("L01".into()), Ladder::first(RecoveryAction::Restart))
///     .on_component(laser.clone(), FaultKind::Silence, Ladder::first(RecoveryAction::SafeStop));
///
/// assert!(plan.check([&laser], [], []).is_ok());
/// # Ok::<(), blastema_core::NameError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    kinds: SortedMap<FaultKind, Ladder>,
    components: SortedMap<ObjectName, SortedMap<FaultKind, Ladder>>,
    abroad: SortedMap<FaultKind, Ladder>,
    observe: Ladder,
}

/// An error in a [`Plan`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The application's list of faults holds a kind that the plan does not answer. Add it with
    /// [`Plan::on`].
    #[error("the fault list holds {code:?}, but the plan has no answer to it{}", hint(.nearest))]
    NoAnswer {
        /// The fault's code.
        code: String,
        /// The code that the plan has and that is spelt most like it.
        nearest: Option<String>,
    },
    /// The plan has an exception for a component that does not exist.
    #[error(
        "the plan has an answer to {kind} of {component}, but there is no such component{}",
        hint(.nearest)
    )]
    NoSuchComponent {
        /// The component that the plan names.
        component: ObjectName,
        /// What it answers.
        kind: FaultKind,
        /// The component that is spelt most like it.
        nearest: Option<String>,
    },
    /// The plan names a strategy that was not given to the node.
    #[error(
        "the plan answers {what} by {strategy:?}, but no strategy of that name was handed over{}",
        hint(.nearest)
    )]
    NoSuchStrategy {
        /// What it answers.
        what: String,
        /// The strategy that it names.
        strategy: String,
        /// The strategy that is spelt most like it.
        nearest: Option<String>,
    },
    /// A step cannot be carried out against that kind of fault, can never succeed, or is never
    /// reached.
    #[error("the plan answers {what} by {action}, {why}")]
    BadStep {
        /// What it answers.
        what: String,
        /// The action of the step.
        action: RecoveryAction,
        /// What is wrong, and what to write.
        why: &'static str,
    },
    /// A fault of the application's own has no code, or that of a built-in kind.
    #[error("a fault of your own cannot have the code {code:?}: {why}")]
    Code {
        /// The code that was given.
        code: String,
        /// What is wrong, and what to write.
        why: &'static str,
    },
}

fn hint(nearest: &Option<String>) -> String {
    nearest.as_ref().map(|name| format!("; did you mean {name:?}?")).unwrap_or_default()
}

impl Default for Plan {
    fn default() -> Self {
        let restart =
            Ladder::first(RecoveryAction::Restart).times(3).then(RecoveryAction::SafeStop);
        let observe = Ladder::first(RecoveryAction::Observe);
        let reroute = Ladder::first(RecoveryAction::Reroute).then(RecoveryAction::Observe);
        let answer = |kind: &FaultKind| match kind {
            FaultKind::ErrorState => Ladder::first(RecoveryAction::Reset)
                .then(RecoveryAction::Restart)
                .times(3)
                .then(RecoveryAction::SafeStop),
            // Warnings: whether a wrong value is worth an incarnation is the application's to say,
            // and a restart does not make work less.
            FaultKind::CheckFailed | FaultKind::Overload | FaultKind::ContractMismatch => {
                observe.clone()
            }
            // The supervisor has already decided to hand it to its parent.
            FaultKind::RestartStorm => observe.clone(),
            // What it sends does harm: the other nodes refuse it, and it cannot be recovered from
            // here.
            FaultKind::NodeFaulty => {
                Ladder::first(RecoveryAction::Isolate).then(RecoveryAction::Observe)
            }
            // A user must change a name.
            FaultKind::NameTaken => observe.clone(),
            // The actuator's node has applied the safe outputs already.
            FaultKind::CommanderGone => observe.clone(),
            // A user, or the application, brings it back.
            FaultKind::NodeInSafeState => observe.clone(),
            // The robot's service manager decides whether its process is started again.
            FaultKind::CrashLoop => observe.clone(),
            // It is over when it is found.
            FaultKind::NodePaused => observe.clone(),
            // The user has accepted it.
            FaultKind::Insecure => observe.clone(),
            // A user must change the policy, or the program.
            FaultKind::Forbidden => observe.clone(),
            // The policy for lost communication acts; a restart brings no one back.
            FaultKind::ConnectionLost => observe.clone(),
            // The service goes on; what is missing is on other nodes, or gone.
            FaultKind::Unreplicated | FaultKind::StateLost => observe.clone(),
            // Its nodes elect a primary by themselves as soon as they can.
            FaultKind::ServiceUnavailable => observe.clone(),
            // The component tries again by itself until what it needs is there.
            FaultKind::Unavailable => observe.clone(),
            // Without an alternative nothing helps but the link's, or the node's, return.
            FaultKind::LinkDown | FaultKind::LinkDegraded | FaultKind::NodeLost => reroute.clone(),
            _ => restart.clone(),
        };
        Plan {
            kinds: FaultKind::built_in().map(|kind| (kind.clone(), answer(kind))).collect(),
            components: SortedMap::new(),
            abroad: SortedMap::new(),
            observe: observe.clone(),
        }
    }
}

impl Plan {
    /// Answers a kind of fault, wherever it is, by `ladder`.
    #[must_use]
    pub fn on(mut self, kind: FaultKind, ladder: Ladder) -> Self {
        self.kinds.insert(kind, ladder);
        self
    }

    /// Answers a kind of fault in one component by `ladder`.
    #[must_use]
    pub fn on_component(mut self, component: ObjectName, kind: FaultKind, ladder: Ladder) -> Self {
        self.components.entry(component).or_default().insert(kind, ladder);
        self
    }

    /// Answers a kind of fault that another node found in itself by `ladder`: to take its service
    /// over, for example. Only a strategy of the application's own can do that.
    #[must_use]
    pub fn on_other_nodes(mut self, kind: FaultKind, ladder: Ladder) -> Self {
        self.abroad.insert(kind, ladder);
        self
    }

    /// The answer that the recoverer of `node` has to a kind of fault at a place.
    pub fn answer(&self, node: &NodeName, kind: &FaultKind, location: &FaultLocation) -> &Ladder {
        match location {
            FaultLocation::Object(address) if address.node == *node => {
                self.answer_for(kind, Some(&address.object))
            }
            FaultLocation::Link { node: here, .. } if here == node => self.answer_for(kind, None),
            // What the plan does about components that do too much helps no computer.
            FaultLocation::Node(_) if *kind == FaultKind::Overload => &self.observe,
            FaultLocation::Node(_) => self.answer_for(kind, None),
            FaultLocation::Object(_) | FaultLocation::Link { .. } => {
                self.abroad.get(kind).unwrap_or(&self.observe)
            }
        }
    }

    /// Whether the guard of `component` may carry out a restart after a panic by itself: only where
    /// the plan's first action is the built-in restart.
    #[doc(hidden)]
    pub fn restarts_on_the_spot(&self, component: &ObjectName) -> bool {
        let first = &self.answer_for(&FaultKind::Panic, Some(component)).steps()[0];
        first.action == RecoveryAction::Restart
    }

    /// The codes of all faults of the application's own that the plan answers.
    #[doc(hidden)]
    pub fn codes(&self) -> BTreeSet<Arc<str>> {
        let of_components = self.components.values().flat_map(SortedMap::keys);
        let kinds = self.kinds.keys().chain(of_components);
        let own = kinds.filter_map(|kind| match kind {
            FaultKind::Custom(code) => Some(code.clone()),
            _ => None,
        });
        own.collect()
    }

    /// Finds what is wrong with the plan before the robot starts: whether every fault kind of
    /// every component, and every kind of the application's own list, has an answer that can be
    /// carried out.
    ///
    /// # Errors
    /// The first thing that is wrong.
    pub fn check<'a>(
        &self,
        components: impl IntoIterator<Item = &'a ObjectName>,
        own_kinds: impl IntoIterator<Item = &'a FaultKind>,
        strategies: impl IntoIterator<Item = &'a str>,
    ) -> Result<(), PlanError> {
        let components: BTreeSet<&ObjectName> = components.into_iter().collect();
        let strategies: BTreeSet<&str> = strategies.into_iter().collect();
        for kind in own_kinds {
            check_code(kind)?;
            let answered = || self.components.values().any(|kinds| kinds.contains_key(kind));
            if !self.kinds.contains_key(kind) && !answered() {
                let code = kind.code();
                let nearest = nearest(code, self.kinds.keys().map(FaultKind::code));
                let (code, nearest) = (code.into(), nearest.map(str::to_owned));
                return Err(PlanError::NoAnswer { code, nearest });
            }
        }
        for (kind, ladder) in &self.kinds {
            check_code(kind)?;
            check_ladder(kind.to_string(), kind, ladder, &strategies)?;
        }
        for (kind, ladder) in &self.abroad {
            check_code(kind)?;
            check_ladder(format!("{kind} of other nodes"), kind, ladder, &strategies)?;
            let local = |step: &&LadderStep| {
                !matches!(step.action, RecoveryAction::Observe | RecoveryAction::Custom(_))
            };
            if let Some(step) = ladder.steps().iter().find(local) {
                let (what, action) = (format!("{kind} of other nodes"), step.action.clone());
                let why =
                    "which can only be carried out by that node itself: use a strategy of your own";
                return Err(PlanError::BadStep { what, action, why });
            }
        }
        for (component, kinds) in &self.components {
            for (kind, ladder) in kinds {
                if !components.contains(component) {
                    let known = components.iter().map(|name| name.as_str());
                    let nearest = nearest(component.as_str(), known).map(str::to_owned);
                    let (component, kind) = (component.clone(), kind.clone());
                    return Err(PlanError::NoSuchComponent { component, kind, nearest });
                }
                check_code(kind)?;
                check_ladder(format!("{kind} of {component}"), kind, ladder, &strategies)?;
            }
        }
        Ok(())
    }

    fn answer_for(&self, kind: &FaultKind, object: Option<&ObjectName>) -> &Ladder {
        let exception = || self.components.get(object?)?.get(kind);
        // Every built-in kind has an answer, and every declared one: what has none is a code that
        // was misspelt, and a slip of the pen must not stop the robot.
        exception().or_else(|| self.kinds.get(kind)).unwrap_or(&self.observe)
    }
}

/// What people read, and rules go by, must be one kind's.
fn check_code(kind: &FaultKind) -> Result<(), PlanError> {
    let FaultKind::Custom(code) = kind else { return Ok(()) };
    let why = if code.is_empty() {
        "give it one, such as GRIP"
    } else if FaultKind::built_in().any(|built_in| built_in.code() == &**code) {
        "a built-in kind has it; choose another one, such as GRIP"
    } else {
        return Ok(());
    };
    Err(PlanError::Code { code: code.as_ref().into(), why })
}

fn check_ladder(
    what: String,
    kind: &FaultKind,
    ladder: &Ladder,
    strategies: &BTreeSet<&str>,
) -> Result<(), PlanError> {
    let link = matches!(kind, FaultKind::LinkDown | FaultKind::LinkDegraded);
    let node = matches!(
        kind,
        FaultKind::NodeLost
            | FaultKind::NodeFaulty
            | FaultKind::NodeInSafeState
            | FaultKind::CrashLoop
            | FaultKind::NodePaused
    );
    let network = link || node;
    let has_ended = matches!(
        kind,
        FaultKind::Panic
            | FaultKind::UnexpectedExit
            | FaultKind::InitializationFailed
            | FaultKind::Fatal
    );
    let mut observed = false;
    for step in ladder.steps() {
        let action = step.action.clone();
        let why = match &action {
            _ if observed => "behind observe, which never fails: let observe stand last",
            _ if step.attempts == 0 => "with 0 attempts: give it at least 1, or leave it out",
            _ if step.within.is_zero() => {
                "within no time at all, so that each attempt fails: give it some"
            }
            _ if step.backoff.factor == 0 => {
                "with pauses that grow by the factor 0: write 1 for equal ones"
            }
            RecoveryAction::Reset | RecoveryAction::Restart | RecoveryAction::MoveToOwnThread
                if network =>
            {
                "which needs a component, and there is none in a link or another node"
            }
            RecoveryAction::Isolate if link => {
                "which needs a component or a node, and a link is neither"
            }
            RecoveryAction::Reroute if !network => {
                "which needs a link or another node, and a component is neither"
            }
            RecoveryAction::Reset if has_ended => {
                "which needs an incarnation, and that one has ended: use restart"
            }
            RecoveryAction::Reset if matches!(kind, FaultKind::Hang | FaultKind::Silence) => {
                "which asks a component that does not answer: use restart"
            }
            RecoveryAction::Custom(name) if !strategies.contains(name.as_ref()) => {
                let nearest = nearest(name, strategies.iter().copied()).map(str::to_owned);
                let strategy = name.as_ref().into();
                return Err(PlanError::NoSuchStrategy { what, strategy, nearest });
            }
            RecoveryAction::Observe => {
                observed = true;
                continue;
            }
            _ => continue,
        };
        return Err(PlanError::BadStep { what, action, why });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recovery::Backoff;
    use crate::testing::object;
    use std::time::Duration;

    fn message(plan: &Plan) -> String {
        let own = [FaultKind::Custom("GRIP".into())];
        let components = [object("laser"), object("planner")];
        plan.check(&components, &own, ["homing"]).expect_err("a wrong plan").to_string()
    }

    fn good() -> Plan {
        Plan::default().on(
            FaultKind::Custom("GRIP".into()),
            Ladder::first(RecoveryAction::Custom("homing".into())),
        )
    }

    #[test]
    fn the_default_plan_answers_every_built_in_kind_and_ends_in_rest_or_observes() {
        let plan = Plan::default();

        assert_eq!(plan.check([], [], []), Ok(()));
        for kind in FaultKind::built_in() {
            let ladder = &plan.kinds[kind];
            let last = &ladder.steps().last().expect("a rung").action;
            assert!(matches!(last, RecoveryAction::SafeStop | RecoveryAction::Observe), "{kind}");
        }
    }

    #[test]
    fn a_code_that_nobody_declared_is_observed_and_brakes_nothing() {
        let node: NodeName = "module1".parse().expect("a good name");
        let plan = Plan::default();

        let location = FaultLocation::Node(node.clone());
        let ladder = plan.answer(&node, &FaultKind::Custom("X".into()), &location);

        assert_eq!(ladder.steps()[0].action, RecoveryAction::Observe);
    }

    #[test]
    fn an_overload_of_the_computer_is_observed_whatever_is_done_about_components() {
        let node: NodeName = "module1".parse().expect("a good name");
        let plan = Plan::default().on(FaultKind::Overload, Ladder::first(RecoveryAction::SafeStop));

        let location = FaultLocation::Node(node.clone());
        let ladder = plan.answer(&node, &FaultKind::Overload, &location);

        assert_eq!(ladder.steps()[0].action, RecoveryAction::Observe);
    }

    #[test]
    fn an_exception_of_a_component_goes_before_the_general_answer() {
        let plan = Plan::default().on_component(
            object("laser"),
            FaultKind::Panic,
            Ladder::first(RecoveryAction::Isolate),
        );

        assert!(!plan.restarts_on_the_spot(&object("laser")));
        assert!(plan.restarts_on_the_spot(&object("planner")));
        let laser = FaultLocation::Object("module1:laser".parse().expect("a good name"));
        let first = |node: &str| {
            let node = node.parse().expect("a good name");
            plan.answer(&node, &FaultKind::Panic, &laser).steps()[0].action.clone()
        };
        assert_eq!(first("module1"), RecoveryAction::Isolate);
        assert_eq!(first("module2"), RecoveryAction::Observe);
    }

    #[test]
    fn a_wrong_plan_says_what_to_write_instead() {
        assert_eq!(
            message(
                &Plan::default()
                    .on(FaultKind::Custom("GRID".into()), Ladder::first(RecoveryAction::Restart),)
            ),
            "the fault list holds \"GRIP\", but the plan has no answer to it; \
             did you mean \"GRID\"?"
        );
        assert_eq!(
            message(&good().on_component(
                object("lazer"),
                FaultKind::Hang,
                Ladder::first(RecoveryAction::Restart),
            )),
            "the plan has an answer to hang of lazer, but there is no such component; \
             did you mean \"laser\"?"
        );
        assert_eq!(
            message(&good().on_component(
                object("laser"),
                FaultKind::Silence,
                Ladder::first(RecoveryAction::Custom("home".into())),
            )),
            "the plan answers silence of laser by \"home\", but no strategy of that name was handed \
             over"
        );
        assert_eq!(
            message(
                &good().on(FaultKind::Silence, Ladder::first(RecoveryAction::Custom("homign".into())),)
            ),
            "the plan answers silence by \"homign\", but no strategy of that name was handed over; \
             did you mean \"homing\"?"
        );
    }

    #[test]
    fn measures_that_cannot_work_are_refused() {
        let wrong = |kind, ladder| message(&good().on(kind, ladder));

        assert!(
            wrong(FaultKind::LinkDown, Ladder::first(RecoveryAction::Restart))
                .starts_with("the plan answers link down by restart, which needs a component")
        );
        assert!(
            wrong(FaultKind::NodeLost, Ladder::first(RecoveryAction::MoveToOwnThread))
                .contains("by move to own thread, which needs a component")
        );
        for ended in [
            FaultKind::Panic,
            FaultKind::UnexpectedExit,
            FaultKind::InitializationFailed,
            FaultKind::Fatal,
        ] {
            assert!(
                wrong(ended, Ladder::first(RecoveryAction::Reset))
                    .ends_with("that one has ended: use restart")
            );
        }
        for stuck in [FaultKind::Hang, FaultKind::Silence] {
            assert!(
                wrong(stuck, Ladder::first(RecoveryAction::Restart).then(RecoveryAction::Reset))
                    .ends_with("does not answer: use restart")
            );
        }
        for kind in FaultKind::built_in() {
            let plan = good().on(kind.clone(), Ladder::first(RecoveryAction::Reroute));
            let own = [FaultKind::Custom("GRIP".into())];
            let works = plan.check(&[object("laser")], &own, ["homing"]).is_ok();
            // B11 to B13 link down, link degraded, node lost; then what else befalls a node.
            let network = ["B11", "B12", "B13", "B15", "B18", "B23", "B24"];
            assert_eq!(works, network.contains(&kind.code()), "{kind}");
        }
        let grip = FaultKind::Custom("GRIP".into());
        assert!(
            wrong(grip, Ladder::first(RecoveryAction::Reroute)).contains("a component is neither")
        );
        assert!(
            message(
                &good().on_other_nodes(FaultKind::Panic, Ladder::first(RecoveryAction::Restart))
            )
            .contains("by that node itself")
        );
        assert!(
            wrong(FaultKind::Silence, Ladder::first(RecoveryAction::Restart).times(0))
                .contains("with 0 attempts")
        );
        assert!(
            wrong(
                FaultKind::Silence,
                Ladder::first(RecoveryAction::Observe).then(RecoveryAction::Restart)
            )
            .contains("behind observe")
        );
    }

    #[test]
    fn a_rung_without_time_and_pauses_without_length_are_refused() {
        let rung = || Ladder::first(RecoveryAction::Restart);
        let wrong = |ladder| message(&good().on(FaultKind::Silence, ladder));

        assert!(wrong(rung().within(Duration::ZERO)).ends_with("each attempt fails: give it some"));
        let still = Backoff { factor: 0, ..Backoff::default() };
        assert!(wrong(rung().backoff(still)).ends_with("write 1 for equal ones"));
    }

    #[test]
    fn a_fault_of_ones_own_has_a_code_that_is_no_other_kinds() {
        let own = |code: &str| FaultKind::Custom(code.into());
        let ladder = || Ladder::first(RecoveryAction::Observe);

        assert!(message(&good().on(own("B01"), ladder())).contains("a built-in kind has it"));
        assert!(message(&good().on(own(""), ladder())).contains("give it one"));
        let of_one = good().on_component(object("laser"), own("B02"), ladder());
        assert!(message(&of_one).contains("\"B02\""));
        let abroad = good().on_other_nodes(own("B04"), ladder());
        assert!(message(&abroad).contains("\"B04\""));
        let declared = Plan::default().check([], &[own("B03")], []).expect_err("B03 is taken");
        assert!(matches!(declared, PlanError::Code { .. }), "{declared}");
    }
}
