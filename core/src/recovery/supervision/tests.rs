//! Every state with every input, in words: outputs are compared as lines such as `start laser #2`.

mod additions;
mod budget;
mod exceeded;
mod incarnations;
mod rest;
mod states;
mod strategies;
mod unavailable;

use super::ReplacementCause::{Asked, Behind, Died, Faulty, Stuck};
use super::*;
use crate::recovery::{Restart, Strategy, WhenExceeded};
use crate::testing::object;
use std::time::Duration;

const MINUTE: Duration = Duration::from_secs(60);

struct Rig {
    machine: Supervisor,
    now: Instant,
    calls: u64,
}

fn permanent() -> ChildRules {
    ChildRules::default()
}

fn on_the_spot() -> ChildRules {
    ChildRules { on_the_spot: true, ..ChildRules::default() }
}

fn kept(restart: Restart) -> ChildRules {
    ChildRules { restart, ..ChildRules::default() }
}

/// All restarts are one count, as in Erlang/OTP.
fn together() -> SupervisorRules {
    let when_exceeded = WhenExceeded::Escalate;
    SupervisorRules { when_exceeded, period: MINUTE, ..SupervisorRules::default() }
}

impl Rig {
    fn with(strategy: Strategy, intensity: u32, children: &[(&str, ChildRules)]) -> Self {
        Rig::of(SupervisorRules { strategy, intensity, ..together() }, children)
    }

    fn of(rules: SupervisorRules, children: &[(&str, ChildRules)]) -> Self {
        let mut machine = Supervisor::new(rules);
        let now = Instant::from_millis(1000);
        for (child, rules) in children {
            machine.add_child(object(child), *rules, now).expect("a free name");
        }
        Rig { machine, now, calls: 0 }
    }

    /// Three permanent children at work.
    fn serving(strategy: Strategy) -> Self {
        let children = ["a", "b", "c"].map(|child| (child, permanent()));
        Rig::with(strategy, 3, &children).at_work()
    }

    /// Its children have all begun their first incarnation.
    fn at_work(mut self) -> Self {
        self.begin();
        let children: Vec<_> = self.machine.children().map(|child| child.name.clone()).collect();
        for child in children {
            self.started(child.as_str(), 1);
        }
        self
    }

    fn outputs(&mut self) -> Vec<String> {
        let mut outputs = Vec::new();
        while let Some(action) = self.machine.poll_output() {
            outputs.push(match action {
                SupervisorOutput::Start { child, incarnation } => {
                    format!("start {child} {incarnation}")
                }
                SupervisorOutput::Order { child, order } => match order {
                    ChildOrder::Stop { .. } => format!("stop {child}"),
                    ChildOrder::ExpectEnd => format!("announce_stops {child}"),
                    ChildOrder::Retire => format!("retire {child}"),
                    ChildOrder::Abandon => format!("abandon {child}"),
                    ChildOrder::CutOff => format!("cut off {child}"),
                    ChildOrder::Reset => format!("reset {child}"),
                    ChildOrder::Isolate(true) => format!("isolate {child}"),
                    ChildOrder::Isolate(false) => format!("admit {child}"),
                    ChildOrder::GrantRestart(true) => format!("grant {child}"),
                    ChildOrder::GrantRestart(false) => format!("withdraw {child}"),
                },
                SupervisorOutput::Recovered { call, child, incarnation: Some(incarnation) } => {
                    format!("{} recovered {child} {incarnation}", call.0)
                }
                SupervisorOutput::Recovered { call, child, incarnation: None } => {
                    format!("{} let {child} go", call.0)
                }
                SupervisorOutput::Waits { call, child, incarnation } => {
                    format!("{} {child} {incarnation} waits", call.0)
                }
                SupervisorOutput::GaveUp { call, child, why } => {
                    format!("{} gave {child} up: {why}", call.0)
                }
                SupervisorOutput::Refused { child, incarnation, reason } => {
                    format!("refused {child} {incarnation}: {reason}")
                }
                SupervisorOutput::Unavailable(reason) => format!("waits: {reason}"),
                SupervisorOutput::Overdue { child, .. } => format!("overdue {child}"),
                SupervisorOutput::Left(child) => format!("left {child}"),
                SupervisorOutput::GiveUp(reason) => format!("give up: {reason}"),
                SupervisorOutput::Escalate(reason) => format!("escalate: {reason}"),
                SupervisorOutput::AllStarted => "all started".into(),
                SupervisorOutput::AllStopped => "all stopped".into(),
            });
        }
        outputs
    }

    fn call(&mut self) -> CallId {
        self.calls += 1;
        CallId(self.calls)
    }

    fn begin(&mut self) -> Vec<String> {
        self.machine.handle_begin(Incarnation::FIRST, self.now);
        self.outputs()
    }

    fn end(&mut self) -> Vec<String> {
        self.machine.handle_end(self.now);
        self.outputs()
    }

    fn restart(&mut self, child: &str, cause: ReplacementCause, incarnation: u64) -> Vec<String> {
        let call = self.call();
        let faulty = Some(Incarnation(incarnation));
        self.machine.handle_restart(&object(child), call, cause, faulty, self.now);
        self.outputs()
    }

    fn restart_by_hand(&mut self, child: &str) -> Vec<String> {
        let call = self.call();
        self.machine.handle_restart(&object(child), call, Asked, None, self.now);
        self.outputs()
    }

    fn reset(&mut self, child: &str) -> Vec<String> {
        let call = self.call();
        self.machine.handle_reset(&object(child), call, self.now);
        self.outputs()
    }

    /// Brings the reset of a child to the point where the child itself is asked to recover.
    fn reset_in_group(&mut self, child: &str) {
        let mut outputs = self.reset(child);
        while let Some(output) = (!outputs.is_empty()).then(|| outputs.remove(0)) {
            let words: Vec<&str> = output.split(' ').collect();
            match words[..] {
                ["stop", other] => outputs.extend(self.stopped(other, 1)),
                ["start", other, _] => outputs.extend(self.started(other, 2)),
                _ => {}
            }
        }
    }

    fn reset_done(
        &mut self,
        child: &str,
        incarnation: u64,
        outcome: Result<(), &str>,
    ) -> Vec<String> {
        let outcome = outcome.map_err(Into::into);
        self.machine.handle_reset_done(&object(child), Incarnation(incarnation), outcome, self.now);
        self.outputs()
    }

    fn rest(&mut self, child: &str, cause: ReplacementCause) -> Vec<String> {
        let call = self.call();
        self.machine.handle_rest(&object(child), call, cause, self.now);
        self.outputs()
    }

    fn isolate(&mut self, child: &str, isolated: bool) -> Vec<String> {
        let call = self.call();
        self.machine.handle_isolate(&object(child), None, isolated, call, self.now);
        self.outputs()
    }

    fn isolate_struck(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        let (call, faulty) = (self.call(), Some(Incarnation(incarnation)));
        self.machine.handle_isolate(&object(child), faulty, true, call, self.now);
        self.outputs()
    }

    fn add(&mut self, child: &str, rules: ChildRules) -> Vec<String> {
        let call = self.call();
        self.machine.handle_add(&object(child), rules, call, self.now);
        self.outputs()
    }

    fn remove(&mut self, child: &str) -> Vec<String> {
        let call = self.call();
        self.machine.handle_remove(&object(child), call, self.now);
        self.outputs()
    }

    fn started(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        self.machine.handle_started(&object(child), Incarnation(incarnation), self.now);
        self.outputs()
    }

    fn unavailable(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        let reason = "no device".into();
        self.machine.handle_unavailable(&object(child), Incarnation(incarnation), reason, self.now);
        self.outputs()
    }

    fn fails_to_start(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        self.machine.handle_fails_to_start(&object(child), Incarnation(incarnation), self.now);
        self.outputs()
    }

    fn start_failed(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        let reason = "no device".into();
        self.machine.handle_start_failed(
            &object(child),
            Incarnation(incarnation),
            reason,
            self.now,
        );
        self.outputs()
    }

    /// Comes to work, or ends where its start is failing.
    fn finish_start(&mut self, child: &str, incarnation: u64) {
        self.started(child, incarnation);
        if self.state(child) == ChildState::Starting {
            self.start_failed(child, incarnation);
        }
    }

    fn stopped(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        self.machine.handle_stopped(&object(child), Incarnation(incarnation), self.now);
        self.outputs()
    }

    fn died(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        self.machine.handle_died(&object(child), Incarnation(incarnation), false, None, self.now);
        self.outputs()
    }

    fn returned(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        self.machine.handle_died(&object(child), Incarnation(incarnation), true, None, self.now);
        self.outputs()
    }

    fn died_on_the_spot(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        let next = Some(Incarnation(incarnation + 1));
        self.machine.handle_died(&object(child), Incarnation(incarnation), false, next, self.now);
        self.outputs()
    }

    fn escalated(&mut self, child: &str, incarnation: u64) -> Vec<String> {
        let reason = "too much".into();
        self.machine.handle_escalated(&object(child), Incarnation(incarnation), reason, self.now);
        self.outputs()
    }

    fn pass(&mut self, seconds: u64) -> Vec<String> {
        self.now = self.now + Duration::from_secs(seconds);
        self.machine.handle_timeout(self.now);
        self.outputs()
    }

    fn state(&self, child: &str) -> ChildState {
        let child = object(child);
        let status = self.machine.children().find(|status| status.name == child);
        status.expect("a child of this name").state
    }
}
