//! What each finding means: the detector's opinion of objects, links and nodes.

use super::node_history::PERIOD;
use super::{AFTER_PAUSE, Cause, Detector, HINDSIGHT, Scene, Seen};
use crate::detection::{ExitReason, Finding, LinkCondition, NodeCondition, OverloadFigures};
use crate::{
    Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant, Lifecycle, NodeName, ObjectName,
};
use std::time::Duration;

impl Detector {
    pub(super) fn judge_object(&mut self, object: &ObjectName, scene: Scene, finding: Finding) {
        if let Finding::Dismissed = finding {
            self.objects.remove(object);
            self.needs.forget(object);
            return self.end_all_at(&scene, |_| true, false);
        }
        let fresh = Seen::new(scene.incarnation);
        let seen = self.objects.entry(object.clone()).or_insert(fresh);
        if let Finding::Isolated { isolated } = finding {
            seen.isolated = isolated;
            return;
        }
        if scene.incarnation < seen.incarnation {
            return self.judge_late(&scene, finding);
        }
        let is_newer = scene.incarnation > seen.incarnation;
        if is_newer {
            seen.begin(scene.incarnation);
            seen.behind = None;
        }
        if is_newer || (ends_waiting(&finding) && !self.ending) {
            self.end_kind(&scene, &FaultKind::Unavailable);
        }
        match finding {
            Finding::Enrolled { may_end, depends_on } => {
                self.needs.declare(object, depends_on);
                self.seen(object).may_end = may_end;
            }
            Finding::Exited { exit, restarted_as } => {
                self.judge_exit(object, &scene, exit, restarted_as);
            }
            Finding::State { state, reason } => self.judge_state(object, &scene, state, reason),
            Finding::Declared { kind, detail } => {
                self.find(&scene, kind, detail, Cause::Above);
            }
            Finding::Cleared { kind } => self.end_kind(&scene, &kind),
            Finding::Silent { age } => {
                let detail = format!("no sign of life for {} ms", age.as_millis());
                let cause = self.cause_of_standstill(object, &scene);
                self.find(&scene, FaultKind::Silence, detail, cause);
            }
            Finding::Spoke => self.end_kind(&scene, &FaultKind::Silence),
            Finding::Hangs { during, age, victims } => {
                self.judge_hang(object, &scene, during, age, &victims);
            }
            Finding::Waits { during, age } => {
                let detail = format!("{during} has been waiting for {} ms", age.as_millis());
                self.find(&scene, FaultKind::Hang, detail, Cause::Above);
            }
            Finding::Overloaded { figures, victims } => {
                let detail = describe(&figures, victims.len());
                let id = self.find(&scene, FaultKind::Overload, detail, Cause::Above);
                self.put_behind(id, victims.iter().filter(|&victim| victim != object));
            }
            Finding::Flows => self.end_kind(&scene, &FaultKind::Overload),
            Finding::Resumed => {
                self.seen(object).behind = None;
                self.end_kind(&scene, &FaultKind::Hang);
            }
            Finding::Lost { culprit } => {
                let cause = self.cause_of_loss(object, &culprit, scene.at);
                let detail = format!("it stands still behind {culprit}, which does not return");
                self.find(&scene, FaultKind::Hang, detail, cause);
            }
            Finding::Dismissed | Finding::Isolated { .. } | Finding::Link(_) | Finding::Node(_) => {
            }
        }
    }

    /// What is known of an object that was just judged.
    fn seen(&mut self, object: &ObjectName) -> &mut Seen {
        self.objects.get_mut(object).expect("`judge_object` has put it there")
    }

    /// The hang, or the overload that still stands, behind which an object is blocked. Where the
    /// culprit of a hang has been replaced elsewhere, its victims stand until they are freed.
    pub(super) fn behind(&self, object: &ObjectName) -> Option<FaultId> {
        let behind = self.objects.get(object)?.behind;
        behind.filter(|&id| self.is_hang(id) || self.fault_log.stands(id))
    }

    /// What is seen of an incarnation that is over changes nothing; but that it panicked is
    /// recorded. Its report comes late where the incarnation that followed has blocked its thread.
    fn judge_late(&mut self, scene: &Scene, finding: Finding) {
        let Finding::Exited { exit: ExitReason::Panicked { text, at, during }, .. } = finding
        else {
            return;
        };
        if let Some(id) = self.fault_log.open_fault(&scene.location, &FaultKind::Panic) {
            let entry = self.fault_log.entry_mut(id).expect("it stands");
            entry.fault.count = entry.fault.count.saturating_add(1);
            return;
        }
        let detail = describe_panic(&text, &at, during);
        let id = self.record(scene, FaultKind::Panic, detail, Cause::Itself);
        self.await_next_incarnation(id, scene.at);
    }

    /// An object that waits behind a hang is remembered, so that its silence is known for a
    /// symptom.
    fn judge_hang(
        &mut self,
        object: &ObjectName,
        scene: &Scene,
        during: &str,
        age: Duration,
        victims: &[ObjectName],
    ) {
        let others = victims.iter().filter(|&victim| victim != object);
        let behind = match others.clone().count() {
            0 => String::new(),
            1 => "; 1 other stands still behind it".to_owned(),
            count => format!("; {count} others stand still behind it"),
        };
        let age = age.as_millis();
        let detail = format!("{during} has kept its thread for {age} ms at least{behind}");
        let id = self.find(scene, FaultKind::Hang, detail, Cause::Itself);
        for victim in others {
            if let Some(seen) = self.objects.get_mut(victim) {
                seen.behind = Some(id);
            }
        }
        self.explain_by(id, scene.at);
    }

    /// These wait behind an overload, unless they stand still behind a hang. That is remembered, so
    /// that their silence is known for a symptom.
    fn put_behind<'a>(&mut self, id: FaultId, victims: impl Iterator<Item = &'a ObjectName>) {
        for victim in victims {
            let hangs = self.behind(victim).is_some_and(|root| self.is_hang(root));
            if let Some(seen) = self.objects.get_mut(victim).filter(|_| !hangs) {
                seen.behind = Some(id);
            }
        }
    }

    fn is_hang(&self, id: FaultId) -> bool {
        self.fault_log.entry(id).is_some_and(|entry| entry.fault.kind == FaultKind::Hang)
    }

    fn judge_exit(
        &mut self,
        object: &ObjectName,
        scene: &Scene,
        exit: ExitReason,
        restarted_as: Option<Incarnation>,
    ) {
        // A thread that was lost to a hang may end before its last victim was replaced.
        let hang = self.behind(object).filter(|&root| self.is_hang(root));
        let hang = hang.filter(|_| exit == ExitReason::Aborted);
        let cause = hang.map_or(Cause::Itself, Cause::Known);
        let error = self.fault_log.open_fault(&scene.location, &FaultKind::ErrorState);
        let seen = self.objects.get_mut(object).expect("the caller has put it there");
        let before = seen.state;
        // An incarnation that was already over ends in some way or other; that is no second fault.
        let over = std::mem::replace(&mut seen.doomed, exit != ExitReason::Stopped);
        seen.state = match exit {
            ExitReason::Stopped => Lifecycle::Finalized,
            _ => Lifecycle::Fatal,
        };
        let (kind, detail) = match exit {
            ExitReason::Panicked { text, at, during } => {
                (FaultKind::Panic, describe_panic(&text, &at, during))
            }
            ExitReason::Returned if !over && !seen.may_end => {
                // An incarnation that ends itself in order is finalized before its guard says how
                // it ended.
                (FaultKind::UnexpectedExit, "it ended itself without having been told to".into())
            }
            // One whose start has failed leaves by way of its error state.
            ExitReason::Fatal if !over && error.is_none() => {
                (FaultKind::UnexpectedExit, "it could not go on, and did not say why".into())
            }
            ExitReason::Aborted if !over && before != Lifecycle::Finalized => {
                (FaultKind::UnexpectedExit, format!("its arbiter went away while it was {before}"))
            }
            ExitReason::Stopped => return self.end_unhanded_at(&scene.location, scene.at),
            ExitReason::Returned if !over => {
                seen.state = Lifecycle::Finalized;
                return self.end_unhanded_at(&scene.location, scene.at);
            }
            ExitReason::Returned | ExitReason::Fatal | ExitReason::Aborted => return,
        };
        let Some(next) = restarted_as else {
            self.find(scene, kind, detail, cause);
            return;
        };
        seen.begin(next);
        let id = self.count_or_record(scene, kind, detail, cause);
        // A recoverer is notified if the next incarnation dies likewise.
        self.await_next_incarnation(id, scene.at);
    }

    fn judge_state(
        &mut self,
        object: &ObjectName,
        scene: &Scene,
        state: Lifecycle,
        reason: Option<String>,
    ) {
        let seen = self.seen(object);
        let before = std::mem::replace(&mut seen.state, state);
        seen.doomed |= state == Lifecycle::Fatal;
        let on_the_way = matches!(state, Lifecycle::Initialized | Lifecycle::Finalized);
        // At work, what a program says of itself is no failure.
        let has_failed = on_the_way || before == state && state != Lifecycle::Active;
        if let Some(reason) = reason.as_ref().filter(|_| has_failed) {
            self.note_failed_stop(scene, reason);
        }
        if before == state {
            return;
        }
        // A guard reports the state at the end of a turn, not the states that it passed.
        if !before.may_reach(state) {
            let detail = format!("it went from {before} to {state}, and no way leads there");
            self.find(scene, FaultKind::CheckFailed, detail, Cause::Itself);
        }
        let reason = reason.unwrap_or_else(|| "it gave no reason".into());
        match state {
            Lifecycle::Error => {
                self.find(scene, FaultKind::ErrorState, reason, Cause::Above);
            }
            Lifecycle::Fatal if before == Lifecycle::Created => {
                self.find(scene, FaultKind::InitializationFailed, reason, Cause::Above);
            }
            Lifecycle::Fatal => {
                self.find(scene, FaultKind::Fatal, reason, Cause::Above);
            }
            Lifecycle::Active => {
                let incarnation = scene.incarnation;
                // Also what a reset of this incarnation was to end that came to wait.
                let waits: Vec<FaultId> = self.unhanded_at(&scene.location).map(|f| f.id).collect();
                let is_isolated = self.seen(object).isolated;
                let entry = |fault: &Fault| self.fault_log.entry(fault.id);
                let contained: Vec<FaultId> = (self.fault_log.open_faults_at(&scene.location))
                    .filter(|fault| {
                        is_isolated && entry(fault).is_some_and(|entry| entry.given_up.is_some())
                    })
                    .map(|fault| fault.id)
                    .collect();
                let is_over = |fault: &Fault| {
                    // No incarnation of a transport makes its network secure.
                    if contained.contains(&fault.id) || fault.kind == FaultKind::Insecure {
                        return false;
                    }
                    let ended =
                        matches!(fault.kind, FaultKind::ErrorState | FaultKind::Unavailable);
                    fault.incarnation < incarnation || ended || waits.contains(&fault.id)
                };
                self.end_all_at(scene, is_over, true);
            }
            // The group has ended, and its restarts with it.
            Lifecycle::Finalized if !self.ending => self.end_kind(scene, &FaultKind::RestartStorm),
            Lifecycle::Created | Lifecycle::Initialized | Lifecycle::Finalized => {}
        }
    }

    /// A hook that brings the component to rest has failed. The recoverer is not notified: what was
    /// to end has ended, or is recovered from already.
    fn note_failed_stop(&mut self, scene: &Scene, reason: &str) {
        let known = self.fault_log.open_fault(&scene.location, &FaultKind::ErrorState);
        if !known.is_some_and(|id| self.repeat(id, scene, reason)) {
            let id = self.record(scene, FaultKind::ErrorState, reason.to_owned(), Cause::Itself);
            self.repair(id, scene.at);
        }
    }

    pub(super) fn judge_link(&mut self, scene: Scene, finding: Finding) {
        let Finding::Link(condition) = finding else { return };
        match condition {
            LinkCondition::Up | LinkCondition::Forgotten => {
                self.end_kind(&scene, &FaultKind::LinkDown);
                self.end_kind(&scene, &FaultKind::LinkDegraded);
            }
            LinkCondition::Degraded { reason } => {
                self.end_kind(&scene, &FaultKind::LinkDown);
                let cause = self.pause_or(Cause::Above);
                self.find(&scene, FaultKind::LinkDegraded, reason, cause);
            }
            LinkCondition::Down { reason } => {
                self.end_kind(&scene, &FaultKind::LinkDegraded);
                let cause = self.pause_or(Cause::Above);
                self.find(&scene, FaultKind::LinkDown, reason, cause);
            }
        }
    }

    pub(super) fn judge_node(&mut self, scene: Scene, finding: Finding) {
        let (Finding::Node(condition), FaultLocation::Node(node)) =
            (finding, scene.location.clone())
        else {
            return;
        };
        match condition {
            NodeCondition::Reachable => {
                self.nodes.handle_reachable(&node, true, scene.at);
                self.end_kind(&scene, &FaultKind::NodeLost);
            }
            NodeCondition::Left | NodeCondition::Removed => {
                self.end_crash_loop(&node, scene.at);
                self.end_kind(&scene, &FaultKind::NodeLost);
                self.end_kind(&scene, &FaultKind::NodeInSafeState);
                self.end_kind(&scene, &FaultKind::ConnectionLost);
                self.end_links_to(&node, scene.at);
            }
            NodeCondition::InSafeState { reason } => {
                let detail = format!("nothing of it serves until it is restarted: {reason}");
                self.find(&scene, FaultKind::NodeInSafeState, detail, Cause::Itself);
            }
            NodeCondition::AtWork => self.end_kind(&scene, &FaultKind::NodeInSafeState),
            // They are no findings.
            NodeCondition::Listed | NodeCondition::MayBeAway => {}
            NodeCondition::Lost { reason } => {
                self.nodes.handle_reachable(&node, false, scene.at);
                let cause = self.crash_loop_of(&scene);
                let cause = self.pause_or(cause);
                self.find(&scene, FaultKind::NodeLost, reason, cause);
            }
            NodeCondition::Paused { span } => self.judge_pause(&scene, span),
            NodeCondition::Overloaded { waited_percent, figures, victims } => {
                let detail = format!(
                    "the computer is overloaded: a thread of this node waited for a processor for \
                     {waited_percent} % of the time; {}",
                    describe(&figures, victims.len())
                );
                self.find(&scene, FaultKind::Overload, detail, Cause::Itself);
            }
            NodeCondition::Relieved => self.end_kind(&scene, &FaultKind::Overload),
            NodeCondition::Offends { what } => {
                if let Some(detail) = self.nodes.handle_offence(&node, what, scene.at) {
                    self.find(&scene, FaultKind::NodeFaulty, detail, Cause::Itself);
                }
            }
            NodeCondition::Isolated { reason } => {
                let detail = format!("it is isolated: {reason}");
                self.find(&scene, FaultKind::NodeFaulty, detail, Cause::Itself);
            }
            NodeCondition::Admitted => {
                self.nodes.handle_admitted(&node);
                self.end_kind(&scene, &FaultKind::NodeFaulty);
            }
            NodeCondition::MessagesLost { detail } => {
                let cause = self.cause_of_lost_messages(&node, &scene);
                self.find(&scene, FaultKind::ConnectionLost, detail, cause);
            }
            NodeCondition::InSession => self.end_kind(&scene, &FaultKind::ConnectionLost),
            NodeCondition::Restarted => {
                self.end_kind(&scene, &FaultKind::NodeInSafeState);
                if let Some(count) = self.nodes.handle_restarted(&node, scene.at) {
                    let detail = format!(
                        "its process died and was started again {count} times, and never stayed \
                         up for {PERIOD:?}"
                    );
                    self.find(&scene, FaultKind::CrashLoop, detail, Cause::Itself);
                }
                let known = self.fault_log.open_fault(&scene.location, &FaultKind::NodeLost);
                let id = known.unwrap_or_else(|| {
                    let detail = "its process died and began again".into();
                    let cause = self.crash_loop_of(&scene);
                    self.record(&scene, FaultKind::NodeLost, detail, cause)
                });
                self.recover(id, scene.at);
                self.end(id, scene.at);
            }
        }
    }

    /// Why messages to a node were lost: the node was lost, or is, or a link to it is down. A session
    /// shows what it has lost when the node is back.
    fn cause_of_lost_messages(&self, node: &NodeName, scene: &Scene) -> Cause {
        let lately = |fault: &&Fault| {
            let entry = self.fault_log.entry(fault.id);
            let ended = entry.and_then(|entry| entry.repaired_at);
            ended.is_none_or(|at| scene.at - at <= AFTER_PAUSE)
        };
        let is_cause = |fault: &&Fault| match &fault.location {
            FaultLocation::Node(_) => {
                fault.location == scene.location && fault.kind == FaultKind::NodeLost
            }
            FaultLocation::Link { neighbour, .. } => {
                neighbour.as_ref() == Some(node) && fault.kind == FaultKind::LinkDown
            }
            FaultLocation::Object(_) => false,
        };
        let mut causes = self.fault_log.latest_first().filter(is_cause).filter(lately);
        causes.next().map_or(Cause::Itself, |fault| Cause::Known(fault.id))
    }

    /// A node has ended in order, or has stayed up for long enough: it is in a crash loop no more.
    pub(super) fn end_crash_loop(&mut self, node: &NodeName, at: Instant) {
        self.nodes.forget_restarts(node);
        let location = FaultLocation::Node(node.clone());
        let scene = Scene { location, incarnation: Incarnation::default(), at };
        self.end_kind(&scene, &FaultKind::CrashLoop);
    }

    /// A death in a crash loop is a symptom of that.
    fn crash_loop_of(&self, scene: &Scene) -> Cause {
        let known = self.fault_log.open_fault(&scene.location, &FaultKind::CrashLoop);
        known.map_or(Cause::Itself, Cause::Known)
    }

    /// A node that leaves in order takes its ends of the cables along.
    fn end_links_to(&mut self, node: &NodeName, at: Instant) {
        let leads_there = |fault: &&Fault| match &fault.location {
            FaultLocation::Link { neighbour, .. } => neighbour.as_ref() == Some(node),
            FaultLocation::Object(_) | FaultLocation::Node(_) => false,
        };
        let locations = self.fault_log.all_open().filter(leads_there);
        let locations: Vec<FaultLocation> = locations.map(|fault| fault.location.clone()).collect();
        for location in locations {
            let scene = Scene { location, incarnation: Incarnation::default(), at };
            self.end_all_at(&scene, |_| true, false);
        }
    }

    /// The hang that kept the thread; where the culprit was cut off before it was found to hang,
    /// what was found of the culprit shortly before.
    fn cause_of_loss(&self, victim: &ObjectName, culprit: &ObjectName, at: Instant) -> Cause {
        let since = at - (Instant::ORIGIN + HINDSIGHT);
        let is_at_culprit = |fault: &Fault| match &fault.location {
            FaultLocation::Object(address) => address.object == *culprit,
            _ => false,
        };
        let of_culprit = || {
            let mut latest = self.fault_log.latest_first();
            latest
                .find(|fault| fault.kind.is_down() && is_at_culprit(fault))
                .and_then(|fault| (fault.found_at - Instant::ORIGIN >= since).then_some(fault.id))
        };
        self.behind(victim).or_else(of_culprit).map_or(Cause::Above, Cause::Known)
    }

    /// An object that stands still does so behind a hang, or because of what else is wrong with
    /// itself, or because of what it depends on.
    fn cause_of_standstill(&self, object: &ObjectName, scene: &Scene) -> Cause {
        let own = || {
            let here = self.fault_log.open_faults_at(&scene.location);
            here.filter(|fault| fault.kind.is_down() && fault.kind != FaultKind::Silence)
                .map(|fault| fault.id)
                .min()
        };
        let behind = self.behind(object).map(Cause::Behind);
        behind.unwrap_or_else(|| own().map_or(Cause::Above, Cause::Known))
    }
}

fn describe_panic(text: &str, at: &str, during: &str) -> String {
    match at {
        // A panic that was injected has no place in a source.
        "" => format!("{text}, in {during}"),
        at => format!("{text}, at {at}, in {during}"),
    }
}

/// Whether an incarnation of which this was seen does not wait any more for what was not there yet.
/// One that is at work has recovered besides.
fn ends_waiting(finding: &Finding) -> bool {
    match finding {
        Finding::Exited { .. } | Finding::Hangs { .. } | Finding::Waits { .. } => true,
        Finding::Declared { kind, .. } => *kind == FaultKind::InitializationFailed,
        Finding::State { state, .. } => {
            matches!(state, Lifecycle::Error | Lifecycle::Fatal | Lifecycle::Finalized)
        }
        _ => false,
    }
}

fn describe(figures: &OverloadFigures, victims: usize) -> String {
    let mut parts = Vec::new();
    if figures.utilisation_percent > 0 {
        parts
            .push(format!("it keeps its thread for {} % of the time", figures.utilisation_percent));
    }
    let oldest = figures.oldest.as_millis();
    match figures.queued {
        0 => {}
        1 => parts.push(format!("1 message waits; it is {oldest} ms old")),
        many => parts.push(format!("{many} messages wait; the oldest is {oldest} ms old")),
    }
    if figures.missed_rounds > 0 {
        parts.push(format!("{} rounds were missed", figures.missed_rounds));
    }
    if figures.expired > 0 {
        parts.push(format!("{} came too late for those who waited", messages(figures.expired)));
    }
    if !figures.silent_for.is_zero() {
        parts.push(format!("no sign of life came for {} ms", figures.silent_for.as_millis()));
    }
    match victims {
        0 => {}
        1 => parts.push("1 other waits behind it".into()),
        many => parts.push(format!("{many} others wait behind it")),
    }
    if parts.is_empty() { "it is late".into() } else { parts.join("; ") }
}

fn messages(count: impl TryInto<u64>) -> String {
    match count.try_into().unwrap_or(u64::MAX) {
        1 => "1 message".to_owned(),
        many => format!("{many} messages"),
    }
}
