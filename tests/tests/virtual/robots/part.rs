//! The component that a random robot is made of: it does what the plan says, and writes down what
//! it does.

use crate::robots::ledger::{Answer, Cause, Ledger, What};
use crate::robots::plan::{Blow, Branch, Clock, Deed, Group, PartPlan, Pull, Robot, TOPICS};
use blastema::platform::now;
use blastema::prelude::*;
use blastema::{Down, Failure, NodeBuilder, RequestError};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Asks a component for a deed; it answers with its incarnation.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "robots/work", reply = u64)]
pub(crate) struct Work {
    pub(crate) number: u64,
    pub(crate) deed: Deed,
}

/// What components publish.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "robots/reading")]
pub(crate) struct Reading {
    topic: u64,
    from: u64,
    of: u64,
    n: u64,
}

/// The publisher of events that no component takes: they show how far a topic has got.
const MARK: u64 = u64::MAX;

impl Reading {
    /// An event that every condition notes and refuses.
    pub(crate) fn mark(topic: usize, n: u64) -> Reading {
        Reading { topic: topic as u64, from: MARK, of: 0, n }
    }
}

/// A message of a flood.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "robots/load")]
pub(crate) struct Load(pub(crate) u64);

const PERIOD: Duration = Duration::from_secs(10);
/// The component that watches all others and is struck by nothing.
pub(crate) const WATCHER: &str = "watcher";

impl Robot {
    /// The node of this plan.
    pub(crate) fn builder(&self, ledger: &Ledger) -> NodeBuilder {
        let root = self.supervisor(&self.root, ledger);
        let builder = Node::builder("robot").plan(self.recovery()).root(root);
        match self.clock {
            Clock::Virtual => builder,
            Clock::Real { threads } => builder.work_threads(usize::from(threads)),
        }
    }

    fn is_real(&self) -> bool {
        self.clock != Clock::Virtual
    }

    fn supervisor(&self, group: &Group, ledger: &Ledger) -> SupervisorSpec {
        let Group { name, strategy, escalates, intensity, children } = group;
        let mut spec = SupervisorSpec::new(name, *strategy).intensity(*intensity, PERIOD);
        if *escalates {
            spec = spec.when_exceeded(WhenExceeded::Escalate);
        }
        for child in children {
            spec = match child {
                Branch::Part(index) => {
                    let (part, restart) = self.spec(*index, ledger);
                    spec.child_with(part, restart)
                }
                Branch::Group(below) => spec.supervisor(self.supervisor(below, ledger)),
            };
        }
        spec
    }

    pub(crate) fn spec(&self, index: usize, ledger: &Ledger) -> (ChildSpec<Part>, Restart) {
        let plan = &self.parts[index];
        let (made, world) = (plan.clone(), ledger.clone());
        let factory =
            move || Part { index, incarnation: 0, plan: made.clone(), ledger: world.clone() };
        let (listens, broken, world) = (plan.listens.clone(), plan.broken_ports, ledger.clone());
        let ports = move |ports: &mut Ports<Part>| {
            assert!(!broken, "panic in ports of the plan");
            for (topic, each) in listens {
                let world = world.clone();
                let condition = move |reading: &Reading| {
                    if reading.from == MARK {
                        world.mark(index, topic, reading.n);
                        return false;
                    }
                    match world.next_blow(index) {
                        None => {}
                        Some(Blow::Block(ms)) => {
                            world.write_current(index, What::Struck(Cause::Block(ms)));
                            block(Duration::from_millis(ms));
                        }
                        Some(Blow::Panic) => {
                            let number = world.number();
                            world.write_current(index, What::Struck(Cause::Condition(number)));
                            panic!("panic number {number} of the plan");
                        }
                    }
                    reading.n.is_multiple_of(each)
                };
                ports.listen::<Reading>().on(&format!("t{topic}")).only_if(condition);
            }
        };
        let (capacity, when_full) = plan.queue;
        let mut spec = ChildSpec::new(&plan.name, factory)
            .with_ports(ports)
            .queue(capacity, when_full)
            .max_wait(Duration::from_millis(plan.max_wait_ms));
        if let Some(hz) = plan.rate_hz {
            spec = spec.rate_hz(f64::from(hz));
            if plan.push {
                // A busy computer may be late for a short while.
                let least = Duration::from_millis(if self.is_real() { 200 } else { 0 });
                let interval = least.max(Duration::from_secs(1) / hz);
                spec = spec.liveness(Liveness::push(interval, 3));
            }
        }
        if plan.pull {
            let (interval, within) = (Duration::from_millis(100), Duration::from_millis(50));
            spec = spec.liveness(Liveness::pull(interval, within));
        }
        if let Some(on) = plan.depends_on {
            spec = spec.depends_on([self.parts[on].name.as_str()]);
        }
        if plan.essential {
            spec = spec.essential();
        }
        if plan.own_thread {
            spec = spec.on_own_thread();
        }
        if self.is_real() {
            // A thread that hangs is lost sooner than a block of the plan ends.
            spec = spec.max_block(Duration::from_millis(150));
        }
        (
            spec.ready_within(Duration::from_secs(3)).shutdown_within(Duration::from_secs(1)),
            plan.restart,
        )
    }
}

/// Keeps this thread for so long.
fn block(span: Duration) {
    let never = Mutex::new(());
    let guard = never.lock().unwrap_or_else(PoisonError::into_inner);
    let until = Instant::now() + span;
    let _ = Condvar::new().wait_timeout_while(guard, span, |()| Instant::now() < until);
}

pub(crate) struct Part {
    index: usize,
    incarnation: u64,
    plan: PartPlan,
    ledger: Ledger,
}

impl Part {
    fn write(&self, what: What) {
        self.ledger.write(self.index, self.incarnation, what);
    }

    fn strike(&self, cause: Cause) {
        self.write(What::Struck(cause));
    }

    /// Computes for as long as each of its handlers does.
    fn work(&self) {
        blastema_tests::burn(Duration::from_millis(self.plan.work_ms));
    }

    async fn act(&mut self, hook: &'static str, cx: &Context<Self>) -> Result<(), Failure> {
        if self.incarnation != cx.incarnation().0 {
            self.incarnation = cx.incarnation().0;
            self.write(What::Began);
        }
        if hook != "on_execute" {
            self.write(What::Hook(hook));
        }
        if hook == "on_initialize" && self.ledger.is_unplugged(self.index) {
            self.strike(Cause::Unavailable);
            return Err(Failure::unavailable("unplugged, says the plan"));
        }
        match self.ledger.next_pull(self.index, hook) {
            None => Ok(()),
            Some(Pull::Fail) => {
                self.strike(Cause::Fail(hook));
                Err("failure of the plan".into())
            }
            Some(Pull::Fatal) => {
                self.strike(Cause::Fatal(hook));
                Err(Failure::fatal("fatal failure of the plan"))
            }
            Some(Pull::Unavailable(_)) => {
                self.strike(Cause::Unavailable);
                Err(Failure::unavailable("not there yet, says the plan"))
            }
            Some(Pull::Panic) => self.ledger.panic(self.index, self.incarnation),
            Some(Pull::Wait(ms)) => {
                self.strike(Cause::Wait(ms));
                tokio::time::sleep(Duration::from_millis(ms)).await;
                self.write(What::Returned);
                Ok(())
            }
        }
    }

    fn publish(&self, cx: &mut Context<Self>) {
        let Some(topic) = self.plan.publishes else { return };
        let Ok(publisher) = cx.publisher::<Reading>(&format!("t{topic}")) else { return };
        let n = self.ledger.next_event(self.index);
        let (from, of, at) = (self.index as u64, self.incarnation, now());
        if publisher.publish(Reading { topic: topic as u64, from, of, n }).is_ok() {
            self.ledger.write_at(at, self.index, of, What::Published { topic, n });
        }
    }

    async fn consult(&self, other: usize, deadline_ms: u64, cx: &mut Context<Self>) {
        let name = self.ledger.robot.parts[other].name.clone();
        let Ok(sender) = cx.sender::<Work>(&name) else { return };
        self.strike(Cause::Consult);
        let by = Some((self.index, self.incarnation));
        let number = self.ledger.ask(other, by, deadline_ms);
        let within = Duration::from_millis(deadline_ms);
        let answer = sender.ask_within(Work { number, deed: Deed::Nothing }, within).await;
        self.ledger.answer(number, Answer::of(answer));
        self.write(What::Returned);
    }
}

impl Answer {
    pub(crate) fn of(answer: Result<u64, RequestError<Work>>) -> Answer {
        match answer {
            Ok(incarnation) => Answer::Reply(incarnation),
            Err(error) => match &error.kind {
                _ if error.outcome() == Outcome::NotTaken => {
                    Answer::NotTaken(format!("{:?}", error.kind))
                }
                DeliveryError::PeerDied { incarnation } => Answer::PeerDied(incarnation.0),
                DeliveryError::DeadlinePassed => Answer::DeadlinePassed,
                other => Answer::Other(format!("{other:?}")),
            },
        }
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        self.write(What::Dropped);
        if self.ledger.next_pull(self.index, "drop") == Some(Pull::Panic) {
            self.strike(Cause::DropPanic);
            panic!("panic in Drop of the plan");
        }
    }
}

impl Component for Part {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Work>();
        ports.accept::<Load>();
    }

    blastema_tests::hooks! {
        on_initialize on_startup on_activated on_deactivated on_aborting on_error on_reset
        on_shutdown on_finalize
    }
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.write(What::Round);
        self.work();
        self.publish(cx);
        self.act("on_execute", cx).await
    }
}

impl Handle<Work> for Part {
    async fn handle(&mut self, work: Work, cx: &mut Context<Self>) -> u64 {
        self.write(What::Serving(work.number));
        self.work();
        let (index, incarnation) = (self.index, self.incarnation);
        match work.deed {
            Deed::Nothing => {}
            Deed::Panic => self.ledger.panic(index, incarnation),
            Deed::PanicInTask(ms) => {
                let (ledger, scheduled) = (self.ledger.clone(), self.ledger.schedule());
                cx.spawn(async move {
                    tokio::time::sleep(Duration::from_millis(ms)).await;
                    let _scheduled = scheduled;
                    ledger.panic(index, incarnation);
                });
            }
            Deed::PanicInTimer(ms) => {
                let scheduled = self.ledger.schedule();
                cx.after(Duration::from_millis(ms), move |part, _| {
                    let _scheduled = &scheduled;
                    part.ledger.panic(index, incarnation);
                });
            }
            Deed::Fail => {
                self.strike(Cause::Fail("a handler"));
                cx.fail("failure of the plan");
            }
            Deed::FailFatally => {
                self.strike(Cause::Fatal("a handler"));
                cx.fail(Failure::fatal("fatal failure of the plan"));
            }
            Deed::Stop => {
                self.strike(Cause::Stop);
                cx.stop();
            }
            Deed::Await(ms) => {
                self.strike(Cause::Wait(ms));
                tokio::time::sleep(Duration::from_millis(ms)).await;
                self.write(What::Returned);
            }
            Deed::Block(ms) => {
                self.strike(Cause::Block(ms));
                block(Duration::from_millis(ms));
                self.write(What::Returned);
            }
            Deed::Declare => {
                self.strike(Cause::Declare);
                cx.declare_fault(FaultKind::CheckFailed, "wrong, says the plan");
            }
            Deed::Publish(count) => (0..count).for_each(|_| self.publish(cx)),
            Deed::Consult(other, deadline_ms) => {
                let other = usize::try_from(other).expect("an index of the plan");
                self.consult(other, deadline_ms, cx).await;
            }
        }
        incarnation
    }
}

impl Handle<Reading> for Part {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        let Reading { topic, from, of, n } = reading;
        let index = |number| usize::try_from(number).expect("an index of the plan");
        debug_assert!(index(topic) < TOPICS);
        self.write(What::Read { topic: index(topic), from: index(from), of, n });
        self.work();
    }
}

impl Handle<Load> for Part {
    async fn handle(&mut self, Load(n): Load, _: &mut Context<Self>) {
        self.write(What::Load(n));
        self.work();
    }
}

/// Watches every component of the plan, and writes down what it is told.
pub(crate) struct Watcher(pub(crate) Ledger);

impl Component for Watcher {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        for part in self.0.robot.parts.iter().filter(|part| !part.late) {
            cx.watch(&part.name)?;
        }
        self.0.watches();
        Ok(())
    }
}

impl Handle<Down> for Watcher {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        let Down { object, incarnation, ending, .. } = down;
        let object = object.to_string();
        let parts = &self.0.robot.parts;
        let Some(part) = parts.iter().position(|part| part.name == object) else { return };
        let ending = format!("{ending:?}");
        self.0.write(
            part,
            incarnation.0,
            What::Down { object, incarnation: incarnation.0, ending },
        );
    }
}
