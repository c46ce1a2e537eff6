//! The notification of recoverers about a fault, on this and on other nodes.

use super::{ConfirmedQueue, ConfirmedQueueLimits, ConfirmedQueueOutput, FaultNotice};
use crate::sorted::SortedMap;
use crate::{Instant, Machine, NodeName};
use std::fmt;
use std::time::Duration;

/// Hands every fault to every port, and limits storms.
///
/// Each port has a queue of its own, so that a recoverer that cannot be reached does not delay the
/// others. In a queue, ends of faults go first, then critical faults, errors, warnings. A fault is
/// never twice in a queue; one that has ended before its turn is taken out again.
#[derive(Clone, Debug)]
pub struct Notifier {
    limits: NotifierLimits,
    ports: SortedMap<RecovererPort, ConfirmedQueue<FaultNotice>>,
}

/// The bounds of a [`Notifier`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotifierLimits {
    /// How many ports there may be.
    pub ports: usize,
    /// The hand-over to the local recoverer.
    pub local: ConfirmedQueueLimits,
    /// The hand-over to another node's recoverer.
    pub remote: ConfirmedQueueLimits,
}

impl Default for NotifierLimits {
    fn default() -> Self {
        let remote = ConfirmedQueueLimits {
            // A round trip over two hops and a change of path takes less.
            timeout: Duration::from_millis(250),
            longest: Duration::from_secs(2),
            // Faults that another node's recoverer cannot keep up with do not help it, and the
            // network has other things to carry.
            per_second: 50,
            capacity: 256,
            ..ConfirmedQueueLimits::default()
        };
        // A recoverer takes in a fault in microseconds; a robot on which two hundred things break
        // each second is better served by the most important ones.
        let local = ConfirmedQueueLimits { per_second: 200, ..ConfirmedQueueLimits::default() };
        // A robot of more than thirty nodes informs the others over its fleet.
        NotifierLimits { ports: 32, local, remote }
    }
}

/// The recoverer that is notified.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RecovererPort {
    /// The recoverer of this node.
    Local,
    /// The recoverer of another node.
    Remote(NodeName),
}

impl fmt::Display for RecovererPort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RecovererPort::Local => f.write_str("here"),
            RecovererPort::Remote(node) => write!(f, "{node}"),
        }
    }
}

impl Notifier {
    /// A notifier without ports.
    pub fn new(limits: NotifierLimits) -> Self {
        Notifier { limits, ports: SortedMap::new() }
    }

    /// Opens a port; no, if there are too many. A port that is open stays as it is.
    pub fn add_port(&mut self, port: RecovererPort, now: Instant) -> bool {
        if self.ports.len() >= self.limits.ports && !self.ports.contains_key(&port) {
            return false;
        }
        let limits = match port {
            RecovererPort::Local => self.limits.local,
            RecovererPort::Remote(_) => self.limits.remote,
        };
        self.ports.entry(port).or_insert_with(|| ConfirmedQueue::new(limits, now.as_nanos()));
        true
    }

    /// The detector hands over what all recoverers must know.
    pub fn handle_notice(&mut self, notice: FaultNotice, now: Instant) {
        for queue in self.ports.values_mut() {
            let waited = queue.withdraw(|waiting| waiting.id() == notice.id()).is_some();
            match notice {
                // The recoverer behind this port does not know of it.
                FaultNotice::Cleared { .. } if waited => {}
                FaultNotice::Found(_) if queue.under_way() == Some(&notice) => {}
                _ => queue.hand(notice.rank(), notice.clone(), now),
            }
        }
    }

    /// A recoverer has confirmed.
    pub fn handle_confirmed(&mut self, port: &RecovererPort, number: u64, now: Instant) {
        if let Some(queue) = self.ports.get_mut(port) {
            queue.handle_confirmed(number, now);
        }
    }

    /// A notice is known not to have reached the recoverer.
    pub fn handle_failed(&mut self, port: &RecovererPort, number: u64, now: Instant) {
        if let Some(queue) = self.ports.get_mut(port) {
            queue.handle_failed(number, now);
        }
    }

    /// The notifier with the same facts, for an actor that panicked within an input.
    #[must_use]
    pub fn restarted(self, now: Instant) -> Self {
        let ports = self.ports.into_iter();
        let ports = ports.map(|(port, queue)| (port, queue.restarted(now))).collect();
        Notifier { ports, ..self }
    }
}

impl Machine for Notifier {
    type Output = (RecovererPort, ConfirmedQueueOutput<FaultNotice>);

    /// The next thing to do for the recoverer behind a port; a confirmation is brought to
    /// [`Notifier::handle_confirmed`].
    fn poll_output(&mut self) -> Option<Self::Output> {
        let mut ports = self.ports.iter_mut();
        ports.find_map(|(port, queue)| Some((port.clone(), queue.poll_output()?)))
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.ports.values().filter_map(Machine::poll_timeout).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.ports.values_mut().for_each(|queue| queue.handle_timeout(now));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{at, node};
    use crate::{Fault, FaultId, FaultKind, FaultLocation, Incarnation};

    fn remote() -> RecovererPort {
        RecovererPort::Remote(node("n"))
    }

    fn fault(id: u64, kind: FaultKind) -> FaultNotice {
        FaultNotice::Found(Fault {
            id: FaultId(id),
            severity: kind.severity(),
            kind,
            location: FaultLocation::Node(node("x")),
            incarnation: Incarnation::FIRST,
            detail: String::new(),
            found_at: at(0),
            symptom_of: None,
            count: 1,
        })
    }

    fn cleared(id: u64) -> FaultNotice {
        FaultNotice::Cleared { id: FaultId(id), location: FaultLocation::Node(node("x")) }
    }

    fn notifier(ports: &[RecovererPort]) -> Notifier {
        let mut notifier = Notifier::new(NotifierLimits::default());
        for port in ports {
            assert!(notifier.add_port(port.clone(), at(0)));
        }
        notifier
    }

    /// What is handed over ("here +1", "n -1"), confirmed at once or not.
    fn handed(notifier: &mut Notifier, confirm: bool, now: Instant) -> Vec<String> {
        let mut handed = Vec::new();
        while let Some(output) = notifier.poll_output() {
            match output {
                (port, ConfirmedQueueOutput::Deliver { number, item: notice }) => {
                    let sign = if matches!(notice, FaultNotice::Found(_)) { '+' } else { '-' };
                    handed.push(format!("{port} {sign}{}", notice.id().0));
                    if confirm {
                        notifier.handle_confirmed(&port, number, now);
                    }
                }
                (port, ConfirmedQueueOutput::GivenUp { item: notice, tries }) => {
                    handed.push(format!("{port} gave up {} after {tries}", notice.id().0));
                }
            }
        }
        handed
    }

    #[test]
    fn every_port_is_told_of_every_fault() {
        let mut notifier = notifier(&[RecovererPort::Local, remote()]);

        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));
        notifier.handle_notice(cleared(1), at(0));

        let reported = handed(&mut notifier, true, at(1));
        assert_eq!(reported, ["here +1", "here -1", "n +1", "n -1"]);
        assert_eq!(notifier.poll_timeout(), None, "nothing waits");
    }

    #[test]
    fn an_unreachable_port_delays_no_other_and_its_notices_are_given_up() {
        let mut notifier = notifier(&[RecovererPort::Local, remote()]);
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));

        let mut reported = Vec::new();
        let mut now = at(0);
        loop {
            while let Some(output) = notifier.poll_output() {
                match output {
                    (RecovererPort::Local, ConfirmedQueueOutput::Deliver { number, .. }) => {
                        notifier.handle_confirmed(&RecovererPort::Local, number, now);
                        reported.push("here".to_string());
                    }
                    (_, ConfirmedQueueOutput::Deliver { .. }) => reported.push("n".into()),
                    (_, ConfirmedQueueOutput::GivenUp { tries, .. }) => {
                        reported.push(format!("lost after {tries}"))
                    }
                }
            }
            let Some(due) = notifier.poll_timeout() else { break };
            now = due;
            notifier.handle_timeout(due);
        }

        assert_eq!(reported, ["here", "n", "n", "n", "n", "n", "n", "n", "n", "lost after 8"]);
    }

    #[test]
    fn critical_faults_overtake_and_what_is_over_goes_before_them() {
        let mut notifier = notifier(&[RecovererPort::Local]);
        notifier.handle_notice(fault(1, FaultKind::Overload), at(0));
        notifier.handle_notice(fault(2, FaultKind::Overload), at(0));
        notifier.handle_notice(fault(3, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(4, FaultKind::NodeLost), at(0));
        notifier.handle_notice(cleared(1), at(0));

        let reported = handed(&mut notifier, true, at(1));

        assert_eq!(reported, ["here +1", "here -1", "here +4", "here +3", "here +2"]);
    }

    #[test]
    fn a_symptom_goes_after_the_roots_of_its_severity() {
        let mut notifier = notifier(&[RecovererPort::Local]);
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));
        let FaultNotice::Found(symptom) = fault(2, FaultKind::Silence) else { return };
        let symptom = Fault { symptom_of: Some(FaultId(1)), ..symptom };
        notifier.handle_notice(FaultNotice::Found(symptom), at(0));
        notifier.handle_notice(fault(3, FaultKind::Panic), at(0));

        assert_eq!(handed(&mut notifier, true, at(1)), ["here +1", "here +3", "here +2"]);
    }

    #[test]
    fn a_fault_is_queued_once_and_not_at_all_if_it_clears_in_time() {
        let mut notifier = notifier(&[RecovererPort::Local]);
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(2, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(2, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(3, FaultKind::Panic), at(0));
        notifier.handle_notice(cleared(3), at(0));

        assert_eq!(handed(&mut notifier, true, at(1)), ["here +1", "here +2"]);
    }

    #[test]
    fn too_many_ports_are_refused_and_a_known_one_keeps_what_waits() {
        let limits = NotifierLimits { ports: 1, ..NotifierLimits::default() };
        let mut notifier = Notifier::new(limits);
        assert!(notifier.add_port(RecovererPort::Local, at(0)));
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));

        assert!(!notifier.add_port(remote(), at(0)));
        assert!(notifier.add_port(RecovererPort::Local, at(0)));

        assert_eq!(handed(&mut notifier, true, at(0)), ["here +1"]);
    }

    #[test]
    fn a_notifier_that_was_struck_hands_over_again_what_was_not_confirmed() {
        let mut notifier = notifier(&[RecovererPort::Local, remote()]);
        notifier.handle_notice(fault(1, FaultKind::Panic), at(0));
        notifier.handle_notice(fault(2, FaultKind::Panic), at(0));
        handed(&mut notifier, false, at(0));

        let mut notifier = notifier.restarted(at(1));

        let reported = handed(&mut notifier, true, at(1));
        assert_eq!(reported, ["here +1", "here +2", "n +1", "n +2"]);
    }
}
